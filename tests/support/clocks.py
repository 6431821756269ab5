"""Clocks that go as a test has them go; simulated time is `daqsvc.acquisition.clock.DrivenClock`."""

from __future__ import annotations

import asyncio

from daqsvc.acquisition.clock import NS_PER_S, SystemClock


class SettableClock:
    """Both clocks stand still until the test moves them, without waiting.

    Args:
        t_ns: first reading of the monotonic clock.
        wall_ns: first reading of the wall clock.
    """

    def __init__(self, t_ns: int = 0, wall_ns: int = 1_000 * NS_PER_S) -> None:
        self.t_ns, self.wall = t_ns, wall_ns

    def advance(self, seconds: float) -> None:
        """Let time pass on both."""
        self.t_ns += round(seconds * NS_PER_S)
        self.wall += round(seconds * NS_PER_S)

    def set_wall(self, seconds: float) -> None:
        """Set the wall clock by so much; time does not pass."""
        self.wall += round(seconds * NS_PER_S)

    def monotonic_ns(self) -> int:
        return self.t_ns

    def wall_ns(self) -> int:
        return self.wall

    async def sleep_ns(self, duration_ns: int) -> None:
        raise AssertionError(f"somebody waits {duration_ns} ns for a clock that stands still")


class SteppedClock(SystemClock):
    """The system's clocks, of which the test sets the wall clock: ``ahead_ns`` beside the system's."""

    ahead_ns = 0

    def wall_ns(self) -> int:
        return super().wall_ns() + self.ahead_ns


class QuickClock(SystemClock):
    """The system's clocks, on which waiting takes a part of its time: back-off is not what is tested.

    Args:
        times: how often a wait fits into the time that it should take.
    """

    def __init__(self, times: float = 100.0) -> None:
        self._times = times

    async def sleep_ns(self, duration_ns: int) -> None:
        await super().sleep_ns(round(duration_ns / self._times))


class LoopClock:
    """The event loop's own time, which `support.modbus_lines.simulate` makes simulated time.

    Args:
        late_ns: how late it wakes whoever waits, as an event loop does that waits in whole milliseconds.
    """

    def __init__(self, late_ns: int = 0) -> None:
        self._late_ns = late_ns

    def monotonic_ns(self) -> int:
        return round(asyncio.get_running_loop().time() * NS_PER_S)

    def wall_ns(self) -> int:
        return self.monotonic_ns()

    async def sleep_ns(self, duration_ns: int) -> None:
        await asyncio.sleep(max(duration_ns + self._late_ns, 0) / NS_PER_S)
