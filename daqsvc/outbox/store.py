"""The outbox: alarms are on disk before anybody says that they are, and stay until the broker has them.

Telemetry is the lower class: it goes to a file of its own, unsynced, and may be dropped (see
`outbox.telemetry`).
"""

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

from daqsvc.outbox.counters import OutboxCounters, TelemetryCounters
from daqsvc.outbox.files import is_corrupt, is_full
from daqsvc.outbox.journal import Journal
from daqsvc.outbox.limits import OutboxLimits
from daqsvc.outbox.messages import Draft, OutboxError, OutboxMessage, TelemetryMessage
from daqsvc.outbox.telemetry import Telemetry

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock

    _Post: TypeAlias = Callable[..., None]

_T = TypeVar("_T")

__all__ = [
    "Outbox",
    "OutboxCounters",
    "OutboxError",
    "OutboxLimits",
    "OutboxMessage",
    "TelemetryCounters",
    "TelemetryMessage",
]

log = logging.getLogger(__name__)

MARK_LINGER_S = 0.05
"""How long a mark may wait for company: nobody waits for it, and each commit costs the disk a sync."""

RETRY_FIRST_S, RETRY_MOST_S = 0.1, 5.0

COMMIT_AT_MOST = 2000
"""Messages in one transaction, so that neither memory nor the write-ahead log grows with the backlog."""

READ_FAILURES_MAX = 3
"""Reads in a row that may fail before the file is given up as if it were corrupt."""


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


@dataclass(slots=True)
class _Failure:
    """What went wrong in one turn of the writer, if anything."""

    write: sqlite3.Error | OSError | None = None
    read: sqlite3.Error | None = None


class Outbox:
    """Messages to the broker, durable in the order in which they were appended.

    All of a file's SQLite happens on one thread. Messages that arrive while a commit is on its way to
    the disk go together with the next one, so a message waits for two syncs at most and a burst shares
    one. If the disk is full or fails, messages wait in memory and are tried again until it works; on a full
    one, telemetry gives way first, then messages that the broker has.

    Use it from one event loop; ``open`` before anything else, ``close`` at the end.

    Args:
        path: the SQLite file of the alarms, e.g. ``/var/lib/daqsvc/outbox.sqlite``; that of telemetry
            stands beside it, ``outbox-telemetry.sqlite``.
        clock: the service's clock.
        limits: how much is kept.
    """

    def __init__(self, path: Path, clock: Clock, limits: OutboxLimits | None = None) -> None:
        self.counters = OutboxCounters()
        self._limits = OutboxLimits() if limits is None else limits
        self._journal = Journal(path, clock.wall_ns, self._limits)
        self._telemetry = Telemetry(telemetry_path(path), clock, self._limits, self.counters.telemetry)
        self._work: queue.SimpleQueue[_Batch] = queue.SimpleQueue()
        self._closing = threading.Event()
        self._committed = asyncio.Event()
        self._last_sequence = 0
        self._refusing = False
        self._broken = ""
        self._ended: asyncio.Future[None] | None = None

    async def open(self) -> None:
        """Open the files, check them, and start their writers.

        Raises:
            OutboxError: the directory or the alarms' file cannot be used.
        """
        loop = asyncio.get_running_loop()
        opened: asyncio.Future[int] = loop.create_future()
        self._ended = loop.create_future()
        threading.Thread(
            target=self._run, args=(loop, opened, self._ended), name="outbox-writer", daemon=True
        ).start()
        self.counters.depth = await opened
        self.counters.quarantined = self._journal.quarantined
        self.counters.vanished = self._journal.vanished
        self._telemetry.start()

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
            OutboxError: the outbox is closed, was closed while it could not write, or too many messages wait
                for a disk that cannot be written.
        """
        return await self.submit(topic, payload_of_sequence, retain=retain)

    def submit(
        self, topic: str, payload_of_sequence: Callable[[int], bytes], *, retain: bool
    ) -> asyncio.Future[int]:
        """Like `append`, but takes its place in the order at once and does not wait for the disk."""
        done: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        if self.counters.waiting >= self._limits.alarms_waiting_max:
            self._refuse(done)
            return done
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

    def telemetry(self, topic: str, payload: bytes, *, expiry_s: float | None = None) -> None:
        """Take in a message of the lower class; never waits.

        It may be dropped: the oldest first if there is no room, or when it is too old. Each drop is counted.

        Args:
            topic: MQTT topic.
            payload: the bytes to publish.
            expiry_s: after this time it is of no use any more; None for the age limit of the outbox, which
                is the longest for any.

        Raises:
            OutboxError: the outbox is not open.
        """
        self._telemetry.put(topic, payload, expiry_s)

    async def pending_telemetry(self, after: int, limit: int) -> list[TelemetryMessage]:
        """Telemetry above number ``after`` that is not too old, in order, at most ``limit``."""
        return await self._telemetry.pending(after, limit)

    async def next_telemetry(self, after: int, limit: int) -> list[TelemetryMessage]:
        """Like `pending_telemetry`, but waits until there is at least one."""
        return await self._telemetry.next(after, limit)

    def mark_telemetry_sent(self, number: int) -> None:
        """The broker has taken this message of telemetry: it is deleted, soon."""
        self._telemetry.mark_sent(number)

    async def close(self, timeout_s: float = 1.0) -> None:
        """Write what waits, once, and close the files; takes at most ``timeout_s``."""
        if self._ended is None or self._closing.is_set():
            return
        self._closing.set()
        self._work.put(_Batch())
        await asyncio.gather(self._telemetry.close(timeout_s), self._close_journal(timeout_s))

    async def _close_journal(self, timeout_s: float) -> None:
        if self._ended is None:
            return
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
        if self._ended is None or self._closing.is_set() or self._broken:
            state = "is not open yet" if self._ended is None else "is closed"
            raise OutboxError(
                f"outbox {self._journal.path} {self._broken or state}; "
                "messages can only pass while it is open"
            )
        self._work.put(batch)

    def _refuse(self, done: asyncio.Future[int]) -> None:
        self.counters.refused += 1
        if not self._refusing:
            self._refusing = True
            log.error(
                "outbox %s: %d messages wait for the disk, no more are taken until it can be written; "
                "alarms are being lost: make room on the disk or replace it",
                self._journal.path,
                self.counters.waiting,
            )
        done.set_exception(
            OutboxError(
                f"outbox {self._journal.path} cannot be written and {self.counters.waiting} messages wait "
                "already; this one is refused"
            )
        )

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
        self._refusing = False
        self._committed.set()

    def _settle_loss(self, drafts: list[asyncio.Future[int]], error: OutboxError) -> None:
        for done in drafts:
            self.counters.waiting -= 1
            self.counters.lost += 1
            _fail(done, error)

    def _settle_quarantine(self, unsent: int) -> None:
        self.counters.quarantined = self._journal.quarantined
        self.counters.depth = unsent

    def _settle_failure(self, failure: _Failure) -> None:
        self.counters.write_errors += failure.write is not None
        self.counters.read_errors += failure.read is not None

    def _settle_end(self, reason: str) -> None:
        self._broken = reason

    # On the writer's thread.

    def _run(
        self, loop: asyncio.AbstractEventLoop, opened: asyncio.Future[int], ended: asyncio.Future[None]
    ) -> None:
        def post(function: Callable[..., object], *args: object) -> None:
            # A loop that is closed already has nobody left who would wait for the answer.
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(function, *args)

        batch = _Batch()
        try:
            try:
                self._journal.hold()
                self._telemetry.file.give_way()
                self._journal.open()
                unsent = self._journal.unsent()
            except (OutboxError, sqlite3.Error) as error:
                post(_fail, opened, error)
                return
            self._last_sequence = self._journal.last_sequence
            post(_succeed, opened, unsent)
            self._serve(batch, post)
        except BaseException as error:
            # A mistake in this program. Whoever waits must hear of it, and nobody may wait in vain.
            post(self._settle_end, f"has stopped: {error!r}")
            self._gather(batch, wait=False)
            self._abandon(batch, error, post)
            raise
        finally:
            self._journal.close()
            post(_succeed, ended, None)

    def _serve(self, batch: _Batch, post: _Post) -> None:
        retry_s = RETRY_FIRST_S
        reported: Exception | None = None
        failed_reads = 0
        while True:
            self._gather(batch, wait=reported is None)
            failure = self._perform(batch, post)
            error = failure.write or failure.read
            if error is None:
                if reported is not None:
                    reported = None
                    log.warning("outbox %s can be used again", self._journal.path)
                retry_s, failed_reads = RETRY_FIRST_S, 0
                if self._closing.is_set() and self._work.empty():
                    return
                continue
            post(self._settle_failure, failure)
            if self._closing.is_set():
                self._abandon(batch, error, post)
                return
            failed_reads = 0 if failure.read is None else failed_reads + 1
            if reported is None:
                reported = error
                log.error(
                    "outbox %s cannot be %s: %s; messages wait in memory until it can",
                    self._journal.path,
                    "written" if failure.write else "read",
                    error,
                )
            if not self._recover(error, post, give_up=failed_reads >= READ_FAILURES_MAX):
                self._closing.wait(retry_s)
                retry_s = min(2 * retry_s, RETRY_MOST_S)

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

    def _perform(self, batch: _Batch, post: _Post) -> _Failure:
        """Commit, then read, even if the former failed. What is done is taken out of the batch."""
        failure = _Failure()
        try:
            while batch.drafts or batch.sent:
                self._commit(batch, post)
        except (sqlite3.Error, OSError) as error:
            failure.write = error
        try:
            while batch.reads:
                query, answer = batch.reads[0]
                post(_succeed, answer, query())
                batch.reads.pop(0)
        except sqlite3.Error as error:
            failure.read = error
        return failure

    def _commit(self, batch: _Batch, post: _Post) -> None:
        now = batch.drafts[:COMMIT_AT_MOST]
        outcomes, marked = self._journal.commit([draft for draft, _ in now], batch.sent)
        settled = [(done, outcome) for (_, done), outcome in zip(now, outcomes, strict=True)]
        batch.drafts, batch.sent = batch.drafts[COMMIT_AT_MOST:], []
        post(self._settle_drafts, settled, marked, self._journal.last_sequence)

    def _recover(self, error: Exception, post: _Post, *, give_up: bool) -> bool:
        """Do something about a failure; whether it is worth trying again at once.

        A corrupt file is set aside, and so is one that cannot be read time and again. On a full disk, what
        the broker has makes room.
        """
        try:
            if isinstance(error, sqlite3.DatabaseError) and (give_up or is_corrupt(error)):
                self._journal.quarantine(error)
                post(self._settle_quarantine, self._journal.unsent())
                return True
            if is_full(error):
                return self._journal.make_room() > 0
        except (sqlite3.Error, OSError) as again:
            if not is_full(again):
                log.error("outbox %s cannot be recovered: %s", self._journal.path, again)  # noqa: TRY400
        return False

    def _abandon(self, batch: _Batch, error: BaseException, post: _Post) -> None:
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


def telemetry_path(path: Path) -> Path:
    """Where telemetry is kept beside the alarms' file ``path``."""
    return path.with_name(f"{path.stem}-telemetry{path.suffix}")
