"""Whether samples come at the rate that is stated: by when frames arrive, or by a recording's stamps.

Live, fewer frames than expected come of a device that is slower, and of a link that loses some. What a slower
device sends is regular; what is lost leaves gaps at random. The same holds for more frames than expected, and
a link that repeats some. Where no counter shows how many are missing, `ArrivalRate` tells them apart.

A recording states a rate, or has a column of time (`rate_of_stamps`). The two must agree ten times closer
than arrivals do with the nominal rate: stamps are rounded, arrivals have the jitter of link and computer.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]

_NS_PER_S = 10**9

SAME_RATE = 0.005
"""Rates that differ by less are the same, rounded."""

MOST_UNEVEN = 0.5
"""Steps of an even column of time are within this fraction of their median (rounded times do that)."""

LEAST_UNBROKEN = 0.75
"""Part of the steps that are one sample where a column of time has gaps; with fewer it is uneven."""

MOST_OFF_GRID = 0.3
"""A gap in a column of time is a whole number of samples to within so much of one, ..."""
SHORT_GAP = 20
"""... if it is not longer than so many samples; what was not sampled may have had its own clock."""

LEAST_IN_ORDER = 0.75
"""Part of the stamps, or of the steps, that go forward where a column of time with stamps that go back still
tells the rate."""

_PIECE = 1 << 14
"""Values whose medians are looked for at a time."""
_NEIGHBOURS = 51
"""Stamps that the one in their middle is compared with."""

FITS = 0.05
"""How far the rate may be off the nominal one; so in the time base (`daqsvc.acquisition.timebase`)."""
BIN_NS = _NS_PER_S // 4
GROUPS = 16
PLAUSIBLE = 0.15
PLAUSIBLE_NS = _NS_PER_S // 2
"""The nominal rate is taken for the device's if the first frames of so long are so close to it."""
LEAST_NS = 3 * _NS_PER_S
"""Of how much time frames must have come."""
RUN = 8
"""Frames whose time is taken together where single ones can be told apart."""
RUNS = 32
REMEMBERED = RUNS + RUN
WIDEST = 0.5
"""How far apart such times may be, in nominal times between frames: frames that are lost make it 1."""
MOST_RATIO = 2.0
"""Between the rate of single frames and that of all in `LEAST_NS`: what was held up comes in a burst."""
LEAST_SPREAD = 6.0
"""Frames by which numbers in equal times must differ if they are lost at random, for that to show."""
AS_BEFORE = 0.1
"""Another rate than the nominal one that differs by less from the last one is the same."""
REGULAR = 0.25
"""Share of that spread, beside half a frame, by which they may differ if the frames are regular."""
MOST_BINS = 512


@dataclass(frozen=True, slots=True)
class StampedRate:
    """What the stamps of a recording show.

    Attributes:
        rate_hz: samples per second.
        tolerance: how far the rate may be off by the digits of the stamps, relative.
        rows: int64 ``[n]``, the place of each sample where some are missing between; None if none are.
        is_even: whether each sample has its place by its stamp; else only the mean rate is known.
        backward: how many steps go back in time.
    """

    rate_hz: float
    tolerance: float
    rows: NDArray[np.int64] | None = None
    is_even: bool = True
    backward: int = 0

    def agrees(self, hz: float) -> bool:
        """Whether a rate is that of the stamps, as far as their digits show."""
        return abs(self.rate_hz / hz - 1.0) <= SAME_RATE + self.tolerance


def rate_of_stamps(seconds: Floats, *, surely_time: bool) -> StampedRate | None:
    """The rate that the stamps of samples show, and where samples lack between them; None if they show none.

    Args:
        seconds: float64 ``[n]``, n at least 3; what is not finite is missing.
        surely_time: whether they are stated to be stamps; else only even steps make them some.
    """
    with np.errstate(invalid="ignore"):  # infinities make NaN
        steps = np.diff(seconds)
    median = float(np.median(steps))
    backward = int((steps < 0.0).sum())
    in_order = backward <= (1.0 - LEAST_IN_ORDER) * len(steps)
    if not (np.isfinite(steps).all() and median > 0.0 and in_order):
        return _mean_rate(seconds) if surely_time else None
    if backward:
        steps = np.diff(_in_order(seconds, median))
    ones = np.abs(steps - median) <= MOST_UNEVEN * median
    period = float(steps[ones].mean())
    rows = None
    if not ones.all():
        counts = np.maximum(np.rint(steps / period), 1.0)
        off = np.abs(steps / period - counts)
        short = counts <= SHORT_GAP
        is_gap = (counts > 1) & (~short | (off <= MOST_OFF_GRID))
        # A clock that is set back shows nothing of what is missing there.
        known = ones | is_gap | (steps < 0.0)
        if not surely_time or ones.mean() < LEAST_UNBROKEN or not known.all():
            return _mean_rate(seconds) if surely_time else None
        if is_gap.any():
            rows = np.concatenate(([0], np.cumsum(np.where(ones, 1.0, counts)))).astype(np.int64)
    rate_hz = len(steps) / float(steps.sum()) if ones.all() else 1.0 / period
    rounding = float(np.abs(steps[ones] - period).max())
    tolerance = 2.0 * rounding / (period * ones.sum())
    return StampedRate(float(rate_hz), tolerance, rows, backward=backward)


def _median_of_neighbours(values: Floats) -> Floats:
    """The median of each value with those around it, float64 ``[n]``; mirrored at both ends.

    NumPy's, and in pieces: SciPy's cannot be loaded in the little memory that recordings are read with.
    """
    half = _NEIGHBOURS // 2
    padded = np.pad(values, half, mode="reflect")
    medians = np.empty_like(values)
    for begin in range(0, len(values), _PIECE):
        windows = np.lib.stride_tricks.sliding_window_view(
            padded[begin : begin + _PIECE + 2 * half], _NEIGHBOURS
        )
        medians[begin : begin + len(windows)] = np.median(windows, axis=1)
    return medians


def _in_order(seconds: Floats, period: float) -> Floats:
    """Stamps of which those out of order follow the ones before them by even steps.

    A few rows that a logger wrote in another order, or stamped wrongly, are no gaps. Where the clock was set
    back the stamps are left as they are.
    """
    at = np.arange(len(seconds))
    late = seconds - period * at
    # A median keeps the edge that a gap makes, and leaves out what lies beside its neighbours.
    neighbours = _median_of_neighbours(late)
    fits = np.abs(late - neighbours) <= MOST_UNEVEN * period
    fits[0] = True
    in_place = _follow(seconds, fits, period)
    fits &= in_place == np.maximum.accumulate(in_place)
    fits &= in_place == np.minimum.accumulate(in_place[::-1])[::-1]
    fits[0] = True
    return in_place if fits.mean() < LEAST_IN_ORDER else _follow(seconds, fits, period)


def _follow(seconds: Floats, fits: NDArray[np.bool_], period: float) -> Floats:
    """The stamps that fit, and between them even steps from the last one that does."""
    at = np.arange(len(seconds))
    last = np.maximum.accumulate(np.where(fits, at, 0))
    return np.asarray(seconds[last] + period * (at - last), np.float64)


def _mean_rate(seconds: Floats) -> StampedRate | None:
    """What stamps that are coarse, or lack some, show all the same; None if they go back often."""
    there = np.flatnonzero(np.isfinite(seconds))
    steps = np.diff(seconds[there])
    if len(there) < 2 or steps.max() <= 0.0:
        return None
    backward = int((steps < 0.0).sum())
    if not backward:
        span_s = float(seconds[there[-1]] - seconds[there[0]])
        rate_hz = float(there[-1] - there[0]) / span_s
        tolerance = 2.0 * float(steps.max()) / span_s
        return StampedRate(rate_hz, tolerance, is_even=False)
    if backward > (1.0 - LEAST_IN_ORDER) * len(steps):
        return None
    # From the middle of one half to that of the other: a few wrong stamps, even at the ends, move neither.
    early, late = np.array_split(there, 2)
    span_s = float(np.median(seconds[late]) - np.median(seconds[early]))
    if span_s <= 0.0:
        return None
    rate_hz = float(np.median(late) - np.median(early)) / span_s
    tolerance = 2.0 * float(np.median(np.abs(steps[steps != 0.0]))) / span_s
    return StampedRate(rate_hz, tolerance, is_even=False, backward=backward)


class ArrivalRate:
    """Measures how many frames come a second, and knows when that is the device's own rate.

    Args:
        frame_rate_hz: nominal frames per second.
    """

    def __init__(self, frame_rate_hz: float) -> None:
        self._nominal_hz = frame_rate_hz
        self._bin_ns = max(BIN_NS, round(2 * _NS_PER_S / frame_rate_hz))
        self._bins: deque[int] = deque(maxlen=MOST_BINS)
        self._filling = 0
        self._ends_ns: int | None = None
        self._latest = np.empty(0, np.int64)
        self._plausible = False
        self.rate_hz: float | None = None
        """Frames per second of the device; None while that is not known."""

    @property
    def fits(self) -> bool:
        """Whether the device's rate is the nominal one, as far as is known."""
        return self.rate_hz is None or self._is_nominal(self.rate_hz)

    def _is_nominal(self, rate_hz: float) -> bool:
        return abs(rate_hz / self._nominal_hz - 1.0) <= FITS

    def add(self, arrival_ns: NDArray[np.int64]) -> None:
        """Take in arrivals.

        Args:
            arrival_ns: int64 ``[n]``, host monotonic, at least one.
        """
        self._latest = np.concatenate([self._latest, arrival_ns[-REMEMBERED:]])[-REMEMBERED:]
        first_ns, last_ns = int(arrival_ns[0]), int(arrival_ns.max())
        if self._ends_ns is None or last_ns - self._ends_ns > MOST_BINS * self._bin_ns:
            # The first frames, or the first ones after an outage: nothing is known of the time before.
            self._bins.clear()
            self._ends_ns, self._filling = first_ns + self._bin_ns, 0
        full = 0 if last_ns < self._ends_ns else (last_ns - self._ends_ns) // self._bin_ns + 1
        edges = self._ends_ns + self._bin_ns * np.arange(full, dtype=np.int64)
        before = np.searchsorted(arrival_ns, edges)
        for come in np.diff(before, prepend=0).tolist():
            self._bins.append(self._filling + come)
            self._filling = 0
        self._filling += len(arrival_ns) - (int(before[-1]) if full else 0)
        self._ends_ns += full * self._bin_ns
        if full:
            self._measure()

    @property
    def known(self) -> bool:
        """Whether the rate is known, or seems to be the nominal one."""
        return self._plausible or self.rate_hz is not None

    def _measure(self) -> None:
        if (duration_ns := len(self._bins) * self._bin_ns) >= PLAUSIBLE_NS:
            ratio = sum(self._bins) * _NS_PER_S / duration_ns / self._nominal_hz
            self._plausible = self._plausible or abs(ratio - 1.0) <= PLAUSIBLE
        if len(self._bins) * self._bin_ns < LEAST_NS:
            return
        bins = np.array(self._bins)
        size = max(1, math.ceil(LEAST_NS / (GROUPS * self._bin_ns)))
        while size * GROUPS <= len(bins):
            come = bins[-size * GROUPS :].reshape(GROUPS, size).sum(axis=1)
            if (rate := self._rate_of(come, size * self._bin_ns / _NS_PER_S)) is not None:
                self._note(rate)
                return
            size *= 2
        if (rate := self._rate_of_single()) is not None:
            self._note(rate)

    def _note(self, rate_hz: float) -> None:
        before = self.rate_hz
        changed = before is None or self._is_nominal(rate_hz) != self._is_nominal(before)
        if changed or (before is not None and abs(rate_hz / before - 1.0) > AS_BEFORE):
            self.rate_hz = rate_hz

    def _rate_of(self, come: NDArray[np.int64], duration_s: float) -> float | None:
        """The rate, if the frames that have come in equal times show it."""
        rate, expected = float(come.mean()) / duration_s, self._nominal_hz * duration_s
        off = abs(rate / self._nominal_hz - 1.0)
        if off <= FITS:
            return rate
        at_random = math.sqrt(expected * off * max(1.0 - off, FITS))
        regular = float(come.std()) <= REGULAR * at_random + 0.5
        return rate if regular and at_random >= LEAST_SPREAD else None

    def _rate_of_single(self) -> float | None:
        """The rate, if the times of single frames are so regular that none can have been lost."""
        if len(self._latest) < REMEMBERED:
            return None
        runs_ns = self._latest[RUN:] - self._latest[:-RUN]
        shortest_ns, usual_ns, longest_ns = np.percentile(runs_ns, [5, 50, 95])
        if usual_ns <= 0 or (longest_ns - shortest_ns) * self._nominal_hz / _NS_PER_S > WIDEST:
            return None
        rate_hz = RUN * _NS_PER_S / float(usual_ns)
        recent = list(self._bins)[-math.ceil(LEAST_NS / self._bin_ns) :]
        come_hz = sum(recent) * _NS_PER_S / (len(recent) * self._bin_ns)
        return rate_hz if rate_hz <= MOST_RATIO * come_hz else None
