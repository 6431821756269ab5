"""The speed of a shaft by the lines of its harmonics, near a nominal one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import scipy.fft

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]

ORDERS = (1, 2, 3)
"""Multiples of the shaft's frequency that are measured."""

SPEED_SEARCH = 0.03
"""The speed is searched within this part of the nominal one."""

_LINE_NATS = 12.0
"""Evidence for a line that is no chance at any of some hundred places; plus two for each channel."""
_POINTS_PER_LINE = 16
_OTHER_LEAST, _OTHER_MOST = 0.55, 2.5
"""Part of the nominal speed within which the lines of another one are noticed."""
_NEXT = 0.12
"""Part of the nominal speed within which a line just outside of the search is looked for."""
_OTHER_POWER = 9.0
"""Velocity power of another line over that of the nominal 1X to 3X, from which on it is the shaft's."""


class OtherSpeedError(ValueError):
    """The harmonics of another speed are far stronger.

    Args:
        harmonics_hz: revolutions per second by the harmonics.
        nominal_hz: as stated.
    """

    def __init__(self, harmonics_hz: float, nominal_hz: float) -> None:
        super().__init__(
            f"the shaft turns at about {60.0 * harmonics_hz:.0f} rpm by its harmonics, not at "
            f"{60.0 * nominal_hz:g} rpm (+-{SPEED_SEARCH:.0%}): correct the speed"
        )
        self.harmonics_hz = harmonics_hz


@dataclass(frozen=True, slots=True)
class LineSpeed:
    """A speed found.

    Attributes:
        hz: revolutions per second.
        deviation_hz: its standard deviation.
        seen: whether a line stands out of the noise; otherwise ``hz`` is the best guess in the search.
    """

    hz: float
    deviation_hz: float
    seen: bool


def find_speed(centred: Floats, rate_hz: float, nominal_hz: float) -> LineSpeed:
    """The speed by the lines of 1X, 2X and 3X, within 3 % of a nominal one.

    The periodogram at h f over the noise density beside it, summed over the channels, is the log likelihood
    of a line there. The strongest line near the nominal 1X is taken first; 2X and 3X refine it where they
    stand out within one resolution of its multiples. Farther off they are lines of something else (belt,
    mains, gears), however strong. Without a line of 1X, the strongest sum of all orders decides.

    Args:
        centred: float64 ``[n, channels]`` without mean, zero where missing.
        rate_hz: samples per second.
        nominal_hz: nominal revolutions per second.

    Raises:
        OtherSpeedError: the harmonics of another speed are far stronger.
    """
    spectrum = _Spectrum.of(centred, rate_hz, nominal_hz)
    _refuse_other_speed(spectrum, nominal_hz)
    hz = np.arange(
        (1.0 - SPEED_SEARCH) * nominal_hz, (1.0 + SPEED_SEARCH) * nominal_hz, spectrum.step_hz / 3.0
    )
    nats = np.stack([spectrum.nats(order * hz, order * nominal_hz) for order in ORDERS])
    first = int(np.argmax(nats[0]))
    if nats[0, first] < spectrum.line_nats:
        first = int(np.argmax(nats.sum(axis=0)))
    estimates: list[tuple[float, float]] = []
    for row, order in enumerate(ORDERS):
        around, deviation = _mean_of(estimates) if estimates else (float(hz[first]), 0.0)
        reach = max(0.5 * spectrum.resolution_hz / order, 3.0 * deviation)
        part = np.flatnonzero(np.abs(hz - around) <= reach)
        best = int(part[np.argmax(nats[row, part])])
        if part[0] < best < part[-1] and nats[row, best] > spectrum.line_nats:
            estimates.append(_vertex(hz, nats[row], best, 0.2 * spectrum.resolution_hz / order))
    if not estimates:
        if np.argmax(nats[0]) in {0, len(hz) - 1}:
            _refuse_next_speed(spectrum, nominal_hz)
        return LineSpeed(float(hz[first]), SPEED_SEARCH * nominal_hz / math.sqrt(3.0), seen=False)
    return LineSpeed(*_mean_of(estimates), seen=True)


@dataclass(frozen=True, slots=True)
class _Spectrum:
    """Periodogram of the lowest frequencies.

    Attributes:
        power: float64 ``[bins, channels]``.
        step_hz: between two bins.
        resolution_hz: between two lines that can be told apart.
        nominal_hz: nominal revolutions per second.
    """

    power: Floats
    step_hz: float
    resolution_hz: float
    nominal_hz: float

    @classmethod
    def of(cls, centred: Floats, rate_hz: float, nominal_hz: float) -> _Spectrum:
        resolution = rate_hz / len(centred)
        # Only the lowest lines matter: as a slower series they are found in a hundredth of the time.
        highest = int(ORDERS[-1] * (_OTHER_MOST + 0.5) * nominal_hz / resolution) + 16
        spectrum = scipy.fft.rfft(centred, axis=0)[:highest]
        slow = scipy.fft.irfft(spectrum, scipy.fft.next_fast_len(2 * len(spectrum), real=True), axis=0)
        # A Hann window keeps strong lines elsewhere out; it widens a line by half.
        window = np.hanning(len(slow))[:, np.newaxis]
        lines = scipy.fft.rfft(slow * window, len(slow) * _POINTS_PER_LINE, axis=0)
        power = lines.real**2 + lines.imag**2
        return cls(power, resolution / _POINTS_PER_LINE, resolution, nominal_hz)

    @property
    def line_nats(self) -> float:
        """Evidence for a line that is no chance."""
        return _LINE_NATS + 2.0 * float(self.power.shape[1])

    def nats(self, hz: Floats, beside_hz: float) -> Floats:
        """Evidence for lines, summed over the channels, against the noise about a frequency."""
        reach = max(0.25 * self.nominal_hz, 12.0 * self.resolution_hz)
        low, high = (round((beside_hz + side * reach) / self.step_hz) for side in (-1.0, 1.0))
        # Exponential variables: their median is ln 2 of their mean, and lines do not touch it.
        noise = np.median(self.power[max(low, 0) : high + 1], axis=0) / math.log(2.0)
        noise = np.maximum(noise, 1e-12 * self.power.max(axis=0) + np.finfo(np.float64).tiny)
        place = np.minimum(hz / self.step_hz, len(self.power) - 1.0)
        below = np.minimum(place.astype(np.int64), len(self.power) - 2)
        share = (place - below)[:, np.newaxis]
        power = (1.0 - share) * self.power[below] + share * self.power[below + 1]
        nats: Floats = (power / noise).sum(axis=1)
        return nats


def _refuse_other_speed(spectrum: _Spectrum, nominal_hz: float) -> None:
    """Refuse a nominal speed if the lines of another one are far stronger, 2X and 3X with 1X."""
    hz = np.arange(len(spectrum.power)) * spectrum.step_hz
    velocity = spectrum.power.sum(axis=1) / np.maximum(hz, spectrum.step_hz) ** 2
    skirt = 2.0 * spectrum.resolution_hz
    halves = np.round(2.0 * hz / nominal_hz) / 2.0
    # Lines at multiples of half the speed are the shaft's own.
    own = np.abs(hz - halves * nominal_hz) <= SPEED_SEARCH * hz + skirt
    at_orders = own & (halves >= 1.0) & (halves <= ORDERS[-1]) & (halves == np.round(halves))
    other = ~own & (hz > _OTHER_LEAST * nominal_hz) & (hz < _OTHER_MOST * nominal_hz)
    if not other.any() or not at_orders.any():
        return
    line = int(np.flatnonzero(other)[np.argmax(velocity[other])])
    if velocity[line] < _OTHER_POWER * velocity[at_orders].max():
        return
    line_hz = float(hz[line])
    for order in ORDERS:
        near = order * line_hz + np.linspace(-1.0, 1.0, 33) * spectrum.resolution_hz
        if spectrum.nats(near, order * line_hz).max() < spectrum.line_nats:
            return
    raise OtherSpeedError(line_hz, nominal_hz)


def _refuse_next_speed(spectrum: _Spectrum, nominal_hz: float) -> None:
    """Refuse a nominal speed if the skirt seen at the end of the search is that of a 1X outside."""
    hz = np.arange((1.0 - _NEXT) * nominal_hz, (1.0 + _NEXT) * nominal_hz, spectrum.step_hz / 3.0)
    nats = np.stack([spectrum.nats(order * hz, order * nominal_hz) for order in ORDERS])
    together = (nats > spectrum.line_nats).all(axis=0)
    if together.any():
        raise OtherSpeedError(float(hz[np.argmax(np.where(together, nats[0], 0.0))]), nominal_hz)


def _vertex(grid: Floats, nats: Floats, best: int, reach_hz: float) -> tuple[float, float]:
    """Vertex of a parabola through a peak of the log likelihood, and the deviation by its curvature."""
    reach = max(1, int(reach_hz / (grid[1] - grid[0])))
    part = slice(max(best - reach, 0), best + reach + 1)
    bend, slope, _ = np.polyfit(grid[part] - grid[best], nats[part], 2)
    if bend >= 0.0:
        return float(grid[best]), reach_hz
    shift = float(np.clip(-slope / (2.0 * bend), -reach_hz, reach_hz))
    return float(grid[best]) + shift, float(1.0 / np.sqrt(-2.0 * bend))


def _mean_of(estimates: list[tuple[float, float]]) -> tuple[float, float]:
    """Weighted mean and its deviation, which grows (Birge) where the estimates contradict each other."""
    values, deviations = np.array(estimates).T
    weights = deviations**-2.0
    mean = float((weights * values).sum() / weights.sum())
    excess = float((weights * (values - mean) ** 2).sum() / max(len(values) - 1, 1))
    return mean, float(np.sqrt(max(excess, 1.0) / weights.sum()))
