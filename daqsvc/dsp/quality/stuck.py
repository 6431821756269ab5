"""Whether a sensor stands still: it repeats one value for longer than it ever does.

A coarse converter repeats its values, a square wave rests on two, and between impacts a quiet sensor stays
at one. A dead sensor differs from these by its habit. This is how often a sample repeats the one before, and
how long its other runs of one value are, in this window and in the good ones before (`StandstillWatch`).

An accelerometer is searched for drop-outs besides, many short runs, by `dropouts`: the habit is taken from
seconds of it at once, and what is found is bridged. A short window could not tell those runs from chance.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

_SURE_NATS = 30.0
"""A run is no chance if it was so improbable, given how often samples repeat: once in some 10^13 windows."""
LONGER = 6
"""It is no habit if it is so many times as long as any other; at its crest a rounded sine rests up to 5."""
RUNS = 8
"""Other runs that are needed to know a habit."""
_REMEMBERED = 8
"""Windows that the habit is taken from, besides the present one."""
_DROP_STEPS = 4.0
"""A drop is more than so many of the signal's finest steps."""

DEAD_SHARE = 0.5
"""Share of samples that repeat the one before, from which on an accelerometer is dead."""
_LEAST_RUN = 4
"""Three differences of nothing in a row."""
_COARSE_RUN = 64
_COARSE = 0.5
"""Least difference over the median one beyond which a converter is coarse: its channel rests by itself."""
_ODD_MOVES = 0.01
"""Share of the moves that may be smaller than its steps: straight lines bridge what is missing."""
_NEAR_LIMIT = 0.025
"""So near to the extremes of all others, as a share of their range, a value is a limit."""
_FALSE_RUNS = 1e-2
"""Runs that a whole record shows by itself, at most."""


def stands_still(probes: Floats) -> bool:
    """Whether a probe repeats one value through a block, as none does that sees a turning shaft.

    Args:
        probes: float64 ``[n, 2]``.
    """
    if len(probes) <= 2 or not (probes[1] == probes[0]).any():
        return False
    return bool((probes == probes[0]).all(axis=0).any())


def never_rests(signals: Floats) -> bool:
    """Whether signals repeat values so rarely that none stands still, for a part of the window either.

    Args:
        signals: float64 ``[n, m]``, finite.
    """
    repeats = np.count_nonzero(signals[1:] == signals[:-1])
    return bool(repeats < min(LONGER, len(signals)) - 1)


class Standstill(NamedTuple):
    """A run of one value that a sensor was dead for.

    Attributes:
        first: its first sample, counted from the beginning of the window.
        samples: how many of the window's samples it holds; all of them if the sensor never moved.
        value: what the sensor repeated, in the unit of the samples.
    """

    first: int
    samples: int
    value: float


class _Habit(NamedTuple):
    """Runs of one value each: how many, over how many samples, and the longest."""

    runs: int
    samples: int
    longest: int


class StandstillWatch:
    """Follows one sensor from window to window; a run of one value goes on over their ends."""

    def __init__(self) -> None:
        self._habits: deque[_Habit] = deque(maxlen=_REMEMBERED)
        self._last = math.nan
        self._open = 0
        self._dead = False

    def push(self, samples: NDArray[np.float32] | NDArray[np.float64]) -> Standstill | None:
        """Take in the next window; when the sensor was dead in it, None if it was alive all the time.

        Args:
            samples: float32 or float64 ``[n]``, finite, n at least 1; missing samples are left out.
        """
        starts = np.concatenate(([0], np.flatnonzero(samples[1:] != samples[:-1]) + 1))
        inside = np.diff(np.append(starts, len(samples)))
        runs = inside.copy()
        if samples[0] == self._last:
            runs[0] += self._open
        at = self._standstill(runs, inside)
        self._dead = at is not None
        if at is None and len(runs) > 1:
            # The last run may still grow: it belongs to the window in which it ends.
            closed = runs[:-1]
            self._habits.append(_Habit(len(closed), int(closed.sum()), int(closed.max())))
        self._last, self._open = float(samples[-1]), int(runs[-1])
        return (
            None if at is None else Standstill(int(starts[at]), int(inside[at]), float(samples[starts[at]]))
        )

    def _standstill(self, runs: NDArray[np.intp], inside: NDArray[np.intp]) -> int | None:
        """Which run the sensor was dead for, if any."""
        if len(runs) == 1:
            return 0
        longest = int(runs.argmax())
        if self._no_habit_of(int(runs[longest]), np.delete(runs, longest)):
            return longest
        # Few samples after a standstill make no habit yet; most of the window is as dead as before.
        goes_on = self._dead and runs[0] > inside[0] and 2 * inside[0] >= inside.sum()
        return 0 if goes_on else None

    def _no_habit_of(self, run: int, others: NDArray[np.intp]) -> bool:
        known = [_Habit(len(others), int(others.sum()), int(others.max())), *self._habits]
        count = sum(habit.runs for habit in known)
        samples = sum(habit.samples for habit in known)
        if count < RUNS or run < LONGER * max(habit.longest for habit in known):
            return False
        repeats = (samples - count + 1) / (samples + 2)  # share of samples like the one before (Laplace)
        return -run * math.log(repeats) >= _SURE_NATS


def dropped_to(signal: Floats) -> Standstill | None:
    """The value that a signal dropped to, or came back from, for a part of a revolution; None if it did not.

    A flat crest rests on one value of a coarse converter, too, but is reached in its finest steps.
    """
    still = StandstillWatch().push(signal)
    if still is None:
        return None
    steps = np.abs(np.diff(signal))
    ends = steps[[i for i in (still.first - 1, still.first + still.samples - 1) if 0 <= i < len(steps)]]
    return still if ends.max(initial=0.0) > _DROP_STEPS * steps[steps > 0].min(initial=np.inf) else None


def coarse_step(moves: Floats) -> float | None:
    """The step of a converter so coarse that a channel mostly moves by one of them; None if it is finer.

    Args:
        moves: differences of neighbouring samples, ``[n]``.
    """
    moving = np.abs(moves[moves != 0.0])
    if not len(moving):
        return None
    least = float(np.quantile(moving, _ODD_MOVES, method="lower"))
    return least if least > _COARSE * np.median(moving) else None


def dropouts(samples: Floats) -> NDArray[np.bool_]:
    """Samples that belong to a run of one value, longer than the channel's own converter makes any.

    Args:
        samples: ``[n]``, all finite.

    Returns:
        ``[n]``; runs at the ends of the range are clipping and not marked.
    """
    n = len(samples)
    steps = np.abs(np.diff(samples))
    rests = steps == 0.0
    if not (rests[2:] & rests[1:-1] & rests[:-2]).any():
        return np.zeros(n, dtype=np.bool_)
    starts = np.flatnonzero(np.concatenate(([True], steps != 0.0)))
    lengths = np.diff(starts, append=n)
    repeated = min(float(np.mean(lengths > 1)), 0.99)
    least = max(_LEAST_RUN, math.ceil(1.0 + math.log(_FALSE_RUNS / n) / math.log(max(repeated, 1e-9))))
    if rests.all() or coarse_step(steps) is not None:
        least = max(least, _COARSE_RUN)
    long = lengths >= least
    rest = samples[np.repeat(~long, lengths)]
    if not len(rest):
        return np.zeros(n, dtype=np.bool_)
    # A clipped channel comes to its limit steadily; what rests far beyond all the rest has dropped out.
    low, high = float(rest.min()), float(rest.max())
    near, values = _NEAR_LIMIT * (high - low), samples[starts]
    clipped = (np.abs(values - low) <= near) | (np.abs(values - high) <= near)
    return np.repeat(long & ~clipped, lengths)
