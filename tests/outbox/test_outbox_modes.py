"""Who may read the files of a store, whatever the umask and however they were left before."""

from __future__ import annotations

import contextlib
import os
import stat

import pytest

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.audit import AuditLog
from daqsvc.outbox.limits import OutboxLimits
from daqsvc.outbox.store import Outbox

pytestmark = pytest.mark.integration
TOPIC = "daqsvc/lab/edge-1/rig/alarms/rotor-fault"


def modes(directory):
    found = {}
    for path in directory.iterdir():
        with contextlib.suppress(FileNotFoundError):  # a journal of SQLite's comes and goes
            found[path.name] = stat.S_IMODE(path.stat().st_mode)
    return found


@pytest.fixture(params=[0o000, 0o022, 0o077], ids=oct)
def umask(request):
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


async def use(path):
    """A store with alarms and telemetry; the modes of its files while it runs."""
    outbox = Outbox(path, SystemClock(), OutboxLimits(reserve_bytes=0))
    await outbox.open()
    await outbox.append(TOPIC, lambda _: b"{}", retain=True)
    outbox.telemetry("daqsvc/lab/edge-1/status", b"{}", expiry_s=60.0)
    await outbox.append(TOPIC, lambda _: b"{}", retain=True)
    outbox.command_ids.remember("rig", "a", until_ns=10**18, now_ns=0)
    await AuditLog(path.parent / "audit.jsonl", SystemClock()).asked(
        AlarmCommand(verb=Verb.ACKNOWLEDGE, alarm="rotor-fault", by="jk"), "test"
    )
    found = modes(path.parent)
    await outbox.close()
    return found


async def test_nobody_else_reads_a_file_of_the_store(tmp_path, umask):
    found = await use(tmp_path / "outbox.sqlite")
    assert {
        "outbox.sqlite",
        "outbox.sqlite-wal",
        "outbox.sqlite.sequence",
        "audit.jsonl",
        "command-ids",
    } <= set(found)
    assert set(found.values()) == {0o600}


async def test_files_that_an_earlier_version_left_open_are_closed_to_others(tmp_path):
    await use(tmp_path / "outbox.sqlite")
    (tmp_path / "audit-000001.jsonl").write_text("")
    (tmp_path / "mqtt-version.json").write_text("{}")
    for path in tmp_path.iterdir():
        path.chmod(0o644)
    assert set((await use(tmp_path / "outbox.sqlite")).values()) == {0o640}


async def test_what_somebody_has_closed_further_stays_closed(tmp_path):
    await use(tmp_path / "outbox.sqlite")
    (tmp_path / "outbox.sqlite").chmod(0o600)
    assert (await use(tmp_path / "outbox.sqlite"))["outbox.sqlite"] == 0o600
