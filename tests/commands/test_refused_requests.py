"""What the service refuses ends with its code, and has it in JSON, whichever verb has asked."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
from typing import TYPE_CHECKING

import pytest

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.commands import AlarmCommand, CommandOutcome
from daqsvc.cli import main
from daqsvc.control import ControlServer, ReloadRefusedError, ReloadTooLateError, SnapshotNotMadeError
from daqsvc.errors.service import SNAPSHOT_LOST
from daqsvc.outbox.store import Outbox

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

PROBLEM = "rig.toml:3: box: the service runs with it. Remedy: restart the service [S01]"


class Refusing:
    """A service that refuses everything."""

    def __init__(self) -> None:
        self.error = ReloadRefusedError([PROBLEM, "it is odd"])

    async def execute(self, command: AlarmCommand, source: str) -> CommandOutcome:
        del source
        return CommandOutcome(accepted=False, reason=f"no alarm is named {command.alarm!r}", code="C05")

    async def status(self, machine: str | None) -> tuple[str, ...]:
        del machine
        return ("rig", "pump")

    async def reload(self, *, dry_run: bool = False) -> list[str]:
        del dry_run
        raise self.error

    async def snapshot(self, machine: str | None, reason: str) -> str:
        del machine, reason
        raise SnapshotNotMadeError("the snapshot is lost: No space left on device", SNAPSHOT_LOST)


@contextlib.asynccontextmanager
async def refusing(store: Path, service: Refusing) -> AsyncIterator[None]:
    outbox = Outbox(store / "outbox.sqlite", SystemClock())
    await outbox.open()
    server = ControlServer(
        store,
        ("rig", "pump"),
        service.execute,
        status=service.status,
        reload=service.reload,
        snapshot=service.snapshot,
    )
    await server.open()
    try:
        yield
    finally:
        await server.close()
        await outbox.close(5.0)


VERBS = [
    ("C05", ["ack", "hot"]),
    ("C05", ["reset", "hot"]),
    ("C05", ["shelve", "hot", "--for", "1h"]),
    ("C05", ["unshelve", "hot"]),
    ("C05", ["bypass", "hot"]),
    ("C05", ["unbypass", "hot"]),
    ("S15", ["snapshot"]),
    ("S16", ["reload"]),
    ("C04", ["status", "--machine", "fan"]),
]


@pytest.mark.parametrize(("code", "words"), VERBS, ids=[words[0] for _, words in VERBS])
async def test_what_is_refused_ends_with_its_code(
    code: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    async with refusing(tmp_path, Refusing()):
        assert await asyncio.to_thread(main, [*words, "--store", f"{tmp_path}"]) != 0
    out, err = capsys.readouterr()
    assert out == ""
    assert err.endswith(f" [{code}]\n")


@pytest.mark.parametrize(("code", "words"), VERBS[:-1], ids=[words[0] for _, words in VERBS[:-1]])
async def test_the_code_of_what_is_refused_is_in_json(
    code: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    async with refusing(tmp_path, Refusing()):
        assert await asyncio.to_thread(main, [*words, "--json", "--store", f"{tmp_path}"]) != 0
    told = json.loads(capsys.readouterr().out)
    assert (told["accepted"], told["code"]) == (False, code)


async def test_each_reason_why_a_reload_is_refused_has_one_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    async with refusing(tmp_path, Refusing()):
        assert await asyncio.to_thread(main, ["reload", "--store", f"{tmp_path}"]) == 2
    assert capsys.readouterr().err.splitlines() == [PROBLEM, "it is odd [S16]"]


async def test_a_reload_that_comes_too_late_has_a_code_of_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    service = Refusing()
    service.error = ReloadTooLateError()
    async with refusing(tmp_path, service):
        assert await asyncio.to_thread(main, ["reload", "--json", "--store", f"{tmp_path}"]) == 2
    told = json.loads(capsys.readouterr().out)
    assert (told["code"], told["lines"]) == ("C07", ["the service ends [C07]"])


async def test_a_question_about_no_machine_of_several_is_answered_with_a_code(tmp_path: Path) -> None:
    async with refusing(tmp_path, Refusing()):
        reader, writer = await asyncio.open_unix_connection(tmp_path / "control.sock")
        for machine in ("", ', "machine": "fan"'):
            writer.write(f'{{"schema": "daqsvc.control/1", "verb": "status"{machine}}}\n'.encode())
            assert re.search(rb'"code": "C04"', await reader.readline())
        writer.close()
