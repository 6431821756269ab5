"""The audit log: on disk before anything is done, never changed, and whole lines only."""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path
from typing import Any

import pytest
from support.formats import fits

from daqsvc import audit
from daqsvc.acquisition.clock import NS_PER_S, DrivenClock
from daqsvc.alarms.commands import AlarmCommand, CommandOutcome, Verb
from daqsvc.audit import (
    REFUSED_EVERY_NS,
    REFUSED_IN_FULL,
    SOURCES,
    AuditError,
    AuditLog,
    Refusals,
    older_parts,
)

SHELVE = AlarmCommand(
    verb=Verb.SHELVE, alarm="rotor-fault", by="Ann Ö.", duration_s=1800.0, reason="spare probe\u2028on order"
)
REFUSED = CommandOutcome(accepted=False, reason="it is normal")


def audit_log(tmp_path: Path) -> AuditLog:
    return AuditLog(tmp_path / "audit.jsonl", DrivenClock(NS_PER_S, 1_795_264_095_376_165_000))


def lines(log: AuditLog) -> list[dict[str, Any]]:
    return [fits("daqsvc.audit/1", json.loads(line)) for line in log.path.read_bytes().split(b"\n") if line]


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


async def test_a_symlink_that_somebody_has_laid_is_not_followed(tmp_path: Path) -> None:
    log = audit_log(tmp_path)
    log.path.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(AuditError, match=r"audit\.jsonl cannot be written"):
        await log.asked(SHELVE, "test")
    assert not (tmp_path / "elsewhere").exists()


# The quota.

QUOTA = 32 * 1024


def numbered(number: int) -> AlarmCommand:
    return AlarmCommand(verb=Verb.ACKNOWLEDGE, alarm="a", by="b", reason=f"{number}")


def kept(log: AuditLog) -> list[int]:
    """Numbers of the commands in all parts, the oldest first."""
    parts = older_parts(log.path)
    files = [*(parts[number] for number in sorted(parts)), log.path]
    text = "".join(one.read_text() for one in files if one.exists())
    return [int(json.loads(line)["reason"]) for line in text.splitlines()]


def size(log: AuditLog) -> int:
    files = [log.path, *older_parts(log.path).values()]
    return sum(one.stat().st_size for one in files if one.exists())


def small_log(tmp_path: Path) -> AuditLog:
    return AuditLog(tmp_path / "audit.jsonl", DrivenClock(), QUOTA)


async def test_the_log_stays_within_its_quota_and_loses_the_oldest_first(tmp_path: Path) -> None:
    foreign = tmp_path / "audit.jsonl.1"
    foreign.write_text("of logrotate")
    log = small_log(tmp_path)
    for number in range(400):
        await log.asked(numbered(number), "test")
        assert size(log) <= QUOTA
    numbers = kept(log)
    assert numbers == list(range(numbers[0], 400))
    assert 0 < numbers[0] < 400 - len(numbers) + 1
    assert len(numbers) * 350 > QUOTA / 2, "little of the quota is of use"
    assert foreign.read_text() == "of logrotate"
    assert {stat.S_IMODE(one.stat().st_mode) for one in older_parts(log.path).values()} == {0o600}


async def test_a_log_that_was_never_parted_does_not_vanish_at_once(tmp_path: Path) -> None:
    log = small_log(tmp_path)
    long = AuditLog(log.path, DrivenClock())
    for number in range(200):
        await long.asked(numbered(number), "test")
    assert log.path.stat().st_size > QUOTA
    await log.asked(numbered(200), "test")
    assert kept(log) == list(range(201))


class Killed(BaseException):
    """The process ends here."""


@pytest.mark.parametrize("step", ["before the rename", "after the rename", "before an old part is deleted"])
async def test_whatever_interrupts_the_parting_loses_no_line(
    step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = small_log(tmp_path)
    rename, unlink = Path.rename, Path.unlink
    steps = iter(range(10_000))

    def perhaps(now: str) -> None:
        if now == step and next(steps) % 3 == 0:
            raise Killed

    def renaming(path: Path, target: Path) -> Path:
        perhaps("before the rename")
        done = rename(path, target)
        perhaps("after the rename")
        return done

    def unlinking(path: Path) -> None:
        perhaps("before an old part is deleted")
        unlink(path)

    monkeypatch.setattr(Path, "rename", renaming)
    monkeypatch.setattr(Path, "unlink", unlinking)
    written, kills, number = [], 0, 0
    while len(written) < 400:
        try:
            audit._write(log.path, json.dumps({"reason": f"{number}", "": "x" * 300}).encode() + b"\n", QUOTA)
            written.append(number)
        except Killed:
            kills += 1
        number += 1
        assert kept(log) == written[-len(kept(log)) :]
    assert kills > 3
    assert size(log) <= QUOTA


# Floods of refused commands.


def test_refused_commands_are_written_until_they_are_a_flood() -> None:
    clock = DrivenClock()
    refusals = Refusals(clock)
    for _ in range(REFUSED_IN_FULL):
        assert not refusals.flooding
        refusals.written()
    assert refusals.flooding
    clock.advance_to(clock.monotonic_ns() + REFUSED_EVERY_NS - 1)
    assert refusals.flooding
    clock.advance_to(clock.monotonic_ns() + 1)
    assert not refusals.flooding
    refusals.written()
    assert refusals.flooding
    clock.advance_to(clock.monotonic_ns() + 1000 * REFUSED_IN_FULL * REFUSED_EVERY_NS)
    for _ in range(REFUSED_IN_FULL):
        assert not refusals.flooding
        refusals.written()
    assert refusals.flooding


async def test_what_was_counted_is_one_line_and_waits_for_a_disk_that_takes_it(tmp_path: Path) -> None:
    log = audit_log(tmp_path)
    refusals = Refusals(DrivenClock(NS_PER_S, 1_795_264_095_376_165_000))
    await log.refused(refusals)
    assert not log.path.exists(), "nothing was refused"
    for number in range(SOURCES + 3):
        refusals.count(SHELVE, f"local uid 1000 pid {number}", "it is normal")
    log.path.mkdir()
    with pytest.raises(AuditError):
        await log.refused(refusals)
    refusals.count(numbered(1), "local uid 1000 pid 0", "it is over")
    log.path.rmdir()
    await log.refused(refusals)
    await log.refused(refusals)
    (line,) = lines(log)
    assert line["outcome"] == "refused_many"
    assert line["count"] == SOURCES + 4
    pids = {f"local uid 1000 pid {number}": 1 + (number == 0) for number in range(SOURCES)}
    assert line["sources"] == pids | {"others": 3}
    assert line["verbs"] == {"shelve": SOURCES + 3, "acknowledge": 1}
    assert (line["since"], line["answer"]) == ("2026-11-21T12:28:15.376165Z", "it is over")
