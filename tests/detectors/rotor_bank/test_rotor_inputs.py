"""What the bank's sensors cannot truly show is named: direction, static position, speed. Calibration."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support import rotor_runs as runs
from support.shaft_channels import feed

from daqsvc.detectors.rotor_bank.detector import (
    DEPARTURE,
    KeyphasorProbe,
    Probe,
    RotorBankDetector,
    RotorMode,
)
from daqsvc.rotor.decision import DecisionRules
from sim_hw.plants import rotor as plant
from sim_hw.plants.rotor import keyphasor_voltage

RATE_HZ = 640.0


def detector(
    modes=runs.PAPER_MODES, *, rotor=runs.ROTOR, speed_rpm=600.0, snr_db=0.0, angles=(0.0, 90.0), **options
):
    return RotorBankDetector(
        machine="rig",
        stream="shaft",
        rate_hz=RATE_HZ,
        speed_rpm=speed_rpm,
        probes=(Probe("probe-x", 0, angles[0]), Probe("probe-y", 1, angles[1])),
        keyphasor=KeyphasorProbe("keyphasor", 2, -6.0),
        rotor=rotor,
        modes=modes,
        noise_um=runs.sigma(snr_db) * runs.CLEARANCE_UM,
        **options,
    )


def diagnoses(subject, samples):
    return feed(subject, samples, RATE_HZ, block=16, first_index=0)


def healthy(revolutions=30.0, *, snr_db=0.0, seed=0):
    return runs.run([], revolutions, seed).channels(snr_db, seed)


def changes(said):
    return [d.decision for d in said if d.changed]


@pytest.mark.parametrize("snr_db", [-5.0, 0.0, 5.0, 20.0])
@pytest.mark.parametrize("seed", range(3))
def test_swapped_probes_are_named_before_any_mode_is(snr_db, seed):
    samples = healthy(snr_db=snr_db, seed=seed)[:, [1, 0, 2]]
    said = diagnoses(detector(runs.TWELVE_MODES, snr_db=snr_db), samples)
    assert changes(said) == []
    late = [d for d in said if d.revolutions > 5.0]
    assert {d.quality for d in late} == {"not_ok"}
    assert all("turns against the stated rotation" in d.reason for d in late)
    assert all("x and y are swapped, or the sign of the speed" in d.reason for d in late)


def test_speed_with_the_wrong_sign_is_named():
    said = diagnoses(detector(speed_rpm=-600.0), healthy())
    assert changes(said) == []
    assert "sign of the speed" in said[-1].reason
    right = diagnoses(detector(speed_rpm=-600.0, angles=(0.0, -90.0)), healthy())
    assert right[-1].quality == "good", "the mirror image of a shaft that turns clockwise"


def test_swapped_probes_that_are_put_right_are_believed():
    samples = healthy(40.0)
    samples[: 20 * runs.PER_REV, :2] = samples[: 20 * runs.PER_REV, [1, 0]]
    said = diagnoses(detector(), samples)
    assert changes(said) == ["N"]
    assert said[-1].quality == "good"


@pytest.mark.parametrize("mode", ["F1", "F1L2", "F1L3"])
def test_faults_and_rub_are_not_taken_for_swapped_probes(mode):
    # The rub whirls backwards at 1.07 per revolution: it must not look like a wiring error.
    run = runs.run([(12.0, runs.PAPER_PLANTS[mode])], 60.0, 3)
    said = diagnoses(detector(), run.channels(0.0, 3))
    assert {d.quality for d in said} == {"good"}
    assert said[-1].decision == mode


def test_probes_without_static_position_are_named():
    samples = healthy()
    samples[:, :2] -= samples[:, :2].mean(axis=0)
    said = diagnoses(detector(runs.TWELVE_MODES), samples)
    assert set(changes(said)) <= {"N"}
    assert said[-1].quality == "not_ok"
    assert "no static position" in said[-1].reason
    assert "ac_coupled = true" in said[-1].reason


def test_ac_coupled_probes_that_are_said_to_be_are_no_fault():
    run = runs.run([(15.0, runs.PAPER_PLANTS["F1"])], 40.0, 1)
    samples = run.channels(0.0, 1)
    samples[:, 1] += 10.0
    said = diagnoses(detector(ac_coupled=True), samples)
    assert changes(said) == ["N", "F1"]
    assert {d.quality for d in said} == {"good"}


def test_ac_coupled_probes_and_a_static_load_do_not_go_together():
    with pytest.raises(ValueError, match=r"'L1' is a static load .* AC-coupled .* remove the mode"):
        detector(runs.TWELVE_MODES, ac_coupled=True)


def test_static_load_that_carries_the_shaft_is_not_taken_for_ac_coupling():
    run = runs.run([(15.0, {"static_load": -0.1})], 40.0, 1)
    lifted = (*runs.PAPER_MODES, RotorMode("L", static_load_um=(0.0, 10.0)))
    said = diagnoses(detector(lifted), run.channels(0.0, 1))
    assert said[-1].decision == "L"
    assert {d.quality for d in said} == {"good"}


@pytest.mark.parametrize("error", [-0.02, -0.005, 0.005, 0.02])
def test_keyphasor_decides_where_the_stated_speed_is_wrong(error):
    run = runs.run([(20.0, runs.PAPER_PLANTS["F1"])], 45.0, 2)
    said = diagnoses(detector(speed_rpm=600.0 * (1.0 + error)), run.channels(0.0, 2))
    assert changes(said) == ["N", "F1"]
    assert said[-1].statistics["speed"] == pytest.approx(600.0, rel=1e-3)


@pytest.mark.parametrize("slip", [-0.02, -0.005, 0.005, 0.02])
def test_keyphasor_of_another_shaft_is_named(slip):
    run = runs.run([], 60.0, 4)
    samples = run.channels(0.0, 4)
    samples[:, 2] = keyphasor_voltage(run.motion.revolution * (1.0 + slip))
    said = diagnoses(detector(), samples)
    assert said[-1].quality == "not_ok"
    assert "turns" in said[-1].reason
    assert ("slower" if slip > 0 else "faster") in said[-1].reason
    assert "check the keyphasor's channel" in said[-1].reason


def test_departure_is_said_before_its_cause():
    rules = DecisionRules(settle_revolutions=4.0)
    modes = (RotorMode("N"), RotorMode("F1", 0.10, "alert"), RotorMode("F1L2", 0.06, "danger"))
    run = runs.run([(20.0, runs.PAPER_PLANTS["F1L2"])], 40.0, 5)
    said = diagnoses(detector(modes, rules=rules), run.channels(0.0, 5))
    assert changes(said) == ["N", "F1L2"]
    departures = [d for d in said if d.decision == DEPARTURE]
    first, named = departures[0], next(d for d in said if d.decision == "F1L2")
    assert run.begins[0] < first.revolutions < run.begins[0] + 2.5
    assert named.revolutions > first.revolutions + 1.0
    assert not first.changed
    # A person is told how bad it is at least.
    assert {d.severity for d in departures} <= {"alert", "danger"}
    assert "N" not in first.group
    assert set(departures[-1].group) <= {"F1", "F1L2"}
    assert first.first_index < first.end_index
    assert max(v for k, v in first.evidence.items() if k.startswith("cusum.")) >= rules.threshold_nats
    assert all(a.decision == DEPARTURE for a in said if first.t_ns < a.t_ns < named.t_ns)


def test_calibration_puts_the_measured_machine_into_every_mode():
    machine = plant.PlantParameters(eccentricity=0.125, heavy_spot_deg=70.0, gravity=0.04, side_load=0.05)
    run = runs.run([(45.0, {"damping_ratio": 0.10})], 70.0, 6, healthy=machine)
    samples = run.channels(0.0, 6)
    subject = detector(calibrate_revolutions=20)
    said = diagnoses(subject, samples)
    assert {d.decision for d in said if d.revolutions < 20.0} == {"undetermined"}
    assert changes(said) == ["N", "F1"]
    calibrated = next(d for d in said if d.changed)
    assert 20.0 < calibrated.revolutions < 23.0
    assert calibrated.end_index - calibrated.first_index == pytest.approx(20 * runs.PER_REV, abs=32)
    rotor = subject.bank_modes[0].rotor
    assert rotor.orbit() == pytest.approx(machine.orbit_1x, abs=0.03)
    assert rotor.rest == pytest.approx(0.05 - 0.04j, abs=0.03)
    assert math.degrees(rotor.heavy_spot_rad) == pytest.approx(70.0, abs=5.0)
    # The same machine, without: far from anything that the file knows.
    assert changes(diagnoses(detector(), samples))[:2] != ["N", "F1"]


def test_calibration_does_not_learn_from_a_bad_probe():
    samples = healthy(60.0, seed=7)
    samples[5 * runs.PER_REV : 25 * runs.PER_REV, 0] = 12.5
    said = diagnoses(detector(calibrate_revolutions=20), samples)
    assert changes(said) == ["N"]
    assert next(d for d in said if d.changed).revolutions > 39.0


def test_negative_calibration_is_refused():
    with pytest.raises(ValueError, match="calibrate_revolutions is -1"):
        detector(calibrate_revolutions=-1)


def test_healthy_machine_raises_no_doubt():
    for seed in range(4):
        said = diagnoses(detector(), healthy(60.0, seed=seed, snr_db=-5.0 + 5.0 * seed))
        assert {d.reason for d in said} == {""}


def test_mode_in_physical_units_reaches_the_observer():
    subject = detector(runs.TWELVE_MODES)
    rest = {mode.name: mode.rotor.rest for mode in subject.bank_modes}
    assert rest["L3"] == pytest.approx(-0.3j)
    assert np.isclose(
        abs(subject.bank_modes[2].rotor.orbit()), 1.8 * abs(subject.bank_modes[0].rotor.orbit())
    )
