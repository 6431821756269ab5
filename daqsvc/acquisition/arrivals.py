"""Streams without a counter: how often frames come, and how many are missing, by times of arrival.

Fewer frames than expected come of a device that is slower, and of a link that loses some. What a slower
device sends is regular; what is lost leaves gaps at random. The same holds for more frames than expected, and
a link that repeats some.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.counter import Placement

if TYPE_CHECKING:
    from numpy.typing import NDArray


FITS = 0.05
"""How far the rate may be off the nominal one."""
BIN_NS = NS_PER_S // 4
GROUPS = 16
PLAUSIBLE = 0.15
PLAUSIBLE_NS = NS_PER_S // 2
"""The nominal rate is taken for the device's if the first frames of so long are so close to it."""
LEAST_NS = 3 * NS_PER_S
"""Of how much time frames must have come."""
RUN = 8
"""Frames whose time is taken together where single ones can be told apart."""
RUNS = 32
REMEMBERED = RUNS + RUN
WIDEST = 0.5
"""How far apart such times may be, in nominal times between frames: frames that are lost make it 1."""
LEAST_SPREAD = 6.0
"""Frames by which numbers in equal times must differ if they are lost at random, for that to show."""
AS_BEFORE = 0.1
"""Another rate than the nominal one that differs by less from the last one is the same."""
REGULAR = 0.25
"""Share of that spread, beside half a frame, by which they may differ if the frames are regular."""
MOST_BINS = 512


class ArrivalRate:
    """Measures how many frames come a second, and knows when that is the device's own rate.

    Args:
        frame_rate_hz: nominal frames per second.
    """

    def __init__(self, frame_rate_hz: float) -> None:
        self._nominal_hz = frame_rate_hz
        self._bin_ns = max(BIN_NS, round(2 * NS_PER_S / frame_rate_hz))
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

    def take(self, arrival_ns: NDArray[np.int64]) -> None:
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
            ratio = sum(self._bins) * NS_PER_S / duration_ns / self._nominal_hz
            self._plausible = self._plausible or abs(ratio - 1.0) <= PLAUSIBLE
        if len(self._bins) * self._bin_ns < LEAST_NS:
            return
        bins = np.array(self._bins)
        size = max(1, math.ceil(LEAST_NS / (GROUPS * self._bin_ns)))
        while size * GROUPS <= len(bins):
            come = bins[-size * GROUPS :].reshape(GROUPS, size).sum(axis=1)
            if (rate := self._rate_of(come, size * self._bin_ns / NS_PER_S)) is not None:
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
        """The rate, if the frames that have come in equal times tell it."""
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
        if usual_ns <= 0 or (longest_ns - shortest_ns) * self._nominal_hz / NS_PER_S > WIDEST:
            return None
        return RUN * NS_PER_S / float(usual_ns)


TOLERANCE = 0.75
"""How late a frame may be, as a share of the time between frames, before others are taken to be missing."""

WATCH_FRAMES = 4
WATCH_MOST_NS = 2_000_000_000
"""For how many frames' time a late one waits for those after it, which tell whether it was held up."""

_FALLING_BEHIND = 1.0 / 32.0
_CATCHING_UP = 1.0 / 2.0
"""Which share of what a frame is late, or early, moves the time at which the next one is due."""


class ArrivalCount:
    """Gives each frame the count that fits its time of arrival.

    Frames come late, never early, so the time at which a frame is due follows the earliest ones: a device
    whose rate is off the nominal one by up to 0.5 % gains and loses nothing. Loss is told exactly while no
    frame is later than half the time between frames, and the device's clock drifts by less than a quarter of
    it during a gap. A longer delay is no loss if the frames have caught up within `WATCH_FRAMES` of that
    time, as those do that a busy gateway sends all at once; else it is taken for missing frames. A repeated
    frame is taken for a new one. No frame is ever rejected: one that comes before its time is a frame all the
    same.

    It takes the place of a `daqsvc.acquisition.counter.CounterUnwrapper`, and knows of no restarts.

    Args:
        period_ns: nominal time from one frame to the next.
    """

    def __init__(self, period_ns: float) -> None:
        self._period_ns = period_ns
        self.watch_ns = min(round(WATCH_FRAMES * period_ns), WATCH_MOST_NS)
        """See `daqsvc.acquisition.counter.CounterUnwrapper.watch_ns`."""
        self._count = 0
        self._due_ns: float | None = None
        """When the next frame is due."""

    def begin_afresh(self, first: int) -> None:
        """Take the next frame as due when it comes.

        Args:
            first: the count of that frame.
        """
        self._count, self._due_ns = first, None

    def measured(self, rate_hz: float, drift: float) -> None:
        """The device's rate has been measured, by these very counts: that tells nothing new."""

    def forget_rate(self) -> None:
        """Go by the nominal rate, as ever."""

    def wants_more(self, raw: NDArray[np.int64], arrival_ns: NDArray[np.int64]) -> bool:  # noqa: ARG002
        """Whether a batch has a late frame, and only those after it can tell whether others are missing.

        Args:
            raw: int64 ``[n]``, anything.
            arrival_ns: int64 ``[n]``, host monotonic, in the order of arrival.
        """
        due_ns = self._due_ns
        while due_ns is not None and len(arrival_ns):
            missing = self._missing(arrival_ns, due_ns)
            if not missing.any():
                return False
            late = int(np.argmax(missing > 0))
            end = np.searchsorted(arrival_ns, arrival_ns[late] + self.watch_ns, side="right")
            watched = missing[late:end]
            lost = int(watched.min())
            if lost and late + len(watched) == len(arrival_ns):
                return True
            # Past the gap, or to where they have caught up.
            seen = late + 1 if lost else late + int(np.argmin(watched)) + 1
            due_ns += (seen + lost) * self._period_ns
            arrival_ns = arrival_ns[seen:]
        return False

    def place(self, raw: NDArray[np.int64], arrival_ns: NDArray[np.int64]) -> Placement:
        """Count a batch.

        Args:
            raw: int64 ``[n]``, anything.
            arrival_ns: int64 ``[n]``, host monotonic, in the order of arrival.
        """
        return Placement(self.count(arrival_ns), np.ones(len(raw), np.bool_), [])

    def count(self, arrival_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """The count of each frame; every frame counts one at least.

        Args:
            arrival_ns: int64 ``[n]``, host monotonic, in the order of arrival.
        """
        counts: list[int] = []
        for at, t_ns in enumerate(arrival_ns.tolist()):
            if self._due_ns is None:
                self._due_ns = float(t_ns)
            missing = 0
            if t_ns - self._due_ns >= TOLERANCE * self._period_ns:
                watched = arrival_ns[at : np.searchsorted(arrival_ns, t_ns + self.watch_ns, side="right")]
                missing = int(self._missing(watched, self._due_ns).min())
            counts.append(self._count + missing)
            late_ns = t_ns - self._due_ns - missing * self._period_ns
            share = _FALLING_BEHIND if late_ns > 0 else _CATCHING_UP
            self._due_ns += (missing + 1) * self._period_ns + share * late_ns
            self._count += missing + 1
        return np.array(counts, np.int64)

    def _missing(self, arrival_ns: NDArray[np.int64], due_ns: float) -> NDArray[np.int64]:
        """Frames that are missing before each, by its own time alone, if the first one was due then."""
        late_ns = arrival_ns - due_ns - self._period_ns * np.arange(len(arrival_ns))
        return np.maximum(np.floor(late_ns / self._period_ns + 1.0 - TOLERANCE), 0).astype(np.int64)
