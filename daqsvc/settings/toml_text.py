"""The text of a machine file, or why it is none: TOML within limits that no machine needs to exceed.

The parser of the standard library has no limits: tables nested hundreds deep, or keys of a hundred thousand
parts, would take minutes and gigabytes of it and of what comes after.
"""

from __future__ import annotations

import re
import tomllib
from itertools import takewhile
from typing import TYPE_CHECKING, Any

from daqsvc.errors.machine_file import NOT_TOML, NOT_UTF8, TOO_LARGE
from daqsvc.settings.error_messages import dotted
from daqsvc.settings.locate import Spot, TooMuchError, locate
from daqsvc.settings.written_numbers import number_meant, with_digits

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
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
    if line is not None and (twice := _twice(text, line, reason)) is not None:
        return TomlTextError(f"is not valid TOML: {twice[0]}", twice[1], NOT_TOML, line)
    if line is not None and place is not None and reason.startswith(_NO_KEY):
        braces = _in_braces(text.split("\n")[line - 1], int(place[2] or 0))
        if braces is not None:
            return TomlTextError(f"is not valid TOML: {braces[0]}", braces[1], NOT_TOML, line)
    opened = None if line is None else _left_open(text, line, reason)
    remedy = _remedy_in(text, line) if opened is None else f"close the bracket of line {opened}"
    return TomlTextError(f"is not valid TOML: {reason}", remedy, NOT_TOML, line)


_NO_KEY = "Invalid initial character for a key part"


def _in_braces(line: str, column: int) -> tuple[str, str] | None:
    """Message and remedy where braces end, or the line does, in place of a key; None if neither does."""
    before, here = line[: column - 1].rstrip(), line[column - 1 : column]
    if not before.endswith((",", "{")):
        return None
    if here == "}":
        what = (
            "a comma behind the last value in braces" if before.endswith(",") else "a comma in empty braces"
        )
        return f"{what}, at column {column}", "remove this comma: [ ] may end with one, { } may not"
    if here in {"", "\r", "#"}:
        return (
            f"braces go on behind the end of the line, at column {column}",
            "write all that is between { and } in one line, or a separate table: [name]",
        )
    return None


_TOKENS = re.compile(
    r"\"\"\".*?\"\"\"|'''.*?'''|\"(?:[^\"\\\n]|\\.)*\"|'[^'\n]*'|#[^\n]*|[\[\]{}]", re.DOTALL
)
"""Texts and comments, in which brackets mean nothing, and brackets."""
_CURLY = "\u201c\u201d\u201e\u201f\u00ab\u00bb\u2018\u2019\u201a\u2039\u203a"
"""Quotes that word processors and web pages put in place of straight ones."""
_KEY, _END = r"^\s*(?P<key>[\w.-]+)", r"\s*(?:#.*)?$"
_SLIPS = tuple(
    (re.compile(f"{_KEY}{pattern}{_END}"), remedy)
    for pattern, remedy in (
        (r"\s*=\s*(?P<whole>[+-]?\d+),(?P<part>\d+)", "write {key} = {whole}.{part}, with a decimal point"),
        (r"\s*=\s*(?P<word>True|False)", "write {key} = {lower}: TOML has true and false in lower case"),
        (
            rf"\s*=\s*[{_CURLY}\"'](?P<word>[^{_CURLY}\"'#]*)[{_CURLY}\"']",
            'write {key} = "{word}", with straight quotes',
        ),
        (r"\s*=\s*(?P<word>(?i:ja|yes|on|oui|si))", 'write {key} = true, or "{word}" if it is a text'),
        (r"\s*=\s*(?P<word>(?i:nein|no|off|non))", 'write {key} = false, or "{word}" if it is a text'),
        (r"\s*=\s*(?P<word>[^\W\d][^\s\"'#=\[\]{{}},]*)", 'write {key} = "{word}", with quotes'),
        (
            r"\s*:\s*(?P<word>[^\W\d][^\s\"'#=\[\]{{}},]*)",
            'write {key} = "{word}", with an equals sign and quotes',
        ),
        (r"\s*:\s*(?P<value>[^#\s].*?)", "write {key} = {value}, with an equals sign"),
        (r"\s*=\s*\"[^\"]*", 'end the text with a quote: "'),
        (
            r"\s*=\s*(?P<value>\"[^\"]*\"|'[^']*'|true|false|0x[\da-fA-F]+|[+-]?\d[\d_]*(\.\d+)?(e[+-]?\d+)?)\s*,",
            "write {key} = {value}, without the comma behind it",
        ),
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
    if len(wrong) > _LONGEST_SLIP:
        wrong = ""
    number = _number_in(wrong)
    if number is not None:
        return number
    if (path := _BACKSLASHES.search(wrong)) is not None and "'" not in path["word"]:
        return f"write {path['key']} = '{path['word']}', in single quotes: there a backslash is only itself"
    for slip, remedy in _SLIPS:
        if (match := slip.match(wrong)) is not None:
            words = match.groupdict()
            return remedy.format(**words, lower=words.get("word", "").lower())
    if (curly := re.search(f"[{_CURLY}]", _TEXTS.sub("", wrong))) is not None:
        return f'write straight quotes (") in place of {curly[0]}'
    return "correct the TOML there: text is in quotes, tables are [name], values are key = value"


_LONGEST_SLIP = 1000
"""Characters of a line that a person may have written; the search in a longer one could take minutes."""
_BACKSLASHES = re.compile(r"(?P<key>[\w.-]+)\s*=\s*\"(?P<word>[^\"\\]*\\[^\"]*)\"")
_TEXTS = re.compile(r"\"(?:[^\"\\]|\\.)*\"|'[^']*'|#.*")
_THOUSANDS = re.compile(
    r"(?P<key>[\w-]+)\s*=\s*(?P<whole>[+-]?\d{1,3}(?:(?P<mark>[., ])\d{3})(?:(?P=mark)\d{3})*)"
    r"(?:(?P<point>[.,])(?P<part>\d+))?(?=\s*(?:[,}\]]|$))"
)
_COMMA = re.compile(r"(?P<key>[\w-]+)\s*=\s*(?P<whole>[+-]?\d+),(?P<part>\d+)(?=\s*[,}\]])")
_EITHER_COMMA = re.compile(
    r"(?P<key>[\w.-]+)\s*=\s*(?P<whole>[+-]?[1-9]\d{0,2}),(?P<part>\d{3})(?=\s*(?:[,}\]]|$))"
)
"""A comma between thousands, or a decimal comma: only who wrote it knows."""
_VALUE = re.compile(r"\s*(?P<key>[\w.-]+)\s*=\s*(?P<text>[\w.+-]+)\s*(?:#|$)")
"""A value without quotes."""
_UNIT = re.compile(
    r"^\s*(?P<key>[\w.-]+)\s*=\s*(?P<text>(?P<number>[+-]?\d[\d_]*(?:\.\d+)?)\s*(?:[^\W\d][^\s#]*|\d[NEO]\d))\s*$"
)


def _number_in(line: str) -> str | None:
    """What to write for a number with a comma, marks between thousands, or a unit; None if there is none."""
    bare = _TEXTS.sub(lambda text: " " * len(text[0]), line)
    for match in _THOUSANDS.finditer(bare):
        if match["point"] != match["mark"] and (
            match["point"] or match["whole"].count(match["mark"]) > 1 or match["mark"] == " "
        ):
            digits = match["whole"].replace(match["mark"], "")
            digits += f".{match['part']}" if match["part"] else ""
            return f"write {match['key']} = {digits}, without marks between thousands"
    if (either := _EITHER_COMMA.search(bare)) is not None:
        key, whole, part = either["key"], either["whole"], either["part"]
        return f"write {key} = {whole}{part}, or {key} = {whole}.{part} if the comma is a decimal comma"
    if (comma := _COMMA.search(bare)) is not None:
        return f"write {comma['key']} = {comma['whole']}.{comma['part']}, with a decimal point"
    if (bare_value := _VALUE.match(bare)) is not None:
        alike = with_digits(bare_value["text"])
        if alike is not None:
            return f"write {bare_value['key']} = {alike[0]}, {alike[1]}"
    if (united := _UNIT.match(bare)) is not None:
        key = united["key"].rpartition(".")[2]
        meant, written = number_meant(united["text"], key), float(united["number"].replace("_", ""))
        same = meant is None or meant == written
        return f"write {united['key']} = {united['number'] if same else f'{meant:.12g}'}, without a unit"
    return None


_HEADER_NAME = re.compile(r"\s*(?P<open>\[\[?)\s*(?P<name>[^\[\]]+?)\s*\]")
_ENTRY = re.compile(r"""\s*(?P<key>[\w.-]+|"[^"]*"|'[^']*')\s*=""")


def _twice(text: str, line: int, reason: str) -> tuple[str, str] | None:
    """Message and remedy about a key or a table that is written twice; None if none is."""
    inline = re.match(r"Duplicate inline table key '(.+)'", reason)
    if inline is not None:
        return f"{inline[1]} is written twice between the same braces", "remove one of the two"
    if not reason.startswith(("Cannot overwrite a value", "Cannot declare", "Cannot mutate")):
        return None
    lines = text.split("\n")
    header, entry = _HEADER_NAME.match(lines[line - 1]), _ENTRY.match(lines[line - 1])
    if header is not None:
        return _table_twice(lines, line, header)
    if entry is None:
        return None
    above = list(
        takewhile(lambda number: _HEADER_NAME.match(lines[number - 1]) is None, range(line - 1, 0, -1))
    )
    key = entry["key"].strip("\"'")
    first = next(
        (
            number
            for number in above
            if (other := _ENTRY.match(lines[number - 1])) is not None and other["key"].strip("\"'") == key
        ),
        None,
    )
    if first is None:
        return f"{key} is a table already, or a value where a table is to be", "remove one of the two"
    return f"{key} is written twice: in line {first}, and here", "remove one of the two lines"


def _table_twice(lines: Sequence[str], line: int, header: re.Match[str]) -> tuple[str, str]:
    """Message and remedy about the table of a line, whose name has been used before."""
    name, is_one = header["name"], header["open"] == "["
    for number, before in enumerate(lines[: line - 1], 1):
        other = _HEADER_NAME.match(before)
        if other is None or other["name"] != name:
            continue
        if (other["open"] == "[") == is_one:
            return (
                f"table [{name}] is written twice: in line {number}, and here",
                "move what it holds to the first one, or give it another name",
            )
        single, several = (line, number) if is_one else (number, line)
        return (
            f"line {several} has a table [[{name}]], one of several, but line {single} has [{name}]",
            f"write [[{name}]] in line {single}, too"
            if name.endswith("s")
            else f"write [{name}], and only once",
        )
    return (
        f"{name} is there already, as a value or as a table within another one",
        "move what it holds there, or remove one of the two",
    )
