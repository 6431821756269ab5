"""Two accelerometers from the healthy recording to the verdict, by the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.machine_files import MACHINES, changed

from sim_hw.plants.bearing import BearingMachine, FaultSignal, levels, simulate
from sim_hw.reproduce.bearing.design import S3

if TYPE_CHECKING:
    from pathlib import Path

    from conftest import Run

    from sim_hw.plants.bearing import Fault

pytestmark = pytest.mark.integration
RATE_HZ, SPEED_RPM = 24_000.0, 1797.0
EXAMPLE = MACHINES / "bearing.toml"
MODEL = (
    'rotor_sensor = "accel-fe"\n'
    f"model = {{ masses_kg = [{S3.m_r}, {S3.m_b}, {S3.m_h}], stiffness_n_per_m = [{S3.k_s}, {S3.k_c}, "
    f"{S3.k_h}], damping_n_s_per_m = [{S3.c_s}, {S3.c_c}, {S3.c_h}] }}"
)
WRONG = "orders = { bpfi = 9.45, bpfo = 4.55, bsf = 3.05, ftf = 0.325 }"
"""Of another bearing: no line is where it says."""


@pytest.mark.long
def test_a_calibrated_pair_names_the_race_that_no_line_shows(verb: Run, tmp_path: Path) -> None:
    text = changed(
        EXAMPLE,
        ('type = "6205-2RS"', f"{WRONG}\n{MODEL}"),
        ("speed_rpm = 1772.0", f"speed_rpm = {SPEED_RPM}"),
        ("rate_hz = 25_600.0", f"rate_hz = {RATE_HZ}"),
        ('unit = "g"', 'unit = "m/s2"'),
    )[0]
    second = text.index("[[pipeline.bearing.bearings]]", text.index("[[pipeline.bearing.bearings]]") + 1)
    text = text[:second] + text[text.index("[[alarms]]") :]
    text = text.replace('channel = "fe"\nunit = "g"', 'channel = "fe"\nunit = "m/s2"')
    machine, out = tmp_path / "m.toml", tmp_path / "motor.toml"
    machine.write_text(text)
    plant = BearingMachine(
        masses=(S3.m_r, S3.m_b, S3.m_h),
        stiffnesses=(S3.k_s, S3.k_c, S3.k_h),
        dampings=(S3.c_s, S3.c_c, S3.c_h),
    )
    signal, rng = FaultSignal(shaft_hz=SPEED_RPM / 60.0), np.random.default_rng(3)
    level, off = levels(plant, signal, snr_db=5.0, rate_hz=RATE_HZ), plant.mismatched(0.05, rng)

    def record(fault: Fault) -> Path:
        y = simulate(off, signal, fault, level, rng, seconds=10.0, rate_hz=RATE_HZ).y
        np.savez(tmp_path / f"{fault}.npz", **{"accel-fe": y[:, 0], "accel-de": y[:, 1]})
        return tmp_path / f"{fault}.npz"

    code, (made,), _ = verb("calibrate", machine, record("healthy"), "--fs", RATE_HZ, "--out", out)
    assert (code, made["refused"]) == (0, None)
    recordings = [tmp_path / "healthy.npz", record("inner"), record("outer")]
    code, found, err = verb("analyze", machine, *recordings, "--fs", RATE_HZ, "--calibration", out)
    assert (code, err) == (0, "")
    assert [one["verdict"] for one in found] == ["normal", "inner", "outer"]
    code, found, _ = verb("analyze", machine, *recordings, "--fs", RATE_HZ)
    assert "outer" not in {one["verdict"] for one in found[1:]}
