"""Text for people in a terminal: aligned columns, ages, and names that could hold anything."""

from __future__ import annotations

import textwrap
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Sequence

_AGES = ((86_400, "d"), (3600, "h"), (60, "min"))
_GAP = "  "
LEAST_WIDTH = 30
"""What the last column has at least, however long the names before it are."""


def aligned(titles: Sequence[str], rows: Sequence[Sequence[str]], width: int | None = None) -> str:
    """A table, each row on a line.

    Args:
        titles: of the columns.
        rows: a text for each column.
        width: of the terminal: the last column is wrapped to it; None to wrap nothing.
    """
    lines = [list(titles), *([harmless(cell) for cell in row] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    indent = sum(widths[:-1]) + len(_GAP) * (len(widths) - 1)
    rendered: list[str] = []
    for line in lines:
        *cells, last = line
        parts = [last] if width is None else wrapped(last, max(width - indent, LEAST_WIDTH))
        first = [cell.ljust(width) for cell, width in zip(cells, widths, strict=False)]
        rendered.append(_GAP.join([*first, parts[0]]).rstrip())
        rendered += [" " * indent + part for part in parts[1:]]
    return "\n".join(rendered)


def wrapped(text: str, width: int) -> list[str]:
    """The lines of a text, at least one; words are not broken."""
    return textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False) or [""]


def harmless(text: str) -> str:
    """The text without control characters, which could change the state of a terminal."""
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)


def local_time(wall_ns: int) -> str:
    """A time of the wall clock where the reader is, to the second."""
    return datetime.fromtimestamp(wall_ns // NS_PER_S, UTC).astimezone().strftime("%Y-%m-%d %H:%M:%S")


def ago(age_ns: int) -> str:
    """An age in its largest unit, e.g. ``12 min``; the wall clock may have stepped since."""
    age_s = age_ns // NS_PER_S
    if age_s < -60:
        return "the clock was ahead"
    for unit_s, name in _AGES:
        if age_s >= unit_s:
            return f"{age_s // unit_s} {name}"
    return f"{max(age_s, 0)} s"
