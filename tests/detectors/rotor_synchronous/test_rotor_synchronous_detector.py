"""The calibrated rotor as a detector: from raw channels to diagnoses, with all that can go wrong."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
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

from daqsvc.detectors.rotor_synchronous.detector import RotorSynchronousDetector
from daqsvc.diagnosis.detector import Window
from daqsvc.dsp.probes import Probe
from daqsvc.dsp.speed.keyphasor import KeyphasorProbe
from daqsvc.rotor.laval import LavalRotor
from daqsvc.rotor.model import RotorParameters, TwoModes
from daqsvc.rotor.synchronous.watch import RotorWatch, WatchRules
from sim_hw.plants import rotor as plant
from sim_hw.plants.rotor import keyphasor_voltage

PER_REV = 64
RATE_HZ = 1600.0
RPM = 1500.0
PERIOD_NS = 1e9 / RATE_HZ
NOISE_UM = 2.0
W = 0.8
HEALTHY = {"speed_ratio": W, "damping_ratio": 0.11}
ROTOR = LavalRotor(natural_frequency_hz=31.0, damping_ratio=0.10, clearance_um=100.0, static_sag_um=10.0)
KEYPHASOR = KeyphasorProbe("keyphasor", 2, -6.0)
CHANGE_REV = 70.3


def detector(*, angles=(0.0, 90.0), speed_rpm=RPM, reference=KEYPHASOR, rotor=ROTOR, unit=1.0, **options):
    return RotorSynchronousDetector(
        machine="pump",
        stream="shaft",
        rate_hz=RATE_HZ,
        speed_rpm=speed_rpm,
        probes=(Probe("probe-x", 0, angles[0], unit), Probe("probe-y", 1, angles[1], unit)),
        reference=reference,
        rotor=rotor,
        **options,
    )


def channels(*changes, revolutions=110.0, seed=0, noise_um=NOISE_UM, w=W, angles=(0.0, 90.0)):
    """Float32 ``[n, 3]`` of a simulated rotor; changes are pairs of revolution and parameters."""
    steps = [plant.Change(at, plant.PlantParameters(**{**HEALTHY, **new})) for at, new in changes]
    motion = plant.simulate(
        plant.PlantParameters(**{**HEALTHY, "speed_ratio": w}),
        steps,
        revolutions=revolutions,
        samples_per_rev=PER_REV * W / w,
    )
    return channels_of(motion, noise_um, seed, angles)


def run(subject, samples, *, block=PER_REV, first_index=FIRST):
    return feed(subject, samples, RATE_HZ, block=block, first_index=first_index)


def course(diagnoses):
    """The decisions in order, without repeats."""
    found = [said.decision for said in diagnoses]
    return [new for old, new in zip([None, *found], found, strict=False) if new != old]


@pytest.fixture(scope="module")
def grown():
    """A rotor whose unbalance grows by three quarters in one step."""
    return channels((CHANGE_REV, {"eccentricity": 0.175}))


@pytest.fixture(scope="module")
def steady():
    return channels(revolutions=130.0, seed=1)


@pytest.fixture(scope="module")
def softer():
    """A shaft that loses stiffness: its 1X grows and it sags deeper."""
    return channels((CHANGE_REV, {"stiffness": 0.85}), revolutions=130.0, seed=2)


def test_what_a_hunting_speed_teaches_later_is_kept_for_the_next_start(monkeypatch):
    """The kept baseline would else allow for ever what one swing left uncertain."""
    turns = np.arange(190 * PER_REV) / PER_REV
    turns += 0.01 * 40.0 / (2.0 * math.pi) * np.sin(2.0 * math.pi * turns / 40.0)
    angle = 2.0 * math.pi * turns
    z = 10.0j + 20.0 * np.exp(1j * angle) + 2.0 * np.exp(-1j * angle)
    noise = np.random.default_rng(2).standard_normal((3, len(z)))
    volts = keyphasor_voltage(turns) + 0.02 * noise[2]
    samples = np.column_stack((z.real + noise[0], z.imag + noise[1], volts)).astype(np.float32)
    kept = []
    for_another_start = RotorWatch.learnt.fget
    given = []

    def learnt(watch):
        given.append(for_another_start(watch))
        return given[-1]

    monkeypatch.setattr(RotorWatch, "learnt", property(learnt))
    run(detector(keep=kept.append), samples)
    # The watch knows which baseline is for another start: after an alarm it is not the one that it judges by.
    assert all(any(one is other for other in given) for one in kept[1:])
    assert len(kept) == 4  # at about 50, 75, 112 and 168 revolutions
    doubts = [float(one.law.variance_um2(np.array([0.0, 1e-3, 0.0]))[1]) for one in kept]
    assert doubts == sorted(doubts, reverse=True)
    assert doubts[0] > 4.0 * doubts[-1]


def test_a_change_is_told_at_once_and_named_when_it_has_settled(grown):
    subject = detector()
    said = run(subject, grown)
    assert course(said) == ["undetermined", "normal", "departure", "unbalance"]
    departed, named = (next(d for d in said if d.decision == name) for name in ("departure", "unbalance"))
    assert CHANGE_REV < departed.revolutions + 1.0 < CHANGE_REV + 4.0
    assert named.revolutions < CHANGE_REV + 14.0
    assert departed.changed
    assert named.changed
    assert (departed.severity, named.severity) == ("alert", "alert")
    assert set(named.group) == {"unbalance", "damping_loss"}
    # The evidence begins where the change did, and ends with a revolution.
    assert (departed.first_index - FIRST) / PER_REV == pytest.approx(CHANGE_REV, abs=2.0)
    assert (departed.end_index - FIRST) / PER_REV < CHANGE_REV + 3.0
    assert departed.statistics["departure"] > departed.thresholds["departure"]
    assert named.evidence["unbalance"] > 50.0
    assert named.statistics["severity"] == pytest.approx(0.75, abs=0.15)
    for d in said:
        assert (d.machine, d.detector, d.stream) == ("pump", "rotor-synchronous", "shaft")
        assert d.sensors == ("probe-x", "probe-y", "keyphasor")
        assert (d.quality, d.reason) == ("good", "")
        assert sum(d.probabilities.values()) == pytest.approx(1.0 if d.probabilities else 0.0)
        assert set(d.units) <= set(d.statistics)
        assert d.first_index <= d.end_index
        assert d.t_ns == pytest.approx((d.end_index - 1) * PERIOD_NS, abs=1000)
    last = said[-1].statistics
    orbit = abs(plant.PlantParameters(**HEALTHY, eccentricity=0.175).orbit_1x) * 100.0
    assert last["1x.amplitude"] == pytest.approx(orbit, rel=0.03)
    assert (last["mean.x"], last["mean.y"]) == pytest.approx((0.0, -10.0), abs=0.5)
    assert last["speed"] == pytest.approx(RPM, rel=1e-3)
    # How large it is, for each member of the group: unbalance times 1.75.
    assert last["unbalance.ratio"] == pytest.approx(1.75, rel=0.05)
    assert last["unbalance.eccentricity_change_um"] == pytest.approx(7.5, rel=0.3)
    assert said[-1].units["unbalance.eccentricity_change_um"] == "um"
    assert "unbalance.ratio" not in said[-1].units
    assert last["damping_loss.damping_ratio"] < 0.11


def test_at_most_one_statement_a_revolution_and_one_a_second_while_nothing_changes(steady):
    said = run(detector(), steady)
    assert len({d.end_index for d in said}) == len(said)
    healthy = [d.end_index for d in said if d.decision == "normal"]
    assert np.diff(healthy) == pytest.approx(RATE_HZ, abs=PER_REV + 1)
    assert len(said) < 10


def test_says_the_same_however_the_samples_are_cut(grown):
    one = run(detector(), grown)
    for block in (16, 1000, len(grown)):
        other = run(detector(), grown, block=block)
        assert [(d.decision, d.end_index, d.quality) for d in other] == [
            (d.decision, d.end_index, d.quality) for d in one
        ]


@pytest.mark.parametrize("reference", ["fixed", "orbit"])
def test_does_without_a_keyphasor(grown, reference):
    said = run(detector(reference=reference), grown)
    assert course(said) == ["undetermined", "normal", "departure", "unbalance"]
    assert said[-1].sensors == ("probe-x", "probe-y")


@pytest.mark.parametrize("angles", [(45.0, 135.0), (-30.0, 90.0), (90.0, 0.0)])
def test_probes_may_point_anywhere(angles):
    samples = channels((CHANGE_REV, {"eccentricity": 0.175}), angles=angles)
    said = run(detector(angles=angles), samples)
    assert course(said) == ["undetermined", "normal", "departure", "unbalance"]
    assert said[-1].statistics["mean.y"] == pytest.approx(-10.0, abs=1.0)


def test_probes_may_measure_in_mil(grown):
    samples = grown.copy()
    samples[:, :2] /= 25.4
    said = run(detector(unit=25.4), samples)
    assert said[-1].statistics["1x.amplitude"] == pytest.approx(
        run(detector(), grown)[-1].statistics["1x.amplitude"], rel=1e-4
    )


def test_a_clockwise_shaft_still_hangs_down(softer):
    """Seen from its other end, gravity points the same way: stiffness loss is told by the deeper sag."""
    ccw = run(detector(), softer)
    assert "stiffness_loss" in {ccw[-1].decision, *ccw[-1].group}
    samples = softer.copy()
    samples[:, 0] *= -1.0
    cw = run(detector(speed_rpm=-RPM), samples)
    assert (cw[-1].decision, cw[-1].group) == (ccw[-1].decision, ccw[-1].group)
    here, there = cw[-1].statistics, ccw[-1].statistics
    assert here["mean.y"] == pytest.approx(there["mean.y"])
    assert here["mean.x"] == pytest.approx(-there["mean.x"], abs=1e-6)
    assert (here["1x.phase"] + there["1x.phase"]) % 360.0 == pytest.approx(180.0)
    loss = "stiffness_loss.stiffness"
    assert here[loss] == pytest.approx(there[loss])
    assert there[loss] == pytest.approx(0.85, abs=0.06)


def test_returns_to_normal():
    samples = channels((70.3, {"eccentricity": 0.175}), (110.7, {}), revolutions=150.0)
    said = run(detector(), samples)
    assert course(said) == ["undetermined", "normal", "departure", "unbalance", "normal"]
    assert said[-1].severity == "normal"


def test_a_large_change_is_danger():
    said = run(detector(), channels((CHANGE_REV, {"eccentricity": 0.3})))
    assert said[-1].decision == "unbalance"
    assert said[-1].severity == "danger"


def test_a_calibration_of_an_earlier_time_begins_at_once(steady, grown):
    first = detector()
    run(first, steady)
    said = run(detector(calibration=first.watch.calibration), grown[30 * PER_REV :])
    assert course(said) == ["normal", "departure", "unbalance"]
    assert said[-1].statistics["calibration.revolutions"] == 50.0


def test_a_pulse_with_sharp_edges_is_no_change_at_the_start_of_the_next_recording():
    """Its edges lie anywhere between two samples, until each is placed by those around it."""
    rng = np.random.default_rng(3)
    turns = np.arange(round(300 * 102.4)) / 102.4 + 0.3
    whirl = 40.0 * np.exp(2j * np.pi * turns) - 15.0j
    noise_um = 0.5 * rng.standard_normal((2, len(turns)))
    pulse = np.where(np.mod(turns, 1.0) < 0.06, -2.0, -10.0)
    recorded = np.stack([whirl.real + noise_um[0], whirl.imag + noise_um[1], pulse], axis=1)
    samples = recorded.astype(np.float32)
    healthy = detector(speed_rpm=RPM / 1.6)
    run(healthy, samples)
    again = detector(speed_rpm=RPM / 1.6, calibration=healthy.watch.calibration)
    said = run(again, samples)
    assert course(said)[-1] == "normal"
    assert "departure" not in course(said)


@pytest.mark.parametrize("from_file", [False, True])
def test_a_run_up_gives_a_name_with_less_of_a_lead(steady, from_file):
    """The margin is stated, as it is the threshold of the name."""
    modes = TwoModes(support_share=0.5, support_lag=0.4)
    known = RotorParameters(
        natural_frequency_hz=31.0, damping_ratio=0.1, eccentricity_um=0.0, clearance_um=1.0, two_modes=modes
    )
    calibrated = detector()
    run(calibrated, steady)
    found = []
    for rotor in (ROTOR, replace(ROTOR, two_modes=known)):
        calibration = replace(calibrated.watch.calibration, rotor=rotor) if from_file else None
        said = run(detector(rotor=ROTOR if from_file else rotor, calibration=calibration), steady)
        found.append(said[-1].thresholds["identity"])
    assert found == [5.0, 3.5]


def test_the_last_look_at_a_short_recording(grown):
    subject = detector()
    run(subject, grown[: 76 * PER_REV])
    last = subject.finish()
    assert last is not None
    assert last.decision == "departure"
    assert "unbalance" in last.group
    assert detector().finish() is None


def test_silence_holds_the_decision(grown):
    subject = detector()
    run(subject, grown)
    (said,) = subject.silent(3.0, 123)
    assert (said.decision, said.severity, said.quality, said.t_ns) == ("unbalance", "alert", "missing", 123)
    assert "no samples of stream 'shaft' for more than 3.0 s" in said.reason
    assert not said.changed


def test_empty_window_says_nothing():
    nothing = Window(FIRST, np.empty((0, 3), dtype=np.float32), 0, PERIOD_NS)
    assert list(detector().process(nothing)) == []


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"angles": (0.0, 170.0)}, r"'probe-x' at 0\.0 and 'probe-y' at 170\.0"),
        ({"speed_rpm": 0.0}, "speed of 0.0 rpm"),
        ({"speed_rpm": math.nan}, "speed of nan rpm"),
    ],
)
def test_figures_that_cannot_be_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        detector(**options)


# Bad input. Healthy to revolution 60, spoilt to 80, healthy again.


def unplugged(part):
    part[:, 1] = NOISE_UM * np.random.default_rng(9).standard_normal(len(part))


def clipped(part):
    np.clip(part[:, 0], -12.0, 12.0, out=part[:, 0])


def at_the_rail(part):
    np.minimum(part[:, 1], -8.0, out=part[:, 1])


def noise_for_keyphasor(part):
    part[:, 2] = -6.0 + 3.0 * np.random.default_rng(9).standard_normal(len(part))


BAD = [
    (dead, "not_ok", "probe-x: stuck at 12.5 um"),
    (unplugged, "not_ok", "probe-y: "),
    (clipped, "not_ok", "probe-x: clipped at"),
    (at_the_rail, "not_ok", "probe-y: clipped at -8 um"),
    (gone, "missing", "probe-x: all samples of a revolution are missing"),
    (infinite, "missing", "probe-y: all samples of a revolution are missing"),
    (half_gone, "missing", "samples of a revolution are missing"),
    (no_keyphasor, "missing", "keyphasor: its pulses do not tell the shaft angle"),
    (noise_for_keyphasor, "missing", "keyphasor: its pulses do not tell the shaft angle"),
    (keyphasor_of_wrong_bits, "not_ok", "keyphasor holds 3e+30 at sample"),
]


@pytest.mark.parametrize(("spoil", "quality", "words"), BAD, ids=lambda v: getattr(v, "__name__", None))
def test_bad_input_is_named_and_holds_the_decision(steady, spoil, quality, words):
    samples = steady.copy()
    spoil(samples[60 * PER_REV : 100 * PER_REV])
    said = run(detector(), samples)
    spoilt = [d for d in said if 65 * PER_REV < d.end_index - FIRST < 100 * PER_REV]
    told = [d for d in spoilt if d.quality != "good"]
    assert told
    assert told[-1].quality == quality
    assert words in told[-1].reason
    # Half a spoilt revolution may be seen as a change, but nothing ever gets a name by it.
    assert {d.decision for d in said} <= {"undetermined", "normal", "departure"}
    assert said[-1].decision == "normal"
    assert said[-1].quality == "good"


@pytest.mark.parametrize(("spoil", "quality", "words"), BAD, ids=lambda v: getattr(v, "__name__", None))
def test_a_machine_is_not_calibrated_on_bad_input(steady, spoil, quality, words):
    samples = steady.copy()
    spoil(samples)
    said = run(detector(), samples)
    assert {d.decision for d in said} == {"undetermined"}
    assert said[-1].quality == quality
    assert words in said[-1].reason


def test_an_alarm_is_not_cleared_by_bad_input(grown):
    samples = grown.copy()
    dead(samples[95 * PER_REV :])
    said = run(detector(), samples)
    assert said[-1].quality == "not_ok"
    assert (said[-1].decision, said[-1].severity) == ("unbalance", "alert")


def test_swapped_probes_and_reversed_rotation_are_refused(steady):
    for subject, samples in ((detector(), steady[:, [1, 0, 2]]), (detector(speed_rpm=-RPM), steady)):
        said = run(subject, samples)
        assert {d.decision for d in said} == {"undetermined"}
        assert said[-1].quality == "not_ok"
        assert "turns against the stated rotation" in said[-1].reason


@pytest.mark.parametrize("error", [0.005, -0.02])
def test_a_stated_speed_that_is_wrong_is_refused(steady, error):
    said = run(detector(reference="fixed", speed_rpm=RPM * (1.0 + error)), steady)
    assert {d.decision for d in said} == {"undetermined"}
    assert said[-1].quality == "not_ok"
    assert "not locked to the shaft" in said[-1].reason


def test_a_speed_that_changes_after_calibration_is_no_fault(steady):
    other = channels(revolutions=60.0, w=W * 1.005, seed=3)
    said = run(detector(reference="fixed"), np.concatenate((steady[: 64 * PER_REV], other)))
    assert {d.decision for d in said} <= {"undetermined", "normal", "departure"}
    assert said[-1].quality == "not_ok"
    assert "no longer locked to the shaft" in said[-1].reason
    (faster,) = re.findall(r"turns (\S+) % faster", said[-1].reason)
    assert float(faster) == pytest.approx(0.5, abs=0.1)


def test_another_speed_is_not_judged(steady):
    slower = channels(revolutions=40.0, w=W * 0.9, seed=3)
    samples = np.concatenate((steady[: 60 * PER_REV], slower, steady[: 60 * PER_REV]))
    said = run(detector(), samples)
    assert {d.decision for d in said} <= {"undetermined", "normal", "departure"}
    told = [d for d in said if d.quality != "good"]
    assert "not judged at 1350 rpm" in told[-1].reason
    assert said[-1].decision == "normal"
    assert said[-1].quality == "good"


def test_an_unsteady_machine_is_calibrated_later():
    samples = channels((30.5, {"eccentricity": 0.2}), revolutions=150.0)
    said = run(detector(), samples)
    refused = [d for d in said if d.quality == "not_ok"]
    assert refused
    assert "cannot be calibrated: not steady" in refused[0].reason
    assert {d.decision for d in refused} == {"undetermined"}
    assert (said[-1].decision, said[-1].quality) == ("normal", "good")
    given_up = detector(rules=WatchRules(retry=False))
    said = run(given_up, samples)
    assert {d.decision for d in said} == {"undetermined"}
    assert "not steady" in given_up.refused


@pytest.mark.parametrize("reference", [KEYPHASOR, "fixed", "orbit"], ids=["keyphasor", "fixed", "orbit"])
@pytest.mark.parametrize("gap_rev", [0.4, 1.3, 7.65])
def test_a_gap_is_no_change(steady, reference, gap_rev):
    subject = detector(reference=reference)
    begin, end = 65 * PER_REV, round((65 + gap_rev) * PER_REV)
    said = run(subject, steady[:begin]) + run(subject, steady[end:], first_index=FIRST + end)
    assert course(said) == ["undetermined", "normal"]
    assert subject.watch.revolutions > 95


def test_ac_coupled_probes_see_no_static_load():
    def ac(samples):
        samples = samples.copy()
        samples[:, :2] -= samples[:, :2].mean(axis=0)
        return samples

    loaded = channels((CHANGE_REV, {"static_load": 0.1}))
    said = run(detector(), loaded)
    assert said[-1].decision == "static_load"
    said = run(detector(ac_coupled=True), loaded)
    # The rotor swings when the load comes; then everything is as before.
    assert course(said) == ["undetermined", "normal", "departure", "normal"]
    assert "static load cannot be seen" in said[-1].reason
    # Nobody said so, but no shaft of this weight has a mean position of zero.
    healthy = ac(channels(revolutions=80.0))
    subject = detector()
    said = run(subject, healthy)
    assert subject.ac_coupled
    assert "static load cannot be seen" in said[-1].reason
    assert (said[-1].decision, said[-1].quality) == ("normal", "good")
    assert run(detector(), channels(revolutions=80.0))[-1].reason == ""


def test_without_a_mean_position_stiffness_loss_is_not_told_from_unbalance(softer):
    with_mean = run(detector(), softer)[-1]
    assert (with_mean.decision, with_mean.group) == ("stiffness_loss", ())
    without = run(detector(ac_coupled=True), softer)[-1]
    assert {"stiffness_loss", "unbalance"} <= set(without.group)


def test_the_listener_hears_every_judged_revolution(steady):
    heard = []
    run(detector(listener=lambda report, vectors: heard.append((report, vectors))), steady)
    assert len(heard) >= 125
    assert [report.revolution for report, _ in heard] == list(range(1, len(heard) + 1))
    for report, vectors in heard:
        assert report.end_index == vectors.end_index[0]
    assert np.diff([report.end_index for report, _ in heard]) == pytest.approx(PER_REV, abs=1)


def test_the_mains_are_stated_with_their_frequency_and_no_fault_is_named():
    steady = channels(revolutions=150.0, seed=1)
    t = np.arange(len(steady)) / RATE_HZ
    hum = 6.0 * np.cos(2.0 * math.pi * 60.0 * t) * (t > 2.2)
    samples = steady + np.column_stack((hum, 0.3 * hum, np.zeros_like(hum))).astype(np.float32)
    diagnoses = run(detector(), samples)
    assert diagnoses[-1].decision == "unmodelled"
    assert diagnoses[-1].group == ()
    assert diagnoses[-1].quality == "good"
    assert "these are the mains, as cables pick them up; no fault of the rotor" in diagnoses[-1].reason
    statistics, units = diagnoses[-1].statistics, diagnoses[-1].units
    assert statistics["line.frequency"] == pytest.approx(60.0, abs=0.1)
    assert statistics["line.order"] == pytest.approx(2.4, abs=0.005)
    assert statistics["line.amplitude"] == pytest.approx(6.0 * math.sqrt(1.09 / 2.0), rel=0.1)
    assert (units["line.frequency"], units["line.amplitude"]) == ("Hz", "um")
    assert not any("line.frequency" in said.statistics for said in run(detector(), steady))
