"""What can still be read of a corrupt journal."""

from __future__ import annotations

import contextlib
import logging
import sqlite3
from itertools import chain, islice
from typing import TYPE_CHECKING, TypeAlias

from daqsvc.outbox.messages import is_sound

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    Row: TypeAlias = tuple[int, str, bytes, int, int, int, int]

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
    whether a message is sent: one that the row or the index takes for unsent, or that says neither, is sent
    again. One of which nobody knows whether it is retained, is.

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


def _numbers(broken: sqlite3.Connection, query: str, most: int, path: Path) -> set[int]:
    return {row[0] for row in _up_to_a_point(broken, query, most, path) if isinstance(row[0], int)}


def _up_to_a_point(
    broken: sqlite3.Connection, query: str, most: int, path: Path, *parameters: int
) -> Iterator[tuple[object, ...]]:
    try:
        yield from islice(broken.execute(query, parameters), most)
    except (sqlite3.Error, ValueError, OverflowError) as error:
        log.debug("corrupt outbox %s could be read up to a point: %s", path, error)


def sound_row(raw: tuple[object, ...], unsent: set[int]) -> Row | None:
    """What a row says; None if it has changed on the disk.

    Args:
        raw: its columns as they were read, text as bytes.
        unsent: numbers of messages that another source takes for unsent.
    """
    sequence, name, payload, retain, sent, wall_ns, told = raw
    try:
        topic = name.decode() if isinstance(name, bytes) else None
    except UnicodeDecodeError:
        return None
    if not (isinstance(sequence, int) and isinstance(topic, str) and isinstance(payload, bytes)):
        return None
    if not isinstance(told, int) or not is_sound(sequence, topic, payload, told):
        return None
    is_sent = sent == 1 and sequence not in unsent
    written_ns = wall_ns if isinstance(wall_ns, int) else 0
    return sequence, topic, payload, int(retain != 0), int(is_sent), written_ns, told
