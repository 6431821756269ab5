"""What alarms do with the last that was told of them before a restart."""

from __future__ import annotations

import dataclasses
import json
import logging
from typing import TYPE_CHECKING, Any

import pytest
from support.alarm_desk import alarm_service

from daqsvc.acquisition.clock import DrivenClock
from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.alarms.events import EventKind, Identity
from daqsvc.alarms.manager import AlarmManager, DiagnosisRule, LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.states import AlarmState, Level
from daqsvc.alarms.voting import VotingRule
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.outbox.store import OutboxMessage
from daqsvc.publish.payloads import alarm_event, alarm_payload, restore_alarms
from daqsvc.publish.topics import Topics

if TYPE_CHECKING:
    from pathlib import Path

RIG = Identity("lab", "edge-1", "rig")
LEVEL = LevelRule("vibration-x", "probe-x", "rms", Setpoint(alert=40.0, danger=60.0, deadband=2.0))
ROTOR = DiagnosisRule("rotor-fault", "rotor-bank")
SENSORS = ("probe-x", "probe-y")
SPEAKERS = {"levels/probe-x": ("probe-x",), "rotor-bank": SENSORS}
S, K = AlarmState, EventKind


def manager(*rules, identity=RIG, start_ns=0, wall_ns=10**18):
    return AlarmManager(identity, rules, DrivenClock(start_ns=start_ns, wall_start_ns=wall_ns))


def rms(value, quality="good", reason=""):
    statistics = {"rms": value}
    return Diagnosis(
        "rig",
        "levels/probe-x",
        1_000,
        "shaft",
        0,
        64,
        "normal",
        statistics=statistics,
        quality=quality,
        reason=reason,
        sensors=("probe-x",),
    )


def mode(decision, severity, quality="good"):
    return Diagnosis(
        "rig",
        "rotor-bank",
        1_000,
        "shaft",
        0,
        64,
        decision,
        severity=severity,
        quality=quality,
        sensors=SENSORS,
    )


def history(subject, *diagnoses):
    """The last event of each alarm."""
    last = {}
    for diagnosis in diagnoses:
        for event in subject.take(diagnosis):
            last[event.alarm] = event
    return list(last.values())


def kinds(events):
    return [(event.alarm, event.kind) for event in events]


def test_a_condition_that_cleared_while_nobody_looked_returns_its_occurrence():
    told = history(manager(ROTOR), mode("F1", "alert"))
    after = manager(ROTOR)
    assert after.resume(told, SPEAKERS) == []
    assert after.take(mode("undetermined", "normal")) == []
    (event,) = after.take(mode("N", "normal"))
    assert event.kind is K.RETURNED
    assert event.occurrence == told[0].occurrence
    assert (event.from_state, event.to_state) == (S.ACTIVE_UNACKNOWLEDGED, S.RETURNED_UNACKNOWLEDGED)


@pytest.mark.parametrize(
    ("decision", "severity", "kind"),
    [("F1", "alert", None), ("F2", "alert", K.CHANGED), ("F3", "danger", K.ESCALATED)],
)
def test_a_condition_that_stands_goes_on_with_its_occurrence(decision, severity, kind):
    told = history(manager(ROTOR), mode("F1", "alert"))
    after = manager(ROTOR)
    after.resume(told, SPEAKERS)
    events = after.take(mode(decision, severity))
    assert [event.kind for event in events] == ([] if kind is None else [kind])
    assert after.alarms["rotor-fault"].occurrence == told[0].occurrence


@pytest.mark.parametrize(("value", "returns"), [(39.0, False), (37.0, True)])
def test_the_deadband_outlives_a_restart(value, returns):
    told = history(manager(LEVEL), rms(50.0))
    after = manager(LEVEL)
    after.resume(told, SPEAKERS)
    assert kinds(after.take(rms(value))) == ([("vibration-x", K.RETURNED)] if returns else [])


def test_a_limit_that_the_machine_file_has_raised_lowers_the_level():
    told = history(manager(LEVEL), rms(70.0))
    after = manager(dataclasses.replace(LEVEL, setpoint=Setpoint(alert=40.0)))
    after.resume(told, SPEAKERS)
    assert kinds(after.take(rms(70.0))) == [("vibration-x", K.LOWERED)]


def test_a_suppression_holds_until_the_sensor_is_good_and_uncovers_what_it_covered():
    told = history(manager(LEVEL, ROTOR), mode("F1", "alert"), rms(9.0, "not_ok", "gap voltage is -20 V"))
    assert {event.alarm for event in told} == {"rotor-fault", "vibration-x", "sensor-ok/probe-x"}
    after = manager(LEVEL, ROTOR)
    after.resume(told, SPEAKERS)
    assert after.take(mode("F1", "alert")) == []
    assert kinds(after.take(rms(9.0, "missing"))) == [("sensor-ok/probe-x", K.CHANGED)]
    events = after.take(rms(9.0))
    assert kinds(events) == [
        ("sensor-ok/probe-x", K.RETURNED),
        ("vibration-x", K.UNSUPPRESSED),
        ("rotor-fault", K.UNSUPPRESSED),
    ]
    assert events[1].to_state is S.NORMAL
    assert events[2].to_state is S.ACTIVE_UNACKNOWLEDGED


def test_a_suppression_by_a_sensor_that_is_gone_ends_with_the_alarms_own_good_statement():
    told = history(manager(ROTOR), mode("F1", "alert"), rms(9.0, "not_ok"))
    after = manager(ROTOR)
    gone = after.resume(told, {"rotor-bank": SENSORS})
    assert kinds(gone) == [("sensor-ok/probe-x", K.RETURNED)]
    assert "the machine file no longer has it" in gone[0].message
    assert "rotor-fault" not in {event.alarm for event in after.take(mode("F1", "alert", "missing"))}
    assert ("rotor-fault", K.UNSUPPRESSED) in kinds(after.take(mode("F1", "alert")))


def test_a_sensor_stays_in_doubt_until_the_detector_that_doubts_it_is_content():
    told = history(manager(), rms(9.0, "missing"))
    after = manager()
    after.resume(told, {"levels/probe-x": ("probe-x",), "spectrum/probe-x": ("probe-x",)})
    other = dataclasses.replace(rms(9.0), detector="spectrum/probe-x")
    assert after.take(other) == []
    assert kinds(after.take(rms(9.0))) == [("sensor-ok/probe-x", K.RETURNED)]


def test_an_alarm_of_a_machine_that_was_renamed_is_returned_under_its_old_name():
    told = history(manager(ROTOR), mode("F1", "alert"))
    renamed = dataclasses.replace(RIG, machine="pump")
    (event,) = manager(ROTOR, identity=renamed).resume(told, SPEAKERS)
    assert (event.identity, event.alarm, event.kind) == (RIG, "rotor-fault", K.RETURNED)
    assert (event.to_state, event.to_level, event.occurrence) == (
        S.NORMAL,
        Level.NORMAL,
        told[0].occurrence,
    )


def test_when_it_was_is_told_by_the_wall_clock_after_a_reboot():
    told = history(manager(ROTOR, start_ns=5_000_000, wall_ns=10**18), mode("F1", "alert"))
    after = manager(ROTOR, start_ns=7, wall_ns=10**18 + 60_000_000_000)
    after.resume(told, SPEAKERS)
    since = after.alarms["rotor-fault"].since
    assert since.wall_ns == told[0].wall_ns
    assert 7 - since.t_ns == 10**18 + 60_000_000_000 - told[0].wall_ns


def test_what_cannot_be_read_is_left_out_and_logged_once(caplog):
    topics = Topics("daqsvc", "lab", "edge-1")
    (event,) = history(manager(ROTOR), mode("F1", "alert"))
    good = alarm_payload(event, 7, "series").to_json()
    shelved = json.dumps(json.loads(good) | {"state": "shelved"}).encode()
    topic = topics.alarm("rig", "rotor-fault")
    other_box = topic.replace("edge-1", "edge-2")
    rows = [
        (topic, good),
        (topic, b"\xff"),
        (topic, good.replace(b"daqsvc.alarm/1", b"daqsvc.alarm/9")),
        (topic, shelved),
        (topics.alarm("rig", "rotor"), good),
        (other_box, b"not ours to read"),
        (topics.availability, b"no alarm"),
    ]
    messages = [OutboxMessage(n, *row, retain=True) for n, row in enumerate(rows)]
    with caplog.at_level(logging.WARNING):
        assert restore_alarms(messages, topics) == [event]
    (record,) = caplog.records
    assert record.getMessage().startswith("4 alarm states of the journal cannot be read")
    assert alarm_event(good) == event


def test_a_suppression_that_an_earlier_version_told_is_taken_over():
    (_, event) = history(manager(ROTOR), mode("F1", "alert"), rms(9.0, "not_ok"))[::-1]
    assert event.kind is K.SUPPRESSED
    told = json.loads(alarm_payload(event, 7, "series").to_json())
    for key in ("reason", "holds", "covered", "shelved_until_wall_ns", "first_out", "chattering", "found"):
        del told[key]
    del told["doubts"]
    before = alarm_event(json.dumps(told).encode())
    assert (before.holds, before.covered) == ((S.SUPPRESSED,), S.ACTIVE_UNACKNOWLEDGED)
    after = manager(ROTOR)
    after.resume([before], SPEAKERS)
    assert after.alarms["rotor-fault"].state is S.SUPPRESSED
    assert kinds(after.take(mode("F1", "alert")))[0] == ("rotor-fault", K.UNSUPPRESSED)
    assert after.alarms["rotor-fault"].state is S.ACTIVE_UNACKNOWLEDGED


@pytest.mark.parametrize(
    "forged",
    [
        {"state": "shelved", "holds": ["shelved"], "covered": "normal"},  # until when?
        {"state": "shelved", "holds": ["shelved"], "shelved_until_wall_ns": 5},  # over what?
        {"holds": ["suppressed"], "covered": "normal"},
        {"state": "suppressed", "holds": ["suppressed"], "covered": "shelved"},
        {"holds": ["normal"], "covered": "normal"},
        {"covered": "normal"},
        {"shelved_until_wall_ns": 5},
    ],
)
def test_a_payload_whose_covers_contradict_each_other_is_refused(forged):
    (event,) = history(manager(ROTOR), mode("F1", "alert"))
    payload = json.loads(alarm_payload(event, 7, "series").to_json()) | forged
    with pytest.raises(ValueError, match="none of this program's"):
        alarm_event(json.dumps(payload).encode())


class Journal(dict[str, Any]):
    """The last event of each alarm, in the order of the events."""

    def take(self, subject, diagnosis, lost=()):
        events = subject.take(diagnosis)
        for event in events:
            if event.alarm not in lost:
                self.pop(event.alarm, None)
                self[event.alarm] = event
        return kinds(events)


def test_missing_data_after_two_restarts_suppress_nothing_that_was_good_between_them():
    """Who says good while another has not spoken yet makes no event of the sensor; those it lifts say so."""
    speakers = {"levels/probe-x": ("probe-x",), "bearing": ("probe-x",), "bearing-fe": ("probe-x",)}

    def bearing(quality):
        return dataclasses.replace(rms(1.0, quality), detector="bearing")

    journal = Journal()
    take = journal.take
    first = manager(LEVEL)
    assert first.resume([], speakers) == []
    assert ("vibration-x", K.SUPPRESSED) in take(first, bearing("not_ok"))
    second = manager(LEVEL)
    second.resume(list(journal.values()), speakers)
    assert take(second, bearing("good")) == [("vibration-x", K.UNSUPPRESSED)]
    third = manager(LEVEL)
    third.resume(list(journal.values()), speakers)
    assert take(third, bearing("missing")) == []
    assert ("vibration-x", K.SUPPRESSED) in take(third, bearing("not_ok"))


@pytest.mark.parametrize("other", ["has turned to another sensor", "was cut off by a crash"])
def test_a_sensor_that_is_not_ok_again_in_the_same_words_stays_so_over_a_restart(other):
    """That is no event of the sensor while another has not spoken yet; who is suppressed again says so."""
    second_rule = dataclasses.replace(LEVEL, alarm="vibration-x-2")
    speakers = {"levels/probe-x": ("probe-x",), "bearing": ("probe-x",), "bearing-fe": ("probe-x",)}
    turns = other == "has turned to another sensor"
    rules = [LEVEL, DiagnosisRule("fault", "bearing-fe")] if turns else [LEVEL, second_rule]

    def bearing(quality):
        return dataclasses.replace(rms(1.0, quality), detector="bearing", reason="clipped")

    def fault(sensor):
        said = mode("F1", "alert")
        return dataclasses.replace(said, detector="bearing-fe", sensors=(sensor,))

    journal = Journal()
    journal.take(manager(*rules), bearing("not_ok"))
    second = manager(*rules)
    second.resume(list(journal.values()), speakers)
    assert ("vibration-x", K.UNSUPPRESSED) in journal.take(second, bearing("good"))
    if turns:
        assert journal.take(second, fault("probe-x")) == [("fault", K.RAISED)]
        assert journal.take(second, fault("probe-y")) == []
    again = journal.take(second, bearing("not_ok"), lost=["vibration-x-2"])
    assert again[0] == ("vibration-x", K.SUPPRESSED)
    assert not any(name.startswith("sensor-ok") for name, _ in again)
    third = manager(*rules)
    third.resume(list(journal.values()), speakers)
    assert ("vibration-x", K.UNSUPPRESSED) not in journal.take(third, rms(1.0)), "the other one has clipped"
    assert ("vibration-x", K.UNSUPPRESSED) in journal.take(third, bearing("good"))


@pytest.mark.parametrize("handled", [False, True])
async def test_an_alarm_that_stands_does_not_go_on_naming_a_limit_that_a_reload_has_changed(
    tmp_path: Path, *, handled: bool
) -> None:
    """What was said when it was raised is history and stays; what is shown as present names both."""
    level = dataclasses.replace(LEVEL, setpoint=Setpoint(alert=15.0, danger=25.0))
    clock, voted = DrivenClock(), VotingRule("either", ("probe-x", "probe-y"), 1, "rms", level.setpoint)
    service = alarm_service(RIG, [level, voted, ROTOR], tmp_path, clock)

    def reload(setpoint: Setpoint) -> list[str]:
        rules = [dataclasses.replace(level, setpoint=setpoint), voted, ROTOR]
        anew = AlarmManager(RIG, rules, clock)
        service.change([anew], gone=(), buses={}, active_detectors=SPEAKERS, outputs=None)
        return [anew.alarms[name].message for name in ("vibration-x", "either", "rotor-fault")]

    await service.open()
    try:
        service.take(dataclasses.replace(rms(19.6), units={"rms": "um"}))
        service.take(mode("F1", "alert"))
        _, of_vote, of_mode = [one.message for one in service.manager.alarms.values()]
        if handled:
            await service.execute(AlarmCommand(verb=Verb.ACKNOWLEDGE, alarm="vibration-x", by="ann"), "test")
        found = "vibration-x alert: rms of probe-x is 19.6 um, alert limit 15 um"
        for setpoint, said in (
            (Setpoint(alert=16.0, danger=30.0), "alert 16 um and danger 30 um"),
            (
                Setpoint(alert=17.0, alert_low=2.0),
                "lower alert 2 um and alert 17 um",
            ),
        ):
            assert reload(setpoint) == [f"{found}; since then its limits are {said}", of_vote, of_mode]
        assert reload(setpoint)[0].endswith(said), "the same again says nothing new"
        events = [json.loads(one.payload) for one in await service.outbox.following(0, 100)]
        told = [(event["kind"], event["state"]) for event in events if event["alarm"] == "vibration-x"]
        state = "active_acknowledged" if handled else "active_unacknowledged"
        acknowledged = [("acknowledged", state)] * handled
        assert told == [("raised", "active_unacknowledged"), *acknowledged, *[("changed", state)] * 2]
        assert events[0]["message"] == found
        service.take(dataclasses.replace(rms(10.0), units={"rms": "um"}))
        assert "returned to normal" in service.manager.alarms["vibration-x"].message
    finally:
        await service.settle(5.0)
        await service.close(5.0)
