"""The shaft angle of every sample between marks of angle zero."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.dsp.keyphasor_edges import KeyphasorEdge

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Bools = NDArray[np.bool_]

_BELOW_ONE = math.nextafter(1.0, 0.0)
_BRIDGED = 3
"""So many missing pulses in a row are bridged."""
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

    def take(self) -> Revolutions:
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
        """A new line of marks, numbered anew; see `add`."""
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
