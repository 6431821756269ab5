"""The SQLite file of telemetry: bounded in bytes and age, not synced, used by one thread.

It shares no page and no lock with the journal of alarms, so neither can harm the other. Where the file
cannot be used (full or broken disk), the same table is kept in memory, smaller: the status that reports the
full disk must still reach the broker.
"""

from __future__ import annotations

import contextlib
import logging
import sqlite3
import time
from typing import TYPE_CHECKING, Any, TypeAlias

from daqsvc.errors.code import coded
from daqsvc.errors.outputs import MESSAGE_DROPPED
from daqsvc.errors.service import DISK_REFUSES, JOURNAL_DAMAGED
from daqsvc.notice import notice
from daqsvc.outbox.files import (
    FileError,
    NewerFileError,
    connect,
    corruption,
    delete,
    free_bytes,
    is_corrupt,
    pragma,
    put_by,
    refuse_newer,
    used_bytes,
)
from daqsvc.outbox.messages import TelemetryMessage, checksum, is_sound
from daqsvc.outbox.rescue import finish, rescue

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock
    from daqsvc.outbox.counters import TelemetryCounters
    from daqsvc.outbox.limits import OutboxLimits

log = logging.getLogger(__name__)

SCHEMA_VERSION = 1

MEMORY_BYTES = 4 * 1024 * 1024
"""Size of the table in memory."""

SMALLEST_BYTES = 256 * 1024
"""A file that may not grow to this is not worth having."""

WAL_PAGES = 256
"""See `files.connect`; 1 MiB comes on top of the limit of the file."""

FILE_RETRY_S = 30.0
"""Time between attempts to get back from memory to the file."""

DROP_AT_ONCE = 64

_SCHEMA = """
CREATE TABLE telemetry (
    number INTEGER PRIMARY KEY,
    topic TEXT NOT NULL,
    payload BLOB NOT NULL,
    expires_ns INTEGER NOT NULL,
    expires_wall_ns INTEGER NOT NULL,
    lifetime_ns INTEGER NOT NULL,
    checksum INTEGER NOT NULL
);
CREATE INDEX expiry ON telemetry (expires_ns);
"""

_ROWS = "SELECT number, topic, payload, expires_ns, expires_wall_ns, lifetime_ns, checksum FROM telemetry"
_INSERT = "INSERT INTO telemetry VALUES (?, ?, ?, ?, ?, ?, ?)"
_DROP_OLDEST = "DELETE FROM telemetry WHERE number IN (SELECT number FROM telemetry ORDER BY number LIMIT ?)"


Arrival: TypeAlias = tuple[str, bytes, int]
"""Topic, payload and lifetime in ns, counted from when it is written."""


class TelemetryFile:
    """Telemetry in order, the oldest dropped first.

    Args:
        path: the SQLite file.
        clock: the service's clock; ages go by its monotonic time, and from one run of the service to the
            next by its wall time.
        limits: how much is kept.
        counters: written by this class, on its thread; single numbers may be read on any.
    """

    def __init__(self, path: Path, clock: Clock, limits: OutboxLimits, counters: TelemetryCounters) -> None:
        self._path = path
        self._clock = clock
        self._limits = limits
        self._counters = counters
        self._connection: sqlite3.Connection | None = None
        self.is_ours: Callable[[], bool] = lambda: True
        """Whether other processes are kept out of the store; else the file is left alone."""
        self._next = 1
        self._retry_at_s = 0.0
        self._reported = ""

    @property
    def last_number(self) -> int:
        """The highest number given so far."""
        return self._next - 1

    def give_way(self) -> None:
        """Delete the file if the disk is nearly full; before `open`."""
        try:
            if free_bytes(self._path.parent) < self._limits.reserve_bytes and self._path.exists():
                delete(self._path)
                log.warning(
                    "telemetry in %s is dropped: the disk is nearly full",
                    self._path,
                    extra=coded(MESSAGE_DROPPED),
                )
        except OSError as error:
            log.warning("telemetry in %s cannot be read: %s", self._path, error, extra=coded(MESSAGE_DROPPED))

    def open(self) -> None:
        """Open or create the file; if it cannot be used, the messages are kept in memory."""
        try:
            self._open_file()
        except FileError as error:
            self._into_memory(error)

    def apply(self, arrived: Sequence[Arrival], sent: Iterable[int]) -> None:
        """Take messages in and delete others; then drop what is too old or too much.

        Args:
            arrived: in their order.
            sent: numbers that the broker has taken.
        """
        sent = list(sent)
        self._come_back()
        try:
            self._apply(arrived, sent)
        except FileError as error:
            self._counters.write_errors += 1
            if self._is_in_memory():
                raise
            self._replace(error)
            self._apply(arrived, sent)

    def pending(self, after: int, limit: int) -> list[TelemetryMessage]:
        """Messages above ``after`` that are not too old, in order, at most ``limit``."""
        try:
            return self._pending(after, limit)
        except FileError as error:
            if self._is_in_memory():
                raise
            self._replace(error)
            return self._pending(after, limit)

    def close(self) -> None:
        """Close the file."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def _apply(self, arrived: Sequence[Arrival], sent: Sequence[int]) -> None:
        now_ns, wall_ns = self._clock.monotonic_ns(), self._clock.wall_ns()
        number = self._next
        rows = []
        for topic, payload, lifetime_ns in arrived:
            check = checksum(number, topic, payload)
            rows.append(
                (number, topic, payload, now_ns + lifetime_ns, wall_ns + lifetime_ns, lifetime_ns, check)
            )
            number += 1
        with self._transaction() as connection:
            connection.executemany(_INSERT, rows)
            taken = connection.executemany(
                "DELETE FROM telemetry WHERE number = ?", [(n,) for n in sent]
            ).rowcount
            old = connection.execute("DELETE FROM telemetry WHERE expires_ns <= ?", (now_ns,)).rowcount
            too_many = self._drop_oldest(connection)
        self._next = number
        taken = max(taken, 0)
        self._counters.accepted += len(rows)
        self._counters.sent += taken
        self._counters.dropped_old += old
        self._counters.dropped_full += too_many
        self._counters.depth += len(rows) - taken - old - too_many

    def _drop_oldest(self, connection: sqlite3.Connection) -> int:
        allowed = self._allowed_bytes(connection)
        dropped = 0
        while used_bytes(connection) > allowed:
            rows = connection.execute(_DROP_OLDEST, (DROP_AT_ONCE,)).rowcount
            if not rows:
                break
            dropped += rows
        return dropped

    def _allowed_bytes(self, connection: sqlite3.Connection) -> int:
        """The limit of the moment.

        Raises:
            sqlite3.OperationalError: the disk is nearly full. To make the file smaller would take room
                first, so it has to go.
        """
        if self._is_in_memory():
            return MEMORY_BYTES
        spare = free_bytes(self._path.parent) - self._limits.reserve_bytes
        if spare < 0:
            raise sqlite3.OperationalError("the disk is nearly full")
        file_bytes = pragma(connection, "page_count") * pragma(connection, "page_size")
        return min(self._limits.telemetry_max_bytes, file_bytes + spare)

    def _pending(self, after: int, limit: int) -> list[TelemetryMessage]:
        rows = self._open_connection().execute(
            "SELECT number, topic, payload, expires_ns, checksum FROM telemetry "
            "WHERE number > ? AND expires_ns > ? ORDER BY number LIMIT ?",
            (after, self._clock.monotonic_ns(), limit),
        )
        messages = []
        for number, topic, payload, expires_ns, check in rows:
            if not is_sound(number, topic, payload, check):
                raise corruption(f"message {number} has changed on the disk")
            messages.append(TelemetryMessage(number, topic, payload, expires_ns))
        return messages

    # Which file, or none.

    def _is_in_memory(self) -> bool:
        return bool(self._counters.in_memory)

    def _open_file(self) -> None:
        if not self.is_ours():
            raise sqlite3.OperationalError("the store cannot be used yet")
        if free_bytes(self._path.parent) < self._limits.reserve_bytes + SMALLEST_BYTES:
            raise sqlite3.OperationalError("the disk is nearly full")
        finish(self._path, self._clock.wall_ns())
        try:
            self._connection = self._connect()
        except NewerFileError as newer:
            put_by(self._path, newer.version, self._clock.wall_ns())
            self._connection = self._connect()
        except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
            if not is_corrupt(error):
                raise
            self._set_aside(error)
            self._connection = self._connect()
        depth, last = self._connection.execute("SELECT count(*), max(number) FROM telemetry").fetchone()
        self._counters.depth = depth
        self._next = max(self._next, (last or 0) + 1)

    def _connect(self) -> sqlite3.Connection:
        connection = connect(self._path, synchronous="OFF", wal_pages=WAL_PAGES)
        try:
            version = refuse_newer(connection, SCHEMA_VERSION)
            connection.execute("BEGIN IMMEDIATE")
            if version == 0:
                _create(connection)
            # The monotonic clock of an earlier run means nothing now. The wall clock shows how much of a
            # message's time is left, and never more than before if it was set back.
            connection.execute(
                "UPDATE telemetry SET expires_ns = ? + max(0, min(lifetime_ns, expires_wall_ns - ?))",
                (self._clock.monotonic_ns(), self._clock.wall_ns()),
            )
            connection.execute("COMMIT")
        except BaseException:
            connection.close()
            raise
        return connection

    def _replace(self, error: Exception) -> None:
        """Go on without the file as it is: with a new one if it is corrupt, else in memory."""
        if is_corrupt(error):
            self.close()
            before = self._counters.depth
            try:
                self._set_aside(error)
                self._open_file()
            except FileError as again:
                self._into_memory(again)
            else:
                self._counters.dropped_disk += max(before - self._counters.depth, 0)
        else:
            self._into_memory(error)

    def _set_aside(self, error: Exception) -> None:
        aside, count = rescue(self._path, "telemetry", _create, _is_row_sound, self._clock.wall_ns())
        self._counters.quarantined += 1
        log.error(
            "telemetry %s is corrupt (%s); set aside as %s, going on with the %d messages that can be read",
            self._path,
            error,
            aside,
            count,
            extra=coded(JOURNAL_DAMAGED),
        )

    def _into_memory(self, error: Exception) -> None:
        """Keep the newest messages in memory and give the file's room back."""
        newest = self._newest()
        self.close()
        with contextlib.suppress(OSError):  # it is the disk that fails; the log below reports it
            if self.is_ours():
                delete(self._path)
        self._connection = connect(":memory:", synchronous="OFF")
        _create(self._connection)
        self._connection.executemany(_INSERT, newest)
        self._counters.dropped_disk += max(self._counters.depth - len(newest), 0)
        self._counters.depth = len(newest)
        self._counters.in_memory = 1
        self._retry_at_s = time.monotonic() + FILE_RETRY_S
        if str(error) != self._reported:
            self._reported = str(error)
            log.warning(
                "telemetry file %s cannot be used: %s; up to %d MiB are kept in memory until it can",
                self._path,
                error,
                MEMORY_BYTES // 2**20,
                extra=coded(DISK_REFUSES),
            )

    def _newest(self) -> list[tuple[object, ...]]:
        """The newest rows, oldest first, as far as they can be read and go into memory."""
        rows: list[tuple[object, ...]] = []
        if self._connection is None:
            return rows
        size = 0
        with contextlib.suppress(*FileError):  # what cannot be read is counted as dropped
            for row in self._connection.execute(f"{_ROWS} ORDER BY number DESC"):
                size += len(row[1]) + len(row[2]) + DROP_AT_ONCE
                if size > MEMORY_BYTES // 2:
                    break
                rows.append(row)
        return rows[::-1]

    def _come_back(self) -> None:
        """From memory to the file, where the disk has room again; tried now and then."""
        if not self._is_in_memory() or time.monotonic() < self._retry_at_s or self._connection is None:
            return
        self._retry_at_s = time.monotonic() + FILE_RETRY_S
        memory = self._connection
        rows = memory.execute(f"{_ROWS} ORDER BY number").fetchall()
        try:
            if free_bytes(self._path.parent) < 2 * self._limits.reserve_bytes:
                return
            delete(self._path)
            self._open_file()
            with self._transaction() as connection:
                connection.executemany(_INSERT, rows)
        except FileError as error:
            if self._connection is not memory:
                self.close()
            self._connection = memory
            log.debug("telemetry file %s still cannot be used: %s", self._path, error)
        else:
            memory.close()
            self._counters.in_memory = 0
            self._reported = ""
            notice(log, "telemetry file %s can be used again", self._path)
        self._counters.depth = len(rows)

    def _open_connection(self) -> sqlite3.Connection:
        if self._connection is None:
            raise sqlite3.OperationalError(f"telemetry file {self._path} is not open")
        return self._connection

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        connection = self._open_connection()
        connection.execute("BEGIN IMMEDIATE")
        try:
            yield connection
            connection.execute("COMMIT")
        except BaseException:
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            raise


def _is_row_sound(row: tuple[Any, ...]) -> bool:
    number, topic, payload, *times, check = row
    is_payload_sound = isinstance(check, int) and is_sound(number, topic, payload, check)
    return is_payload_sound and all(isinstance(time_ns, int) for time_ns in times)


def _create(connection: sqlite3.Connection) -> None:
    for statement in _SCHEMA.split(";"):
        connection.execute(statement)
    connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
