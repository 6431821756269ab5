"""What becomes of diagnoses: one alarm each, one event per change, nothing cleared by missing data."""

from __future__ import annotations

import logging

import pytest

from daqsvc.acquisition.clock import DrivenClock
from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.alarms.events import EventKind, Identity
from daqsvc.alarms.manager import AlarmManager, DiagnosisRule, LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.states import AlarmState, CommandNotAllowedError, Level
from daqsvc.diagnosis.record import Diagnosis

MACHINE = Identity("lab", "edge-1", "rig")
LEVEL = LevelRule("vibration-x", "probe-x", "rms", Setpoint(alert=40.0, danger=60.0, deadband=2.0))
LATCHING = LevelRule("vibration-x", "probe-x", "rms", Setpoint(alert=40.0, danger=60.0), latching=True)
ROTOR = DiagnosisRule("rotor-fault", "rotor-bank")
S, K = AlarmState, EventKind


class Desk:
    """A manager and somebody who hands it diagnoses, one a second."""

    def __init__(self, *rules):
        self.clock = DrivenClock(start_ns=0, wall_start_ns=1_000_000_000_000)
        self.manager = AlarmManager(MACHINE, rules, self.clock)
        self.t_ns = 0

    def take(self, **fields):
        self.t_ns += 1_000_000_000
        self.clock.advance_to(self.t_ns)
        fields = {"machine": "rig", "stream": "shaft", "first_index": 0, "end_index": 64, **fields}
        return self.manager.take(Diagnosis(t_ns=self.t_ns, **fields))

    def rms(self, value, quality="good", sensor="probe-x", reason=""):
        return self.take(
            detector=f"levels/{sensor}",
            decision="normal",
            statistics={"rms": value},
            units={"rms": "um"},
            quality=quality,
            reason=reason,
            sensors=(sensor,),
        )

    def ask(self, verb, alarm, by="", **more):
        events = self.manager.execute(AlarmCommand(verb=verb, alarm=alarm, by=by, **more))
        return events[0]

    def acknowledge(self, alarm, by=""):
        return self.ask(Verb.ACKNOWLEDGE, alarm, by)

    def reset(self, alarm, by=""):
        return self.ask(Verb.RESET, alarm, by)

    def mode(self, decision, severity, quality="good", **more):
        return self.take(
            detector="rotor-bank",
            decision=decision,
            severity=severity,
            quality=quality,
            sensors=("probe-x", "probe-y", "keyphasor"),
            **more,
        )


def kinds(events):
    return [(event.alarm, event.kind) for event in events]


def test_a_level_alarm_from_the_cradle_to_the_grave():
    desk = Desk(LEVEL)
    assert desk.rms(39.9) == []
    [raised] = desk.rms(40.0)
    assert (raised.kind, raised.from_state, raised.to_state) == (K.RAISED, S.NORMAL, S.ACTIVE_UNACKNOWLEDGED)
    assert (raised.from_level, raised.to_level) == (Level.NORMAL, Level.ALERT)
    assert raised.message == "vibration-x alert: rms of probe-x is 40 um, alert limit 40 um"
    assert (raised.t_ns, raised.wall_ns) == (2_000_000_000, 1_002_000_000_000)
    assert raised.cause.statistics["rms"] == 40.0
    [escalated] = desk.rms(61.0)
    assert (escalated.kind, escalated.to_level) == (K.ESCALATED, Level.DANGER)
    [lowered] = desk.rms(57.0)
    assert (lowered.kind, lowered.from_level, lowered.to_level) == (K.LOWERED, Level.DANGER, Level.ALERT)
    assert desk.rms(38.5) == []
    [returned] = desk.rms(37.0)
    assert (returned.kind, returned.to_state) == (K.RETURNED, S.RETURNED_UNACKNOWLEDGED)
    assert returned.message.endswith("below its limit of 40 um")
    acknowledged = desk.acknowledge("vibration-x", by="ann")
    assert (acknowledged.to_state, acknowledged.by) == (S.NORMAL, "ann")
    occurrences = {e.occurrence for e in (raised, escalated, lowered, returned, acknowledged)}
    assert len(occurrences) == 1
    assert desk.manager.alarms["vibration-x"].occurrence is None


def test_each_activation_is_an_occurrence_of_its_own():
    desk = Desk(LEVEL)
    first = desk.rms(50.0)[0].occurrence
    desk.rms(0.0)
    assert desk.rms(50.0)[0].occurrence != first


def test_an_escalation_wants_to_be_acknowledged_again():
    desk = Desk(LEVEL)
    desk.rms(50.0)
    assert desk.acknowledge("vibration-x").to_state is S.ACTIVE_ACKNOWLEDGED
    [event] = desk.rms(70.0)
    assert (event.from_state, event.to_state) == (S.ACTIVE_ACKNOWLEDGED, S.ACTIVE_UNACKNOWLEDGED)


def test_a_latched_alarm_keeps_its_worst_level_and_refuses_reset_while_it_stands():
    desk = Desk(LATCHING)
    desk.rms(70.0)
    assert desk.rms(50.0) == []
    with pytest.raises(
        CommandNotAllowedError, match="cannot reset vibration-x: its condition is still present"
    ):
        desk.reset("vibration-x")
    [latched] = desk.rms(0.0)
    assert (latched.kind, latched.to_state) == (K.LATCHED, S.LATCHED_UNACKNOWLEDGED)
    assert latched.to_level is Level.DANGER
    [again] = desk.rms(45.0)
    assert (again.kind, again.occurrence) == (K.RECURRED, latched.occurrence)
    desk.rms(0.0)
    desk.acknowledge("vibration-x")
    reset = desk.reset("vibration-x", by="bob")
    assert (reset.to_state, reset.to_level, reset.by) == (S.NORMAL, Level.NORMAL, "bob")


def test_a_diagnosis_alarm_is_one_alarm_that_is_refined():
    desk = Desk(ROTOR)
    assert desk.mode("undetermined", "normal") == []
    assert desk.mode("N", "normal") == []
    [raised] = desk.mode("F1", "alert", probabilities={"F1": 0.984, "N": 0.016}, group=("F1", "F1L2"))
    assert raised.message == ("rotor-fault alert: rotor-bank finds F1, p = 0.984, not told apart from F1L2")
    assert desk.mode("F1", "alert", probabilities={"F1": 0.99}) == []
    [changed] = desk.mode("F1L2", "alert")
    assert (changed.kind, changed.occurrence) == (K.CHANGED, raised.occurrence)
    assert desk.mode("undetermined", "normal") == []
    [escalated] = desk.mode("F1L3", "danger")
    assert (escalated.kind, escalated.occurrence) == (K.ESCALATED, raised.occurrence)
    [returned] = desk.mode("N", "normal")
    assert (returned.kind, returned.occurrence) == (K.RETURNED, raised.occurrence)


def test_missing_data_holds_and_is_an_event_of_its_own():
    desk = Desk(LEVEL)
    desk.rms(50.0)
    [missing] = desk.rms(0.0, "missing", reason="60 % of the window is missing")
    assert (missing.alarm, missing.kind) == ("sensor-ok/probe-x", K.RAISED)
    assert "60 % of the window is missing" in missing.message
    assert desk.rms(0.0, "missing") == []
    assert desk.manager.alarms["vibration-x"].state is S.ACTIVE_UNACKNOWLEDGED
    assert kinds(desk.rms(50.0)) == [("sensor-ok/probe-x", K.RETURNED)]


def test_missing_data_does_not_raise_a_delayed_alarm_either():
    rule = LevelRule("slow", "probe-x", "rms", Setpoint(alert=40.0, on_delay_ns=3_000_000_000))
    desk = Desk(rule)
    desk.rms(50.0)
    for _ in range(5):
        desk.rms(50.0, "missing")
    assert kinds(desk.rms(50.0)) == [("sensor-ok/probe-x", K.RETURNED)]
    assert desk.rms(50.0) == desk.rms(50.0) == []
    assert kinds(desk.rms(50.0)) == [("slow", K.RAISED)]


def test_a_sensor_that_is_not_ok_suppresses_what_rests_on_it_and_nothing_else():
    other = LevelRule("vibration-y", "probe-y", "rms", Setpoint(alert=40.0))
    desk = Desk(LEVEL, other, ROTOR)
    desk.mode("F1", "alert")
    desk.rms(50.0)
    events = desk.rms(0.0, "not_ok", reason="gap voltage is -0.1 V")
    assert kinds(events) == [
        ("sensor-ok/probe-x", K.RAISED),
        ("vibration-x", K.SUPPRESSED),
        ("rotor-fault", K.SUPPRESSED),
    ]
    assert "gap voltage is -0.1 V" in events[1].message
    assert desk.manager.alarms["vibration-y"].state is S.NORMAL
    assert desk.mode("F1L3", "danger") == []
    with pytest.raises(CommandNotAllowedError, match="it is suppressed"):
        desk.acknowledge("vibration-x")
    events = desk.rms(30.0)
    assert kinds(events) == [
        ("sensor-ok/probe-x", K.RETURNED),
        ("vibration-x", K.UNSUPPRESSED),
        ("rotor-fault", K.UNSUPPRESSED),
        ("vibration-x", K.RETURNED),
    ]
    assert events[1].to_state is S.ACTIVE_UNACKNOWLEDGED
    assert kinds(desk.mode("F1L3", "danger")) == [("rotor-fault", K.ESCALATED)]


def test_missing_samples_do_not_lift_a_suppression():
    desk = Desk(LEVEL)
    desk.rms(50.0, "not_ok")
    assert kinds(desk.rms(50.0, "missing")) == [("sensor-ok/probe-x", K.CHANGED)]
    assert desk.manager.alarms["vibration-x"].state is S.SUPPRESSED


def test_a_detector_on_several_sensors_blames_none_of_them():
    desk = Desk(LEVEL, ROTOR)
    events = desk.mode("N", "normal", quality="not_ok", reason="a probe is dead")
    assert kinds(events) == [("detector-ok/rotor-bank", K.RAISED), ("rotor-fault", K.SUPPRESSED)]
    assert kinds(desk.rms(50.0)) == [("vibration-x", K.RAISED)]


def test_a_sensor_is_good_again_only_when_every_detector_says_so():
    desk = Desk(LEVEL)
    desk.rms(0.0, "not_ok", reason="dead")
    good = {"decision": "normal", "sensors": ("probe-x",)}
    assert desk.take(detector="bearing", **good) == []
    assert desk.manager.alarms["sensor-ok/probe-x"].state is S.ACTIVE_UNACKNOWLEDGED
    assert ("sensor-ok/probe-x", K.RETURNED) in kinds(desk.rms(0.0))


@pytest.mark.gives("A16")
def test_a_measure_that_the_detector_does_not_have_is_reported_once(caplog):
    desk = Desk(LevelRule("odd", "probe-x", "velocity_rms", Setpoint(alert=1.0)))
    with caplog.at_level(logging.ERROR):
        assert desk.rms(50.0) == desk.rms(50.0) == []
    assert len(caplog.records) == 1
    assert "levels/probe-x measures rms, not 'velocity_rms'" in caplog.text


def test_wrong_wiring_is_refused():
    with pytest.raises(ValueError, match="two alarms are named 'rotor-fault'"):
        Desk(ROTOR, ROTOR)
    with pytest.raises(ValueError, match="taken by the sensor checks"):
        Desk(DiagnosisRule("sensor-ok/x", "rotor-bank"))
    desk = Desk(LEVEL)
    with pytest.raises(ValueError, match="machine 'other'"):
        desk.take(machine="other", detector="levels/probe-x", decision="normal")
    with pytest.raises(
        CommandNotAllowedError,
        match=r"no alarm is named 'vibration-z'; did you mean 'vibration-x'[?] There are: vibration-x$",
    ):
        desk.acknowledge("vibration-z")
    with pytest.raises(CommandNotAllowedError, match="never been raised"):
        desk.acknowledge("vibration-x")


def test_from_too_high_to_too_low_is_a_change_of_one_alarm():
    rule = LevelRule("window", "probe-x", "rms", Setpoint(alert=40.0, alert_low=10.0, deadband=2.0))
    desk = Desk(rule)
    (raised,) = desk.rms(45.0)
    assert (raised.kind, raised.finding) == (EventKind.RAISED, "high")
    assert "alert limit 40 um" in raised.message
    (changed,) = desk.rms(9.0)
    assert (changed.kind, changed.finding, changed.occurrence) == (
        EventKind.CHANGED,
        "low",
        raised.occurrence,
    )
    assert "rms of probe-x is 9 um, lower alert limit 10 um" in changed.message
    assert desk.rms(11.9) == []
    (returned,) = desk.rms(12.1)
    assert returned.kind is EventKind.RETURNED
    assert "between its limits of 10 and 40 um" in returned.message
