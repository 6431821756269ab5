"""A service that records continuously leaves files that join, and each of them is judged again as it was."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from support.recorded_rig import RATE_HZ, let_time_pass, play, recorded_rig, recorder_of, recording
from support.waiting import PATIENCE_S

from daqsvc.acquisition.samples import SampleBlock
from daqsvc.confined.limits import ResourceLimits
from daqsvc.offline.replay import replay
from daqsvc.snapshots.reading import read_snapshot

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.integration
PLAYED = round(9.0 * RATE_HZ) // 3 * 3
"""Samples; three of them make a frame."""


async def test_files_join_over_an_alarm_and_each_is_judged_again_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daqsvc.recorder.END_S", PATIENCE_S)  # however slow the disk is
    machine, samples = recorded_rig(
        "continuous", continuous=True, continuous_s=2.5, before_s=1.0, after_s=1.0
    )
    async with recording(machine, tmp_path / "store") as (service, clock):
        await play(service, clock, samples[:PLAYED])
        await let_time_pass(service, clock, 1.0)
        recorder = recorder_of(service)
    files = sorted(recorder.folder.directory.glob("*-continuous.mcap"))
    assert len(files) >= 2, "how many depends on how soon detectors say what they remember"
    assert list(recorder.folder.directory.glob("*-alarm.mcap"))
    assert recorder.counters.blocks_dropped == recorder.counters.snapshots_failed == 0
    end_index = equal = 0
    for path in files:
        snapshot = read_snapshot(path, ResourceLimits())
        assert snapshot.notes == ()
        for entry in snapshot.entries:
            if isinstance(entry.what, SampleBlock):
                assert entry.what.first_index == end_index, path
                end_index = entry.what.end_index
        folder = tmp_path / f"replay of {path.name}"
        folder.mkdir()
        replayed = await replay(snapshot, None, folder)
        assert not replayed.anew
        equal += replayed.said.equal
        # A short file, as the last one may be, has no statement, and nothing was compared.
        assert replayed.is_equal or not replayed.is_compared, (path, replayed.said, replayed.alarmed)
    assert end_index == PLAYED
    assert equal > 20
