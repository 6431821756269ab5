"""Takes a line that is none of the rotor's out of the positions that its observers see.

The observers of a bank know motions of a rotor and noise. Mains that cables pick up are neither. The observer
that allows for most, that of a rub, follows them best. A line that is known is taken out before.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.rotor.synchronous.nonsynchronous import (
    APART_BINS,
    MOST_MULTIPLES,
    NonsynchronousSearch,
    is_multiple_of_mains,
)
from daqsvc.rotor.synchronous.positions import REVOLUTIONS, turning
from daqsvc.rotor.synchronous.vectors import HARMONICS

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from daqsvc.rotor.synchronous.nonsynchronous import Found, HealthyOrbit, NonsynchronousLine
    from daqsvc.rotor.synchronous.positions import Stretch

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

_MOST_LINES = 3
_SETTLED_REV = 8
"""Revolutions after which the observers have settled without a line."""
_FORGIVEN = 1.0 / 16.0
"""Of a revolution in which it was not healthy, by one in which it is."""
_FITTED_EVERY = 4
"""Revolutions after which a line is fitted again: the mains wander."""
_FITTED_REV, _ENOUGH = 64.0, 0.9
_BEATS = 2.0
"""Beats with the nearest harmonic that a fit needs, if that takes longer."""
_TUNINGS = 2
_SHOWN = 0.45
"""Part of the rate of the positions, below which tones of a hum are taken out."""
_MOST_OFF = 0.25
"""Part of a turn, over half a fit, by which a frequency may be corrected in it."""
_CONTACT_FREE = 0.9
"""An orbit within this part of the clearance makes no lines of its own by touching."""
_WRAPPED = 0.5
"""Turns by which an angle goes back where it begins to count again."""
_CHANGED = 0.5
"""Of what is left beside the rotor's motion with a line or without it, the part that shows which is true."""


class _Motion(NamedTuple):
    """A line with its phase, and the rotor beside it.

    Attributes:
        hz: float64 ``[F]``, signed frequencies.
        amplitudes: complex128 ``[F]``, um.
        origin: sample at which they have no phase.
        orders: harmonics of the shaft.
        harmonics: complex128 ``[H]``, um.
    """

    hz: Floats
    amplitudes: Complexes
    origin: float
    orders: list[int]
    harmonics: Complexes

    def at(self, samples: Floats, rate_hz: float) -> Complexes:
        """The line at samples, complex128 ``[n]``, um."""
        seconds = (samples - self.origin) / rate_hz
        return np.asarray(np.exp(2j * math.pi * np.outer(seconds, self.hz)) @ self.amplitudes)


class LineRemoval:
    """Finds foreign lines while a machine is not healthy, and takes them out for as long as they are there.

    Foreign are the mains and twice the mains. While the orbit touches nothing, their multiples are, if they
    go back and forth, and a modulation by the poles of a motor. Any other line may be a rub's. Another line
    is looked for where the machine is not healthy without those that are known, three in all.

    Args:
        rate_hz: sampling rate.
        clearance_um: radial.
        clockwise: whether the shaft turns so.
        ac_coupled: whether the probes show no static position, so that no orbit is known to touch nothing.
    """

    def __init__(
        self, rate_hz: float, clearance_um: float, *, clockwise: bool, ac_coupled: bool = False
    ) -> None:
        free_um = 0.0 if ac_coupled else _CONTACT_FREE * clearance_um
        # Only the first line may be all that is new.
        self._each = tuple(
            _OneLine(rate_hz, clearance_um, clockwise=clockwise, free_um=free_um, is_first=i == 0)
            for i in range(_MOST_LINES)
        )
        self._unhealthy = 0.0

    @property
    def lines(self) -> tuple[NonsynchronousLine, ...]:
        """The lines that are taken out, the largest first."""
        known = (one.line for one in self._each if one.line is not None and one.is_out)
        return tuple(sorted(known, key=lambda line: -line.amplitude_um))

    def forget(self) -> None:
        """Keep nothing, as after a gap whose length is a guess: which phase a line has is not known."""
        for one in self._each:
            one.forget()

    def without(self, first_index: int, angle_rad: Floats, xy: Floats, samples_per_rev: int) -> Floats:
        """Take in a block.

        Args:
            first_index: of its first sample.
            angle_rad: float64 ``[n]``, shaft angle, growing, in whatever turn; NaN where not known.
            xy: float64 ``[n, 2]``, positions in clearances; NaN where missing.
            samples_per_rev: of a revolution.

        Returns:
            float64 ``[n, 2]``, the positions without the lines; NaN where one seems to end.
        """
        for one in self._each:
            xy = one.without(first_index, angle_rad, xy, samples_per_rev)
        return xy

    def look(self, orbit: Callable[[], HealthyOrbit], *, healthy: bool) -> bool:
        """Look for lines, at the end of a revolution.

        Args:
            orbit: gives the healthy one, seen from where the shaft turns counter-clockwise.
            healthy: whether the machine is, by what it does without the lines. In a beat it seems to be at
                times.

        Returns:
            Whether other lines are taken out from now on.
        """
        # What beats makes the machine healthy at times, also for most of them.
        self._unhealthy = max(0.0, self._unhealthy + (-_FORGIVEN if healthy else 1.0))
        for i, one in enumerate(self._each):
            if one.look(orbit, healthy=healthy or (i > 0 and self._unhealthy < _SETTLED_REV)):
                self._unhealthy = 0.0
                for later in self._each[i + 1 :]:
                    later.forget()
                return True
            if one.line is None:
                break
        return False


class _OneLine:
    """The same of one line; arguments as of `LineRemoval`, and ``free_um``, in which nothing is touched."""

    def __init__(
        self, rate_hz: float, clearance_um: float, *, clockwise: bool, free_um: float, is_first: bool
    ) -> None:
        self._free_um = free_um
        self._rate_hz, self._clearance_um = rate_hz, clearance_um
        self._direction = -1.0 if clockwise else 1.0
        self._search = NonsynchronousSearch(rate_hz, by_part_of_beat=is_first)
        self._blocks: list[tuple[Floats, Floats]] = []
        self._first_index = self._end_index = self._covered = self._revolution = 0
        self._turns, self._next_index = 0.0, 0
        self._looking, self._unhealthy = False, -1
        self._line: NonsynchronousLine | None = None
        self._motion: _Motion | None = None
        self._fitted = 0
        self._is_out = False
        self._left: deque[tuple[int, float, float]] = deque()
        self._doubted = 0

    @property
    def line(self) -> NonsynchronousLine | None:
        """The line that is known; None if there is none."""
        return self._line

    @property
    def is_out(self) -> bool:
        """Whether it is taken out: not where it seems to have ended."""
        return self._is_out and self._motion is not None

    def forget(self) -> None:
        """Keep nothing."""
        self._search.forget()
        self._blocks, self._covered = [], 0
        self._line, self._motion, self._looking, self._is_out = None, None, False, False
        self._left.clear()
        self._doubted = 0

    def without(self, first_index: int, angle_rad: Floats, xy: Floats, samples_per_rev: int) -> Floats:
        """Take in a block."""
        if not len(xy) or not self._looking:
            return xy
        if first_index != self._end_index:
            self._blocks, self._covered = [], 0
        self._end_index = first_index + len(xy)
        if not self._blocks:
            self._first_index = first_index
        self._blocks.append((angle_rad, xy.copy()))
        self._covered += len(xy)
        if self._covered >= samples_per_rev:
            self._keep(samples_per_rev)
        motion = self._motion
        if motion is None:
            return xy
        z = self._of(xy)
        line = motion.at(np.arange(first_index, first_index + len(z), dtype=np.float64), self._rate_hz)
        if np.isfinite(angle_rad).all():
            rotor = turning(angle_rad / math.tau, motion.orders) @ motion.harmonics
            if self._weigh(z, line, rotor, samples_per_rev):
                return np.full_like(xy, np.nan)
        if not self._is_out:
            return xy
        left = (z - line) / self._clearance_um
        return np.column_stack((left.real, self._direction * left.imag))

    def _keep(self, samples_per_rev: int) -> None:
        """Keep the blocks so far as a revolution, its angle on from that of the one before."""
        angle_rad, xy = map(np.concatenate, zip(*self._blocks, strict=True))
        self._blocks, self._covered = [], 0
        turns = angle_rad / math.tau
        if not np.isfinite(turns).all():
            return
        expected = self._turns + (self._first_index - self._next_index) / samples_per_rev
        turns += round(expected - float(turns[0]))
        turns[1:] += np.cumsum(np.diff(turns) < -_WRAPPED)
        self._turns, self._next_index = float(turns[-1]), self._first_index + len(turns) - 1
        self._search.add(self._revolution, self._first_index, turns - self._revolution, self._of(xy))
        self._revolution += 1

    def _of(self, xy: Floats) -> Complexes:
        """Positions in um, seen from where the shaft turns counter-clockwise."""
        z = np.empty(len(xy), dtype=np.complex128)
        z.real, z.imag = self._clearance_um * xy[:, 0], self._direction * self._clearance_um * xy[:, 1]
        return z

    def look(self, orbit: Callable[[], HealthyOrbit], *, healthy: bool) -> bool:
        """Look for a line; whether it is taken out from now on, or not any more."""
        if not healthy:
            self._unhealthy = self._revolution
            if not self._looking:
                self.forget()
                self._search.begin(self._revolution)
                self._looking = True
        elif self._line is None and self._revolution - self._unhealthy > REVOLUTIONS:
            self._looking = False
        if not self._looking:
            return False
        known = orbit()
        found, before = self._search.evaluate(self._revolution - 1, known), self._line
        self._line = found.line if found is not None and self._is_foreign(found.line) else None
        if found is None or self._line is None:
            self._motion, self._is_out = None, False
        elif before is None or self._revolution - self._fitted >= _FITTED_EVERY:
            self._fit(found, known)
            if before is None:
                self._is_out = True
                self._left.clear()
        return (before is None) != (self._line is None)

    def _is_foreign(self, line: NonsynchronousLine) -> bool:
        if line.mains:
            return True
        if line.poles is None and not (line.forward is None and is_multiple_of_mains(line.frequency_hz)):
            return False
        last = self._search.last(_FITTED_REV)
        return last is not None and float(np.abs(last.z).max()) < self._free_um

    def _fit(self, found: Found, orbit: HealthyOrbit) -> None:
        line = found.line
        apart = abs(line.order - round(line.order))
        wanted_rev = max(_FITTED_REV, _BEATS / max(apart, 1e-9))
        stretch = self._search.last(wanted_rev)
        # After a gap there are too few at first: the line as it was goes on.
        if stretch is not None and stretch.revolutions > _ENOUGH * min(wanted_rev, found.revolutions):
            self._motion = _of_part(stretch, line, orbit) if found.is_partial else _fitted(stretch, line)
            self._fitted = self._revolution

    def _weigh(self, z: Complexes, line: Complexes, rotor: Complexes, samples_per_rev: int) -> bool:
        """See by the last two revolutions whether the line is there: it may end long before a fit shows it.

        Returns:
            Whether this block raises a doubt, so that it is no evidence; for a revolution at most.
        """
        known = np.isfinite(z)
        if self._motion is None or not known.any():
            return False
        off = (z - rotor)[known]
        with_it, without = (float((np.abs(one) ** 2).sum()) for one in (off, off - line[known]))
        self._left.append((len(z), with_it, without))
        while sum(one[0] for one in self._left) - self._left[0][0] >= 2 * samples_per_rev:
            self._left.popleft()
        ends = np.cumsum([one[0] for one in self._left])
        if ends[-1] < 2 * samples_per_rev:
            return False
        # A fault, or another line, leaves much of both: then nothing shows.
        earlier = ends <= ends[-1] - samples_per_rev
        left = np.array([one[1:] for one in self._left])
        (was_with, was_without), (now_with, now_without) = (
            left[earlier].sum(axis=0),
            left[~earlier].sum(axis=0),
        )
        self._is_out = bool(
            now_with > _CHANGED * now_without if self._is_out else now_without < _CHANGED * now_with
        )
        clear = self._is_out and was_without < _CHANGED * was_with
        self._doubted = self._doubted + len(z) if clear and with_it < _CHANGED * without else 0
        return 0 < self._doubted <= samples_per_rev


def _fitted(stretch: Stretch, line: NonsynchronousLine) -> _Motion:
    """A line and the harmonics together, at the frequency that fits best."""
    seconds = np.arange(len(stretch.z)) / stretch.rate_hz
    centred = seconds - seconds.mean()
    hz, (factors, fixed_hz) = line.frequency_hz, _family(line, stretch)
    harmonics = stretch.harmonics
    count = harmonics.shape[1]
    most_hz = _MOST_OFF / max(float(centred[-1]), 1e-9)
    for _ in range(_TUNINGS):
        going = np.exp(2j * math.pi * np.outer(seconds, factors * hz + fixed_hz))
        fit = stretch.fit(harmonics, going, centred[:, np.newaxis] * going)
        amplitudes, slopes = np.split(fit[count:], 2)
        turned = factors @ (slopes * amplitudes.conj()).imag
        off_hz = float(turned / (factors**2 @ np.abs(amplitudes) ** 2)) / math.tau
        hz += min(max(off_hz, -most_hz), most_hz)
    signed = factors * hz + fixed_hz
    fit = stretch.fit(harmonics, np.exp(2j * math.pi * np.outer(seconds, signed)))
    return _motion(stretch, signed, fit[count:], stretch.orders, fit[:count])


def _family(line: NonsynchronousLine, stretch: Stretch) -> tuple[Floats, Floats]:
    """What comes with a line: each frequency as a multiple of that of the line, and what is added, in Hz.

    A line on the other side of a harmonic comes with one that modulates it. With the mains their multiples
    come, as no hum is a pure tone.
    """
    shaft_hz = line.frequency_hz / line.order
    multiples, added_hz = [1.0], [0.0]
    if line.modulates is not None:
        multiples, added_hz = [1.0, -1.0], [0.0, 2.0 * line.modulates * shaft_hz]
    elif line.mains:
        for times in range(1, MOST_MULTIPLES + 1):
            order = times * line.order / line.mains
            apart = abs(order - round(order)) * stretch.revolutions
            shown = order * shaft_hz < _SHOWN * stretch.rate_hz
            if times != line.mains and apart >= APART_BINS and shown:
                multiples.append(times / line.mains)
                added_hz.append(0.0)
    both = np.array(multiples + [-one for one in multiples])
    return both, np.array(added_hz + [-one for one in added_hz])


def _of_part(stretch: Stretch, line: NonsynchronousLine, orbit: HealthyOrbit) -> _Motion:
    """A line by a part of its beat with a harmonic, beside the healthy orbit."""
    signed = np.array([line.frequency_hz, -line.frequency_hz])
    seconds = np.arange(len(stretch.z)) / stretch.rate_hz
    off = stretch.off(orbit.baseline)
    return _motion(
        off,
        signed,
        off.fit(np.exp(2j * math.pi * np.outer(seconds, signed))),
        list(HARMONICS),
        orbit.baseline,
    )


def _motion(
    stretch: Stretch, hz: Floats, amplitudes: Complexes, orders: list[int], harmonics: Complexes
) -> _Motion:
    """The same at the samples, of which each position is the mean of some."""
    count = stretch.averaged
    origin = stretch.first * count + (count - 1) / 2.0
    at_samples = np.sinc(hz / stretch.rate_hz / count) / np.sinc(hz / stretch.rate_hz)
    return _Motion(hz, amplitudes * at_samples, origin, orders, harmonics)
