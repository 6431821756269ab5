"""JSON of a service that runs, and of verbs that ask it, is as the published schemas promise, key by key."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

import pytest
from support.formats import fits
from support.recorded_rig import let_time_pass, play, recorded_rig, recording
from support.waiting import PATIENCE_S

from daqsvc.cli import main
from daqsvc.control import SOCKET
from daqsvc.snapshots.contents import (
    ABOUT,
    ALARMS,
    CAUSES,
    DIAGNOSES,
    STANDING,
    STATES,
    WINDOWS,
    Entry,
    Noted,
)
from daqsvc.snapshots.mcap import Damage
from daqsvc.snapshots.reading import entries_of

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.integration
CONTROL = '{"schema": "daqsvc.control/1", "verb": '
ANSWERED = {
    '"status"}': "daqsvc.service-status/1",
    '"standing"}': "daqsvc.control-answer/1",
    '"status", "machine": "none"}': "daqsvc.control-answer/1",
    '"reload", "dry_run": true}': "daqsvc.control-answer/1",
    '"reset", "alarm": "rotor-fault", "by": "Ada"}': "daqsvc.control-answer/1",
    '"shelve", "alarm": "none", "by": "Ada", "duration_s": 60, "reason": "r"}': "daqsvc.control-answer/1",
    '"live"}': "daqsvc.live/1",
}
"""What is asked of the control socket, and the format of the answer."""


async def told(store: Path, line: str) -> dict[str, Any]:
    """The first line that the control socket answers with."""
    reader, writer = await asyncio.open_unix_connection(store / SOCKET, limit=2**24)
    try:
        writer.write(line.encode() + b"\n")
        async with asyncio.timeout(PATIENCE_S):
            answer: dict[str, Any] = json.loads(await reader.readline())
        return answer
    finally:
        writer.close()


def printed(capsys: pytest.CaptureFixture[str], *arguments: object) -> list[dict[str, Any]]:
    """The lines of JSON that a verb prints."""
    main([*map(str, arguments), "--json"])
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


@pytest.mark.long
async def test_all_that_is_told_on_the_box_is_as_the_schemas_promise(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    machine, samples = recorded_rig("formats", before_s=3.0, after_s=1.0)
    store = tmp_path / "store"
    async with recording(machine, store) as (service, clock):
        await play(service, clock, samples)
        for asked, name in ANSWERED.items():
            fits("daqsvc.control/1", json.loads(CONTROL + asked))
            fits(name, await told(store, CONTROL + asked))
        verbs = [
            ("daqsvc reload", ["reload", "--dry-run"]),
            ("daqsvc.alarm/1", ["alarms", "--all"]),
            ("daqsvc.service-status/1", ["status"]),
            ("daqsvc ack", ["shelve", "rotor-fault", "--for", "1h"]),
            ("daqsvc ack", ["ack", "none-of-this-name"]),
        ]
        for name, words in verbs:
            lines = await asyncio.to_thread(printed, capsys, *words, "--store", store)
            assert lines or "none-of-this-name" in words, words
            for line in lines:
                fits(name, line)
        taking = asyncio.create_task(asyncio.to_thread(printed, capsys, "snapshot", "--store", store))
        while not taking.done():
            await let_time_pass(service, clock, 0.5)
        [snapshot] = await taking
        assert fits("daqsvc snapshot", snapshot)["accepted"]
        audit = (store / "audit.jsonl").read_text().splitlines()
    assert {fits("daqsvc.audit/1", json.loads(line))["outcome"] for line in audit} >= {"asked", "accepted"}
    topics = set()
    for file in store.rglob("*.mcap"):
        for one in entries_of(memoryview(file.read_bytes()), Damage()):
            if isinstance(one, Entry) and isinstance(one.what, Noted):
                topics.add(one.what.topic)
                document = one.what.document
                if one.what.topic == ALARMS:
                    fits("daqsvc.alarm/1", document)
                elif one.what.topic != DIAGNOSES:
                    fits("daqsvc.snapshot/1", document)
    assert topics >= {ABOUT, WINDOWS, DIAGNOSES, ALARMS}
    assert topics <= {ABOUT, WINDOWS, DIAGNOSES, STATES, STANDING, CAUSES, ALARMS}
    [replayed] = await asyncio.to_thread(printed, capsys, "replay", snapshot["path"])
    assert fits("daqsvc replay", replayed)["is_compared"]
    words = ("export", snapshot["path"], "--to", tmp_path / "snapshot.wav")
    [exported] = await asyncio.to_thread(printed, capsys, *words)
    assert fits("daqsvc.export/1", exported)["files"]
