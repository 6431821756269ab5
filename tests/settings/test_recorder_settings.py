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
