"""Snapshots by the speed need somebody who knows the speed."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.paths import ROOT

from daqsvc.settings import MachineFileError, parse_machine_file

RIG = (ROOT / "config" / "machines" / "virtual-rig.toml").read_text(encoding="utf-8")
STEPS = "[recorder]\nevery_rpm = 100.0\n"


def without_bank(text: str) -> str:
    """The machine file without its rotor bank, and the alarm that follows it."""
    tables = [f"[{table}" for table in text.replace("\n\n[", "\n[").split("\n[")]
    kept = [one for one in tables if "rotor_bank" not in one and 'detector = "rotor-bank"' not in one]
    return "\n".join(kept).removeprefix("[")


def test_a_machine_that_states_its_speed_may_be_recorded_by_it() -> None:
    machine = parse_machine_file(f"{RIG}\n{STEPS}", Path("rig.toml"))
    assert machine.recorder is not None
    assert machine.recorder.every_rpm == 100.0


def test_steps_of_a_speed_that_nobody_states_are_refused_in_a_sentence() -> None:
    with pytest.raises(MachineFileError) as raised:
        parse_machine_file(f"{without_bank(RIG)}\n{STEPS}", Path("rig.toml"))
    [problem] = raised.value.problems
    assert problem.key == "recorder.every_rpm"
    assert problem.message == "asks for snapshots by the speed, and no detector of this machine states one"
    assert "[pipeline.rotor_bank] or [pipeline.rotor_synchronous]" in problem.remedy


@pytest.mark.parametrize(("every_s", "is_warned"), [("10.0", True), ("19.9", True), ("20.0", False)])
def test_snapshots_by_the_clock_that_overlap_are_warned_of(every_s: str, *, is_warned: bool) -> None:
    machine = parse_machine_file(f"{RIG}\n[recorder]\nevery_s = {every_s}\n", Path("rig.toml"))
    found = [one for one in machine.warnings if one.key == "recorder.every_s"]
    assert bool(found) == is_warned
    assert all("each holds 20 s" in one.message for one in found)
    assert all("continuous = true" in one.remedy for one in found)
