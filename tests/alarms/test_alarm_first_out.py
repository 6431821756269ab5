"""First-out: which alarm of a group came first, kept until the group is normal again."""

from __future__ import annotations

from support.alarm_rig import AlarmRig

from daqsvc.alarms.commands import Verb
from daqsvc.alarms.rules import DiagnosisRule, LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.states import AlarmState

X = LevelRule("x", "probe-x", "rms", Setpoint(alert=40.0))
Y = LevelRule("y", "probe-y", "rms", Setpoint(alert=40.0))
FAULT = DiagnosisRule("fault", "rotor-bank")
APART = LevelRule("apart", "probe-z", "rms", Setpoint(alert=40.0), group="gearbox")
SPEAKERS = {
    "levels/probe-x": ("probe-x",),
    "levels/probe-y": ("probe-y",),
    "levels/probe-z": ("probe-z",),
    "rotor-bank": ("probe-x", "probe-y"),
}


def first(rig):
    return {name for name, status in rig.manager.alarms.items() if status.first_out}


def test_the_first_alarm_of_the_machine_is_marked_and_no_later_one():
    rig = AlarmRig(X, Y, FAULT)
    assert [event.first_out for event in rig.rms(50.0, sensor="probe-y")] == [True]
    assert [event.first_out for event in rig.rms(50.0)] == [False]
    assert [event.first_out for event in rig.mode("rub", "danger")] == [False]
    assert first(rig) == {"y"}


def test_the_mark_outlives_its_alarm_and_ends_with_the_group():
    rig = AlarmRig(X, Y)
    rig.rms(50.0)
    rig.rms(50.0, sensor="probe-y")
    rig.acknowledge("x")
    assert rig.rms(0.0)[0].to_state is AlarmState.NORMAL
    assert first(rig) == {"x"}
    rig.rms(0.0, sensor="probe-y")
    assert first(rig) == {"x"}
    rig.acknowledge("y")
    assert first(rig) == set()
    rig.rms(50.0, sensor="probe-y")
    assert first(rig) == {"y"}


def test_groups_have_a_first_each():
    rig = AlarmRig(X, Y, APART)
    rig.rms(50.0)
    assert rig.rms(50.0, sensor="probe-z")[0].first_out
    rig.rms(50.0, sensor="probe-y")
    assert first(rig) == {"x", "apart"}


def test_what_is_set_aside_is_not_first_and_what_is_suppressed_stays_it():
    rig = AlarmRig(X, Y)
    rig.ask(Verb.BYPASS, "x")
    assert not rig.rms(50.0)[0].first_out
    assert rig.rms(50.0, sensor="probe-y")[0].first_out
    rig.rms(50.0, "not_ok", sensor="probe-y")
    rig.ask(Verb.UNBYPASS, "x")
    assert first(rig) == {"y"}


def test_the_sensor_checks_do_not_compete():
    rig = AlarmRig(X)
    (quality,) = rig.rms(50.0, "missing")
    assert not quality.first_out
    assert rig.rms(50.0)[-1].first_out


def test_the_mark_is_the_same_after_a_restart_and_an_old_claim_is_worth_nothing():
    rig = AlarmRig(X, Y)
    rig.rms(50.0)  # x is first ...
    rig.rms(50.0, sensor="probe-y")
    rig.acknowledge("x")
    rig.rms(0.0)  # ... and its last event says so
    rig.acknowledge("y")
    rig.rms(0.0, sensor="probe-y")  # the group is normal
    rig.rms(50.0, sensor="probe-y")
    assert first(rig) == {"y"}
    assert first(rig.restarted(SPEAKERS)) == {"y"}
    rig.acknowledge("y")
    rig.rms(0.0, sensor="probe-y")
    assert first(rig.restarted(SPEAKERS)) == set()


def test_a_first_out_that_has_returned_is_still_first_after_a_restart():
    rig = AlarmRig(X, Y)
    rig.rms(50.0)
    rig.rms(50.0, sensor="probe-y")
    rig.acknowledge("x")
    rig.rms(0.0)
    after = rig.restarted(SPEAKERS)
    assert first(after) == {"x"}
    assert not after.acknowledge("y").first_out
    assert first(after) == {"x"}
