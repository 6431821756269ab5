"""A line beside the shaft's harmonics that came with a change: where it is, and whether it is the mains'.

A revolution's synchronous vector cannot tell a line that is near a harmonic from that harmonic. Cables pick
up the mains, and an induction motor pulls at twice their frequency. Either may beat with 1X or 2X: for a
part of the beat 1X looks like that of another unbalance. Many revolutions together show the line by itself.

A line at twice the mains: Randall, Vibration-based Condition Monitoring (2nd ed. 2021), section 2.4.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
import scipy.fft

from daqsvc.rotor.synchronous.vectors import HARMONICS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from daqsvc.rotor.synchronous.baseline import Calibration

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

Mains: TypeAlias = Literal[0, 1, 2]
"""A line at the frequency of the mains, or at twice that; 0: at neither."""
REVOLUTIONS = 512
"""Revolutions that are kept: a line 1 % beside a harmonic is five bins away from it then."""
LEAST_REVOLUTIONS = 64
_SETTLING = 8
"""Revolutions after a change in which the rotor is on its way."""
_EVERY = 16
"""Revolutions from one evaluation to the next, at least."""
_POINTS_PER_REV = 32
_HIGHEST = 6
"""Harmonics that are taken out; lines are looked for up to this order, and that of twice the mains."""
_MOST_MISSING = 0.2
_MAINS_HZ = (50.0, 60.0)
_GRID_SHARE = 0.002
"""How far a grid's frequency may be off."""
_ABOUT_BINS = 40
_SKIRT_BINS = (4, 10)
_CORE_BINS = 2
_WINDOW_BINS = 1.5
"""Bins of noise that Hann's window lets through."""
_APART_BINS = 2.5
"""Bins beside a harmonic where its own changes end up."""
_DEVIATIONS = 4.0
_LINE_DB = 15.0
"""A line of the mains, of which it is known where it would be ..."""
_ANY_LINE_DB = 20.0
"""... and one that is anywhere."""
_SHARP_DB = 6.0
_MIRROR_DB = 6.0
"""What modulates a harmonic leaves lines on either side of it, as a speed that hunts does."""
_NEW = 4.0
"""Power of a line over what was there before, from which on it came with the change."""
_GRID_STEPS = 9
_LEAST_OVER_NOISE = 30.0
_ALL_OF_IT = 0.9
"""Part of all new motion that the mains must be where they are not resolved from a harmonic ..."""
_NOT_STEADY = 0.8
"""... and the part of theirs that a steady orbit may explain then: what grows evenly is steady by 3/4, and is
explained by a line by no more than that."""
_EXPLAINED = 0.5
"""Part of all new motion that a line must be to be what has changed."""


@dataclass(frozen=True, slots=True)
class NonsynchronousLine:
    """A line that came with a change and is at no harmonic of the shaft.

    Attributes:
        frequency_hz: where it is.
        order: the same per revolution of the shaft.
        amplitude_um: square root of the mean square radius of its motion; of a round orbit the radius.
        forward: whether the shaft goes around more with its rotation than against it.
        mains: 1 at the frequency of the mains, 2 at twice that; 0 elsewhere.
        share: of all that moves otherwise than before, as mean squares.
    """

    frequency_hz: float
    order: float
    amplitude_um: float
    forward: bool
    mains: Mains
    share: float

    @property
    def is_the_change(self) -> bool:
        """Whether the mains are all that has changed."""
        return self.mains > 0 and self.share > _EXPLAINED

    def describe(self) -> str:
        """One sentence for a person."""
        sense = "forward" if self.forward else "backward"
        line = f"a line of {self.amplitude_um:.3g} um at {self.frequency_hz:.2f} Hz"
        if self.mains == 2:
            what = "twice the mains, as an induction motor pulls"
        elif self.mains:
            what = "the mains, as cables pick them up"
        else:
            what = f"{sense}, at no harmonic of the shaft"
        return f"{line} ({self.order:.4g}X) came with the change: {what}"


@dataclass(frozen=True, slots=True)
class Stretch:
    """Positions of the shaft over some revolutions, at even times.

    Attributes:
        z: complex128 ``[n]``, um; 0 where missing.
        turns: float64 ``[n]``, shaft angle in revolutions.
        there: bool ``[n]``.
        rate_hz: of the positions.
        averaged: samples in each.
    """

    z: Complexes
    turns: Floats
    there: NDArray[np.bool_]
    rate_hz: float
    averaged: int

    @property
    def revolutions(self) -> float:
        """How far the shaft turned."""
        known = self.turns[self.there]
        return float(known[-1] - known[0]) if len(known) else 0.0


@dataclass(frozen=True, slots=True)
class _Kept:
    """Positions of one revolution: ``z`` is NaN where missing."""

    revolution: int
    first: int
    z: NDArray[np.complex64]
    turns: Floats


class LastPositions:
    """The shaft's positions in the last revolutions, some 32 in each.

    Args:
        rate_hz: sampling rate.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._averaged = 0
        self._kept: deque[_Kept] = deque(maxlen=REVOLUTIONS)
        self._next = -1
        self._rest_z: Complexes = np.empty(0, dtype=np.complex128)
        self._rest_turns: Floats = np.empty(0)

    def add(self, revolution: int, first_index: int, turns: Floats, z: Complexes) -> None:
        """Keep a revolution.

        Args:
            revolution: its number.
            first_index: of its first sample.
            turns: float64 ``[n]``, shaft angle in revolutions from its beginning.
            z: complex128 ``[n]``, um; NaN where missing.
        """
        if not self._averaged:
            self._averaged = max(1, len(z) // _POINTS_PER_REV)
        if first_index != self._next:
            self._rest_z, self._rest_turns = self._rest_z[:0], self._rest_turns[:0]
        self._next = first_index + len(z)
        first = first_index - len(self._rest_z)
        z = np.concatenate((self._rest_z, z))
        turns = np.concatenate((self._rest_turns, revolution + turns))
        # Positions lie on one grid, over gaps as well.
        skip = -first % self._averaged
        whole = max(0, len(z) - skip) // self._averaged * self._averaged
        self._rest_z, self._rest_turns = z[skip + whole :], turns[skip + whole :]
        if not whole:
            return
        means = z[skip : skip + whole].reshape(-1, self._averaged).mean(axis=1)
        at = turns[skip : skip + whole].reshape(-1, self._averaged).mean(axis=1)
        first = (first + skip) // self._averaged
        self._kept.append(_Kept(revolution, first, means.astype(np.complex64), at))

    def stretch(self, begin: int, end: int) -> Stretch | None:
        """The revolutions from one up to before another; None if too much is missing."""
        kept = [one for one in self._kept if begin <= one.revolution < end]
        if not kept:
            return None
        first = kept[0].first
        z = np.full(kept[-1].first + len(kept[-1].z) - first, np.nan, dtype=np.complex128)
        turns = np.zeros(len(z))
        for one in kept:
            part = slice(one.first - first, one.first - first + len(one.z))
            z[part], turns[part] = one.z, one.turns
        there = np.isfinite(z)
        if there.mean() < 1.0 - _MOST_MISSING:
            return None
        z[~there] = 0.0
        return Stretch(z, turns, there, self._rate_hz / self._averaged, self._averaged)


class _Spectrum:
    """Power of what is left beside the harmonics, both senses together.

    Args:
        stretch: positions.
    """

    def __init__(self, stretch: Stretch) -> None:
        turning = np.exp(2j * math.pi * stretch.turns)
        orders = range(-_HIGHEST, _HIGHEST + 1)
        basis = np.stack([turning**k for k in orders], axis=1) * stretch.there[:, np.newaxis]
        fit = np.linalg.solve(basis.conj().T @ basis, basis.conj().T @ stretch.z)
        window = np.hanning(len(stretch.z) + 1)[:-1] * stretch.there
        sides = scipy.fft.fft((stretch.z - basis @ fit) * window)
        sides = np.abs(sides) ** 2 / (_WINDOW_BINS * max(float(window.sum()) ** 2, 1.0))
        self.step_hz = stretch.rate_hz / len(stretch.z)
        count = len(sides) // 2
        self.forward, self.backward = sides[:count], np.roll(sides[::-1], 1)[:count]
        self.power = self.forward + self.backward

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

    def line(self, at: int, power: Floats | None = None) -> float:
        """Mean square of the line whose top is in a bin."""
        power = self.power if power is None else power
        return float(power[max(at - _CORE_BINS, 1) : at + _CORE_BINS + 1].sum())

    def exact_hz(self, at: int) -> float:
        """Where a line is between the bins, by its neighbours."""
        low, middle, high = np.sqrt(self.power[at - 1 : at + 2])
        return float((at + 1.5 * (high - low) / (low + middle + high)) * self.step_hz)

    def largest_about(self, hz: float, reach_hz: float) -> float:
        """Mean square of the strongest line about a frequency."""
        at = self.peak(hz - reach_hz - self.step_hz, hz + reach_hz + self.step_hz)
        return self.line(at) if at else 0.0


def new_line(
    now: Stretch, before: Stretch | None, healthy: Calibration, speed_uncertainty: float = 0.0
) -> NonsynchronousLine | None:
    """The line beside the harmonics that came with a change: that of the mains, or else the strongest.

    Args:
        now: the machine since the change.
        before: the machine before it; None if not known.
        healthy: its baseline.
        speed_uncertainty: relative standard deviation of the speed: a line as near to a harmonic may be it.
    """
    found = _new_line(now, before, healthy)
    if found is None:
        return None
    apart = abs(found.order - round(found.order))
    return found if apart > _DEVIATIONS * speed_uncertainty * found.order else None


def _new_line(now: Stretch, before: Stretch | None, healthy: Calibration) -> NonsynchronousLine | None:
    shaft_hz = now.revolutions * now.rate_hz / float(np.ptp(np.flatnonzero(now.there)))
    motion = _Motion(now, healthy)
    if now.revolutions >= LEAST_REVOLUTIONS:
        earlier = None if before is None or before.revolutions < LEAST_REVOLUTIONS / 4 else _Spectrum(before)
        found = _standing_out(_Spectrum(now), earlier, shaft_hz, motion)
        if found is not None:
            return found
    return motion.of_mains(shaft_hz)


def _standing_out(
    spectrum: _Spectrum, earlier: _Spectrum | None, shaft_hz: float, motion: _Motion
) -> NonsynchronousLine | None:
    """The line of a spectrum that stands alone and is new; None if there is none."""
    candidates: list[tuple[int, Mains, float]] = [(_strongest(spectrum, shaft_hz), 0, _ANY_LINE_DB)]
    for hz, mains in _mains():
        reach_hz = max(_GRID_SHARE * hz, spectrum.step_hz)
        candidates.append((spectrum.peak(hz - reach_hz, hz + reach_hz), mains, _LINE_DB))
    found = [
        (spectrum.line(at), at, mains)
        for at, mains, least_db in candidates
        if at and _stands_alone(spectrum, at, shaft_hz, least_db) and _is_new(spectrum, at, earlier)
    ]
    if not found:
        return None
    # The mains are among the strongest themselves where they are it.
    square, at, mains = max(found, key=lambda one: one[0] * (2.0 if one[2] else 1.0))
    frequency_hz = spectrum.exact_hz(at)
    return NonsynchronousLine(
        frequency_hz=frequency_hz,
        order=frequency_hz / shaft_hz,
        amplitude_um=math.sqrt(square),
        forward=spectrum.line(at, spectrum.forward) >= spectrum.line(at, spectrum.backward),
        mains=mains,
        share=min(1.0, square / motion.square),
    )


def _mains() -> Iterator[tuple[float, Mains]]:
    """Frequencies where lines of the mains are."""
    for mains_hz in _MAINS_HZ:
        yield mains_hz, 1
        yield 2.0 * mains_hz, 2


def _strongest(spectrum: _Spectrum, shaft_hz: float) -> int:
    """The strongest bin that is beside the harmonics."""
    bins = np.arange(len(spectrum.power))
    orders = bins * (spectrum.step_hz / shaft_hz)
    beside = np.abs(orders - np.round(orders)) * shaft_hz > _APART_BINS * spectrum.step_hz
    power = np.where(beside & (orders < _HIGHEST + 1.0), spectrum.power, 0.0)
    return int(power.argmax())


def _stands_alone(spectrum: _Spectrum, at: int, shaft_hz: float, least_db: float) -> bool:
    """Whether a bin is a line by itself: sharp, at no harmonic, and none of a pair about one."""
    per_rev = shaft_hz / spectrum.step_hz
    nearest = round(at / per_rev) * per_rev
    if abs(at - nearest) < _APART_BINS or spectrum.level_db(at) < least_db or not spectrum.is_sharp(at):
        return False
    mirrored = round(2.0 * nearest - at)
    if not 1 <= mirrored < len(spectrum.power) - 1:
        return True
    return bool(spectrum.line(mirrored) < 10.0 ** (-0.1 * _MIRROR_DB) * spectrum.line(at))


def _is_new(spectrum: _Spectrum, at: int, earlier: _Spectrum | None) -> bool:
    """Whether a line was not there before, or not nearly as strong."""
    if earlier is None:
        return True
    before = earlier.largest_about(at * spectrum.step_hz, spectrum.step_hz)
    return bool(spectrum.line(at) > _NEW * before)


class _Motion:
    """How a shaft moves otherwise than it did when it was healthy.

    Args:
        now: its positions.
        healthy: its baseline.
    """

    def __init__(self, now: Stretch, healthy: Calibration) -> None:
        turning = np.exp(2j * math.pi * now.turns)
        orbit = np.stack([turning**k for k in HARMONICS], axis=1) @ healthy.baseline
        self._off = np.where(now.there, now.z - orbit, 0.0)
        self._turning, self._rate_hz = turning, now.rate_hz
        self._count = int(now.there.sum())
        self._noise = healthy.noise / now.averaged
        square = float((np.abs(self._off) ** 2).sum()) / self._count - self._noise
        self.square = max(square, 1e-12)
        """Mean square of the positions off the healthy orbit, without the healthy noise, um^2."""

    def of_mains(self, shaft_hz: float) -> NonsynchronousLine | None:
        """The mains, if they are nearly all of the motion and no steady orbit is; None if not.

        A part of a beat tells them from 1X, as their frequency is known.

        Args:
            shaft_hz: revolutions per second.
        """
        seconds = np.arange(len(self._off)) / self._rate_hz
        best = (0.0, 0.0, 0j, 0j)
        at: Mains = 1
        for hz, mains in _mains():
            if hz > 0.4 * self._rate_hz:
                continue
            for share in np.linspace(-_GRID_SHARE, _GRID_SHARE, _GRID_STEPS):
                going = np.exp(2j * math.pi * hz * (1.0 + share) * seconds)
                forward = complex(np.vdot(going, self._off)) / self._count
                backward = complex(np.vdot(going.conj(), self._off)) / self._count
                square = abs(forward) ** 2 + abs(backward) ** 2
                if square > best[0]:
                    best, at = (square, hz * (1.0 + share), forward, backward), mains
        square, hz, forward, backward = best
        loud = square > _LEAST_OVER_NOISE * self._noise / self._count
        if not loud or square < _ALL_OF_IT * self.square or self._steady() > _NOT_STEADY * square:
            return None
        return NonsynchronousLine(
            frequency_hz=hz,
            order=hz / shaft_hz,
            amplitude_um=math.sqrt(square),
            forward=abs(forward) >= abs(backward),
            mains=at,
            share=min(1.0, square / self.square),
        )

    def _steady(self) -> float:
        """What harmonics of the shaft that do not change explain of the motion, um^2."""
        return sum(
            abs(complex(np.vdot(self._turning**k, self._off)) / self._count) ** 2
            for k in range(-_HIGHEST, _HIGHEST + 1)
        )


class NonsynchronousSearch:
    """Looks for such lines while a rotor is watched.

    Args:
        rate_hz: sampling rate.
        speed_uncertainty: relative standard deviation of a stated speed that replaces a keyphasor.
    """

    def __init__(self, rate_hz: float, speed_uncertainty: float = 0.0) -> None:
        self._speed_uncertainty = speed_uncertainty
        self._positions = LastPositions(rate_hz)
        self._before: Stretch | None = None
        self._since: int | None = None
        self._next = 0
        self._line: NonsynchronousLine | None = None

    def add(self, revolution: int, first_index: int, turns: Floats, z: Complexes) -> None:
        """Keep a revolution; see `LastPositions.add`."""
        self._positions.add(revolution, first_index, turns, z)

    @property
    def line(self) -> NonsynchronousLine | None:
        """What was found last."""
        return self._line

    def depart(self, onset: int) -> None:
        """The machine was healthy before a revolution, and is not any more."""
        self._before = self._positions.stretch(onset - REVOLUTIONS, onset)
        self._since, self._line = onset, None
        self._next = onset + _SETTLING + _EVERY

    def evaluate(self, revolution: int, healthy: Calibration) -> NonsynchronousLine | None:
        """The line that came with the change, by all revolutions up to now, or nearly all.

        Args:
            revolution: the last one.
            healthy: the machine before.
        """
        if self._since is None or revolution < self._next:
            return self._line
        begin = max(self._since + _SETTLING, revolution - REVOLUTIONS)
        now = self._positions.stretch(begin, revolution + 1)
        self._line = None if now is None else new_line(now, self._before, healthy, self._speed_uncertainty)
        self._next = revolution + _EVERY
        return self._line
