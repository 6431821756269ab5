"""Trip multiply: limits are raised while the machine starts up, for a limited time; nothing is cleared."""

from __future__ import annotations

import pytest
from support.alarm_rig import AlarmRig, alarm_handling, kinds

from daqsvc.alarms.rules import LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.states import AlarmState
from daqsvc.alarms.voting import VotingRule
from daqsvc.settings.alarms import StartUp

SETPOINT = Setpoint(alert=40.0, danger=60.0, deadband=2.0)
DOUBLED = LevelRule("vibration-x", "probe-x", "rms", SETPOINT, trip_multiply=2.0)
PLAIN = LevelRule("vibration-y", "probe-y", "rms", SETPOINT)
THROUGH_CRITICAL = StartUp(detector="rotor-bank", between=(300.0, 2700.0), at_most_s=30.0)
ON_THE_MOVE = StartUp(detector="rotor-bank", change_per_s=20.0)


def rig_with(start_up, *rules):
    return AlarmRig(*rules, handling=alarm_handling(start_up=start_up))


def turn(rig, speed_rpm, quality="missing", seconds=1.0):
    """A detector that judges nothing at this speed still knows it."""
    return rig.mode("N", "normal", quality, statistics={"speed": speed_rpm}, seconds=seconds)


def test_limits_are_multiplied_while_the_speed_is_in_the_range_and_only_where_the_alarm_says_so():
    rig = rig_with(THROUGH_CRITICAL, DOUBLED, PLAIN)
    turn(rig, 1500.0)
    assert rig.manager.multiplies
    assert rig.rms(79.0) == []
    assert kinds(rig.rms(50.0, sensor="probe-y")) == [("vibration-y", "raised")]
    (raised,) = rig.rms(80.0)
    assert raised.message == (
        "vibration-x alert: rms of probe-x is 80 um, alert limit 40 um times 2 at start-up"
    )
    assert rig.rms(120.0)[0].to_level.label == "danger"


def test_they_are_single_again_when_the_start_up_is_over():
    rig = rig_with(THROUGH_CRITICAL, DOUBLED)
    turn(rig, 1500.0)
    assert rig.rms(50.0) == []
    turn(rig, 3000.0)
    assert kinds(rig.rms(50.0)) == [("vibration-x", "raised")]


def test_a_start_up_returns_no_alarm_that_stands():
    rig = rig_with(THROUGH_CRITICAL, DOUBLED)
    turn(rig, 3000.0)
    rig.rms(50.0)
    turn(rig, 1500.0)
    assert rig.rms(50.0) == []
    assert rig.status("vibration-x").state is AlarmState.ACTIVE_UNACKNOWLEDGED
    assert kinds(rig.rms(37.0)) == [("vibration-x", "returned")]


def test_it_ends_by_itself_and_says_so():
    rig = rig_with(THROUGH_CRITICAL, DOUBLED)
    turn(rig, 1500.0)
    assert rig.tick(30.0) == []
    (overrun,) = rig.tick(0.1)
    assert (overrun.alarm, overrun.kind.value) == ("trip-multiply", "raised")
    assert "for more than 30 s; limits are no longer multiplied" in overrun.message
    turn(rig, 1500.0)
    assert kinds(rig.rms(50.0)) == [("vibration-x", "raised")]
    turn(rig, 3000.0)
    assert kinds(rig.tick()) == [("trip-multiply", "returned")]
    turn(rig, 1500.0)
    assert rig.manager.multiplies


def test_a_signal_that_falls_silent_does_not_keep_limits_raised():
    rig = rig_with(THROUGH_CRITICAL, DOUBLED)
    turn(rig, 1500.0)
    assert rig.rms(50.0, seconds=29.0) == []
    assert kinds(rig.rms(50.0, seconds=2.0)) == [("vibration-x", "raised")]
    assert not rig.manager.multiplies


@pytest.mark.parametrize(("rpm_per_s", "multiplies"), [(19.0, False), (21.0, True), (-21.0, True)])
def test_a_speed_on_the_move_is_a_start_up_too(rpm_per_s, multiplies):
    rig = rig_with(ON_THE_MOVE, DOUBLED)
    for second in range(4):
        turn(rig, 1000.0 + rpm_per_s * second)
    assert rig.manager.multiplies is multiplies
    turn(rig, 1000.0 + 3 * rpm_per_s)
    assert not rig.manager.multiplies


def test_jitter_from_statement_to_statement_is_no_start_up():
    rig = rig_with(ON_THE_MOVE, DOUBLED)
    for step in range(40):
        turn(rig, 1000.0 + 3.0 * (step % 2), seconds=0.05)
        assert not rig.manager.multiplies


def test_a_bad_keyphasor_and_a_speed_that_is_not_known_say_nothing():
    rig = rig_with(THROUGH_CRITICAL, DOUBLED)
    turn(rig, 1500.0, "not_ok")
    turn(rig, float("nan"))
    rig.mode("N", "normal")
    assert not rig.manager.multiplies


def test_a_vote_is_multiplied_as_well():
    rule = VotingRule("vote", ("a", "b"), 2, "rms", SETPOINT, trip_multiply=3.0)
    rig = rig_with(THROUGH_CRITICAL, rule)
    turn(rig, 1500.0)
    assert rig.rms(110.0, sensor="a") == rig.rms(110.0, sensor="b") == []
    turn(rig, 3000.0)
    rig.rms(110.0, sensor="a")
    assert kinds(rig.rms(110.0, sensor="b")) == [("vote", "raised")]
