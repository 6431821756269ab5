"""The codes that lines of the log have while a test runs: what the mark ``gives`` holds a test to."""

from __future__ import annotations

import ast
import contextlib
import logging
from typing import TYPE_CHECKING

from support.paths import ROOT

if TYPE_CHECKING:
    from collections.abc import Iterator


class _Listening(logging.Handler):
    def __init__(self) -> None:
        super().__init__()
        self.codes: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler.emit`."""
        if (code := record.__dict__.get("code")) is not None:
            self.codes.add(f"{code}")


@contextlib.contextmanager
def codes_logged() -> Iterator[set[str]]:
    """Those of this process, from now on."""
    listening = _Listening()
    logging.getLogger().addHandler(listening)
    try:
        yield listening.codes
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
