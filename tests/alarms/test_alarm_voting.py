"""Voting: enough sensors must agree, and one that is silent counts for neither side."""

from __future__ import annotations

import itertools

import pytest
from support.alarm_rig import AlarmRig, kinds

from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.states import AlarmState, Level
from daqsvc.alarms.voting import VotingRule

SENSORS = ("a", "b", "c")
SETPOINT = Setpoint(alert=40.0, danger=60.0)
TWO_OF_THREE = VotingRule("vibration", SENSORS, 2, "rms", SETPOINT)
VALUES = {"0": 0.0, "A": 50.0, "D": 70.0}


def voted(said, rule=TWO_OF_THREE):
    """A rig whose sensors have said ``said``, in turn: 0 normal, A alert, D danger, m missing, n not OK."""
    rig = AlarmRig(rule)
    say(rig, said)
    return rig


def say(rig, said):
    events = []
    for sensor, word in zip(SENSORS, said, strict=True):
        if word in VALUES:
            events += rig.rms(VALUES[word], sensor=sensor)
        elif word in "mn":
            events += rig.rms(0.0, {"m": "missing", "n": "not_ok"}[word], sensor=sensor)
    return [event for event in events if event.alarm == "vibration"]


@pytest.mark.parametrize("vote", [1, 2, 3])
@pytest.mark.parametrize("said", ["".join(said) for said in itertools.product("0AD", repeat=3)])
def test_a_level_is_reached_when_enough_sensors_are_there(vote, said):
    rig = voted(said, VotingRule("vibration", SENSORS, vote, "rms", SETPOINT))
    levels = sorted({"0": Level.NORMAL, "A": Level.ALERT, "D": Level.DANGER}[word] for word in said)
    assert rig.status("vibration").level is levels[-vote]


@pytest.mark.parametrize("silent", "mn.")
def test_one_vote_and_a_silent_sensor_are_no_alarm(silent):
    assert voted(f"A0{silent}").status("vibration").own_state is AlarmState.NORMAL


@pytest.mark.parametrize("silent", "mn")
def test_a_sensor_that_falls_silent_does_not_clear_the_alarm(silent):
    rig = voted("AA0")
    assert say(rig, f"{silent}A0") == []
    assert rig.status("vibration").own_state is AlarmState.ACTIVE_UNACKNOWLEDGED


@pytest.mark.parametrize("silent", "mn")
def test_what_not_even_the_silent_ones_could_make_up_is_cleared(silent):
    rig = voted("AA0")
    events = say(rig, f"{silent}00")
    assert kinds(events) == [("vibration", "returned")]


def test_too_few_sensors_for_a_vote_suppress_the_alarm():
    rig = voted("AA0")
    assert kinds(say(rig, "n..")) == []
    assert kinds(say(rig, ".n.")) == [("vibration", "suppressed")]
    assert say(rig, "..0") == []
    assert kinds(say(rig, "A..")) == [("vibration", "unsuppressed")]
    assert rig.status("vibration").state is AlarmState.ACTIVE_UNACKNOWLEDGED
    assert say(rig, "..0") == []
    assert kinds(say(rig, ".0.")) == [("vibration", "returned")]


def test_a_sensor_that_somebody_else_blames_has_no_vote():
    rig = AlarmRig(TWO_OF_THREE)
    rig.take(detector="bearing", decision="normal", quality="not_ok", sensors=("a",))
    assert say(rig, "AA0") == []
    assert rig.status("vibration").own_state is AlarmState.NORMAL
    rig.take(detector="bearing", decision="normal", sensors=("a",))
    assert kinds(say(rig, "A..")) == [("vibration", "raised")]


def test_the_message_says_who_votes():
    rig = voted("A.m")
    (raised,) = say(rig, ".D.")
    assert raised.message == (
        "vibration alert: 2 of 3 sensors are at a limit (a, b), it takes 2; "
        "rms of b is 70 um, danger limit 60 um; no vote from c"
    )


def test_a_vote_that_stood_before_a_restart_stands_after_it():
    rig = voted("AA0")
    after = rig.restarted({f"levels/{sensor}": (sensor,) for sensor in SENSORS})
    assert after.status("vibration").state is AlarmState.ACTIVE_UNACKNOWLEDGED
    assert say(after, "A..") == []
    assert say(after, ".0.") == []
    assert kinds(say(after, "..0")) == [("vibration", "returned")]


@pytest.mark.parametrize(("sensors", "vote"), [(("a", "a"), 1), (("a", "b"), 3), (("a", "b"), 0)])
def test_votes_that_cannot_be_are_refused(sensors, vote):
    with pytest.raises(ValueError, match="alarm vibration: "):
        VotingRule("vibration", sensors, vote, "rms", SETPOINT)
