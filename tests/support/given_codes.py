"""The codes of the lines of the log while a test runs: which it has given, and which lines have none."""

from __future__ import annotations

import ast
import contextlib
import functools
import logging
import os
import re
from typing import TYPE_CHECKING

from support.paths import ROOT

if TYPE_CHECKING:
    from collections.abc import Iterator


MESSAGES = ROOT / "tests" / "errors" / "messages.txt"
"""Messages that tests have had from the program, each behind its code."""
TAKE = os.environ.get("DAQSVC_TAKE_MESSAGES") == "1"
"""Whether those of the tests that run now are kept there, in place of being compared. One process only."""
OURS = ("daqsvc", "drivers")
"""The packages whose lines have codes, by the names of their loggers."""


class Codes(logging.Handler):
    """Looks at the lines of the log.

    Attributes:
        given: the codes that lines have had, each with their messages.
        lacking: the lines from WARNING on that have had none.
    """

    def __init__(self) -> None:
        super().__init__()
        self.given: dict[str, set[str]] = {}
        self.lacking: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler.emit`."""
        if (code := record.__dict__.get("code")) is not None:
            message = " ".join(record.getMessage().removesuffix(f" [{code}]").split())
            self.given.setdefault(f"{code}", set()).add(message)
        elif record.levelno >= logging.WARNING and record.name.partition(".")[0] in OURS:
            self.lacking.append(f"{record.levelname} {record.getMessage()}")


@contextlib.contextmanager
def codes_logged() -> Iterator[Codes]:
    """Those of this process, from now on."""
    listening = Codes()
    logging.getLogger().addHandler(listening)
    try:
        yield listening
    finally:
        logging.getLogger().removeHandler(listening)


@functools.cache
def codes_of_marks() -> frozenset[str]:
    """Those that tests are marked with, e.g. ``@pytest.mark.gives("B29")``."""
    # Most files have none, and are not parsed: each process of a run needs these codes to know its tests.
    texts = (file.read_text(encoding="utf-8") for file in (ROOT / "tests").rglob("test_*.py"))
    return frozenset(
        ast.literal_eval(argument)
        for text in texts
        if "pytest.mark.gives" in text
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "pytest.mark.gives"
        for argument in node.args
    )


def shape(message: str) -> str:
    """A message without what depends on the hour, the computer and the machine file: figures and files."""
    message = re.sub(r"(?<!\w)'[^']*'|\"[^\"]*\"", "#", message)
    words = [re.sub(r"\S*[\d/#]\S*?(?=[,;:.()]*(?:\s|$))", "#", word) for word in message.split()]
    return re.sub(r"\b[\w-]+\.(?:toml|csv|npz|wav|mcap|blf)\b", "#", " ".join(words))


@functools.cache
def messages() -> dict[str, list[str]]:
    """The messages of `MESSAGES`, by their codes."""
    found: dict[str, list[str]] = {}
    for line in MESSAGES.read_text("utf-8").splitlines():
        code, _, message = line.partition(" ")
        found.setdefault(code, []).append(message)
    return found


def unknown(code: str, given: set[str]) -> bool:
    """Whether none of the messages that a test has had is in `MESSAGES`; with `TAKE` one is put there."""
    known = {shape(message) for message in messages().get(code, ())}
    if known & {shape(message) for message in given}:
        return False
    if TAKE:
        lines = {*MESSAGES.read_text("utf-8").splitlines(), f"{code} {min(given)}"}
        MESSAGES.write_text("".join(f"{line}\n" for line in sorted(lines)), "utf-8")
        messages.cache_clear()
    return not TAKE


def in_one_line(message: str) -> str:
    """A message as it is in `MESSAGES`: without line breaks, and without the folder of a file."""
    return re.sub(r"(?<!\S)/\S*/(?=[\w.-]+)", "", " ".join(message.split()))


def had(code: str, said: object) -> None:
    """Make sure that a message with this code is one that tests have had before.

    Args:
        code: of the message.
        said: the message without the code, or lines of which one ends with it.

    Raises:
        AssertionError: no test has had it, or no line has the code.
    """
    text = re.sub(r"\n    (?! )", " ", f"{said}")  # warnings go on below themselves
    given = re.findall(rf"^(?:  )?(.*) \[{code}\]$", text.rstrip(), re.MULTILINE)
    if not given and not re.search(r"\[[A-Z]\d\d\]$", text.strip(), re.MULTILINE):
        given = [text]
    assert given, f"no line has {code}: {text}"
    assert not unknown(code, {in_one_line(one) for one in given}), (
        f"the message of {code} is another than in tests/errors/messages.txt: correct it there "
        "(DAQSVC_TAKE_MESSAGES=1 adds it)"
    )


def is_had(code: str, example: str) -> bool:
    """Whether a test has had this message, or one that begins so, from the program; one name may differ."""
    words = shape(example).split()
    return any(
        len(had) >= len(words) and sum(one != other for one, other in zip(words, had, strict=False)) <= 1
        for had in (shape(message).split() for message in messages().get(code, ()))
    )
