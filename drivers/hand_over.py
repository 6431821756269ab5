"""From the thread of a reader to the event loop: one batch in a turn of it, however many wait.

The loop does in one turn all that was ready when the turn began. Batches handed to it one by one would, after
a turn that took long, be taken in all at once, and every other bus, timer and connection would wait for them.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

Call: TypeAlias = "tuple[Callable[..., object], tuple[Any, ...]]"


class HandOver:
    """Has calls made on the event loop in their order, one in each turn.

    Args:
        loop: the event loop.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._calls: deque[Call] = deque()
        self._lock = threading.Lock()
        self._due = False

    def post(self, call: Callable[..., object], *arguments: object) -> None:
        """Have ``call`` made; from any thread.

        Raises:
            RuntimeError: the event loop is closed.
        """
        with self._lock:
            self._calls.append((call, arguments))
            if self._due:
                return
            self._due = True
        self._loop.call_soon_threadsafe(self._next)

    def finish(self) -> None:
        """Make at once all calls that wait; on the event loop, when nobody posts any more."""
        while self._calls:
            self._make()

    def _next(self) -> None:
        """Make the next call, and come back for the one after it when all others had their turn."""
        try:
            if self._calls:
                self._make()
        finally:
            with self._lock:
                self._due = bool(self._calls)
                if self._due:
                    self._loop.call_soon(self._next)

    def _make(self) -> None:
        call, arguments = self._calls.popleft()
        call(*arguments)
