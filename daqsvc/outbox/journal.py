"""The SQLite file of the outbox: synchronous, used by one thread.

Sequence numbers are never used twice on a box. A healthy file knows its highest number
(``AUTOINCREMENT``). A new file, be it the first or the successor of a corrupt one, starts above both

- the wall clock in milliseconds since 1970, far above any number that was counted up from an earlier
  start, and
- the mark in the side file ``<name>.sequence``, which is always ahead of what was used, in case the
  wall clock was set back.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import sqlite3
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path
    from typing import BinaryIO

log = logging.getLogger(__name__)

SCHEMA_VERSION = 1
MARK_STEP = 1024
TRIM_EVERY = 1000
NS_PER_MS = 1_000_000

_SCHEMA = """
CREATE TABLE messages (
    sequence INTEGER PRIMARY KEY AUTOINCREMENT,
    topic TEXT NOT NULL,
    payload BLOB NOT NULL,
    retain INTEGER NOT NULL,
    sent INTEGER NOT NULL DEFAULT 0
);
CREATE INDEX unsent ON messages (sequence) WHERE NOT sent;
CREATE INDEX retained ON messages (topic, sequence) WHERE retain;
"""

_LATEST = "(SELECT max(sequence) FROM messages WHERE retain GROUP BY topic)"


class OutboxError(Exception):
    """The outbox cannot do what it was asked to; the text names the file and the remedy."""


@dataclass(frozen=True, slots=True)
class OutboxMessage:
    """A message that is on disk.

    Attributes:
        sequence: its number, never used twice.
        topic: MQTT topic.
        payload: the bytes to publish.
        retain: whether the broker keeps it as the latest of its topic.
    """

    sequence: int
    topic: str
    payload: bytes
    retain: bool


@dataclass(frozen=True, slots=True)
class Draft:
    """A message on its way to the disk, whose payload wants to know its number."""

    topic: str
    payload_of_sequence: Callable[[int], bytes]
    retain: bool


class Journal:
    """Messages by sequence number, sent or not.

    Args:
        path: the SQLite file; its directory is created.
        wall_ns: wall clock, ns since the Unix epoch.
        keep_sent: how many messages to keep at most once they are sent. The latest retained message of
            each topic is kept for good, and what is not sent is never dropped.
    """

    def __init__(self, path: Path, wall_ns: Callable[[], int], keep_sent: int) -> None:
        self.path = path
        self.quarantined = 0
        self._mark_path = path.with_name(path.name + ".sequence")
        self._wall_ns = wall_ns
        self._keep_sent = keep_sent
        self._connection: sqlite3.Connection | None = None
        self._lock: BinaryIO | None = None
        self._next = 0
        self._mark = 0
        self._sent_since_trim = 0

    @property
    def last_sequence(self) -> int:
        """The highest number used so far."""
        return self._next - 1

    def open(self) -> None:
        """Open or create the file; a corrupt one is set aside.

        Raises:
            OutboxError: the directory or file cannot be used.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._take_possession()
            self._mark = self._read_mark()
            try:
                self._connect()
            except sqlite3.DatabaseError as error:
                if not is_corrupt(error):
                    raise
                self.quarantine(error)
        except (OSError, sqlite3.Error) as error:
            raise OutboxError(
                f"cannot open the outbox {self.path}: {error}; "
                f"give the service a directory that it may write in, with space left"
            ) from error

    def _take_possession(self) -> None:
        """Keep other processes out: two writers would give the same numbers and fight at the broker.

        The system gives the lock back however this process ends.
        """
        lock = self.path.with_name(self.path.name + ".lock").open("ab")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.close()
            raise OutboxError(
                f"another daqsvc uses the store {self.path.parent}; "
                "stop it, or give this one a directory of its own"
            ) from None
        except BaseException:
            lock.close()
            raise
        self._lock = lock

    def quarantine(self, error: sqlite3.DatabaseError) -> None:
        """Set a corrupt file aside and begin a new one."""
        if self._connection is not None:
            with contextlib.suppress(sqlite3.Error):  # it is given up anyway
                self._connection.close()
            self._connection = None
        stamp = self._wall_ns() // NS_PER_MS
        aside = self.path.with_name(f"{self.path.name}.corrupt-{stamp}")
        for suffix in ("", "-wal", "-shm"):
            part = self.path.with_name(self.path.name + suffix)
            if part.exists():
                part.rename(aside.with_name(aside.name + suffix))
        self.quarantined += 1
        log.error("outbox %s is corrupt (%s); set aside as %s, starting a new one", self.path, error, aside)
        self._connect()

    def _connect(self) -> None:
        connection = sqlite3.connect(self.path, isolation_level=None, timeout=5.0)
        try:
            self._next = 1 + self._prepare(connection)
        except BaseException:
            connection.close()
            raise
        self._connection = connection

    def _prepare(self, connection: sqlite3.Connection) -> int:
        """Set the connection up, check the file, and return the highest number in use."""
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = FULL")
        verdict = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
        if verdict != "ok":
            raise _corruption(str(verdict))
        version = connection.execute("PRAGMA user_version").fetchone()[0]
        if version not in (0, SCHEMA_VERSION):
            raise OutboxError(
                f"outbox {self.path} has schema version {version}, this program knows {SCHEMA_VERSION}; "
                f"update the program or move the file away"
            )
        if version == 0:
            connection.executescript(
                f"BEGIN IMMEDIATE; {_SCHEMA} PRAGMA user_version = {SCHEMA_VERSION}; COMMIT;"
            )
        used = connection.execute("SELECT seq FROM sqlite_sequence WHERE name = 'messages'").fetchone()
        return int(used[0]) if used else max(self._mark, self._wall_ns() // NS_PER_MS)

    def commit(self, drafts: Sequence[Draft], sent: Iterable[int]) -> tuple[list[int | Exception], int]:
        """Write drafts and mark others as sent, in one durable transaction.

        Returns:
            For each draft its sequence number, or what its payload function raised (such a draft takes
            no number); and how many messages were newly marked.

        Raises:
            sqlite3.Error: nothing was written; try again with the same drafts.
            OSError: likewise, from the side file.
        """
        outcomes: list[int | Exception] = []
        rows = []
        sequence = self._next
        for draft in drafts:
            try:
                payload = draft.payload_of_sequence(sequence)
            except Exception as error:  # noqa: BLE001  the caller's own function; it goes back to the caller
                outcomes.append(error)
                continue
            rows.append((sequence, draft.topic, payload, draft.retain))
            outcomes.append(sequence)
            sequence += 1
        self._advance_mark(sequence)

        connection = self._open_connection()
        connection.execute("BEGIN IMMEDIATE")
        try:
            connection.executemany(
                "INSERT INTO messages (sequence, topic, payload, retain) VALUES (?, ?, ?, ?)", rows
            )
            marked = connection.executemany(
                "UPDATE messages SET sent = 1 WHERE sequence = ? AND NOT sent", [(s,) for s in sent]
            ).rowcount
            self._trim(connection, marked)
            connection.execute("COMMIT")
        except BaseException:
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            raise
        self._next = sequence
        return outcomes, marked

    def pending(self, after: int, limit: int) -> list[OutboxMessage]:
        """Messages above ``after`` that are not sent, in order, at most ``limit``."""
        return self._select("WHERE NOT sent AND sequence > ? ORDER BY sequence LIMIT ?", after, limit)

    def retained(self) -> list[OutboxMessage]:
        """The latest retained message of each topic, if it is sent, in order."""
        return self._select(f"WHERE sent AND sequence IN {_LATEST} ORDER BY sequence")

    def latest(self) -> list[OutboxMessage]:
        """The latest retained message of each topic, sent or not, in order."""
        return self._select(f"WHERE sequence IN {_LATEST} ORDER BY sequence")

    def unsent(self) -> int:
        """How many messages are not sent."""
        count: int = (
            self._open_connection().execute("SELECT count(*) FROM messages WHERE NOT sent").fetchone()[0]
        )
        return count

    def close(self) -> None:
        """Close the file."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _open_connection(self) -> sqlite3.Connection:
        if self._connection is None:
            self._connect()
        if self._connection is None:
            raise OutboxError(f"outbox {self.path} is not open; call open() first")
        return self._connection

    def _select(self, where: str, *parameters: int) -> list[OutboxMessage]:
        rows = self._open_connection().execute(
            f"SELECT sequence, topic, payload, retain FROM messages {where}",  # noqa: S608  constants only
            parameters,
        )
        return [
            OutboxMessage(sequence, topic, payload, bool(retain)) for sequence, topic, payload, retain in rows
        ]

    def _trim(self, connection: sqlite3.Connection, marked: int) -> None:
        self._sent_since_trim += marked
        if self._sent_since_trim < min(TRIM_EVERY, self._keep_sent + 1):
            return
        self._sent_since_trim = 0
        connection.execute(
            """
            DELETE FROM messages WHERE sent
            AND sequence <= (SELECT sequence FROM messages WHERE sent
                             ORDER BY sequence DESC LIMIT 1 OFFSET ?)
            AND sequence NOT IN (SELECT max(sequence) FROM messages WHERE retain GROUP BY topic)
            """,
            (self._keep_sent,),
        )

    def _read_mark(self) -> int:
        try:
            return int(self._mark_path.read_text(encoding="ascii"))
        except FileNotFoundError:
            return 0
        except ValueError:
            log.warning(
                "outbox mark %s is not a number; sequence numbers start by the wall clock", self._mark_path
            )
            return 0

    def _advance_mark(self, sequence: int) -> None:
        """Keep the mark ahead of every number in use, durably, before the number is used."""
        if sequence <= self._mark:
            return
        mark = sequence + MARK_STEP
        draft = self._mark_path.with_name(self._mark_path.name + ".new")
        with draft.open("w", encoding="ascii") as file:
            file.write(str(mark))
            file.flush()
            os.fsync(file.fileno())
        draft.replace(self._mark_path)
        self._mark = mark


def is_corrupt(error: Exception) -> bool:
    """Whether an error says that the file itself is broken, rather than the disk full or busy."""
    code = getattr(error, "sqlite_errorcode", None)
    return code is not None and code & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


def _corruption(verdict: str) -> sqlite3.DatabaseError:
    error = sqlite3.DatabaseError(verdict)
    error.sqlite_errorcode = sqlite3.SQLITE_CORRUPT
    return error
