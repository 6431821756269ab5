"""An alarm of the demo leaves a snapshot, and what that holds gives the same alarm."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from daqsvc.cli import main
from sim_hw.demo.session import DemoOutcome, Script, summarise
from sim_hw.demo.view import View

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.integration
SAME = ("alarm", "kind", "level", "state", "monotonic_ns", "message")


def told(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


@pytest.mark.long
@pytest.mark.timeout(900)
def test_a_snapshot_of_the_demo_replays_to_the_alarms_that_it_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "kept" / "here"
    assert main(["demo", "--speed", "1000", "--json", "--snapshots", str(folder)]) == 0
    *messages, summary = told(capsys)
    alarms = [one for one in messages if one["type"] == "alarm"]
    assert {one["alarm"] for one in alarms} >= {"rotor-fault", "shaft-vibration-x"}
    [path] = summary["snapshots"]
    assert [str(one) for one in folder.iterdir()] == [path]
    assert path.endswith("-alarm.mcap")

    assert main(["replay", "--check", "--json", path]) == 0
    [replayed] = told(capsys)
    assert [[one[key] for key in SAME] for one in replayed["alarms"]] == [
        [one[key] for key in SAME] for one in alarms
    ]
    assert not replayed["anew"]
    assert replayed["compared"]["statements"]["only_then"] == []

    # Some 20 s at that speed: the answers are the same.
    assert main(["replay", "--check", "--json", "--speed", "100", path]) == 0
    [paced] = told(capsys)
    fresh = ("id", "sequence", "occurrence", "time", "wall_ns")
    for one in (*paced["alarms"], *replayed["alarms"]):
        for key in fresh:
            one.pop(key, None)
    assert paced == replayed
    assert main(["replay", path]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "rotor-fault raised" in lines[0]
    [causes] = [line for line in lines if line.startswith("made for: ")]
    assert "rotor-fault: raised; " in causes
    assert lines[-1] == f"{len(alarms)} of {len(alarms)} alarm events are as they were, to the last bit"


def test_the_demo_says_how_to_judge_its_snapshot_again_and_how_to_keep_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = Script("a rig", lambda _: pytest.fail("not played"), "shaft", np.zeros((9, 3)), 640.0)
    stream = dict.fromkeys(
        (
            *("samples_received", "samples_lost", "frames_received", "frames_corrupt", "frames_duplicate"),
            *("frames_reordered", "frames_late", "frames_rejected", "drift_ppm", "jitter_ms"),
        ),
        0,
    )
    lag = {"p50": 0.0, "p99": 0.0, "max": 0.0}
    outcome = DemoOutcome(figures={"streams": {"shaft": stream}, "detectors": {}, "loop_lag_ms": lag})

    def shown() -> list[str]:
        View(script, 1.0).show_snapshots(summarise(script, outcome, speed=1.0))
        return capsys.readouterr().out.splitlines()

    assert "snapshot" not in "".join(shown())
    outcome.snapshots_gone = 2
    assert "2 snapshots, which were removed with the demo: --snapshots DIR" in " ".join(shown())
    outcome.snapshots = [tmp_path / ("long-" * 40) / "an alarm.mcap"]
    assert f"daqsvc replay '{outcome.snapshots[0]}'" in shown()


def test_a_folder_that_cannot_be_made_ends_the_demo_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert main(["demo", "--speed", "1000", "--json", "--snapshots", str(tmp_path / "file" / "in")]) == 1
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith("daqsvc demo: --snapshots: the folder")
    assert said.endswith("Not a directory; name another [C23]")
