"""What a bank can tell apart, against published figures, laws and limits; and the verb that says it."""

from __future__ import annotations

import argparse
import functools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from support.formats import fits
from support.machine_files import LAVAL, MOTOR, changed

from daqsvc.cli import load
from daqsvc.commands.detectability import DetectabilityCommand
from daqsvc.rotor.detectability.prediction import FAULTS, detectability
from daqsvc.rotor.discretise import BankMode
from daqsvc.rotor.model import NormalisedRotor

AMPLITUDE = 0.1 / (2 * 0.18)
PER_REV = 64
ROTOR = NormalisedRotor(w=1.0, e=0.1, zeta=0.18, g=0.1, contact_stiffness=30.0, alpha=1.0, mu=0.1)


def mode(name, *, q=1e-4, rub=False, **quantities):
    return BankMode(name, replace(ROTOR, **quantities), 0.1 if rub else q, rub)


N, F1, F1L2 = mode("N"), mode("F1", zeta=0.10), mode("F1L2", zeta=0.06)
U2, K1, R = mode("U2", e=0.18), mode("K1", k=0.95), mode("R", zeta=0.02, rub=True)


def noise_at(snr_db):
    """Standard deviation for a ratio of the AC power of one channel of N to the noise."""
    return AMPLITUDE / math.sqrt(2.0) * 10.0 ** (-snr_db / 20.0)


@functools.cache
def foresee(*modes, snr_db=0.0, per_rev=PER_REV, threshold_nats=16.0, **options):
    duration = 2.0 * math.pi / abs(modes[0].rotor.w) / per_rev
    options["threshold_nats"] = np.array(threshold_nats)
    options.setdefault("faults", ())
    return detectability(modes, noise=noise_at(snr_db), duration=duration, **options)


def at_speed(w, *modes):
    return tuple(replace(m, rotor=replace(m.rotor, w=w)) for m in modes)


# Steady evidence of a detector that is told the time of the change: means of 200 simulated seeds.
@pytest.mark.parametrize(
    ("snr_db", "n_f1", "f1_n", "f1l2_f1"),
    [(-5, 10.8, 12.1, 24.0), (-2.5, 16.9, 20.6, 38.0), (0, 24.8, 33.9, 56.0), (2.5, 33.6, 53.0, 76.0),
     (5, 42.0, 78.0, 95.0), (20, 61.0, 192.0, 138.0)],
)  # fmt: skip
def test_evidence_is_that_of_simulated_seeds(snr_db, n_f1, f1_n, f1l2_f1):
    prediction = foresee(N, F1, F1L2, snr_db=snr_db)
    assert prediction.pair("N", "F1").nats_per_rev == pytest.approx(n_f1, rel=0.02)
    assert prediction.pair("F1", "N").nats_per_rev == pytest.approx(f1_n, rel=0.02)
    assert prediction.pair("F1L2", "F1").nats_per_rev == pytest.approx(f1l2_f1, rel=0.02)


@pytest.mark.parametrize(
    ("snr_db", "f1", "f1l2"), [(-5, 3.18, 2.95), (-2.5, 2.42, 2.34), (0, 1.88, 1.92), (5, 1.25, 1.34)]
)
def test_delay_is_near_the_median_of_simulated_seeds(snr_db, f1, f1l2):
    prediction = foresee(N, F1, F1L2, snr_db=snr_db)
    assert prediction.pair("F1", "N").delay_rev == pytest.approx(f1, rel=0.15)
    assert prediction.pair("F1L2", "F1").delay_rev == pytest.approx(f1l2, rel=0.15)


@pytest.mark.parametrize(("w", "nats"), [(0.8, 7.7), (0.9, 11.0), (1.1, 16.0), (1.2, 21.0)])
def test_unbalance_and_damping_part_off_resonance(w, nats):
    prediction = foresee(*at_speed(w, N, U2, F1))
    assert prediction.pair("F1", "U2").nats_per_rev == pytest.approx(nats, rel=0.03)
    assert prediction.ambiguities == ()


def test_unbalance_and_damping_look_the_same_at_resonance():
    prediction = foresee(N, U2, F1)
    (ambiguity,) = prediction.ambiguities
    assert ambiguity.modes == ("U2", "F1")
    assert ambiguity.nats_per_rev == pytest.approx(0.0, abs=0.01)
    assert prediction.pair("U2", "F1").delay_rev == math.inf
    assert prediction.pair("U2", "N").delay_rev < 3.0
    # It opens where it says, as much as it says, and not a step nearer; the sampling rate stays.
    w = ambiguity.opens_at_w
    duration = 2.0 * math.pi / PER_REV
    there, nearer = (
        detectability(
            at_speed(v, N, U2, F1), noise=noise_at(0), duration=duration, threshold_nats=16.0, faults=()
        )
        for v in (w, w - math.copysign(0.01, w - 1.0))
    )
    for truth, rival in (("U2", "F1"), ("F1", "U2")):
        assert there.pair(truth, rival).nats_per_rev >= ambiguity.open_nats_per_rev - 0.05 > 0.9
    assert min(nearer.pair("U2", "F1").nats_per_rev, nearer.pair("F1", "U2").nats_per_rev) < 1.0


def test_no_confidence_from_how_a_machine_shakes():
    # With little sensor noise the modes differ in their answer to process noise, if it is what is assumed;
    # in a calmer machine the same evidence points the wrong way.
    assert foresee(N, U2, F1, snr_db=20).pair("F1", "U2").nats_per_rev > 0.3
    assert foresee(N, U2, F1, snr_db=20, process_noise=1e-6).pair("F1", "U2").nats_per_rev < 0.0
    for found in (foresee(N, U2, F1, snr_db=20), foresee(N, U2, F1, snr_db=20, process_noise=1e-6)):
        assert [a.modes for a in found.ambiguities] == [("U2", "F1")]


def test_stiffness_loss_shows_only_near_resonance():
    best = foresee(N, K1).pair("K1", "N").nats_per_rev
    assert 0.7 < best < 1.1
    for w in (0.8, 1.5):
        assert foresee(*at_speed(w, N, K1)).pair("K1", "N").nats_per_rev < 0.25 * best


def test_sampling_rate_is_of_no_use_at_one_noise_density():
    slow = foresee(N, F1, F1L2)
    fast = foresee(N, F1, F1L2, per_rev=2 * PER_REV, snr_db=-10.0 * math.log10(2.0))
    for pair in slow.pairs:
        other = fast.pair(pair.truth, pair.rival)
        assert other.nats_per_rev == pytest.approx(pair.nats_per_rev, rel=0.01)
        assert other.delay_rev == pytest.approx(pair.delay_rev, rel=0.05)


def test_clockwise_is_the_same():
    forward, backward = foresee(N, F1, U2), foresee(*at_speed(-1.0, N, F1, U2))
    for pair in forward.pairs:
        other = backward.pair(pair.truth, pair.rival)
        assert other.nats_per_rev == pytest.approx(pair.nats_per_rev, rel=1e-6)
        assert other.delay_rev == pytest.approx(pair.delay_rev, rel=1e-6)


def test_a_bank_that_trusts_its_models_less_gathers_less():
    # Orbits a long way apart: all but nothing is in the variances.
    far, sceptical = foresee(N, F1L2), foresee(N, F1L2, variance_factor=1.5)
    pair, other = far.pair("F1L2", "N"), sceptical.pair("F1L2", "N")
    assert other.nats_per_rev == pytest.approx(pair.nats_per_rev / 1.5, rel=0.02)
    assert other.delay_rev > pair.delay_rev


def test_thresholds_belong_to_transitions():
    thresholds = ((0.0, 10.0, 10.0), (30.0, 0.0, 10.0), (30.0, 30.0, 0.0))
    prediction = foresee(N, F1, F1L2, threshold_nats=thresholds)
    assert {p.threshold_nats for p in prediction.pairs if p.rival == "N"} == {10.0}
    assert prediction.pair("N", "F1").threshold_nats == 30.0
    assert (
        prediction.pair("N", "F1").delay_rev > foresee(N, F1, threshold_nats=10.0).pair("N", "F1").delay_rev
    )
    assert prediction.false_alarms_per_1000_rev == pytest.approx(1000 * PER_REV * 2 * math.exp(-10.0))


@pytest.mark.parametrize("snr_db", [0.0, 10.0])
@pytest.mark.parametrize("calibration_rev", [20.0, 50.0])
def test_synchronous_vector_is_limited_by_its_calibration(snr_db, calibration_rev):
    prediction = foresee(
        N,
        F1,
        snr_db=snr_db,
        calibration_rev=calibration_rev,
        process_noise=1e-12,
        faults=("unbalance", "static_load"),
    )
    unbalance, load = prediction.smallest
    delta = math.sqrt(20.0 / (calibration_rev * PER_REV * 10.0 ** (snr_db / 10.0)))
    delta = math.hypot(delta, math.sqrt(20.0) * 0.002)  # no baseline is believed better than 0.2 %
    assert (unbalance.fault, unbalance.healthy) == ("unbalance", 1.0)
    assert unbalance.by_vector - 1.0 == pytest.approx(delta, rel=0.03)
    assert (load.fault, load.healthy) == ("static_load", 0.0)
    assert load.by_vector == pytest.approx(delta * AMPLITUDE, rel=0.03)


def test_smallest_change_takes_as_long_as_it_says():
    prediction = foresee(N, F1, within_rev=40.0, faults=FAULTS)
    changes = {change.fault: change.by_bank for change in prediction.smallest}
    for just in (
        mode("unbalance", e=0.1 * changes["unbalance"]),
        mode("damping_loss", zeta=changes["damping_loss"]),
        mode("stiffness_loss", k=changes["stiffness_loss"]),
        mode("static_load", g=0.1 + changes["static_load"]),
    ):
        assert foresee(N, just).pair(just.name, "N").delay_rev == pytest.approx(40.0, rel=0.05), just.name
    (later,) = foresee(N, F1, within_rev=400.0, faults=("damping_loss",)).smallest
    assert 0.18 > later.by_bank > changes["damping_loss"]


def test_ac_coupled_probes_see_no_static_load():
    (load,) = foresee(N, F1, ac_coupled=True, faults=("static_load",)).smallest
    assert (load.by_bank, load.by_vector) == (None, None)


def test_rub_is_simulated_and_says_so():
    prediction = foresee(N, F1, R)
    assert {(p.truth, p.rival) for p in prediction.pairs if p.simulated} == {
        ("N", "R"), ("R", "N"), ("F1", "R"), ("R", "F1")
    }  # fmt: skip
    assert prediction == foresee.__wrapped__(N, F1, R)
    # The flexible observer of the rub is a weak rival; the rub itself is nothing like a steady orbit.
    assert 5.0 < prediction.pair("N", "R").nats_per_rev < 20.0
    assert prediction.pair("R", "N").nats_per_rev > 200.0
    assert 0.5 < prediction.pair("R", "F1").delay_rev < 2.0
    # Fast sampling does not make a simulation long, nor the figures different.
    fast = foresee(N, R, per_rev=1000, snr_db=-10.0 * math.log10(1000 / PER_REV))
    assert fast.pair("R", "N").nats_per_rev == pytest.approx(prediction.pair("R", "N").nats_per_rev, rel=0.1)


def test_linear_mode_that_would_touch_is_named():
    assert foresee(N, F1L2).touching == ()
    assert foresee(N, mode("loose", zeta=0.04)).touching == ("loose",)


@pytest.mark.parametrize(
    ("modes", "words"),
    [((N,), "two modes"), ((R, N), "healthy one first"), (at_speed(0.0, N, F1), "turning shaft")],
)
def test_what_is_no_bank_is_refused(modes, words):
    with pytest.raises(ValueError, match=words):
        detectability(modes, noise=0.1, duration=0.1, threshold_nats=16.0)


def test_a_fault_that_would_make_the_machine_whirl_by_itself_is_seen_before_that():
    # Cross stiffness drives whirl, so 60 % of the damping is the least that this machine can run with.
    driven = {"anisotropy": 0.05, "cross_stiffness": 0.108 * 2.0}
    n, u = mode("N", **driven), mode("U", e=0.15, **driven)
    (damping,) = foresee(n, u, snr_db=20.0, faults=("damping_loss",)).smallest
    assert damping.by_bank is not None
    assert 0.6 * 0.18 <= damping.by_bank < 0.18


def test_rub_without_bounded_motion_is_refused():
    soft = mode("soft", zeta=0.01, contact_stiffness=1e-3, rub=True)
    with pytest.raises(ValueError, match="'soft' the disc leaves its housing"):
        foresee(N, soft)


def verb(*arguments):
    command = DetectabilityCommand(load, lambda: None)
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args([str(argument) for argument in arguments]))


@pytest.fixture(scope="module")
def two_look_alike(tmp_path_factory):
    """A machine file with a mode of unbalance that looks like one of lost damping at resonance."""
    text, _ = changed(
        LAVAL,
        ('  { name = "F1L3", damping_ratio = 0.02, severity = "danger", rub = true },\n', ""),
        ('{ name = "F1L2", damping_ratio = 0.06', '{ name = "U2", unbalance_ratio = 1.8'),
    )
    file = tmp_path_factory.mktemp("machine") / "rig.toml"
    file.write_text(text, encoding="utf-8")
    return file


def test_verb_tells_what_looks_the_same_and_where_it_does_not(two_look_alike, capsys):
    assert verb(two_look_alike) == 0
    output = capsys.readouterr().out
    assert "F1 and U2 cannot be told apart at 600 rpm; at 6" in output
    assert "nats a revolution." in output
    assert max(map(len, output.splitlines())) <= 110
    assert verb(two_look_alike, "--speed-rpm", 540) == 0
    output = capsys.readouterr().out
    assert "laval-rig at 540 rpm" in output
    assert "All modes can be told apart at 540 rpm" in output


def test_verb_as_json_in_the_units_of_the_file(two_look_alike, capsys):
    assert verb(two_look_alike, "--json", "--false-alarms-per-1000-rev", 0.5, "--process-noise", 1e-9) == 0
    output = fits("daqsvc detectability", json.loads(capsys.readouterr().out))
    assert (output["machine"], output["speed_rpm"], output["noise_um"]) == ("laval-rig", 600.0, 2.0)
    assert output["modes"] == ["N", "F1", "U2"]
    assert output["false_alarms_per_1000_rev"] == pytest.approx(0.5)
    pairs = {(pair["truth"], pair["rival"]): pair for pair in output["pairs"]}
    assert len(pairs) == 6
    assert pairs["F1", "N"]["threshold_nats"] == pytest.approx(math.log(1000 * 64 * 2 / 0.5))
    assert pairs["F1", "U2"]["delay_rev"] is None
    (ambiguous,) = output["ambiguous"]
    assert 420.0 < ambiguous["opens_at_rpm"] < 780.0
    changes = {change["fault"]: change for change in output["smallest_change"]}
    assert list(changes) == ["unbalance", "damping_loss", "stiffness_loss", "static_load"]
    # sqrt(20 / (50 * 64 * SNR)) of the 1X amplitude, and the floor of 0.2 % of it.
    amplitude_um = 100.0 * AMPLITUDE
    delta_um = math.hypot(
        math.sqrt(20 / (50 * 64)) * math.sqrt(2.0) * 2.0, math.sqrt(20) * 0.002 * amplitude_um
    )
    assert changes["static_load"]["unit"] == "um"
    assert changes["static_load"]["by_vector"] == pytest.approx(delta_um, rel=0.03)
    assert changes["stiffness_loss"]["healthy"] == 100.0
    assert 90.0 < changes["stiffness_loss"]["by_bank"] < 100.0


def test_verb_without_a_bank_says_what_is_missing(capsys):
    assert verb(MOTOR) == 2
    assert "[pipeline.rotor_bank]" in capsys.readouterr().err


@pytest.mark.parametrize("value", ["-3", "0", "nan", "fast"])
def test_verb_refuses_numbers_that_mean_nothing(value, capsys):
    with pytest.raises(SystemExit):
        verb(LAVAL, f"--speed-rpm={value}")
    assert f"'{value}' is not a number above 0" in capsys.readouterr().err
