"""The audit log: on disk before anything is done, never changed, and whole lines only."""

from __future__ import annotations

import json
import os
import stat
from typing import TYPE_CHECKING, Any

import pytest

from daqsvc.acquisition.clock import NS_PER_S, DrivenClock
from daqsvc.alarms.commands import AlarmCommand, CommandOutcome, Verb
from daqsvc.audit import AuditError, AuditLog

if TYPE_CHECKING:
    from pathlib import Path

SHELVE = AlarmCommand(
    verb=Verb.SHELVE, alarm="rotor-fault", by="Ann Ö.", duration_s=1800.0, reason="spare probe\u2028on order"
)
REFUSED = CommandOutcome(accepted=False, reason="it is normal")


def audit_log(tmp_path: Path) -> AuditLog:
    return AuditLog(tmp_path / "audit.jsonl", DrivenClock(NS_PER_S, 1_795_264_095_376_165_000))


def lines(log: AuditLog) -> list[dict[str, Any]]:
    return [json.loads(line) for line in log.path.read_bytes().split(b"\n") if line]


async def test_a_command_leaves_two_lines_that_say_all_of_it(tmp_path: Path) -> None:
    log = audit_log(tmp_path)
    entry = await log.asked(SHELVE, "local uid 1000 pid 7")
    assert [line["outcome"] for line in lines(log)] == ["asked"], "on disk before anything is done"
    await log.answered(entry, SHELVE, "local uid 1000 pid 7", REFUSED)
    asked, answered = lines(log)
    assert answered == asked | {"outcome": "refused", "answer": "it is normal", "events": []}
    assert asked == {
        "schema": "daqsvc.audit/1",
        "id": entry,
        "time": "2026-11-21T12:28:15.376165Z",
        "wall_ns": 1_795_264_095_376_165_000,
        "monotonic_ns": NS_PER_S,
        "outcome": "asked",
        "source": "local uid 1000 pid 7",
        "by": "Ann Ö.",
        "verb": "shelve",
        "alarm": "rotor-fault",
        "occurrence": None,
        "duration_s": 1800.0,
        "reason": "spare probe\u2028on order",
    }


async def test_what_was_written_stays_as_it_is(tmp_path: Path) -> None:
    log = audit_log(tmp_path)
    log.path.write_bytes(b"")
    before = b""
    for verb in Verb:
        await log.asked(AlarmCommand(verb=verb, alarm="a", by="b"), "test")
        after = log.path.read_bytes()
        assert after.startswith(before)
        assert len(after.splitlines()) == len(before.splitlines()) + 1
        before = after


async def test_half_a_line_that_a_power_cut_left_spoils_no_other(tmp_path: Path) -> None:
    log = audit_log(tmp_path)
    log.path.write_bytes(b'{"schema": "daqsvc.au')
    await log.asked(SHELVE, "test")
    torn, whole, end = log.path.read_bytes().split(b"\n")
    assert (torn, end) == (b'{"schema": "daqsvc.au', b"")
    assert json.loads(whole)["alarm"] == "rotor-fault"


async def test_a_log_that_was_renamed_is_begun_anew(tmp_path: Path) -> None:
    log = audit_log(tmp_path)
    await log.asked(SHELVE, "test")
    log.path.rename(tmp_path / "audit.jsonl.1")
    await log.asked(SHELVE, "test")
    assert len(lines(log)) == 1
    assert not stat.S_IMODE(log.path.stat().st_mode) & (stat.S_IWGRP | stat.S_IRWXO)


@pytest.mark.parametrize("broken", ["no directory", "a directory in its place", "full disk"])
async def test_a_log_that_cannot_be_written_says_which_and_why(
    broken: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = audit_log(tmp_path / "store" if broken == "no directory" else tmp_path)
    if broken == "a directory in its place":
        log.path.mkdir()
    elif broken == "full disk":
        monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError(28, os.strerror(28))))
    with pytest.raises(AuditError, match=r"audit\.jsonl cannot be written: .*make room"):
        await log.asked(SHELVE, "test")
