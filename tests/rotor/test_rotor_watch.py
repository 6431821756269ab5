"""Calibrate, notice, name, and find the way back: a rotor's life in revolutions."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from support.rotor_orbits import HEALTHY, PER_REV, RATE_HZ, ROTOR, SPEED_RAD_S, orbits

from daqsvc.dsp.speed.revolutions import Revolutions
from daqsvc.rotor.laval import LavalRotor, unbalance_response
from daqsvc.rotor.synchronous.baseline import NotCalibratableError, calibrate
from daqsvc.rotor.synchronous.severity import levels
from daqsvc.rotor.synchronous.vectors import synchronous_vectors
from daqsvc.rotor.synchronous.watch import RotorWatch, WatchRules

NOISE_UM = 2.8  # 17 dB


def life(*segments, seed=3, noise_um=NOISE_UM, rules=None, deviation=None, rotor=ROTOR):
    """Reports of a watch over segments of (revolutions, synchronous vector), with abrupt changes."""
    vectors = np.vstack([np.tile(vector, (count, 1)) for count, vector in segments])
    watch = RotorWatch(rotor, RATE_HZ, rules=rules)
    cut = orbits(vectors, noise_um, seed, deviation=deviation)
    return watch, watch.evaluate(synchronous_vectors(cut), cut)


def with_change(**moved):
    vector = HEALTHY.copy()
    for name, value in moved.items():
        vector[("dc", "forward", "backward", "twice", "back_twice").index(name)] += value
    return vector


UNBALANCE = with_change(forward=-0.7 * HEALTHY[1])
LOAD = with_change(dc=6.0 - 4.0j)


def test_a_healthy_rotor_stays_normal():
    watch, reports = life((400, HEALTHY))
    assert not any(report.departed for report in reports)
    assert watch.state == "watching"
    assert watch.finish() is None


def test_the_baseline_is_what_the_rotor_does():
    watch, _ = life((60, HEALTHY))
    calibration = watch.calibration
    deviation = math.sqrt(calibration.noise / PER_REV / calibration.revolutions)
    assert np.abs(calibration.baseline - HEALTHY).max() < 4.0 * deviation
    assert calibration.noise_um == pytest.approx(NOISE_UM, rel=0.05)
    assert calibration.speed_rpm == pytest.approx(600.0)
    assert abs(calibration.eccentricity_um) == pytest.approx(10.0, rel=0.05)
    assert calibration.laval


def test_a_change_is_said_at_once_and_named_after_it_has_settled():
    _, reports = life((100, HEALTHY), (60, UNBALANCE))
    departed = [report for report in reports if report.departed]
    assert [report.revolution for report in departed] == [101]
    assert departed[0].onset_revolution == 101
    named = [report for report in reports if report.identification and report.identification.named]
    assert 108 <= named[0].revolution <= 112
    assert set(named[-1].identification.group) <= {"unbalance", "damping_loss"}
    assert named[-1].identification.verdict == "unbalance"


def test_every_fault_has_its_level():
    watch, _ = life((100, HEALTHY), (60, UNBALANCE))
    report = watch.finish()
    level = levels(report, watch.calibration)["unbalance"]
    assert level["ratio"] == pytest.approx(0.3, abs=0.03)
    assert level["eccentricity_change_um"] == pytest.approx(7.0, rel=0.05)
    watch, _ = life((100, HEALTHY), (60, LOAD))
    level = levels(watch.finish(), watch.calibration)["static_load"]
    assert level["shift_um"] == pytest.approx(abs(6.0 - 4.0j), rel=0.05)
    assert level["shift_deg"] == pytest.approx(math.degrees(math.atan2(-4.0, 6.0)), abs=3.0)
    softer = 1.0 / (0.8 - 1.0 + 0.36j) * 0.36j
    watch, _ = life((100, HEALTHY), (60, with_change(dc=-2.5j, forward=HEALTHY[1] * (softer - 1.0))))
    report = watch.finish()
    assert report.verdict == "stiffness_loss"
    assert levels(report, watch.calibration)["stiffness_loss"]["stiffness"] == pytest.approx(0.8, abs=0.02)


def test_the_damping_that_is_left_is_told():
    less = complex(unbalance_response(1.0, 0.09) / unbalance_response(1.0, 0.18))
    watch, _ = life((100, HEALTHY), (60, with_change(forward=HEALTHY[1] * (less - 1.0))))
    report = watch.finish()
    assert set(report.group) == {"unbalance", "damping_loss"}
    assert levels(report, watch.calibration)["damping_loss"]["damping_ratio"] == pytest.approx(0.09, rel=0.05)


def test_a_second_fault_is_another_change():
    both = UNBALANCE + with_change(dc=9.0) - HEALTHY
    _, reports = life((100, HEALTHY), (80, UNBALANCE), (80, both))
    assert [report.revolution for report in reports if report.departed][:2] == [101, 181]
    last = reports[-1].identification
    assert "normal" not in last.group
    assert last.verdict != "unbalance"


def test_a_machine_that_is_mended_is_normal_again():
    watch, reports = life((100, HEALTHY), (80, UNBALANCE), (120, HEALTHY))
    assert [report.revolution for report in reports if report.departed][:2] == [101, 181]
    assert watch.state == "watching"
    assert reports[-1].identification is None


def test_a_change_too_small_for_a_name_gets_none():
    _, reports = life((200, HEALTHY), (150, with_change(forward=0.03 * HEALTHY[1])), noise_um=0.5)
    assert any(report.departed for report in reports)
    assert reports[-1].identification.group == ("small_change",)


@pytest.mark.long
def test_the_baseline_grows_while_the_machine_is_healthy():
    """What 50 revolutions cannot see, 600 can: the reference is the limit, not patience."""
    small = with_change(forward=0.06 * HEALTHY[1])
    early = sum(
        any(r.departed for r in life((50, HEALTHY), (150, small), seed=s, noise_um=20.0)[1])
        for s in range(10)
    )
    late = sum(
        any(r.departed for r in life((600, HEALTHY), (150, small), seed=s, noise_um=20.0)[1])
        for s in range(10)
    )
    assert late >= early + 3


def test_1x_that_follows_the_speed_is_no_fault():
    deviation = 0.01 * np.sin(2.0 * math.pi * np.arange(400) / 100.0)
    moved = np.tile(HEALTHY, (400, 1))
    moved[:, 1] *= unbalance_response(1.0 + deviation, 0.18) / unbalance_response(1.0, 0.18)
    for known in (0.2, 0.02):
        rotor = replace(ROTOR, natural_frequency_tolerance=known, damping_tolerance=known)
        watch = RotorWatch(rotor, RATE_HZ)
        reports = watch.evaluate(synchronous_vectors(orbits(moved, NOISE_UM, 5, deviation=deviation)))
        assert watch.calibration is not None
        assert not any(report.departed for report in reports)


def test_a_hunting_speed_teaches_what_the_stated_rotor_does_not_know():
    """The stated rotor is another one, and the machine's own backward whirl follows the speed, too."""
    deviation = 0.01 * np.sin(2.0 * math.pi * np.arange(400) / 60.0)
    moved = np.tile(with_change(backward=3.0), (400, 1))
    follows = unbalance_response(1.0 + deviation, 0.18) / unbalance_response(1.0, 0.18)
    moved[:, 1] *= follows
    moved[:, 2] *= 1.0 + 6.0j * deviation
    blind = replace(
        ROTOR, natural_frequency_tolerance=0.05, natural_frequency_hz=1.3 * ROTOR.natural_frequency_hz
    )
    watch = RotorWatch(blind, RATE_HZ, rules=WatchRules(retry=False))
    reports = watch.evaluate(synchronous_vectors(orbits(moved, NOISE_UM, 5, deviation=deviation)))
    assert not any(report.departed for report in reports)
    law = watch.calibration.law
    spread_um = math.sqrt(law.covariance_um2[2, 0, 0])
    assert law.follows_um[0, 2] == pytest.approx(18.0j, abs=3.0 * spread_um + 1.5)
    # What was learnt is no licence to move without the speed; of marks that jitter nothing is learnt.
    jitter = 0.01 * np.diff(np.random.default_rng(3).standard_normal(401))
    steady = RotorWatch(ROTOR, RATE_HZ)
    steady.evaluate(synchronous_vectors(orbits(np.tile(HEALTHY, (400, 1)), NOISE_UM, 5, deviation=jitter)))
    assert steady.calibration.law is None
    moved[200:, 1] *= 1.4
    watch = RotorWatch(blind, RATE_HZ)
    reports = watch.evaluate(synchronous_vectors(orbits(moved, NOISE_UM, 5, deviation=deviation)))
    assert next(report.revolution for report in reports if report.departed) in range(201, 204)


def test_a_rotor_that_follows_its_speed_late_is_no_fault():
    """The calibration sees the speed fall only; while it rises, 1X at the same speed is another."""
    phase = 2.0 * math.pi * np.arange(700) / 120.0
    # Of two modes, the one that dies away more slowly counts: here by 1.7 times.
    late_rev = 1.7 / (2.0 * math.pi * 0.03)
    deviation, late = 0.011 * np.cos(phase), 0.011 * np.cos(phase - 2.0 * math.pi * late_rev / 120.0)
    moved = np.tile(with_change(backward=6.0), (700, 1))
    moved[:, 1] *= unbalance_response(1.0 + late, 0.03) / unbalance_response(1.0, 0.03)
    moved[:, 2] += 300.0 * late
    watch = RotorWatch(replace(ROTOR, damping_ratio=0.03), RATE_HZ)
    reports = watch.evaluate(synchronous_vectors(orbits(moved, 1.0, 5, deviation=deviation)))
    assert watch.calibration.law is not None
    assert not any(report.departed for report in reports)
    # Nor is it a licence: an unbalance that grows by half is still seen.
    moved[300:, 1] *= 1.5
    watch = RotorWatch(replace(ROTOR, damping_ratio=0.03), RATE_HZ)
    reports = watch.evaluate(synchronous_vectors(orbits(moved, 1.0, 5, deviation=deviation)))
    assert next(report.revolution for report in reports if report.departed) in range(301, 331)
    # Over whole swings of the speed the delay cancels: it is not in what the change is judged by.
    assert watch.finish().evidence["unbalance"] > 20.0


def test_a_stiff_rotor_that_turns_slowly_is_not_late():
    """Its free motion dies away within a thousandth of a revolution."""
    stiff = replace(ROTOR, natural_frequency_hz=1000.0 * ROTOR.natural_frequency_hz)
    deviation = 0.01 * np.sin(2.0 * math.pi * np.arange(100) / 60.0)
    cut = orbits(np.tile(HEALTHY, (100, 1)), NOISE_UM, 5, deviation=deviation)
    law = calibrate(synchronous_vectors(cut), stiff, RATE_HZ).law
    fastest = 0.01 * 2.0 * math.pi / 60.0
    assert math.sqrt(law.covariance_um2[:, 1, 1].max()) * fastest < 1e-3 * NOISE_UM
    assert law.off_um.max() < 1e-3 * NOISE_UM


def test_drift_of_the_probes_is_no_static_load():
    drifting = with_change(dc=3.0j)
    _, reports = life((100, HEALTHY), (100, drifting), rules=WatchRules(probe_drift_um=4.0))
    assert not any(report.departed for report in reports)
    _, reports = life((100, HEALTHY), (100, drifting))
    assert reports[-1].identification.verdict == "static_load"


def test_noise_alone_that_gets_louder_is_a_change():
    quiet, loud = np.tile(HEALTHY, (100, 1)), np.tile(HEALTHY, (40, 1))
    parts = [orbits(quiet, 1.0, 1), orbits(loud, 3.0, 2)]
    watch = RotorWatch(ROTOR, RATE_HZ)
    reports = [report for part in parts for report in watch.evaluate(synchronous_vectors(part))]
    assert [report.revolution for report in reports if report.departed][:1] == [101]


def test_a_whirl_that_does_not_keep_step_with_the_shaft_is_no_unbalance():
    """Oil whirl at 0.45 of the speed: 1X may move with it, but no unbalance makes the rest."""
    healthy, after = (
        orbits(np.tile(HEALTHY, (100, 1)), NOISE_UM, 1),
        orbits(np.tile(UNBALANCE, (80, 1)), NOISE_UM, 2),
    )
    turns = np.arange(80 * PER_REV) / PER_REV
    whirl = 12.0 * np.exp(2j * math.pi * 0.45 * turns)
    after.xy[:, 0] += whirl.real
    after.xy[:, 1] += whirl.imag
    watch = RotorWatch(ROTOR, RATE_HZ)
    for part in (healthy, after):
        watch.evaluate(synchronous_vectors(part))
    assert set(watch.finish().group) <= {"unmodelled", "rub"}


# What cannot be a baseline


def refusal(cut, rotor=ROTOR):
    with pytest.raises(NotCalibratableError) as caught:
        calibrate(synchronous_vectors(cut), rotor, RATE_HZ)
    return str(caught.value)


def test_too_few_revolutions_are_no_baseline():
    assert "only 12 usable revolutions" in refusal(orbits(np.tile(HEALTHY, (12, 1))))


@pytest.mark.parametrize("error", [0.005, -0.005, 0.02])
@pytest.mark.parametrize("noise_um", [0.3, 2.8, 20.0])
def test_a_speed_that_is_wrong_is_found_and_told(error, noise_um):
    """Without a keyphasor the angle runs away from the shaft: 1X turns."""
    turns = np.arange(50 * PER_REV) / PER_REV
    true_turns = turns * (1.0 + error)
    z = HEALTHY[0] + HEALTHY[1] * np.exp(2j * math.pi * true_turns)
    rng = np.random.default_rng(2)
    z = z + noise_um * (rng.standard_normal(z.size) + 1j * rng.standard_normal(z.size))
    cut = Revolutions(
        first_index=0,
        xy=np.column_stack((z.real, z.imag)),
        angle_rad=2.0 * math.pi * turns % (2.0 * math.pi),
        starts=np.arange(50) * PER_REV,
        period_samples=np.full(50, float(PER_REV)),
        trusted=np.ones(50, dtype=bool),
    )
    reason = refusal(cut)
    assert "not locked to the shaft" in reason
    speed = float(reason.split("turns at ")[1].split(" rpm")[0])
    assert speed == pytest.approx(600.0 * (1.0 + error), abs=0.6)


def test_an_orbit_that_turns_the_other_way_is_told():
    told = refusal(orbits(np.tile(np.array([0, 0, 20.0, 0, 0]), (50, 1)), NOISE_UM))
    assert "against the stated rotation" in told
    assert "swap" in told


def test_noise_without_an_orbit_is_told():
    assert "no orbit" in refusal(orbits(np.zeros((50, 5)), NOISE_UM))


def test_a_fault_during_calibration_is_refused():
    vectors = np.vstack([np.tile(HEALTHY, (25, 1)), np.tile(LOAD, (25, 1))])
    reason = refusal(orbits(vectors, NOISE_UM))
    assert "not steady: the mean position moves" in reason


def test_a_service_tries_again_and_a_recording_does_not():
    segments = ((25, HEALTHY), (200, LOAD))
    watch, _ = life(*segments)
    assert watch.calibration is not None
    assert abs(watch.calibration.baseline[0] - LOAD[0]) < 0.5
    watch, reports = life(*segments, rules=WatchRules(retry=False))
    assert watch.calibration is None
    assert "not steady" in reports[-1].refused


def test_what_the_model_can_tell_is_said_in_words():
    watch, _ = life((60, HEALTHY))
    assert "behaves like a Laval rotor" in watch.calibration.describe()
    elliptic = HEALTHY.copy()
    elliptic[2] = 8.0
    watch, _ = life((60, elliptic))
    assert "is no Laval rotor (backward over forward 1X is 29 %" in watch.calibration.describe()


def test_a_rotor_that_cannot_be_is_refused():
    for wrong in ({"damping_ratio": 1.2}, {"natural_frequency_hz": 0.0}, {"clearance_um": -1.0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            LavalRotor(**({"natural_frequency_hz": 10.0, "damping_ratio": 0.1} | wrong))


def test_speed_slope_is_that_of_the_response():
    mean, spread = replace(ROTOR, natural_frequency_tolerance=0.0, damping_tolerance=0.0).speed_slope(
        SPEED_RAD_S
    )
    step = unbalance_response(1.001, 0.18) / unbalance_response(1.0, 0.18) - 1.0
    assert mean == pytest.approx(complex(step) / 0.001, rel=0.01)
    assert spread < 1e-9


@pytest.mark.parametrize("begins", [2, 5, 12, 25, 44])
@pytest.mark.parametrize("fault", [UNBALANCE, LOAD, with_change(backward=4.0, twice=2.0)])
def test_a_fault_at_any_time_of_the_calibration_is_refused(begins, fault):
    vectors = np.vstack([np.tile(HEALTHY, (begins, 1)), np.tile(fault, (50 - begins, 1))])
    assert "not steady" in refusal(orbits(vectors, NOISE_UM))


def test_a_burst_during_a_long_calibration_is_refused():
    vectors = np.tile(HEALTHY, (230, 1))
    vectors[100:105] = with_change(backward=4.0, twice=2.0)
    assert re.search("in revolutions 10[012] to 10[456] of 230", refusal(orbits(vectors, NOISE_UM)))


def test_noise_that_grows_during_calibration_is_refused():
    noisy = orbits(np.tile(HEALTHY, (100, 1)), NOISE_UM)
    extra = np.random.default_rng(8).standard_normal((40 * PER_REV, 2))
    noisy.xy[-40 * PER_REV :] += NOISE_UM * extra
    assert "do not repeat with the shaft" in refusal(noisy)


def test_steady_machines_are_calibrated_nearly_always():
    for seed in range(60):
        for noise_um in (0.0, 2.8, 20.0):
            calibrate(synchronous_vectors(orbits(np.tile(HEALTHY, (50, 1)), noise_um, seed)), ROTOR, RATE_HZ)


def test_a_keyphasor_that_misses_every_second_revolution_is_told():
    reason = refusal(orbits(np.tile(np.array([0.0, 0.1, 0.0, 20.0, 0.0]), (50, 1)), 0.3))
    assert "one pulse a revolution" in reason


def test_a_rotor_that_cannot_whirl_like_that_makes_no_names_by_its_model():
    """Revolutions a minute typed for Hz: the eccentricity that it takes is beyond the clearance."""
    watch, _ = life((60, HEALTHY), rotor=replace(ROTOR, natural_frequency_hz=600.0))
    assert not watch.calibration.laval
    assert "more than the clearance: check natural frequency" in watch.calibration.describe()


@pytest.mark.parametrize("order", [0.38, 0.47, 1.6])
def test_a_steady_whirl_is_one_alarm_that_is_held_and_no_fault_of_the_shaft(order):
    """Half a cycle fits five harmonics well: the residual alone does not show it."""
    turns = np.arange(330 * PER_REV) / PER_REV
    cut = orbits(np.tile(HEALTHY, (330, 1)), NOISE_UM, 4)
    whirl = np.where(turns > 100.0, 5.0, 0.0) * np.exp(2j * math.pi * order * turns)
    cut.xy[:, 0] += whirl.real
    cut.xy[:, 1] += whirl.imag
    watch = RotorWatch(ROTOR, RATE_HZ)
    reports = watch.evaluate(synchronous_vectors(cut), cut)
    assert sum(report.departed for report in reports) <= 2
    assert all(report.state == "departed" for report in reports if report.revolution > 105)
    identification = watch.finish()
    assert identification.group == ("unmodelled",)
    assert levels(identification, watch.calibration)["unmodelled"]["nonsynchronous_um"] == pytest.approx(
        4.5, rel=0.4
    )


def test_a_probe_that_gets_noisier_is_no_rub():
    for seed in range(4):
        cut = orbits(np.tile(HEALTHY, (330, 1)), NOISE_UM, seed)
        extra = np.random.default_rng(seed + 50).standard_normal(230 * PER_REV)
        cut.xy[100 * PER_REV :, 0] += 1.8 * NOISE_UM * extra
        watch = RotorWatch(ROTOR, RATE_HZ)
        watch.evaluate(synchronous_vectors(cut), cut)
        assert watch.finish().group == ("unmodelled",)


def test_the_damping_that_is_left_allows_for_what_is_not_known():
    less = complex(unbalance_response(1.0, 0.09) / unbalance_response(1.0, 0.18))
    change = with_change(forward=HEALTHY[1] * (less - 1.0))
    off = replace(ROTOR, natural_frequency_hz=10.0 * 1.18)
    watch, _ = life((100, HEALTHY), (60, change), rotor=off)
    level = levels(watch.finish(), watch.calibration)["damping_loss"]
    assert level["least"] * 0.9 <= 0.09 <= level["most"] * 1.1


def test_a_slow_drift_is_a_few_alarms_and_not_one_each_revolution():
    """A long window shows it; the revolutions of before are no reference for what comes after."""
    drift = [(1, with_change(dc=0.006j * step)) for step in range(500)]
    _, reports = life((150, HEALTHY), *drift)
    departed = [report.revolution for report in reports if report.departed]
    assert departed
    assert np.diff(departed).min(initial=30) >= 30
    assert reports[-1].identification.verdict == "static_load"
