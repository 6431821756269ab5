"""Alarms that are there by themselves can be handled before they are first raised."""

from __future__ import annotations

import pytest
from support.alarm_rig import AlarmRig, alarm_handling

from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.alarms.manager import DiagnosisRule
from daqsvc.alarms.states import AlarmState, CommandNotAllowedError, Level
from daqsvc.settings.alarms import StartUp

SPEAKERS = {"levels/probe-x": ("probe-x",), "rotor-bank": ("probe-x", "probe-y")}
CONDITIONS = ("store/disk", "certificate/broker")
HANDLING = alarm_handling(
    flood=(10, 600),
    start_up=StartUp(
        detector="rotor-bank", measure="speed", between=(300.0, 2700.0), change_per_s=None, at_most_s=100.0
    ),
)
NAMES = ("sensor-ok/probe-x", "detector-ok/rotor-bank", "alarm-flood", "trip-multiply", *CONDITIONS)


@pytest.fixture
def rig():
    made = AlarmRig(DiagnosisRule("rotor-fault", "rotor-bank"), handling=HANDLING)
    made.manager.resume([], SPEAKERS, CONDITIONS)
    return made


def execute(rig, verb, name, duration_s=None):
    command = AlarmCommand(verb=verb, alarm=name, by="ann", duration_s=duration_s)
    return rig.told(rig.manager.execute(command))


@pytest.mark.parametrize("name", NAMES)
def test_one_that_was_never_raised_is_bypassed_over_a_restart_and_put_back(rig, name):
    (bypassed,) = execute(rig, Verb.BYPASS, name)
    assert (bypassed.alarm, bypassed.to_state) == (name, AlarmState.OUT_OF_SERVICE)
    after = rig.restarted(SPEAKERS, CONDITIONS)
    assert after.manager.alarms[name].state is AlarmState.OUT_OF_SERVICE
    (back,) = execute(after, Verb.UNBYPASS, name)
    assert (back.to_state, back.to_level) == (AlarmState.NORMAL, Level.NORMAL)


@pytest.mark.parametrize("name", NAMES)
def test_one_that_was_never_raised_is_shelved_until_its_time_is_over(rig, name):
    execute(rig, Verb.SHELVE, name, 60.0)
    assert rig.manager.alarms[name].state is AlarmState.SHELVED
    rig.clock.advance(61.0)
    (over,) = rig.told(rig.manager.tick())
    assert (over.alarm, over.to_state) == (name, AlarmState.NORMAL)


def test_a_condition_that_comes_behind_the_cover_is_told_of_as_covered(rig):
    execute(rig, Verb.BYPASS, "store/disk")
    (event,) = rig.told(rig.manager.condition("store/disk", Level.ALERT, "the disk is full"))
    assert (event.to_state, event.covered) == (
        AlarmState.OUT_OF_SERVICE,
        AlarmState.ACTIVE_UNACKNOWLEDGED,
    )


def test_a_sensor_that_dies_behind_the_cover_is_told_of_as_covered(rig):
    execute(rig, Verb.BYPASS, "sensor-ok/probe-x")
    events = rig.rms(3.0, quality="not_ok", reason="dead")
    assert ("sensor-ok/probe-x", AlarmState.OUT_OF_SERVICE) in [(e.alarm, e.to_state) for e in events]


def test_a_command_that_is_refused_brings_no_alarm_into_being(rig):
    for verb, duration_s in ((Verb.ACKNOWLEDGE, None), (Verb.SHELVE, 1e9), (Verb.UNBYPASS, None)):
        with pytest.raises(CommandNotAllowedError):
            execute(rig, verb, "store/disk", duration_s)
    assert set(rig.manager.alarms) == {"rotor-fault"}
    assert not rig.manager.conditions


def test_what_cannot_come_is_no_alarm_and_the_refusal_names_those_that_can(rig):
    with pytest.raises(
        CommandNotAllowedError,
        match=r"no alarm is named 'sensor-ok/probe-z'; did you mean 'sensor-ok/.*'\? There are: ",
    ):
        execute(rig, Verb.BYPASS, "sensor-ok/probe-z")
    calm = AlarmRig(DiagnosisRule("rotor-fault", "rotor-bank"))
    for name in ("alarm-flood", "trip-multiply"):
        with pytest.raises(CommandNotAllowedError, match="there are: rotor-fault"):
            execute(calm, Verb.BYPASS, name)


def test_after_a_damaged_journal_they_are_told_as_normal_too(rig):
    told = rig.manager.begin_anew([], "the journal was damaged")
    assert {event.alarm for event in told} == {"rotor-fault", *NAMES}
    assert {event.to_state for event in told} == {AlarmState.NORMAL}
