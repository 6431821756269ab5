"""What can still be read of a corrupt journal."""

from __future__ import annotations

import contextlib
import logging
import sqlite3
from itertools import islice
from typing import TYPE_CHECKING, TypeAlias

from daqsvc.outbox.messages import is_sound

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    Row: TypeAlias = tuple[int, str, bytes, int, int, int, int]

log = logging.getLogger(__name__)

_ROWS = """
SELECT sequence, topic, payload, retain, sent, wall_ns, checksum
FROM messages NOT INDEXED ORDER BY sequence {}
"""

_SMALLEST_ROW = 16
"""Bytes that a row takes at least. A file whose pages point at each other must not be read for ever."""


def readable(path: Path, below: int) -> Iterator[Row]:
    """The rows of ``messages`` that can be read and have kept their checksum, some of them twice.

    The table is read from both ends, so that one bad page does not hide what lies behind it.

    Args:
        path: the corrupt file.
        below: the first number that was never used.
    """
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as broken:
        for order in ("ASC", "DESC"):
            try:
                rows = broken.execute(_ROWS.format(order))
                for row in islice(rows, path.stat().st_size // _SMALLEST_ROW):
                    if _is_sound(row, below):
                        yield row
            except (sqlite3.Error, ValueError, OverflowError) as error:
                log.info("corrupt outbox %s could be read up to a point, %s: %s", path, order, error)


def _is_sound(row: Row, below: int) -> bool:
    sequence, topic, payload, retain, sent, wall_ns, told = row
    return (
        told is not None
        and is_sound(sequence, topic, payload, told)
        and sequence < below
        and retain in {0, 1}
        and sent in {0, 1}
        and isinstance(wall_ns, int)
    )
