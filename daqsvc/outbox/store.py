"""The outbox: alarms are on disk before anybody says that they are, and stay until the broker has them."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import queue
import sqlite3
import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from daqsvc.outbox.journal import Draft, Journal, OutboxError, OutboxMessage, is_corrupt

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock

    _Post: TypeAlias = Callable[..., None]

_T = TypeVar("_T")

__all__ = ["Outbox", "OutboxCounters", "OutboxError", "OutboxMessage"]

log = logging.getLogger(__name__)

MARK_LINGER_S = 0.05
"""How long a mark may wait for company: nobody waits for it, and each commit costs the disk a sync."""

RETRY_FIRST_S, RETRY_MOST_S = 0.1, 5.0


@dataclass(slots=True)
class OutboxCounters:
    """What the outbox has done since it was opened.

    Attributes:
        appended: messages committed.
        sent: messages that the broker has acknowledged.
        depth: messages on disk that the broker has not acknowledged.
        waiting: messages in memory that are not on disk yet.
        write_errors: transactions that failed and were tried again.
        quarantined: corrupt files set aside.
        lost: messages that never reached the disk because the outbox was closed while it could not write.
    """

    appended: int = 0
    sent: int = 0
    depth: int = 0
    waiting: int = 0
    write_errors: int = 0
    quarantined: int = 0
    lost: int = 0


@dataclass(slots=True)
class _Batch:
    """What one turn of the writer does."""

    drafts: list[tuple[Draft, asyncio.Future[int]]] = field(default_factory=list)
    sent: list[int] = field(default_factory=list)
    reads: list[tuple[Callable[[], Any], asyncio.Future[Any]]] = field(default_factory=list)

    def is_urgent(self) -> bool:
        """Whether somebody waits for it."""
        return bool(self.drafts or self.reads)

    def add(self, other: _Batch) -> None:
        self.drafts += other.drafts
        self.sent += other.sent
        self.reads += other.reads


class Outbox:
    """Messages to the broker, durable in the order in which they were appended.

    All of SQLite happens on one thread of its own. Messages that arrive while a commit is on its way to
    the disk go together with the next one, so a message waits for two syncs at most and a burst shares
    one. If the disk is full or fails, messages wait in memory and are tried again until it works.

    Use it from one event loop; ``open`` before anything else, ``close`` at the end.

    Args:
        path: the SQLite file, e.g. ``/var/lib/daqsvc/outbox.sqlite``.
        clock: for the start of a new file's sequence numbers.
        keep_sent: how many messages to keep as a journal after they are sent.
    """

    def __init__(self, path: Path, clock: Clock, *, keep_sent: int = 100_000) -> None:
        self.counters = OutboxCounters()
        self._journal = Journal(path, clock.wall_ns, keep_sent)
        self._work: queue.SimpleQueue[_Batch] = queue.SimpleQueue()
        self._closing = threading.Event()
        self._committed = asyncio.Event()
        self._last_sequence = 0
        self._ended: asyncio.Future[None] | None = None

    async def open(self) -> None:
        """Open the file, check it, and start the writer.

        Raises:
            OutboxError: the directory or file cannot be used.
        """
        loop = asyncio.get_running_loop()
        opened: asyncio.Future[int] = loop.create_future()
        self._ended = loop.create_future()
        threading.Thread(
            target=self._run, args=(loop, opened, self._ended), name="outbox-writer", daemon=True
        ).start()
        self.counters.depth = await opened
        self.counters.quarantined = self._journal.quarantined

    async def append(self, topic: str, payload_of_sequence: Callable[[int], bytes], *, retain: bool) -> int:
        """Append a message and wait until it is on disk.

        Args:
            topic: MQTT topic.
            payload_of_sequence: builds the payload from the message's sequence number; called on the
                writer's thread, and once more for each time that a commit has failed.
            retain: whether the broker shall keep it as the latest of its topic.

        Returns:
            The sequence number.

        Raises:
            OutboxError: the outbox is closed, or was closed while it could not write.
        """
        return await self.submit(topic, payload_of_sequence, retain=retain)

    def submit(
        self, topic: str, payload_of_sequence: Callable[[int], bytes], *, retain: bool
    ) -> asyncio.Future[int]:
        """Like `append`, but takes its place in the order at once and does not wait for the disk."""
        done: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self._put(_Batch(drafts=[(Draft(topic, payload_of_sequence, retain), done)]))
        self.counters.waiting += 1
        return done

    def mark_sent(self, sequence: int) -> None:
        """The broker has acknowledged this message; on disk within the next 50 ms or commit.

        A crash in between only sends the message again, with the same number.
        """
        self._put(_Batch(sent=[sequence]))

    async def pending(self, after: int, limit: int) -> list[OutboxMessage]:
        """Messages above ``after`` that the broker has not acknowledged, in order, at most ``limit``."""
        return await self._read(lambda: self._journal.pending(after, limit))

    async def retained(self) -> list[OutboxMessage]:
        """The latest retained message of each topic, where the broker has acknowledged it, in order."""
        return await self._read(self._journal.retained)

    async def latest(self) -> list[OutboxMessage]:
        """The latest retained message of each topic, whether it is sent or not, in order."""
        return await self._read(self._journal.latest)

    async def next_pending(self, after: int, limit: int) -> list[OutboxMessage]:
        """Like `pending`, but waits until there is at least one."""
        while True:
            newest = self._last_sequence
            messages = await self.pending(after, limit)
            if messages:
                return messages
            while self._last_sequence == newest:
                self._committed.clear()
                await self._committed.wait()

    async def close(self, timeout_s: float = 1.0) -> None:
        """Write what waits, once, and close the file; takes at most ``timeout_s``."""
        if self._ended is None or self._closing.is_set():
            return
        self._closing.set()
        self._work.put(_Batch())
        try:
            await asyncio.wait_for(asyncio.shield(self._ended), timeout_s)
        except TimeoutError:
            log.error(  # noqa: TRY400  the message says it all
                "outbox %s did not close within %.1f s; %d messages may not be on disk",
                self._journal.path,
                timeout_s,
                self.counters.waiting,
            )

    async def _read(self, query: Callable[[], _T]) -> _T:
        answer: asyncio.Future[_T] = asyncio.get_running_loop().create_future()
        self._put(_Batch(reads=[(query, answer)]))
        return await answer

    def _put(self, batch: _Batch) -> None:
        if self._ended is None or self._closing.is_set():
            state = "is not open yet" if self._ended is None else "is closed"
            raise OutboxError(f"outbox {self._journal.path} {state}; messages can only pass while it is open")
        self._work.put(batch)

    # On the event loop, called by the writer.

    def _settle_drafts(
        self,
        outcomes: list[tuple[asyncio.Future[int], int | Exception]],
        marked: int,
        last_sequence: int,
    ) -> None:
        for done, outcome in outcomes:
            self.counters.waiting -= 1
            if isinstance(outcome, Exception):
                _fail(done, outcome)
                continue
            self.counters.appended += 1
            self.counters.depth += 1
            _succeed(done, outcome)
        self.counters.sent += marked
        self.counters.depth -= marked
        self._last_sequence = last_sequence
        self._committed.set()

    def _settle_loss(self, drafts: list[asyncio.Future[int]], error: OutboxError) -> None:
        for done in drafts:
            self.counters.waiting -= 1
            self.counters.lost += 1
            _fail(done, error)

    def _settle_quarantine(self) -> None:
        self.counters.quarantined = self._journal.quarantined
        self.counters.depth = 0

    def _settle_write_error(self) -> None:
        self.counters.write_errors += 1

    # On the writer's thread.

    def _run(
        self, loop: asyncio.AbstractEventLoop, opened: asyncio.Future[int], ended: asyncio.Future[None]
    ) -> None:
        def post(function: Callable[..., object], *args: object) -> None:
            # A loop that is closed already has nobody left who would wait for the answer.
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(function, *args)

        try:
            try:
                self._journal.open()
                unsent = self._journal.unsent()
            except (OutboxError, sqlite3.Error) as error:
                post(_fail, opened, error)
                return
            self._last_sequence = self._journal.last_sequence
            post(_succeed, opened, unsent)
            self._serve(post)
        finally:
            self._journal.close()
            post(_succeed, ended, None)

    def _serve(self, post: _Post) -> None:
        batch = _Batch()
        retry_s = RETRY_FIRST_S
        failing = False
        while True:
            self._gather(batch, wait=not failing)
            try:
                self._perform(batch, post)
            except (sqlite3.Error, OSError) as error:
                post(self._settle_write_error)
                if self._closing.is_set():
                    self._abandon(batch, error, post)
                    return
                if not failing:
                    failing = True
                    log.error(  # noqa: TRY400  the message says it all
                        "outbox %s cannot be written: %s; messages wait in memory until it can",
                        self._journal.path,
                        error,
                    )
                self._recover(error, post)
                self._closing.wait(retry_s)
                retry_s = min(2 * retry_s, RETRY_MOST_S)
                continue
            if failing:
                failing = False
                retry_s = RETRY_FIRST_S
                log.warning("outbox %s can be written again", self._journal.path)
            if self._closing.is_set() and self._work.empty():
                return

    def _gather(self, batch: _Batch, *, wait: bool) -> None:
        """Add what has arrived; marks alone wait for company for a while."""
        if wait:
            batch.add(self._work.get())
        until = time.monotonic() + MARK_LINGER_S
        while True:
            linger_s = until - time.monotonic()
            patient = wait and not batch.is_urgent() and not self._closing.is_set() and linger_s > 0
            try:
                batch.add(self._work.get(timeout=linger_s) if patient else self._work.get_nowait())
            except queue.Empty:
                return

    def _perform(self, batch: _Batch, post: _Post) -> None:
        """Commit, then read. What is done is taken out of the batch, so that it can be tried again."""
        if batch.drafts or batch.sent:
            outcomes, marked = self._journal.commit([draft for draft, _ in batch.drafts], batch.sent)
            settled = [(done, outcome) for (_, done), outcome in zip(batch.drafts, outcomes, strict=True)]
            batch.drafts, batch.sent = [], []
            post(self._settle_drafts, settled, marked, self._journal.last_sequence)
        while batch.reads:
            query, answer = batch.reads[0]
            post(_succeed, answer, query())
            batch.reads.pop(0)

    def _recover(self, error: Exception, post: _Post) -> None:
        """A file that has become corrupt is set aside; anything else is only tried again."""
        if not (isinstance(error, sqlite3.DatabaseError) and is_corrupt(error)):
            return
        try:
            self._journal.quarantine(error)
        except (sqlite3.Error, OSError) as again:
            log.error("outbox %s cannot be replaced: %s", self._journal.path, again)  # noqa: TRY400
        post(self._settle_quarantine)

    def _abandon(self, batch: _Batch, error: Exception, post: _Post) -> None:
        failure = OutboxError(
            f"outbox {self._journal.path} was closed while it could not be written: {error}"
        )
        post(self._settle_loss, [done for _, done in batch.drafts], failure)
        for _, answer in batch.reads:
            post(_fail, answer, failure)
        if batch.drafts:
            log.error("outbox %s lost %d messages: %s", self._journal.path, len(batch.drafts), error)


def _succeed(future: asyncio.Future[_T], result: _T) -> None:
    if not future.done():
        future.set_result(result)


def _fail(future: asyncio.Future[Any], error: Exception) -> None:
    if not future.done():
        future.set_exception(error)
