"""A service leaves snapshots of its machine, and what they hold is judged again to the last bit."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.recorded_rig import RATE_HZ, let_time_pass, play, recorded_rig, recorder_of, recording
from support.waiting import PATIENCE_S

from daqsvc.acquisition.samples import SampleBlock
from daqsvc.alarms.states import Level
from daqsvc.confined.limits import ResourceLimits
from daqsvc.offline.replay import replay
from daqsvc.snapshots.contents import ALARMS, DIAGNOSES, MACHINE_JSON, MACHINE_TOML, Noted
from daqsvc.snapshots.reading import read_snapshot

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.offline.replay import Comparison, Replayed
    from daqsvc.service import Service
    from daqsvc.snapshots.contents import Document, Entry, Snapshot

pytestmark = pytest.mark.integration
RATE_ROWS = round(RATE_HZ) // 3 * 3


def snapshots(service: Service) -> list[Path]:
    return sorted(recorder_of(service).folder.directory.glob("*.mcap"))


def is_statement(what: object, statement: Document) -> bool:
    """Whether an entry is that statement of a detector."""
    if getattr(what, "topic", "") != DIAGNOSES:
        return False
    document = getattr(what, "document", {})
    return all(document[key] == statement[key] for key in ("detector", "decision", "monotonic_ns"))


def in_short(comparison: Comparison) -> list[list[tuple[object, ...]]]:
    """What differs: said then only, and now only."""
    keys = ("alarm", "detector", "kind", "decision", "state", "monotonic_ns", "message", "quality")
    return [
        [tuple(one.get(key) for key in keys) for one in differs]
        for differs in (comparison.changed, comparison.added)
    ]


def what_differs(comparison: Comparison) -> list[tuple[object, ...]]:
    """By alarm event, the fields that are others now than then."""
    now = {(one["alarm"], one["monotonic_ns"], one["kind"]): one for one in comparison.added}
    differs: list[tuple[object, ...]] = []
    for one in comparison.changed:
        event = one["alarm"], one["monotonic_ns"], one["kind"]
        told = now.pop(event, {})
        differs += [(event, key, one[key], told.get(key)) for key in one if one[key] != told.get(key)]
    return differs + list(now)


def of_alarms(snapshot: Snapshot) -> list[Document]:
    """The alarm events in it."""
    noted = [entry.what for entry in snapshot.entries if isinstance(entry.what, Noted)]
    return [one.document for one in noted if one.topic == ALARMS]


def by_another(entry: Entry) -> Entry:
    """The same, said by a detector of another name if the rotor bank has said it."""
    if not isinstance(entry.what, Noted):
        return entry
    document = dict(entry.what.document)
    if entry.what.topic == ALARMS and document["cause"]["detector"] == "rotor-bank":
        document["cause"] = {**document["cause"], "detector": "gone"}
    if entry.what.topic == DIAGNOSES and document["detector"] == "rotor-bank":
        document["detector"] = "gone"
    return replace(entry, what=Noted(entry.what.topic, document))


async def again(snapshot: Snapshot, folder: Path) -> Replayed:
    folder.mkdir()  # noqa: ASYNC240 - of this test alone
    return await replay(snapshot, None, folder)


async def test_an_alarm_leaves_a_snapshot_that_replays_to_the_same_alarm(tmp_path: Path) -> None:
    machine, samples = recorded_rig("snapshot-alarm", after_s=2.0)
    async with recording(machine, tmp_path / "store") as (service, clock):
        recorder = recorder_of(service)
        await play(service, clock, samples[: round(6.5 * RATE_HZ)])
        await let_time_pass(service, clock, 1.75)
        # It waits for detectors, which a busy computer keeps busy for longer.
        async with asyncio.timeout(PATIENCE_S):
            while not recorder.counters.snapshots:
                await let_time_pass(service, clock, 0.25)
        path, *_ = snapshots(service)
    assert path.name.endswith("-alarm.mcap")
    assert recorder.counters.snapshots_failed == recorder.counters.blocks_dropped == 0
    snapshot = read_snapshot(path, ResourceLimits())
    assert snapshot.notes == ()
    assert MACHINE_JSON in snapshot.files
    assert b"laval-rig" in snapshot.files[MACHINE_TOML]
    recorded = np.concatenate([e.what.samples for e in snapshot.entries if isinstance(e.what, SampleBlock)])
    scale = 0.0005 / 0.00787  # a count of the device, in um
    assert np.abs(recorded[:, :2] - samples[: len(recorded), :2]).max() < scale
    alarms = of_alarms(snapshot)
    assert next(one["kind"] for one in alarms if one["alarm"] == "rotor-fault") == "raised"

    replayed = await again(snapshot, tmp_path / "replay")
    assert not replayed.anew
    assert replayed.is_equal, (replayed.said.changed[:1], replayed.alarmed)
    assert replayed.said.equal > 20
    assert replayed.alarmed.equal == len(alarms) > 0
    assert not replayed.said.added
    assert not replayed.notes

    # An alarm that is raised now and was not then shows as such, wherever it is in the file.
    raised = next(one for one in alarms if one["kind"] == "raised")
    statement = {key: one for key, one in raised["cause"].items() if key not in {"schema", "site", "box"}}
    hidden = [
        entry
        for entry in snapshot.entries
        if getattr(entry.what, "document", None) is not raised and not is_statement(entry.what, statement)
    ]
    assert len(hidden) == len(snapshot.entries) - 2
    without = await again(replace(snapshot, entries=hidden), tmp_path / "without")
    assert not without.is_equal
    assert [one["decision"] for one in without.said.added] == [statement["decision"]]

    # A name is no physics: by a machine file that differs in nothing else it is the same.
    named = machine.machine.model_copy(update={"name": "other-rig"})
    (tmp_path / "named").mkdir()
    other = machine.model_copy(update={"box": "other-box", "machine": named})
    renamed = await replay(snapshot, other, tmp_path / "named")
    assert renamed.is_equal
    assert renamed.said.equal == replayed.said.equal
    assert renamed.notes == [
        "judged as demo/virtual/laval-rig, as it was then: the machine file is of demo/other-box/other-rig"
    ]

    # What detectors have said that the machine file does not have is named as such.
    gone = await again(replace(snapshot, entries=[*map(by_another, snapshot.entries)]), tmp_path / "gone")
    ours = [one for one in alarms if one["cause"]["detector"] == "rotor-bank"]
    events = f"not judged again: {len(ours)} (gone)"
    assert len([note for note in gone.notes if "the machine file does not have" in note]) == 2
    assert any(note.startswith("alarm events of detectors") and note.endswith(events) for note in gone.notes)

    # Limits that came into force within it are told.
    about = {**snapshot.about, "changed_ns": snapshot.about["begin_ns"] + 1}
    changed = await again(replace(snapshot, about=about), tmp_path / "changed")
    assert changed.notes[0].startswith("other limits came into force at 20")


@pytest.mark.long
async def test_alarms_of_a_device_that_comes_and_goes_are_the_same_again(tmp_path: Path) -> None:
    machine, samples = recorded_rig("snapshot-silence", before_s=3.0, after_s=0.5)
    async with recording(machine, tmp_path / "store") as (service, clock):
        await let_time_pass(service, clock, 8.0)  # nothing comes
        await play(service, clock, samples[: round(6.5 * RATE_HZ) // 3 * 3])
        await let_time_pass(service, clock, 6.0)
        files = snapshots(service)
    kinds = []
    for number, path in enumerate(files):
        snapshot = read_snapshot(path, ResourceLimits())
        alarms = of_alarms(snapshot)
        kinds += [(one["alarm"], one["kind"]) for one in alarms]
        replayed = await again(snapshot, tmp_path / f"replay {number}")
        assert replayed.is_equal, (path.name, in_short(replayed.said), what_differs(replayed.alarmed))
        assert replayed.alarmed.equal > 0
    assert {("sensor-ok/probe-x", "raised"), ("sensor-ok/probe-x", "returned")} <= {*kinds}
    assert ("rotor-fault", "raised") in kinds


async def test_what_the_service_says_of_itself_is_not_judged_again(tmp_path: Path) -> None:
    machine, samples = recorded_rig("snapshot-condition", after_s=2.0)
    async with recording(machine, tmp_path / "store") as (service, clock):
        asked = asyncio.create_task(recorder_of(service).snapshot("a test"))
        await let_time_pass(service, clock, 0.2)
        for level in (Level.ALERT, Level.NORMAL):
            for event in service.alarms.manager.condition("store/disk", level, "the disk is full"):
                recorder_of(service).alarm(event)
        await play(service, clock, samples[: RATE_ROWS * 2])
        await let_time_pass(service, clock, 3.0)
        path = await asked
    replayed = await again(read_snapshot(path, ResourceLimits()), tmp_path / "replay")
    assert replayed.is_equal, replayed.alarmed
    assert replayed.notes == ["alarm events of the service itself are not compared: 2"]


@pytest.mark.long
async def test_a_snapshot_from_amid_a_run_begins_with_what_detectors_remember(tmp_path: Path) -> None:
    machine, samples = recorded_rig("snapshot-amid", before_s=1.0, after_s=2.0)
    machine = machine.model_copy(update={"alarms": ()})
    async with recording(machine, tmp_path / "store") as (service, clock):

        async def ask() -> Path:
            await clock.sleep_ns(round(11e9))
            return await recorder_of(service).snapshot("a test")

        asked = asyncio.create_task(ask())
        await play(service, clock, samples)
        await let_time_pass(service, clock, 3.0)
        path = await asked
    assert path.name.endswith("-asked.mcap")
    snapshot = read_snapshot(path, ResourceLimits())
    assert not snapshot.about["from_start"]
    assert snapshot.about["causes"] == ["a test"]
    assert {name.partition("/")[0] for name in snapshot.about["remembered"]} == {"levels", "rotor-bank"}
    replayed = await again(snapshot, tmp_path / "replay")
    assert not replayed.anew
    assert not replayed.said.changed, replayed.said.changed[0]
    assert replayed.said.equal > 5
