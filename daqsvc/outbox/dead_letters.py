"""Messages that the broker will not take: kept on disk, out of the way of all others, to be tried again.

Once a message on a topic is here, those that follow on the same topic come here too, so that each alarm's
events stay in their order. Everything happens in a separate file, which is opened for each of the few
things that are done with it.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar

from daqsvc.errors.code import coded
from daqsvc.errors.outputs import TOPIC_REFUSED
from daqsvc.errors.service import JOURNAL_DAMAGED
from daqsvc.outbox.files import FileError, NewerFileError, connect, is_corrupt, put_by, refuse_newer
from daqsvc.outbox.messages import OutboxError, OutboxMessage, checksum, is_sound
from daqsvc.outbox.rescue import finish, rescue

if TYPE_CHECKING:
    import sqlite3
    from collections.abc import Callable, Mapping
    from pathlib import Path

_P = ParamSpec("_P")
_T = TypeVar("_T")

log = logging.getLogger(__name__)

MOST_OF_A_TOPIC = 1000
"""Letters of one topic that are kept; beyond that the oldest are dropped, counted, and that is logged."""

SCHEMA_VERSION = 0
"""What SQLite gives to a file without a version; changes of the table count from here."""

_REASON_LETTERS = 300

_TABLE = """
CREATE TABLE IF NOT EXISTS letters (
    sequence INTEGER PRIMARY KEY, topic TEXT NOT NULL, payload BLOB NOT NULL, retain INTEGER NOT NULL,
    reason TEXT NOT NULL, wall_ns INTEGER NOT NULL, checksum INTEGER NOT NULL
)
"""


class DeadLetters:
    """What the broker refuses.

    Use it from one event loop.

    Args:
        path: the SQLite file; made when it is needed first.
        wall_ns: wall clock, ns since the Unix epoch.

    Attributes:
        waiting: how many letters there are.
        dropped: how many of them were dropped because there were too many of a topic, or a file was damaged.
    """

    def __init__(self, path: Path, wall_ns: Callable[[], int]) -> None:
        self.waiting = 0
        self.dropped = 0
        self._path = path
        self._wall_ns = wall_ns
        self._reasons: Mapping[str, str] = {}
        self._lock = asyncio.Lock()
        self._loaded = False

    @property
    def is_known(self) -> bool:
        """Whether the file has been read since the start, so that `reasons` are all there are."""
        return self._loaded

    @property
    def reasons(self) -> Mapping[str, str]:
        """By topic, why the broker will not take its messages."""
        return MappingProxyType(dict(self._reasons))

    async def load(self) -> None:
        """Look what an earlier run has left.

        Raises:
            OutboxError: the file cannot be read.
        """
        if not self._loaded:
            await self._do(_nothing)

    async def put(self, message: OutboxMessage, reason: str) -> None:
        """Keep a message that was refused; on disk when this returns.

        Raises:
            OutboxError: the file cannot be written.
        """
        await self._do(self._insert, message, reason)

    async def hold(self, message: OutboxMessage) -> bool:
        """Keep a message if others of its topic are here; whether they are.

        Raises:
            OutboxError: the file cannot be written.
        """
        return message.topic in self._reasons and await self._do(self._insert_behind, message)

    async def oldest(self, topic: str) -> OutboxMessage | None:
        """The first letter of a topic.

        Raises:
            OutboxError: the file cannot be read.
        """
        return await self._do(_oldest, topic)

    async def remove(self, message: OutboxMessage) -> None:
        """Forget a letter that the broker has taken.

        Raises:
            OutboxError: the file cannot be written.
        """
        await self._do(_delete, message.sequence)

    async def overtake(self, message: OutboxMessage) -> None:
        """A later message of a topic was taken: those before must not become the topic's latest any more.

        Raises:
            OutboxError: the file cannot be written.
        """
        if message.topic in self._reasons:
            await self._do(_overtake, message)

    async def _do(
        self, work: Callable[Concatenate[sqlite3.Connection, _P], _T], *args: _P.args, **options: _P.kwargs
    ) -> _T:
        async with self._lock:
            task = asyncio.ensure_future(asyncio.to_thread(lambda: self._work(work, *args, **options)))
            try:
                return await asyncio.shield(task)
            except asyncio.CancelledError:
                await asyncio.wait({task})  # what is begun is ended, and known
                if not task.cancelled():
                    task.exception()
                raise

    # On a thread.

    def _work(
        self, work: Callable[Concatenate[sqlite3.Connection, _P], _T], *args: _P.args, **options: _P.kwargs
    ) -> _T:
        try:
            try:
                return self._with_file(work, *args, **options)
            except NewerFileError as newer:
                put_by(self._path, newer.version, self._wall_ns())
                return self._with_file(work, *args, **options)
            except FileError as error:
                if not is_corrupt(error):
                    raise
                self._set_aside(error)
                return self._with_file(work, *args, **options)
        except FileError as error:
            raise OutboxError(f"the refused messages in {self._path} cannot be kept: {error}") from error

    def _with_file(
        self, work: Callable[Concatenate[sqlite3.Connection, _P], _T], *args: _P.args, **options: _P.kwargs
    ) -> _T:
        finish(self._path, self._wall_ns())
        with contextlib.closing(connect(self._path, synchronous="FULL")) as connection:
            refuse_newer(connection, SCHEMA_VERSION)
            connection.execute("BEGIN IMMEDIATE")
            connection.execute(_TABLE)
            result = work(connection, *args, **options)
            connection.execute("COMMIT")
            row = connection.execute(
                "SELECT topic, reason, count(*) FROM letters GROUP BY topic HAVING sequence = min(sequence)"
            ).fetchall()
        # A whole new one, for the event loop may be reading.
        self._reasons = {topic: reason for topic, reason, _ in row}
        self.waiting = sum(count for _, _, count in row)
        self._loaded = True
        return result

    def _set_aside(self, error: Exception) -> None:
        aside, count = rescue(self._path, "letters", _make, _is_row_sound, self._wall_ns())
        self.dropped += max(self.waiting - count, 0)
        log.error(
            "%s is damaged (%s) and set aside as %s; of the messages in it that the broker had refused, %d "
            "can be read and are kept",
            self._path,
            error,
            aside,
            count,
            extra=coded(JOURNAL_DAMAGED),
        )

    def _insert(self, connection: sqlite3.Connection, message: OutboxMessage, reason: str) -> None:
        m = message
        connection.execute(
            "INSERT OR IGNORE INTO letters VALUES (?, ?, ?, ?, ?, ?, ?)",
            (
                *(m.sequence, m.topic, m.payload, m.retain, reason[:_REASON_LETTERS], self._wall_ns()),
                checksum(m.sequence, m.topic, m.payload),
            ),
        )
        # The reason that counts is the latest; it stands with the first of the topic.
        connection.execute(
            """
            UPDATE letters SET reason = ?
            WHERE sequence = (SELECT min(sequence) FROM letters WHERE topic = ?)
            """,
            (reason[:_REASON_LETTERS], m.topic),
        )
        dropped = connection.execute(
            """
            DELETE FROM letters WHERE sequence IN
            (SELECT sequence FROM letters WHERE topic = ? ORDER BY sequence DESC LIMIT -1 OFFSET ?)
            """,
            (m.topic, MOST_OF_A_TOPIC),
        ).rowcount
        if dropped > 0:
            if not self.dropped:
                log.error(
                    "more than %d messages on %s are refused; the oldest are dropped and counted",
                    MOST_OF_A_TOPIC,
                    m.topic,
                    extra=coded(TOPIC_REFUSED),
                )
            self.dropped += dropped

    def _insert_behind(self, connection: sqlite3.Connection, message: OutboxMessage) -> bool:
        first = connection.execute(
            "SELECT reason FROM letters WHERE topic = ? ORDER BY sequence LIMIT 1", (message.topic,)
        ).fetchone()
        if first is not None:
            self._insert(connection, message, first[0])
        return first is not None


def _make(connection: sqlite3.Connection) -> None:
    connection.execute(_TABLE)


def _is_row_sound(row: tuple[Any, ...]) -> bool:
    sequence, topic, payload, retain, reason, wall_ns, check = row
    is_payload_sound = isinstance(check, int) and is_sound(sequence, topic, payload, check)
    return (
        is_payload_sound and isinstance(retain, int) and isinstance(reason, str) and isinstance(wall_ns, int)
    )


def _nothing(_connection: sqlite3.Connection) -> None:
    """Only look how many there are."""


def _oldest(connection: sqlite3.Connection, topic: str) -> OutboxMessage | None:
    while True:
        row = connection.execute(
            """
            SELECT sequence, topic, payload, retain, checksum FROM letters WHERE topic = ?
            ORDER BY sequence LIMIT 1
            """,
            (topic,),
        ).fetchone()
        if row is None:
            return None
        sequence, of, payload, retain, check = row
        if is_sound(sequence, of, payload, check):
            return OutboxMessage(sequence, of, payload, bool(retain))
        log.error(
            "refused message %s on %s has changed on the disk and is dropped",
            sequence,
            topic,
            extra=coded(JOURNAL_DAMAGED),
        )
        _delete(connection, sequence)


def _delete(connection: sqlite3.Connection, sequence: int) -> None:
    connection.execute("DELETE FROM letters WHERE sequence = ?", (sequence,))


def _overtake(connection: sqlite3.Connection, message: OutboxMessage) -> None:
    connection.execute(
        "UPDATE letters SET retain = 0 WHERE topic = ? AND sequence < ?", (message.topic, message.sequence)
    )
