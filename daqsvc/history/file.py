"""The file of trends and alarm events: what is kept in it, for how long, and how it is read.

Seconds come in as they are; once an hour is over they are packed, summed up to minutes and hours, and let go.
So nothing that was written is lost with the process, and months fit (``docs/decisions/0019``).
"""

from __future__ import annotations

import json
import os
import sqlite3
import zlib
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.errors.command_line import NOTHING_RECORDED
from daqsvc.history.points import (
    HOUR_S,
    RECORD,
    DamagedChunkError,
    Step,
    TrendPoints,
    gathered,
    merge,
    pack,
    spread,
    summed_up,
    unpack,
    weighed,
)
from daqsvc.outbox.files import SIDE_FILES, create, restrict, used_bytes

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

NAME = "history.sqlite"
VERSION = 1
SETTLED_S = 60
"""An hour is packed so long after its end: what was measured in it is written by then."""
EVENTS_SHARE = 0.25
"""Of the file's size, what alarm events may take."""
BUSY_S = 5.0
MOST_NS = 1 << 63
"""What SQLite has no number for."""

_TABLES = """
CREATE TABLE IF NOT EXISTS series (
    id INTEGER PRIMARY KEY, machine TEXT NOT NULL, detector TEXT NOT NULL, kind TEXT NOT NULL,
    key TEXT NOT NULL, unit TEXT NOT NULL, UNIQUE (machine, detector, kind, key, unit));
CREATE TABLE IF NOT EXISTS piece (series INTEGER NOT NULL, hour_s INTEGER NOT NULL, data BLOB NOT NULL);
CREATE INDEX IF NOT EXISTS piece_by_series ON piece (series, hour_s);
CREATE TABLE IF NOT EXISTS chunk (
    series INTEGER NOT NULL, step_s INTEGER NOT NULL, begin_s INTEGER NOT NULL, data BLOB NOT NULL,
    UNIQUE (series, step_s, begin_s));
CREATE INDEX IF NOT EXISTS chunk_by_time ON chunk (step_s, begin_s);
CREATE TABLE IF NOT EXISTS event (
    sequence INTEGER PRIMARY KEY, wall_ns INTEGER NOT NULL, machine TEXT NOT NULL, payload BLOB NOT NULL);
CREATE INDEX IF NOT EXISTS event_by_machine ON event (machine, wall_ns);
"""


class NewerHistoryError(Exception):
    """The file was written by a newer version; the text states it."""

    code = NOTHING_RECORDED


class EmptyHistoryError(Exception):
    """The file holds no history, not even an empty one; the text states it."""

    code = NOTHING_RECORDED


class Series(NamedTuple):
    """Which figure it is: see `daqsvc.diagnosis.reading.Reading`."""

    machine: str
    detector: str
    kind: str
    key: str
    unit: str

    @property
    def name(self) -> str:
        """What a person calls it, e.g. ``levels/shaft-x.rms``."""
        return f"{self.detector}.{self.key}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Keeping:
    """How much is kept.

    Attributes:
        spans: by step, how many chunks of each series; older ones are deleted. They are counted, not dated: a
            wall clock that is wrong for a while deletes nothing.
        max_bytes: of the whole file; beyond that the oldest seconds go first, then events, minutes, hours.
    """

    spans: Mapping[Step, int]
    max_bytes: int


class Event(NamedTuple):
    """An alarm event.

    Attributes:
        sequence: its number in the journal.
        wall_ns: when it happened.
        machine: whose alarm.
        payload: the message, JSON.
    """

    sequence: int
    wall_ns: int
    machine: str
    payload: bytes


class HistoryReader:
    """The file, to read only, also while a service writes it.

    Args:
        path: of the file.

    Raises:
        sqlite3.Error: it cannot be opened, or is damaged.
        NewerHistoryError: a newer version wrote it.
        EmptyHistoryError: no service has written anything into it.
    """

    def __init__(self, path: Path) -> None:
        self._sql = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=BUSY_S)
        try:
            _check_version(self._sql, path)
            _refuse_empty(self._sql, path)
            self._ids = {Series(*row[1:]): int(row[0]) for row in self._sql.execute("SELECT * FROM series")}
        except BaseException:
            self._sql.close()
            raise

    def close(self) -> None:
        """Release the file."""
        self._sql.close()

    @property
    def last_sequence(self) -> int:
        """Number of the newest alarm event that is in it."""
        return int(self._sql.execute("SELECT COALESCE(MAX(sequence), 0) FROM event").fetchone()[0])

    def series(self, machine: str | None = None) -> list[Series]:
        """The figures that there are, of one machine or all, by name."""
        return sorted(one for one in self._ids if machine in {None, one.machine})

    def trend(self, series: Series, step: Step, since_s: float, until_s: float) -> TrendPoints:
        """A figure over time.

        Args:
            series: which.
            step: from point to point.
            since_s: begin, s since the Unix epoch.
            until_s: end, exclusive.

        Raises:
            sqlite3.Error: the file cannot be read.
            KeyError: there is no such figure.
        """
        number = self._ids[series]
        parts = [np.empty(0, RECORD)]
        rows = self._sql.execute(
            "SELECT begin_s, data FROM chunk "
            "WHERE series = ? AND step_s = ? AND begin_s > ? AND begin_s < ? ORDER BY begin_s",
            (number, int(step), since_s - step.span_s, until_s),
        )
        for begin_s, data in rows:
            try:
                parts.append(gathered(unpack(data, step), step, begin_s))
            except DamagedChunkError:
                continue  # as if nothing had been measured
        recent = self._pieces(number, since_s - 2 * HOUR_S, until_s)
        found = summed_up(weighed(np.concatenate(parts), summed_up(recent, step)), step)
        found = found[(found["t_s"] >= since_s) & (found["t_s"] < until_s)]
        return TrendPoints(
            found["t_s"], found["low"], found["mean"], found["high"], found["n"].astype(np.int64)
        )

    def events(self, machine: str | None, since_s: float, until_s: float) -> list[Event]:
        """Alarm events of a machine, or of all, in order.

        Raises:
            sqlite3.Error: the file cannot be read.
        """
        rows = self._sql.execute(
            "SELECT * FROM event WHERE wall_ns >= ? AND wall_ns < ? AND (? IS NULL OR machine = ?) "
            "ORDER BY sequence",
            (max(int(since_s * 1e9), 0), min(int(until_s * 1e9), MOST_NS - 1), machine, machine),
        )
        return [Event(number, wall_ns, name, zlib.decompress(data)) for number, wall_ns, name, data in rows]

    def oldest_s(self, step: Step) -> float | None:
        """Begin of the oldest chunk of a step; None if there is none."""
        row = self._sql.execute("SELECT MIN(begin_s) FROM chunk WHERE step_s = ?", (int(step),)).fetchone()
        return None if row[0] is None else float(row[0])

    def _pieces(self, number: int, since_s: float, until_s: float) -> NDArray[np.void]:
        rows = self._sql.execute(
            "SELECT data FROM piece WHERE series = ? AND hour_s >= ? AND hour_s < ?",
            (number, since_s, until_s),
        )
        parts = [
            np.frombuffer(data[: len(data) // RECORD.itemsize * RECORD.itemsize], RECORD) for (data,) in rows
        ]
        return np.concatenate([np.empty(0, RECORD), *parts])


class HistoryFile(HistoryReader):
    """The file, for one writer at a time; not for several threads at once.

    Args:
        path: made if need be.

    Raises:
        sqlite3.Error: it cannot be opened, or is damaged.
        OSError: it cannot be made.
        NewerHistoryError: a newer version wrote it.
    """

    def __init__(self, path: Path) -> None:
        if not os.path.lexists(path):
            # SQLite would ask the umask; the files beside a database get the mode of the database.
            os.close(create(path))
        for suffix in SIDE_FILES:
            restrict(path.with_name(path.name + suffix))
        # Each call may come from a separate thread, one after the other.
        self._sql = sqlite3.connect(path, isolation_level=None, timeout=BUSY_S, check_same_thread=False)
        try:
            _check_version(self._sql, path)
            self._sql.execute("PRAGMA auto_vacuum = INCREMENTAL")
            self._sql.execute("PRAGMA journal_mode = WAL")
            # A power cut may take the last seconds, and never damages the file.
            self._sql.execute("PRAGMA synchronous = NORMAL")
            self._sql.executescript(_TABLES)
            self._sql.execute(f"PRAGMA user_version = {VERSION}")
            self._ids = {Series(*row[1:]): int(row[0]) for row in self._sql.execute("SELECT * FROM series")}
        except BaseException:
            self._sql.close()
            raise

    def write(self, seconds: Mapping[Series, NDArray[np.void]], events: Sequence[Event] = ()) -> None:
        """Add seconds (`RECORD`, in any order) and alarm events, all or nothing.

        Raises:
            sqlite3.Error: nothing was written.
        """
        with self._transaction():
            for series, records in seconds.items():
                hours = records["t_s"] // HOUR_S * HOUR_S
                for hour_s in np.unique(hours).tolist():
                    row = (self._id(series), hour_s, records[hours == hour_s].tobytes())
                    self._sql.execute("INSERT INTO piece VALUES (?, ?, ?)", row)
            self._sql.executemany(
                "INSERT OR IGNORE INTO event VALUES (?, ?, ?, ?)",
                [(*event[:3], zlib.compress(event.payload)) for event in events],
            )

    def pack(self, now_s: float) -> Iterator[int]:
        """Pack the hours that are over, a series at a time; yields the chunks that were damaged and are lost.

        Args:
            now_s: wall clock.

        Raises:
            sqlite3.Error: what was packed so far stays so.
        """
        until_s = (now_s - SETTLED_S) // HOUR_S * HOUR_S
        rows = self._sql.execute(
            "SELECT DISTINCT series, hour_s FROM piece WHERE hour_s < ? ORDER BY series, hour_s", (until_s,)
        ).fetchall()
        for number, hour_s in rows:
            with self._transaction():
                damaged = self._pack(number, hour_s)
            yield damaged

    def _pack(self, number: int, hour_s: int) -> int:
        records = self._pieces(number, hour_s, hour_s + HOUR_S)
        damaged = 0
        for step in Step:
            summed = summed_up(records, step)
            begin_s = hour_s // step.span_s * step.span_s
            dense = spread(summed, step, begin_s)
            key = (number, int(step), begin_s)
            row = self._sql.execute(
                "SELECT data FROM chunk WHERE series = ? AND step_s = ? AND begin_s = ?", key
            ).fetchone()
            if row is not None:
                try:
                    dense = merge(unpack(row[0], step), dense)
                except DamagedChunkError:
                    damaged += 1
            self._sql.execute("INSERT OR REPLACE INTO chunk VALUES (?, ?, ?, ?)", (*key, pack(dense)))
        self._sql.execute("DELETE FROM piece WHERE series = ? AND hour_s = ?", (number, hour_s))
        return damaged

    def keep(self, keeping: Keeping) -> None:
        """Delete what is too old, or too much.

        Raises:
            sqlite3.Error: the disk takes no writes.
        """
        for step, spans in keeping.spans.items():
            row = self._sql.execute(
                "SELECT DISTINCT begin_s FROM chunk WHERE step_s = ? ORDER BY begin_s DESC LIMIT 1 OFFSET ?",
                (int(step), spans),
            ).fetchone()
            if row is not None:
                self._sql.execute("DELETE FROM chunk WHERE step_s = ? AND begin_s <= ?", (int(step), row[0]))
        self._drop_events(int(EVENTS_SHARE * keeping.max_bytes))
        for step in Step:
            while used_bytes(self._sql) > keeping.max_bytes and self._drop_oldest(step):
                pass
        # A page a step: `execute` takes one only.
        self._sql.executescript("PRAGMA incremental_vacuum")
        self._sql.execute("PRAGMA wal_checkpoint(TRUNCATE)")

    def _drop_oldest(self, step: Step) -> bool:
        """Delete the oldest chunk of each series, but never the newest."""
        oldest, newest = self._sql.execute(
            "SELECT MIN(begin_s), MAX(begin_s) FROM chunk WHERE step_s = ?", (int(step),)
        ).fetchone()
        if oldest == newest:
            return False
        self._sql.execute("DELETE FROM chunk WHERE step_s = ? AND begin_s = ?", (int(step), oldest))
        return True

    def _drop_events(self, max_bytes: int) -> None:
        total, many = self._sql.execute(
            "SELECT COALESCE(SUM(LENGTH(payload)), 0), COUNT(*) FROM event"
        ).fetchone()
        if total > max_bytes:
            # They are about as long as each other: a share of them is that share of the bytes.
            [first] = self._sql.execute(
                "SELECT sequence FROM event ORDER BY sequence LIMIT 1 OFFSET ?",
                (many - 1 - int((many - 1) * max_bytes / total),),
            ).fetchone()
            self._sql.execute("DELETE FROM event WHERE sequence < ?", (first,))

    def _id(self, series: Series) -> int:
        if series not in self._ids:
            done = self._sql.execute("INSERT INTO series VALUES (NULL, ?, ?, ?, ?, ?)", series)
            self._ids[series] = int(done.lastrowid or 0)
        return self._ids[series]

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        ids = dict(self._ids)
        self._sql.execute("BEGIN IMMEDIATE")
        try:
            yield
            self._sql.execute("COMMIT")
        except BaseException:
            self._ids = ids
            if self._sql.in_transaction:
                self._sql.execute("ROLLBACK")
            raise


def _check_version(connection: sqlite3.Connection, path: Path) -> None:
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if version > VERSION:
        raise NewerHistoryError(
            f"{path} was written by a newer version of daqsvc (its form is {version}, this version knows "
            f"{VERSION}); install that again, or move the file away to begin again"
        )


def _refuse_empty(connection: sqlite3.Connection, path: Path) -> None:
    """See that the tables are there; a writer would make them."""
    if connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'series'").fetchone() is None:
        raise EmptyHistoryError(
            f"{path} holds nothing yet; start the service with [history] in the machine file, which fills "
            "it, or name another store with --store"
        )


def events_of(messages: Iterable[tuple[int, bytes]]) -> list[Event]:
    """Alarm events from messages of the journal, each with its number; what is none is left out."""
    found = []
    for sequence, payload in messages:
        try:
            document = json.loads(payload)
            if not str(document["schema"]).startswith("daqsvc.alarm/"):
                continue
            wall_ns = int(document["wall_ns"])
            if 0 <= wall_ns < MOST_NS:
                found.append(Event(sequence, wall_ns, str(document["machine"]), payload))
        except (ValueError, TypeError, KeyError):
            continue
    return found
