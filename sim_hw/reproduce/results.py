"""What a study finds: statements of the paper beside what was obtained, and how they are written."""

from __future__ import annotations

import csv
import shutil
import textwrap
from collections.abc import Mapping  # noqa: TC003 - the page of formats reads the types
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from matplotlib.figure import Figure

HEADINGS = ("figure", "the paper states", "obtained", "agrees", "remark")
_SHARES = (0.31, 0.34, 0.35)
"""Shares of the three long columns of the printed table."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultRow:
    """One statement of the paper, and what became of it.

    Attributes:
        name: of the row, for programs.
        figure: figure or section of the paper that it belongs to.
        paper: what the paper states; empty where it is silent.
        obtained: what was obtained, in words and figures.
        agrees: whether the two agree; null in JSON where there is nothing to compare.
        remark: what the reader should know about it.
        values: the numbers behind ``obtained``, units in their names.
    """

    name: str
    figure: str
    paper: str
    obtained: str
    agrees: bool | None
    remark: str = ""
    values: Mapping[str, float] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """The row as a JSON object."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Findings:
    """The results of a study.

    Attributes:
        rows: its part of the table.
        figures: for each figure file, by its name without ending, what draws it onto an empty figure.
    """

    rows: tuple[ResultRow, ...]
    figures: Mapping[str, Callable[[Figure], None]]


def write_csv(path: Path, rows: Iterable[ResultRow]) -> None:
    """The table for programs: one line for each number, rows without numbers on one line of their own.

    Raises:
        OSError: the file cannot be written.
    """
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("name", *HEADINGS, "quantity", "value"))
        for row in rows:
            texts = (row.name, row.figure, row.paper, row.obtained, _verdict(row), row.remark)
            writer.writerows((*texts, *number) for number in row.values.items() or [("", "")])


def write_markdown(path: Path, rows: Iterable[ResultRow], *, heading: str) -> None:
    """The table for people.

    Args:
        path: the file.
        rows: the table.
        heading: paragraph above the table.

    Raises:
        OSError: the file cannot be written.
    """
    lines = ["# What the paper states, and what was obtained", "", heading, ""]
    lines += ["| " + " | ".join(HEADINGS) + " |", "|---" * len(HEADINGS) + "|"]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in _cells(row)) + " |" for row in rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def as_text(rows: Iterable[ResultRow], width: int | None = None) -> str:
    """The table for a terminal.

    Args:
        rows: the table.
        width: characters in a line; the terminal's if not given, 110 where there is none.
    """
    width = width or shutil.get_terminal_size((110, 24)).columns
    short = (9, 6)
    free = max(30, width - sum(short) - 2 * (len(HEADINGS) - 1))
    long = [int(free * share) for share in _SHARES]
    widths = [short[0], long[0], long[1], short[1], long[2]]
    lines = [_line(HEADINGS, widths), "  ".join("-" * w for w in widths)]
    for row in rows:
        lines += [_line(_cells(row), widths), ""]
    return "\n".join(lines).rstrip()


def _cells(row: ResultRow) -> tuple[str, ...]:
    return (row.figure, row.paper or "(nothing)", row.obtained, _verdict(row), row.remark)


def _verdict(row: ResultRow) -> str:
    return {True: "yes", False: "no", None: "-"}[row.agrees]


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    columns = [textwrap.wrap(cell, width) or [""] for cell, width in zip(cells, widths, strict=True)]
    height = max(map(len, columns))
    return "\n".join(
        "  ".join(
            (column[i] if i < len(column) else "").ljust(width)
            for column, width in zip(columns, widths, strict=True)
        ).rstrip()
        for i in range(height)
    )
