"""Telemetry on its way to the broker: never waits, is dropped oldest first, and every drop is counted."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections import deque
from typing import TYPE_CHECKING, TypeVar

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.errors.code import coded
from daqsvc.errors.service import PART_FAILED
from daqsvc.outbox.messages import OutboxError
from daqsvc.outbox.telemetry_file import Arrival, TelemetryFile

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock
    from daqsvc.outbox.counters import TelemetryCounters
    from daqsvc.outbox.limits import OutboxLimits
    from daqsvc.outbox.messages import TelemetryMessage

_T = TypeVar("_T")

log = logging.getLogger(__name__)

LINGER_S = 0.05
"""How long a message may wait for company on its way to the file."""

RETRY_FIRST_S, RETRY_MOST_S = 0.25, 30.0
"""Waits before the thread begins again after a failure."""

WAITING_MAX_BYTES = 4 * 1024 * 1024
"""What may wait for the file; beyond that, the oldest is dropped."""


class Telemetry:
    """The lower class of messages, with a thread and its own file.

    Args:
        path: the SQLite file.
        clock: the service's clock.
        limits: how much is kept.
        counters: what is counted here.
    """

    def __init__(self, path: Path, clock: Clock, limits: OutboxLimits, counters: TelemetryCounters) -> None:
        self.counters = counters
        self.file = TelemetryFile(path, clock, limits, counters)
        self._limits = limits
        self._changed = threading.Condition()
        # Under the lock of `_changed`:
        self._arrived: deque[Arrival] = deque()
        self._arrived_bytes = 0
        self._overflowed = 0
        self._sent: list[int] = []
        self._reads: list[tuple[int, int, asyncio.Future[list[TelemetryMessage]]]] = []
        self._closing = False
        # On the event loop only:
        self._last_number = 0
        self._committed = asyncio.Event()
        self._ended: asyncio.Future[None] | None = None

    def start(self) -> None:
        """Start the thread; it opens the file."""
        loop = asyncio.get_running_loop()
        self._ended = loop.create_future()
        threading.Thread(
            target=self._run, args=(loop, self._ended), name="outbox-telemetry", daemon=True
        ).start()

    def put(self, topic: str, payload: bytes, expiry_s: float | None) -> None:
        """Take a message in; see `Outbox.telemetry`."""
        self._check_open()
        if not isinstance(payload, bytes):
            raise TypeError(f"the payload for {topic} is of type {type(payload).__name__}; give bytes")
        longest_ns = self._limits.telemetry_max_age_ns
        lifetime_ns = longest_ns if expiry_s is None else min(round(expiry_s * NS_PER_S), longest_ns)
        with self._changed:
            self._arrived.append((topic, payload, lifetime_ns))
            self._arrived_bytes += len(payload)
            while self._arrived_bytes > WAITING_MAX_BYTES:
                self._arrived_bytes -= len(self._arrived.popleft()[1])
                self._overflowed += 1
            self._changed.notify()

    def mark_sent(self, number: int) -> None:
        """The broker has taken this message."""
        self._check_open()
        with self._changed:
            self._sent.append(number)
            self._changed.notify()

    async def pending(self, after: int, limit: int) -> list[TelemetryMessage]:
        """See `Outbox.pending_telemetry`."""
        self._check_open()
        answer: asyncio.Future[list[TelemetryMessage]] = asyncio.get_running_loop().create_future()
        with self._changed:
            self._reads.append((after, limit, answer))
            self._changed.notify()
        return await answer

    async def next(self, after: int, limit: int) -> list[TelemetryMessage]:
        """See `Outbox.next_telemetry`."""
        while True:
            newest = self._last_number
            messages = await self.pending(after, limit)
            if messages:
                return messages
            while self._last_number == newest:
                self._committed.clear()
                await self._committed.wait()

    async def close(self, timeout_s: float) -> None:
        """Write what waits and close the file; takes at most ``timeout_s``."""
        if self._ended is None:
            return
        with self._changed:
            self._closing = True
            self._changed.notify()
        with contextlib.suppress(TimeoutError):  # telemetry may be lost; the thread ends with the process
            await asyncio.wait_for(asyncio.shield(self._ended), timeout_s)

    def _check_open(self) -> None:
        if self._ended is None or self._closing:
            state = "is not open yet" if self._ended is None else "is closed"
            raise OutboxError(f"the outbox's telemetry {state}; messages can only pass while it is open")

    def _settle(self, last_number: int) -> None:
        self._last_number = last_number
        self._committed.set()

    # On the thread.

    def _run(self, loop: asyncio.AbstractEventLoop, ended: asyncio.Future[None]) -> None:
        def post(function: Callable[..., object], *args: object) -> None:
            # On a loop that is closed already nothing waits for the answer.
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(function, *args)

        retry_s = RETRY_FIRST_S
        try:
            while not self._serve(post):
                with self._changed:
                    self._changed.wait_for(lambda: self._closing, timeout=retry_s)
                retry_s = min(2 * retry_s, RETRY_MOST_S)
        finally:
            self._closing = True
            post(_finish, ended, None)

    def _serve(self, post: Callable[..., None]) -> bool:
        """Work until stopped; False after a failure, which costs what was being written."""
        try:
            self.file.open()
            post(self._settle, self.file.last_number)
            while self._turn(post):
                pass
        except BaseException:
            self.counters.restarts += 1
            if self.counters.restarts == 1:
                log.exception(
                    "the thread that keeps telemetry has failed; it begins again", extra=coded(PART_FAILED)
                )
            return self._closing
        finally:
            self.file.close()
        return True

    def _turn(self, post: Callable[..., None]) -> bool:
        """Do what has come in the meantime; whether to go on."""
        with self._changed:
            self._changed.wait_for(lambda: self._arrived or self._sent or self._is_urgent())
            self._changed.wait_for(self._is_urgent, timeout=LINGER_S)
            closing = self._closing
            arrived, self._arrived, self._arrived_bytes = self._arrived, deque(), 0
            sent, self._sent = self._sent, []
            reads = list(self._reads)
            overflowed, self._overflowed = self._overflowed, 0
        self.counters.accepted += overflowed
        self.counters.dropped_full += overflowed
        if arrived or sent:
            self.file.apply(arrived, sent)
            post(self._settle, self.file.last_number)
        for after, limit, answer in reads:
            post(_finish, answer, self.file.pending(after, limit))
            with self._changed:
                self._reads.pop(0)
        return not closing

    def _is_urgent(self) -> bool:
        return bool(self._reads or self._closing)


def _finish(future: asyncio.Future[_T], result: _T) -> None:
    if not future.done():
        future.set_result(result)
