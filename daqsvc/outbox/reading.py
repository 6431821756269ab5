"""The journal of alarms for other processes: read-only, while the service runs and while it does not.

Nothing is created or changed in the store. That matters: a file that an administrator's command leaves
behind there belongs to the administrator, and the service could not open it.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import sqlite3
import stat
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar
from urllib.parse import quote

from daqsvc.outbox.files import FileError, remedy
from daqsvc.outbox.messages import NewerOutboxError, OutboxError, is_sound
from daqsvc.outbox.safety import refuse_foreign, refuse_unsafe, whose_to_read
from daqsvc.outbox.tables import SCHEMA_VERSION, known_version, newer_writer, version_of
from daqsvc.outbox.written_by import written_by

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator

_T = TypeVar("_T")

JOURNAL_NAME = "outbox.sqlite"
"""What the service calls the journal in its store."""

ATTEMPTS, RETRY_S = 4, 0.05

_MAGIC, _HEADER_BYTES, _USER_VERSION = b"SQLite format 3\0", 100, slice(60, 64)
"""The header of a file of SQLite, and where the version of its tables is in it."""

_COLUMNS = "sequence, topic, payload, retain, sent, wall_ns, checksum"


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """A message of the journal.

    Attributes:
        sequence: its number.
        topic: MQTT topic.
        payload: the bytes published, or to be published.
        retain: whether it is a state, of which the latest of each topic counts.
        sent: whether the broker has acknowledged it.
        wall_ns: when it was written, ns since the Unix epoch by the wall clock of then.
    """

    sequence: int
    topic: str
    payload: bytes
    retain: bool
    sent: bool
    wall_ns: int


@dataclass(frozen=True, slots=True)
class JournalView:
    """What the journal held at one moment.

    Attributes:
        latest: the latest state of each topic, in order.
        history: the newest messages, the newest last.
        unsent: how many messages the broker has not acknowledged.
        damaged: messages left out because they have changed on the disk.
    """

    latest: tuple[JournalEntry, ...]
    history: tuple[JournalEntry, ...]
    unsent: int
    damaged: int


def read_journal(store: Path, *, history: int = 100) -> JournalView:
    """Read the journal of a service; blocks.

    Args:
        store: the service's directory.
        history: how many messages of the past at most.

    Raises:
        OutboxError: there is none, or it cannot be read; the text states what to do.
    """
    return _read(store / JOURNAL_NAME, lambda connection: _view(connection, history))


def read_pasts(
    store: Path, topics: Collection[str], is_over: Callable[[JournalEntry], bool], most: int
) -> dict[str, list[JournalEntry]]:
    """Read what led to the latest message of each of many topics, in one walk back; blocks.

    Args:
        store: the service's directory.
        topics: which ones.
        is_over: whether a message is of the time before the one that is asked for; with it, its topic ends.
        most: how many messages of each topic at most.

    Returns:
        By topic its messages, the newest last. Those that have changed on the disk are left out.

    Raises:
        OutboxError: as of `read_journal`.
    """
    return _read(store / JOURNAL_NAME, lambda connection: _pasts(connection, topics, is_over, most))


def _pasts(
    connection: sqlite3.Connection,
    topics: Collection[str],
    is_over: Callable[[JournalEntry], bool],
    most: int,
) -> dict[str, list[JournalEntry]]:
    pasts: dict[str, list[JournalEntry]] = {topic: [] for topic in topics}
    asked = set(topics)
    rows = connection.execute(f"SELECT {_COLUMNS} FROM messages ORDER BY sequence DESC")  # noqa: S608  constants only
    for row in rows:
        if not asked:
            break
        if row[1] not in asked:
            continue
        for entry in _sound([row]):
            if is_over(entry):
                asked.discard(entry.topic)
                break
            pasts[entry.topic].append(entry)
            if len(pasts[entry.topic]) >= most:
                asked.discard(entry.topic)
    return {topic: past[::-1] for topic, past in pasts.items()}


def _read(path: Path, query: Callable[[sqlite3.Connection], _T]) -> _T:
    """What a query finds in the journal, all of it at one moment.

    Raises:
        OutboxError: there is no journal, or it cannot be read; the text states what to do.
    """
    try:
        return _tried(path, query)
    except FileNotFoundError:
        raise OutboxError(
            f"there is no journal {path}: the service has not run with this store yet, or keeps it "
            f"elsewhere; see --store of its daqsvc run, or `directory` in [store] of its machine file"
        ) from None
    except PermissionError as error:
        raise OutboxError(
            f"the journal {path} may not be read: {error.strerror}; {whose_to_read(path)}"
        ) from error
    except FileError as error:
        raise OutboxError(
            f"the journal {path} cannot be read: {error}; the service sets a corrupt one aside when it starts"
        ) from error


def _tried(path: Path, query: Callable[[sqlite3.Connection], _T]) -> _T:
    """Read; again, if the service comes or goes meanwhile and takes the write-ahead log with it."""
    for _ in range(ATTEMPTS - 1):
        try:
            return _read_once(path, query)
        except (sqlite3.Error, UnicodeDecodeError, FileNotFoundError):
            path.stat()
            time.sleep(RETRY_S)
    return _read_once(path, query)


def _read_once(path: Path, query: Callable[[sqlite3.Connection], _T]) -> _T:
    with opened_to_read(path) as connection:
        connection.execute("BEGIN")  # all that follows is of one moment
        _check_version(path, connection)
        return query(connection)


def _check_version(path: Path, connection: sqlite3.Connection) -> None:
    writer = written_by(path)
    version = version_of(connection, writer)
    if not version and not connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
        raise OutboxError(
            f"the journal {path} is empty: the service has not been able to write anything to it yet; "
            f"{remedy(path.parent)}"
        )
    if version != SCHEMA_VERSION:
        raise OutboxError(
            f"the journal {path} has schema version {version}, this program reads {SCHEMA_VERSION}; "
            + (
                f"use the program that the service runs, {newer_writer(writer)}"
                if version > SCHEMA_VERSION
                else "start the service once"
            )
        )


def _view(connection: sqlite3.Connection, history: int) -> JournalView:
    newest = connection.execute(
        f"SELECT {_COLUMNS} FROM messages ORDER BY sequence DESC LIMIT ?",  # noqa: S608  constants only
        [history],
    ).fetchall()
    latest = connection.execute(
        f"SELECT {_COLUMNS} FROM messages WHERE sequence IN "  # noqa: S608  constants only
        "(SELECT sequence FROM latest) ORDER BY sequence"
    ).fetchall()
    unsent = connection.execute("SELECT count(*) FROM messages WHERE NOT sent").fetchone()[0]
    sound_latest, sound_history = _sound(latest), _sound(reversed(newest))
    bad = {row[0] for row in [*latest, *newest]} - {e.sequence for e in [*sound_latest, *sound_history]}
    return JournalView(tuple(sound_latest), tuple(sound_history), unsent, len(bad))


def _sound(rows: Iterable[tuple[int, str, bytes, int, int, int, int | None]]) -> list[JournalEntry]:
    return [
        JournalEntry(sequence, topic, payload, bool(retain), bool(sent), wall_ns)
        for sequence, topic, payload, retain, sent, wall_ns, check in rows
        if is_sound(sequence, topic, payload, check)
    ]


def refuse_newer(path: Path) -> None:
    """See whose version a journal is, if it is there and can be read; nothing is changed in it.

    Raises:
        NewerOutboxError: a newer version of the program has written it.
        StoreRefusedError: it is a file of others; or root reads, and others may put files there.
    """
    # What else may be wrong with it, the service finds and repairs when it opens it.
    with contextlib.suppress(*FileError):
        if os.geteuid() == 0:
            # SQLite opens by name what may have become a link, or a pipe, after it was examined.
            refuse_unsafe(path.parent)
        with opened_to_read(path) as connection:
            known_version(connection, path)


def refuse_newer_header(path: Path) -> None:
    """The same by the header of the file alone, and without SQLite: root may do so whoever owns the store.

    What is only in the write-ahead log is not seen, nor whether the number is damaged. In a process that
    has the journal open this would undo its locks.

    Raises:
        NewerOutboxError: a newer version of the program has written it.
    """
    try:
        header = _header(path)
    except OSError:
        return
    if len(header) < _HEADER_BYTES or not header.startswith(_MAGIC):
        return
    version = int.from_bytes(header[_USER_VERSION], "big", signed=True)
    if version > SCHEMA_VERSION:
        raise NewerOutboxError(
            f"outbox {path} has schema version {version}, written by {newer_writer(written_by(path))}; this "
            f"program knows {SCHEMA_VERSION}: install that version again, or give the service another store"
        )


def _header(path: Path) -> bytes:
    """The header of a regular file; never through a symbolic link, and never waiting for a pipe."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        return os.read(handle, _HEADER_BYTES) if stat.S_ISREG(os.fstat(handle).st_mode) else b""
    finally:
        os.close(handle)


@contextlib.contextmanager
def opened_to_read(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection that leaves no trace.

    A service that runs, or was killed, leaves a write-ahead log and its index beside the journal: these are
    read as they are. Without a log, everything is in the file itself. A log without an index (a copy, a
    read-only file system) can only be read where an index can be made: in a copy.

    Raises:
        OSError: a file is not there or must not be read.
        sqlite3.Error: it cannot be opened.
    """
    _check_readable(path)
    log, index = (path.with_name(path.name + suffix) for suffix in ("-wal", "-shm"))
    if not log.exists() or log.stat().st_size == 0:
        with contextlib.closing(_connect(path, "immutable=1")) as connection:
            yield connection
        return
    _check_readable(log)
    if index.exists():
        connection = _connect(path, "mode=ro")
        try:
            connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
        except sqlite3.OperationalError:
            connection.close()  # the index cannot be used here; what follows does without
        else:
            with contextlib.closing(connection):
                yield connection
            return
    with tempfile.TemporaryDirectory(prefix="daqsvc-") as copies:
        copy = Path(copies) / path.name
        for part in (path, log):
            shutil.copyfile(part, copy.with_name(part.name))
        with contextlib.closing(_connect(copy, "mode=rw")) as connection:
            yield connection


def _check_readable(path: Path) -> None:
    """Raise what SQLite would not distinguish, without a handle: closing one undoes this process's locks."""
    refuse_foreign(path)
    if not os.access(path, os.R_OK, effective_ids=True):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


def _connect(path: Path, how: str) -> sqlite3.Connection:
    return sqlite3.connect(
        f"file:{quote(str(path.absolute()))}?{how}", uri=True, isolation_level=None, timeout=5.0
    )
