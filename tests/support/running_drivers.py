"""A CAN driver that runs while a test looks on."""

from __future__ import annotations

import asyncio
import contextlib
import time
from typing import TYPE_CHECKING

from support.waiting import eventually

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from drivers.can.driver import CanDriver


class CountingDevice:
    """Counts its samples by the clock of the host, as a device does, however slow the test is.

    Args:
        rate_hz: samples per second.
        per_frame: samples in a frame.
    """

    def __init__(self, rate_hz: float, per_frame: int) -> None:
        self._frame_ns = per_frame * 1e9 / rate_hz
        self._per_frame = per_frame
        self._begun_ns: int | None = None
        self._last = 0

    def frame(self) -> int:
        """The number of the frame that it sends now, from 0 on."""
        now_ns = time.monotonic_ns()
        if self._begun_ns is None:
            self._begun_ns = now_ns
        self._last = int((now_ns - self._begun_ns) / self._frame_ns)
        return self._last

    @property
    def samples_since_first(self) -> int:
        """Samples from the first one sent up to the last one."""
        return (self._last + 1) * self._per_frame


@contextlib.asynccontextmanager
async def running(driver: CanDriver) -> AsyncIterator[None]:
    """A driver that is up, and has been stopped afterwards."""
    async with begun(driver):
        await eventually(lambda: driver.link.state == "up")
        yield


@contextlib.asynccontextmanager
async def begun(driver: CanDriver) -> AsyncIterator[None]:
    """A driver that may never come up, and has been stopped afterwards."""
    task = asyncio.create_task(driver.run())
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
