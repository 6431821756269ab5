"""A small database that is corrupt gives way to a new one with the rows that can still be read.

As of the journal (see `outbox.renewal`), what can be read is in a new file, synced and under its own name,
before the corrupt one is touched. So nothing readable is lost, whatever fails and wherever a crash comes.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sqlite3
from typing import TYPE_CHECKING, Any

from daqsvc.outbox.files import create, delete, set_aside, sync_directory, sync_file

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

log = logging.getLogger(__name__)


def rescue(
    path: Path,
    table: str,
    make: Callable[[sqlite3.Connection], object],
    is_row_sound: Callable[[tuple[Any, ...]], bool],
    wall_ns: int,
) -> tuple[Path | None, int]:
    """Put a new file with what can be read in the place of a corrupt one, which is set aside.

    Args:
        path: the corrupt file.
        table: its one table, whose first column is the integer key.
        make: makes the table in the new file.
        is_row_sound: whether a row is what was written.
        wall_ns: wall clock, ns since the Unix epoch.

    Returns:
        Where the corrupt file is by now, and how many rows were saved.

    Raises:
        sqlite3.Error: the new file cannot be written; the corrupt one is as it was.
        OSError: as above.
    """
    rows = _rows(path, table, is_row_sound)
    draft = path.with_name(path.name + ".draft")
    delete(draft)
    os.close(create(draft))
    try:
        with contextlib.closing(sqlite3.connect(draft, isolation_level=None)) as new:
            make(new)
            if rows:
                places = ", ".join("?" * len(next(iter(rows.values()))))
                new.execute("BEGIN")
                new.executemany(f"INSERT INTO {table} VALUES ({places})", rows.values())  # noqa: S608  a constant
                new.execute("COMMIT")
        sync_file(draft)
    except BaseException:
        delete(draft)
        raise
    draft.rename(_saved(path))
    sync_directory(path.parent)
    return finish(path, wall_ns), len(rows)


def finish(path: Path, wall_ns: int) -> Path | None:
    """Go on with what a crash has cut off; where the corrupt file is by now, None if there was none.

    Raises:
        OSError: a file cannot be renamed.
    """
    saved = _saved(path)
    if not saved.exists():
        return None
    aside = set_aside(path, wall_ns) if path.exists() else None
    saved.rename(path)
    sync_directory(path.parent)
    return aside


def _rows(
    path: Path, table: str, is_row_sound: Callable[[tuple[Any, ...]], bool]
) -> dict[int, tuple[Any, ...]]:
    """From both ends, up to a bad page."""
    rows: dict[int, tuple[Any, ...]] = {}
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as broken:
        broken.text_factory = lambda raw: raw.decode(errors="replace")
        for order in ("ASC", "DESC"):
            try:
                for row in broken.execute(f"SELECT * FROM {table} NOT INDEXED ORDER BY 1 {order}"):  # noqa: S608  constants
                    if is_row_sound(row):
                        rows[row[0]] = row
            except (sqlite3.Error, ValueError, OverflowError) as error:
                log.debug("corrupt file %s could be read up to a point: %s", path, error)
    return rows


def _saved(path: Path) -> Path:
    return path.with_name(path.name + ".saved")
