"""Lines of what drives a machine: the mesh of a gear with its sidebands, and an induction motor's.

Such lines may fall where a bearing's are looked for. A mesh is a strong line at a whole order, the number of
teeth, well above the orders beside it, and so is its second harmonic. Narrow sidebands come in pairs, as far
apart as the mate turns, and the mate has a whole number of teeth, too. A motor has a line at twice the line
frequency, to within what a grid varies.

Sources: Randall, Vibration-based Condition Monitoring (2nd ed. 2021), sections 2.3 (gears) and 2.4 (motors).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Complex = NDArray[np.complex128]
    Real = NDArray[np.float64]

LINE_FREQUENCIES_HZ = (50.0, 60.0)
GRID_SHARE = 0.002
"""How far a grid's frequency may be off."""
_LINE_DB = 15.0
"""A line that stands out: of noise the best of 10,000 bins reaches 12 dB over its median."""
_SIDEBAND_DB = 12.0
_ABOUT_BINS = 40
"""Bins on either side that show the noise about a line."""
_REACH_BINS = 1.5
"""How far a line may be from where it is looked for."""
_SKIRT_BINS = (5, 12)
"""Bins from a line where only one that is smeared, as slip smears a bearing's, has much left ..."""
_SHARP_DB = 6.0
"""... and how far a narrow one rises above it."""
_LEAST_TEETH, _MOST_TEETH = 12, 120
"""Gears with fewer are rare, as their teeth are cut away at the foot."""
_LEAST_MATE_TEETH = 10
"""A mate may have fewer, but then its sidebands must show about the second harmonic of the mesh, too."""
TOP_ORDER = 2.0 * _MOST_TEETH + 4.0
"""The highest order that is examined: beside the second harmonic of a mesh."""
_CARRIER_DB = 6.0
"""How far a mesh and its second harmonic rise above the harmonics of the shaft beside them."""
_MESH_SHARE = 0.06
"""Of the signal's deviation that a mesh has at least: harmonics of a damaged race fall on whole orders by
chance, and their neighbours look like sidebands then. Those of measured records had mostly up to .05."""
_LEAST_REVOLUTIONS = 60.0
"""With fewer the sidebands of neighbouring numbers of teeth cannot be told apart."""
_SIDEBAND_ORDERS = (1, 2, 3)
_LEAST_PAIRS = 2
_MOST_SLIP = 0.08
_MOST_POLE_PAIRS = 8


@dataclass(frozen=True, slots=True)
class DriveLines:
    """The lines of one gear or motor.

    Attributes:
        kind: ``"gear"``, or ``"motor"``.
        frequency_hz: of the mesh, or twice the line frequency.
        order: the same per revolution of the shaft.
        teeth: of the gear on this shaft; None of a motor.
        mate_teeth: of the gear that it meshes with; None of a motor.
        spacing: of the sidebands in orders: the mate's speed, or the pole-pass frequency; None if none show.
        poles: of a motor; None if its speed is not near a synchronous one, or of a gear.
    """

    kind: Literal["gear", "motor"]
    frequency_hz: float
    order: float
    teeth: int | None = None
    mate_teeth: int | None = None
    spacing: float | None = None
    poles: int | None = None

    def explained(self, highest: float) -> tuple[float, ...]:
        """Orders at which it makes lines in an envelope, beside the shaft's harmonics, up to one."""
        if self.kind == "gear" and self.spacing is not None:
            count = int(highest / self.spacing) + 1
            return tuple(k * self.spacing for k in range(1, count + 1))
        pole_pass = (0.0,) if self.spacing is None else (-self.spacing, 0.0, self.spacing)
        # The line frequency itself modulates where the phases are not alike.
        multiples = range(1, int(2.0 * highest / self.order) + 2)
        return tuple(0.5 * k * self.order + side for k in multiples for side in pole_pass)

    def describe_as_doubt(self) -> str:
        """The same of a gear that may be none."""
        return (
            f"lines {self.spacing:.4g} orders apart about {self.order:g}X, as of a gear of {self.teeth} "
            f"teeth and a mate of {self.mate_teeth}, are as far apart as those of a damaged part"
        )

    def describe(self) -> str:
        """One sentence for a person."""
        if self.kind == "gear":
            turns_hz = self.frequency_hz / self.order * (self.spacing or 0.0)
            return (
                f"a gear of {self.teeth} teeth on this shaft meshes at {self.frequency_hz:.1f} Hz; its mate "
                f"of {self.mate_teeth} teeth turns at {60.0 * turns_hz:.0f} rpm and makes sidebands "
                f"{self.spacing:.4g} orders apart: these lines are the gear's, not the bearing's"
            )
        sentence = f"a line of an induction motor stands out at {self.frequency_hz:.2f} Hz, twice the mains"
        if self.poles is not None:
            sentence += f" ({self.poles} poles"
            if self.spacing is not None:
                pass_hz = self.frequency_hz / self.order * self.spacing
                sentence += f", sidebands at the pole-pass frequency of {pass_hz:.2f} Hz"
            sentence += ")"
        return sentence + ": lines at multiples of the mains are the motor's, not the bearing's"


class LineLevels:
    """How far lines stand out of the spectrum of a signal.

    Args:
        spectrum: complex ``[bins]``, one-sided, of the whole record from 0 Hz, without window.
        step_hz: between two bins.
        top_hz: what lies above is not examined.
    """

    def __init__(self, spectrum: Complex, step_hz: float, top_hz: float) -> None:
        self.step_hz = step_hz
        # Hann's window, as neighbouring bins: strong lines must not leak onto others.
        windowed = 0.5 * spectrum
        windowed[1:-1] -= 0.25 * (spectrum[:-2] + spectrum[2:])
        power: Real = windowed.real**2 + windowed.imag**2
        self._total = float(power[1:].sum())
        self._power = power[: int(top_hz / step_hz) + 1].copy()
        self.top_hz = (len(self._power) - 1) * step_hz

    def level_db(self, hz: float, reach_hz: float = 0.0) -> float:
        """The strongest bin about a frequency over the median of the noise there, in dB."""
        reach = max(_REACH_BINS, reach_hz / self.step_hz)
        centre = hz / self.step_hz
        first, last = math.ceil(centre - reach), math.floor(centre + reach)
        begin, end = max(first - _ABOUT_BINS, 1), last + _ABOUT_BINS + 1
        if first < 1 or end > len(self._power):
            return -math.inf
        noise = float(np.median(self._power[begin:end]))
        return 10.0 * math.log10(float(self._power[first : last + 1].max()) / max(noise, 1e-300) + 1e-30)

    def narrow_db(self, hz: float, skirt_share: float = 1.0) -> float:
        """The level of a line that is as narrow as the record allows; minus infinity where it is smeared.

        Args:
            hz: where it is.
            skirt_share: share of the bins beside it that must be low; others may hold another line.
        """
        centre = round(hz / self.step_hz)
        near, far = _SKIRT_BINS
        if centre < far + 1 or centre + far + 1 > len(self._power):
            return -math.inf
        skirt = np.r_[
            self._power[centre - far : centre - near + 1], self._power[centre + near : centre + far + 1]
        ]
        narrow = self._power[centre - 2 : centre + 3].max() > 10.0 ** (0.1 * _SHARP_DB) * np.quantile(
            skirt, skirt_share
        )
        return self.level_db(hz) if narrow else -math.inf

    def strongest_hz(self, hz: float, reach_hz: float) -> float:
        """Where the strongest bin about a frequency is, between the bins by its neighbours."""
        reach = max(_REACH_BINS, reach_hz / self.step_hz)
        centre = hz / self.step_hz
        first, last = math.ceil(centre - reach), math.floor(centre + reach)
        peak = first + int(np.argmax(self._power[first : last + 1]))
        low, middle, high = np.sqrt(self._power[peak - 1 : peak + 2])
        return float((peak + (high - low) / (low + middle + high)) * self.step_hz)

    def share(self, hz: float) -> float:
        """Deviation of the line about a frequency over that of the whole signal."""
        # Hann's window leaves 3/8 of the power of either.
        peak = round(hz / self.step_hz)
        line = float(self._power[max(peak - 2, 1) : peak + 3].sum())
        return math.sqrt(line / max(self._total, 1e-300))

    def power(self, hz: float) -> float:
        """Of the strongest bin about a frequency."""
        centre = hz / self.step_hz
        first, last = math.ceil(centre - _REACH_BINS), math.floor(centre + _REACH_BINS)
        return float(self._power[first : last + 1].max())


SHARP, VAGUE = 0.0012, 0.006
"""How well the speed of a shaft is known, as shares, where its harmonics show it sharply and where not."""


def drive_lines(levels: LineLevels, shaft_hz: float, *, known: float) -> tuple[DriveLines, ...]:
    """Recognise a gear on a shaft, and an induction motor, by their lines in a signal.

    Args:
        levels: of the signal's spectrum, in which the shaft turns evenly.
        shaft_hz: revolutions per second.
        known: how well, as a share; a gear is looked for only where it is known within `SHARP`.
    """
    gear = _gear(levels, shaft_hz) if known <= SHARP else None
    sources = (gear, motor_lines(levels, shaft_hz, known))
    return tuple(each for each in sources if each is not None)


def _gear(lines: LineLevels, shaft_hz: float) -> DriveLines | None:
    """The gear on the shaft whose mesh is strongest."""
    if shaft_hz / lines.step_hz < _LEAST_REVOLUTIONS:
        return None
    most = min(_MOST_TEETH, int(lines.top_hz / shaft_hz) - len(_SIDEBAND_ORDERS))
    clear = [z for z in range(_LEAST_TEETH, most + 1) if _is_mesh(lines, z, shaft_hz)]
    # Harmonics of a mesh look like one, too: the lowest of them is the mesh.
    meshes = [z for z in clear if not any(z % lower == 0 for lower in clear if lower < z)]
    for teeth in sorted(meshes, key=lambda z: lines.power(z * shaft_hz), reverse=True):
        mate = _mate(lines, teeth, shaft_hz)
        # A line without a mate's sidebands may be the blades of a fan, or a bearing that hardly slips.
        if mate is not None:
            return DriveLines("gear", teeth * shaft_hz, float(teeth), teeth, mate, teeth / mate)
    return None


def _is_mesh(lines: LineLevels, order: int, shaft_hz: float) -> bool:
    """Whether a harmonic of the shaft may be a mesh: strong, and with a second harmonic."""
    strong = lines.share(order * shaft_hz) > _MESH_SHARE
    return strong and all(_is_carrier(lines, k * order, shaft_hz) for k in (1, 2))


def _is_carrier(lines: LineLevels, order: int, shaft_hz: float) -> bool:
    """Whether a harmonic of the shaft stands out of the noise and above the harmonics beside it."""
    hz = order * shaft_hz
    if hz + 3.0 * shaft_hz > lines.top_hz or lines.level_db(hz) < _LINE_DB:
        return False
    beside = max(lines.power(hz + side * shaft_hz) for side in (-3, -2, -1, 1, 2, 3))
    return bool(lines.power(hz) > beside * 10.0 ** (0.1 * _CARRIER_DB))


def _mate(lines: LineLevels, teeth: int, shaft_hz: float) -> int | None:
    """Teeth of the gear whose turning makes pairs of sidebands about a mesh; None if no such pairs show."""
    scores = {
        mate: score
        for mate in range(_LEAST_MATE_TEETH, _MOST_TEETH + 1)
        if (score := _pairs(lines, teeth, mate, shaft_hz)) > 0.0
    }
    if not scores:
        return None
    best = max(scores, key=scores.__getitem__)
    # Every second pair of a slower gear is a faster one's, if all of them show it is the slower one.
    return max(mate for mate in scores if mate % best == 0)


def _pairs(lines: LineLevels, teeth: int, mate: int, shaft_hz: float) -> float:
    """How far pairs of sidebands stand out about a mesh and its second harmonic; 0 if too few do."""
    spacing, resolution = teeth / mate, lines.step_hz / shaft_hz
    # At whole orders they are the shaft's own; closer than this to a carrier they are its skirt.
    if abs(spacing - round(spacing)) < 4.0 * resolution or spacing < 6.0 * resolution:
        return 0.0
    levels = [
        min(lines.narrow_db((carrier * teeth + side * k * spacing) * shaft_hz) for side in (-1, 1))
        for carrier in (1, 2)
        for k in _SIDEBAND_ORDERS
        if abs(k * spacing - round(k * spacing)) > 3.0 * resolution
    ]
    if sum(level > _SIDEBAND_DB for level in levels) < _LEAST_PAIRS or levels[0] < _SIDEBAND_DB:
        return 0.0
    if mate < _LEAST_TEETH and levels[len(levels) // 2] < _SIDEBAND_DB:
        return 0.0
    return sum(max(level, 0.0) for level in levels)


def motor_lines(lines: LineLevels, shaft_hz: float, known: float) -> DriveLines | None:
    """The induction motor whose line at twice the mains stands out; None if there is none.

    Args:
        lines: of a signal's spectrum.
        shaft_hz: revolutions per second.
        known: how well, as a share: a line as near to an order may be the shaft's.
    """
    for line_hz in LINE_FREQUENCIES_HZ:
        peak_hz = _line_of_grid(lines, 2.0 * line_hz, shaft_hz, known, parts=(1,))
        if peak_hz is None:
            continue
        order = peak_hz / shaft_hz
        for pairs, slip_hz in slips(0.5 * peak_hz, shaft_hz):
            spacing = 2.0 * pairs * slip_hz / shaft_hz
            shows = spacing * shaft_hz > 3.0 * lines.step_hz and any(
                min(lines.level_db(carrier_hz + side * spacing * shaft_hz) for side in (-1, 1)) > _SIDEBAND_DB
                for carrier_hz in (shaft_hz, peak_hz)
            )
            return DriveLines("motor", peak_hz, order, spacing=spacing if shows else None, poles=2 * pairs)
        return DriveLines("motor", peak_hz, order)
    return None


def slips(line_hz: float, shaft_hz: float) -> Iterator[tuple[int, float]]:
    """Pole pairs of the induction motors that a shaft may be of, with their slip in revolutions per second.

    Args:
        line_hz: frequency of the mains.
        shaft_hz: revolutions per second.
    """
    for pairs in range(1, _MOST_POLE_PAIRS + 1):
        synchronous_hz = line_hz / pairs
        if 0.0 < synchronous_hz - shaft_hz < _MOST_SLIP * synchronous_hz:
            yield pairs, synchronous_hz - shaft_hz


def mains_line(lines: LineLevels, shaft_hz: float, known: float) -> float | None:
    """Frequency of the mains, if they stand out: cables pick them up; None if they do not.

    Args:
        lines: of a signal's spectrum.
        shaft_hz: revolutions per second.
        known: how well, as a share: a line as near to an order, a half or a third of one may be the shaft's.
    """
    found = (_line_of_grid(lines, hz, shaft_hz, known, parts=(1, 2, 3)) for hz in LINE_FREQUENCIES_HZ)
    return next((hz for hz in found if hz is not None), None)


def _line_of_grid(
    lines: LineLevels, grid_hz: float, shaft_hz: float, known: float, parts: tuple[int, ...]
) -> float | None:
    """Where a narrow line at a frequency of the grid is; None if there is none, or it may be the shaft's.

    Args:
        lines: of a signal's spectrum.
        grid_hz: where it is looked for.
        shaft_hz: revolutions per second.
        known: how well, as a share.
        parts: of the shaft's speed that have harmonics where the line may be one.
    """
    reach_hz = grid_hz * GRID_SHARE
    if lines.level_db(grid_hz, reach_hz) < _LINE_DB:
        return None
    peak_hz = lines.strongest_hz(grid_hz, reach_hz)
    if lines.narrow_db(peak_hz, skirt_share=0.5) < _LINE_DB:
        return None  # smeared, as slip smears a bearing's
    orders = (peak_hz / shaft_hz * part for part in parts)
    beside_hz = min(
        abs(order - round(order)) / part * shaft_hz for order, part in zip(orders, parts, strict=True)
    )
    if abs(peak_hz - grid_hz) > reach_hz or beside_hz < max(2.0 * lines.step_hz, known * peak_hz):
        return None  # a harmonic of the shaft, or of something else
    return peak_hz
