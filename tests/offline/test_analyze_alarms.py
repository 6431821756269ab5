"""What ``daqsvc analyze`` says of alarms that came and went, and of several in one recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.orbit_files import AMPLITUDE_UM, ONSET, RATE_HZ, SAMPLES_PER_REV, SPEED_RPM, Orbit

from daqsvc.detectors.rotor_synchronous.recorded import analyse
from daqsvc.detectors.rotor_synchronous.recorded_speed import RotorSetup
from daqsvc.recording.recording import Recording
from daqsvc.rotor.laval import LavalRotor

ROTOR = LavalRotor(natural_frequency_hz=60.0, damping_ratio=0.1, clearance_um=200.0)
SETUP = RotorSetup(probes=("x", "y"), rotor=ROTOR, speed_rpm=SPEED_RPM)


def analysed(orbit):
    samples = np.column_stack([orbit.x, orbit.y])
    return analyse(Recording(("x", "y"), samples, RATE_HZ, Path("orbit"), nan_count=0), SETUP)


def test_a_fault_that_went_away_is_told_though_the_machine_is_normal_at_the_end():
    found = analysed(Orbit(300, change=0.5, until=130.0))
    assert found.verdict == "normal"
    (alarm,) = found.as_json()["alarms"]
    assert alarm["onset"]["revolution"] == int(ONSET)
    assert alarm["departure"]["revolution"] == int(ONSET) + 1
    assert alarm["departure"]["sample"] == pytest.approx(alarm["departure"]["seconds"] * RATE_HZ)
    assert int(ONSET) + 1 < alarm["declaration"]["revolution"] < 130
    assert alarm["verdict"] in alarm["group"]
    assert set(alarm["group"]) == {"unbalance", "damping_loss"}
    assert 130 < alarm["returned"]["revolution"] <= 150
    assert alarm["returned"]["sample"] == pytest.approx(
        alarm["returned"]["revolution"] * SAMPLES_PER_REV, abs=1
    )
    headline, line = found.describe().splitlines()[:2]
    assert headline.endswith(
        "normal at the end of 300 revolutions, but an alarm was raised and cleared before"
    )
    assert "alarm at revolution 81" in line
    assert "unbalance or damping loss" in line
    assert f"healthy again at revolution {alarm['returned']['revolution']} " in line


def test_a_fault_that_came_back_is_two_alarms():
    orbit, again = Orbit(300, change=0.5, until=130.0), Orbit(300, change=0.5, until=130.0, seed=2)
    orbit.x, orbit.y = np.append(orbit.x, again.x), np.append(orbit.y, again.y)
    found = analysed(orbit)
    assert found.verdict == "normal"
    assert [alarm.onset.revolution for alarm in found.alarms] == [80, 380]
    assert all(alarm.returned is not None for alarm in found.alarms)
    assert "2 alarms were raised and cleared before" in found.describe()


def test_a_second_fault_has_an_onset_of_its_own():
    orbit = Orbit(300, change=0.5)
    orbit.y[200 * SAMPLES_PER_REV :] -= 0.5 * AMPLITUDE_UM
    found = analysed(orbit)
    first, second = found.alarms
    assert found.onset == first.onset
    assert set(first.group) == {"unbalance", "damping_loss"}
    assert first.onset.revolution == 80
    assert second.onset.revolution == 200
    assert (second.verdict, second.group) == (found.verdict, found.group)
    assert (first.returned, second.returned) == (None, None)


def test_the_smallest_change_is_that_of_the_baseline_as_it_has_grown():
    grown, short = analysed(Orbit(600, seed=3)), analysed(Orbit(60))
    assert short.as_json()["calibration"]["reference_revolutions"] == 60
    smallest = [one.as_json()["calibration"]["smallest_change_um"] for one in (short, grown)]
    assert smallest[0] / smallest[1] == pytest.approx(10.0**0.5, rel=0.1)
    assert grown.as_json()["calibration"]["reference_revolutions"] == 600
    assert grown.as_json()["calibration"]["revolutions"] == 50
    assert "after 600 revolutions the smallest change" in grown.describe()
    changed = analysed(Orbit(300, change=0.5))
    assert changed.reference_revolutions == int(ONSET)
    returned = analysed(Orbit(300, change=0.5, until=130.0))
    (alarm,) = returned.alarms
    assert returned.reference_revolutions == int(ONSET) + 300 - alarm.returned.revolution


def test_no_angle_is_minus_zero():
    orbit = Orbit(300, change=0.5)
    z = (orbit.x + 1j * orbit.y) * np.exp(1j * np.radians(39.9))
    orbit.x, orbit.y = z.real, z.imag
    text = analysed(orbit).describe()
    assert "um at 0 degrees" in text
    assert "-0 degrees" not in text
