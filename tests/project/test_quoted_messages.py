"""Messages that a page quotes are messages of the program: figures and names may differ, words may not."""

from __future__ import annotations

import ast
import errno
import functools
import os
import re
from typing import TYPE_CHECKING

import pytest
from support.given_codes import is_had
from support.paths import ROOT
from support.snippets import PAGES

from daqsvc.errors.table import CODES

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.sources
FIELD = "\0"
"""Stands in a text of the source for what is put in there."""
LEFT_OUT = "..."
HEADS = {"message", "in log or status"}
"""What stands above the first column of a table of messages."""
GOLDEN = ROOT / "tests" / "guard" / "golden"
PACKAGES = ("daqsvc", "drivers", "sim_hw", "config/postgresql")
EXAMPLES = ROOT / "daqsvc" / "errors"
"""Its texts quote messages, and are none themselves."""
ELSEWHERE = (ROOT / "docs" / "reference", ROOT / "docs" / "tutorials")
"""Made from the source; followed word for word."""
PLACE = re.compile(r"^(?:daqsvc \w+: |alarm: |\S+\.toml:\d+: )?(?:[\w.]+ = (?:\"[^\"]*\"|[\w.]+): )?")
"""Where a message is: the verb, or the line of the file, the key and its value."""
ENDS_WITH_A_CODE = re.compile(r"(?m)(?:^|`)((?:[^`\s]+ )+[^`\s]+) \[([A-Z]\d\d)\](?:`|$)")
"""In a block or in backticks: a message and its code. Lines of tables are those of test_shown_commands.py."""

LINK = re.compile(r"\b(?:CAN bus|serial port) '[^']*'(?: \([^()]*\))?")
"""A bus or a port, as one name."""
OF_CHECK = re.compile(r"\S+\.toml:\d+: (\S+) = \S+: (.*)")


def constants(tree: ast.AST) -> Iterator[str]:
    """The texts of a module, but for docstrings; `FIELD` stands for what is put in."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            node.value.value = None
        elif isinstance(node, ast.JoinedStr):
            parts = [f"{part.value}" if isinstance(part, ast.Constant) else FIELD for part in node.values]
            yield "".join(parts)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            # %s of the log, {name} of format
            yield re.sub(r"%[-\d.]*[sdrgf]|\{\w*\}", FIELD, node.value)


@functools.cache
def texts() -> list[tuple[list[str], set[str]]]:
    """The words of every text in the source, in order and as a set."""
    files = {file for package in PACKAGES for file in (ROOT / package).rglob("*.py")}
    files -= set(EXAMPLES.glob("*.py"))
    found = {text for file in files for text in constants(ast.parse(file.read_text("utf-8")))}
    # What the operating system says.
    found |= {os.strerror(number) for number in errno.errorcode}
    return [(words(text), set(words(text))) for text in sorted(found)]


def words(text: str) -> list[str]:
    """Without the punctuation between them; a figure with its unit in brackets is one."""
    text = re.sub(r"\(\d[^()]*\)", lambda match: match[0].replace(" ", "_"), text)
    return [word for part in text.split() if (word := part.strip(",:;()").rstrip(".") or part.strip(",:;()"))]


def may_be_put_in(word: str) -> bool:
    """Whether a word is a figure, a path or in quotes, and so no word of the message itself."""
    return bool(re.search(r"\d|\.\.\.|^[\"']|/", word)) or word in {"or", "and"}


def is_in(quoted: list[str], text: list[str]) -> bool:
    """Whether words are some of those of a text, one after the other."""

    @functools.cache
    def goes_on(at: int, there: int) -> bool:
        if at == len(quoted) or there == len(text):
            return at == len(quoted)
        if quoted[at] == LEFT_OUT:
            return any(goes_on(at + 1, one) for one in range(there, len(text)))
        if FIELD not in text[there]:
            return quoted[at] == text[there] and goes_on(at + 1, there + 1)
        # Nothing, one name, perhaps with its article, or as many figures as there are.
        end = at + 1 + (quoted[at] == "the")
        if any(goes_on(one, there + 1) for one in {at, at + 1, min(end, len(quoted))}):
            return True
        while end < len(quoted) and may_be_put_in(quoted[end - 1]) and may_be_put_in(quoted[end]):
            end += 1
            if goes_on(end, there + 1):
                break
        else:
            return False
        return True

    return any(goes_on(0, begin) for begin in range(len(text)))


@functools.cache
def is_said(message: str) -> bool:
    """Whether the program says this: as one text, or put together from several."""
    message = LINK.sub("'link'", message)
    quoted = words(PLACE.sub("", message))
    own = {word for word in quoted if not may_be_put_in(word)}
    for text, its_words in texts():
        # Two words at least are its own: names alone fit anything.
        if len(own & its_words) < min(2, len(quoted)) or len(own - its_words) > 4:
            continue
        # The first word may be the name of a channel.
        if is_in(quoted, text) or (len(quoted) > 3 and is_in(quoted[1:], text)):
            return True
    cuts = re.finditer(r"[:;] | (?=\()", PLACE.sub("", message))
    halves = [(message[: cut.start()], message[cut.end() :]) for cut in cuts]
    return any(all(map(is_said, pair)) for pair in halves if all(pair))


def in_tables(page: Path) -> Iterator[str]:
    """What the first column of the tables of messages quotes."""
    inside = False
    for line in page.read_text("utf-8").splitlines():
        first = line.split("|")[1].strip() if line.startswith("|") and line.count("|") > 1 else None
        inside = first is not None and (inside or first in HEADS)
        if inside and first is not None:
            yield from (quoted for quoted in re.findall("`([^`]+)`", first) if " " in quoted)


QUOTED = [
    pytest.param(message, id=f"{page.relative_to(ROOT)} {message}")
    for page in PAGES
    if page.parent not in ELSEWHERE
    for message in in_tables(page)
]
WITH_CODE = [
    pytest.param(match[1], match[2], id=f"{page.relative_to(ROOT)} {match[0]}")
    for page in PAGES
    if page.parent not in ELSEWHERE
    for match in ENDS_WITH_A_CODE.finditer(page.read_text("utf-8"))
    if "  "
    not in match[1]  # else a row of daqsvc alarms, which holds what an alarm found and no text of its own
]


@pytest.mark.parametrize("message", QUOTED)
def test_a_table_of_messages_quotes_what_the_program_says(message: str) -> None:
    assert is_said(message)
    if must := re.search("must be .*", message):
        assert f"{must[0]}. Remedy" in (GOLDEN / "broken-tables.txt").read_text("utf-8")


@pytest.mark.parametrize(("message", "code"), WITH_CODE)
def test_a_message_with_a_code_is_one_of_the_program(message: str, code: str) -> None:
    assert code in CODES
    if of_check := OF_CHECK.match(message):
        said = (GOLDEN / "broken-tables.txt").read_text("utf-8")
        assert re.search(rf"{re.escape(of_check[1])} = .*: {re.escape(of_check[2])} \[{code}\]\n", said)
    else:
        assert is_had(code, message) or is_said(message)


@pytest.mark.parametrize(
    "message",
    [
        "the controller has gone bus-off",
        "has 64 bytes: only CAN FD can carry more than 8",
        "the bus is out of order",
        "alarm: its frames 0x101 have 48 bytes, the file 64",
    ],
)
def test_what_the_program_does_not_say_is_found(message: str) -> None:
    assert not is_said(message)
