"""Alarms on a phase, on amplitude and phase as one region, and in the zones of a standard."""

from __future__ import annotations

import math

import pytest
from support.alarm_rig import AlarmRig, kinds

from daqsvc.alarms.make import alarm_rule
from daqsvc.alarms.rules import Beside, LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.states import Level
from daqsvc.alarms.voting import VotingRule
from daqsvc.settings.alarms import LevelAlarm, VotingAlarm

PHASE = Setpoint(alert=30.0, danger=60.0, deadband=5.0, reference_deg=350.0)
REGION = LevelRule(
    "region",
    "probe-x",
    "1x_amplitude",
    Setpoint(alert=60.0, danger=80.0, alert_low=20.0, deadband=2.0),
    beside=Beside("1x_phase_lag", PHASE),
)
UNITS = {"1x_amplitude": "um", "1x_phase_lag": "deg", "velocity_rms": "mm/s"}
UNKNOWN = (-math.inf, math.inf)


def say(rig, sensor="probe-x", unknown=(), **statistics):
    """A statement about 1X, of which some may be unknown."""
    named = {
        f"1x_{name}" if name in {"amplitude", "phase_lag"} else name: v for name, v in statistics.items()
    }
    return rig.take(
        detector=f"levels/{sensor}",
        decision="normal",
        statistics=named,
        units=UNITS,
        sensors=(sensor,),
        quality="missing" if unknown else "good",
        reason="no pulses" if unknown else "",
        bounds=dict.fromkeys(unknown, UNKNOWN),
        missing_share=0.0,
    )


def test_a_phase_may_cross_360_and_is_far_from_its_reference_either_way():
    rig = AlarmRig(LevelRule("phase", "probe-x", "1x_phase_lag", PHASE))
    for lag in (350.0, 5.0, 19.0, 335.0, 321.0):
        assert say(rig, phase_lag=lag) == []
    (event,) = say(rig, phase_lag=20.0)
    assert (event.kind.value, event.to_level) == ("raised", Level.ALERT)
    assert event.message == (
        "phase alert: 1x_phase_lag of probe-x is 20 deg, 30 deg from its reference of 350 deg, alert limit "
        "30 deg"
    )
    assert say(rig, phase_lag=16.0) == []  # within the deadband
    assert kinds(say(rig, phase_lag=14.0)) == [("phase", "returned")]
    (event,) = say(rig, phase_lag=200.0)
    assert event.to_level is Level.DANGER


def test_an_acceptance_region_is_left_by_the_amplitude_or_by_the_phase():
    rig = AlarmRig(REGION)
    assert say(rig, amplitude=40.0, phase_lag=350.0) == []
    (event,) = say(rig, amplitude=40.0, phase_lag=25.0)
    assert (event.finding, event.to_level) == ("phase", Level.ALERT)
    assert "35 deg from its reference of 350 deg" in event.message
    (event,) = say(rig, amplitude=90.0, phase_lag=25.0)
    assert (event.finding, event.to_level) == ("high", Level.DANGER)
    assert "1x_amplitude of probe-x is 90 um" in event.message
    (event,) = say(rig, amplitude=40.0, phase_lag=25.0)
    assert (event.finding, event.to_level) == ("phase", Level.ALERT)
    (event,) = say(rig, amplitude=40.0, phase_lag=355.0)
    assert event.kind.value == "returned"
    (event,) = say(rig, amplitude=15.0, phase_lag=355.0)
    assert (event.finding, event.to_level) == ("low", Level.ALERT)
    assert rig.rules[0].limits(UNITS) == (
        "lower alert 20 um, alert 60 um and danger 80 um, 1x_phase_lag alert 30 deg and danger 60 deg from "
        "350 deg"
    )


def test_a_region_holds_what_is_not_known_of_it():
    rig = AlarmRig(REGION)
    say(rig, amplitude=40.0, phase_lag=25.0)
    both = ("1x_amplitude", "1x_phase_lag")
    assert say(rig, unknown=both) == []
    assert say(rig, amplitude=40.0, unknown=("1x_phase_lag",)) == []
    assert rig.status("region").level is Level.ALERT
    (event,) = say(rig, amplitude=85.0, unknown=("1x_phase_lag",))
    assert (event.finding, event.to_level) == ("high", Level.DANGER)
    # Back within the limits of the amplitude: of the phase the last thing that is known stands.
    assert say(rig, amplitude=40.0, unknown=("1x_phase_lag",)) == []
    assert kinds(say(rig, amplitude=40.0, phase_lag=350.0)) == [("region", "returned")]


@pytest.mark.parametrize(
    "found", [{"amplitude": 40.0, "phase_lag": 25.0}, {"amplitude": 65.0, "phase_lag": 350.0}]
)
def test_a_region_goes_on_after_a_restart_where_it_was(found):
    rig = AlarmRig(REGION)
    say(rig, **found)
    after = rig.restarted({"levels/probe-x": ("probe-x",)})
    assert say(after, amplitude=59.0, phase_lag=16.0) == []  # in both deadbands
    assert after.status("region").level is Level.ALERT
    assert kinds(say(after, amplitude=40.0, phase_lag=350.0)) == [("region", "returned")]


def test_phases_vote_against_one_reference():
    rule = VotingRule("turned", ("a", "b"), 2, "1x_phase_lag", PHASE)
    rig = AlarmRig(rule)
    say(rig, "a", phase_lag=350.0)
    say(rig, "b", phase_lag=350.0)
    assert say(rig, "a", phase_lag=25.0) == []
    (event,) = say(rig, "b", phase_lag=30.0)
    assert "40 deg from its reference of 350 deg" in event.message


@pytest.mark.parametrize(
    ("value", "zone"), [(1.39, "A"), (1.4, "B"), (2.79, "B"), (2.8, "C"), (4.5, "D"), (99.0, "D")]
)
def test_each_value_has_its_zone(value, zone):
    assert Setpoint(alert=2.8, danger=4.5, zones=(1.4, 2.8, 4.5)).zone(value) == zone
    assert Setpoint(alert=2.8, danger=4.5).zone(value) == ""


def test_messages_say_the_zone():
    alarm = LevelAlarm(name="zones", sensor="de", measure="velocity_rms").in_zones((1.4, 2.8, 4.5))
    rig = AlarmRig(alarm_rule(alarm))
    assert say(rig, "de", velocity_rms=1.0) == []
    (event,) = say(rig, "de", velocity_rms=3.0)
    assert event.message == (
        "zones alert: velocity_rms of de is 3 mm/s, zone C of ISO 20816-3, alert limit 2.8 mm/s"
    )
    (event,) = say(rig, "de", velocity_rms=5.0)
    assert "zone D of ISO 20816-3, danger limit 4.5 mm/s" in event.message
    (event,) = say(rig, "de", velocity_rms=1.0)
    assert "zone A of ISO 20816-3, below its limit of 2.8 mm/s" in event.message


def test_a_vote_has_zones_too():
    table = {"name": "zones", "sensors": ["a", "b"], "vote": 1, "measure": "velocity_rms"}
    rig = AlarmRig(alarm_rule(VotingAlarm.model_validate(table).in_zones((1.4, 2.8, 4.5))))
    say(rig, "a", velocity_rms=1.0)
    (event,) = say(rig, "b", velocity_rms=3.0)
    assert "velocity_rms of b is 3 mm/s, zone C of ISO 20816-3" in event.message


def test_limits_that_are_stated_win_over_those_of_the_zones():
    alarm = LevelAlarm(name="zones", sensor="de", measure="velocity_rms", alert=2.0).in_zones((1.4, 2.8, 4.5))
    assert alarm.setpoints == {"alert": 2.0, "danger": 4.5}
    (event,) = say(AlarmRig(alarm_rule(alarm)), "de", velocity_rms=2.1)
    assert "zone B of ISO 20816-3, alert limit 2 mm/s" in event.message
