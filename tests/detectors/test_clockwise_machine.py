"""A shaft that turns clockwise: a negative speed in the machine file, and everything that rests on it."""

from __future__ import annotations

import argparse

import numpy as np
import pytest
from support.machine_files import LAVAL, MACHINES, changed, only_problem
from support.shaft_channels import channels_of, feed

from daqsvc.commands.detectability import DetectabilityCommand
from daqsvc.detectors.make import detectors
from daqsvc.settings import describe, parse_machine_file
from sim_hw.plants import rotor as plant

PUMP = MACHINES / "rotor-synchronous.toml"
PER_REV = 64
RATE_HZ = 640.0
SPEED = "speed_rpm = 600.0"
ONSET_REV, REVOLUTIONS = 60.0, 90.0


def rig(*, clockwise):
    """The rig with both of its rotor's detectors, or its mirror image: +x is then -x, heavy spot and all."""
    table = '[pipeline.rotor_synchronous]\nprobes = ["probe-x", "probe-y"]\nkeyphasor = "keyphasor"'
    text, _ = changed(LAVAL, ("[[alarms]]", f"{table}\n\n[[alarms]]"))
    if clockwise:
        text = text.replace(SPEED, "speed_rpm = -600.0").replace("heavy_spot_deg = 0", "heavy_spot_deg = 180")
    return parse_machine_file(text, LAVAL)


def samples(*, clockwise):
    """Float32 ``[n, 3]`` of a rotor that loses damping, or of its mirror image."""
    lost = plant.PlantParameters(damping_ratio=0.10)
    motion = plant.simulate(
        plant.PlantParameters(),
        [plant.Change(ONSET_REV, lost)],
        revolutions=REVOLUTIONS,
        samples_per_rev=PER_REV,
    )
    taken = channels_of(motion, 2.0, seed=3)
    if clockwise:
        taken[:, 0] *= -1.0
    return taken


def course(detector, taken):
    decisions = [(said.decision, said.group) for said in feed(detector, taken, RATE_HZ, block=PER_REV)]
    return [one for one, before in zip(decisions, [None, *decisions], strict=False) if one != before]


@pytest.mark.parametrize("which", ["rotor-bank", "rotor-synchronous"])
def test_the_detectors_see_a_clockwise_shaft_as_its_mirror_image(which):
    told = []
    for clockwise in (False, True):
        machine = rig(clockwise=clockwise)
        (detector,) = (made for made in detectors(machine) if made.name == which)
        told.append(course(detector, samples(clockwise=clockwise)))
    assert told[1] == told[0]
    assert told[0][-1][0] in {"F1", "unbalance", "damping_loss"}


def test_thresholds_by_a_rate_of_false_alarms_do_not_know_the_direction():
    rates = "false_alarms_per_1000_rev = 0.02\nmtbf_hours = 1000.0"
    text, _ = changed(LAVAL, ('rule = "cusum"', f'{rates}\nrule = "cusum"'))
    thresholds = []
    for speed in (SPEED, "speed_rpm = -600.0"):
        machine = parse_machine_file(text.replace(SPEED, speed, 1), LAVAL)
        (bank,) = (made for made in detectors(machine) if made.name == "rotor-bank")
        thresholds.append(bank.rules.thresholds(4))
    np.testing.assert_array_equal(*thresholds)
    assert np.isfinite(thresholds[0]).all()


def test_check_says_which_way_it_turns():
    assert "Speed    600 rpm (10 Hz), clockwise" in describe(rig(clockwise=True))
    assert "clockwise" not in describe(rig(clockwise=False))
    text, _ = changed(
        PUMP,
        ("speed_rpm = 1500.0", "speed_rpm = -1500.0"),
        ('keyphasor = "keyphasor"          #', 'speed_source = "fixed" #'),
    )
    assert "angle from 1500 rpm, taken as exact" in " ".join(describe(parse_machine_file(text, PUMP)).split())


def test_a_shaft_is_sampled_too_slowly_in_either_direction():
    problem, _ = only_problem(
        PUMP,
        ("rate_hz = 1600.0", "rate_hz = 250.0"),
        ("speed_rpm = 1500.0", "speed_rpm = -1500.0"),
    )
    assert "10 times a revolution (250 Hz at 1500 rpm)" in problem.message
    assert "300 Hz or faster" in problem.remedy


@pytest.mark.parametrize(
    ("speed", "message"),
    [("0.0", "stands still"), ("-2e6", "-1,000,000 or more"), ("2e6", "1,000,000 or less")],
)
def test_a_speed_that_no_shaft_has_is_refused(speed, message):
    problem, _ = only_problem(LAVAL, (SPEED, f"speed_rpm = {speed}"))
    assert problem.key == "machine.speed_rpm"
    assert message in problem.message
    assert "clockwise" in problem.remedy


def test_another_speed_is_one_in_the_same_direction(capsys):
    command = DetectabilityCommand(lambda _: rig(clockwise=True), lambda: None)
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    assert command.run(parser.parse_args([str(LAVAL), "--speed-rpm", "540", "--json"])) == 0
    assert '"speed_rpm": -540.0' in capsys.readouterr().out
