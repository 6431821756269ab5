"""Where in a TOML text each key stands, so that a message can name the line.

`tomllib` reads values and forgets places. This scanner reads places and leaves values alone: it
assumes a text that `tomllib` has accepted, so it needs no error handling of its own.
"""

from __future__ import annotations

import bisect
import re
import tomllib
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from daqsvc.settings.problems import KeyPath

# Quantifiers that give nothing back (++, *+): on megabytes of blanks the others take gigabytes.
_BLANK = re.compile(r"[ \t]*+")
_BLANK_LINES = re.compile(r"(?:[ \t\r\n]++|#[^\n]*+)*+")
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_SCALAR = re.compile(r"[^,\]}#\r\n]*")  # numbers, booleans and dates (which may hold a space)
# Each quoted form up to its end; a multi-line string may end in up to two quotes of its own.
_QUOTED = {
    '"""': re.compile(r'"""(?:[^\\"]++|\\.|"(?!""))*+"""(?:""|"|)(?!")', re.DOTALL),
    "'''": re.compile(r"'''.*?'''(?:''|'|)(?!')", re.DOTALL),
    '"': re.compile(r'"(?:[^"\\]++|\\.)*+"'),
    "'": re.compile(r"'[^']*'"),
}


@dataclass(frozen=True, slots=True)
class Spot:
    """A place in the text.

    Attributes:
        line: from 1.
        source: the value as it is written; empty for a table with its own header.
    """

    line: int
    source: str = ""


class TooMuchError(Exception):
    """A text with more in it than was asked for.

    Attributes:
        line: where it becomes too much, from 1.
        deep: whether its tables and arrays are too deep within each other; else there are too many values.
    """

    def __init__(self, line: int, *, deep: bool) -> None:
        super().__init__(line)
        self.line = line
        self.deep = deep


def locate(text: str, *, most_depth: int = 100, most_values: int = 1_000_000) -> Mapping[KeyPath, Spot]:
    """The place of every key, table and array element of a valid TOML text.

    Args:
        text: what `tomllib.loads` accepted.
        most_depth: longest key path.
        most_values: keys, tables and array elements, at most.

    Returns:
        For each key path its spot: of a value the line of its key (of an array element, of the element),
        of a table the line where it is first mentioned. The empty path means the whole, at line 1.

    Raises:
        TooMuchError: the text goes beyond these limits.
    """
    return _Scanner(text.replace("\r\n", "\n"), most_depth, most_values).scan()


def line_of(text: str, path: KeyPath) -> int | None:
    """The line of a key of a valid TOML text, or of the nearest table above it if that is not there.

    Args:
        text: what `tomllib.loads` accepted; empty for values that came from no text.
        path: of the key.

    Returns:
        From 1; None if there is no text.
    """
    if not text:
        return None
    spots = locate(text.removeprefix("\ufeff"))
    return next(spots[path[:end]].line for end in range(len(path), -1, -1) if path[:end] in spots)


class _Scanner:
    def __init__(self, text: str, most_depth: int, most_values: int) -> None:
        self._text = text
        self._most_depth = most_depth
        self._most_values = most_values
        self._position = 0
        self._line_starts = [0, *(match.end() for match in re.finditer("\n", text))]
        self._spots: dict[KeyPath, Spot] = {(): Spot(1)}
        self._table_counts: dict[KeyPath, int] = {}

    def scan(self) -> Mapping[KeyPath, Spot]:
        table: KeyPath = ()
        self._skip(_BLANK_LINES)
        while self._position < len(self._text):
            if self._text.startswith("[", self._position):
                table = self._header()
            else:
                self._key_value(table)
            self._skip(_BLANK_LINES)
        return self._spots

    def _header(self) -> KeyPath:
        line = self._line()
        array_of_tables = self._take("[[")
        if not array_of_tables:
            self._take("[")
        keys = tuple(self._keys())
        self._take("]]" if array_of_tables else "]")
        path: KeyPath = ()
        for key in keys[:-1]:
            path = self._last_element((*path, key))
            self._note(path, line)
        path = (*path, keys[-1])
        self._note(path, line)
        if array_of_tables:
            self._table_counts[path] = self._table_counts.get(path, 0) + 1
        path = self._last_element(path)
        self._note(path, line)
        return path

    def _note(self, path: KeyPath, line: int) -> None:
        """Keep the line where a table or value is first mentioned."""
        self._spots.setdefault(path, Spot(line))
        if len(path) > self._most_depth or len(self._spots) > self._most_values:
            raise TooMuchError(line, deep=len(path) > self._most_depth)

    def _last_element(self, path: KeyPath) -> KeyPath:
        """The table that a header means by ``path``: of an array of tables, the latest one."""
        count = self._table_counts.get(path)
        return path if count is None else (*path, count - 1)

    def _key_value(self, table: KeyPath) -> None:
        line = self._line()
        path = table
        for key in self._keys():
            path = (*path, key)
            self._note(path, line)
        self._take("=")
        self._spots[path] = Spot(line, self._value(path))

    def _keys(self) -> Iterator[str]:
        """The parts of a dotted key, up to what follows it."""
        while True:
            self._skip(_BLANK)
            quote = self._text[self._position]
            if quote in "\"'":
                literal = self._match(_QUOTED[quote])
                yield tomllib.loads(f"key = {literal}")["key"]
            else:
                yield self._match(_BARE_KEY)
            self._skip(_BLANK)
            if not self._take("."):
                return

    def _value(self, path: KeyPath) -> str:
        """Pass over a value, noting what lies in it; returns it as it is written."""
        self._skip(_BLANK)
        start = self._position
        for quote, pattern in _QUOTED.items():
            if self._text.startswith(quote, start):
                return self._match(pattern)
        if self._take("["):
            self._array(path)
        elif self._take("{"):
            self._inline_table(path)
        else:
            return self._match(_SCALAR).rstrip()
        return self._text[start : self._position]

    def _array(self, path: KeyPath) -> None:
        index = 0
        self._skip(_BLANK_LINES)
        while not self._take("]"):
            line = self._line()
            element = (*path, index)
            self._note(element, line)
            self._spots[element] = Spot(line, self._value(element))
            index += 1
            self._skip(_BLANK_LINES)
            self._take(",")
            self._skip(_BLANK_LINES)

    def _inline_table(self, path: KeyPath) -> None:
        self._skip(_BLANK_LINES)
        while not self._take("}"):
            self._key_value(path)
            self._skip(_BLANK_LINES)
            self._take(",")
            self._skip(_BLANK_LINES)

    def _line(self) -> int:
        return bisect.bisect_right(self._line_starts, self._position)

    def _skip(self, pattern: re.Pattern[str]) -> None:
        self._match(pattern)

    def _match(self, pattern: re.Pattern[str]) -> str:
        match = pattern.match(self._text, self._position)
        if match is None:
            raise ValueError(f"line {self._line()} is not TOML that tomllib accepts")
        self._position = match.end()
        return match.group()

    def _take(self, token: str) -> bool:
        """Pass over ``token`` if it comes next."""
        if not self._text.startswith(token, self._position):
            return False
        self._position += len(token)
        return True
