"""A CAN driver that runs while a test looks on."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import SystemClock

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from drivers.can_bus import CanDriver

PATIENCE_S = 20.0


class QuickClock(SystemClock):
    """Back-off at a hundredth of its length."""

    async def sleep_ns(self, duration_ns: int) -> None:
        await asyncio.sleep(duration_ns / 1e11)


@contextlib.asynccontextmanager
async def running(driver: CanDriver) -> AsyncIterator[None]:
    """A driver that is up, and has been stopped afterwards."""
    async with begun(driver):
        await until(lambda: driver.link.state == "up")
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


async def until(true: Callable[[], bool]) -> None:
    """Wait until something is true."""
    async with asyncio.timeout(PATIENCE_S):
        while not true():
            await asyncio.sleep(0.005)
