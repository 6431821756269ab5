"""Snapshots of a device that a DBC file describes: they are judged again anywhere, also without that file."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.formats import fits
from support.live_service import watch_of
from support.machine_files import TRIAXIAL, changed
from support.recorded_rig import let_time_pass, play, recorder_of, recording
from support.waiting import eventually

from daqsvc.confined.limits import ResourceLimits
from daqsvc.offline.replay import replay
from daqsvc.settings.load import parse_machine_file
from daqsvc.snapshots.contents import ALARMS, STATES, Noted
from daqsvc.snapshots.reading import read_snapshot

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.offline.replay import Replayed
    from daqsvc.settings import MachineFile
    from daqsvc.snapshots.contents import Snapshot

pytestmark = pytest.mark.integration
RATE_HZ = 100.0
DBC = "triaxial-accelerometer.dbc"
IN_EXAMPLE = f"../devices/{DBC}"
PLAYED_S = ((12.0, 2.5), (4.5, 2.3), (4.5, 2.6), (4.5, 2.4), (4.5, 7.0))
"""How long the device sends, and how long it is gone then: it is silent 2 to 2.5 s after its last sample."""


def machine_at(folder: Path, dbc: str, bus: str) -> MachineFile:
    """The machine file, as it lies in a folder."""
    text, _ = changed(
        TRIAXIAL,
        (f'"{IN_EXAMPLE}"', f'"{dbc}"'),
        ('interface = "socketcan"', 'interface = "virtual"'),
        ('channel = "can0"', f'channel = "{bus}"'),
        ("rate_hz = 1000.0", f"rate_hz = {RATE_HZ}"),
        ("[10.0, 400.0]", "[10.0, 40.0]"),
        ("window_s = 1.0", "window_s = 0.25"),
        ("[pipeline]", "[recorder]\nbefore_s = 2.7\nafter_s = 2.0\nreserve_mb = 0\n\n[pipeline]"),
    )
    machine = parse_machine_file(text, folder / "fan.toml")
    return machine.model_copy(update={"mqtt": None})


async def judged(snapshot: Snapshot, machine: MachineFile | None, folder: Path) -> Replayed:
    folder.mkdir()  # noqa: ASYNC240 - of this test alone
    return await replay(snapshot, machine, folder)


async def test_a_device_that_comes_and_goes_is_judged_again_where_its_dbc_is_not(tmp_path: Path) -> None:
    there, elsewhere = tmp_path / "there", tmp_path / "elsewhere"
    for folder in (there / "devices", elsewhere):
        folder.mkdir(parents=True)
        shutil.copy(TRIAXIAL.parent / IN_EXAMPLE, folder)
    machine = machine_at(there, f"devices/{DBC}", "snapshot-dbc")
    rng = np.random.default_rng(7)
    index = 0
    async with recording(machine, tmp_path / "store") as (service, clock):
        pipeline = watch_of(service).pipeline
        block = min(detector.block for detector in pipeline.detectors)

        def has_judged() -> bool:
            return pipeline.behind_samples < block and not pipeline.is_judging

        for played_s, gap_s in PLAYED_S:
            samples = rng.normal(0.0, 0.05, (round(played_s * RATE_HZ), 3))
            await play(service, clock, samples, index)
            # What is said when a silence has been noticed already is not said at all.
            await eventually(has_judged, "all has been judged")
            await let_time_pass(service, clock, gap_s)
            index += len(samples) + round(gap_s * RATE_HZ)
        files = sorted(recorder_of(service).folder.directory.glob("*-alarm.mcap"))
    shutil.rmtree(there)

    kinds: list[tuple[str, str]] = []
    for number, path in enumerate(files):
        snapshot = read_snapshot(path, ResourceLimits())
        noted = [one.what for one in snapshot.entries if isinstance(one.what, Noted)]
        kinds += [(one.document["alarm"], one.document["kind"]) for one in noted if one.topic == ALARMS]
        replayed = await judged(snapshot, None, tmp_path / f"replay {number}")
        assert replayed.anew == {}
        assert replayed.is_equal, (path.name, replayed.said, replayed.alarmed)
    assert {("sensor-ok/accel-x", "raised"), ("sensor-ok/accel-x", "returned")} <= {*kinds}

    # By the same machine file in another folder, beside the same DBC, the detectors go on, too.
    states = [one.document for one in noted if one.topic == STATES]
    assert [fits("daqsvc.snapshot/1", one) for one in states]
    moved = machine_at(elsewhere, f"{elsewhere / DBC}", "snapshot-dbc")
    by_moved = await judged(snapshot, moved, tmp_path / "moved")
    assert by_moved.is_equal
    assert by_moved.anew == {}

    # By another DBC they cannot.
    (elsewhere / DBC).write_text((elsewhere / DBC).read_text().replace("0.0005", "0.001"))
    by_other = await judged(snapshot, moved, tmp_path / "other")
    assert {*by_other.anew.values()} == {
        "the machine file, or a file that it names, is not the one in the snapshot"
    }
