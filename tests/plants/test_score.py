"""The bench of the plants sees what it should: a right name, a group, a wrong one, a false alarm."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from plants.score import Said, scored
from plants.table import reliability, summary
from plants.timing import PER_REV

SPEED_RPM = 3000.0
SAID = Said(
    case="a", fault="static load", snr_db=20, moved=0.5, alarms_before=0, revolutions_before=40.0, delay=1.0,
    decision="static_load", group=(), probability=1.0, probabilities={"static_load": 1.0}, evidence={},
    named=True, refused="",
)  # fmt: skip


def test_a_name_is_right_told_or_wrong():
    assert (SAID.right, SAID.told, SAID.wrong) == (True, True, False)
    group = replace(SAID, group=("static_load", "stiffness_loss"))
    assert (group.right, group.told, group.wrong) == (False, True, False)
    other = replace(SAID, decision="rub")
    assert (other.right, other.told, other.wrong) == (False, False, True)
    withheld = replace(SAID, decision="rub", group=("rub", "unmodelled"))
    assert (withheld.told, withheld.wrong) == (False, False)
    silent = replace(SAID, named=False, decision="departure")
    assert (silent.right, silent.told, silent.wrong) == (False, False, False)


def test_1x_alone_may_stay_the_group_that_it_is():
    pair = replace(SAID, fault="damping loss", decision="unbalance", group=("unbalance", "damping_loss"))
    assert pair.right
    assert not replace(pair, group=("unbalance", "stiffness_loss")).right


def test_a_fault_without_a_model_is_misnamed_by_a_sure_name_that_is_not_true_of_it():
    crack = replace(
        SAID, fault="breathing crack", decision="rub", probabilities={"rub": 0.95, "unmodelled": 0.05}
    )
    assert crack.misnamed
    assert not replace(crack, group=("rub", "unmodelled")).misnamed
    assert not replace(crack, probabilities={"rub": 0.8, "unmodelled": 0.2}).misnamed
    softer = replace(crack, decision="stiffness_loss", probabilities={"stiffness_loss": 1.0})
    assert not softer.misnamed
    assert replace(softer, fault="coupled 2X").misnamed


def record(folder, name, step_um, revolutions=160, onset=90):
    """A round orbit whose mean position moves at the onset."""
    angle = 2.0 * np.pi * np.arange(revolutions * PER_REV) / PER_REV
    z = 20.0 * np.exp(1j * angle) - 60.0j + np.where(angle >= 2.0 * np.pi * onset, step_um, 0.0)
    np.savez(
        folder / f"{name}.npz",
        z_um=z.astype(np.complex64),
        angle_rad=angle,
        rate_hz=SPEED_RPM / 60.0 * PER_REV,
    )


def test_records_are_judged_from_raw_channels(tmp_path):
    case = {
        "geometry": "pump", "part": "tuned", "speed_rpm": SPEED_RPM, "of_critical": 0.8, "onset_rev": 90.0,
        "size": 1.0, "critical_hz": 62.0, "damping_ratio": 0.1, "clearance_um": 400.0, "moved": 0.7,
        "speed_hunts": False,
    }  # fmt: skip
    cases = [
        {**case, "name": "loaded", "fault": "static load"},
        {**case, "name": "well", "fault": "healthy"},
        {**case, "name": "hidden", "fault": "static load", "part": "drawn"},
    ]
    (tmp_path / "cases.json").write_text(json.dumps(cases))
    record(tmp_path, "loaded", 15.0)
    record(tmp_path, "well", 0.0)
    loaded, well = scored(tmp_path, part="tuned", snr_db=(20,))
    assert loaded.right
    assert loaded.delay == pytest.approx(1.0, abs=1.5)
    assert (loaded.alarms_before, loaded.revolutions_before) == (0, 40.0)
    assert (well.decision, well.alarms_before) == ("normal", 0)
    assert well.revolutions_before == pytest.approx(110.0, abs=5.0)
    assert summary([loaded, well])[2].startswith("| 20 dB | 100.0 % | 100.0 % | 0.0 % of 1 |")
    assert reliability([loaded])[-2] == "| 0.9 to 0.99 | 1 | 100.0 % |"
    # A change that comes before it is said to have come is a false alarm.
    cases[0]["onset_rev"] = 150.0
    (tmp_path / "cases.json").write_text(json.dumps(cases[:1]))
    (early,) = scored(tmp_path, part="tuned", snr_db=(20,))
    assert early.alarms_before == 1
