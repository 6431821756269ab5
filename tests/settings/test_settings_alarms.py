"""What a machine file can say about alarms, what is wrong with it, and the rules that come of it."""

from __future__ import annotations

from functools import partial

import pytest
from support.machine_files import LAVAL, MOTOR, changed, only_problem, parsed, problems_of

from daqsvc.alarms.make import alarm_rule
from daqsvc.alarms.rules import DiagnosisRule, LevelRule
from daqsvc.alarms.voting import VotingRule
from daqsvc.detectors.levels import plugin as levels_plugin
from daqsvc.detectors.levels.statements import Limits
from daqsvc.settings.alarms import StartUp
from daqsvc.settings.describe import describe

VOTING = """[[alarms]]
name = "shaft-vibration"
sensors = ["probe-x", "probe-y"]
vote = 2
measure = "rms"
alert = 45.0
trip_multiply = 2.0
first_out_group = "shaft"

[mqtt]"""
START_UP = """[alarm_handling.start_up]
detector = "rotor-bank"
between = [100.0, 500.0]
change_per_s = 20.0

[mqtt]"""
VOTES = ("[mqtt]", VOTING.replace("trip_multiply = 2.0\n", ""))
STARTS = ("[mqtt]", START_UP.replace("[mqtt]", VOTING))


machine_with = partial(parsed, LAVAL)


def test_a_voting_alarm_becomes_a_rule_that_is_judged_and_described():
    machine = machine_with(STARTS)
    assert machine.warnings == ()
    rule = alarm_rule(machine.alarms[-1])
    assert isinstance(rule, VotingRule)
    assert (rule.sensors, rule.vote, rule.trip_multiply) == (("probe-x", "probe-y"), 2, 2.0)
    assert (rule.group, rule.setpoint.alert, rule.latching) == ("shaft", 45.0, False)
    assert "rms, 2 of probe-x, probe-y" in describe(machine)
    assert "start-up x2" in " ".join(describe(machine).split())
    assert Limits("rms", 45.0, None) in levels_plugin._limits(machine, "probe-y")


def test_what_holds_for_all_alarms_has_defaults_and_can_be_switched_off():
    handling = machine_with().alarm_handling
    assert (handling.chatter_raises, handling.chatter_window_s, handling.chatter_quiet_s) == (5, 60.0, 60.0)
    assert (handling.flood_alarms, handling.flood_window_s) == (10, 600.0)
    assert handling.start_up is None
    assert handling.shelve_at_most_s == 28_800.0
    switched_off = machine_with(
        ("chatter_raises = 5", "chatter_raises = 0"),
        ("flood_alarms = 10", "flood_alarms = 0"),
        ("28_800.0", "60.0"),
    )
    handling = switched_off.alarm_handling
    assert (handling.chatter_raises, handling.flood_alarms, handling.shelve_at_most_s) == (0, 0, 60.0)


def test_a_start_up_is_recognised_by_what_the_file_says():
    assert machine_with(STARTS).alarm_handling.start_up == StartUp(
        detector="rotor-bank",
        measure="speed",
        between=(100.0, 500.0),
        change_per_s=20.0,
        at_most_s=120.0,
    )


def test_evidence_and_group_reach_the_rules():
    machine = machine_with(('detector = "rotor-bank"', 'detector = "rotor-bank"\nevidence_nats = 18.0'))
    rule = alarm_rule(machine.alarms[-1])
    assert rule == DiagnosisRule("rotor-fault", "rotor-bank", latching=rule.latching, evidence_nats=18.0)
    assert "18 nats at least" in describe(machine)
    first = alarm_rule(machine.alarms[0])
    assert isinstance(first, LevelRule)
    assert (first.group, first.trip_multiply) == ("machine", 1.0)


@pytest.mark.parametrize(
    ("replacements", "key", "message", "remedy"),
    [
        ([VOTES, ("vote = 2", "vote = 3")], "alarms[3].vote", "cannot be reached by 2 sensors", "vote = 2"),
        (
            [VOTES, ('"probe-x", "probe-y"]\nvote', '"probe-x", "probe-x"]\nvote')],
            "alarms[3].sensors[1]",
            "votes twice",
            "once",
        ),
        (
            [VOTES, ('"probe-x", "probe-y"]\nvote', '"probe-x", "probe-z"]\nvote')],
            "alarms[3].sensors[1]",
            "no such sensor",
            "probe-x",
        ),
        (
            [VOTES, ('"probe-x", "probe-y"]\nvote', '"probe-x", "keyphasor"]\nvote')],
            "alarms[3].sensors[1]",
            "no vibration",
            "probe-x",
        ),
        (
            [("[mqtt]", VOTING)],
            "alarms[3].trip_multiply",
            "nothing states when the machine starts up",
            "[alarm_handling.start_up]",
        ),
        (
            [
                STARTS,
                (
                    '[alarm_handling.start_up]\ndetector = "rotor-bank"',
                    '[alarm_handling.start_up]\ndetector = "bank"',
                ),
            ],
            "alarm_handling.start_up.detector",
            "no such detector",
            "rotor-bank",
        ),
        (
            [STARTS, ('detector = "rotor-bank"\nbetween', 'detector = "levels/probe-x"\nbetween')],
            "alarm_handling.start_up.detector",
            "states no speed while the machine starts up",
            "take one of: rotor-bank",
        ),
        (
            [STARTS, ("between = [100", 'measure = "sped"\nbetween = [100')],
            "alarm_handling.start_up.measure",
            "is nothing that rotor-bank states",
            'did you mean "speed"',
        ),
        (
            [STARTS, ("[100.0, 500.0]", "[500.0, 100.0]")],
            "alarm_handling.start_up.between",
            "no range",
            "lower end",
        ),
        (
            [STARTS, ("between = [100.0, 500.0]\nchange_per_s = 20.0\n", "")],
            "alarm_handling.start_up",
            "neither between nor change_per_s",
            "add one",
        ),
        (
            [('name = "rotor-fault"', 'name = "alarm-flood"')],
            "alarms[2].name",
            "the service raises itself",
            "another name",
        ),
    ],
)
def test_what_cannot_be_is_named_with_a_remedy(replacements, key, message, remedy):
    problem, _ = only_problem(LAVAL, *replacements)
    assert problem.key == key
    assert message in problem.message
    assert remedy in problem.remedy


def test_a_machine_without_a_speed_has_no_start_up():
    start_up = '[alarm_handling.start_up]\ndetector = "levels/accel-de"\nchange_per_s = 20.0\n\n[mqtt]'
    problem, *_ = problems_of(changed(MOTOR, ("[mqtt]", start_up))[0], MOTOR)
    assert problem.key == "alarm_handling.start_up.detector"
    assert problem.message == "no detector of this machine states a speed"
    assert "[pipeline.rotor_bank] or [pipeline.rotor_synchronous]" in problem.remedy


def test_a_start_up_without_effect_is_a_warning():
    (warning,) = machine_with(("[mqtt]", START_UP)).warnings
    assert warning.key == "alarm_handling.start_up"
    assert "no alarm has a trip_multiply" in warning.message
