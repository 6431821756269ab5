"""The codes of the lines of the log while a test runs: which it has given, and which lines have none."""

from __future__ import annotations

import ast
import contextlib
import logging
from typing import TYPE_CHECKING

from support.paths import ROOT

if TYPE_CHECKING:
    from collections.abc import Iterator


OURS = ("daqsvc", "drivers")
"""The packages whose lines have codes, by the names of their loggers."""


class Codes(logging.Handler):
    """Looks at the lines of the log.

    Attributes:
        given: the codes that lines have had.
        lacking: the lines from WARNING on that have had none.
    """

    def __init__(self) -> None:
        super().__init__()
        self.given: set[str] = set()
        self.lacking: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler.emit`."""
        if (code := record.__dict__.get("code")) is not None:
            self.given.add(f"{code}")
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


def codes_of_marks() -> set[str]:
    """Those that tests are marked with, e.g. ``@pytest.mark.gives("B29")``."""
    return {
        ast.literal_eval(argument)
        for file in (ROOT / "tests").rglob("test_*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "pytest.mark.gives"
        for argument in node.args
    }
