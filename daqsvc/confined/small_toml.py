"""Small TOML files that people hand over, within limits: the parser of the standard library has none.

Keys of thousands of parts, and tables nested as deep, would take it minutes and gigabytes.
"""

from __future__ import annotations

import os
import re
import stat
import tomllib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

MOST_BYTES = 8_000_000
"""The healthy state of a machine's bearings has some 100 kB."""

MOST_DEPTH = 16

_PART = r"""(?:(?<![\w-])[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')[ \t]*+"""
# A word begins where no word goes on, so that each is passed over once.
_LONG_KEY = re.compile(rf"(?:^|[\[{{,])[ \t]*+(?:{_PART}\.[ \t]*+){{{2 * MOST_DEPTH}}}", re.MULTILINE)


class TomlFileError(ValueError):
    """A file is no TOML, or beyond the limits; the message is to be read behind its name."""


def read_toml(path: Path, most_bytes: int = MOST_BYTES) -> dict[str, Any]:
    """The tables of a file.

    Args:
        path: the file.
        most_bytes: what it may have.

    Raises:
        OSError: it cannot be opened.
        TomlFileError: it is no file, no TOML, or beyond the limits.
    """
    # Without waiting: to open a pipe that nobody writes to would take for ever.
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    with os.fdopen(descriptor, "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise TomlFileError("this is no file but a folder, pipe or device")
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise TomlFileError(f"this is larger than {most_bytes / 1e6:.3g} MB")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise TomlFileError(f"this is not UTF-8: {error.reason} at byte {error.start}") from None
    return parse_toml(text)


def parse_toml(text: str) -> dict[str, Any]:
    """The tables of a text.

    Raises:
        TomlFileError: it is no TOML, or beyond the limits.
    """
    if _LONG_KEY.search(text) is not None:
        raise TomlFileError("this is nested too deep: a key has more parts than any of its tables")
    try:
        document = tomllib.loads(text)
    except RecursionError:
        raise TomlFileError("this is nested too deep") from None
    except ValueError as error:
        raise TomlFileError(f"this is not TOML: {error}") from None
    _check(document)
    return document


def _check(document: dict[str, Any]) -> None:
    waiting: list[tuple[Any, int]] = [(document, 0)]
    while waiting:
        value, depth = waiting.pop()
        if depth > MOST_DEPTH:
            raise TomlFileError("this is nested too deep")
        if isinstance(value, dict | list):
            waiting += [(item, depth + 1) for item in (value.values() if isinstance(value, dict) else value)]
