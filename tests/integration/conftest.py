"""Verbs of the command line, run in this process."""

from __future__ import annotations

import json
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest

from daqsvc.cli import main

if TYPE_CHECKING:
    from collections.abc import Callable

    Run = Callable[..., tuple[int, list[dict[str, Any]], str]]


@pytest.fixture
def verb(capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a verb with ``--json``: exit code, objects, what went to stderr."""

    def run(*arguments: object) -> tuple[int, list[dict[str, Any]], str]:
        try:
            code = main([*map(str, arguments), "--json"])
        except SystemExit as stopped:
            code = int(stopped.code or 0)
        out, err = capsys.readouterr()
        return code, [json.loads(line, parse_constant=pytest.fail) for line in out.splitlines()], err

    return run


@pytest.fixture
def analyze(verb: Run) -> Run:
    """Runs ``daqsvc analyze``; see `verb`."""
    return partial(verb, "analyze")
