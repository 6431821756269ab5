"""How a text table is laid out by its first lines: delimiter, decimal point, preamble, header."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from daqsvc.recording.contents import check_columns, column_names
from daqsvc.recording.formats.column_units import (
    is_surely_unit,
    is_time_name,
    is_unit,
    time_unit,
    unit_as_name,
    unit_in_name,
    without_brackets,
)
from daqsvc.recording.formats.written_times import format_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daqsvc.recording.formats.written_times import TimeFormat

DELIMITERS = ("\t", ";", "|", ",", " ")
"""Between the columns, tried in this order (a comma may also be a decimal point)."""

SNIFFED_LINES = 120
"""Lines that the layout is found by; a preamble is shorter."""

_TABLE_LINES = 20
"""Of these, those that show a table which begins with the file."""

_LEAST_TABLE_LINES = 2
"""Rows of samples that show a table behind a preamble."""

STATED = re.compile(
    r"""["\s]*(?P<name>[A-Za-z][\w .-]*?)\s*(?:[\[(]\s*(?P<in_name>k?Hz|S/s)\s*[\])])?["\s]*[:=;,\t|]["\s]*"""
    r"""(?P<number>[-+]?\d[\d.,]*(?:[eE][-+]?\d+)?)\s*(?P<unit>k?Hz|S/s)?["\s;,\t|]*""",
    re.IGNORECASE,
)
"""A number in a preamble, e.g. ``Sampling rate [Hz];25600`` or ``Sample Rate: 25.6 kHz``."""


@dataclass(frozen=True, slots=True)
class Layout:
    """How a table is laid out.

    Attributes:
        delimiter: between the columns; None where there is only one.
        decimal_comma: whether a comma is the decimal point.
        lines_before: lines before the first one of samples, without comments and blanks.
        has_header: whether they name the columns.
        names: of the columns.
        numeric: numbers of those that hold numbers.
        scalars: numbers that the preamble states.
        times: for columns of times in words, how these are written, by their numbers.
        units: that a row of units names, by the numbers of the columns.
    """

    delimiter: str | None
    decimal_comma: bool
    lines_before: int
    has_header: bool
    names: Sequence[str]
    numeric: Sequence[int]
    scalars: Mapping[str, float]
    times: Mapping[int, TimeFormat] = field(default_factory=dict)
    units: Mapping[int, str] = field(default_factory=dict)

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.names)

    def split(self, line: str) -> list[str]:
        """The cells of a line, without quotes."""
        return split(line, self.delimiter)

    def is_number(self, cell: str) -> bool:
        """Whether a cell is a number."""
        return is_number(cell, decimal_comma=self.decimal_comma)


def layout_of(lines: Sequence[str]) -> Layout:
    """How a table is laid out.

    Args:
        lines: the first `SNIFFED_LINES` of the file, or all if there are fewer; no comments, no blanks.

    Raises:
        TooLargeError: it has more columns than a recording may have.
    """
    plain, fits = _from_the_first_line(lines)
    behind = None if fits else _behind_a_preamble(lines)
    layout = behind or plain
    return replace(layout, times=_times(layout, lines[layout.lines_before :]))


def _times(layout: Layout, body: Sequence[str]) -> dict[int, TimeFormat]:
    """The columns of times in words among those that are not numeric."""
    rows = [layout.split(line) for line in body]
    words = (i for i in range(layout.width) if i not in layout.numeric)
    formats = {i: format_of([row[i] for row in rows if len(row) > i]) for i in words}
    return {i: form for i, form in formats.items() if form is not None}


def _from_the_first_line(lines: Sequence[str]) -> tuple[Layout, bool]:
    """The layout of a table that begins with the file, and whether the lines fit it."""
    top = lines[:_TABLE_LINES]
    delimiter, decimal_comma = _sniff(top)
    rows = [split(line, delimiter) for line in top]
    last = rows[-1]
    check_columns(len(last))
    width = _width(rows)
    numbers = [[is_number(cell, decimal_comma=decimal_comma) for cell in row[:width]] for row in rows]
    header_lines = _header_lines(numbers)
    has_samples = header_lines < len(rows)
    numeric = [i for i in range(width) if has_samples and (numbers[-1][i] or not last[i])]
    heading = _heading(rows, header_lines, width)
    header = rows[heading.names or 0] if header_lines else []
    names = column_names([*header[:width], *[""] * (width - len(header))])
    stated = _stated(lines[: heading.names or 0], decimal_comma)
    units = heading.units_of(rows, width)
    layout = Layout(
        delimiter, decimal_comma, header_lines, header_lines > 0, names, numeric, stated, units=units
    )
    body = [split(line, delimiter) for line in lines[header_lines:]]
    fits = not has_samples or (bool(numeric) and all(_is_row(row, layout) for row in body))
    return layout, fits


def _is_row(row: Sequence[str], layout: Layout) -> bool:
    return len(row) >= layout.width and all(not row[i] or layout.is_number(row[i]) for i in layout.numeric)


def _behind_a_preamble(lines: Sequence[str]) -> Layout | None:
    """The layout of a table behind lines about it, as loggers write them; None if there is none."""
    for delimiter in (*DELIMITERS, None):
        rows = [split(line, delimiter) for line in lines]
        last = rows[-1]
        check_columns(len(last))
        if delimiter is not None and len(last) < 2:
            continue
        decimal_comma = _has_decimal_comma(rows[-_TABLE_LINES:], delimiter)
        numeric = [i for i, cell in enumerate(last) if is_number(cell, decimal_comma=decimal_comma)]
        if not numeric:
            continue
        width = _width(rows)
        table = Layout(delimiter, decimal_comma, 0, False, [""] * width, numeric, {})
        first = len(rows)
        while first and len(rows[first - 1]) == len(last) and _is_row(rows[first - 1], table):
            first -= 1
        if len(rows) - first < _LEAST_TABLE_LINES:
            continue
        table = replace(table, times=_times(table, lines[first:]))
        if any(_is_like(row, table) for row in rows[:first]):
            return None
        heading = _heading(rows, first, width)
        header = heading.names
        names = column_names(rows[header][:width] if header is not None else [""] * width)
        about = lines[: first if header is None else header]
        return Layout(
            delimiter,
            decimal_comma,
            first,
            header is not None,
            names,
            numeric,
            _stated(about, decimal_comma),
            units=heading.units_of(rows, width),
        )
    return None


def _is_like(row: Sequence[str], table: Layout) -> bool:
    """Whether a line is rather a damaged row of samples than one about them."""
    if len(row) < table.width:
        return False
    if table.times:
        return any(form.fits(row[i]) for i, form in table.times.items())
    numbers = [table.is_number(row[i]) for i in table.numeric]
    return numbers[0] if table.numeric[0] == 0 else sum(numbers) * 2 >= len(numbers)


def _width(rows: Sequence[Sequence[str]]) -> int:
    """Columns of a table: loggers that end each line with a delimiter have none after it."""
    last = rows[-1]
    return len(last) - (len(last) > 1 and all(row[-1] == "" for row in rows if len(row) == len(last)))


@dataclass(frozen=True, slots=True)
class _Heading:
    """Which lines above a table state what its columns are.

    Attributes:
        names: number of the line that names them; None if none does.
        units: of the one with their units; the same if the columns are called by these.
    """

    names: int | None = None
    units: int | None = None

    def units_of(self, rows: Sequence[Sequence[str]], width: int) -> dict[int, str]:
        """The units by the numbers of their columns."""
        cells = rows[self.units][:width] if self.units is not None else []
        unit_of = unit_as_name if self.units == self.names else without_brackets
        return {i: unit for i, cell in enumerate(cells) if (unit := unit_of(cell))}


def _heading(rows: Sequence[Sequence[str]], first: int, width: int) -> _Heading:
    """What the lines right above samples are: names, with units below or above, or neither.

    Args:
        rows: the lines.
        first: number of the first one of samples.
        width: columns of these.
    """
    if not first:
        return _Heading()
    above, lower = first - 1, rows[first - 1]
    upper = rows[above - 1] if above else []
    if len(upper) >= width and not any(map(_is_moment, upper[:width])):
        if _is_units_below(lower, upper[:width]):
            return _Heading(above - 1, above)
        # What is below names of the time describes the columns in other words.
        if all(upper[:width]) and any(map(_is_time, upper[:width])) and not any(map(_is_time, lower[:width])):
            return _Heading(above - 1)
    if len(lower) < width:
        return _Heading()
    if len(upper) >= width and _is_timed(upper, lower) and all(map(is_unit, upper[:width])):
        return _Heading(above, above - 1)
    # Channels A and V are no units; beside one that is called m/s2 they are.
    is_both = (
        all(map(is_unit, lower[:width]))
        and any(map(is_surely_unit, lower[:width]))
        and not any(map(_is_time, lower[:width]))
    )
    return _Heading(above, above if is_both else None)


def _is_units_below(cells: Sequence[str], names: Sequence[str]) -> bool:
    """Whether a line holds the units of the columns that the line above names."""
    if len(cells) < min(2, len(names)) or (
        any(map(_is_time, cells[: len(names)])) and not any(map(_is_time, names))
    ):
        return False
    cells = [*cells, *[""] * (len(names) - len(cells))][: len(names)]
    if not all(map(is_unit, cells)):
        return _is_timed(cells, names)
    named = [
        bool(name) or not cell or time_unit(cell) is not None for name, cell in zip(names, cells, strict=True)
    ]
    return any(names) and all(named)


def _is_timed(units: Sequence[str], names: Sequence[str]) -> bool:
    """Whether a unit of time stands with the name of a time."""
    return any(
        _is_time(name) and time_unit(without_brackets(unit)) is not None
        for unit, name in zip(units, names, strict=False)
    )


def _is_time(name: str) -> bool:
    """Whether a column of this name is one of time, whatever its unit."""
    bare, unit = unit_in_name(name)
    return is_time_name(name) or (is_time_name(bare) and time_unit(unit) is not None)


def _is_moment(cell: str) -> bool:
    """Whether a cell is a date or a time of the day, as it is in lines about a measurement."""
    return format_of([cell]) is not None


def _stated(lines: Sequence[str], decimal_comma: bool) -> dict[str, float]:  # noqa: FBT001
    """Numbers that lines of a preamble state, by their names in small letters with ``_`` for blanks."""
    values: dict[str, float] = {}
    for line in lines:
        stated = STATED.fullmatch(line.strip())
        if stated is None or not is_number(stated["number"], decimal_comma=decimal_comma):
            continue
        number = float(stated["number"].replace(",", ".") if decimal_comma else stated["number"])
        unit = stated["unit"] or stated["in_name"] or ""
        name = re.sub(r"[\s.-]+", "_", stated["name"].strip().lower())
        values.setdefault(name, number * (1e3 if unit.lower() == "khz" else 1.0))
    return values


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
        rows = [split(line, delimiter) for line in lines]
        # The first line may be longer: some loggers append totals to it.
        if len(rows[-1]) < 2 or len({len(row) for row in rows[1:]}) > 1:
            continue
        decimal_comma = _has_decimal_comma(rows, delimiter)
        if any(is_number(cell, decimal_comma=decimal_comma) for cell in rows[-1]):
            return delimiter, decimal_comma
    return None, False


def _has_decimal_comma(rows: Sequence[Sequence[str]], delimiter: str | None) -> bool:
    """Whether there is one in a line as long as the last one; whole numbers may be in some."""
    return delimiter not in {None, ","} and any(
        "," in cell and is_number(cell, decimal_comma=True)
        for row in rows
        if len(row) == len(rows[-1])
        for cell in row
    )


def split(line: str, delimiter: str | None) -> list[str]:
    """The cells of a line, without quotes."""
    if delimiter is None:
        return [line.strip().strip('"')]
    if delimiter == " ":
        return [cell.strip('"') for cell in line.split()]
    if delimiter not in line and len(line) > csv.field_size_limit():
        return [line.strip().strip('"')]  # a long line of another delimiter, which csv would refuse
    cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    return [cell.strip() for cell in cells]


def is_number(cell: str, *, decimal_comma: bool = False) -> bool:
    """Whether a cell is a number."""
    try:
        float(cell.replace(",", ".") if decimal_comma else cell)
    except ValueError:
        return False
    return True
