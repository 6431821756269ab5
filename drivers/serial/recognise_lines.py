"""Lines of text in a stream of bytes: what separates columns, which are numbers, and which lines are damaged.

Columns are judged by the great majority of the lines, so that noise, or a message of the device now and
then, changes nothing.
"""

from __future__ import annotations

import binascii
import re
from collections import Counter
from dataclasses import dataclass, replace
from functools import reduce
from operator import xor
from typing import TYPE_CHECKING

import numpy as np

from drivers.serial.line_numbers import (
    ABSENT,
    BLANK,
    NUMBER,
    encoded,
    fields_of,
    is_text,
    number_within,
    parts_of,
    text_of,
)
from drivers.serial.settings import LONGEST_BESIDE

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

SEPARATORS = (",", ";", "\t", "|", " ")
MAJORITY = 0.8
"""What so many of the lines have in common holds for all; the others are damaged."""
_LEAST_LINES = 3
_LEAST_STEPS = 5
_MOST_RESETS = 2
_WRAP = 256
"""What counters wrap at is a multiple of it."""
_TURN_SHARE = 0.05
"""So near to the turn are the values before and after it, as lines may be missing there."""
_WIDTHS = (8, 16)
"""Bits of a counter that a few minutes may show; one of 32 turns once in months."""
_MOST_AT_TURN = 16
"""Lines that may be missing where a counter of bits begins again."""
_MOST_KINDS = 16
_LEAST_SHARE = 0.02
"""Of the lines begin with a word that is no accident."""
_ENDS = 5
"""Lines at each end by which the growth of a column is judged."""
_LEAST_SWINGING, _LEAST_DIFFERENT, _SWINGING = 16, 4, 0.1
"""A column may be a vibration from so many values on, different ones among them, and share of steps over
the mean."""
_CHECKSUM = re.compile(r"\*([0-9A-Fa-f]{4}|[0-9A-Fa-f]{2})$")
_PREFIX = re.compile(rf"(?=.{{1,{LONGEST_BESIDE}}}$)[!$]?(?!\d)[\w-]+")
_MESSAGES = frozenset(
    {"err", "error", "fail", "failed", "fault", "warn", "warning", "info", "debug", "timeout"}
)
"""Words that messages of a device begin with, which are neither names of columns nor kinds of lines."""
_WORD = re.compile(r"\W*([^\W\d_]+)(?![\w,;|\t])")
_CODED = re.compile(r".*[ :]\d+ *")
_DIGITS = re.compile(r"\d+")
_HEX = re.compile(r"[0-9A-Fa-f]{2,8}")
_LETTERS = re.compile(r"[^\W\d_]{3,}")
TIME_UNITS: Mapping[str, str] = {"s": "s", "sec": "s", "ms": "ms", "us": "us", "µs": "us", "μs": "us"}
"""Units of a time as devices write them, and as the driver names them."""
_SUMS: Mapping[int, tuple[str, Callable[[bytes], int]]] = {
    2: ("xor", lambda text: reduce(xor, text, 0)),
    4: ("crc16", lambda text: binascii.crc_hqx(text, 0xFFFF)),
}
"""Checksums, by the digits that they have: name, and what it is of the bytes before the ``*``."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column of lines.

    Attributes:
        name: as the header has it, else ``c1``, ``c2`` ...
        numeric: whether it is a number, or absent, in all lines that are not damaged.
        unit: the text behind the number that is the same in all of them, such as a unit; else empty.
        least: least value; 0 of a text.
        most: largest one.
        step: by how much it counts, if it is whole numbers that do; else 0.
        turns_at: the power of ten at which it was seen to begin again at 0; else 0. No counter of bits does.
        bits: width of a counter that was seen to begin again at 0 after it; else 0.
        grows: whether it never falls, and grows at all.
        per_line: by how much it grows from line to line, on average; of a counter, without its turns.
        prefix: the text in front of the number that is the same in all of them, such as a name; else empty.
        last: its last text.
        absent: in how many lines there is no value.
        absent_text: its text in the last one of these.
        swings: whether it swings about 0, as a vibration does, much faster than it drifts.
    """

    name: str
    numeric: bool
    least: float = 0.0
    most: float = 0.0
    step: float = 0.0
    turns_at: int = 0
    grows: bool = False
    per_line: float = 0.0
    last: str = ""
    unit: str = ""
    prefix: str = ""
    absent: int = 0
    absent_text: str = ""
    swings: bool = False
    bits: int = 0


@dataclass(frozen=True, slots=True)
class TextLines:
    """Lines of text.

    Attributes:
        lines: whole lines of this kind, oldest first, without their ends.
        delimiter: what ends one; a carriage return before a line feed is none of it.
        separator: between columns, a blank for one or more of them; empty if there is one column.
        decimal: decimal mark of the numbers.
        prefix: the first field of each line, where it is the same word in all; else empty.
        checksum: behind a ``*``: "xor", "crc16", "unknown", or "none".
        columns: those of most lines, without prefix.
        header: whether the first line names the columns.
        damaged: lines that are not like most: other columns, no number where most have one, bytes that are
            no text, or a wrong checksum.
        others: lines of other kinds on the same port, each with another prefix, those with the most columns
            of numbers first, and of these the most frequent.
        behind: how many bytes came behind each line of the layout, a damaged one too, oldest first.
    """

    lines: Sequence[str]
    delimiter: str
    separator: str
    decimal: str
    prefix: str
    checksum: str
    columns: Sequence[Column]
    header: bool
    damaged: Sequence[str]
    others: Sequence[TextLines] = ()
    behind: Sequence[int] = ()

    @property
    def kinds(self) -> Sequence[TextLines]:
        """All kinds of lines on the port, this one first."""
        return (self, *self.others)


def text_lines(data: bytes) -> TextLines | None:
    """Lines of text and their columns; None if there are not even three whole lines."""
    for delimiter in (b"\n", b"\r", b";"):
        # The first piece may lack its beginning, the last its end.
        first, *pieces = data.split(delimiter)
        lines, behind, left = [], [], len(data) - len(first)
        for piece in pieces[:-1]:
            left -= len(delimiter) + len(piece)
            if line := _text(piece):
                lines.append(line)
                behind.append(left)
        if len(lines) >= _LEAST_LINES:
            if first.startswith(b"#") or _is_header(_text(first), lines):
                lines = [_text(first), *lines]
                behind = [len(data) - len(first), *behind]
            return _kinds_of(lines, behind, delimiter.decode())
    return None


def _kinds_of(lines: Sequence[str], behind: Sequence[int], delimiter: str) -> TextLines:
    """Lines by the word that they begin with, where there are several of them."""
    separator, _ = _marks_of(lines[1:] or lines)
    words = (
        [fields_of(line, separator)[0].strip() if separator in line else "" for line in lines]
        if separator
        else []
    )
    least = max(_LEAST_LINES, _LEAST_SHARE * len(lines))
    frequent = [
        word for word, times in Counter(words).most_common(_MOST_KINDS) if times >= least and _is_word(word)
    ]
    if len(frequent) < 2 or sum(word in frequent for word in words) < MAJORITY * len(lines):
        return _columns_of(lines, behind, delimiter)
    kinds = [
        _columns_of(
            [line for line, word in zip(lines, words, strict=True) if word == one],
            [left for left, word in zip(behind, words, strict=True) if word == one],
            delimiter,
        )
        for one in frequent
    ]
    strange = [line for line, word in zip(lines, words, strict=True) if word not in frequent]
    kinds.sort(key=lambda kind: -sum(one.numeric for one in kind.columns))
    first = kinds[0]
    return replace(
        first,
        lines=[*first.lines, *strange],
        damaged=[*first.damaged, *strange],
        others=kinds[1:],
    )


def _is_word(field: str) -> bool:
    """Whether a first column can name a kind of line: a word, and not what devices write for no number."""
    no_number = ABSENT.fullmatch(field) is not None or field.lstrip("$!").lower() in _MESSAGES
    return _PREFIX.fullmatch(field) is not None and not no_number


def _text(piece: bytes) -> str:
    return text_of(piece).strip("\r\n")


def _is_header(first: str, lines: Sequence[str]) -> bool:
    """Whether a line is a header: words, where the next one has numbers."""
    second = lines[0]
    separator, decimal = _marks_of([second])
    fields = fields_of(first, separator) if separator else [first]
    others = fields_of(second, separator) if separator else [second]
    return (
        len(fields) == len(others)
        and _only_words(fields, others, decimal)
        and not second.strip().startswith(fields[0].strip())
        and not _is_message(first, lines, separator)
    )


def _is_message(first: str, others: Sequence[str], separator: str) -> bool:
    """Whether a line of words is a message of the device, and no header: messages come again, with codes.

    Some devices repeat their header, too: then it is the same words each time, and several of them.
    """
    word = _WORD.match(first)
    if word is not None and word[1].lower() in _MESSAGES:
        return True
    if separator in {"", BLANK}:
        form = _DIGITS.sub("0", first)
        return _CODED.fullmatch(first) is not None or any(_DIGITS.sub("0", one) == form for one in others)
    return False


def _only_words(fields: Sequence[str], others: Sequence[str], decimal: str) -> bool:
    """Whether the fields of a line are words, as in a header: no numbers, with or without name and unit."""
    return not any(
        NUMBER[decimal].fullmatch(one)
        or ((parts := parts_of(one, decimal)) is not None and parts == parts_of(other, decimal))
        for one, other in zip(fields, others, strict=True)
    )


def _marks_of(lines: Sequence[str]) -> tuple[str, str]:
    """What stands between columns, and the decimal mark of the numbers in them.

    The separator is the mark that most lines have as often as each other, and with which most columns are
    numbers. A decimal comma is as frequent as the separator, but then leaves no numbers.
    """
    best, most = ("", "."), 0.0
    for separator in SEPARATORS:
        rows = [fields_of(line, separator) for line in lines]
        width, agreeing = Counter(map(len, rows)).most_common(1)[0]
        if width == 1:
            continue
        fields = [field for row in rows if len(row) == width for field in row]
        for decimal in (mark for mark in (".", ",") if mark != separator):
            numbers = sum(parts_of(field, decimal) is not None for field in fields)
            score = agreeing / len(lines) * (1 + numbers / len(fields))
            if score > most + 0.02:
                best, most = (separator, decimal), score
    if not best[0]:
        alone = {mark: sum(parts_of(line, mark) is not None for line in lines) for mark in NUMBER}
        return "", max(alone, key=lambda mark: alone[mark])
    return best


def _columns_of(lines: Sequence[str], behind: Sequence[int], delimiter: str) -> TextLines:
    checksum = _checksum_of(lines)
    plain = [_CHECKSUM.sub("", line) if checksum != "none" else line for line in lines]
    separator, decimal = _marks_of(plain[1:] or plain)
    rows = [
        [field.strip() for field in fields_of(line, separator)] if separator else [line.strip()]
        for line in plain
    ]
    width = Counter(len(row) for row in rows[1:] or rows).most_common(1)[0][0]
    number = NUMBER[decimal]
    header = (
        len(rows[0]) == len(rows[1]) == width
        and _only_words(rows[0], rows[1], decimal)
        and any(parts_of(one, decimal) is not None for one in rows[1])
        and rows[0][0] != rows[1][0]
        and not _is_message(plain[0], plain[1:], separator)
    )
    names = [name.lstrip("#").strip() for name in rows[0]] if header else []
    sound = [
        len(row) == width and is_text(line) and _sum_fits(line, checksum)
        for row, line in zip(rows, lines, strict=True)
    ]
    sound[0] &= not header
    prefix = _prefix_of([row for row, good in zip(rows, sound, strict=True) if good], width)
    first = 1 if prefix else 0
    around = [
        _texts_of([row[k] for row, good in zip(rows, sound, strict=True) if good], decimal)
        for k in range(first, width)
    ]
    around = _without_hex([row[first:] for row, good in zip(rows, sound, strict=True) if good], around)
    for at, row in enumerate(rows):
        sound[at] = (
            sound[at]
            and (not prefix or row[0] == prefix)
            and all(
                _is_number(text, texts, number)
                for text, texts in zip(row[first:], around, strict=True)
                if texts is not None
            )
        )
    # Messages of the device between the lines take no turn of the layout; a damaged line of it does.
    turns = np.array(sound)
    words = {word for line, good in zip(lines, sound, strict=True) if good for word in _LETTERS.findall(line)}
    for at, row in enumerate(rows):
        if not sound[at] and not (header and at == 0):
            turns[at] = not _is_other(plain[at], row, around, words, decimal)
    sound_rows = np.flatnonzero(sound)
    places = (np.cumsum(turns) - 1)[sound_rows]
    columns = [
        _column(
            [rows[at][first + k] for at in sound_rows.tolist()],
            places,
            names[first + k] if names else texts[0].strip("=:") if texts and texts[0] else f"c{k + 1}",
            decimal if texts is not None else "",
            texts or ("", ""),
        )
        for k, texts in enumerate(around)
    ]
    damaged = [line for line, good in zip(lines[header:], sound[header:], strict=True) if not good]
    ends = [behind[at] for at in np.flatnonzero(turns).tolist()]
    return TextLines(
        lines, delimiter, separator, decimal, prefix, checksum, columns, header, damaged, behind=ends
    )


def _without_hex(
    rows: Sequence[Sequence[str]], around: Sequence[tuple[str, str] | None]
) -> list[tuple[str, str] | None]:
    """The texts around the numbers of columns; None also of those that are hex by chance without a letter.

    Beside columns of hex with letters, one of the same width with zeros in front is hex, too.
    """
    columns = [[row[k] for row in rows] for k in range(len(around))]
    widths = {
        len(fields[0])
        for fields, texts in zip(columns, around, strict=True)
        if fields and texts is None and len(set(map(len, fields))) == 1 and all(map(_HEX.fullmatch, fields))
    }

    def is_hex(fields: Sequence[str]) -> bool:
        same = {len(field) for field in fields}
        return same <= widths and all(map(str.isdigit, fields)) and any(one[0] == "0" for one in fields)

    return [
        None if widths and texts == ("", "") and fields and is_hex(fields) else texts
        for fields, texts in zip(columns, around, strict=True)
    ]


def _is_other(
    line: str, row: Sequence[str], around: Sequence[tuple[str, str] | None], words: set[str], decimal: str
) -> bool:
    """Whether a line that is not sound is none of the layout: a message of the device, and no damaged line.

    It has words that no sound line has, or fewer than half of the numbers.
    """
    if len(row) != len(around) and any(word not in words for word in _LETTERS.findall(line)):
        return True
    numbers = sum(parts_of(field, decimal) is not None for field in row)
    return 2 * numbers < sum(texts is not None for texts in around)


def _texts_of(texts: Sequence[str], decimal: str) -> tuple[str, str] | None:
    """The name in front of the number of a column, and the unit behind it; None if it is no number.

    Either is empty where there is none.

    A word that is always the same, such as 0A, is none: the numbers before a unit change, have decimals, or a
    blank behind them. Lines without a value are left out of it, also where most have none.
    """
    parts = [parts_of(text, decimal) for text in texts]
    known = Counter(one for one in parts if one is not None)
    around = max(known, key=lambda one: known[one], default=None)
    if around is None:
        return None
    fitting = sum(_is_number(text, around, NUMBER[decimal]) for text in texts)
    if fitting < MAJORITY * len(texts):
        return None
    name, unit = around
    numbers = {
        text.removeprefix(name).removesuffix(unit)
        for text, one in zip(texts, parts, strict=True)
        if one == around
    }
    alone = unit and not name and len(numbers) == 1
    return None if alone and not any(mark in one for one in numbers for mark in (decimal, " ")) else around


def _is_number(text: str, around: tuple[str, str], number: re.Pattern[str]) -> bool:
    """Whether a field has a number, with those texts around it where they are not empty; it may be absent."""
    bare = number_within(text, *around)
    return bare is not None and bool(number.fullmatch(bare) or ABSENT.fullmatch(bare))


def _prefix_of(rows: Sequence[Sequence[str]], width: int) -> str:
    """The word that nearly all rows begin with; empty if there is none."""
    if width == 1 or not rows:
        return ""
    word, times = Counter(row[0] for row in rows).most_common(1)[0]
    return word if times >= MAJORITY * len(rows) and _PREFIX.fullmatch(word) else ""


def _column(
    texts: Sequence[str], places: NDArray[np.int64], name: str, decimal: str, around: tuple[str, str]
) -> Column:
    """One column.

    Args:
        texts: its fields, of the lines that are not damaged; a number may be absent in some.
        places: int64 ``[n]``, which lines of the layout those are.
        name: of the column.
        decimal: decimal mark of the numbers; empty if it is text.
        around: the texts in front of and behind the numbers.
    """
    prefix, unit = around
    last = texts[-1] if texts else ""
    written = texts
    texts = [(number_within(text, *around) or "").strip() for text in texts] if decimal else texts
    if not decimal or all(map(ABSENT.fullmatch, texts)):
        # Where some are numbers, one that is none shows why it is no column of them.
        none = (text for text in reversed(texts) if not any(one.fullmatch(text) for one in NUMBER.values()))
        return Column(name, numeric=False, last=next(none, last))
    there = [k for k, text in enumerate(texts) if not ABSENT.fullmatch(text)]
    absent = [text for k, text in enumerate(written) if ABSENT.fullmatch(texts[k])]
    texts, places = [texts[k] for k in there], places[there]
    values = np.array([float(text.replace(decimal, ".")) for text in texts])
    # What has a unit counts no lines; but it may be a time.
    whole = not unit and all(text.isdigit() for text in texts)
    rises = np.diff(values) >= 0
    grows = bool(
        (not unit or unit in TIME_UNITS) and len(rises) and rises.mean() >= 0.98 and values[-1] > values[0]
    )
    ends = min(_ENDS, len(values) // 2)
    per_line = 0.0
    if ends:
        # Medians: one damaged digit must not count.
        lines = np.median(places[-ends:]) - np.median(places[:ends])
        per_line = float((np.median(values[-ends:]) - np.median(values[:ends])) / lines)
    step = _step_of(values, places) if whole else 0.0
    turns_at = _turn_of(values, step)
    per_line = _counted_per_line(values, places) if step == 1 else per_line
    least, most = float(values.min()), float(values.max())
    return Column(
        name,
        True,
        least,
        most,
        step,
        turns_at,
        grows,
        per_line,
        last if any(around) else texts[-1],
        unit,
        prefix,
        len(absent),
        absent[-1] if absent else "",
        _swings(values),
        _bits_of(values, step),
    )


def _swings(values: NDArray[np.float64]) -> bool:
    """Whether values swing about 0: they pass their mean in a good part of the steps.

    The noise of a level does so, too, but not about 0.
    """
    mean = values.mean()
    if len(values) < _LEAST_SWINGING or len(set(values.tolist())) < _LEAST_DIFFERENT:
        return False
    passes = np.diff(values > mean).mean() >= _SWINGING
    return bool(passes and abs(mean) <= values.std() and values.min() < 0 < values.max())


def _step_of(values: NDArray[np.float64], places: NDArray[np.int64]) -> float:
    """By how much whole numbers count from line to line; 0 if they do not.

    Nearly all steps are the same. A few lines may be missing, a digit damaged, and a counter wraps; but one
    that begins again often, as a number of a channel does, counts no lines.
    """
    lines, steps = np.diff(places), np.diff(values)
    if len(steps) < _LEAST_STEPS:
        return 0.0
    each = steps / lines
    step, _ = Counter(each.tolist()).most_common(1)[0]
    same = each == step
    if step <= 0 or same.mean() < MAJORITY:
        return 0.0
    resets = (steps[1:-1] < 0) & same[:-2] & same[2:]
    beyond = (steps[1:-1] - step * lines[1:-1]) % _WRAP != 0
    return float(step) if (resets & beyond).sum() <= _MOST_RESETS else 0.0


def _counted_per_line(values: NDArray[np.float64], places: NDArray[np.int64]) -> float:
    """By how much a column counts from line to line: more than 1 where lines are missing."""
    lines, steps = np.diff(places), np.diff(values)
    missing = np.maximum(steps - lines, 0.0)
    # Around a damaged digit, or where the count begins again, it falls.
    falls = np.concatenate([[False], steps <= 0, [False]])
    missing[falls[:-2] | falls[1:-1] | falls[2:]] = 0.0
    return float(1 + missing.sum() / lines.sum())


def _turn_of(values: NDArray[np.float64], step: float) -> int:
    """The power of ten at which a count begins again; 0 if none was seen."""
    if not step or len(values) < 3:
        return 0
    before, after, beyond = values[:-2], values[1:-1], values[2:]
    # Lines at the turn may be missing. Behind a damaged digit the count goes on as before it.
    turns_at = 10.0 ** np.ceil(np.log10(np.maximum(before, 1.0) + step))
    turned = (before >= (1 - _TURN_SHARE) * turns_at) & (after <= _TURN_SHARE * turns_at) & (beyond < before)
    return int(turns_at[turned][0]) if turned.any() else 0


def _bits_of(values: NDArray[np.float64], step: float) -> int:
    """The bits after which a counter begins again at 0; 0 if that was not seen."""
    if step != 1 or len(values) < 3:
        return 0
    before, after, beyond = values[:-2], values[1:-1], values[2:]
    for bits in _WIDTHS:
        turns_at = 2**bits
        # Behind a damaged digit the count goes on as before it.
        fell = (before - after > turns_at / 2) & (beyond < before)
        if values.max() < turns_at and (fell & ((after - before) % turns_at <= _MOST_AT_TURN)).any():
            return bits
    return 0


def _sum_fits(line: str, checksum: str) -> bool:
    """Whether the checksum of a line is right, as far as it is known."""
    if checksum not in {"xor", "crc16"}:
        return True
    match = _CHECKSUM.search(line)
    if match is None:
        return False
    text, sent = line[: match.start()].lstrip("$!"), int(match[1], 16)
    name, made = _SUMS[len(match[1])]
    return name == checksum and any(made(one) == sent for one in encoded(text))


def _checksum_of(lines: Sequence[str]) -> str:
    with_checksum = [line for line in lines if _CHECKSUM.search(line) is not None]
    if len(with_checksum) < MAJORITY * len(lines):
        return "none"
    for name, _ in _SUMS.values():
        if sum(_sum_fits(line, name) for line in with_checksum) >= MAJORITY * len(with_checksum):
            return name
    return "unknown"
