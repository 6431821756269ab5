"""What many of these tests need: verbs of the command line run in this process, a store, a broker."""

from __future__ import annotations

import json
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest
from support.brokers import running_mosquitto
from support.formats import fits
from support.sim_processes import BAD_LINK

from daqsvc.acquisition.clock import SystemClock
from daqsvc.cli import main
from daqsvc.outbox.store import Outbox

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator
    from pathlib import Path

    from support.brokers import Mosquitto

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
        told = [json.loads(line, parse_constant=pytest.fail) for line in out.splitlines()]
        return code, [fits(one.get("schema", f"daqsvc {arguments[0]}"), one) for one in told], err

    return run


@pytest.fixture
def analyze(verb: Run) -> Run:
    """Runs ``daqsvc analyze``; see `verb`."""
    return partial(verb, "analyze")


@pytest.fixture
async def outbox(tmp_path: Path) -> AsyncIterator[Outbox]:
    """An empty journal, open."""
    outbox = Outbox(tmp_path / "outbox.sqlite", SystemClock())
    await outbox.open()
    yield outbox
    await outbox.close()


@pytest.fixture
def mosquitto(tmp_path: Path) -> Iterator[Mosquitto]:
    """A broker that has just been started."""
    with running_mosquitto(tmp_path) as broker:
        yield broker


@pytest.fixture
def bad_link(tmp_path: Path) -> Path:
    """A scenario for ``daqsvc sim`` in which a lot goes wrong with the link."""
    path = tmp_path / "bad-link.toml"
    path.write_text(BAD_LINK, encoding="utf-8")
    return path


@pytest.fixture
def bus_path(tmp_path: Path) -> str:
    """Where a virtual CAN bus may be."""
    return str(tmp_path / "can0")
