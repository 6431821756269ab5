"""The SQLite file of the alarms: synchronous, used by one thread."""

from __future__ import annotations

import contextlib
import logging
import sqlite3
import time
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING

from daqsvc.errors.code import coded
from daqsvc.errors.service import DISK_REFUSES, JOURNAL_DAMAGED
from daqsvc.notice import notice
from daqsvc.outbox.ballast import Ballast
from daqsvc.outbox.files import (
    FileError,
    connect,
    corruption,
    free_bytes,
    is_corrupt,
    is_full,
    make_directory,
    may_pass,
    pragma,
    sync_directory,
    take_possession,
    used_bytes,
)
from daqsvc.outbox.known_topics import KnownTopics
from daqsvc.outbox.limits import OutboxLimits
from daqsvc.outbox.log_copy import LogCopy
from daqsvc.outbox.messages import (
    OutboxAwayError,
    OutboxError,
    OutboxMessage,
    StoreRefusedError,
    checksum,
    is_sound,
)
from daqsvc.outbox.reading import JOURNAL_NAME, opened_to_read, refuse_newer
from daqsvc.outbox.renewal import JournalDamage, Renewal
from daqsvc.outbox.safety import (
    refuse_link,
    refuse_no_directory,
    refuse_unopenable,
    refuse_unsafe,
    refuse_unwritable,
    restrict_files,
)
from daqsvc.outbox.salvage import LARGEST, readable
from daqsvc.outbox.sequence import SequenceMark, place_of
from daqsvc.outbox.tables import (
    FILL_LATEST,
    SCHEMA_VERSION,
    bring_up_to_date,
    known_version,
)
from daqsvc.outbox.unwritten import Unwritten
from daqsvc.outbox.written_by import note_version

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path
    from typing import BinaryIO

    from daqsvc.outbox.messages import Draft
    from daqsvc.outbox.unwritten import Acknowledged

log = logging.getLogger(__name__)

TRIM_EVERY = 256
"""Messages marked as sent from one look at the limits to the next."""

TRIM_AT_MOST = 8 * TRIM_EVERY
"""Messages deleted at a time, so that no commit takes long; far more than come in between."""

SLACK_PAGES = 2048
"""Free pages of the file that are kept for what comes, 8 MiB; more are given back to the disk."""

RECENT = 1000
"""Messages, not sent yet, that are kept in memory as well: a disk that fails may not give them back."""

_INSERT = """
INSERT INTO messages (sequence, topic, payload, retain, wall_ns, checksum) VALUES (?, ?, ?, ?, ?, ?)
"""

_IS_LATEST = "SELECT sequence FROM latest"

_TRUE_LATEST = "SELECT topic, max(sequence) FROM messages WHERE retain GROUP BY topic"
_ODD_LATEST = f"""
SELECT topic FROM (SELECT topic, sequence FROM latest EXCEPT {_TRUE_LATEST})
UNION ALL SELECT topic FROM ({_TRUE_LATEST} EXCEPT SELECT topic, sequence FROM latest)
"""  # noqa: S608  constants only

SHORT_BYTES = 1024 * 1024
"""Below this, what SQLite calls an I/O error comes of a full disk."""


class Journal:
    """Messages by sequence number, sent or not; `outbox.sequence` explains how the numbers go on.

    A message is numbered, then written; until then it waits in memory, under the number and with the content
    that it keeps. Nobody reads it there, unless it is shown because the disk takes no writes: see `show`.

    Args:
        path: the SQLite file; its directory is created.
        wall_ns: wall clock, ns since the Unix epoch.
        limits: how much is kept of what is sent.
        before_new: called on the thread before a new file is made; what it raises is an error of the disk.
    """

    def __init__(
        self,
        path: Path,
        wall_ns: Callable[[], int],
        limits: OutboxLimits,
        before_new: Callable[[], None] = lambda: None,
    ) -> None:
        self.path = path
        self.quarantined = 0
        self.vanished = 0
        self._mark = SequenceMark(path.with_name(path.name + ".sequence"))
        self.set_aside: Path | None = None
        self._renewal = Renewal(path)
        self._log_copy = LogCopy(path)
        self._known_topics = KnownTopics(path.with_name(path.name + ".topics"))
        self._wall_ns = wall_ns
        self._limits = limits
        self._before_new = before_new
        self._ballast = Ballast(
            path.with_name(path.name + ".ballast"), limits.ballast_bytes, limits.reserve_bytes
        )
        self._connection: sqlite3.Connection | None = None
        self._view: contextlib.ExitStack | None = None
        self._viewed: sqlite3.Connection | None = None
        self._may_view = False
        self._has_failed = False
        self._lock: BinaryIO | None = None
        self._is_ready = False
        self._next = 0
        self._unwritten = Unwritten(limits.alarms_waiting_max // 4)
        self._unsent = 0
        self._recent: dict[int, OutboxMessage] = {}
        self._shows = False
        self._was_ahead = False
        self._sent_since_trim = 0

    @property
    def last_sequence(self) -> int:
        """The highest number used so far."""
        return self._next - 1

    @property
    def newest(self) -> int:
        """The highest number that can be read, or was."""
        first = self._unwritten.first
        return self._next - 1 if first is None or self._shows else first - 1

    @property
    def shows(self) -> bool:
        """Whether messages can be read that are not on the disk."""
        return self._shows

    @property
    def has_unwritten(self) -> bool:
        """Whether `write` has something to do."""
        return bool(self._unwritten)

    @property
    def waiting(self) -> tuple[OutboxMessage, ...]:
        """The messages that are not on the disk and that the broker does not have."""
        marks = self._unwritten.marks
        return tuple(m for m in self._unwritten.messages if m.sequence not in marks)

    @property
    def was_ahead(self) -> bool:
        """Whether an earlier run may have sent to the broker what the journal does not have.

        So it is until `damage_is_reported`.
        """
        return self._was_ahead

    @property
    def is_held(self) -> bool:
        """Whether other processes are kept out."""
        return self._lock is not None

    @property
    def is_ready(self) -> bool:
        """Whether `open` has succeeded."""
        return self._is_ready

    @property
    def known_topics(self) -> frozenset[str] | None:
        """Topics that ever had a retained message; None if they are not known, because of damage."""
        return self._known_topics.topics

    def hold(self) -> None:
        """Create the directory and keep other processes out of it, until `close`.

        Raises:
            StoreRefusedError: this account may not use it, or others may write there.
        OutboxError: the directory cannot be used, or another process uses it.
        """
        if self._lock is not None:
            return
        try:
            refuse_no_directory(self.path.parent)
            make_directory(self.path.parent)
            refuse_unsafe(self.path.parent)
            refuse_unwritable(self.path.parent)
            refuse_unopenable(self.path.parent)
            restrict_files(self.path.parent)
            self._lock = take_possession(self.path.with_name(self.path.name + ".lock"))
        except OSError as error:
            if isinstance(error, PermissionError):
                with contextlib.suppress(OSError):
                    refuse_unsafe(self.path.parent)  # its message names the owner
            raise self._unusable(error) from error

    def open(self) -> None:
        """Open or create the file; a corrupt one is set aside. What a crash has cut off there is finished.

        Raises:
            OutboxError: the directory or file cannot be used; an `OutboxAwayError` if that may pass.
        """
        if self._is_ready:
            return
        self.hold()
        try:
            self._open()
        except FileError as error:
            self._disconnect()
            self._may_view = self._mark.ended or self.is_short_of_room(error)
            raise self._unusable(error) from error
        note_version(self.path)
        self._is_ready = True

    def _open(self) -> None:
        assert self._lock is not None  # noqa: S101 - `hold` has it
        self._close_view()
        if not self._next:  # else numbers of this run are in use
            self._mark.read(place_of(self._lock))
            self._was_ahead = self._mark.is_ahead
        aside = self._renewal.finish()
        if aside is not None:
            notice(log, "outbox %s: the saving of what was left of %s is finished", self.path, aside)
        untold = self._renewal.untold()
        self.quarantined, self.vanished = untold.quarantined, untold.vanished
        self._log_copy.copy()
        known_gone = self.vanished
        if not self.path.exists():
            self._before_new()
        try:
            self._connect()
        except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
            if not is_corrupt(error):
                raise
            self.quarantine(error)
        self._adopt()
        self._prove()
        self._put_log_away(is_whole=self.vanished == known_gone)
        self._look_up_topics(is_whole=not (self.quarantined or self.vanished))
        self._tidy()
        self._ballast.allocate()

    def _put_log_away(self, *, is_whole: bool) -> None:
        """Delete the copy of the log, or set it aside if something of it may be missing."""
        try:
            if is_whole:
                self._log_copy.discard()
            elif (aside := self._log_copy.keep(self._wall_ns())) is not None:
                self.set_aside = aside
                log.warning(
                    "outbox %s: the log that is damaged is set aside as %s",
                    self.path,
                    aside,
                    extra=coded(JOURNAL_DAMAGED),
                )
        except OSError as error:
            log.warning(
                "outbox %s: the copy of its log stays where it is: %s",
                self.path,
                error,
                extra=coded(DISK_REFUSES),
            )

    def _look_up_topics(self, *, is_whole: bool) -> None:
        topics = [row[0] for row in self._open_connection().execute("SELECT topic FROM latest")]
        self._known_topics.open(topics, is_whole=is_whole)

    def _unusable(self, error: Exception) -> OutboxError:
        refused = StoreRefusedError if isinstance(error, PermissionError) else OutboxError
        kind = OutboxAwayError if may_pass(error) else refused
        return kind(
            f"cannot open the outbox {self.path}: {error}; "
            f"give the service a directory that it may write in, with space left"
        )

    def _adopt(self) -> None:
        """Take over what an earlier version has set aside and was cut off before it could save it."""
        connection = self._open_connection()
        if connection.execute("SELECT 1 FROM messages LIMIT 1").fetchone():
            return
        for aside in self._renewal.aside()[:1]:
            rows = list(readable(aside))
            if not rows:
                return
            with _transaction(connection):
                connection.executemany("INSERT INTO messages VALUES (?, ?, ?, ?, ?, ?, ?)", rows)
                connection.execute(FILL_LATEST)
            self._next = max(self._next, max(row[0] for row in rows) + 1)
            self.quarantined += 1
            self._renewal.remember(JournalDamage(self.quarantined, self.vanished))
            notice(log, "outbox %s: %d messages were saved from %s", self.path, len(rows), aside)

    def _prove(self) -> None:
        """Have all that can be read in the database itself, synced: only then may it be published.

        The log may hold what a system that was failing never wrote: it is read back from memory.
        """
        try:
            self._open_connection().execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
        except sqlite3.Error as error:
            if not is_full(error):
                raise

    def _tidy(self) -> None:
        """Trim, and have the file itself state where the numbers go on; on a full disk, both can wait."""
        connection = self._open_connection()
        try:
            self._mark.advance(self.last_sequence)
            with _transaction(connection):
                connection.execute("DELETE FROM sqlite_sequence WHERE name = 'messages'")
                connection.execute(
                    "INSERT INTO sqlite_sequence VALUES ('messages', ?)", (self.last_sequence,)
                )
                self._trim(connection)
        except (sqlite3.OperationalError, OSError) as error:
            if not is_full(error):
                raise
            log.warning(
                "outbox %s: %s; the journal is not trimmed", self.path, error, extra=coded(DISK_REFUSES)
            )

    def quarantine(self, error: Exception) -> None:
        """Set a corrupt file aside and go on with a new one that has what can still be read of it.

        See `outbox.renewal`: whatever fails, and wherever a crash comes, nothing readable is lost.

        Raises:
            sqlite3.Error: the new file cannot be written; the corrupt one is as it was.
            OSError: as above, or it cannot be set aside.
        """
        self._disconnect()
        if not self.path.exists():
            self._connect()
            self._tidy()
            return
        begun = self._first_unwritten() or LARGEST
        # A new file's numbers begin above all that the old one may have forgotten.
        self._next = max(self._next, self._mark.first_free(None, self._wall_ns()))
        in_log = [row for number, row in self._log_copy.rows().items() if number < begun]
        count = self._renewal.save(self.path, begun, self._mark.used, self._wall_ns(), in_log)
        aside = self._renewal.replace(JournalDamage(self.quarantined + 1, self.vanished))
        self.quarantined += 1
        log.error(
            "outbox %s is corrupt (%s); set aside as %s, going on with the %d messages that can be read",
            self.path,
            error,
            aside,
            count,
            extra=coded(JOURNAL_DAMAGED),
        )
        self._connect()
        self._tidy()

    def damage_is_reported(self) -> None:
        """The alarms have reported the damage of the journal: not again after a crash."""
        self._was_ahead = False
        self._mark.drift(ahead=self._shows)
        try:
            self._renewal.is_reported()
            if self._known_topics.topics is None:
                self._look_up_topics(is_whole=True)
        except OSError as error:
            log.info("outbox %s: its damage will be reported again: %s", self.path, error)

    def _connect(self) -> None:
        is_new = not self.path.exists()
        refuse_link(self.path)
        connection = connect(self.path, synchronous="FULL", thorough=True)
        try:
            stored = self._prepare(connection)
            _compare(connection)
            sync_directory(self.path.parent)
        except BaseException:
            connection.close()
            raise
        self._close_view()
        self._connection = connection
        gone = self._mark.vanished(stored)
        if is_new and self._mark.is_damaged:
            gone = max(gone, 1)  # there was a journal, and it is not known what was in it
        last, was_emptied = stored or 0, False
        if self._log_copy.is_there and (gone or not stored or self._mark.is_damaged):
            back = self._take_back(connection, stored or 0)
            last = max(back, default=last)
            self._next = max(self._next, last + 1)
            gone -= sum(self._mark.used - gone < number <= self._mark.used for number in back)
            was_emptied = self._log_copy.was_emptied and bool(self._mark.used)
            if was_emptied:
                gone = max(gone, 1)  # what was in the journal but not in the log is not known
        if gone:
            self.vanished += gone
            self._renewal.remember(JournalDamage(self.quarantined, self.vanished))
            log.error(
                "outbox %s %s, but numbers up to %d were used: %d messages are gone from the disk; it was "
                "damaged, deleted, or is an older copy",
                self.path,
                "is not there" if is_new else "was empty" if was_emptied else f"ends with message {last}",
                self._mark.used,
                gone,
                extra=coded(JOURNAL_DAMAGED),
            )
        self._next = max(self._next, self._mark.first_free(stored, self._wall_ns()))
        self._mark.begin(self._next, self._unwritten.first)

    def _first_unwritten(self) -> int:
        """The first number that is not in the journal by a commit that has succeeded; 0 if not known."""
        first = self._unwritten.first
        return self._next if first is None else first

    def _take_back(self, connection: sqlite3.Connection, stored: int) -> list[int]:
        """Have the messages again that SQLite does not find behind a wrong checksum in the log.

        Args:
            connection: to the journal.
            stored: the highest number that it knows.

        Returns:
            Their numbers.
        """
        rows = [
            row
            for number, row in self._log_copy.rows().items()
            if stored < number < LARGEST and self._mark.can_be_used(number)
        ]
        if rows:
            with _transaction(connection):
                connection.executemany("INSERT OR IGNORE INTO messages VALUES (?, ?, ?, ?, ?, ?, ?)", rows)
                connection.execute("DELETE FROM latest")
                connection.execute(FILL_LATEST)
            log.warning(
                "outbox %s: its write-ahead log is damaged; %d messages are taken back from it, page by page",
                self.path,
                len(rows),
                extra=coded(JOURNAL_DAMAGED),
            )
        return [row[0] for row in rows]

    def _reconnect(self) -> None:
        """Open the file again in the middle of a run.

        The log may hold a commit that has failed. Its messages are still in memory and will be committed
        again, so it must not come back.
        """
        begun = self._first_unwritten()
        self._connect()
        if not begun:
            return
        try:
            connection = self._open_connection()
            with _transaction(connection):
                if connection.execute("DELETE FROM messages WHERE sequence >= ?", (begun,)).rowcount:
                    connection.execute("DELETE FROM latest")
                    connection.execute(FILL_LATEST)
            self._prove()
        except BaseException:
            self._disconnect()
            raise

    def _disconnect(self) -> None:
        if self._connection is not None:
            connection, self._connection = self._connection, None
            with contextlib.suppress(sqlite3.Error):  # it is given up anyway
                connection.close()

    def _prepare(self, connection: sqlite3.Connection) -> int | None:
        """Bring the tables up to date; the highest number that the file knows, None if it is new."""
        version = known_version(connection, self.path)
        if version < SCHEMA_VERSION:
            bring_up_to_date(connection, version, self._wall_ns())
        used = connection.execute("SELECT seq FROM sqlite_sequence WHERE name = 'messages'").fetchone()
        last: int | None = connection.execute("SELECT max(sequence) FROM messages").fetchone()[0]
        if used is None:
            return last
        if not (isinstance(used[0], int) and used[0] < LARGEST):
            raise corruption(f"it ends with message {used[0]}, which was never given")
        if not self._mark.can_be_used(used[0]) and used[0] != last:
            raise corruption(f"it ends with message {used[0]}, which was never given")
        return max(used[0], last or 0)

    def number(self, drafts: Iterable[Draft]) -> list[OutboxMessage | Exception]:
        """Give messages their numbers, which they keep; from here on they wait to be written.

        Returns:
            For each draft its message, or what its payload function raised (such a draft takes no number).

        Raises:
            OSError: there are no numbers to be had; try again with the same drafts.
            OutboxError: it has not been read yet which numbers are free.
        """
        if not self._next:
            self._begin_unread()
        outcomes: list[OutboxMessage | Exception] = []
        sequence = self._next
        for draft in drafts:
            try:
                outcomes.append(draft.message(sequence))
            except Exception as error:  # noqa: BLE001  the caller's own function; it goes back to the caller
                outcomes.append(error)
                continue
            sequence += 1
        if sequence > self._next:
            self._mark.give(sequence - 1)
            if self._shows:
                self._mark.drift(ahead=True)
        self._next = sequence
        for outcome in outcomes:
            if isinstance(outcome, OutboxMessage):
                self._unwritten.add(outcome)
        return outcomes

    def _begin_unread(self) -> None:
        """Begin with numbers though the journal cannot be opened."""
        if self._lock is None:
            raise OutboxError(f"outbox {self.path} is not open; call open() first")
        is_new = not self.path.exists() or not self.path.stat().st_size
        self._next = self._mark.first_unread(self._wall_ns(), is_new=is_new)
        self._mark.begin(self._next)

    def acknowledge(self, numbers: Iterable[int]) -> Acknowledged:
        """Take in that the broker has messages; the next `write` puts it on disk."""
        return self._unwritten.acknowledge(numbers)

    def show(self) -> None:
        """Have messages read though the disk does not take them, until `hide`."""
        self._shows = True
        if self._unwritten.first is not None:
            self._mark.drift(ahead=True)

    def hide(self) -> None:
        """The disk takes messages again and has all of them."""
        self._shows = False
        self._mark.drift(ahead=self._was_ahead)

    def write(self, at_most: int) -> tuple[list[int], int]:
        """Write the first messages that wait, and mark others as sent, in one durable transaction.

        Args:
            at_most: how many messages, and how many marks.

        Returns:
            The numbers of the messages that are on disk by now, and how many messages were newly marked.

        Raises:
            sqlite3.Error: nothing was written; try again.
            OSError: as above, from the side file.
        """
        connection = self._open_connection()
        messages, marks = self._unwritten.next(at_most)
        wall_ns = self._wall_ns()
        rows = [
            (m.sequence, m.topic, m.payload, m.retain, wall_ns, checksum(m.sequence, m.topic, m.payload))
            for m in messages
        ]
        latest = {m.topic: m.sequence for m in messages if m.retain}
        if messages:
            self._mark.advance(messages[-1].sequence)
        self._known_topics.add(latest)
        with self._committed(connection):
            connection.executemany(_INSERT, rows)
            connection.executemany("INSERT OR REPLACE INTO latest VALUES (?, ?)", latest.items())
            marked = connection.executemany(
                "UPDATE messages SET sent = 1 WHERE sequence = ? AND NOT sent", [(mark,) for mark in marks]
            ).rowcount
            self._sent_since_trim += max(marked, 0)
            trims = self._sent_since_trim >= TRIM_EVERY
            if trims:
                self._trim(connection)
        if messages:
            self._confirm(messages[-1].sequence)
        self._unwritten.written(messages, marks)
        self._recent.update((m.sequence, m) for m in messages)
        for mark in marks:
            self._recent.pop(mark, None)
        while len(self._recent) > RECENT:
            del self._recent[next(iter(self._recent))]
        self._unsent += len(messages) - max(marked, 0)
        if trims:
            self._tend(connection)
        return [m.sequence for m in messages], max(marked, 0)

    def _confirm(self, last: int) -> None:
        """Note what was committed, and so see whether the disk still takes writes.

        An ext4 that fails has been seen to confirm the sync that it failed in. The commit is undone then, by
        `_reconnect`, and tried again.

        Raises:
            OSError: the disk takes no writes.
        """
        try:
            self._mark.note(last)
        except OSError:
            self._has_failed = True
            self._disconnect()
            raise

    @contextlib.contextmanager
    def _committed(self, connection: sqlite3.Connection) -> Iterator[None]:
        """A transaction; what cannot be committed must not be read, not even on this connection."""
        try:
            with _transaction(connection):
                yield
        except BaseException:
            self._has_failed = True
            if connection.in_transaction:
                self._disconnect()
            raise
        self._has_failed = False

    def is_short_of_room(self, error: Exception) -> bool:
        """Whether an error comes of a full disk, also if SQLite has other words for it."""
        try:
            return is_full(error) or (may_pass(error) and free_bytes(self.path.parent) < SHORT_BYTES)
        except OSError:
            return False

    def make_room(self) -> bool:
        """Make room on a full disk: the ballast, old corrupt files, then messages that the broker has.

        Returns:
            Whether there was something to gain.

        Raises:
            sqlite3.Error: not even that is possible.
        """
        if self._ballast.throw_off():
            log.warning(
                "outbox %s: the disk is full; the room that was held for this is in use",
                self.path,
                extra=coded(DISK_REFUSES),
            )
            return True
        if self._renewal.forget_aside(1):
            log.warning(
                "outbox %s: the disk is full; older corrupt files are deleted",
                self.path,
                extra=coded(DISK_REFUSES),
            )
            return True
        if not self._is_ready:
            return False
        connection = self._open_connection()
        with self._committed(connection):
            deleted = connection.execute(
                f"""
                DELETE FROM messages WHERE sequence IN
                (SELECT sequence FROM messages WHERE sent AND sequence NOT IN ({_IS_LATEST})
                 ORDER BY sequence LIMIT {TRIM_EVERY})
                """  # noqa: S608  constants only
            ).rowcount
        return deleted > 0

    def pending(self, after: int, limit: int) -> list[OutboxMessage]:
        """Messages above ``after`` that are not sent, in order, at most ``limit``."""
        marks = self._unwritten.marks
        try:
            messages = self._unsent_above(after, limit, marks)
        except (OutboxError, *FileError):
            recent = [m for m in self._recent.values() if m.sequence not in marks]
            if not self._shows or self._unsent > self._unwritten.marks_elsewhere() + len(recent):
                raise
            # Of all else in the journal, the broker has it.
            messages = [replace(m, stored=True) for m in recent if m.sequence > after][:limit]
        waiting = (m for m in self._shown() if m.sequence > after and m.sequence not in marks)
        return [*messages, *islice(waiting, limit - len(messages))]

    def _unsent_above(self, after: int, limit: int, marks: frozenset[int]) -> list[OutboxMessage]:
        where = "WHERE NOT sent AND sequence > ? AND sequence < ? ORDER BY sequence LIMIT ?"
        messages: list[OutboxMessage] = []
        while len(messages) < limit:
            some = self._select(where, after, self._first_unwritten() or LARGEST, limit)
            messages += [m for m in some if m.sequence not in marks]
            if len(some) < limit:
                break
            after = some[-1].sequence
        return messages[:limit]

    def following(self, after: int, limit: int) -> list[OutboxMessage]:
        """Messages above ``after`` that are still kept, sent or not, in order, at most ``limit``."""
        where = "WHERE sequence > ? AND sequence < ? ORDER BY sequence LIMIT ?"
        messages = self._select(where, after, self._first_unwritten() or LARGEST, limit)
        waiting = (m for m in self._shown() if m.sequence > after)
        return [*messages, *islice(waiting, limit - len(messages))]

    def retained(self) -> list[OutboxMessage]:
        """The latest retained message of each topic, if it is sent, in order."""
        if not self._unwritten:
            return self._select(f"WHERE sent AND sequence IN ({_IS_LATEST}) ORDER BY sequence")
        marks = self._unwritten.marks
        try:
            sent = marks.union(
                row[0]
                for row in self._reading().execute(
                    f"SELECT sequence FROM messages WHERE sent AND sequence IN ({_IS_LATEST})"  # noqa: S608  constants only
                )
            )
            latest = self.latest()
        except (OutboxError, *FileError):
            if not self._shows:
                raise
            sent, latest = marks, self._overlaid([])  # of what cannot be read, nothing is repeated
        return [message for message in latest if message.sequence in sent]

    def latest(self) -> list[OutboxMessage]:
        """The latest retained message of each topic, sent or not, in order."""
        where = f"WHERE sequence IN ({_IS_LATEST}) AND sequence < ? ORDER BY sequence"
        return self._overlaid(self._select(where, self._first_unwritten() or LARGEST))

    def _overlaid(self, there: Iterable[OutboxMessage]) -> list[OutboxMessage]:
        by_topic = {m.topic: m for m in (*there, *self._shown()) if m.retain}
        return sorted(by_topic.values(), key=lambda m: m.sequence)

    def _shown(self) -> Iterable[OutboxMessage]:
        return self._unwritten.messages if self._shows else ()

    def unsent(self) -> int:
        """How many messages on the disk are not marked as sent."""
        count: int = (
            self._open_connection().execute("SELECT count(*) FROM messages WHERE NOT sent").fetchone()[0]
        )
        self._unsent = count
        return count

    def close(self) -> None:
        """Close the file; whatever the disk does, nothing is raised."""
        self._close_view()
        is_whole = self._connection is not None and self._is_ready and not self._has_failed
        # What the broker may have and the journal has not, the next run must be able to find out.
        is_whole = is_whole and self._unwritten.first is None and not self._mark.is_ahead
        self._disconnect()
        self._is_ready = False
        if is_whole:
            try:
                self._mark.settle(self._next - 1)
            except OSError as error:
                log.warning(
                    "outbox mark of %s cannot be written: %s; numbers will jump",
                    self.path,
                    error,
                    extra=coded(DISK_REFUSES),
                )
        self._mark.close()
        if self._lock is not None:
            lock, self._lock = self._lock, None
            with contextlib.suppress(OSError):  # the system takes the lock back, whatever it states
                lock.close()

    def _close_view(self) -> None:
        if self._view is not None:
            view, self._view, self._viewed = self._view, None, None
            view.close()

    def _open_connection(self) -> sqlite3.Connection:
        if self._connection is None:
            if self._lock is None:
                raise OutboxError(f"outbox {self.path} is not open; call open() first")
            self._reconnect()
        if self._connection is None:
            raise OutboxError(f"outbox {self.path} cannot be opened again")
        return self._connection

    def _reading(self) -> sqlite3.Connection:
        """The journal; while it cannot be opened, a reader of it that needs no room on the disk.

        Raises:
            sqlite3.Error: it cannot be examined, or may hold what the disk never got (see `_prove`).
            OSError: as above.
        """
        if self._is_ready or self._connection is not None or self._lock is None:
            try:
                return self._open_connection()
            except FileError as error:
                if not may_pass(error) or self._lock is None:
                    raise
                log.debug("outbox %s is only read: %s", self.path, error)
        elif not self._may_view:
            raise sqlite3.OperationalError(f"outbox {self.path} is not open yet")
        if self._viewed is None:
            self._view = contextlib.ExitStack()
            self._viewed = self._view.enter_context(opened_to_read(self.path))
        return self._viewed

    def _select(self, where: str, *parameters: int) -> list[OutboxMessage]:
        rows = self._reading().execute(
            f"SELECT sequence, topic, payload, retain, checksum FROM messages {where}",  # noqa: S608  constants only
            parameters,
        )
        messages = []
        for sequence, topic, payload, retain, check in rows:
            if not is_sound(sequence, topic, payload, check):
                raise corruption(f"message {sequence} has changed on the disk")
            messages.append(OutboxMessage(sequence, topic, payload, bool(retain)))
        return messages

    def _trim(self, connection: sqlite3.Connection) -> None:
        """Delete the oldest of what is sent and beyond the limits; a bounded amount of work."""
        self._sent_since_trim = 0
        oldest_ns = self._wall_ns() - self._limits.alarms_keep_ns
        newest = connection.execute(
            "SELECT sequence FROM messages WHERE sent ORDER BY sequence DESC LIMIT 1 OFFSET ?",
            (self._limits.alarms_keep_at_least,),
        ).fetchone()
        spare_from = newest[0] if newest else 0
        for _ in range(TRIM_AT_MOST // TRIM_EVERY):
            over = used_bytes(connection) > self._limits.alarms_max_bytes
            deleted = connection.execute(
                f"""
                DELETE FROM messages WHERE sequence IN
                (SELECT sequence FROM
                 (SELECT sequence, wall_ns FROM messages WHERE sent AND sequence NOT IN ({_IS_LATEST})
                  ORDER BY sequence LIMIT {TRIM_EVERY})
                 WHERE ? OR (sequence <= ? AND wall_ns < ?))
                """,  # noqa: S608  constants only
                (over, spare_from, oldest_ns),
            ).rowcount
            if deleted < TRIM_EVERY:
                break

    def _tend(self, connection: sqlite3.Connection) -> None:
        """Now and then: give some of the free pages back to the disk, and have the ballast on board.

        Whatever was to be committed is; an error here must not have it committed again.
        """
        try:
            if pragma(connection, "freelist_count") > SLACK_PAGES:
                # A script, for `execute` would end this statement at its first page.
                connection.executescript(f"PRAGMA incremental_vacuum({SLACK_PAGES // 2})")
        except sqlite3.Error as error:
            log.warning("outbox %s cannot be made smaller: %s", self.path, error, extra=coded(DISK_REFUSES))
        self._ballast.allocate()


def refuse_store(store: Path) -> None:
    """Find a store that no start can use, before anything is done that takes long; blocks.

    All that it leaves in the store are the directory and its lock file, as `Journal.hold` does.

    Raises:
        OutboxError: as of `Journal.open`, if that will not pass by itself.
    """
    journal = Journal(store / JOURNAL_NAME, time.time_ns, OutboxLimits())
    try:
        journal.hold()
        refuse_newer(journal.path)
    except OutboxAwayError:
        return  # it may be back by the time the journal is opened
    finally:
        journal.close()


@contextlib.contextmanager
def _transaction(connection: sqlite3.Connection) -> Iterator[None]:
    """All or nothing, durable when it ends."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        raise


def _compare(connection: sqlite3.Connection) -> None:
    """See that the latest state of each topic is the one that it should be.

    Raises:
        sqlite3.DatabaseError: it is not; a flipped bit there would have an alarm forgotten.
    """
    odd = connection.execute(_ODD_LATEST).fetchone()
    if odd is not None:
        raise corruption(f"the latest state of {odd[0]} is another")
