"""Orbits cut into whole shaft revolutions, with the shaft angle of every sample.

What is measured once a revolution needs whole revolutions: the keyphasor states where they begin, or a known
speed, or the orbit itself. A revolution is the half-open interval between two marks of angle zero and may
last a non-integer number of samples; a sample belongs to the revolution that its time lies in.

A pulse with flanks shorter than the sampling interval states only between which two samples its edge lies.
Half way between them is wrong by up to half a sample, 3 degrees at 64 samples a revolution, and jumps by a
whole one from one revolution to another. The last edges together show more: of all constant speeds that put
each of them between its own two samples, the middle one places the newest (`SteadyEdges`).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from daqsvc.dsp.quality.missing import EdgeCounts
from daqsvc.dsp.speed.keyphasor import Edge, EdgeFinder, EdgeLine, KeyphasorEdge
from daqsvc.dsp.speed.orbit import OrbitPhase

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Bools = NDArray[np.bool_]

_REACH = 16
_LEAST = 3
_SHARP = 0.8
"""Part of the signal's range that an edge must rise by from one sample to the next to count as sharp."""
_HALF_SAMPLE = 0.5
_ROUNDING = 1e-6
_PULL = 0.1


class SharpEdges:
    """Finds which edges of a signal are sharp, block by block."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the signal."""
        self._last = np.nan
        self._low, self._high = np.inf, -np.inf

    def sharp(self, samples: Floats) -> NDArray[np.bool_]:
        """Whether the signal rises or falls by most of its range so far from the sample before.

        Args:
            samples: float64 ``[n]``; NaN where missing.
        """
        if not len(samples):
            return np.zeros(0, dtype=bool)
        before = np.concatenate(([self._last], samples[:-1]))
        low = np.minimum.accumulate(np.fmin(samples, np.inf))
        high = np.maximum.accumulate(np.fmax(samples, -np.inf))
        low, high = np.minimum(low, self._low), np.maximum(high, self._high)
        with np.errstate(invalid="ignore"):
            sharp: NDArray[np.bool_] = np.abs(samples - before) >= _SHARP * (high - low)
        self._last, self._low, self._high = float(samples[-1]), float(low[-1]), float(high[-1])
        return sharp


class SteadyEdges:
    """Places marks that are known to half a sample only."""

    def __init__(self) -> None:
        self._marks: deque[KeyphasorEdge] = deque(maxlen=_REACH)
        self._placed: KeyphasorEdge | None = None

    def reset(self) -> None:
        """Forget the marks before."""
        self._marks.clear()
        self._placed = None

    def place(self, mark: KeyphasorEdge, *, sharp: bool) -> KeyphasorEdge:
        """The mark, moved by up to half a sample if its edge is sharp and the shaft turns evenly.

        The place moves on with the speed and only gently towards the middle of what the edges allow. Where
        they allow a whole sample, any place in it is as good, but none may be left in a jump.
        """
        if not sharp:
            self.reset()
            return mark
        self._marks.append(mark)
        revolution = np.array([one.revolution - mark.revolution for one in self._marks], dtype=np.float64)
        sample = np.array([-one.samples_before(mark) for one in self._marks])
        reach = len(sample)
        allowed = None
        while reach >= _LEAST and allowed is None:
            allowed = _even(revolution[-reach:], sample[-reach:])
            reach //= 2
        offset = 0.0
        if allowed is not None:
            period, offset = allowed
            if self._placed is not None:
                turns = mark.revolution - self._placed.revolution
                ahead = period * turns - self._placed.samples_before(mark)
                offset = ahead + _PULL * (offset - ahead)
            offset = min(max(offset, -_HALF_SAMPLE), _HALF_SAMPLE)
        self._placed = replace(mark.later(offset), revolution=mark.revolution)
        return self._placed


def _even(revolution: Floats, sample: Floats) -> tuple[float, float] | None:
    """Period, and place of the last edge from where it was seen, if the speed is constant; else None."""
    apart = revolution[np.newaxis, :] - revolution[:, np.newaxis]
    later = apart > 0.0
    apart = np.where(later, apart, 1.0)
    gap = sample[np.newaxis, :] - sample[:, np.newaxis]
    shortest = float(np.where(later, (gap - 2.0 * _HALF_SAMPLE) / apart, -np.inf).max())
    longest = float(np.where(later, (gap + 2.0 * _HALF_SAMPLE) / apart, np.inf).min())
    if shortest > longest + _ROUNDING:
        return None
    period = 0.5 * (shortest + longest)
    line = sample - period * revolution
    earliest, latest = float((line - _HALF_SAMPLE).max()), float((line + _HALF_SAMPLE).min())
    return None if earliest > latest + _ROUNDING else (period, 0.5 * (earliest + latest))


_SPEED_RATIO = 10.0
"""A run-up may start, or a coast-down end, at this part of the expected speed, or at this multiple."""
_SHORTEST_PERIOD = 3.0
_BELOW_ONE = math.nextafter(1.0, 0.0)
_BRIDGED = 3
"""Missing pulses in a row that are bridged."""
WAIT_REVOLUTIONS = 5.5
"""A mark that has not come by then (three missing ones, slowing down) does not close its revolution."""
_JUMP = 0.2
"""Speeds of two revolutions that differ by more are not those of one shaft."""


@dataclass(frozen=True, slots=True)
class Revolutions:
    """Zero or more whole revolutions, in order and without a gap between them.

    Attributes:
        first_index: samples since the start of the cutter, or its last reset, at which ``xy`` begins.
        xy: float64 ``[n, 2]``, the samples of these revolutions, in the unit they came in; NaN where missing.
        angle_rad: float64 ``[n]``, from the mark in the direction of rotation, 0 to 2 pi (2 pi excluded).
        starts: int64 ``[r]``, index into ``xy`` of the first sample of each revolution.
        period_samples: float64 ``[r]``, exact length of each revolution.
        trusted: bool ``[r]``; False where the angle is a guess: more than three pulses missing, no lock, or
            a speed that jumped by more than a fifth from one revolution to the next.
    """

    first_index: int
    xy: Floats
    angle_rad: Floats
    starts: Ints
    period_samples: Floats
    trusted: Bools

    def __len__(self) -> int:
        return len(self.starts)


class RevolutionCutter(Protocol):
    """Cuts a stream of samples into revolutions; the result does not depend on how it comes in blocks."""

    @property
    def counts(self) -> EdgeCounts:
        """What became of the marks since the start."""
        ...

    def process(self, xy: Floats, marker: Floats | None) -> Revolutions:
        """Take in samples; return the revolutions that they complete.

        Args:
            xy: float64 ``[n, 2]``, two probes; NaN where missing.
            marker: float64 ``[n]``, keyphasor signal, NaN where missing; None if the cutter needs none.

        Raises:
            ValueError: the shapes do not fit, or the cutter needs a marker and there is none.
        """
        ...

    def reset(self) -> None:
        """Start again after a gap: incomplete revolutions are dropped, the counts go on."""
        ...


class FixedSpeedCutter:
    """Revolutions of a known constant speed: angle zero at the first sample.

    Args:
        period_samples: samples per revolution.

    Raises:
        ValueError: the period cannot be.
    """

    def __init__(self, period_samples: float) -> None:
        _check_period(period_samples)
        self._period = period_samples
        self.counts = EdgeCounts()
        self.reset()

    def reset(self) -> None:
        """See `RevolutionCutter.reset`."""
        self._shaft = Shaft()
        self._edge = KeyphasorEdge(0, 0.0)
        self._done = 0

    def process(self, xy: Floats, marker: Floats | None = None) -> Revolutions:
        """See `RevolutionCutter.process`; ``marker`` is not examined."""
        _check_samples(xy, marker)
        self._shaft.append(xy)
        while (end := KeyphasorEdge.at((self._done + 1) * self._period)).index <= self._shaft.position:
            self._shaft.turn(self._edge, end, 1, bend=0.0, trusted=True)
            self._edge = end
            self._done += 1
        return self._shaft.drain()


class KeyphasorCutter:
    """Revolutions between the edges of a keyphasor (`EdgeFinder`, `EdgeLine`).

    Between two edges the angle follows the mean of the parabolas through them and the edge before, and
    through them and the edge after: a constant acceleration leaves no error. Edges that lie
    anywhere between two samples are placed where an evenly turning shaft puts them (`SteadyEdges`). Hence a
    revolution comes out when the next one is complete; up to three missing pulses are bridged. Where no edge
    comes for longer, or the edges make no sense, the stretch is divided evenly into revolutions that are not
    trusted.

    Args:
        threshold: level that marks the edge, in the unit of the marker.
        hysteresis: how far the signal must return past the threshold before it can make another edge.
        edge: whether the rising or the falling edge marks angle zero.
        period_samples: expected samples per revolution.
        period_range: shortest and longest period to lock at; without it, a tenth and ten times the
            expected one, as in a run-up.

    Raises:
        ValueError: a figure cannot be.
    """

    def __init__(
        self,
        *,
        threshold: float,
        hysteresis: float,
        period_samples: float,
        edge: Edge = "rising",
        period_range: tuple[float, float] | None = None,
    ) -> None:
        _check_period(period_samples)
        if period_range is None:
            shortest = max(period_samples / _SPEED_RATIO, min(_SHORTEST_PERIOD, period_samples))
            period_range = (shortest, _SPEED_RATIO * period_samples)
        self._finder = EdgeFinder(threshold, hysteresis, edge)
        self._sharp, self._steady = SharpEdges(), SteadyEdges()
        self._line = EdgeLine(period_samples, period_range)
        self._period = period_samples
        self._patience = WAIT_REVOLUTIONS * period_range[1]
        self.reset()

    @property
    def counts(self) -> EdgeCounts:
        """What became of the pulses since the start."""
        return self._line.counts

    def reset(self) -> None:
        """See `RevolutionCutter.reset`."""
        self._finder.reset()
        self._sharp.reset()
        self._steady.reset()
        self._line.reset()
        self._number = self._line.number
        self._shaft = Shaft()
        self._marks = Between(self._shaft, self._period, self._patience)

    def process(self, xy: Floats, marker: Floats | None) -> Revolutions:
        """See `RevolutionCutter.process`."""
        if marker is None:
            raise ValueError("the keyphasor cutter needs the keyphasor's samples; without one, use another")
        _check_samples(xy, marker)
        begin = self._shaft.position
        self._shaft.append(xy)
        sharp = self._sharp.sharp(marker)
        for sample, fraction in self._finder.find(marker):
            # Whatever is overdue at this sample is settled before its edge, in blocks of any size.
            self._marks.wait(begin + sample)
            accepted = self._line.judge(begin + sample, fraction)
            if self._line.number != self._number:
                self._number = self._line.number
                self._steady.reset()
                self._marks.restart(self._line.marks, self._line.period)
            elif accepted and self._line.locked:
                mark = self._steady.place(self._line.marks[-1], sharp=bool(sharp[sample]))
                self._marks.add(mark, self._line.period)
        self._marks.wait(self._shaft.position)
        return self._shaft.drain()


class OrbitCutter:
    """Revolutions of a shaft without a keyphasor, by the phase of the orbit's own 1X (`OrbitPhase`).

    Angle zero is where the 1X vector points along +x. The angle follows the vector's slow turning, so a
    change of its phase that a fault makes is seen for some 30 revolutions and then becomes the new zero.
    Revolutions come out about four revolutions late, the first 16 together.

    Args:
        period_samples: expected samples per revolution, right to 4 %.

    Raises:
        ValueError: the period cannot be.
    """

    def __init__(self, period_samples: float) -> None:
        _check_period(period_samples)
        self._period = period_samples
        self.counts = EdgeCounts()
        self.reset()

    def reset(self) -> None:
        """See `RevolutionCutter.reset`."""
        self._shaft = Shaft()
        self._phase = OrbitPhase(self._period)
        self._last: KeyphasorEdge | None = None

    def process(self, xy: Floats, marker: Floats | None = None) -> Revolutions:
        """See `RevolutionCutter.process`; ``marker`` is not examined."""
        _check_samples(xy, marker)
        self._shaft.append(xy)
        for zero in self._phase.process(xy):
            mark = KeyphasorEdge.at(zero.sample)
            if self._last is not None:
                self._shaft.turn(self._last, mark, 1, bend=0.0, trusted=zero.trusted)
            self._last = mark
            if zero.measured:
                self.counts.accepted += 1
            else:
                self.counts.missing += 1
        return self._shaft.drain()


def _check_period(period_samples: float) -> None:
    if not (math.isfinite(period_samples) and period_samples > 2.0):
        raise ValueError(
            f"revolutions of {period_samples} samples cannot be cut; more than 2 samples are needed: "
            "check the speed and the sampling rate"
        )


def _check_samples(xy: Floats, marker: Floats | None) -> None:
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise ValueError(f"revolutions are cut from two probes [n, 2], not from an array {list(xy.shape)}")
    if marker is not None and marker.shape != xy.shape[:1]:
        raise ValueError(f"{len(xy)} samples of the probes, but {list(marker.shape)} of the keyphasor")


class Shaft:
    """Samples whose revolution is not known yet, and the revolutions that are, until they are taken."""

    def __init__(self) -> None:
        self.position = 0
        self._held = np.empty((0, 2))
        self._held_index = 0
        self._cut_index: int | None = None
        self._begin_turns()

    def _begin_turns(self) -> None:
        self._angle: list[Floats] = []
        self._starts: list[Floats] = []
        self._periods: list[Floats] = []
        self._trusted: list[Bools] = []

    def append(self, xy: Floats) -> None:
        """Take in float64 ``[n, 2]`` samples."""
        self._held = np.concatenate((self._held, xy))
        self.position += len(xy)

    def turn(
        self, begin: KeyphasorEdge, end: KeyphasorEdge, turns: int, *, bend: float, trusted: bool
    ) -> None:
        """The shaft turned ``turns`` times from ``begin`` to ``end``.

        Args:
            begin: the mark that the last turn ended at, or the first one.
            end: the mark that this one ends at.
            turns: whole revolutions between them.
            bend: curvature of the angle, in revolutions per sample squared.
            trusted: whether it is known.
        """
        if self._cut_index is None:
            self._drop_before(begin.index)
        lasted = begin.samples_before(end)
        # So bent, the slower end still has half of the mean speed.
        bend = math.copysign(min(abs(bend), 0.5 * turns / lasted**2), bend)
        since = np.arange(end.index - begin.index) - begin.fraction
        angle = turns * since / lasted + bend * since * (since - lasted)
        # Where the angle is a whole number: the root of the parabola in the form that is safe for bend 0.
        whole = np.arange(turns + 1)
        slope = turns / lasted - bend * lasted
        edges = 2.0 * whole / (slope + np.sqrt(slope**2 + 4.0 * bend * whole))
        edges[-1] = lasted
        starts = np.ceil(edges[:-1] + begin.fraction)
        counts = np.diff(np.append(starts, len(since))).astype(np.int64)
        fraction = np.clip(angle - np.repeat(whole[:-1], counts), 0.0, _BELOW_ONE)
        self._angle.append(2.0 * math.pi * fraction)
        self._starts.append(starts + (begin.index - self._held_index))
        self._periods.append(np.diff(edges))
        self._trusted.append(np.full(turns, trusted))
        self._cut_index = end.index

    def drain(self) -> Revolutions:
        """The revolutions since the last call."""
        first_index = self._held_index
        n = 0 if self._cut_index is None else self._cut_index - first_index
        revolutions = Revolutions(
            first_index=first_index,
            xy=self._held[:n],
            angle_rad=np.concatenate((np.empty(0), *self._angle)),
            starts=np.concatenate((np.empty(0), *self._starts)).astype(np.int64),
            period_samples=np.concatenate((np.empty(0), *self._periods)),
            trusted=np.concatenate((np.empty(0, dtype=np.bool_), *self._trusted)),
        )
        self._drop_before(first_index + n)
        self._begin_turns()
        return revolutions

    def _drop_before(self, index: int) -> None:
        self._held = self._held[index - self._held_index :]
        self._held_index = index


class Between:
    """Turns the marks of a keyphasor into revolutions, as soon as the mark after the next is known.

    Args:
        shaft: takes the revolutions.
        period_samples: samples per revolution as long as none is known.
        patience_samples: how long to wait for the first lock before guessing.
    """

    def __init__(self, shaft: Shaft, period_samples: float, patience_samples: float) -> None:
        self._shaft = shaft
        self._period = period_samples
        self._patience = patience_samples
        self._edge: KeyphasorEdge | None = None
        """Where the revolutions cut so far end."""
        self._before: KeyphasorEdge | None = None
        self._marks: list[KeyphasorEdge] = []
        """Marks of the line from ``_edge`` on."""

    def add(self, mark: KeyphasorEdge, period_samples: float) -> None:
        """The next mark of the line.

        Args:
            mark: the mark.
            period_samples: samples per revolution by the line.
        """
        if not self._marks:
            self._fill(mark)
        # By this the next mark is waited for, whatever the revolutions before it lasted: those of noise can
        # be so short that every mark of the shaft would come too late.
        self._period = period_samples
        self._marks.append(mark)
        if len(self._marks) > 2:
            self._cut(self._marks[2])

    def restart(self, marks: Iterable[KeyphasorEdge], period_samples: float) -> None:
        """A new line of marks, numbered again; see `add`."""
        self._finish()
        for mark in marks:
            if self._edge is None or mark.index > self._edge.index:
                self.add(mark, period_samples)

    def wait(self, position: int) -> None:
        """Settle what is overdue when all samples before ``position`` are there."""
        last = self._marks[-1] if self._marks else self._edge
        if last is None:
            if position < self._patience:
                return
            last = self._edge = KeyphasorEdge(0, 0.0)
        period = self._cut_period()
        if position - last.index < WAIT_REVOLUTIONS * period + 1:
            return
        self._finish()
        while position - last.index >= WAIT_REVOLUTIONS * period + 1:
            following = last.later(period)
            self._shaft.turn(last, following, 1, bend=0.0, trusted=False)
            last = self._edge = following

    def _cut_period(self) -> float:
        if len(self._marks) > 1:
            begin, end = self._marks[-2:]
            return begin.samples_before(end) / (end.revolution - begin.revolution)
        return self._period

    def _finish(self) -> None:
        """Cut what the line still holds, without a mark after it."""
        if len(self._marks) > 1:
            self._cut(None)
        self._marks.clear()
        self._before = None

    def _cut(self, after: KeyphasorEdge | None) -> None:
        """The revolutions between the two oldest marks."""
        begin, end = self._marks[:2]
        turns = end.revolution - begin.revolution
        rate = turns / begin.samples_before(end)
        bends = []
        trusted = turns <= _BRIDGED + 1
        if self._before is not None:
            early, gap = _rate(self._before, begin)
            trusted &= _steady(early, rate, (gap + turns) / 2)
            bends.append((rate - early) / self._before.samples_before(end))
        if after is not None:
            late, gap = _rate(end, after)
            trusted &= _steady(rate, late, (gap + turns) / 2)
            bends.append((late - rate) / begin.samples_before(after))
        bend = sum(bends) / len(bends) if bends and trusted else 0.0
        self._shaft.turn(begin, end, turns, bend=bend, trusted=trusted)
        self._period = 1.0 / rate
        self._before = self._marks.pop(0)
        self._edge = end

    def _fill(self, mark: KeyphasorEdge) -> None:
        """Guess from where the revolutions end, or from the start, to the first mark of a line."""
        if self._edge is not None and self._edge.index < mark.index:
            turns = max(1, round(self._edge.samples_before(mark) / self._period))
            self._shaft.turn(self._edge, mark, turns, bend=0.0, trusted=False)
        self._edge = mark


def _rate(begin: KeyphasorEdge, end: KeyphasorEdge) -> tuple[float, int]:
    """Speed between two marks in revolutions per sample, and the revolutions between them."""
    turns = end.revolution - begin.revolution
    return turns / begin.samples_before(end), turns


def _steady(one: float, other: float, apart: float) -> bool:
    """Whether speeds so many revolutions apart can be those of one shaft."""
    return max(one / other, other / one) - 1.0 <= _JUMP * apart
