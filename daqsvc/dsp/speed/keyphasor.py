"""Shaft angle and speed from a keyphasor: its edges, which of them mark a revolution, and the angle between.

One pulse a turn, its edge is angle zero.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import numpy as np

from daqsvc.dsp.quality.missing import EdgeCounts

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

Edge = Literal["rising", "falling"]

_ABOVE_MINUS_ONE = math.nextafter(-1.0, 0.0)
_TOLERANCE = 0.2
"""An edge may come this part of a revolution early or late."""
_REJECTED_IN_A_ROW = 3
"""Edges out of place, but in step with each other, from which on they are right and the line is wrong."""
_STEP = 0.25
"""Gaps between edges in step change by no more from one to the next."""
_ALIAS_STEP = 0.1
"""The same, where it must not be a second pulse that happens to come half a revolution later."""
_MIN_LOCK_EDGES = 2
_FREE_LOCK_EDGES = 4
"""Edges in step that make a lock if the speed is not known beforehand."""
_ALIAS_EDGES = 8
"""Edges in step at a part of the period (at a multiple, half of them) that show a wrong lock."""
_MIN_BEND_EDGES = 3
_BEND_EDGES = 1.5
"""The curvature is taken from so many times the edges that the line goes through."""
_BEND_DOUBT = 3.0
"""A curvature of so many standard deviations is half believed."""
_CONTRADICTED = 4.0
"""A parabola whose speed is so many times that of the last revolution, or negative, goes through noise."""
_QUARTILE = 1.15
"""Upper quartile of the absolute deviation from the mean, in standard deviations."""
_FOLLOWED_REVOLUTIONS = 4.0
"""Time without an edge for which the acceleration is continued; then the speed is held."""
_FORGOTTEN_REVOLUTIONS = 32.0
"""After so long without an edge there is no counting of revolutions any more."""


@dataclass(frozen=True, slots=True)
class KeyphasorProbe:
    """A keyphasor.

    Attributes:
        name: name of the sensor.
        column: its column in the stream, volts.
        threshold_v: level that marks the edge.
        hysteresis_v: how far the voltage must return before there can be another edge.
        edge: the edge that marks angle zero.
    """

    name: str
    column: int
    threshold_v: float
    hysteresis_v: float = 0.5
    edge: Edge = "rising"


@dataclass(frozen=True, slots=True)
class KeyphasorEdge:
    """Angle zero at ``index + fraction`` samples since the start.

    Attributes:
        index: first sample at or after the mark.
        fraction: from there back to the mark, in samples, -1 to 0.
        revolution: count of revolutions at the mark.
    """

    index: int
    fraction: float
    revolution: int = 0

    def samples_before(self, other: KeyphasorEdge) -> float:
        """Samples from here to ``other``."""
        return (other.index - self.index) + (other.fraction - self.fraction)

    def later(self, samples: float) -> KeyphasorEdge:
        """The place so many samples after this one (before it, if negative)."""
        later = KeyphasorEdge.at(self.fraction + samples)
        return KeyphasorEdge(self.index + later.index, later.fraction)

    @classmethod
    def at(cls, sample: float) -> KeyphasorEdge:
        """A place in samples since the start."""
        index = math.ceil(sample)
        return cls(index, sample - index)


class EdgeFinder:
    """Finds the edges of a pulse train over blocks of samples.

    An edge is where the voltage crosses the threshold, interpolated linearly between two samples; the next
    one counts only after the voltage has been back by the hysteresis.

    Args:
        threshold: level that marks the edge, in the unit of the samples.
        hysteresis: how far the signal must return past the threshold before it can make another edge.
        edge: whether the rising or the falling edge counts.

    Raises:
        ValueError: a figure cannot be.
    """

    def __init__(self, threshold: float, hysteresis: float, edge: Edge) -> None:
        if not math.isfinite(threshold):
            raise ValueError(f"keyphasor: the threshold is {threshold}; it must be a finite voltage")
        if not (math.isfinite(hysteresis) and hysteresis >= 0.0):
            raise ValueError(f"keyphasor: the hysteresis is {hysteresis}; it must be 0 or above")
        if edge not in ("rising", "falling"):
            raise ValueError(f"keyphasor: edge {edge!r} is unknown; use 'rising' or 'falling'")
        self._sign = 1.0 if edge == "rising" else -1.0
        self._threshold = self._sign * threshold
        self._rearm = self._threshold - hysteresis
        self.reset()

    def reset(self) -> None:
        """Forget the sample before; the next edge must be seen to rise."""
        self._last = math.nan
        self._armed = False

    def find(self, samples: Floats) -> list[tuple[int, float]]:
        """Edges as (first sample past the threshold, samples from there to the crossing, -1 to 0).

        Args:
            samples: float64 ``[n]``; NaN where missing.
        """
        if self._find_none(samples):
            return []
        signal = self._sign * np.where(np.isfinite(samples), samples, np.nan)
        before = np.concatenate(([self._last], signal[:-1])) if len(signal) else signal
        # +1 past the threshold, -1 back past the hysteresis, 0 shows nothing: carry the last word on.
        word = (signal >= self._threshold).astype(np.int8) - (signal < self._rearm).astype(np.int8)
        spoken = np.flatnonzero(word)
        previous = np.concatenate(([-1 if self._armed else 1], word[spoken]))
        edges = []
        for sample in spoken[(previous[1:] > 0) & (previous[:-1] < 0)].tolist():
            low, high = float(before[sample]), float(signal[sample])
            # Without the sample before it the edge could lie anywhere in the gap: it marks nothing.
            if low < self._threshold:
                edges.append((sample, max(-(high - self._threshold) / (high - low), _ABOVE_MINUS_ONE)))
        if len(signal):
            self._armed = bool(previous[-1] < 0)
            self._last = float(signal[-1])
        return edges

    def _find_none(self, samples: Floats) -> bool:
        """Take in a block that nowhere gets to the threshold; False if it may, or lacks samples.

        Most blocks of a fraction of a revolution are such, and this is a quarter of the work.
        """
        if not len(samples):
            return False
        low, high = sorted((self._sign * float(samples.min()), self._sign * float(samples.max())))
        if not -math.inf < low <= high < self._threshold:
            return False
        self._armed = self._armed or low < self._rearm
        self._last = self._sign * float(samples[-1])
        return True


class EdgeLine:
    """Decides which edges mark a revolution, and where the shaft is after the last of them.

    The shaft follows a parabola in time through the last edges, so that a steady acceleration leaves no
    lag. It goes through most of the edges and leaves out the rest, so that a wrong one does not bend it;
    its curvature counts as far as it stands out from their scatter.

    An edge marks a revolution if it lies within a fifth of a revolution of where the parabola, or the
    revolution before, has it. Edges out of place that keep step with each other start a new line.

    Args:
        period_samples: expected samples per revolution.
        period_range: shortest and longest period at which a line may start, in samples. Without it the
            speed is taken as known to a fifth, and two edges make a line; with it, four in step do.
        line_edges: edges that the parabola goes through.

    Raises:
        ValueError: a figure cannot be.

    Attributes:
        counts: what became of the edges.
        marks: the last edges of the line, oldest first.
        number: counts the lines; it changes when the edges begin to be numbered again.
        period: samples per revolution at the last edge; the expected ones before there is any line.
    """

    def __init__(
        self, period_samples: float, period_range: tuple[float, float] | None = None, line_edges: int = 8
    ) -> None:
        if not (math.isfinite(period_samples) and period_samples > 2.0):
            raise ValueError(
                f"keyphasor: {period_samples} samples per revolution; more than 2 are needed to see a pulse"
            )
        if line_edges < _MIN_LOCK_EDGES:
            raise ValueError(f"keyphasor: a line through {line_edges} edges; it takes at least 2")
        shortest, longest = period_range or (
            (1.0 - _TOLERANCE) * period_samples,
            (1.0 + _TOLERANCE) * period_samples,
        )
        if period_range is not None and not 2.0 < shortest < longest < math.inf:
            raise ValueError(
                f"keyphasor: a period between {shortest} and {longest} samples cannot be searched; "
                "the shortest must be above 2 and below the longest"
            )
        self._any_speed = period_range is not None
        self._range = (shortest, longest)
        self.counts = EdgeCounts()
        self._line_edges = line_edges
        self.marks: deque[KeyphasorEdge] = deque(maxlen=math.floor(_BEND_EDGES * line_edges))
        self.number = 0
        self.period = period_samples
        self._nominal_period = period_samples
        self._crossings: deque[KeyphasorEdge] = deque(maxlen=_ALIAS_EDGES + 1)
        self.reset()

    def reset(self, *, keep_speed: bool = False) -> None:
        """Forget the edges; the counts go on, and the period if it is kept."""
        if not keep_speed:
            self.period = self._nominal_period
        self._forget()

    @property
    def locked(self) -> bool:
        """Whether there is a line."""
        return len(self.marks) >= _MIN_LOCK_EDGES

    def turns(self, since: Floats) -> Floats:
        """Revolutions since the last mark.

        Args:
            since: float64 ``[n]``, samples since the last mark.
        """
        # Past the hold the parabola goes on as its tangent: an acceleration cannot be relied on for long.
        bent = np.minimum(since, self._hold)
        turns: Floats = self._offset + self._rate * since + self._bend * bent * (2.0 * since - bent)
        return turns

    def judge(self, index: int, fraction: float) -> bool:
        """Take in an edge; True if it marks a revolution."""
        mark = KeyphasorEdge(index, fraction)
        self._crossings.append(mark)
        if self.locked and self.marks[-1].samples_before(mark) > _FORGOTTEN_REVOLUTIONS * self.period:
            self._forget()
        if not self.marks:
            if self._any_speed:
                return self._propose(mark, _FREE_LOCK_EDGES)
            self._take(mark)
            return True
        if (whole := self._whole_turns(mark)) == 0:
            self.counts.rejected += 1
            if not self._propose(mark, _REJECTED_IN_A_ROW) and self._any_speed:
                self._divide()
            return False
        self.counts.missing += whole - 1
        self._take(replace(mark, revolution=self.marks[-1].revolution + whole))
        if self._any_speed:
            self._multiply()
        return True

    def _whole_turns(self, mark: KeyphasorEdge) -> int:
        """Revolutions from the last mark to this edge; 0 if it is out of place."""
        since = self.marks[-1].samples_before(mark)
        turns = float(self.turns(np.array([since]))[0])
        whole = round(turns)
        if whole >= 1 and abs(turns - whole) <= _TOLERANCE:
            return whole
        if not self.locked:
            return 0
        # At the start of a run-up the last revolution knows better than all of them.
        before, last = self.marks[-2], self.marks[-1]
        lasted = before.samples_before(last) / (last.revolution - before.revolution)
        return int(abs(since / lasted - 1.0) <= _TOLERANCE)

    def _take(self, mark: KeyphasorEdge) -> None:
        was_locked = self.locked
        self.counts.accepted += 1
        self._proposed.clear()
        self.marks.append(mark)
        self.number += self.locked and not was_locked
        self._fit()

    def _propose(self, mark: KeyphasorEdge, enough: int) -> bool:
        """Remember an edge that has no place; enough of them in step start a line."""
        self._proposed.append(mark)
        if len(self._proposed) < enough:
            return False
        if not self._in_step(self._proposed, _STEP):
            self._proposed.pop(0)
            return False
        if not self.marks:
            self.counts.accepted += enough
        self._start(self._proposed)
        return True

    def _in_step(self, marks: list[KeyphasorEdge], step: float) -> bool:
        """Whether the gaps change by at most ``step`` from one to the next, and can be revolutions."""
        gaps = [a.samples_before(b) for a, b in itertools.pairwise(marks)]
        steady = all(max(a / b, b / a) - 1.0 <= step for a, b in itertools.pairwise(gaps))
        shortest, longest = self._range
        return steady and shortest <= sum(gaps) / len(gaps) <= longest

    def _divide(self) -> None:
        """Start again if the edges keep step at a part of the period: the line had skipped some."""
        last = list(self._crossings)
        if len(last) > _ALIAS_EDGES and self._in_step(last, _ALIAS_STEP):
            self._start(last)

    def _multiply(self) -> None:
        """Start again if the edges keep step at a multiple of the period: the line had one too many."""
        last = list(self.marks)[-(_ALIAS_EDGES // 2) - 1 :]
        turns = {b.revolution - a.revolution for a, b in itertools.pairwise(last)}
        several = len(last) > _ALIAS_EDGES // 2 and len(turns) == 1 and turns != {1}
        if several and self._in_step(last, _STEP):
            self._start(last)

    def _start(self, marks: list[KeyphasorEdge]) -> None:
        marks = [replace(mark, revolution=revolution) for revolution, mark in enumerate(marks)]
        self._forget()
        self.marks.extend(marks)
        self.number += 1
        self._fit()

    def _forget(self) -> None:
        self.marks.clear()
        self._crossings.clear()
        self._proposed: list[KeyphasorEdge] = []
        self._rate, self._bend, self._offset, self._hold = 1.0 / self.period, 0.0, 0.0, 0.0

    def _fit(self) -> None:
        """Parabola through the edges: revolutions over samples, both from the last edge."""
        if not self.locked:
            return
        last = self.marks[-1]
        turns = np.array([mark.revolution - last.revolution for mark in self.marks], dtype=np.float64)
        since = np.array([-mark.samples_before(last) for mark in self.marks])
        self._bend = _believable_bend(since, turns)
        near = slice(-self._line_edges, None)
        self._offset, self._rate = _line(since[near], (turns - self._bend * since**2)[near])
        before = self.marks[-2]
        lasted = before.samples_before(last) / (last.revolution - before.revolution)
        if not 1.0 / _CONTRADICTED < self._rate * lasted < _CONTRADICTED:
            self._bend, self._offset, self._rate = 0.0, 0.0, 1.0 / lasted
        self.period = 1.0 / self._rate
        self._hold = _FOLLOWED_REVOLUTIONS * self.period
        if self._bend < 0.0:
            # Deceleration may at most halve the speed.
            self._hold = min(self._hold, -0.25 * self._rate / self._bend)


@lru_cache(maxsize=32)
def _pairs(n: int) -> Ints:
    """All pairs out of ``n`` points, in order: int64 ``[2, n (n - 1) / 2]``."""
    return np.array(list(itertools.combinations(range(n), 2)), dtype=np.int64).T


@lru_cache(maxsize=32)
def _triples(n: int) -> Ints:
    """All triples of different points out of ``n``, in any order: int64 ``[3, n, n - 1, n - 2]``."""
    triples = np.array(list(itertools.permutations(range(n), 3)), dtype=np.int64)
    return triples.T.reshape(3, n, n - 1, n - 2)


def _line(x: Floats, y: Floats) -> tuple[float, float]:
    """Offset and slope of the line through most points: medians over pairs (Theil and Sen)."""
    i, j = _pairs(len(x))
    slope = float(_median((y[j] - y[i]) / (x[j] - x[i])))
    return float(_median(y - slope * x)), slope


def _median(values: Floats) -> Floats:
    """``numpy.median`` over the last axis: a few values, none NaN, for which its checks cost more than it."""
    middle = values.shape[-1] // 2
    ranked = np.sort(values)
    if values.shape[-1] % 2:
        return np.asarray(ranked[..., middle])
    return np.asarray((ranked[..., middle - 1] + ranked[..., middle]) / 2.0)


def _upper_quartile(values: Floats) -> float:
    """``numpy.quantile`` of 0.75, in the same way."""
    ranked = np.sort(values).tolist()
    place = 0.75 * (len(ranked) - 1)
    below = math.floor(place)
    low, high, part = ranked[below], ranked[min(below + 1, len(ranked) - 1)], place - below
    return float(high - (high - low) * (1.0 - part) if part >= 0.5 else low + (high - low) * part)


def _believable_bend(since: Floats, turns: Floats) -> float:
    """Curvature in revolutions per sample squared, as far as it stands out from the scatter."""
    n = len(since)
    if n < _MIN_BEND_EDGES:
        return 0.0
    i, j, k = _triples(n)
    apart = since - since[:, np.newaxis]
    np.fill_diagonal(apart, 1.0)  # of which no triple has any
    rate = (turns - turns[:, np.newaxis]) / apart
    # Repeated medians (Siegel 1982) stay right while more than half of the edges are.
    bend = float(_median(_median(_median((rate[j, k] - rate[i, j]) / apart[i, k]))))
    straight = turns - bend * since**2
    offset, speed = _line(since, straight)
    # Few edges fit some parabola by chance: until there are more, half a sample is taken as their scatter.
    chance = 1.0 / (n - 2) ** 2
    scatter = _upper_quartile(np.abs(straight - offset - speed * since))
    edge = scatter / _QUARTILE * (1.0 + 8.0 * chance) + 0.5 * speed * chance
    # Standard deviation of the curvature of a least-squares parabola through n evenly spaced points.
    spacing = -float(since[0]) / (n - 1)
    deviation = edge / (spacing**2 * math.sqrt(n * (n**2 - 1) * (n**2 - 4) / 180.0))
    return bend**3 / (bend**2 + (_BEND_DOUBT * deviation) ** 2)


@dataclass(frozen=True, slots=True)
class ShaftTrack:
    """The shaft over a block of samples.

    Attributes:
        angle_rad: float64 ``[n]``, shaft angle from the mark in the direction of rotation, 0 to 2 pi;
            NaN where it is not known.
        edges: float64 ``[m]``, accepted edges within the block, in samples from the block's first one.
        period_samples: samples per revolution at the end of the block; NaN if not known.
    """

    angle_rad: Floats
    edges: Floats
    period_samples: float


class KeyphasorTracker:
    """Follows the shaft over blocks of samples, by the edges up to each sample (`EdgeFinder`, `EdgeLine`).

    The result does not depend on how the samples are cut into blocks.

    Args:
        threshold: level that marks the edge, in the unit of the samples.
        hysteresis: how far the signal must return past the threshold before it can make another edge.
        edge: whether the rising or the falling edge marks angle zero.
        period_samples: expected samples per revolution.
        period_range: shortest and longest period to lock at, in samples, for a run-up from standstill;
            without it, the expected one to a fifth.
        line_edges: edges that the angle is taken from.

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
        line_edges: int = 8,
    ) -> None:
        self._finder = EdgeFinder(threshold, hysteresis, edge)
        self._line = EdgeLine(period_samples, period_range, line_edges)
        self._position = 0
        self._start = 0

    @property
    def counts(self) -> EdgeCounts:
        """What became of the pulses since the start."""
        return self._line.counts

    @property
    def locked(self) -> bool:
        """Whether the angle is known."""
        return self._line.locked

    @property
    def period_samples(self) -> float:
        """Samples per revolution by the last edges; the expected ones before there are any."""
        return self._line.period

    @property
    def revolutions_since_edge(self) -> float:
        """Revolutions since the last accepted edge, or since the start or reset if there is none."""
        since = self._line.marks[-1].index if self._line.marks else self._start
        return (self._position - since) / self._line.period

    def reset(self, *, keep_speed: bool = False) -> None:
        """Forget the edges, for instance after a long gap; the counts go on, and the speed if it is kept."""
        self._start = self._position
        self._finder.reset()
        self._line.reset(keep_speed=keep_speed)

    def process(self, samples: Floats) -> ShaftTrack:
        """Follow the shaft over the next samples.

        Args:
            samples: float64 ``[n]``, keyphasor signal; NaN where missing.
        """
        begin, end = self._position, self._position + len(samples)
        angle = np.empty(len(samples))
        done = 0
        edges = []
        for sample, fraction in self._finder.find(samples):
            # The angle of the sample that completes the edge uses it already.
            angle[done:sample] = self._angle(begin + done, sample - done)
            done = sample
            if self._line.judge(begin + sample, fraction):
                edges.append(sample + fraction)
        angle[done:] = self._angle(begin + done, len(samples) - done)
        self._position = end
        period = self._line.period if self.locked else math.nan
        return ShaftTrack(angle, np.asarray(edges, dtype=np.float64), period)

    def _angle(self, first: int, count: int) -> Floats:
        if not self.locked:
            return np.full(count, np.nan)
        last = self._line.marks[-1]
        since = np.arange(first - last.index, first - last.index + count, dtype=np.float64) - last.fraction
        angle: Floats = 2.0 * math.pi * np.mod(self._line.turns(since), 1.0)
        return angle
