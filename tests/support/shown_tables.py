"""Compares tables of what runs (`daqsvc status`, `alarms`, `trend`) with what pages show: all but figures.

Which rows such a table has depends on the hour. So each cell that a page shows must have come in some row,
must be a message of the program, or a name of the examples.
"""

from __future__ import annotations

import re
import tomllib
from functools import cache
from typing import TYPE_CHECKING, Any

from support.machine_files import MACHINES
from support.shown_output import shape

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_CELLS = re.compile(r"\s{2,}")
_PHRASES = re.compile(r"[,;:] |\s{2,}")
_ID = re.compile(r"\b[0-9a-f]{8}\b")
_MODE = re.compile(r"\b(?:N|F\d(?:L\d)?)\b(?: \((?:alert|danger)\))?")
_TIME = re.compile(r"# (?:ms|s|min|h|d|days?)\b")
_BARS = re.compile("[▁-█]+")
_IN_A_COLUMN = 20
"""Least indent of a line that goes on with the last cell of the one above."""
OF_OTHERS = {
    "broker": "there is none; tests/hil/test_package.py has one",
    "connected": "the same",
}
"""Phrases that cannot come here: why, and the test in which they do."""
LEAST_BLANKS = 2
"""In a message; words alone are in any."""
_MESSAGE = 4
"""Indent of the messages below a row."""


def unlike(shown: str, came: str, is_said: Callable[[str], bool]) -> str:
    """The first title or cell that is shown and neither came nor is a message or a name; "" if all are.

    Args:
        shown: as a page has it.
        came: all that the verbs have shown.
        is_said: whether the program has such a message.
    """

    def is_message(text: str) -> bool:
        return text.count(" ") >= LEAST_BLANKS and is_said(text)

    machines = {_kind(machine) for machine in _machines()}
    known = {"", "#", *machines, *_names(), *OF_OTHERS} | {
        _kind(phrase) for line in _whole_lines(came) for phrase in _PHRASES.split(line)
    }
    titles = {shape(line) for line in came.splitlines()}
    for line in _whole_lines(shown):
        if line.isupper() and not re.search(r"\d", line):
            if shape(line) not in titles:
                return line
            continue
        for cell in filter(None, _CELLS.split(line)):
            if not is_message(cell):
                for phrase in map(str.strip, _PHRASES.split(cell)):
                    if _kind(phrase) not in known and not is_message(phrase):
                        return phrase
    return ""


def _kind(phrase: str) -> str:
    """A phrase without what may be another one at another hour."""
    phrase = _MODE.sub("mode", _ID.sub("id", _BARS.sub("", phrase.strip())))
    if " " in phrase:
        phrase = re.sub(r"[\w.-]+", lambda word: "name" if word[0] in _names() else word[0], phrase)
        phrase = re.sub(r"\bby \w+$", "by somebody", phrase)
    return _TIME.sub("# s", shape(phrase).removesuffix(","))


def _whole_lines(text: str) -> Iterator[str]:
    """The lines, each with those that go on with it."""
    whole, before = "", 0
    for line in filter(str.strip, text.splitlines()):
        indent = len(line) - len(line.lstrip())
        if whole and (indent >= _IN_A_COLUMN or _MESSAGE <= indent <= before):
            whole += f" {line.strip()}"
            continue
        yield whole.strip()
        whole, before = line, indent
    yield whole.strip()


@cache
def _examples() -> list[dict[str, Any]]:
    return [tomllib.loads(file.read_text("utf-8")) for file in MACHINES.glob("*.toml")]


@cache
def _names() -> frozenset[str]:
    """Of the machines in the examples, and of their sensors and alarms."""
    parts = [part for file in _examples() for key in ("sensors", "alarms") for part in file.get(key, [])]
    return frozenset(part["name"] for part in [*parts, *(file["machine"] for file in _examples())])


def _machines() -> list[str]:
    """The machines in the examples, each with site and box."""
    return [f"{file['machine']['name']} ({file['site']}/{file['box']})" for file in _examples()]
