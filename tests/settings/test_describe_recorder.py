"""What `daqsvc check` says of snapshots."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.paths import ROOT

from daqsvc.settings import describe, parse_machine_file

LAVAL = ROOT / "config" / "machines" / "laval-rig.toml"


def lines(table: str) -> list[str]:
    text = describe(parse_machine_file(LAVAL.read_text(encoding="utf-8") + table, Path("rig.toml")))
    return [line for line in text.splitlines() if line.startswith("recorder")]


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("", "10 s before and 10 s after each alarm"),
        ("every_s = 3600", "10 s before and 10 s after each alarm; each hour"),
        ("after_s = 2.5\nevery_s = 90", "10 s before and 2.5 s after each alarm; every 90 s"),
        ("every_rpm = 50", "10 s before and 10 s after each alarm; each 50 rpm of speed"),
        ("continuous = true", "10 s before and 10 s after each alarm; everything, in files of 600 s"),
    ],
)
def test_what_is_recorded_is_said(table: str, words: str) -> None:
    [line] = lines(f"\n[recorder]\n{table}\n")
    start = f"recorder {words}; 1000 MB, 90 days; 256 MB left free"
    assert start.startswith(line), "the rest may be on the next line"
    assert len(line) > len(words)


def test_without_a_recorder_nothing_is_said() -> None:
    assert lines("") == []
