"""A line beside the shaft's harmonics that came with a change, and what the change is without it.

A revolution's synchronous vector cannot tell a line that is near a harmonic from that harmonic. Cables pick
up the mains, an induction motor pulls at twice their frequency, its poles pass a rotor bar and modulate 1X,
another machine shakes the ground. Any of these may beat with 1X, which looks like that of another unbalance
for a part of the beat. Many revolutions together show the line by itself, and the harmonics without it.

Lines of motors: Randall, Vibration-based Condition Monitoring (2nd ed. 2021), section 2.4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

import numpy as np
import scipy.fft

from daqsvc.dsp.drive_lines import GRID_SHARE, LINE_FREQUENCIES_HZ, slips
from daqsvc.rotor.synchronous.positions import REVOLUTIONS, LastPositions
from daqsvc.rotor.synchronous.vectors import HARMONICS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from daqsvc.rotor.synchronous.positions import Stretch

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

Mains: TypeAlias = Literal[0, 1, 2]
"""A line at the frequency of the mains, or at twice that; 0: at neither."""
LEAST_REVOLUTIONS = 64
EVERY = 16
"""Revolutions from one evaluation to the next, at least."""
_SETTLING = 8
"""Revolutions after a change in which the rotor is on its way."""
_HIGHEST = 7.0
"""Order up to which lines are looked for, but for those of the mains."""
_JUDGED = (1, 2, 3)
"""Harmonics that a rotor is judged by."""
_NEAR = 1.0 / 16.0
"""Orders from one of them within which a line beats so slowly that its revolutions are not alike."""
_BEATS = 2.0
"""Beats over which line and harmonic are told apart well."""
_DIVISORS = (2, 3, 4)
"""A rub leaves lines at these parts of the speed."""
_ABOUT_BINS = 40
_SKIRT_BINS = (4, 10)
_CORE_BINS = 2
_WINDOW_BINS = 1.5
"""Bins of noise that Hann's window lets through."""
APART_BINS = 2.5
"""Bins beside a harmonic where its own changes end up."""
_KNOWN_BINS = 3.0
"""The same, from which on a line stays known."""
_HALF = 0.5
"""Part of a line below which it has ended."""
_DEVIATIONS = 4.0
"""Of a stated speed, within which a line may be a harmonic."""
_LINE_DB = 15.0
"""A line of the mains, of which it is known where it would be ..."""
_ANY_LINE_DB = 20.0
"""... and one that is anywhere."""
_SHARP_DB = 6.0
_MIRROR_DB = 6.0
"""What modulates a harmonic leaves lines on either side of it."""
_NEW = 4.0
"""Power of a line over what was there before, from which on it came with the change."""
_FLAT = 0.8
"""Smaller over larger of both senses, from which on a motion is a line in the plane."""
_OIL_WHIRL = (0.35, 0.5)
"""Orders of a whirl of oil films."""
_MOST_OF_CLEARANCE = 0.5
"""No mains move a signal by more than this part of the clearance."""
_GRID_STEPS = 9
MOST_MULTIPLES = 6
"""Of the mains, that a hum has."""
_LEAST_OVER_NOISE = 30.0
"""Power of the mains over that of noise in the same line, from which on they are found in a beat."""
_ALL_OF_IT = 0.9
"""Part of all new motion that the mains must be where they are not resolved from a harmonic ..."""
_NOT_STEADY = 0.8
"""... and the part of theirs that a steady orbit may explain then: what grows evenly is steady by 3/4, and is
explained by a line by no more than that."""


@dataclass(frozen=True, slots=True)
class NonsynchronousLine:
    """A line that came with a change and is at no harmonic of the shaft.

    Attributes:
        frequency_hz: where it is.
        order: the same per revolution of the shaft.
        amplitude_um: square root of the mean square radius of its motion; of a round orbit the radius.
        forward: whether the shaft goes around with its rotation or against it; None: back and forth.
        mains: 1 if cables pick up the mains, 2 if it is twice the mains; 0 otherwise.
        modulates: harmonic that has such a line on either side; None if it is alone.
        poles: of the induction motor whose poles pass as often as the harmonic is modulated; None if unknown.
        share: of all that moves beside the harmonics and did not before, as mean squares.
    """

    frequency_hz: float
    order: float
    amplitude_um: float
    forward: bool | None
    mains: Mains = 0
    modulates: int | None = None
    poles: int | None = None
    share: float = 1.0

    def figures(self) -> dict[str, float]:
        """Its figures in a diagnosis; in Hz and um."""
        return {
            "line.frequency": self.frequency_hz,
            "line.order": self.order,
            "line.amplitude": self.amplitude_um,
        }

    @property
    def beats(self) -> bool:
        """Whether it is so near a judged harmonic that the revolutions differ for many in turn."""
        return _is_near(self.order)

    @property
    def is_foreign(self) -> bool:
        """Whether it is none of the rotor's: of the mains, or one that beats with a harmonic."""
        return self.mains > 0 or self.beats

    def describe(self, *, left_out: bool = False) -> str:
        """One sentence for a person.

        Args:
            left_out: whether it is said of positions that it is taken out of, and not of a change.
        """
        if self.modulates is not None:
            return self._modulation(self.modulates, left_out=left_out)
        line = f"a line of {self.amplitude_um:.3g} um at {self.frequency_hz:.2f} Hz ({self.order:.4g}X)"
        if self.mains == 2:
            what = "it is at twice the mains, as an induction motor pulls"
        elif self.mains:
            what = "these are the mains, as cables pick them up"
        else:
            sense = {True: "forward", False: "backward", None: "back and forth"}[self.forward]
            what = f"it goes {sense}, at no harmonic of the shaft"
            if any(_is_mains(self.frequency_hz, hz) for hz, _ in _mains()):
                what += "; the mains have this frequency, too"
        return f"{line} {'is left out' if left_out else 'came with the change'}: {what}"

    def _modulation(self, harmonic: int, *, left_out: bool) -> str:
        often_hz = abs(self.frequency_hz - harmonic * self.frequency_hz / self.order)
        sentence = (
            f"{harmonic}X is modulated at {often_hz:.2f} Hz{'' if left_out else ' since the change'}, by "
            f"lines of {self.amplitude_um:.3g} um on either side{', which are left out' if left_out else ''}"
        )
        if self.poles is not None:
            sentence += (
                f": as often as the poles of an induction motor of {self.poles} poles pass its rotor bars"
            )
        return sentence


class HealthyOrbit(NamedTuple):
    """What is known of the machine before a change.

    Attributes:
        baseline: complex128 ``[5]``, its synchronous vector, um.
        noise: variance of a complex sample that does not repeat with the shaft, um^2.
        clearance_um: radial; None if not known.
    """

    baseline: Complexes
    noise: float
    clearance_um: float | None

    @property
    def amplitude_um(self) -> float:
        """Modulus of the forward 1X vector."""
        return float(abs(self.baseline[1]))


class Found(NamedTuple):
    """What a search has found.

    Attributes:
        line: the line.
        harmonics: complex128 ``[5]``, synchronous vector without it, um; None where it does not beat with it,
            or nothing else has changed.
        revolutions: that show this.
    """

    line: NonsynchronousLine
    harmonics: Complexes | None
    revolutions: int

    @property
    def is_partial(self) -> bool:
        """Whether a part of a beat has shown it."""
        return self.line.beats and self.harmonics is None


class _Spectrum:
    """Power of what is left beside the harmonics, both senses together.

    Args:
        stretch: positions.
    """

    def __init__(self, stretch: Stretch) -> None:
        harmonics = stretch.harmonics
        window = np.hanning(len(stretch.z) + 1)[:-1] * stretch.there
        left = scipy.fft.fft((stretch.z - harmonics @ stretch.fit(harmonics)) * window)
        sides: Floats = np.abs(left) ** 2 / (_WINDOW_BINS * max(float(window.sum()) ** 2, 1.0))
        self.step_hz = stretch.rate_hz / len(stretch.z)
        count = len(sides) // 2
        self.power = sides[:count] + np.roll(sides[::-1], 1)[:count]

    def peak(self, low_hz: float, high_hz: float) -> int:
        """The strongest bin between two frequencies; 0 if there is none."""
        first, last = math.ceil(low_hz / self.step_hz), math.floor(high_hz / self.step_hz)
        first, last = max(first, 1), min(last, len(self.power) - 2)
        return first + int(np.argmax(self.power[first : last + 1])) if last >= first else 0

    def level_db(self, at: int) -> float:
        """How far a bin stands out of those around it."""
        begin, end = max(at - _ABOUT_BINS, 1), at + _ABOUT_BINS + 1
        noise = float(np.median(self.power[begin:end]))
        return 10.0 * math.log10(float(self.power[at]) / max(noise, 1e-300) + 1e-30)

    def is_sharp(self, at: int) -> bool:
        """Whether a bin is the top of a line that is as narrow as the revolutions allow."""
        near, far = _SKIRT_BINS
        if at < far + 1 or at + far + 1 > len(self.power):
            return False
        skirt = np.r_[self.power[at - far : at - near + 1], self.power[at + near : at + far + 1]]
        top = self.power[at - 1 : at + 2].argmax() == 1
        return bool(top and self.power[at] > 10.0 ** (0.1 * _SHARP_DB) * np.quantile(skirt, 0.75))

    def line(self, at: int) -> float:
        """Mean square of the line whose top is in a bin."""
        return float(self.power[max(at - _CORE_BINS, 1) : at + _CORE_BINS + 1].sum())

    def exact_hz(self, at: int) -> float:
        """Where a line is between the bins, by its neighbours."""
        low, middle, high = np.sqrt(self.power[at - 1 : at + 2])
        return float((at + 1.5 * (high - low) / (low + middle + high)) * self.step_hz)

    def largest_about(self, hz: float, reach_hz: float) -> float:
        """Mean square of the strongest line about a frequency."""
        at = self.peak(hz - reach_hz - self.step_hz, hz + reach_hz + self.step_hz)
        return self.line(at) if at else 0.0


class _Before(NamedTuple):
    """The machine before a change."""

    stretch: Stretch
    spectrum: _Spectrum


def _new_line(
    now: Stretch,
    before: _Before | None,
    healthy: HealthyOrbit,
    speed_uncertainty: float = 0.0,
    *,
    by_part_of_beat: bool = True,
) -> Found | None:
    """The line beside the harmonics that came with a change: that of the mains, or else the strongest.

    Args:
        now: the machine since the change.
        before: the machine before it; None if not known.
        healthy: its baseline.
        speed_uncertainty: relative standard deviation of the speed: a line as near to a harmonic may be it.
        by_part_of_beat: whether the mains may be found by less than a beat.
    """
    shaft_hz = float(now.revolutions * now.rate_hz / np.ptp(np.flatnonzero(now.there)))
    found = None
    if now.revolutions >= LEAST_REVOLUTIONS:
        found = _standing_out(now, before, shaft_hz, healthy)
    if found is None and by_part_of_beat:
        found = _mains_in_a_beat(now, before, shaft_hz, healthy)
    if found is None:
        return None
    order = found.line.order
    return found if abs(order - round(order)) > _DEVIATIONS * speed_uncertainty * order else None


def _standing_out(
    now: Stretch, before: _Before | None, shaft_hz: float, healthy: HealthyOrbit
) -> Found | None:
    """The line of the spectrum that is new and at no harmonic; None if there is none."""
    spectrum = _Spectrum(now)
    candidates = [(_strongest(spectrum, shaft_hz), _ANY_LINE_DB, 1.0)]
    for hz, _ in _mains():
        reach_hz = max(GRID_SHARE * hz, spectrum.step_hz)
        # The mains are among the strongest themselves where they are it.
        candidates.append((spectrum.peak(hz - reach_hz, hz + reach_hz), _LINE_DB, 2.0))
    best, at, modulates = 0.0, 0, None
    for peak, least_db, weight in candidates:
        if not peak or not _stands_out(spectrum, peak, shaft_hz, least_db):
            continue
        if not _is_new(spectrum, peak, before):
            continue
        mirrored = _mirrored(spectrum, peak, shaft_hz)
        harmonic = round(peak * spectrum.step_hz / shaft_hz)
        if mirrored and not _is_near(peak * spectrum.step_hz / shaft_hz):
            continue
        if weight * spectrum.line(peak) > best:
            best, at, modulates = weight * spectrum.line(peak), peak, harmonic if mirrored else None
    if not at:
        return None
    frequency_hz = spectrum.exact_hz(at)
    return _described(now, frequency_hz, shaft_hz, healthy, modulates)


def _described(
    now: Stretch, frequency_hz: float, shaft_hz: float, healthy: HealthyOrbit, modulates: int | None
) -> Found:
    """A line of this frequency, and the harmonics without it."""
    order = frequency_hz / shaft_hz
    near = _is_near(order)
    shown_rev = float(LEAST_REVOLUTIONS)
    if near:
        shown_rev = max(shown_rev, _BEATS / abs(order - round(order)))
    part = now.last(shown_rev)
    frequencies = [frequency_hz]
    if modulates is not None:
        frequencies.append(2.0 * modulates * shaft_hz - frequency_hz)
    seconds = np.arange(len(part.z)) / part.rate_hz
    going = [np.exp(2j * math.pi * sign * hz * seconds) for hz in frequencies for sign in (1.0, -1.0)]
    basis = np.column_stack((part.harmonics, *going))
    fit = part.fit(basis)
    harmonics, sides = fit[: len(HARMONICS)], np.abs(fit[-len(going) :])
    forward, backward = float(sides[0]), float(sides[1])
    amplitude_um = math.sqrt(float((sides**2).sum()))
    left = (part.z - basis @ fit)[part.there]
    others = max(float((np.abs(left) ** 2).mean()) - healthy.noise / part.averaged, 0.0)
    share = amplitude_um**2 / (amplitude_um**2 + others)
    line = NonsynchronousLine(frequency_hz, order, amplitude_um, _sense(forward, backward), share=share)
    if modulates is None:
        line = replace(line, mains=_mains_in(line, now.revolutions, healthy))
    else:
        often_hz = abs(frequency_hz - modulates * shaft_hz)
        line = replace(line, modulates=modulates, poles=_poles(often_hz, shaft_hz, now.revolutions))
    return Found(line, harmonics if near else None, round(part.revolutions))


def _sense(forward: float, backward: float) -> bool | None:
    """Whether a motion is forward; None where it goes back and forth."""
    return None if min(forward, backward) > _FLAT * max(forward, backward) else forward > backward


def _mains_in(line: NonsynchronousLine, revolutions: float, healthy: HealthyOrbit) -> Mains:
    """Whether a line is of the mains: it is where they are, and nothing of the rotor can be it."""
    mains: Mains = next((m for hz, m in _mains() if _is_mains(line.frequency_hz, hz)), 0)
    clearance_um, order = healthy.clearance_um, line.order
    if clearance_um is not None and line.amplitude_um > _MOST_OF_CLEARANCE * clearance_um:
        return 0
    # What a rub leaves at a part of the speed may be at the mains by chance.
    parts = (abs(order - round(order * n) / n) for n in _DIVISORS)
    if not _is_near(order) and any(part * revolutions < APART_BINS for part in parts):
        return 0
    if line.forward is None:
        return mains
    if not _is_near(order) and line.amplitude_um > healthy.amplitude_um:
        return 0  # a whirl by itself
    # Cables give all probes the same, so that the orbit is a line.
    return mains if mains != 1 and not _OIL_WHIRL[0] < order < _OIL_WHIRL[1] else 0


def _poles(often_hz: float, shaft_hz: float, revolutions: float) -> int | None:
    """Poles of an induction motor at this speed that pass its rotor bars so often; None if there is none."""
    resolution_hz = shaft_hz / max(revolutions, 1.0)
    for mains_hz in LINE_FREQUENCIES_HZ:
        # The poles pass at twice the slip of every pole pair; the slip is as exact as the mains.
        allowed_hz = 2.0 * GRID_SHARE * mains_hz + resolution_hz
        for pairs, slip_hz in slips(mains_hz, shaft_hz):
            if abs(often_hz - 2.0 * pairs * slip_hz) < allowed_hz:
                return 2 * pairs
    return None


def _mains() -> Iterator[tuple[float, Mains]]:
    """Frequencies where lines of the mains are."""
    for mains_hz in LINE_FREQUENCIES_HZ:
        yield mains_hz, 1
        yield 2.0 * mains_hz, 2


def is_multiple_of_mains(frequency_hz: float) -> bool:
    """Whether a frequency is three to six times the mains, as near as the grid allows: a tone of a hum."""
    for mains_hz in LINE_FREQUENCIES_HZ:
        times = round(frequency_hz / mains_hz)
        if 3 <= times <= MOST_MULTIPLES and _is_mains(frequency_hz, times * mains_hz):
            return True
    return False


def _is_mains(frequency_hz: float, mains_hz: float) -> bool:
    return abs(frequency_hz - mains_hz) < 1.5 * GRID_SHARE * mains_hz


def _is_near(order: float) -> bool:
    """Whether a line beats with a judged harmonic."""
    return round(order) in _JUDGED and abs(order - round(order)) < _NEAR


def _strongest(spectrum: _Spectrum, shaft_hz: float) -> int:
    """The strongest bin that is beside the harmonics."""
    orders = np.arange(len(spectrum.power)) * (spectrum.step_hz / shaft_hz)
    beside = np.abs(orders - np.round(orders)) * shaft_hz > APART_BINS * spectrum.step_hz
    return int(np.where(beside & (orders < _HIGHEST), spectrum.power, 0.0).argmax())


def _stands_out(spectrum: _Spectrum, at: int, shaft_hz: float, least_db: float) -> bool:
    """Whether a bin is a sharp line at no harmonic."""
    per_rev = shaft_hz / spectrum.step_hz
    apart = abs(at - round(at / per_rev) * per_rev)
    return apart >= APART_BINS and spectrum.level_db(at) >= least_db and spectrum.is_sharp(at)


def _mirrored(spectrum: _Spectrum, at: int, shaft_hz: float) -> bool:
    """Whether a harmonic has as strong a line on its other side."""
    per_rev = shaft_hz / spectrum.step_hz
    mirror = round(2.0 * round(at / per_rev) * per_rev - at)
    if not 1 <= mirror < len(spectrum.power) - 1:
        return False
    return bool(spectrum.line(mirror) > 10.0 ** (-0.1 * _MIRROR_DB) * spectrum.line(at))


def _is_new(spectrum: _Spectrum, at: int, before: _Before | None) -> bool:
    """Whether a line was not there before, or not nearly as strong."""
    if before is None:
        return True
    was = before.spectrum.largest_about(at * spectrum.step_hz, spectrum.step_hz)
    return bool(spectrum.line(at) > _NEW * was)


def _mains_in_a_beat(
    now: Stretch, before: _Before | None, shaft_hz: float, healthy: HealthyOrbit
) -> Found | None:
    """The mains beside a harmonic, before a spectrum tells them apart; None if it is not them.

    Their frequency is known. So a part of a beat is enough, if they are nearly all of the new motion and no
    steady orbit is.

    Args:
        now: the machine since the change.
        before: the machine before it; None if not known.
        shaft_hz: revolutions per second.
        healthy: the baseline.
    """
    off = now.off(healthy.baseline).z
    count = int(now.there.sum())
    noise = healthy.noise / now.averaged
    moves = max(float((np.abs(off) ** 2).sum()) / count - noise, 1e-12)
    best, best_hz = 0.0, 0.0
    mains: Mains = 0
    for hz, which in _mains():
        if not _is_near(hz / shaft_hz):
            continue
        for share in np.linspace(-GRID_SHARE, GRID_SHARE, _GRID_STEPS).tolist():
            square = float((np.abs(_sides(now, off, hz * (1.0 + share))) ** 2).sum())
            if square > best:
                best, best_hz, mains = square, hz * (1.0 + share), which
    steady = float((np.abs(now.harmonics.conj().T @ off / count) ** 2).sum())
    loud = best > _LEAST_OVER_NOISE * noise / count
    if not loud or best < _ALL_OF_IT * moves or steady > _NOT_STEADY * best:
        return None
    if before is None:
        was = healthy.noise
    else:
        off_before = before.stretch.off(healthy.baseline).z
        was = float((np.abs(_sides(before.stretch, off_before, best_hz)) ** 2).sum())
    forward, backward = (float(abs(each)) for each in _sides(now, off, best_hz))
    if best < _NEW * was or (mains == 1 and _sense(forward, backward) is not None):
        return None
    line = NonsynchronousLine(
        frequency_hz=best_hz,
        order=best_hz / shaft_hz,
        amplitude_um=math.sqrt(best),
        forward=_sense(forward, backward),
        mains=mains,
    )
    return Found(line, None, round(now.revolutions))


def _sides(stretch: Stretch, off: Complexes, hz: float) -> Complexes:
    """Amplitude of a motion at one frequency, complex128 ``[2]``: forward and backward, um."""
    going = np.exp(2j * math.pi * hz * np.arange(len(off)) / stretch.rate_hz)
    count = int(stretch.there.sum())
    return np.array([np.vdot(going, off) / count, np.vdot(going.conj(), off) / count])


class NonsynchronousSearch:
    """Looks for such lines while a rotor is watched.

    Args:
        rate_hz: sampling rate.
        speed_uncertainty: relative standard deviation of a stated speed that replaces a keyphasor.
        by_part_of_beat: whether the mains may be found by less than a beat, as all that is new.
    """

    def __init__(
        self, rate_hz: float, speed_uncertainty: float = 0.0, *, by_part_of_beat: bool = True
    ) -> None:
        self._speed_uncertainty, self._by_part_of_beat = speed_uncertainty, by_part_of_beat
        self._positions = LastPositions(rate_hz)
        self._before: _Before | None = None
        self._since: int | None = None
        self._next = 0
        self._found: Found | None = None
        self._shown_rev = 0.0
        self._most_um = 0.0

    def add(self, revolution: int, first_index: int, turns: Floats, z: Complexes) -> None:
        """Keep a revolution; see `LastPositions.add`."""
        self._positions.add(revolution, first_index, turns, z)

    def last(self, revolutions: float) -> Stretch | None:
        """The last revolutions, or as many of them as there are; None if too much is missing."""
        end = self._positions.end
        return self._positions.stretch(end - math.ceil(revolutions), end)

    def begin(self, revolution: int) -> None:
        """Look for all lines from a revolution on, however long they have been there."""
        self._before, self._since, self._found = None, revolution, None
        self._next = revolution + _SETTLING + EVERY

    def forget(self) -> None:
        """Keep nothing of what was, as after a gap whose length is a guess."""
        self._positions.forget()
        self._since, self._found, self._most_um = None, None, 0.0

    def depart(self, onset: int) -> None:
        """The machine was healthy before a revolution, and is not any more."""
        if self._since is not None and onset - self._since < REVOLUTIONS:
            return  # a beat seems to end and to begin again
        before = self._positions.stretch(onset - REVOLUTIONS, onset)
        enough = before is not None and before.revolutions >= LEAST_REVOLUTIONS / 4
        self._before = _Before(before, _Spectrum(before)) if before is not None and enough else None
        self._since, self._found = onset, None
        self._next = onset + _SETTLING + EVERY

    def evaluate(self, revolution: int, healthy: HealthyOrbit) -> Found | None:
        """The line that came with the change, by all revolutions up to now, or nearly all.

        Args:
            revolution: the last one.
            healthy: the machine before.
        """
        if self._since is None or revolution < self._next:
            return self._found
        self._next = revolution + EVERY
        begin = max(self._since + _SETTLING, revolution - REVOLUTIONS)
        now = self._positions.stretch(begin, revolution + 1)
        was = self._found
        if was is not None and not was.is_partial:
            if now is None or now.revolutions < self._shown_rev:
                return was  # after a gap there are too few
            self._found = self._followed(was.line, now.last(self._shown_rev), healthy)
        else:
            self._found = None if now is None else self._new_line(now, healthy)
            if now is not None and self._found is not None:
                self._shown_rev = min(_shown_by(now, self._found.line), REVOLUTIONS - 2.0 * EVERY)
        if self._found is not None:
            self._most_um = max(self._most_um, self._found.line.amplitude_um)
        elif was is not None:
            self._since, self._most_um = revolution - EVERY, 0.0
        return self._found

    def _followed(self, line: NonsynchronousLine, now: Stretch, healthy: HealthyOrbit) -> Found | None:
        """A line that is known, by the last revolutions; None if it has ended."""
        found = self._new_line(now, healthy)
        if found is None or not _is_same(found.line, line):
            found = _fitted_again(now, line, healthy)
        return found if found.line.amplitude_um >= _HALF * self._most_um else None

    def _new_line(self, now: Stretch, healthy: HealthyOrbit) -> Found | None:
        return _new_line(
            now,
            self._before,
            healthy,
            self._speed_uncertainty,
            by_part_of_beat=self._by_part_of_beat,
        )


def _shown_by(now: Stretch, line: NonsynchronousLine) -> float:
    """Revolutions that show whether a line is still there."""
    least = max(now.revolutions, 2.0 * LEAST_REVOLUTIONS)
    apart = abs(line.order - round(line.order))
    return max(least, _KNOWN_BINS / apart) if line.beats else least


def _is_same(now: NonsynchronousLine, then: NonsynchronousLine) -> bool:
    """Whether two lines are one, some revolutions later; more of them may show that it is the mains."""
    alike = now.modulates == then.modulates and then.mains in {0, now.mains}
    return alike and abs(now.order - then.order) < _NEAR


def _fitted_again(now: Stretch, line: NonsynchronousLine, healthy: HealthyOrbit) -> Found:
    """A line that was known, as a fault beside it may hide it in the spectrum."""
    shaft_hz = line.frequency_hz / line.order
    fitted = _described(now, line.frequency_hz, shaft_hz, healthy, line.modulates)
    return fitted._replace(line=replace(fitted.line, mains=line.mains, poles=line.poles))
