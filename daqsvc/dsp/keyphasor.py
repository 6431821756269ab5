"""Shaft angle and speed from a keyphasor, sample by sample."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.dsp.keyphasor_edges import Edge, EdgeCounts, EdgeFinder, EdgeLine

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

__all__ = ["Edge", "EdgeCounts", "KeyphasorTracker", "ShaftTrack"]


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

    def reset(self) -> None:
        """Forget the edges, for instance after a long gap; the counts go on."""
        self._start = self._position
        self._finder.reset()
        self._line.reset()

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
