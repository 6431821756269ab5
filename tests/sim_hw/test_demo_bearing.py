"""``daqsvc demo --bearing``: the bearing's detector live on a recording, without a machine file or a bus."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.bearing_signals import OUTER, RATE_HZ, SPEED_RPM, Housing

from daqsvc.cli import main

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.integration


def demo(path: Path, *options: str) -> int:
    try:
        return main(["demo", "--recording", str(path), "--fs", f"{RATE_HZ:g}", *options])
    except SystemExit as stopped:
        return int(stopped.code or 0)


@pytest.fixture
def damaged(tmp_path: Path) -> Path:
    path = tmp_path / "rig.npz"
    np.savez(path, de=Housing(seconds=11.0, order=OUTER, size=2.0, seed=3).samples)
    return path


@pytest.mark.long
def test_a_damaged_race_of_a_recording_is_named_and_alarmed_live(
    damaged: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--bearing", "6205-2RS", "--speed-rpm", f"{SPEED_RPM:g}", "--speed", "4", "--json")
    assert demo(damaged, *options) == 0
    messages = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    diagnoses = [one for one in messages if one["type"] == "diagnosis" and one["detector"] == "bearing"]
    assert diagnoses[-1]["decision"] == "outer"
    assert diagnoses[-1]["sensors"] == ["de"]
    alarms = [one for one in messages if one["type"] == "alarm"]
    assert len(alarms) == 1
    assert "damage of the outer race at de" in json.dumps(alarms[0])


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (("--bearing", "6205-2RS"), 2, "--bearing and --speed-rpm go together"),
        (("--speed-rpm", "1797"), 2, "--bearing and --speed-rpm go together"),
        (("--bearing", "6205-2RS", "--speed-rpm", "1797", "--unit", "um"), 2, "--unit is um"),
        (("--bearing", "6205-2SR", "--speed-rpm", "1797"), 1, "did you mean 6205?"),
    ],
)
def test_what_cannot_be_watched_is_told_before_anything_is_started(
    damaged: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], code: int, words: str
) -> None:
    assert demo(damaged, *options) == code
    assert words in capsys.readouterr().err
