"""The calibrated rotor in a machine file: what it is told, and what it refuses to be told."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest
from support.machine_files import LAVAL, MACHINES, changed, only_problem, parsed, problems_of
from support.run_ups import RATE_HZ, record

from daqsvc.alarms.make import alarm_rule
from daqsvc.detectors.make import detectors
from daqsvc.detectors.rotor_synchronous.detector import RotorSynchronousDetector
from daqsvc.rotor.calibration.file import CalibrationRecord, save_calibration, save_record
from daqsvc.rotor.calibration.run_up import fit_run_up
from daqsvc.rotor.laval import LavalRotor
from daqsvc.rotor.synchronous.baseline import Calibration
from daqsvc.settings import describe, parse_machine_file
from daqsvc.settings.problems import AssemblyError

EXAMPLE = MACHINES / "rotor-synchronous.toml"
TABLE = "[pipeline.rotor_synchronous]"
KEYPHASOR = 'keyphasor = "keyphasor"          #'


machine = partial(parsed, EXAMPLE)


def detector(given):
    (made,) = (d for d in detectors(given) if isinstance(d, RotorSynchronousDetector))
    return made


def healthy(rotor, revolutions):
    """The healthy state of the example at its speed."""
    return Calibration(
        rotor=rotor,
        speed_rpm=1500.0,
        revolutions=revolutions,
        baseline=np.array([-10j, 16.0 - 3j, 0.1, 0.05j, 0.0]),
        variance=np.full(5, 0.01),
        noise=0.5,
        noise_variance=0.02,
        samples_per_rev=64.0,
    )


def test_the_detector_is_what_the_machine_file_says():
    made = detector(
        machine(
            ("calibrate_revolutions = 50", "calibrate_revolutions = 77"),
            ("natural_frequency_tolerance_percent = 20.0", "natural_frequency_tolerance_percent = 5.0"),
            ("probe_drift_um = 0.0", "probe_drift_um = 3.0"),
            ("false_alarms_per_1000_rev = 0.1", "false_alarms_per_1000_rev = 0.01"),
        )
    )
    assert (made.name, made.stream, made.block) == ("rotor-synchronous", "shaft", 80)
    assert made.watch.rules.calibrate_revolutions == 77
    assert made.watch.rules.probe_drift_um == 3.0
    assert made.watch.rules.false_alarms_per_1000_rev == 0.01
    rotor = made.watch.rotor
    assert (rotor.natural_frequency_hz, rotor.natural_frequency_tolerance) == (31.0, 0.05)
    assert (rotor.damping_ratio, rotor.damping_tolerance) == (0.1, 0.2)
    assert (rotor.clearance_um, rotor.static_sag_um) == (100.0, 10.0)
    assert rotor.plain_bearings is None
    assert not made.ac_coupled


@pytest.mark.parametrize("stated", [True, False])
def test_the_machine_file_states_whether_its_bearings_are_plain(stated, tmp_path):
    text, _ = changed(EXAMPLE, ("clearance_um =", f"plain_bearings = {str(stated).lower()}\nclearance_um ="))
    assert detector(parse_machine_file(text, EXAMPLE)).watch.rotor.plain_bearings is stated
    save_calibration(
        healthy(LavalRotor(natural_frequency_hz=31.0, damping_ratio=0.1), 50), tmp_path / "a.toml"
    )
    text = text.replace("probe_drift_um = 0.0", 'calibration = "a.toml"')
    assert detector(parse_machine_file(text, tmp_path / "m.toml")).watch.rotor.plain_bearings is stated


@pytest.mark.parametrize(
    ("replacements", "reference", "sensors", "words"),
    [
        ((), "keyphasor", 3, "probe-x, probe-y and keyphasor; angle from the keyphasor"),
        (((KEYPHASOR, "#"),), "fixed", 2, "probe-x and probe-y; angle from 1500 rpm, taken as exact"),
        (((KEYPHASOR, 'speed_source = "orbit" #'),), "orbit", 2, "the orbit's 1X around 1500 rpm"),
    ],
)
def test_what_tells_the_shaft_angle(replacements, reference, sensors, words):
    given = machine(*replacements)
    assert given.pipeline.rotor_synchronous.reference == reference
    assert len(given.pipeline.rotor_synchronous.sensors) == sensors
    assert words in " ".join(describe(given).split())
    detector(given)


def test_ac_coupled_probes_are_known_by_their_sensors():
    given = machine(("angle_deg = 90.0", "angle_deg = 90.0\nac_coupled = true"))
    assert detector(given).ac_coupled
    assert "no static load is seen" in " ".join(describe(given).split())


def test_an_alarm_may_follow_it():
    given = machine()
    assert given.detectors == ("rotor-synchronous",)
    assert next(rule.detector for rule in map(alarm_rule, given.alarms)) == "rotor-synchronous"


def test_both_rotor_detectors_watch_one_machine():
    text, _ = changed(LAVAL)
    text = text.replace("[[alarms]]", f'{TABLE}\nprobes = ["probe-x", "probe-y"]\n\n[[alarms]]', 1)
    given = parse_machine_file(text, LAVAL)
    assert given.detectors == ("rotor-bank", "rotor-synchronous")


@pytest.mark.parametrize(
    ("replacements", "key", "message", "remedy"),
    [
        ([('probes = ["probe-x"', 'probes = ["probe-q"')], "probes[0]", "no such sensor", "probe-x"),
        ([('probes = ["probe-x"', 'probes = ["keyphasor"')], "probes[0]", '"proximity"', "probe-x"),
        ([('probes = ["probe-x"', 'probes = ["probe-y"')], "probes[1]", "twice", "two different"),
        ([(KEYPHASOR, 'keyphasor = "probe-x" #')], "keyphasor", 'type "keyphasor"', "keyphasor"),
        ([("angle_deg = 90.0", "angle_deg = 20.0")], "probes", "along one line", "90 deg apart"),
        ([(KEYPHASOR, 'speed_source = "keyphasor" #')], "speed_source", "none is named", '"fixed"'),
        ([("rate_hz = 1600.0", "rate_hz = 250.0")], "probes", "10 times a revolution", "300 Hz"),
        ([("calibrate_revolutions = 50", "calibrate_revolutions = 5")], "calibrate_revolutions", "20", ""),
        ([("tolerance_percent = 20.0", "tolerance_percent = 100.0")], "natural_frequency", "100", ""),
    ],
)
def test_what_does_not_fit_is_named(replacements, key, message, remedy):
    problem, _ = only_problem(EXAMPLE, *replacements)
    assert problem.key.startswith(f"pipeline.rotor_synchronous.{key}")
    assert message in problem.message
    assert remedy in problem.remedy


def test_it_needs_the_rotor():
    text, _ = changed(EXAMPLE)
    start, end = text.index("[machine.rotor]"), text.index("[buses.can0]")
    (problem,) = problems_of(text[:start] + text[end:], EXAMPLE)
    assert problem.key == "pipeline.rotor_synchronous"
    assert "[machine.rotor]" in problem.remedy


def test_an_alarm_on_a_detector_that_is_not_there():
    problem, _ = only_problem(EXAMPLE, ('detector = "rotor-synchronous"', 'detector = "rotor-bank"'))
    assert "not configured" in problem.message
    assert "[pipeline.rotor_bank]" in problem.remedy


def test_a_keyphasor_that_nobody_looks_at_is_a_warning():
    given = machine((KEYPHASOR, 'speed_source = "orbit"\nkeyphasor = "keyphasor" #'))
    (warning,) = given.warnings
    assert "not used" in warning.message


def test_a_calibration_is_read_beside_the_machine_file(tmp_path):
    calibration = healthy(LavalRotor(natural_frequency_hz=30.0, damping_ratio=0.1), 200)
    save_calibration(calibration, tmp_path / "healthy.toml")
    text, _ = changed(EXAMPLE, ("probe_drift_um = 0.0", 'calibration = "healthy.toml"'))
    given = parse_machine_file(text, tmp_path / "m.toml")
    made = detector(given)
    assert made.watch.state == "watching"
    assert made.watch.calibration.revolutions == 200
    np.testing.assert_array_equal(made.watch.calibration.baseline, calibration.baseline)
    assert "healthy state in healthy.toml" in " ".join(describe(given).split())
    save_calibration(dataclasses.replace(calibration, speed_rpm=3000.0), tmp_path / "healthy.toml")
    with pytest.raises(AssemblyError, match=r"rotor_synchronous\.calibration = 'healthy\.toml'"):
        detectors(given)
    (tmp_path / "healthy.toml").unlink()
    with pytest.raises(AssemblyError, match=r"rotor_synchronous\.calibration = 'healthy\.toml'"):
        detectors(given)


@pytest.mark.gives("D19")
def test_a_kept_healthy_state_is_used_with_what_the_file_says_of_the_rotor_now(tmp_path, caplog):
    calibration = healthy(LavalRotor(natural_frequency_hz=99.0, damping_ratio=0.5), 50)

    def kept():
        made = detectors(machine(), tmp_path)
        return next(d for d in made if isinstance(d, RotorSynchronousDetector)).watch

    assert kept().state == "calibrating"
    path = tmp_path / "rotor-synchronous.toml"
    save_calibration(calibration, path)
    assert kept().state == "watching"
    assert kept().rotor.natural_frequency_hz == 31.0
    path.write_text("rubbish = 1", encoding="utf-8")
    assert kept().state == "calibrating"
    assert "measured again" in caplog.text


def test_a_run_up_tells_the_rotor_and_the_healthy_state_is_learnt_live(tmp_path):
    fit = fit_run_up(*record(5.0), RATE_HZ)
    rotor = fit.rotor(clearance_um=400.0, static_sag_um=150.0)
    save_record(CalibrationRecord(rotor=rotor, run_up=fit, run_up_source="up.npz"), tmp_path / "up.toml")
    text, _ = changed(EXAMPLE, ("probe_drift_um = 0.0", 'calibration = "up.toml"'))
    given = parse_machine_file(text, tmp_path / "m.toml")
    assert "that of the first 50 revolutions if a run-up is all that it holds" in " ".join(
        describe(given).split()
    )
    store = tmp_path / "store"
    store.mkdir()

    def watch():
        made = detectors(given, store)
        return next(d for d in made if isinstance(d, RotorSynchronousDetector)).watch

    learning = watch()
    assert (learning.state, learning.calibration) == ("calibrating", None)
    assert learning.rotor.natural_frequency_hz == fit.natural_frequency_hz == pytest.approx(40.0, rel=1e-3)
    assert learning.rotor.natural_frequency_tolerance == 0.02
    assert learning.rotor.clearance_um == 100.0, "that of the machine file"
    # What was learnt is kept, and comes back with the rotor of the run-up.
    kept = healthy(LavalRotor(natural_frequency_hz=31.0, damping_ratio=0.1), 50)
    save_calibration(kept, store / "rotor-synchronous.toml")
    assert watch().state == "watching"
    assert watch().calibration.rotor == learning.rotor
