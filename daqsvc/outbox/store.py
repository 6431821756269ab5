"""The outbox: alarms are on disk before anybody states that they are, and stay until the broker has them.

Telemetry is the lower class: it goes to a separate file, unsynced, and may be dropped (see
`outbox.telemetry`).
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
from typing import TYPE_CHECKING, TypeVar

from daqsvc.errors.code import coded
from daqsvc.errors.service import DISK_REFUSES
from daqsvc.outbox.command_ids import CommandIds
from daqsvc.outbox.counters import OutboxCounters, TelemetryCounters
from daqsvc.outbox.dead_letters import DeadLetters
from daqsvc.outbox.journal import Journal
from daqsvc.outbox.limits import OutboxLimits
from daqsvc.outbox.messages import Draft, OutboxError, OutboxMessage, TelemetryMessage, new_series
from daqsvc.outbox.reading import read_journal
from daqsvc.outbox.telemetry import Telemetry
from daqsvc.outbox.writer import Batch, JournalWriter, fail, succeed

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock
    from daqsvc.outbox.writer import Failure
    from daqsvc.supervision import Progress

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

LOOK_S = 0.25
"""How often to look whether the writer of the alarms still lives."""


class Outbox:
    """Messages to the broker, durable in the order in which they were appended.

    All of a file's SQLite happens on one thread. Messages that arrive while a commit is on its way to
    the disk go together with the next one, so a message waits for two syncs at most and a burst shares
    one. If the disk is full or fails, messages wait in memory, can be read from there like all others, and
    are tried again until it works. On a full one, telemetry gives way first, then messages that the broker
    has.

    Use it from one event loop; ``open`` before anything else, ``close`` at the end.

    Beside the journal it has, in their own files, the messages that the broker refuses (`dead_letters`)
    and the ids of the commands that have come (`command_ids`).

    Args:
        path: the SQLite file of the alarms, e.g. ``/var/lib/daqsvc/outbox.sqlite``; that of telemetry
            is beside it, ``outbox-telemetry.sqlite``.
        clock: the service's clock.
        limits: how much is kept.

    Attributes:
        counters: what was done so far.
        series: what the ids of new messages begin with (see `outbox.messages.event_id`).
        command_ids_lost: whether ids of commands that had come were gone at the start.
    """

    def __init__(self, path: Path, clock: Clock, limits: OutboxLimits | None = None) -> None:
        self.series = new_series()
        self.counters = OutboxCounters()
        self.directory = path.parent
        self.command_ids_lost = False
        self._clock = clock
        self.command_ids = CommandIds(path.with_name("command-ids"))
        self.dead_letters = DeadLetters(path.with_name(f"{path.stem}-refused{path.suffix}"), clock.wall_ns)
        self._limits = OutboxLimits() if limits is None else limits
        self._journal = Journal(path, clock.wall_ns, self._limits, self.command_ids.begin)
        self._telemetry = Telemetry(telemetry_path(path), clock, self._limits, self.counters.telemetry)
        self._telemetry.file.is_ours = lambda: self._journal.is_held
        self._books = _Books(self.counters, self._journal)
        self._writer = JournalWriter(self._journal, self._books, self._telemetry.file.give_way)
        self._ended: asyncio.Future[None] | None = None

    @property
    def known_topics(self) -> frozenset[str] | None:
        """Topics that ever had a retained message; None if they are not known, because of damage."""
        return self._journal.known_topics

    @property
    def has_set_aside(self) -> bool:
        """Whether damage of this run or the last has left files named ``*.corrupt-*``."""
        telemetry = self.counters.telemetry
        return bool(self.counters.quarantined or telemetry.quarantined or self._journal.set_aside)

    async def open(self) -> None:
        """Open the files, check them, and start their writers.

        A disk that is full, takes no writes or fails is no reason not to start: messages wait in memory
        until the journal can be opened; `OutboxCounters.shut` states it.

        Raises:
            OutboxError: the directory or the alarms' file cannot be used, and that will not pass by itself.
        """
        # In a directory that this account may not search, the writer states what is wrong.
        is_new = not await asyncio.to_thread(os.path.lexists, self._journal.path)
        begun_ns = self._clock.wall_ns()
        opened, self._ended = self._writer.start()
        unsent = await opened
        self.command_ids_lost = await asyncio.to_thread(self.command_ids.open, begun_ns, is_new=is_new)
        if unsent is None:
            self.counters.shut = 1
        else:
            self._books.opened(unsent)
        self._telemetry.start()

    async def glimpse(self) -> list[OutboxMessage] | None:
        """`latest` of a journal that cannot be opened for now; None if it cannot even be examined."""
        try:
            return await asyncio.to_thread(_latest_of, self._journal.path)
        except (OutboxError, OSError) as error:
            log.error("what the alarms were cannot be read yet: %s", error, extra=coded(DISK_REFUSES))  # noqa: TRY400
            return None

    @property
    def broker_is_ahead(self) -> bool:
        """Whether an earlier run may have sent to the broker what the journal never got.

        Until `damage_is_reported`, which states that the broker has received the state of everything by now.
        """
        return self._journal.was_ahead

    def damage_is_reported(self) -> None:
        """The damage of the journal is reported: not again after a restart."""
        self._put(
            Batch(reads=[(self._journal.damage_is_reported, asyncio.get_running_loop().create_future())])
        )

    async def append(self, topic: str, payload_of_sequence: Callable[[int], bytes], *, retain: bool) -> int:
        """Append a message and wait until it is on disk.

        If the disk takes no writes, the broker may have it before. If that goes on for very long, the journal
        gives up messages that the broker has and a later one has overtaken: then this returns, too.

        Args:
            topic: MQTT topic.
            payload_of_sequence: builds the payload from the message's sequence number; called on the
                writer's thread, and once more for each time that a commit has failed.
            retain: whether the broker keeps it as the latest of its topic.

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
            done.set_exception(self._books.refusal())
            return done
        self._put(Batch(drafts=[(Draft(topic, payload_of_sequence, retain), done)]))
        self.counters.waiting += 1
        return done

    def mark_sent(self, *sequences: int) -> None:
        """The broker has acknowledged these messages; on disk within the next 50 ms or commit, if it works.

        A crash in between only sends them again, with the same numbers.
        """
        self._refuse_unless_open()
        self._writer.mark(sequences)

    async def pending(self, after: int, limit: int) -> list[OutboxMessage]:
        """Messages above ``after`` that the broker has not acknowledged, in order, at most ``limit``."""
        return await self._read(lambda: self._journal.pending(after, limit))

    async def oldest_wall_ns(self) -> int | None:
        """When the oldest event happened that the broker has not acknowledged; None if there is none.

        By the payload, ns since the Unix epoch; None also for one that does not state it.
        """
        for message in await self.pending(0, 1) if self.counters.depth or self.counters.waiting else ():
            with contextlib.suppress(ValueError, KeyError, TypeError):
                return int(json.loads(message.payload)["wall_ns"])
        return None

    async def retained(self) -> list[OutboxMessage]:
        """The latest retained message of each topic, where the broker has acknowledged it, in order."""
        return await self._read(self._journal.retained)

    async def latest(self) -> list[OutboxMessage]:
        """The latest retained message of each topic, whether it is sent or not, in order."""
        return await self._read(self._journal.latest)

    async def next_pending(self, after: int, limit: int) -> list[OutboxMessage]:
        """Like `pending`, but waits until there is at least one."""
        return await self._next(self.pending, after, limit)

    async def following(self, after: int, limit: int) -> list[OutboxMessage]:
        """Messages above ``after`` that are still kept, sent or not, in order, at most ``limit``."""
        return await self._read(lambda: self._journal.following(after, limit))

    async def next_following(self, after: int, limit: int) -> list[OutboxMessage]:
        """Like `following`, but waits until there is at least one."""
        return await self._next(self.following, after, limit)

    async def _next(
        self, read: Callable[[int, int], Awaitable[list[OutboxMessage]]], after: int, limit: int
    ) -> list[OutboxMessage]:
        while True:
            newest = self._books.last_sequence
            messages = await read(after, limit)
            if messages:
                return messages
            await self._books.news(newest)

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

    async def until_broken(self) -> str:
        """Wait until the thread that writes the alarms has ended by itself; why, in a sentence."""
        # A thread that has ended reports nothing.
        while self._ended is None or self._writer.is_closing or self._writer.is_alive:  # noqa: ASYNC110
            await asyncio.sleep(LOOK_S)
        why = self._books.broken or "has stopped: its thread was lost"
        return f"outbox {self._journal.path} {why}; no alarm can reach the disk any more"

    @property
    def progress(self) -> Progress:
        """How far the thread that writes the alarms has come."""
        return self._writer.progress

    def close_from_outside(self, timeout_s: float) -> bool:
        """Like `close`, but from any thread, and of the alarms only: the way out if the event loop hangs.

        Blocks for at most ``timeout_s``; whether the file is closed.
        """
        if self._ended is None:
            return True
        self._writer.close()
        return self._writer.join(timeout_s)

    async def close(self, timeout_s: float = 30.0) -> None:
        """Write what waits, once, and close the files; takes at most ``timeout_s``."""
        if self._ended is None or self._writer.is_closing:
            return
        self._writer.close()
        await asyncio.gather(self._telemetry.close(timeout_s), self._close_journal(timeout_s))

    async def _close_journal(self, timeout_s: float) -> None:
        if self._ended is None:
            return
        try:
            await asyncio.wait_for(asyncio.shield(self._ended), timeout_s)
        except TimeoutError:
            log.error(  # noqa: TRY400  the message is enough
                "outbox %s did not close within %.1f s; %d messages may not be on disk",
                self._journal.path,
                timeout_s,
                self.counters.waiting,
                extra=coded(DISK_REFUSES),
            )

    async def _read(self, query: Callable[[], _T]) -> _T:
        answer: asyncio.Future[_T] = asyncio.get_running_loop().create_future()
        self._put(Batch(reads=[(query, answer)]))
        return await answer

    def _put(self, batch: Batch) -> None:
        self._refuse_unless_open()
        self._writer.put(batch)

    def _refuse_unless_open(self) -> None:
        if self._ended is None or self._writer.is_closing or self._books.broken:
            state = "is not open yet" if self._ended is None else "is closed"
            raise OutboxError(
                f"outbox {self._journal.path} {self._books.broken or state}; "
                "messages can only pass while it is open"
            )


class _Books:
    """What the writer reports, counted and passed on to those who wait; on the event loop."""

    def __init__(self, counters: OutboxCounters, journal: Journal) -> None:
        self.last_sequence = 0
        self.broken = ""
        self._counters = counters
        self._journal = journal
        self._refusing = False
        self._arrived = asyncio.Event()

    async def news(self, newest: int) -> None:
        """Wait until there is a message after ``newest``."""
        while self.last_sequence == newest:
            self._arrived.clear()
            await self._arrived.wait()

    def refusal(self) -> OutboxError:
        """Count a message that is refused, log it once as an error, and give the reason."""
        waiting = self._counters.waiting
        self._counters.refused += 1
        if not self._refusing:
            self._refusing = True
            log.error(
                "outbox %s: %d messages wait for the disk, no more are taken until it can be written; "
                "alarms are being lost: make room on the disk or replace it",
                self._journal.path,
                waiting,
                extra=coded(DISK_REFUSES),
            )
        return OutboxError(
            f"outbox {self._journal.path} cannot be written and {waiting} messages wait already; "
            "this one is refused"
        )

    def committed(
        self,
        outcomes: Sequence[tuple[asyncio.Future[int], int | Exception]],
        marked: int,
        last_sequence: int,
    ) -> None:
        """See `Reports.committed`."""
        for done, outcome in outcomes:
            self._counters.waiting -= 1
            if isinstance(outcome, Exception):
                fail(done, outcome)
                continue
            self._counters.appended += 1
            self._counters.depth += 1
            succeed(done, outcome)
        self._counters.sent += marked
        self._counters.depth -= marked
        self.last_sequence = last_sequence
        self._refusing = False
        self._arrived.set()

    def shown(self, last_sequence: int) -> None:
        """See `Reports.shown`."""
        self._counters.unbacked = 1
        self.last_sequence = last_sequence
        self._arrived.set()

    def backed(self) -> None:
        """See `Reports.backed`."""
        self._counters.unbacked = 0

    def acknowledged(self, from_memory: int, given_up: Sequence[tuple[asyncio.Future[int], int]]) -> None:
        """See `Reports.acknowledged`."""
        self._counters.sent_unbacked += from_memory
        self._counters.unjournalled += len(given_up)
        for done, number in given_up:
            self._counters.waiting -= 1
            succeed(done, number)

    def abandoned(
        self, lost: Sequence[asyncio.Future[int]], accepted: Sequence[asyncio.Future[int]], error: OutboxError
    ) -> None:
        """See `Reports.abandoned`."""
        self._counters.lost += len(lost)
        self._counters.unjournalled += len(accepted)
        for done in (*lost, *accepted):
            self._counters.waiting -= 1
            fail(done, error)

    def opened(self, unsent: int) -> None:
        """See `Reports.opened`."""
        self._counters.shut = 0
        self._counters.depth = unsent
        self._counters.quarantined = self._journal.quarantined
        self._counters.vanished = self._journal.vanished
        self.last_sequence = self._journal.last_sequence
        self._arrived.set()

    def replaced(self, unsent: int) -> None:
        """See `Reports.replaced`."""
        self._counters.quarantined = self._journal.quarantined
        self._counters.depth = unsent

    def failed(self, failure: Failure) -> None:
        """See `Reports.failed`."""
        self._counters.write_errors += failure.write is not None
        self._counters.read_errors += failure.read is not None

    def stopped(self, reason: str) -> None:
        """See `Reports.stopped`."""
        self.broken = reason


def _latest_of(path: Path) -> list[OutboxMessage]:
    """The latest retained message of each topic, of a journal that nobody has open; none of a new one."""
    if not path.exists() or not path.stat().st_size:
        return []
    view = read_journal(path.parent, history=0)
    return [OutboxMessage(e.sequence, e.topic, e.payload, e.retain) for e in view.latest]


def telemetry_path(path: Path) -> Path:
    """Where telemetry is kept beside the alarms' file ``path``."""
    return path.with_name(f"{path.stem}-telemetry{path.suffix}")
