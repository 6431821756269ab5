"""Counting frames that carry no counter: their times of arrival show how many are missing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

TOLERANCE = 0.75
"""How late a frame may be, as a share of the time between frames, before others are taken to be missing."""

WATCH_FRAMES = 4
WATCH_MOST_NS = 2_000_000_000
"""For how many frames' time a late one waits for those after it, which show whether it was held up."""

SURE_FRAMES = 50
"""Missing frames up to this number are counted exactly: 0.5 % of rate error is then a quarter of a frame."""

_FALLING_BEHIND = 1.0 / 32.0
_CATCHING_UP = 1.0 / 2.0
"""Which share of what a frame is late, or early, moves the time at which the next one is due."""


class ArrivalCount:
    """Gives each frame the count that fits its time of arrival.

    Frames come late, never early, so the time at which a frame is due follows the earliest ones. A device
    whose rate is off the nominal one by up to 0.5 % gains and loses nothing. Loss is counted exactly while no
    frame is later than half the time between frames, and the device's clock drifts by less than a quarter of
    it during a gap. A longer delay is no loss if the frames have caught up within `WATCH_FRAMES` of that
    time, as those do that a busy gateway sends all at once. Else it is taken for missing frames. A repeated
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
        """The device's rate has been measured, by these very counts: there is nothing new in it."""

    def forget_rate(self) -> None:
        """Go by the nominal rate, as ever."""

    def wants_more(self, raw: NDArray[np.int64], arrival_ns: NDArray[np.int64]) -> bool:  # noqa: ARG002
        """Whether a batch has a late frame, and only those after it can show whether others are missing.

        Args:
            raw: int64 ``[n]``, anything.
            arrival_ns: int64 ``[n]``, host monotonic, in the order of arrival.
        """
        return self._sure(arrival_ns) < len(arrival_ns)

    def sure(self, raw: NDArray[np.int64], arrival_ns: NDArray[np.int64]) -> int:  # noqa: ARG002
        """How many frames at the beginning of a batch that `wants_more` need not wait for what comes.

        They are better placed at once: each wait has an end, and the frames that came last have waited least.
        """
        return self._sure(arrival_ns)

    def _sure(self, arrival_ns: NDArray[np.int64]) -> int:
        due_ns, at, lost_at = self._due_ns, 0, None
        while due_ns is not None and at < len(arrival_ns):
            rest_ns = arrival_ns[at:]
            missing = self._missing(rest_ns, due_ns)
            if not missing.any():
                break
            late = int(np.argmax(missing > 0))
            end = np.searchsorted(rest_ns, rest_ns[late] + self.watch_ns, side="right")
            watched = missing[late:end]
            lost = int(watched.min())
            if lost and lost_at is None:
                lost_at = at + late  # what comes after it shows how many are missing: it is placed with that
            if lost and late + len(watched) == len(rest_ns):
                return at + late if lost_at is None else lost_at
            # Past the gap, or to where they have caught up.
            seen = late + 1 if lost else late + int(np.argmin(watched)) + 1
            due_ns += (seen + lost) * self._period_ns
            at += seen
        return len(arrival_ns)

    def place(
        self, raw: NDArray[np.int64], arrival_ns: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_], list[int]]:
        """Count a batch.

        Args:
            raw: int64 ``[n]``, anything.
            arrival_ns: int64 ``[n]``, host monotonic, in the order of arrival.
        """
        return self.count(arrival_ns), np.ones(len(raw), np.bool_), []

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
