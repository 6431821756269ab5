"""Waiting for what must happen, however slow the machine is: nothing is timed by it."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable

PATIENCE_S = 200.0
"""How long to wait before the test is given up: only what hangs takes so long, on a machine with a load of 20
too; less than the time that pytest gives a test."""


async def eventually(condition: Callable[[], object], what: str = "it is so") -> None:
    """Wait until ``condition`` holds; the event loop goes on."""
    until_s = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > until_s:
            pytest.fail(f"waited {PATIENCE_S:g} s in vain until {what}")
        await asyncio.sleep(0.005)


def eventually_blocking(condition: Callable[[], object], what: str = "it is so") -> None:
    """The same without an event loop."""
    until_s = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > until_s:
            pytest.fail(f"waited {PATIENCE_S:g} s in vain until {what}")
        time.sleep(0.005)
