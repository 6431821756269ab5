"""Alarm events in the log: each, unless they come faster than anybody reads."""

from __future__ import annotations

import dataclasses
import logging

import pytest
from support.alarm_rig import AlarmRig

from daqsvc.alarm_log import LINE_EVERY_NS, LINES, AlarmLog
from daqsvc.alarms.manager import LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.states import Level


@pytest.mark.gives("A17", "S11")
def test_a_flood_is_counted_once_a_second_and_what_comes_after_it_is_named(caplog):
    caplog.set_level(logging.INFO, "daqsvc.alarm_log")
    rig = AlarmRig(LevelRule("vibration-x", "probe-x", "rms", Setpoint(alert=4.0)))
    raised, returned = [event for value in (5.0, 1.0) for event in rig.rms(value)]
    log = AlarmLog(rig.clock)
    for _ in range(LINES):
        log.say(raised)
    log.sum_up()
    assert len(caplog.records) == LINES
    assert {record.levelname for record in caplog.records} == {"WARNING"}
    assert raised.message in caplog.records[0].getMessage()
    caplog.clear()
    for _ in range(500):
        log.say(raised)
    log.sum_up()
    log.sum_up()
    (record,) = caplog.records
    assert record.getMessage().startswith("500 alarm events came too fast for this log")
    caplog.clear()
    rig.clock.t_ns += LINE_EVERY_NS
    log.say(returned)
    log.say(returned)
    (record,) = caplog.records
    assert (record.levelname, returned.message in record.getMessage()) == ("NOTICE", True)
    rig.clock.t_ns += LINE_EVERY_NS
    caplog.clear()
    log.say(dataclasses.replace(returned, from_level=Level.NORMAL))
    assert [record.levelname for record in caplog.records] == ["INFO"], "as of one that is shelved"
    rig.clock.t_ns += 10 * LINES * LINE_EVERY_NS
    caplog.clear()
    for _ in range(2 * LINES):
        log.say(raised)
    assert len(caplog.records) == LINES, "what is not needed is not saved up"


def test_what_calls_for_a_person_is_a_warning_and_what_a_person_did_is_none(caplog):
    rig = AlarmRig(LevelRule("vibration-x", "probe-x", "rms", Setpoint(alert=4.0, danger=8.0)))
    log = AlarmLog(rig.clock)
    (raised,), (escalated,) = rig.rms(5.0), rig.rms(9.0)
    acknowledged = rig.acknowledge("vibration-x")
    (lowered,) = rig.rms(5.0)
    (returned,) = rig.rms(1.0)
    for event in (raised, escalated, acknowledged, lowered, returned):
        log.say(event)
    assert [(record.levelname, f"{record.code}") for record in caplog.records] == [
        ("WARNING", "A17"),
        ("WARNING", "A17"),
        ("NOTICE", "None"),
        ("NOTICE", "None"),
        ("NOTICE", "None"),
    ]


@pytest.mark.gives("A17", "D21", "D22")
def test_alarms_of_sensors_have_their_codes():
    rig = AlarmRig(LevelRule("probe-x", "probe-x", "rms", Setpoint(alert=35.0)))
    log = AlarmLog(rig.clock)
    dead = "probe-x does not move at all (0 um): dead or disconnected"
    silent = "no samples of stream 'shaft' for more than 2.0 s; check bus and device"
    for events in (
        rig.rms(36.2),
        rig.rms(36.2, "not_ok", reason=dead),
        rig.rms(36.2),
        rig.rms(36.2, "missing", reason=silent),
    ):
        for event in events:
            log.say(event)
