"""Where the keys of a machine file stand, and in which tables: read by rules of TOML alone.

The guard must not read machine files by the code that it guards.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

Path: TypeAlias = tuple[str | int, ...]

KIND_KEYS = {"driver", "transport", "framing", "way", "type"}
"""Keys whose value says what else can stand in the table."""

_BLANK = re.compile(r"(?:[ \t\r\n]+|#[^\n]*)*")
_NAME = re.compile(r'[A-Za-z0-9_-]+|"[^"\n]*"')
_TEXT = re.compile(r'"""(?:[^\\]|\\.)*?"""|\'\'\'.*?\'\'\'|"(?:[^"\\\n]|\\.)*"|\'[^\'\n]*\'', re.DOTALL)
_SCALAR = re.compile(r"[^,\]}#\r\n]*[^,\]}#\r\n \t]")


@dataclass(frozen=True)
class Key:
    """A key with its value.

    Attributes:
        path: names and positions that lead to it, itself included.
        begin: where its name begins in the text.
        name_end: one past the end of the name.
        value_begin: where its value begins.
        end: one past the end of the value.
        value: the value.
        inline: whether it stands in an inline table.
    """

    path: Path
    begin: int
    name_end: int
    value_begin: int
    end: int
    value: Any
    inline: bool

    @property
    def name(self) -> str:
        """Its own name."""
        return str(self.path[-1])


@dataclass(frozen=True)
class Header:
    """The header of a table.

    Attributes:
        path: names and positions that lead to the table.
        begin: where its line begins.
        name_end: one past the end of its last name.
        end: one past the end of its line.
    """

    path: Path
    begin: int
    name_end: int
    end: int


class _Reader:
    def __init__(self, text: str) -> None:
        self.text, self.at = text, 0
        self.keys, self.headers = list[Key](), list[Header]()
        self.numbers: dict[Path, int] = {}

    def read(self) -> _Reader:
        table: Path = ()
        while self._blank() < len(self.text):
            if self.text[self.at] == "[":
                table = self._header()
            else:
                self._key(table, inline=False)
        return self

    def _blank(self) -> int:
        self.at = self._past(_BLANK)
        return self.at

    def _past(self, pattern: re.Pattern[str]) -> int:
        match = pattern.match(self.text, self.at)
        if match is None:
            raise ValueError(f"guard.tables cannot read {self.text[self.at : self.at + 40]!r}")
        return match.end()

    def _header(self) -> Path:
        end = self.text.index("]", self.at)
        several = self.text.startswith("[[", self.at)
        path: Path = ()
        names = _NAME.findall(self.text[self.at : end])
        for depth, name in enumerate(names, 1):
            path = (*path, name.strip('"'))
            if several and depth == len(names):
                self.numbers[path] = self.numbers.get(path, -1) + 1
            if path in self.numbers:
                path = (*path, self.numbers[path])
        self.headers.append(Header(path, self.at, end, end + 1 + several))
        self.at = end + 1 + several
        return path

    def _key(self, table: Path, *, inline: bool) -> None:
        begin = self.at
        self.at = self._past(_NAME)
        name, name_end = self.text[begin : self.at].strip('"'), self.at
        self._blank()
        self.at += 1  # the equals sign
        self._blank()
        place, path = len(self.keys), (*table, name)
        value_begin = self.at
        self._value(path)
        value = tomllib.loads(f"value = {self.text[value_begin : self.at]}")["value"]
        self.keys.insert(place, Key(path, begin, name_end, value_begin, self.at, value, inline))

    def _value(self, path: Path) -> None:
        match self.text[self.at]:
            case '"' | "'":
                self.at = self._past(_TEXT)
            case "[" | "{" as bracket:
                closing = "]" if bracket == "[" else "}"
                self.at += 1
                number = 0
                while self.text[self._blank()] != closing:
                    if bracket == "{":
                        self._key(path, inline=True)
                    else:
                        self._value((*path, number))
                    number += 1
                    if self.text[self._blank()] == ",":
                        self.at += 1
                self.at += 1
            case _:
                self.at = self._past(_SCALAR)


def keys(text: str) -> list[Key]:
    """All keys of a TOML text that have a value, those of inline tables too, in the order of the text."""
    return _Reader(text).read().keys


def headers(text: str) -> list[Header]:
    """The headers of a TOML text, in its order."""
    return _Reader(text).read().headers


def tables(text: str) -> Iterator[tuple[str, list[Key]]]:
    """Every table of a machine file, as `label` names it, with its keys."""
    document = tomllib.loads(text)
    found: dict[Path, list[Key]] = {}
    for key in keys(text):
        found.setdefault(key.path[:-1], []).append(key)
    for path, held in found.items():
        yield label(document, path), held


def label(document: Mapping[str, Any], path: Path) -> str:
    """What a table is, e.g. ``buses.NAME<serial cobs>`` or ``streams.NAME.layout<plain>.counter``."""
    text = ""
    value: Any = document
    for depth, step in enumerate(path):
        value = value[step]
        if isinstance(step, int):
            text += "[]"
        elif depth == 1 and path[0] in {"buses", "streams"}:
            text += ".NAME"
        else:
            text += f".{step}" if text else str(step)
        if isinstance(value, dict) and (kind := _kind(path[: depth + 1], value)):
            text += f"<{kind}>"
    return text


def _kind(path: Path, table: Mapping[str, Any]) -> str:
    """What makes this table another one than those in the same place; empty if there is one kind only."""
    match path:
        case ("buses", _):
            named = [table.get(key) for key in ("driver", "transport", "framing")]
            return " ".join(str(name) for name in named if name is not None)
        case ("streams", _, "layout"):
            if "way" in table:
                return str(table["way"])
            tells = ("columns", "line", "payload_length", "dbc")
            return next((key for key in tells if key in table), "plain")
        case ("sensors", _):
            return str(table.get("type"))
        case ("alarms", _):
            return next((key for key in ("detector", "sensors", "sensor") if key in table), "")
    return ""
