"""Lines that are none of the rotor's: a bank leaves them out, judges the rest, and states whose they are."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import rotor_runs as runs
from support.shaft_channels import feed

from daqsvc.detectors.rotor_bank.detector import KeyphasorProbe, Probe, RotorBankDetector
from daqsvc.detectors.rotor_bank.recorded import bank_verdict
from daqsvc.diagnosis.detector import Window
from daqsvc.diagnosis.recorded import Statements
from daqsvc.recording.recording import Recording

SNR_DB = 20.0
BEGINS = 150
KNOWN = 150
"""Revolutions within which a line is known, but for slow beats."""


def flat_line(hz, um):
    """As cables pick it up: the same in both probes, but for the gain."""
    return lambda t: um * (1.0 + 0.3j) * np.cos(math.tau * hz * t + 0.3)


def round_line(hz, um):
    return lambda t: um * np.exp(1j * (math.tau * hz * t + 0.3))


def modulation(shaft_hz, often_hz, um):
    """1X of a motor whose poles pass so often."""
    return lambda t: um * np.exp(1j * math.tau * shaft_hz * t) * np.cos(math.tau * often_hz * t + 0.3)


FOREIGN = {
    "mains below 1X": (83.0, flat_line(50.0, 12.0), 50.0, "these are the mains"),
    "mains above 1X": (41.0, flat_line(50.0, 9.0), 50.0, "these are the mains"),
    "mains beside 1X": (49.6, flat_line(49.97, 12.0), 49.97, "these are the mains"),
    "twice the mains beside 2X": (49.6, round_line(100.05, 12.0), 100.05, "twice the mains"),
    "twice the mains": (24.7, round_line(100.0, 8.0), 100.0, "twice the mains"),
    "poles that pass": (24.7, modulation(24.7, 1.2, 16.0), 25.9, "induction motor of 4 poles"),
}


def all_of(names, *everyday):
    """Cases, those that are not for every day as long tests."""
    return [name if name in everyday else pytest.param(name, marks=pytest.mark.long) for name in names]


def bank(shaft_hz, **options):
    return RotorBankDetector(
        machine="rig",
        stream="shaft",
        rate_hz=runs.PER_REV * shaft_hz,
        speed_rpm=60.0 * shaft_hz,
        probes=(Probe("probe-x", 0, 0.0), Probe("probe-y", 1, 90.0)),
        keyphasor=KeyphasorProbe("keyphasor", 2, -6.0),
        rotor=replace(runs.ROTOR, natural_frequency_hz=shaft_hz),
        noise_um=runs.CLEARANCE_UM * runs.sigma(SNR_DB),
        **{"modes": runs.TWELVE_MODES, **options},
    )


def channels(shaft_hz, line, revolutions, *, changes=(), ends=None, seed=1):
    """Channels of the rig at a speed, with a line from revolution 150 on."""
    samples = runs.run(changes, revolutions, seed).channels(SNR_DB, seed)
    at = np.arange(len(samples))
    there = (at >= BEGINS * runs.PER_REV) & (at < (math.inf if ends is None else ends * runs.PER_REV))
    motion = np.where(there, line(at / (runs.PER_REV * shaft_hz)), 0.0)
    samples[:, 0] += motion.real
    samples[:, 1] += motion.imag
    return samples


def said_of(shaft_hz, samples, **options):
    subject = bank(shaft_hz, **options)
    return subject, feed(subject, samples, runs.PER_REV * shaft_hz, block=16, first_index=0)


def after(said, revolution):
    return [one for one in said if one.revolutions > revolution]


@pytest.mark.parametrize(("shaft_hz", "line", "hz", "whose"), FOREIGN.values(), ids=FOREIGN.keys())
def test_what_is_not_the_rotors_is_no_fault(shaft_hz, line, hz, whose):
    subject, said = said_of(shaft_hz, channels(shaft_hz, line, 700))
    # The observers alone take it for a fault: without this the test would show nothing.
    assert {one.decision for one in after(said, BEGINS)} - {"N", "departure"}
    late = after(said, BEGINS + 2 * KNOWN)
    assert {one.decision for one in late} == {"N"}
    assert not any(one.changed for one in late)
    assert all(one.probabilities["N"] > 0.99 for one in late)
    for one in late:
        assert one.quality == "good"
        assert whose in one.reason
        assert "left out" in one.reason
        stated_hz = one.statistics["line.frequency"]
        # Either of a pair may be stated.
        assert min(abs(stated_hz - hz), abs(stated_hz - 2.0 * shaft_hz + hz)) < 0.1
        assert one.units["line.frequency"] == "Hz"
    assert subject.lines


@pytest.mark.parametrize("fault", all_of(["U2", "L2", "K2", "D1"], "U2", "L2"))
@pytest.mark.parametrize(
    "name", all_of(["mains below 1X", "mains beside 1X", "twice the mains"], "mains below 1X")
)
def test_a_fault_beside_a_line_is_named(name, fault):
    shaft_hz, line, _, _ = FOREIGN[name]
    begins = 500
    samples = channels(shaft_hz, line, 800, changes=[(begins, runs.TWELVE_PLANTS[fault])])
    _, said = said_of(shaft_hz, samples)
    assert {one.decision for one in said if BEGINS + 2 * KNOWN < one.revolutions < begins - 1} == {"N"}
    last = said[-1]
    # At the critical speed the steady orbits of both are nearly the same.
    same = {"U2", "D1"} if fault in {"U2", "D1"} else {fault}
    assert last.decision in same
    assert set(last.group) <= same | {"U1", "D2"}
    assert "line.frequency" in last.statistics


@pytest.mark.parametrize("name", all_of(FOREIGN, "mains below 1X"))
def test_the_end_of_a_line_is_no_change(name):
    shaft_hz, line, _, _ = FOREIGN[name]
    ends = 600
    subject, said = said_of(shaft_hz, channels(shaft_hz, line, 1000, ends=ends))
    assert {one.decision for one in after(said, ends - 10)} == {"N"}
    assert not subject.lines
    assert said[-1].reason == ""


@pytest.mark.parametrize("shaft_hz", all_of([24.7, 49.6, 50.0], 50.0))
@pytest.mark.parametrize(
    "fault", [{"damping_ratio": 0.02}, {"damping_ratio": 0.1, "eccentricity": 0.3}, {"eccentricity": 0.4}]
)
def test_nothing_is_left_out_of_a_rub(shaft_hz, fault):
    subject, said = said_of(shaft_hz, channels(shaft_hz, flat_line(50.0, 0.0), 600, changes=[(200, fault)]))
    assert said[-1].decision == "R"
    assert not subject.lines
    assert not any("line.frequency" in one.statistics for one in said)


def test_a_rub_beside_the_mains_is_a_rub():
    shaft_hz, line, _, _ = FOREIGN["mains below 1X"]
    samples = channels(shaft_hz, line, 800, changes=[(500, runs.TWELVE_PLANTS["R"])])
    _, said = said_of(shaft_hz, samples)
    assert said[-1].decision == "R"
    assert next(one for one in after(said, 495) if one.decision == "R").revolutions < 505


def hum(hz, um):
    """The mains with what comes with them."""
    tones = [flat_line(hz * times, um / times) for times in (1, 2, 3)]
    return lambda t: sum(tone(t) for tone in tones)


@pytest.mark.long
@pytest.mark.parametrize(("shaft_hz", "hz"), [(41.0, 50.0), (83.0, 50.0), (49.6, 49.97), (61.0, 60.0)])
def test_a_hum_that_is_no_pure_tone_is_left_out_whole(shaft_hz, hz):
    subject, said = said_of(shaft_hz, channels(shaft_hz, hum(hz, 12.0), 1200))
    late = after(said, 900)
    assert {one.decision for one in late} == {"N"}
    assert subject.lines


def test_tones_of_a_hum_are_all_stated():
    subject, said = said_of(61.0, channels(61.0, hum(60.0, 12.0), 1200))
    assert {round(one.frequency_hz) for one in subject.lines} == {60, 120, 180}
    assert said[-1].reason.count("left out") == 3
    assert said[-1].statistics["line.frequency"] == pytest.approx(60.0, abs=0.05)


UNKNOWN = {
    "another machine, or a 1X that turns": (31.3, round_line(32.6, 8.0)),
    "1X that turns once in 100 revolutions": (40.0, round_line(40.4, 12.0)),
    "a whirl at the frequency of the mains": (50.0 / 0.45, round_line(50.0, 12.0)),
    "half the speed of a rub": (100.0, round_line(50.0, 12.0)),
    "a third of it, back and forth": (150.0, flat_line(50.0, 9.0)),
    "modulation as of no motor": (40.0, modulation(40.0, 1.3, 16.0)),
}


@pytest.mark.parametrize(("shaft_hz", "line"), UNKNOWN.values(), ids=UNKNOWN.keys())
def test_what_may_be_the_rotors_is_not_left_out(shaft_hz, line):
    subject, said = said_of(shaft_hz, channels(shaft_hz, line, 700))
    assert subject.lines == ()
    assert not any("line.frequency" in one.statistics for one in said)
    assert {one.decision for one in after(said, BEGINS)} != {"N"}


def test_a_rub_that_comes_and_goes_as_often_as_poles_pass_stays_a_rub():
    shaft_hz, often_hz = 24.7, 1.2
    half = round(0.5 * shaft_hz / often_hz)
    changes = [
        (200 + k * half, runs.TWELVE_PLANTS["R"] | {"damping_ratio": 0.05} if k % 2 == 0 else {})
        for k in range(50)
    ]
    subject, said = said_of(shaft_hz, channels(shaft_hz, flat_line(50.0, 0.0), 720, changes=changes))
    assert subject.lines == ()
    assert "R" in {one.decision for one in after(said, 600)}


def test_probes_that_are_ac_coupled_show_no_contact_so_that_only_the_mains_are_left_out():
    modes = tuple(mode for mode in runs.TWELVE_MODES if not any(mode.static_load_um))
    for name, known in (("poles that pass", False), ("twice the mains", True)):
        shaft_hz, line, _, _ = FOREIGN[name]
        samples = channels(shaft_hz, line, 600)
        samples[:, :2] -= samples[: 100 * runs.PER_REV, :2].mean(axis=0)
        subject, _ = said_of(shaft_hz, samples, ac_coupled=True, modes=modes)
        assert bool(subject.lines) == known


def test_how_samples_are_cut_makes_no_difference():
    shaft_hz, line, _, _ = FOREIGN["mains below 1X"]
    samples = channels(shaft_hz, line, 700, ends=550)
    for block in (16, 33, 640):
        subject = bank(shaft_hz)
        said = feed(subject, samples, runs.PER_REV * shaft_hz, block=block, first_index=0)
        assert {one.decision for one in after(said, 400)} == {"N"}
        assert {bool(one.reason) for one in said if 400 < one.revolutions < 545} == {True}


def test_a_stream_that_begins_again_has_no_line_yet():
    shaft_hz, line, _, _ = FOREIGN["mains below 1X"]
    rate_hz = runs.PER_REV * shaft_hz
    samples = channels(shaft_hz, line, 600)
    subject = bank(shaft_hz)
    feed(subject, samples, rate_hz, block=16, first_index=0)
    assert subject.lines
    feed(subject, samples[: 20 * runs.PER_REV], rate_hz, block=16, first_index=0)
    assert subject.lines == ()


def test_a_line_in_the_calibration_is_left_out_as_well():
    shaft_hz = 83.0
    samples = channels(shaft_hz, flat_line(50.0, 0.0), 600)
    motion = flat_line(50.0, 12.0)(np.arange(len(samples)) / (runs.PER_REV * shaft_hz))
    samples[:, 0] += motion.real
    samples[:, 1] += motion.imag
    _, said = said_of(shaft_hz, samples, calibrate_revolutions=60)
    late = after(said, 60 + 2 * KNOWN)
    assert {one.decision for one in late} == {"N"}
    assert all("these are the mains" in one.reason for one in late)


def test_a_shaft_that_turns_the_other_way_is_judged_alike():
    shaft_hz, line, hz, whose = FOREIGN["twice the mains"]
    samples = channels(shaft_hz, line, 600)
    mirrored = samples.copy()
    mirrored[:, 0] *= -1.0
    subject = RotorBankDetector(
        machine="rig",
        stream="shaft",
        rate_hz=runs.PER_REV * shaft_hz,
        speed_rpm=-60.0 * shaft_hz,
        probes=(Probe("probe-x", 0, 0.0), Probe("probe-y", 1, 90.0)),
        keyphasor=KeyphasorProbe("keyphasor", 2, -6.0),
        rotor=replace(runs.ROTOR, natural_frequency_hz=shaft_hz),
        modes=runs.TWELVE_MODES,
        noise_um=runs.CLEARANCE_UM * runs.sigma(SNR_DB),
        calibrate_revolutions=60,
    )
    said = feed(subject, mirrored, runs.PER_REV * shaft_hz, block=16, first_index=0)
    assert said[-1].decision == "N"
    assert whose in said[-1].reason
    assert subject.lines
    assert subject.lines[0].forward is True
    assert said[-1].statistics["line.frequency"] == pytest.approx(hz, abs=0.1)


def test_it_goes_on_over_a_gap_of_known_length_and_starts_again_after_a_guess():
    shaft_hz, line, _, _ = FOREIGN["mains below 1X"]
    rate_hz = runs.PER_REV * shaft_hz
    samples = channels(shaft_hz, line, 1000)
    for breaks, known in ((False, True), (True, False)):
        subject = bank(shaft_hz)
        begin, end = 600 * runs.PER_REV, 606 * runs.PER_REV + 17
        feed(subject, samples[:begin], rate_hz, block=16, first_index=0)
        assert subject.lines
        part = samples[end : end + 4 * runs.PER_REV]
        at = end + len(part)
        offsets = (0,) if breaks else ()
        window = Window(end, part, round((at - 1) * 1e9 / rate_hz), 1e9 / rate_hz, breaks=offsets)
        said = list(subject.process(window))
        assert bool(subject.lines) == known
        said += feed(subject, samples[at:], rate_hz, block=16, first_index=at)
        assert said[-1].decision == "N"
        assert subject.lines
        if known:
            assert {one.decision for one in said} == {"N"}


@pytest.mark.parametrize("name", all_of(FOREIGN, "mains beside 1X"))
def test_a_fit_after_a_gap_waits_for_as_many_revolutions_as_tell_line_and_harmonic_apart(name):
    shaft_hz, line, hz, _ = FOREIGN[name]
    rate_hz = runs.PER_REV * shaft_hz
    samples = channels(shaft_hz, line, 1200)
    subject = bank(shaft_hz)
    begin, end = 700 * runs.PER_REV, 705 * runs.PER_REV + 17
    feed(subject, samples[:begin], rate_hz, block=16, first_index=0)
    said = feed(subject, samples[end:], rate_hz, block=16, first_index=end)
    assert {one.decision for one in said} == {"N"}
    assert all("left out" in one.reason for one in said if one.quality == "good")
    pair = (hz, 2.0 * shaft_hz - hz)
    assert min(abs(said[-1].statistics["line.frequency"] - one) for one in pair) < 0.1


def test_the_papers_rule_is_left_as_it_is():
    shaft_hz, line, _, _ = FOREIGN["twice the mains"]
    subject, _ = said_of(shaft_hz, channels(shaft_hz, line, 500), rules=replace(runs_rules(), rule="paper"))
    assert not subject.lines


def runs_rules():
    return bank(24.7).rules


def test_a_recording_states_the_line():
    shaft_hz, line, hz, _ = FOREIGN["mains below 1X"]
    samples = channels(shaft_hz, line, 600)
    subject, said = said_of(shaft_hz, samples)
    rate_hz = runs.PER_REV * shaft_hz
    recording = Recording(("probe-x", "probe-y", "keyphasor"), samples, rate_hz, Path("one.npz"), 0)
    verdict = bank_verdict(
        recording, Statements("rotor-bank", said, rate_hz), subject.faults, closed=True, lines=subject.lines
    )
    assert verdict.verdict == "normal"
    stated = verdict.as_json()["line"]
    assert stated["frequency_hz"] == pytest.approx(hz, abs=0.1)
    assert (stated["mains"], stated["is_the_change"]) == (1, True)
    assert "normal at the end of 600 revolutions, without a line that is left out" in verdict.describe()
    assert "is left out: these are the mains" in verdict.describe()
