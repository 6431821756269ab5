"""A recording whose speed moves, or is not the stated one, is told from one with a fault."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.orbit_files import RATE_HZ, SAMPLES_PER_REV, SPEED_RPM, Orbit
from support.run_ups import RATE_HZ as RUN_UP_RATE_HZ
from support.run_ups import record

from daqsvc.detectors.rotor_synchronous.recorded import analyse
from daqsvc.detectors.rotor_synchronous.recorded_speed import KeyphasorChannel, RotorSetup
from daqsvc.dsp.speed.steadiness import trend_of_orbit, trend_of_pulses
from daqsvc.recording.recording import Recording
from daqsvc.rotor.laval import LavalRotor

ROTOR = LavalRotor(natural_frequency_hz=60.0, damping_ratio=0.1, clearance_um=200.0)
SETUP = RotorSetup(probes=("x", "y"), rotor=ROTOR, speed_rpm=SPEED_RPM)
WITH_KEYPHASOR = replace(SETUP, keyphasor=KeyphasorChannel("k"), speed_rpm=None)


def pulses(angle_rad):
    return np.where((angle_rad / math.tau) % 1.0 < 0.1, 5.0, 0.0)


def refused(columns, setup, rate_hz=RATE_HZ):
    names = ("x", "y", "k")[: len(columns)]
    return analyse(
        Recording(names, np.column_stack(columns), rate_hz, Path("it"), nan_count=0), setup
    ).refused


@pytest.mark.parametrize("coast_down", [False, True])
@pytest.mark.parametrize(
    "setup",
    [WITH_KEYPHASOR, replace(SETUP, speed_rpm=4500.0), replace(SETUP, speed_rpm=900.0, follow_orbit=True)],
    ids=["keyphasor", "fixed", "orbit"],
)
def test_a_run_up_is_told_from_a_fault(setup, coast_down):
    xy, angle = record(noise_um=2.0)
    if coast_down:
        xy, angle = xy[::-1] * [1.0, -1.0], angle[-1] - angle[::-1]
        setup = replace(setup, speed_rpm=4500.0) if setup.follow_orbit else setup
    said = refused([*xy.T, pulses(angle)], setup, RUN_UP_RATE_HZ)
    assert said is not None
    assert "a run-up cannot be judged; learn the rotor from it with daqsvc calibrate" in said
    found = re.search(r"the speed (rises|falls) from (\d+) to (\d+) rpm", said)
    assert found is not None
    ends = [4500.0, 720.0] if coast_down else [720.0, 4500.0]
    assert found[1] == ("falls" if coast_down else "rises")
    assert [float(found[2]), float(found[3])] == pytest.approx(ends, rel=0.25)


def test_a_speed_that_hunts_or_is_scattered_is_no_run_up():
    rng = np.random.default_rng(5)
    revolutions = np.arange(200.0)
    hunting = 64.0 * (revolutions + 3.0 * np.sin(revolutions / 8.0))
    assert trend_of_pulses(hunting, RATE_HZ) is None
    missing = 64.0 * revolutions[rng.random(200) > 0.3]
    assert trend_of_pulses(missing, RATE_HZ) is None
    twice = np.sort(np.concatenate((64.0 * revolutions, 64.0 * revolutions + 20.0)))
    assert trend_of_pulses(twice, RATE_HZ) is None
    assert trend_of_orbit(rng.standard_normal((20_000, 2)), RATE_HZ) is None
    drifting = np.cumsum(64.0 * (1.0 - 0.04 * revolutions / 200.0))
    assert trend_of_pulses(drifting, RATE_HZ) is None
    rising = np.cumsum(64.0 * (1.0 - 0.08 * revolutions / 200.0))
    trend = trend_of_pulses(rising, RATE_HZ)
    assert trend is not None
    assert trend.to_rpm / trend.from_rpm == pytest.approx(1.0 / 0.92, rel=0.01)


@pytest.mark.parametrize("stated_rpm", [1500.0, 6000.0, 3250.0, 2780.0, 1010.0])
@pytest.mark.parametrize("change", [0.0, 0.8])
def test_a_speed_stated_far_off_is_answered_with_the_true_one(stated_rpm, change):
    orbit = Orbit(200, change=change)
    said = refused([orbit.x, orbit.y], replace(SETUP, speed_rpm=stated_rpm))
    assert said is not None
    found = re.search(r"(?:orbit|shaft) turns at ([\d.]+) rpm", said)
    assert found is not None, said
    assert float(found[1]) == pytest.approx(SPEED_RPM, rel=1e-3)


def test_noise_names_no_speed():
    noise = 30.0 * np.random.default_rng(1).standard_normal((200 * SAMPLES_PER_REV, 2))
    said = refused(list(noise.T), SETUP)
    assert said is not None
    assert "no 1X line within 10% of 3000 rpm" in said
    assert "turns at" not in said


def test_a_whirl_as_large_as_1x_is_no_wrong_speed():
    orbit = Orbit(120)
    angle = math.tau * np.arange(len(orbit.x)) / SAMPLES_PER_REV
    orbit.x += 60.0 * np.cos(0.45 * angle)
    orbit.y += 60.0 * np.sin(0.45 * angle)
    said = refused([orbit.x, orbit.y], SETUP)
    assert said is None or "turns at" not in said


def test_a_calibrated_machine_is_not_judged_while_it_coasts_down():
    steady = Orbit(120)
    keyphasor = np.where(np.arange(len(steady.x)) % SAMPLES_PER_REV < 6, 5.0, 0.0)
    samples = np.column_stack([steady.x, steady.y, keyphasor])
    healthy = analyse(Recording(("x", "y", "k"), samples, RATE_HZ, Path("h"), nan_count=0), WITH_KEYPHASOR)
    assert healthy.calibration is not None
    xy, angle = record(noise_um=2.0)
    down = [*(xy[::-1] * [1.0, -1.0]).T, pulses(angle[-1] - angle[::-1])]
    said = refused(down, replace(WITH_KEYPHASOR, calibrations=(healthy.calibration,)), RUN_UP_RATE_HZ)
    assert said is not None
    assert re.match(r"the speed falls from \d+ to \d+ rpm: a run-up cannot be judged", said)
