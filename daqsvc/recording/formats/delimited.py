"""Text tables: CSV with any delimiter, with or without preamble and header, gzipped or not.

The file may be in one of several encodings, and larger than it looks.
"""

from __future__ import annotations

import contextlib
import gzip
import io
import itertools
import re
import struct
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias, cast

import numpy as np

from daqsvc.confined.limits import CountedFile, TooLargeError
from daqsvc.errors.recordings import NOT_NUMBERS, TOO_SHORT
from daqsvc.recording import RecordingError
from daqsvc.recording.contents import LONGEST_NAME, LONGEST_TEXT, STATED_START, Contents, Elsewhere
from daqsvc.recording.formats.column_units import is_time_name, spelt_alike, time_unit, unit_in_name
from daqsvc.recording.formats.table_layout import SNIFFED_LINES, is_number, layout_of
from daqsvc.recording.formats.written_times import (
    EitherDateError,
    in_turn,
    joined_times,
    times_of,
)
from daqsvc.recording.rate import PER_SECOND
from daqsvc.rounding import counted

if TYPE_CHECKING:
    from collections.abc import Generator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.confined.limits import Budget
    from daqsvc.recording.formats.written_times import ColumnTimes, TimeFormat, WrittenTimes

    Floats: TypeAlias = NDArray[np.float64]
    from collections.abc import Iterator, Sequence
    from typing import BinaryIO


STATEMENT = re.compile(r"#\s*([A-Za-z]\w*)\s*[=:]\s*([-+.\deE]+)\s*")
"""A number in a comment, e.g. ``# fs = 25600``."""
UNIT = re.compile(r"#\s*unit of (.+?) = (\S.*)")
"""The unit of a column in a comment, as `daqsvc export` writes it: ``# unit of probe-x = um``."""
START = re.compile(rf"#\s*{STATED_START} = (\S+)")
"""The begin in a comment, in the same way."""

LONGEST_LINE = 1_000_000
"""Characters; what is longer among the first lines is no table."""

_MOST_STATEMENTS = 1000
_SEPARATOR = re.compile(r"(?i)sep=.?\s*")
"""The first line of tables that state their delimiter for Excel."""
_BLOCK_ROWS = 1 << 16


def read_csv(path: Path, budget: Budget) -> Contents:
    """All columns by header or number from 0; numbers stated in comments and a preamble are scalars."""
    file = TextFile(path, budget)
    try:
        return _DelimitedTable(path, file).read()
    except UnicodeDecodeError:
        file.take_for_latin_1()
        return _DelimitedTable(path, file).read()


class _DelimitedTable:
    """A table in a text file, which is read line by line, as it may be large.

    Args:
        path: the file, for messages.
        file: its lines.
    """

    def __init__(self, path: Path, file: TextFile) -> None:
        self._path = path
        self._file = file
        self._layout = layout_of(self._first_lines())
        self._stated: dict[str, float] = {}
        self._units: dict[str, str] = {}
        self._texts: dict[str, str] = {}

    def read(self) -> Contents:
        """What it holds.

        Raises:
            RecordingError: a cell is no number, or it is empty.
        """
        layout = self._layout
        if not layout.numeric and not layout.has_header:
            first = self._first_lines()[0]
            raise RecordingError(
                f"{self._path} holds no numeric channel: its first line is {first[:LONGEST_NAME]!r}, and no "
                "line behind it has a number; give a table with a column of numbers for each channel",
                NOT_NUMBERS,
            )
        numbers = self._numbers()
        entries: dict[str, NDArray[np.generic]] = {
            name: numbers[:, layout.numeric.index(i)] if i in layout.numeric else np.empty(1, dtype=object)
            for i, name in enumerate(layout.names)
        }
        dates, undated = self._times(len(numbers))
        entries |= dates
        units = self._take_units(layout.names)
        entries = dict(self._scaled(entries, units))
        for name, number in {**layout.scalars, **self._stated}.items():
            entries.setdefault(name, np.array(number))
        for name, text in self._texts.items():
            entries.setdefault(name, np.array(text))
        contents = Contents(
            entries,
            is_table=True,
            has_header=layout.has_header,
            units={name: unit for name, unit in units.items() if name in entries},
            # A begin of the times alone: the day is not known, and the channels have none.
            starts_ns=dict.fromkeys(undated, 0),
        )
        return replace(contents, elsewhere=_by_short_names(contents))

    def _take_units(self, names: Sequence[str]) -> dict[str, str]:
        """The units of the columns by their names, as the names, a row of units or comments state.

        Raises:
            RecordingError: two of these are stated of a column.
        """
        units: dict[str, str] = {}
        for i, name in enumerate(names):
            stated = {
                "its name": unit_in_name(name)[1] if self._layout.has_header else "",
                "the row of units": self._layout.units.get(i, ""),
                "a comment": self._units.get(name, ""),
            }
            by_place = {where: unit for where, unit in stated.items() if unit and i not in self._layout.times}
            first = next(iter(by_place.items()), None)
            if first is None:
                continue
            for where, unit in by_place.items():
                if not spelt_alike(unit, first[1]):
                    raise RecordingError(
                        f"column {i + 1} ({name:.{LONGEST_NAME}}) of {self._path} is in "
                        f"{first[1]:.{LONGEST_NAME}} by {first[0]} and in {unit:.{LONGEST_NAME}} by {where}; "
                        "correct the one that is wrong",
                        NOT_NUMBERS,
                    )
            units[name] = first[1][:LONGEST_NAME]
        return units

    def _scaled(
        self, entries: Mapping[str, NDArray[np.generic]], units: dict[str, str]
    ) -> Iterator[tuple[str, NDArray[np.generic]]]:
        """The columns, those of time in a unit that their names then end with; these leave the units."""
        for name, values in entries.items():
            bare, own = unit_in_name(name)
            unit = time_unit(units.get(name, ""))
            if unit is None or not is_time_name(bare) or values.dtype.kind != "f":
                yield name, values
                continue
            del units[name]
            seconds = np.asarray(values, np.float64) * unit.factor if unit.factor != 1.0 else values
            called = f"{bare} [{unit.name}]"
            if own and is_time_name(name):  # as in time_ms, which states it by itself
                yield name, values
            elif called not in entries:
                yield called, seconds
            else:
                yield name, np.asarray(seconds, np.float64) / PER_SECOND.get(unit.name, 1.0)

    def _times(self, length: int) -> tuple[dict[str, NDArray[np.generic]], list[str]]:
        """The columns of times, datetime64[ns]; a date and the time of the day beside it are one.

        Returns:
            The columns; and the names of those whose day is not known.
        """
        layout, forms = self._layout, self._layout.times
        if not forms:
            return {}, []
        pieces: dict[int, list[WrittenTimes]] = {i: [] for i in forms}
        with contextlib.closing(self._rows(fill=False)) as rows:
            while block := list(itertools.islice(rows, _BLOCK_ROWS)):
                cells = [layout.split(line) for line in block]
                for i, form in forms.items():
                    pieces[i].append(times_of([row[i] if len(row) > i else "" for row in cells], form))
        # A date without the time of the day is no time of a sample: it may be anything.
        used = [i for i in forms if forms[i].holds != "date" or _beside(i, forms) is not None]
        columns = {i: self._column(i, pieces[i], length) for i in used}
        entries: dict[str, NDArray[np.generic]] = {}
        undated = []
        for i, column in columns.items():
            date: int | None = i
            if forms[i].holds == "date":
                continue
            joined = column.times
            if forms[i].holds == "time":
                date = _beside(i, forms)
                joined = (
                    in_turn(column.times)
                    if date is None
                    else column.times + (columns[date].times - np.datetime64(0, "ns"))
                )
            entries[layout.names[i]] = joined
            if date is None or not columns[date].is_dated:
                undated.append(layout.names[i])
        return entries, undated

    def _column(self, i: int, pieces: Sequence[WrittenTimes], length: int) -> ColumnTimes:
        """The times of a column by its number.

        Raises:
            RecordingError: nothing separates the day from the month.
        """
        forms = self._layout.times
        form = forms[i]
        beside = _beside(i, forms)
        if beside is not None:
            form = replace(form, halves=form.halves or forms[beside].halves)
        try:
            return joined_times(pieces, form, length)
        except EitherDateError:
            raise RecordingError(
                f"the dates in column {i + 1} ({self._layout.names[i]:.{LONGEST_NAME}}) of {self._path} "
                "may have the day first or the month, and the rows leap either way; write them as 2026-01-31",
                NOT_NUMBERS,
            ) from None

    def _first_lines(self) -> list[str]:
        first: list[str] = []
        for line in self._file.lines():
            if len(line) > LONGEST_LINE:
                raise TooLargeError(
                    f"a line of it has more than {LONGEST_LINE:,} characters; give a table with a line for "
                    "each sample"
                )
            if not _is_no_row(line):
                first.append(line.removesuffix("\n"))
                if len(first) == SNIFFED_LINES:
                    break
        if not first:
            raise RecordingError(f"{self._path} is empty; give a file with samples", TOO_SHORT)
        return first

    def _numbers(self) -> Floats:
        """Numbers float64 ``[n, len(layout.numeric)]``; an empty cell is NaN."""
        layout = self._layout
        with contextlib.closing(self._rows(fill=False)) as rows:
            # Asked here, as NumPy would only warn.
            if next(rows, None) is None:
                raise RecordingError(
                    f"{self._path} has a header but no samples; give a file with samples", TOO_SHORT
                )
        if not layout.numeric:
            return np.empty((1, 0))
        try:
            return self._parsed(fill=False)
        except UnicodeDecodeError:
            raise
        except ValueError:
            pass
        try:
            return self._parsed(fill=True)
        except UnicodeDecodeError:
            raise
        except ValueError as error:
            self._find_fault()
            raise RecordingError(
                f"{self._path} cannot be read: {error}; correct the file", NOT_NUMBERS
            ) from error

    def _parsed(self, *, fill: bool) -> Floats:
        return np.loadtxt(
            self._rows(fill=fill),
            delimiter=None if self._layout.delimiter == " " else self._layout.delimiter,
            usecols=self._layout.numeric,
            comments=None,
            quotechar='"',
            ndmin=2,
        )

    def _rows(self, *, fill: bool) -> Generator[str]:
        """The lines of samples as NumPy reads them: with decimal points, and NaN in empty cells if wanted."""
        decimal_comma, left = self._layout.decimal_comma, self._layout.lines_before
        empty = _empty_cell(self._layout.delimiter) if fill else None
        for line in self._file.lines():
            if _is_no_row(line):
                if line[0] == "#":
                    self._note(line)
                continue
            if left:
                left -= 1
                continue
            row = line.replace(",", ".") if decimal_comma else line
            yield row if empty is None else empty.sub("nan", row.removesuffix("\n"))

    def _note(self, comment: str) -> None:
        comment = comment.strip()
        if (unit := UNIT.fullmatch(comment)) is not None and len(self._units) < _MOST_STATEMENTS:
            self._units.setdefault(unit[1][:LONGEST_TEXT], unit[2][:LONGEST_NAME])
        if (start := START.fullmatch(comment)) is not None:
            self._texts.setdefault(STATED_START, start[1][:LONGEST_TEXT])
        stated = STATEMENT.fullmatch(comment)
        if stated is not None and is_number(stated[2]) and len(self._stated) < _MOST_STATEMENTS:
            self._stated.setdefault(stated[1], float(stated[2]))

    def _find_fault(self) -> None:
        """State which cell is no number, by its line and column in the file, both counted from 1.

        Raises:
            RecordingError: there is one, or a line is too short.
        """
        layout, left = self._layout, self._layout.lines_before
        for i, line in enumerate(self._file.lines(), 1):
            if _is_no_row(line):
                continue
            if left:
                left -= 1
                continue
            cells = layout.split(line)
            where = f"{self._path}, line {i}"
            if len(cells) < layout.width:
                raise RecordingError(
                    f"{where} has {counted(len(cells), 'column')} where the others have {layout.width}; "
                    "correct the file",
                    NOT_NUMBERS,
                )
            for column in layout.numeric:
                if cells[column] and not layout.is_number(cells[column]):
                    named = f" ({layout.names[column]:.{LONGEST_NAME}})" if layout.has_header else ""
                    cell = f"{cells[column]!r:.{LONGEST_NAME}}"
                    raise RecordingError(
                        f"{where}, column {column + 1}{named}: {cell} is not a number; correct the file",
                        NOT_NUMBERS,
                    )


def _beside(i: int, forms: Mapping[int, TimeFormat]) -> int | None:
    """Of a column of dates or times of the day, by its number, the other one of a pair beside it, if any."""
    other = {"date": "time", "time": "date"}.get(forms[i].holds)
    return next((j for j in (i - 1, i + 1) if j in forms and forms[j].holds == other), None)


def _by_short_names(contents: Contents) -> dict[str, Elsewhere]:
    """The columns with a unit behind their names by these names without it, where only one is called so."""
    short: dict[str, list[str]] = {}
    for name in contents.vectors():
        bare, unit = unit_in_name(name)
        if unit and bare != name and not is_time_name(bare) and bare not in contents.entries:
            short.setdefault(bare, []).append(name)
    full = {bare: names[0] for bare, names in short.items() if len(names) == 1}

    def read() -> Contents:
        # Behind all others, as columns have numbers, too.
        more = {bare: contents.entries[name] for bare, name in full.items()}
        units = {bare: contents.units[name] for bare, name in full.items() if name in contents.units}
        return replace(
            contents, entries={**contents.entries, **more}, units={**contents.units, **units}, elsewhere={}
        )

    return {
        bare: Elsewhere(f"is called {name!r} there; name it so, e.g. --map '{bare}={name}'", read)
        for bare, name in full.items()
    }


def _is_no_row(line: str) -> bool:
    """Whether a line is a comment, blank, or for Excel alone."""
    return line[0] == "#" or line.isspace() or (line[0] in "sS" and _SEPARATOR.fullmatch(line) is not None)


def _empty_cell(delimiter: str | None) -> re.Pattern[str] | None:
    """What an empty cell looks like; None where the delimiter leaves no place for one."""
    if delimiter in {None, " "}:
        return None
    between = re.escape(delimiter or "")
    blank = rf"[^\S{between}]*"
    return re.compile(rf'(?:(?<={between})|^){blank}(?:"")?{blank}(?=$|{between})')


_BYTE_ORDER_MARKS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}

_BUFFER_BYTES = 1 << 18
_GZIP_TRAILER_BYTES = 8


class TextFile:
    """A text file in UTF-16 (if a byte order mark states it), UTF-8, or else Latin-1.

    Args:
        path: the file; gzipped if it ends in ``.gz``.
        budget: of the file; each reading of it may take as much.
    """

    def __init__(self, path: Path, budget: Budget) -> None:
        self._path = path
        self._budget = budget
        self._zipped = path.name.lower().endswith(".gz")
        with self._open() as file:
            mark = file.read(2)
            if self._zipped and _declared_bytes(path) > budget.most_bytes:
                # Reported at the end of the file, which is anything where that is cut off: so count.
                counted = CountedFile(file, replace(budget))
                while counted.read(_BUFFER_BYTES):
                    pass
        self._encoding = _BYTE_ORDER_MARKS.get(mark, "utf-8-sig")

    @property
    def may_be_latin_1(self) -> bool:
        """Whether another encoding can be tried where this one fails."""
        return self._encoding == "utf-8-sig"

    def take_for_latin_1(self) -> None:
        """Try that."""
        self._encoding = "latin-1"

    def lines(self) -> Iterator[str]:
        r"""Its lines, with ``\n`` at their ends.

        Raises:
            UnicodeDecodeError: it is not in UTF-8.
            RecordingError: it is not in UTF-16 though it states it.
            TooLargeError: it unpacks to too much.
        """
        with self._open() as file:
            counted = io.BufferedReader(CountedFile(file, replace(self._budget)), _BUFFER_BYTES)
            with io.TextIOWrapper(counted, self._encoding) as text:
                try:
                    yield from text
                except UnicodeError as error:
                    if self.may_be_latin_1:
                        raise
                    raise RecordingError(
                        f"{self._path} cannot be read: it is no text in UTF-16, as its first two bytes show "
                        f"({error}); save it as CSV in UTF-8",
                        NOT_NUMBERS,
                    ) from None

    @contextmanager
    def _open(self) -> Iterator[BinaryIO]:
        with self._path.open("rb") as raw:
            if self._zipped:
                with gzip.open(raw) as file:
                    yield cast("BinaryIO", file)
            else:
                yield raw


def _declared_bytes(path: Path) -> int:
    """What a gzip file states at its end that it unpacks to."""
    with path.open("rb") as file:
        size = file.seek(0, io.SEEK_END)
        if size <= _GZIP_TRAILER_BYTES:
            return 0
        file.seek(-4, io.SEEK_END)
        return int(struct.unpack("<I", file.read(4))[0])
