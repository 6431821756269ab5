"""The rotor bank as a detector: from raw channels to diagnoses, with all that can be wrong with them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.rotor_runs import damping_bank
from support.shaft_channels import (
    FIRST,
    channels_of,
    dead,
    feed,
    gone,
    half_gone,
    infinite,
    keyphasor_of_wrong_bits,
    no_keyphasor,
)

from daqsvc.diagnosis.detector import Window
from daqsvc.rotor.decision import DecisionRules
from sim_hw.plants import rotor as plant

PER_REV = 64
RATE_HZ = 640.0
PERIOD_NS = 1e9 / RATE_HZ
NOISE_UM = 19.6


def detector(**options):
    return damping_bank(RATE_HZ, NOISE_UM, **options)


def channels(changes=(), *, revolutions=20.0, w=1.0, angles=(0.0, 90.0), seed=0, noise_um=NOISE_UM):
    """Float32 ``[n, 3]`` of a simulated rotor; ``changes`` are pairs of revolution and damping ratio."""
    steps = [plant.Change(at, plant.PlantParameters(damping_ratio=z, speed_ratio=w)) for at, z in changes]
    motion = plant.simulate(
        plant.PlantParameters(speed_ratio=w), steps, revolutions=revolutions, samples_per_rev=PER_REV / w
    )
    return channels_of(motion, noise_um, seed, angles)


def run(subject, samples, *, block=16, first_index=FIRST):
    return feed(subject, samples, RATE_HZ, block=block, first_index=first_index)


def decisions(diagnoses):
    return [said.decision for said in diagnoses if said.changed]


@pytest.fixture(scope="module")
def worn():
    """A rotor that loses damping in one step after 15 revolutions."""
    return channels([(15.0, 0.10)], revolutions=30.0)


def test_diagnosis_each_revolution_and_at_each_change(worn):
    subject = detector()
    said = run(subject, worn)
    assert decisions(said) == ["N", "F1"]
    progress = [d for d in said if not d.changed]
    assert 29 <= len(progress) <= 30
    assert [d.end_index - d.first_index for d in progress[2:]] == pytest.approx(
        [PER_REV] * len(progress[2:]), abs=16
    )
    for d in said:
        assert (d.machine, d.detector, d.stream) == ("rig", "rotor-bank", "shaft")
        assert d.sensors == ("probe-x", "probe-y", "keyphasor")
        assert d.quality == "good"
        assert sum(d.probabilities.values()) == pytest.approx(1.0)
        assert d.t_ns == pytest.approx((d.end_index - 1) * PERIOD_NS, abs=1000)
    # It says so in the window that it finds it in.
    change = said[[d.decision for d in said].index("F1")]
    assert change.changed
    assert change.severity == "alert"
    assert 15.0 < change.revolutions < 18.0
    assert change.revolutions == pytest.approx((change.end_index - FIRST) / PER_REV, abs=0.1)
    assert FIRST + 15 * PER_REV <= change.first_index < change.end_index
    assert change.evidence["lead.N"] >= change.thresholds["cusum"]
    assert said[-1].statistics["speed"] == pytest.approx(600.0, rel=1e-3)
    assert said[0].decision == "undetermined"


def test_says_the_same_however_the_samples_are_cut(worn):
    one = run(detector(), worn)
    assert one == run(detector(), worn, block=16 * 7)
    assert one == run(detector(), worn, block=len(worn))


def test_paper_rule_never_has_a_severity(worn):
    said = run(detector(rules=DecisionRules(rule="paper")), worn)
    assert {"N", "F1"} <= set(decisions(said))
    assert {d.severity for d in said} == {"normal"}


@pytest.mark.parametrize("angles", [(45.0, 135.0), (-30.0, 90.0), (90.0, 0.0)])
def test_probes_may_point_anywhere(angles):
    said = run(detector(angles=angles), channels([(15.0, 0.10)], revolutions=30.0, angles=angles))
    assert decisions(said) == ["N", "F1"]


def test_probes_in_one_direction_are_refused():
    with pytest.raises(ValueError, match=r"'probe-x' at 0\.0 and 'probe-y' at 170\.0"):
        detector(angles=(0.0, 170.0))


def test_speed_comes_from_the_keyphasor():
    # The machine file says 600 rpm, the shaft makes 570: away from resonance all orbits are others.
    said = run(detector(), channels([(15.0, 0.10)], revolutions=35.0, w=0.95))
    assert decisions(said) == ["N", "F1"]
    assert said[-1].statistics["speed"] == pytest.approx(570.0, rel=1e-3)


def test_clockwise_shaft():
    samples = channels([(15.0, 0.10)], revolutions=30.0, angles=(0.0, 90.0))
    samples[:, 0] *= -1.0
    # Mirrored in x, the disc turns clockwise and its heavy spot lies at 180 degrees: turn the mark there.
    said = run(detector(angles=(180.0, 90.0)), samples)
    assert decisions(said) == ["N", "F1"]
    mirrored = detector(speed_rpm=-600.0)
    samples[:, 0] *= -1.0
    samples[:, 1] = -samples[:, 1] - 20.0
    assert decisions(run(mirrored, samples)) == ["N", "F1"]


def test_short_gap_is_predicted_through(worn):
    subject = detector()
    begin, end = 10 * PER_REV + 5, 10 * PER_REV + 45
    said = run(subject, worn[:begin]) + run(subject, worn[end:], first_index=FIRST + end)
    assert decisions(said) == ["N", "F1"]
    change = next(d for d in said if d.decision == "F1")
    assert 15.0 < (change.end_index - FIRST) / PER_REV < 18.0
    assert change.revolutions == pytest.approx((change.end_index - FIRST) / PER_REV, abs=0.1)


@pytest.mark.parametrize("gap_rev", [1.3, 7.6, 100.25])
def test_decision_is_held_over_a_long_gap(gap_rev):
    samples = channels([(15.0, 0.02)], revolutions=150.0)
    subject = detector()
    begin, end = 30 * PER_REV, round((30 + gap_rev) * PER_REV)
    before = run(subject, samples[:begin])
    assert before[-1].decision == "F1L3"
    after = run(subject, samples[end:], first_index=FIRST + end)
    assert decisions(after) == []
    assert {d.decision for d in after} == {"F1L3"}


def test_device_that_starts_over_does_not_change_the_decision(worn):
    subject = detector()
    run(subject, worn[: 14 * PER_REV])
    assert decisions(run(subject, worn[: 14 * PER_REV], first_index=0)) == []


def test_empty_window_says_nothing():
    nothing = Window(FIRST, np.empty((0, 3), dtype=np.float32), 0, PERIOD_NS)
    assert list(detector().process(nothing)) == []


def spoilt(worn, spoil, begin_rev=8.0, end_rev=30.0):
    samples = worn.copy()
    spoil(samples[round(begin_rev * PER_REV) : round(end_rev * PER_REV)])
    return samples


def nearly_dead(part):
    part[:, 1] *= 0.01


def clipped(part):
    np.clip(part[:, 0], -15.0, 15.0, out=part[:, 0])


def at_the_rail(part):
    np.minimum(part[:, 1], 5.0, out=part[:, 1])


def keyphasor_gone(part):
    part[:, 2] = np.nan


@pytest.mark.parametrize(
    ("spoil", "quality", "reason"),
    [
        (dead, "not_ok", "probe-x: stuck at 12.5 um"),
        (nearly_dead, "not_ok", "probe-y: moved by"),
        (clipped, "not_ok", "probe-x: clipped at -15"),
        (at_the_rail, "not_ok", "probe-y: clipped at 5"),
        (gone, "missing", "probe-x: "),
        (infinite, "missing", "probe-y: "),
        (half_gone, "missing", "of 64 samples of a revolution are missing"),
        (no_keyphasor, "missing", "keyphasor: no pulse"),
        (keyphasor_gone, "missing", "keyphasor: no pulse"),
        (keyphasor_of_wrong_bits, "not_ok", "keyphasor holds 3e+30 at sample"),
    ],
)
def test_bad_sensor_is_named_and_the_decision_held(worn, spoil, quality, reason):
    said = run(detector(), spoilt(worn, spoil, 8.0, 30.0))
    # The damping goes at revolution 15, unseen.
    assert decisions(said) == ["N"]
    late = [d for d in said if d.revolutions > 13.0]
    assert len(late) > 15
    for d in late:
        assert d.quality == quality
        assert reason in d.reason
        assert ";" in d.reason, "the remedy follows the finding"
        assert d.decision == "N"


@pytest.mark.parametrize("spoil", [dead, clipped, gone, no_keyphasor])
def test_sensor_that_comes_back_is_believed_again(worn, spoil):
    said = run(detector(), spoilt(worn, spoil, 8.0, 20.0))
    assert decisions(said) == ["N", "F1"]
    assert said[-1].quality == "good"
    assert said[-1].reason == ""
    assert next(d for d in said if d.decision == "F1").revolutions > 20.0


def test_coarse_converter_is_not_taken_for_a_clipped_probe():
    samples = channels(revolutions=20.0, noise_um=2.0)
    samples[:, :2] = 2.0 * np.round(samples[:, :2] / 2.0)
    assert {d.quality for d in run(detector(), samples)} == {"good"}


def test_keyphasor_that_never_comes_is_said_after_three_revolutions(worn):
    said = run(detector(), spoilt(worn, no_keyphasor, 0.0, 30.0))
    assert {d.decision for d in said} == {"undetermined"}
    assert {d.quality for d in said if d.revolutions > 4.0} == {"missing"}


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, 3e38])
def test_no_data_makes_it_raise(value):
    subject = detector()
    run(subject, channels(revolutions=5.0))
    rubbish = np.full((10 * PER_REV, 3), value, dtype=np.float32)
    said = run(subject, rubbish, first_index=FIRST + 5 * PER_REV)
    assert said[-1].quality != "good"
    assert said[-1].reason


def test_warming_leaves_no_trace(worn):
    cold, warm = detector(), detector()
    warm.warm()
    assert run(cold, worn[: 10 * PER_REV]) == run(warm, worn[: 10 * PER_REV])


def test_block_is_a_quarter_of_a_revolution():
    assert detector().block == PER_REV // 4
    assert detector(speed_rpm=1200.0).block == PER_REV // 8


@pytest.mark.parametrize("speed_rpm", [0.0, math.nan, math.inf])
def test_speed_that_cannot_be_followed_is_refused(speed_rpm):
    with pytest.raises(ValueError, match="rig"):
        detector(speed_rpm=speed_rpm)
