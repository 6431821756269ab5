"""What can still be read of a corrupt journal."""

from __future__ import annotations

import contextlib
import logging
import mmap
import os
import sqlite3
from itertools import chain, islice
from typing import TYPE_CHECKING

from daqsvc.outbox.log_rows import rows_in_pages
from daqsvc.outbox.tables import sound_row

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from daqsvc.outbox.tables import Row

log = logging.getLogger(__name__)

LARGEST = 2**53
"""Numbers stay below what every reader of JSON can tell apart."""

_ROWS = "SELECT sequence, topic, payload, retain, sent, wall_ns, checksum FROM messages NOT INDEXED "
_FROM_BOTH_ENDS = (f"{_ROWS} ORDER BY sequence ASC", f"{_ROWS} ORDER BY sequence DESC")
_ONE = f"{_ROWS} WHERE sequence = ?"
_UNSENT = "SELECT sequence FROM messages INDEXED BY unsent WHERE NOT sent"
_SENT = "SELECT sequence FROM messages INDEXED BY sent WHERE sent"

_SMALLEST_ROW = 16
"""Bytes that a row takes at least. A file whose pages point at each other must not be read for ever."""

_PROBES = 100_000
"""Rows between two bad pages that are looked for one by one."""


def readable(path: Path, below: int = LARGEST) -> Iterator[Row]:
    """The rows of ``messages`` that can be read and have kept their checksum.

    The table is read from both ends, and what lies between two bad pages number by number. No checksum covers
    whether a message is sent: one that the row or the index takes for unsent, or that states neither, is sent
    again. One of which it is not known whether it is retained, is. If SQLite finds nothing at all, since the
    first page is lost or the table's own, the pages are read one by one.

    Args:
        path: the corrupt file.
        below: the first number that was never used.

    Yields:
        Each row once.
    """
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as broken:
        broken.text_factory = bytes  # or one bad name would end it
        most = path.stat().st_size // _SMALLEST_ROW
        unsent = _numbers(broken, _UNSENT, most, path)
        seen: set[int] = set()

        def new(rows: Iterable[tuple[object, ...]]) -> Iterator[Row]:
            for raw in rows:
                row = sound_row(raw, unsent)
                if row is not None and row[0] < below and row[0] not in seen:
                    seen.add(row[0])
                    yield row

        reached = []
        for query in _FROM_BOTH_ENDS:
            row = None
            for row in new(_up_to_a_point(broken, query, most, path)):
                yield row
            reached.append(row)
        between = range(0)
        if reached[0] is not None and reached[1] is not None:
            between = range(reached[0][0] + 1, reached[1][0])
        named = sorted((unsent | _numbers(broken, _SENT, most, path)) - seen)
        for number in chain(named, islice(between, _PROBES)):
            if number not in seen:
                yield from new(_up_to_a_point(broken, _ONE, 1, path, number))
    if not seen:
        yield from _page_by_page(path, below)


def _page_by_page(path: Path, below: int) -> Iterator[Row]:
    """What the pages hold. A message that is in one as sent was marked after any other copy was made."""
    with path.open("rb") as file:
        if not os.fstat(file.fileno()).st_size:
            return
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            rows: dict[int, Row] = {}
            for row in rows_in_pages(content):
                if row[0] < below and (row[0] not in rows or row[4]):
                    rows[row[0]] = row
    yield from (rows[number] for number in sorted(rows))


def _numbers(broken: sqlite3.Connection, query: str, most: int, path: Path) -> set[int]:
    return {row[0] for row in _up_to_a_point(broken, query, most, path) if isinstance(row[0], int)}


def _up_to_a_point(
    broken: sqlite3.Connection, query: str, most: int, path: Path, *parameters: int
) -> Iterator[tuple[object, ...]]:
    try:
        yield from islice(broken.execute(query, parameters), most)
    except (sqlite3.Error, ValueError, OverflowError) as error:
        log.debug("corrupt outbox %s could be read up to a point: %s", path, error)
