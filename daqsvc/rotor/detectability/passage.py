"""When a CUSUM passes its threshold: the distribution of the delay, not one path of it.

The mean path of the evidence passes a threshold later than half of the real ones do: they climb with
noise of their own, about five nats at a threshold of 16, and need to touch it only once. So the
distribution of the CUSUM is carried forward over a grid, reflected at 0 and absorbed at the threshold.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtr

from daqsvc.rotor.detectability.evidence import growth_after, steady_growth

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from daqsvc.rotor.detectability.evidence import Axis, Growth

    Floats = NDArray[np.float64]

_STEP_SPREAD = 0.25
"""Samples are taken together until the variance of their evidence is this much, nats squared."""
_FINEST_CELL = 0.15
_MOST_CELLS = 400
_STEPS_BEFORE = 64
_MOST_STEPS = 4000
_DECAYED = 8.0
"""A transient is over when it has fallen by exp(-8)."""
_LONGEST_TRANSIENT = 400_000


def delay_samples(before: Axis, after: Axis, w: float, threshold_nats: float, quantile: float = 0.5) -> float:
    """Samples from an abrupt change until the CUSUM of its evidence passes a threshold.

    Args:
        before: the mode that the machine was in for long.
        after: the mode that it changed to.
        w: normalised shaft speed.
        threshold_nats: the threshold.
        quantile: part of all changes that are past the threshold by then, in (0, 1).

    Returns:
        Samples after the change; infinite if the evidence does not lead to the threshold.
    """
    cusum = _Cusum(threshold_nats)
    quiet = _steps_of(steady_growth(before, after, before, w))
    for samples, drift, spread in itertools.islice(quiet, _STEPS_BEFORE):
        cusum.advance(samples * drift, samples * spread)
    cusum.forget_alarms()
    # The slowest of both modes rules the transient.
    transient = min(_LONGEST_TRANSIENT, math.ceil(_DECAYED / min(before.decay, after.decay)))
    growing = _changing_steps(growth_after(before, after, w, transient))
    lasting = steady_growth(after, after, before, w)
    steady = _steps_of(lasting) if lasting.drift[0] > 0.0 else ()
    time = passed = 0.0
    for samples, drift, spread in itertools.islice(itertools.chain(growing, steady), _MOST_STEPS):
        before_step, passed = passed, cusum.advance(samples * drift, samples * spread)
        if passed >= quantile:
            return time + samples * (quantile - before_step) / (passed - before_step)
        time += samples
    return math.inf


class _Cusum:
    """Distribution of a CUSUM over cells from 0 to its threshold.

    Args:
        threshold_nats: the threshold.
    """

    def __init__(self, threshold_nats: float) -> None:
        count = min(_MOST_CELLS, max(100, math.ceil(threshold_nats / _FINEST_CELL)))
        self._weight = np.zeros(count)
        self._weight[0] = 1.0
        # Cells are centred on their values, and the last one ends at the threshold.
        cell = threshold_nats / (count - 0.5)
        self._edges = (np.arange(1 - count, count + 1) - 0.5) * cell
        self._passed = 0.0
        self._step = (math.nan, math.nan)
        self._moves = self._exits = self._weight

    def forget_alarms(self) -> None:
        """Keep to the runs that have not passed yet."""
        self._weight /= self._weight.sum()
        self._passed = 0.0

    def advance(self, drift: float, spread: float) -> float:
        """One step by a normal increment of that mean and variance; the part of all runs that has passed."""
        if self._step != (drift, spread):
            self._step = (drift, spread)
            below = ndtr((self._edges - drift) / math.sqrt(max(spread, 1e-12)))
            self._moves = below[1:] - below[:-1]
            self._exits = 1.0 - below[: len(self._weight) - 1 : -1]
        count = len(self._weight)
        moved = np.convolve(self._weight, self._moves)[count - 1 : 2 * count - 1]
        self._passed += float(self._weight @ self._exits)
        moved[0] = max(0.0, 1.0 - self._passed - float(moved[1:].sum()))
        self._weight = moved
        return self._passed


def _steps_of(growth: Growth) -> Iterator[tuple[int, float, float]]:
    """Samples taken together, and drift and spread of each, again and again; none if nothing drives it."""
    drift, spread = float(growth.drift[0]), float(growth.spread[0])
    if spread > 0.0:
        samples = max(1, math.floor(_STEP_SPREAD / spread))
        yield from itertools.repeat((samples, drift, spread))


def _changing_steps(growth: Growth) -> Iterator[tuple[int, float, float]]:
    """Samples taken together, and the mean drift and spread of each."""
    bins = np.floor(np.cumsum(growth.spread) / _STEP_SPREAD)
    begins = np.flatnonzero(np.diff(bins, prepend=-1.0))
    samples = np.diff(begins, append=len(bins))
    drift = np.add.reduceat(growth.drift, begins) / samples
    spread = np.add.reduceat(growth.spread, begins) / samples
    yield from zip(samples.tolist(), drift.tolist(), spread.tolist(), strict=True)
