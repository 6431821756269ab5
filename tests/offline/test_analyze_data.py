"""What ``daqsvc analyze`` says against the samples: unit, coupling, gaps, too few of them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, lfilter
from support.orbit_files import RATE_HZ, SAMPLES_PER_REV, SPEED_RPM, Orbit

from daqsvc.detectors.rotor_synchronous.calibrating import calibrate_recordings
from daqsvc.detectors.rotor_synchronous.recorded import analyse
from daqsvc.detectors.rotor_synchronous.recorded_speed import KeyphasorChannel, RotorSetup
from daqsvc.dsp.quality import RefusedError
from daqsvc.dsp.quality.recorded import Complaint
from daqsvc.recording.recording import Recording
from daqsvc.rotor.calibration.file import CalibrationFileError, load_healthy, save_record
from daqsvc.rotor.laval import LavalRotor

ROTOR = LavalRotor(natural_frequency_hz=60.0, damping_ratio=0.1, clearance_um=200.0)
SETUP = RotorSetup(probes=("x", "y"), rotor=ROTOR, speed_rpm=SPEED_RPM)
WITH_KEYPHASOR = replace(SETUP, keyphasor=KeyphasorChannel("k"))


class MarkedOrbit(Orbit):
    """With a keyphasor whose every mark falls on the first sample of a revolution."""

    def __post_init__(self):
        super().__post_init__()
        self.pulses = np.where(np.arange(len(self.x)) % SAMPLES_PER_REV < 6, -2.0, -10.0)


def recording(orbit, *, keyphasor=False, scale=1.0, rate_hz=RATE_HZ):
    columns = [scale * orbit.x, scale * orbit.y, *([orbit.pulses] if keyphasor else [])]
    names = ("x", "y", "k")[: len(columns)]
    return Recording(names, np.column_stack(columns), rate_hz, Path("orbit"), nan_count=0)


def test_an_orbit_that_is_tiny_in_its_clearance_makes_the_unit_doubtful():
    found = analyse(recording(Orbit(), scale=0.002), SETUP)
    assert found.verdict == "normal"
    (problem,) = found.quality.problems
    assert re.fullmatch(
        r"the unit 'um' may be wrong: the orbit has a radius of 0\.08\d* um in a clearance of 200 um", problem
    )
    assert analyse(recording(Orbit()), SETUP).quality.problems == ()
    unknown = replace(SETUP, rotor=replace(ROTOR, clearance_um=None))
    assert analyse(recording(Orbit(), scale=0.002), unknown).quality.problems == ()


def test_ac_coupling_is_seen_in_spite_of_what_switching_on_leaves():
    b, a = butter(1, 2.0, "high", fs=RATE_HZ)
    orbit = Orbit(240)
    orbit.x, orbit.y = (lfilter(b, a, probe + 15.0) for probe in (orbit.x, orbit.y))
    first, later = (abs(part.mean()) for part in np.split(orbit.x, [50 * SAMPLES_PER_REV]))
    assert first > 20.0 * later
    found = analyse(recording(orbit), SETUP)
    assert found.refused is None
    assert found.verdict == "normal"
    assert any("AC-coupled probes?" in problem for problem in found.quality.problems)
    assert not any(
        "AC-coupled" in problem for problem in analyse(recording(Orbit(240)), SETUP).quality.problems
    )


@pytest.mark.parametrize("per_rev", [5, 7])
def test_too_few_samples_a_revolution_are_told_with_the_rate_that_is_needed(per_rev):
    orbit = Orbit(400)
    orbit.x, orbit.y = (probe[:: SAMPLES_PER_REV // per_rev] for probe in (orbit.x, orbit.y))
    rate_hz = RATE_HZ / (SAMPLES_PER_REV // per_rev)
    found = analyse(recording(orbit, rate_hz=rate_hz), SETUP)
    assert found.refused is not None
    assert f"a revolution has {60.0 * rate_hz / SPEED_RPM:.3g} samples" in found.refused
    assert "sample at 400 Hz or faster" in found.refused


def test_a_keyphasor_that_stops_is_one_complaint_and_one_count():
    orbit = MarkedOrbit(200)
    orbit.pulses[80 * SAMPLES_PER_REV :] = -10.0
    found = analyse(recording(orbit, keyphasor=True), WITH_KEYPHASOR)
    assert found.refused is not None
    assert re.search(r"; [^;]* \(\d+ of \d+ revolutions cannot be judged\)$", found.refused)
    assert "times more" not in found.refused
    assert Complaint("no pulse", 1).describe() == "no pulse"
    assert Complaint("no pulse", 2).describe() == "no pulse (and 1 time more)"
    assert Complaint("no pulse", 36).describe() == "no pulse (and 35 times more)"


def test_missing_pulses_leave_a_calibration_what_revolutions_there_are():
    orbit = MarkedOrbit(120)
    for revolution in (20, 41, 60, 61, 90):
        orbit.pulses[(revolution - 1) * SAMPLES_PER_REV : revolution * SAMPLES_PER_REV] = -10.0
    made = calibrate_recordings([recording(orbit, keyphasor=True)], WITH_KEYPHASOR)
    assert made.steady[0].revolutions >= 110
    with pytest.raises(RefusedError) as refused:
        calibrate_recordings([recording(MarkedOrbit(15), keyphasor=True)], WITH_KEYPHASOR)
    assert "a baseline needs 23" in str(refused.value)
    assert "--" not in str(refused.value)
    assert "fewer" not in str(refused.value)


def with_run_up(path):
    """A calibration file with a baseline at another speed and, after it, what a run-up told."""
    from support.run_ups import RATE_HZ as RUN_UP_RATE_HZ
    from support.run_ups import record

    xy, angle = record(noise_um=1.0)
    keyphasor = np.where((angle / (2.0 * np.pi)) % 1.0 < 0.1, -2.0, -10.0)
    samples = np.column_stack([xy, keyphasor])
    run_up = Recording(("x", "y", "k"), samples, RUN_UP_RATE_HZ, Path("run-up"), nan_count=0)
    setup = replace(WITH_KEYPHASOR, speed_rpm=None)
    steady = recording(MarkedOrbit(120), keyphasor=True)
    made = calibrate_recordings([run_up, steady], setup, rotor_is_known=False)
    save_record(made, path)
    save_record(
        replace(made, run_up=None, steady=(replace(made.steady[0], fit_error=None),)), path.with_suffix(".st")
    )
    return path


@pytest.mark.long
def test_at_another_speed_the_rotor_of_the_run_up_serves_and_the_baseline_is_learnt(tmp_path):
    path = with_run_up(tmp_path / "both.toml")
    rotor, baselines = load_healthy(path, 2000.0)
    assert baselines == ()
    assert rotor.natural_frequency_hz == pytest.approx(40.0, rel=0.02)
    with pytest.raises(CalibrationFileError, match=r"no baseline within 5 % of 2000\.0 rpm"):
        load_healthy(path.with_suffix(".st"), 2000.0)
    # The speed by the keyphasor chooses where none is stated.
    rotor, baselines = load_healthy(path, None)
    setup = replace(WITH_KEYPHASOR, rotor=rotor, calibrations=baselines, speed_rpm=None)
    slow = recording(MarkedOrbit(200, change=0.8), keyphasor=True, rate_hz=RATE_HZ * 2.0 / 3.0)
    found = analyse(slow, setup)
    assert found.refused is None
    assert "unbalance" in found.group
    assert found.calibration is not None
    assert found.calibration.speed_rpm == pytest.approx(2000.0, rel=1e-3)
    assert found.calibration.rotor == rotor
    assert any(
        "no baseline at 2000.0 rpm, but at 3000.0 rpm: the rotor is that of its run-up" in problem
        for problem in found.quality.problems
    )
    _, baselines = load_healthy(path.with_suffix(".st"), None)
    found = analyse(slow, replace(setup, calibrations=baselines))
    assert found.refused is not None
    assert found.refused.startswith(
        "the calibration holds no baseline within 5 % of 2000.0 rpm, but at 3000.0"
    )
    assert "times more" not in found.refused
