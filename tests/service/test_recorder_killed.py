"""A recorder that is killed while it writes leaves what it has written, and the next start goes on."""

from __future__ import annotations

import shutil
import time
from typing import TYPE_CHECKING

import pytest
from support.many_machines import watched
from support.waiting import PATIENCE_S

from daqsvc.acquisition.samples import SampleBlock
from daqsvc.cli import main
from daqsvc.confined.limits import ResourceLimits
from daqsvc.snapshots.reading import read_snapshot

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from daqsvc.snapshots.contents import Snapshot

pytestmark = [pytest.mark.integration, pytest.mark.long]
RECORDER = "\n[recorder]\ncontinuous = true\ncontinuous_s = 3.0\nreserve_mb = 0\n"


def until(true: Callable[[], bool], what: str) -> None:
    patience_s = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < patience_s, what
        time.sleep(0.1)


def read(path: Path) -> Snapshot:
    return read_snapshot(path, ResourceLimits())


def blocks(snapshot: Snapshot) -> list[SampleBlock]:
    return [one.what for one in snapshot.entries if isinstance(one.what, SampleBlock)]


def test_what_was_written_before_a_kill_is_read_and_a_new_start_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    first.mkdir()
    second.mkdir()
    folder = first / "store" / "rotor-00" / "snapshots"

    def files() -> list[Path]:
        return sorted(folder.glob("*-continuous.mcap"))

    with watched(first, 1, more=RECORDER) as plant:
        until(lambda: len(files()) >= 3, "the third file is begun")
        until(lambda: len(blocks(read(files()[-1]))) >= 5, "there is something in it")
        known = blocks(read(files()[-1]))[-1].end_index
        plant.kill()
    *whole, cut = files()
    end_index = None
    for path in (*whole, cut):
        snapshot = read(path)
        assert bool(snapshot.notes) == (path == cut), snapshot.notes
        for block in blocks(snapshot):
            assert end_index in {None, block.first_index}, path
            end_index = block.end_index
    assert end_index is not None
    assert end_index >= known
    assert main(["replay", str(cut)]) == 0
    assert "are as they were, to the last bit" in capsys.readouterr().out

    (first / "store").rename(second / "store")
    shutil.rmtree(first / "plant")  # a store takes no second file for the same machine
    folder = second / "store" / "rotor-00" / "snapshots"
    with watched(second, 1, more=RECORDER) as plant:
        until(lambda: len(files()) >= len(whole) + 3, "two further files are begun")
        recorders = plant.status(0)["figures"]["recorders"]  # type: ignore[index]
        assert recorders["rotor-00"]["write_failures"] == 0
        assert recorders["rotor-00"]["snapshots_deleted"] == 0
    assert read(files()[len(whole)]).notes, "the one that was cut is as it was"
    assert not read(files()[-2]).notes
