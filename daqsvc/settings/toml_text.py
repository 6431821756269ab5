"""The text of a machine file, or why it is none: TOML within limits that no machine needs to exceed.

The parser of the standard library has no limits: tables nested hundreds deep, or keys of a hundred thousand
parts, would take minutes and gigabytes of it and of what comes after.
"""

from __future__ import annotations

import re
import tomllib
from typing import TYPE_CHECKING, Any

from daqsvc.errors.machine_file import NOT_TOML, NOT_UTF8, TOO_LARGE
from daqsvc.settings.error_messages import dotted
from daqsvc.settings.locate import Spot, TooMuchError, locate

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from daqsvc.errors.code import Code
    from daqsvc.settings.problems import KeyPath

MOST_BYTES = 1 << 20
"""A machine file of a thousand sensors and alarms has half of it."""
MOST_DEPTH = 16
"""Tables and arrays within each other; the format has six."""
MOST_VALUES = 100_000
MOST_ENTRIES = 5000
"""Of one table or array."""
_SHORTEST_INT, _LONGEST_INT = -(1 << 63), (1 << 63) - 1
"""What TOML gives a whole number room for."""
# A key with more parts than the limit: the parser takes a time that grows with the square of their number. A
# word begins where no word goes on, so that each is passed over once.
_PART = r"""(?:(?<![A-Za-z0-9_-])[A-Za-z0-9_-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')[ \t]*+"""
_LONG_KEY = re.compile(rf"(?:^|[\[{{,])[ \t]*+(?:{_PART}\.[ \t]*+){{{2 * MOST_DEPTH}}}", re.MULTILINE)
_LONG_NUMBER = re.compile(r"[=\[,][ \t]*+[+-]?(?:0[xob][0-9A-Fa-f_]{300}|[0-9][0-9_]{300})")


class TomlTextError(Exception):
    """A text that is no TOML, or more than a machine file can be; the message is to be read after its name.

    Attributes:
        remedy: what to do about it.
        code: of the kind of mistake.
        line: where, from 1; None if it concerns the text as a whole.
    """

    def __init__(self, message: str, remedy: str, code: Code, line: int | None = None) -> None:
        super().__init__(message)
        self.remedy = remedy
        self.code = code
        self.line = line


def decoded(data: bytes, path: Path) -> str:
    """The text of a file.

    Raises:
        TomlTextError: it is not UTF-8.
    """
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        before = data[: error.start]
        line, column = before.count(b"\n") + 1, error.start - (before.rfind(b"\n") + 1) + 1
        what = f"byte {data[error.start]:#04x} at column {column}"
        if data[:2] in {b"\xff\xfe", b"\xfe\xff"}:
            what = "it looks like UTF-16"
        raise TomlTextError(f"is not UTF-8: {what}", f"save {path.name} as UTF-8", NOT_UTF8, line) from None


def parse(text: str) -> tuple[dict[str, Any], Mapping[KeyPath, Spot]]:
    """The document in a TOML text, and where in the text its keys stand.

    Args:
        text: TOML, with or without a byte order mark.

    Raises:
        TomlTextError: it is no TOML, or exceeds the limits of a machine file.
    """
    text = text.removeprefix("\ufeff")
    if len(text) > MOST_BYTES:
        raise TomlTextError(
            f"is larger than {MOST_BYTES / 1e6:.3g} MB", "check whether it is the right file", TOO_LARGE
        )
    if (match := _LONG_KEY.search(text)) is not None:
        raise _too_deep(_line_at(text, match.start()))
    if (match := _LONG_NUMBER.search(text)) is not None:
        raise TomlTextError(
            "has a number with hundreds of digits", "write a number", TOO_LARGE, _line_at(text, match.start())
        )
    try:
        # With its last line ended: else tomllib has no line number for a mistake there.
        document = tomllib.loads(text if text.endswith("\n") else f"{text}\n")
    except RecursionError:
        raise _too_deep(_deepest_line(text)) from None
    except ValueError as error:
        raise _syntax_error(text, str(error)) from None
    try:
        spots = locate(text, most_depth=MOST_DEPTH, most_values=MOST_VALUES)
    except TooMuchError as error:
        if error.deep:
            raise _too_deep(error.line) from None
        raise TomlTextError(
            f"holds more than {MOST_VALUES:,} values",
            "check whether it is the right file",
            TOO_LARGE,
            error.line,
        ) from None
    _check_sizes(document, spots)
    return document, spots


def _check_sizes(document: dict[str, Any], spots: Mapping[KeyPath, Spot]) -> None:
    """No table or array has more entries than a machine file needs, and no number more bits than TOML has."""
    waiting: list[tuple[KeyPath, Any]] = [((), document)]
    while waiting:
        path, value = waiting.pop()
        if isinstance(value, dict | list) and len(value) > MOST_ENTRIES:
            subject = f"{dotted(path)} has" if path else "has"
            raise TomlTextError(
                f"{subject} {len(value):,} entries: a machine file has at most {MOST_ENTRIES:,} in one place",
                "check whether it is the right file",
                TOO_LARGE,
                spots[path].line,
            )
        if isinstance(value, dict):
            waiting += [((*path, key), item) for key, item in value.items()]
        elif isinstance(value, list):
            waiting += [((*path, index), item) for index, item in enumerate(value)]
        elif isinstance(value, int) and not _SHORTEST_INT <= value <= _LONGEST_INT:
            raise TomlTextError(
                f"{dotted(path)} is too large for a whole number of TOML (64 bits)",
                "correct it",
                TOO_LARGE,
                spots[path].line,
            )


def _too_deep(line: int | None) -> TomlTextError:
    return TomlTextError(
        f"is nested too deeply: a machine file has at most {MOST_DEPTH} tables and arrays within each other",
        "write fewer brackets inside brackets, and keys with fewer dots",
        TOO_LARGE,
        line,
    )


def _line_at(text: str, position: int) -> int:
    return text.count("\n", 0, position) + 1


def _deepest_line(text: str) -> int:
    """Where brackets become too deep, by their number; those in texts are counted too."""
    depth = 0
    for bracket in re.finditer(r"[\[\]{}]", text):
        depth += 1 if bracket[0] in "[{" else -1
        if depth > MOST_DEPTH:
            return _line_at(text, bracket.start())
    return 1


def _syntax_error(text: str, reason: str) -> TomlTextError:
    line = None
    place = re.search(r" \(at (?:line (\d+), column (\d+)|end of document)\)$", reason)
    if place is not None:
        reason = reason[: place.start()]
        line = int(place[1]) if place[1] else text.rstrip("\n").count("\n") + 1
        where = f"column {place[2]}" if place[2] else "the end of the file"
        reason = f"{reason}, at {where}"
    opened = None if line is None else _left_open(text, line, reason)
    remedy = _remedy_in(text, line) if opened is None else f"close the bracket of line {opened}"
    return TomlTextError(f"is not valid TOML: {reason}", remedy, NOT_TOML, line)


_TOKENS = re.compile(
    r"\"\"\".*?\"\"\"|'''.*?'''|\"(?:[^\"\\\n]|\\.)*\"|'[^'\n]*'|#[^\n]*|[\[\]{}]", re.DOTALL
)
"""Texts and comments, in which brackets mean nothing, and brackets."""
_KEY, _END = r"^\s*(?P<key>[\w.-]+)", r"\s*(?:#.*)?$"
_SLIPS = tuple(
    (re.compile(f"{_KEY}{pattern}{_END}"), remedy)
    for pattern, remedy in (
        (r"\s*=\s*(?P<whole>[+-]?\d+),(?P<part>\d+)", "write {key} = {whole}.{part}, with a decimal point"),
        (r"\s*=\s*(?P<word>True|False)", "write {key} = {lower}: TOML has true and false in lower case"),
        (r"\s*=\s*(?P<number>[+-]?\d[\d_.]*)\s*[^\W\d][^\s#]*", "write {key} = {number}, without a unit"),
        (r"\s*=\s*(?P<word>[^\W\d][^\s\"'#=\[\]{{}},]*)", 'write {key} = "{word}", with quotes'),
        (
            r"\s*:\s*(?P<word>[^\W\d][^\s\"'#=\[\]{{}},]*)",
            'write {key} = "{word}", with an equals sign and quotes',
        ),
        (r"\s*:\s*(?P<value>[^#\s].*?)", "write {key} = {value}, with an equals sign"),
        (r"\s*=\s*\"[^\"]*", 'end the text with a quote: "'),
        (r"\s*=", "write a value behind {key} ="),
    )
)
"""Lines that people write, and that are no TOML: the first that fits tells what was meant."""


_HEADER = re.compile(r"\s*\[[\w.\[-]+\]")
"""A new table: what is open there should have been closed before."""


def _left_open(text: str, line: int, reason: str) -> int | None:
    """The line of the first bracket that is still open where an error shows; None if none is."""
    lines = text.split("\n")
    is_header = _HEADER.match(lines[line - 1]) is not None
    if not (is_header or "Unclosed" in reason or "Expected ']'" in reason):
        return None
    before = "\n".join(lines[: line - 1 if is_header else line])
    opened: list[int] = []
    for token in _TOKENS.finditer(before):
        if token[0] in "[{":
            opened.append(token.start())
        elif token[0] in "]}" and opened:
            opened.pop()
    return _line_at(before, opened[-1]) if opened else line if "Expected ']'" in reason else None


def _remedy_in(text: str, line: int | None) -> str:
    """What to write in place of the line that is no TOML."""
    wrong = "" if line is None else text.split("\n")[line - 1]
    for slip, remedy in _SLIPS:
        if (found := slip.match(wrong)) is not None:
            words = found.groupdict()
            return remedy.format(**words, lower=words.get("word", "").lower())
    return "correct the TOML there: text stands in quotes, tables are [name], values are key = value"
