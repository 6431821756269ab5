"""Text tables: CSV by whatever delimiter, with or without header, gzipped or not."""

from __future__ import annotations

import csv
import gzip
import io
import re
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from daqsvc.recording.contents import Contents, column_names
from daqsvc.recording.errors import RecordingError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]

DELIMITERS = ("\t", ";", "|", ",", " ")
"""Between the columns, tried in this order (a comma may also be a decimal point)."""

SNIFFED_LINES = 20

NO_SAMPLES = re.compile(r"^(?:#.*|[^\S\n]+)?(?:\n|\Z)", re.MULTILINE)
"""Comments and blank lines."""

STATEMENT = re.compile(r"^#\s*([A-Za-z]\w*)\s*[=:]\s*([-+.\deE]+)\s*$", re.MULTILINE)
"""A number in a comment, e.g. ``# fs = 25600``."""


def read_csv(path: Path) -> Contents:
    """All columns by header or number from 0; numbers stated in comments are scalars."""
    text = _text(path)
    table = NO_SAMPLES.sub("", text)
    if not table:
        raise RecordingError(f"{path} is empty; give a file with samples")
    layout = _Layout(table.split("\n", SNIFFED_LINES)[:SNIFFED_LINES])
    for _ in range(layout.header_lines):
        table = table.partition("\n")[2]
    if not table:
        raise RecordingError(f"{path} has a header but no samples; give a file with samples")
    numbers = _numbers(path, text, table, layout)
    entries: dict[str, NDArray[np.generic]] = {
        name: numbers[:, layout.numeric.index(i)] if i in layout.numeric else np.empty(1, dtype=object)
        for i, name in enumerate(layout.names)
    }
    for name, number in STATEMENT.findall(text):
        if _is_number(number):
            entries.setdefault(name, np.array(float(number)))
    return Contents(entries, is_table=True, has_header=layout.header_lines > 0)


def _text(path: Path) -> str:
    opener = gzip.open if path.name.lower().endswith(".gz") else open
    with opener(path, "rt", encoding="utf-8-sig") as file:
        try:
            return file.read()
        except UnicodeDecodeError as error:
            raise RecordingError(
                f"{path} cannot be read: it is not text in UTF-8 ({error.reason} at byte {error.start}); "
                "save it as CSV in UTF-8"
            ) from error


class _Layout:
    """How the first lines of a table (no comments, no blanks) say that it is laid out.

    Attributes:
        delimiter: between the columns; None where there is only one.
        decimal_comma: whether a comma is the decimal point.
        header_lines: 0, 1 with names, or 2 with names and units.
        names: of the columns.
        width: number of columns.
        numeric: numbers of those that hold numbers.
    """

    def __init__(self, lines: Sequence[str]) -> None:
        lines = [line for line in lines if line]
        self.delimiter, self.decimal_comma = _sniff(lines)
        rows = [self.split(line) for line in lines]
        last = rows[-1]
        # Loggers that end each line with a delimiter have no column after it.
        self.width = len(last) - (len(last) > 1 and not any(row[len(last) - 1 :] != [""] for row in rows))
        numbers = [[self.is_number(cell) for cell in row[: self.width]] for row in rows]
        self.header_lines = _header_lines(numbers)
        has_samples = self.header_lines < len(rows)
        self.numeric = [i for i in range(self.width) if has_samples and (numbers[-1][i] or not last[i])]
        header = rows[0] if self.header_lines else []
        self.names = column_names([*header[: self.width], *[""] * (self.width - len(header))])

    def split(self, line: str) -> list[str]:
        """The cells of a line, without quotes."""
        return _split(line, self.delimiter)

    def is_number(self, cell: str) -> bool:
        """Whether a cell is a number."""
        return _is_number(cell, decimal_comma=self.decimal_comma)


def _header_lines(numbers: Sequence[Sequence[bool]]) -> int:
    """How many of the first lines are a header, by which cells are numbers."""
    if len(numbers) == 1:
        return int(not any(numbers[0]))
    if not any(numbers[-1]):
        return 0
    wordy = [not any(row) for row in numbers[:3]]
    if wordy[0] and wordy[1]:
        return 2
    return int(any(later and not number for number, later in zip(numbers[0], numbers[1], strict=False)))


def _sniff(lines: Sequence[str]) -> tuple[str | None, bool]:
    """Delimiter of the columns (None where there is only one), and whether commas are decimal points."""
    for delimiter in DELIMITERS:
        rows = [_split(line, delimiter) for line in lines]
        # The first line may be longer: some loggers append totals to it.
        if len(rows[-1]) < 2 or len({len(row) for row in rows[1:]}) > 1:
            continue
        decimal_comma = delimiter != "," and any(
            "," in cell and _is_number(cell, decimal_comma=True) for cell in rows[-1]
        )
        if any(_is_number(cell, decimal_comma=decimal_comma) for cell in rows[-1]):
            return delimiter, decimal_comma
    return None, False


def _split(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return [line.strip().strip('"')]
    if delimiter == " ":
        return [cell.strip('"') for cell in line.split()]
    cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    return [cell.strip() for cell in cells]


def _is_number(cell: str, *, decimal_comma: bool = False) -> bool:
    try:
        float(cell.replace(",", ".") if decimal_comma else cell)
    except ValueError:
        return False
    return True


def _numbers(path: Path, text: str, table: str, layout: _Layout) -> Floats:
    """Numbers float64 ``[n, len(layout.numeric)]``; an empty cell is NaN."""
    if not layout.numeric:
        return np.empty((1, 0))
    if layout.decimal_comma:
        table = table.replace(",", ".")
    try:
        return _parsed(table, layout)
    except ValueError:
        filled = _with_nan(table, layout.delimiter)
    try:
        return _parsed(filled, layout)
    except ValueError as error:
        _find_fault(path, text, layout)
        raise RecordingError(f"{path} cannot be read: {error}; correct the file") from error


def _parsed(table: str, layout: _Layout) -> Floats:
    return np.loadtxt(
        io.StringIO(table),
        delimiter=None if layout.delimiter == " " else layout.delimiter,
        usecols=layout.numeric,
        comments=None,
        quotechar='"',
        ndmin=2,
    )


def _with_nan(table: str, delimiter: str | None) -> str:
    """The table with ``nan`` in its empty cells."""
    if delimiter in {None, " "}:
        return table
    blank = rf"[^\S\n{delimiter}]*"
    return re.sub(
        rf'(?:(?<=[{delimiter}])|^(?!\Z)){blank}(?:"")?{blank}(?=$|[{delimiter}])',
        "nan",
        table,
        flags=re.MULTILINE,
    )


def _find_fault(path: Path, text: str, layout: _Layout) -> None:
    """Say which cell is no number, by its line in the file.

    Raises:
        RecordingError: there is one, or a line is too short.
    """
    numbered = [(i, line) for i, line in enumerate(text.split("\n"), 1) if not NO_SAMPLES.fullmatch(line)]
    for i, line in numbered[layout.header_lines :]:
        cells = layout.split(line)
        if len(cells) < layout.width:
            raise RecordingError(
                f"{path}:{i} has {len(cells)} columns where the others have {layout.width}; correct the file"
            )
        for column in layout.numeric:
            if cells[column] and not layout.is_number(cells[column]):
                raise RecordingError(
                    f"{path}:{i} column {column}: {cells[column]!r} is not a number; correct the file"
                )
