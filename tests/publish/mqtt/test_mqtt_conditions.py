"""What is said of the broker: once when it begins, once when it is over, and not for every wobble."""

from __future__ import annotations

from typing import Any

import pytest
from support.mqtt_publishing import mqtt

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarms.states import Level
from daqsvc.publish.mqtt.conditions import NS_PER_DAY, BrokerCheck, BrokerVitals
from daqsvc.publish.mqtt.plugin import MqttPlugin

HOUR_NS = 3600 * NS_PER_S
NOW_NS = 1_795_264_095 * NS_PER_S


def look(check: BrokerCheck, **vitals: Any) -> dict[str, tuple[Level, str]]:
    found = check.look(BrokerVitals(**({"wall_ns": NOW_NS} | vitals)))
    return {name: (level, sentence) for name, level, sentence in found}


@pytest.mark.parametrize(
    ("days", "level", "words"),
    [
        (14.1, Level.NORMAL, "lasts until"),
        (13.9, Level.ALERT, "ends at 2026-12-05T10:04:15.000000Z, in less than 14 days: renew it"),
        (0.1, Level.ALERT, "renew it"),
        (-0.1, Level.DANGER, "ended at"),
    ],
)
def test_a_certificate_that_ends_is_told_a_fortnight_before(days: float, level: Level, words: str) -> None:
    found = look(BrokerCheck(), certificates_end_ns={"client": NOW_NS + round(days * NS_PER_DAY)})
    assert found["certificate/client"][0] is level
    assert words in found["certificate/client"][1]


def test_a_broker_that_is_refused_as_expired_is_dangerous_whatever_it_showed_before() -> None:
    check, before = BrokerCheck(), {"broker": NOW_NS + 90 * NS_PER_DAY}
    for known in ({}, before):
        found = look(check, certificates_end_ns=known, connected=False, has_expired=True)
        level, sentence = found["certificate/broker"]
        assert level is Level.DANGER
        assert "has expired; renew it" in sentence
    assert look(check, certificates_end_ns=before)["certificate/broker"][0] is Level.NORMAL


def test_a_clock_that_is_set_by_an_hour_makes_no_certificate_alarm_come_and_go() -> None:
    check, ends = BrokerCheck(), {"client": NOW_NS + 14 * NS_PER_DAY + HOUR_NS // 2}
    levels = [
        look(check, wall_ns=NOW_NS + step_ns, certificates_end_ns=ends)["certificate/client"][0]
        for step_ns in (0, HOUR_NS, 0, -HOUR_NS, HOUR_NS)
    ]
    assert levels == [Level.NORMAL, *[Level.ALERT] * 4]
    renewed = {"client": NOW_NS + 90 * NS_PER_DAY}
    assert look(check, certificates_end_ns=renewed)["certificate/client"][0] is Level.NORMAL


def test_a_certificate_that_is_no_longer_in_use_stands_no_longer() -> None:
    told = frozenset({"certificate/ca", "alarm-flood"})
    assert "certificate/ca" not in look(BrokerCheck(), reported=told, connected=False), "nobody knows yet"
    found = look(BrokerCheck(), reported=told)
    assert found["certificate/ca"] == (Level.NORMAL, "it is no longer in use")
    assert "alarm-flood" not in found


def test_what_the_broker_refuses_is_named_once_without_a_count() -> None:
    check = BrokerCheck()
    assert "broker/refused" not in look(check, refused={}), "nobody knows yet"
    assert look(check, refused={}, is_refused_known=True)["broker/refused"][0] is Level.NORMAL
    level, one = look(check, refused={"a/b": "not allowed"})["broker/refused"]
    assert level is Level.ALERT
    assert "will not take messages on a/b (not allowed): they wait on disk" in one
    many = {f"a/{n}": "no" for n in range(3, 9)}
    _, several = look(check, refused=many)["broker/refused"]
    assert several == look(check, refused=many | {"a/9": "no"})["broker/refused"][1]
    assert "a/3 (no); a/4 (no); a/5 (no), and others" in several
    assert "broker/refused" in MqttPlugin().conditions(mqtt(1))
