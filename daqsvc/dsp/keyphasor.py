"""Shaft angle and speed from a keyphasor: one pulse a revolution, its edge marks angle zero."""

from __future__ import annotations

import itertools
import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

Edge = Literal["rising", "falling"]

_TOLERANCE = 0.2
"""An edge may come this part of a revolution early or late."""
_REJECTED_IN_A_ROW = 3
"""So many edges out of place, but in step with each other, are right and the line is wrong."""
_MIN_LOCK_EDGES = 2


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


@dataclass(slots=True)
class EdgeCounts:
    """What became of the pulses since the start.

    Attributes:
        accepted: edges that marked a revolution.
        missing: revolutions without an edge, found out at the next one.
        rejected: edges that came where none can be: second pulses, noise.
    """

    accepted: int = 0
    missing: int = 0
    rejected: int = 0


@dataclass(slots=True)
class _Mark:
    """An edge: ``index + fraction`` samples since the start, at a count of revolutions."""

    index: int
    fraction: float
    revolution: int

    def samples_before(self, other: _Mark) -> float:
        return (other.index - self.index) + (other.fraction - self.fraction)


class KeyphasorTracker:
    """Follows the edges of a keyphasor over blocks of samples.

    An edge is where the voltage crosses the threshold, interpolated linearly between two samples; the next
    one counts only after the voltage has been back by the hysteresis. The angle runs along a straight line
    through the last edges (Theil-Sen: medians, so that a wrong edge does not bend it). At every sample it
    uses the edges up to there, hence does not depend on how the samples are cut into blocks.

    Args:
        threshold: level that marks the edge, in the unit of the samples.
        hysteresis: how far the signal must return past the threshold before it can make another edge.
        edge: whether the rising or the falling edge marks angle zero.
        period_samples: expected samples per revolution.
        line_edges: edges that the line goes through.

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
        line_edges: int = 8,
    ) -> None:
        if not math.isfinite(threshold):
            raise ValueError(f"keyphasor: the threshold is {threshold}; it must be a finite voltage")
        if not (math.isfinite(hysteresis) and hysteresis >= 0.0):
            raise ValueError(f"keyphasor: the hysteresis is {hysteresis}; it must be 0 or above")
        if not (math.isfinite(period_samples) and period_samples > 2.0):
            raise ValueError(
                f"keyphasor: {period_samples} samples per revolution; more than 2 are needed to see a pulse"
            )
        if edge not in ("rising", "falling"):
            raise ValueError(f"keyphasor: edge {edge!r} is unknown; use 'rising' or 'falling'")
        if line_edges < _MIN_LOCK_EDGES:
            raise ValueError(f"keyphasor: a line through {line_edges} edges; it takes at least 2")
        self._sign = 1.0 if edge == "rising" else -1.0
        self._threshold = self._sign * threshold
        self._rearm = self._threshold - hysteresis
        self._nominal_period = period_samples
        self._line_edges = line_edges
        self.counts = EdgeCounts()
        self._position = 0
        self.reset()

    def reset(self) -> None:
        """Forget the edges, for instance after a long gap; the counts go on."""
        self._start = self._position
        self._last = math.nan
        self._armed = False
        self._marks: deque[_Mark] = deque(maxlen=self._line_edges)
        self._rejected: list[_Mark] = []
        self._period = self._nominal_period
        self._offset = 0.0

    @property
    def locked(self) -> bool:
        """Whether the angle is known."""
        return len(self._marks) >= _MIN_LOCK_EDGES

    @property
    def period_samples(self) -> float:
        """Samples per revolution by the last edges; the expected ones before there are any."""
        return self._period

    @property
    def revolutions_since_edge(self) -> float:
        """Revolutions since the last accepted edge, or since the start or reset if there is none."""
        since = self._marks[-1].index if self._marks else self._start
        return (self._position - since) / self._period

    def process(self, samples: Floats) -> ShaftTrack:
        """Follow the shaft over the next samples.

        Args:
            samples: float64 ``[n]``, keyphasor signal; NaN where missing.
        """
        begin, end = self._position, self._position + len(samples)
        angle = np.empty(len(samples))
        done = 0
        edges = []
        for sample, back in self._find_edges(samples):
            # The angle of the sample that completes the edge uses it already.
            angle[done:sample] = self._angle(begin + done, sample - done)
            done = sample
            self._position = begin + sample
            if self._accept(begin + sample, -back):
                edges.append(sample - back)
        angle[done:] = self._angle(begin + done, len(samples) - done)
        self._position = end
        period = self._period if self.locked else math.nan
        return ShaftTrack(angle, np.asarray(edges, dtype=np.float64), period)

    def _find_edges(self, samples: Floats) -> list[tuple[int, float]]:
        """Crossings as (first sample past the threshold, samples that the crossing lies before it)."""
        signal = self._sign * np.where(np.isfinite(samples), samples, np.nan)
        before = np.concatenate(([self._last], signal[:-1])) if len(signal) else signal
        # +1 past the threshold, -1 back past the hysteresis, 0 says nothing: carry the last word on.
        word = (signal >= self._threshold).astype(np.int8) - (signal < self._rearm).astype(np.int8)
        spoken = np.flatnonzero(word)
        previous = np.concatenate(([-1 if self._armed else 1], word[spoken]))
        found = []
        for sample in spoken[(previous[1:] > 0) & (previous[:-1] < 0)].tolist():
            low, high = float(before[sample]), float(signal[sample])
            # Without the sample before it the edge could lie anywhere in the gap: it marks nothing.
            if low < self._threshold:
                found.append((sample, (high - self._threshold) / (high - low)))
        if len(signal):
            self._armed = bool(previous[-1] < 0)
            self._last = float(signal[-1])
        return found

    def _accept(self, index: int, fraction: float) -> bool:
        """Hold an edge against the period; True if it marks a revolution."""
        mark = _Mark(index, fraction, 0)
        if not self._marks:
            self._take(mark)
            return True
        turns = self._marks[-1].samples_before(mark) / self._period
        whole = round(turns)
        if whole < 1 or abs(turns - whole) > _TOLERANCE:
            self.counts.rejected += 1
            self._reject(mark)
            return False
        mark.revolution = self._marks[-1].revolution + whole
        self.counts.missing += whole - 1
        self._take(mark)
        return True

    def _take(self, mark: _Mark) -> None:
        self.counts.accepted += 1
        self._rejected.clear()
        self._marks.append(mark)
        self._fit()

    def _reject(self, mark: _Mark) -> None:
        """Remember an edge out of place; edges out of place that keep step start a new line."""
        self._rejected.append(mark)
        if len(self._rejected) < _REJECTED_IN_A_ROW:
            return
        gaps = [a.samples_before(b) for a, b in itertools.pairwise(self._rejected)]
        mean = sum(gaps) / len(gaps)
        in_step = all(abs(gap - mean) <= _TOLERANCE * mean for gap in gaps)
        if in_step and abs(mean - self._nominal_period) <= _TOLERANCE * self._nominal_period:
            self._marks.clear()
            for revolution, rejected in enumerate(self._rejected):
                rejected.revolution = revolution
                self._marks.append(rejected)
            self._rejected.clear()
            self._fit()
        else:
            self._rejected.pop(0)

    def _fit(self) -> None:
        """Theil-Sen line through the edges: period, and offset from the last edge of angle zero."""
        last = self._marks[-1]
        if len(self._marks) < _MIN_LOCK_EDGES:
            self._offset = 0.0
            return
        revolution = np.array([mark.revolution - last.revolution for mark in self._marks], dtype=np.float64)
        sample = np.array([-mark.samples_before(last) for mark in self._marks])
        i, j = np.triu_indices(len(sample), 1)
        self._period = float(np.median((sample[j] - sample[i]) / (revolution[j] - revolution[i])))
        self._offset = float(np.median(sample - self._period * revolution))

    def _angle(self, first: int, count: int) -> Floats:
        if not self.locked:
            return np.full(count, np.nan)
        last = self._marks[-1]
        since = np.arange(first - last.index, first - last.index + count) - last.fraction - self._offset
        angle: Floats = 2.0 * math.pi * np.mod(since / self._period, 1.0)
        return angle
