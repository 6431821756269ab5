"""A corrupt journal gives way to a new one with what can still be read, in steps that any crash may cut off.

1. What can be read goes into ``<journal>.draft``, synced.
2. The draft becomes ``<journal>.saved``: from here on it is what counts.
3. The corrupt files become ``<journal>.corrupt-<ms>``.
4. The saved one becomes the journal.

Until the second step the corrupt journal is as it was, so that a start begins again; from there on, a start
goes on. What has happened is kept in ``<journal>.damage`` until an alarm has reported it.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import sqlite3
import stat
from dataclasses import asdict, dataclass
from itertools import chain
from typing import TYPE_CHECKING

from daqsvc.errors.code import coded
from daqsvc.errors.service import JOURNAL_DAMAGED
from daqsvc.outbox.files import (
    ASIDE_KEPT,
    MODE,
    NS_PER_MS,
    SIDE_FILES,
    check,
    create,
    delete,
    read_whole,
    replace_durably,
    sync_directory,
    sync_file,
)
from daqsvc.outbox.log_copy import ASIDE_SUFFIX
from daqsvc.outbox.salvage import LARGEST, readable
from daqsvc.outbox.tables import FILL_LATEST, bring_up_to_date

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator
    from pathlib import Path

    from daqsvc.outbox.tables import Row

log = logging.getLogger(__name__)

_INSERT = "INSERT OR IGNORE INTO messages VALUES (?, ?, ?, ?, ?, ?, ?)"


@dataclass(frozen=True, slots=True)
class JournalDamage:
    """Damage to a journal that no alarm has reported yet.

    Attributes:
        quarantined: corrupt files set aside.
        vanished: messages that it no longer knew, at least.
    """

    quarantined: int = 0
    vanished: int = 0


class Renewal:
    """The files of a journal that is being replaced.

    Args:
        path: the journal.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._draft = path.with_name(path.name + ".draft")
        self._saved = path.with_name(path.name + ".saved")
        self._note = path.with_name(path.name + ".damage")

    def finish(self) -> Path | None:
        """Go on with what a crash has cut off, before the journal is opened.

        Returns:
            Where the corrupt file is by now; None if there was nothing to finish.

        Raises:
            sqlite3.Error: the new journal cannot be written.
            OSError: as above.
        """
        delete(self._draft)
        if self._saved.exists():
            return self._swap()
        aside = next(iter(self.aside()), None)
        if self._path.exists() or aside is None:
            return None
        # An earlier version renamed first and saved afterwards, and was cut off in between.
        for suffix in SIDE_FILES[1:]:
            part, target = _part(self._path, suffix), _part(aside, suffix)
            if part.exists() and not target.exists():
                part.rename(target)
        self.save(aside, LARGEST, 0, 0)
        return self._swap()

    def save(self, source: Path, below: int, last: int, wall_ns: int, others: Collection[Row] = ()) -> int:
        """Write what can be read of ``source`` into a new file: all of it, or on a full disk what is needed.

        Args:
            source: the corrupt journal.
            below: the first number that was never used.
            last: the highest number that was, as far as the side files show.
            wall_ns: wall clock, ns since the Unix epoch.
            others: messages from elsewhere, which count where the source does not hold them.

        Returns:
            How many messages were saved.

        Raises:
            sqlite3.Error: the new file cannot be written; the corrupt one is as it was.
            OSError: as above.
        """
        try:
            count = self._write(chain(readable(source, below), others), source, last, wall_ns)
        except (sqlite3.Error, OSError) as error:
            log.warning(
                "outbox %s: not all can be saved (%s); trying what is needed",
                self._path,
                error,
                extra=coded(JOURNAL_DAMAGED),
            )
            needed = (row for row in others if row[3] or not row[4])
            count = self._write(chain(_needed(source, below), needed), source, last, wall_ns)
        self._draft.rename(self._saved)
        sync_directory(self._path.parent)
        return count

    def replace(self, damage: JournalDamage) -> Path:
        """Put what was saved in the place of the corrupt journal.

        Args:
            damage: what is to be reported of it.

        Returns:
            Where the corrupt file is by now.

        Raises:
            OSError: a file cannot be renamed.
        """
        self.remember(damage)
        return self._swap()

    def aside(self) -> list[Path]:
        """Corrupt files that were set aside, the newest first."""
        parts = [
            old
            for old in self._path.parent.glob(f"{self._path.name}.corrupt-*")
            if not old.name.endswith((*SIDE_FILES[1:], ASIDE_SUFFIX))
        ]
        return sorted(parts, key=lambda old: (old.stat().st_mtime_ns, old.name), reverse=True)

    def forget_aside(self, keep: int) -> bool:
        """Delete corrupt files but for the newest; whether there were any."""
        old = self.aside()[keep:]
        for each in old:
            delete(each)
        return bool(old)

    def remember(self, damage: JournalDamage) -> None:
        """Keep over a crash what is still to be sent."""
        try:
            replace_durably(self._note, json.dumps(asdict(damage)).encode())
        except OSError as error:
            log.warning(
                "outbox %s: after a crash its damage will not be known: %s",
                self._path,
                error,
                extra=coded(JOURNAL_DAMAGED),
            )

    def untold(self) -> JournalDamage:
        """What an earlier run could not report any more."""
        try:
            note = json.loads(read_whole(self._note, 1024))
            return JournalDamage(int(note["quarantined"]), int(note["vanished"]))
        except FileNotFoundError:
            return JournalDamage()
        except (OSError, ValueError, KeyError, TypeError) as error:
            log.info("the record of damage in %s cannot be read: %s", self._note, error)
            return JournalDamage(quarantined=1)

    def is_reported(self) -> None:
        """It was sent."""
        with contextlib.suppress(FileNotFoundError):
            self._note.unlink()

    def _write(self, rows: Iterable[Row], source: Path, last: int, wall_ns: int) -> int:
        delete(self._draft)
        try:
            with contextlib.closing(_new(self._draft, source)) as draft:
                bring_up_to_date(draft, 0, wall_ns)
                draft.execute("BEGIN IMMEDIATE")
                draft.executemany(_INSERT, rows)
                draft.execute(FILL_LATEST)
                count, highest = draft.execute("SELECT count(*), max(sequence) FROM messages").fetchone()
                draft.execute("DELETE FROM sqlite_sequence WHERE name = 'messages'")
                draft.execute(
                    "INSERT INTO sqlite_sequence VALUES ('messages', ?)", (max(highest or 0, last),)
                )
                draft.execute("COMMIT")
                check(draft, thorough=True)
            sync_file(self._draft)
        except BaseException:
            delete(self._draft)
            raise
        return int(count)

    def _swap(self) -> Path:
        if not self._note.exists():
            self.remember(JournalDamage(quarantined=1))
        aside = self._aside_name()
        for suffix in (*SIDE_FILES[1:], ""):
            part = _part(self._path, suffix)
            if part.exists():
                part.rename(_part(aside, suffix))
        sync_directory(self._path.parent)
        self._saved.rename(self._path)
        sync_directory(self._path.parent)
        self.forget_aside(ASIDE_KEPT)
        return aside

    def _aside_name(self) -> Path:
        """A name that is the same when a crash has cut the renaming off."""
        stamp = self._saved.stat().st_mtime_ns // NS_PER_MS
        while (aside := self._path.with_name(f"{self._path.name}.corrupt-{stamp}")).exists():
            if not self._path.exists():
                break
            stamp += 1
        return aside


def _new(path: Path, like: Path) -> sqlite3.Connection:
    """A file that is only made or deleted as a whole, so it needs no journal of its own."""
    os.close(create(path))
    path.chmod(stat.S_IMODE(like.stat().st_mode) & MODE)
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("PRAGMA auto_vacuum = INCREMENTAL")
    connection.execute("PRAGMA journal_mode = OFF")
    connection.execute("PRAGMA synchronous = OFF")
    return connection


def _needed(source: Path, below: int) -> Iterator[Row]:
    """What is not sent, and the latest state of each topic."""
    latest: dict[str, int] = {}
    for row in readable(source, below):
        if row[3]:
            latest[row[1]] = max(row[0], latest.get(row[1], 0))
    return (row for row in readable(source, below) if not row[4] or latest.get(row[1]) == row[0])


def _part(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)
