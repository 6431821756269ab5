"""The two clocks of the service: monotonic nanoseconds to compute with, wall time as a label.

Every interval, deadline and time stamp inside the service is an int64 count of nanoseconds on the
monotonic clock, so a step of the wall clock can move nothing. Wall time is attached to what leaves
the service, and only there.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
import time
from datetime import UTC, datetime
from typing import Protocol

NS_PER_S = 1_000_000_000


class Clock(Protocol):
    """A source of monotonic time, of wall-time labels, and of waiting on the former.

    ``monotonic_ns`` and ``wall_ns`` may be called from any thread; ``sleep_ns`` from the event loop.
    """

    def monotonic_ns(self) -> int:
        """Nanoseconds on a clock that never steps; its zero is arbitrary."""
        ...

    def wall_ns(self) -> int:
        """Nanoseconds since the Unix epoch, UTC; may step."""
        ...

    async def sleep_ns(self, duration_ns: int) -> None:
        """Wait until ``duration_ns`` have passed on the monotonic clock."""
        ...


class SystemClock:
    """The clocks of the operating system (CLOCK_MONOTONIC and CLOCK_REALTIME)."""

    def monotonic_ns(self) -> int:
        """See `Clock.monotonic_ns`."""
        return time.monotonic_ns()

    def wall_ns(self) -> int:
        """See `Clock.wall_ns`."""
        return time.time_ns()

    async def sleep_ns(self, duration_ns: int) -> None:
        """See `Clock.sleep_ns`."""
        await asyncio.sleep(max(duration_ns, 0) / NS_PER_S)


class DrivenClock:
    """A clock that moves only when somebody advances it: simulated time, as fast as it is driven.

    Whatever plays a simulation drives it, so the service sees the same intervals at any playing
    speed, and no sample is lost by playing too fast.

    Args:
        start_ns: first reading of the monotonic clock.
        wall_start_ns: wall-clock label of that instant.
    """

    def __init__(self, start_ns: int = NS_PER_S, wall_start_ns: int | None = None) -> None:
        self._start_ns = start_ns
        self._now_ns = start_ns
        self._wall_start_ns = time.time_ns() if wall_start_ns is None else wall_start_ns
        self._order = itertools.count()
        self._sleepers: list[tuple[int, int, asyncio.Future[None]]] = []

    def monotonic_ns(self) -> int:
        """See `Clock.monotonic_ns`."""
        return self._now_ns

    def wall_ns(self) -> int:
        """See `Clock.wall_ns`."""
        return self._wall_start_ns + self._now_ns - self._start_ns

    async def sleep_ns(self, duration_ns: int) -> None:
        """See `Clock.sleep_ns`; returns at once if the time has already come."""
        if duration_ns <= 0:
            await asyncio.sleep(0)
            return
        wake: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        heapq.heappush(self._sleepers, (self._now_ns + duration_ns, next(self._order), wake))
        await wake

    def advance_to(self, now_ns: int) -> None:
        """Move to ``now_ns`` and wake whoever waited for it; call from the event loop.

        Raises:
            ValueError: ``now_ns`` lies in the past.
        """
        if now_ns < self._now_ns:
            raise ValueError(f"a monotonic clock cannot go back from {self._now_ns} to {now_ns} ns")
        self._now_ns = now_ns
        while self._sleepers and self._sleepers[0][0] <= now_ns:
            _, _, wake = heapq.heappop(self._sleepers)
            if not wake.done():
                wake.set_result(None)


def iso_utc(wall_ns: int) -> str:
    """A wall-clock label as ISO 8601 in UTC with microseconds, e.g. ``2026-01-31T12:00:00.000001Z``."""
    seconds, ns = divmod(wall_ns, NS_PER_S)
    stamp = datetime.fromtimestamp(seconds, UTC).replace(microsecond=ns // 1000)
    return stamp.isoformat(timespec="microseconds").replace("+00:00", "Z")
