"""What the service says of itself: once when it begins, once when it is over, and not for every wobble."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarms.states import Level
from daqsvc.self_check import MIB, NS_PER_DAY, SelfCheck, Vitals

HOUR_NS = 3600 * NS_PER_S
NOW_NS = 1_795_264_095 * NS_PER_S
STORE = Path("/var/lib/daqsvc")
FINE: dict[str, Any] = {
    "now_ns": 0,
    "wall_ns": NOW_NS,
    "certificates_end_ns": {},
    "broker_has_expired": False,
    "conditions_told": frozenset(),
    "connected": True,
    "free_bytes": None,
    "waiting": 0,
    "write_errors": 0,
    "lost": 0,
    "damaged": 0,
    "telemetry_dropped": 0,
    "unwritten": 0,
}


def look(check: SelfCheck, **vitals: Any) -> dict[str, tuple[Level, str]]:
    found = check.look(Vitals(**(FINE | vitals)))
    return {name: (level, sentence) for name, level, sentence in found}


def self_check() -> SelfCheck:
    return SelfCheck(STORE, 64 * MIB)


def test_a_service_that_is_well_says_nothing_but_normal() -> None:
    found = look(self_check(), free_bytes=65 * MIB, certificates_end_ns={"broker": NOW_NS + 90 * NS_PER_DAY})
    assert {level for level, _ in found.values()} == {Level.NORMAL}
    assert set(found) == {
        "certificate/broker",
        *(f"store/{part}" for part in ("disk", "journal", "damage", "telemetry", "audit-log")),
    }


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
    found = look(self_check(), certificates_end_ns={"client": NOW_NS + round(days * NS_PER_DAY)})
    assert found["certificate/client"][0] is level
    assert words in found["certificate/client"][1]


def test_a_broker_that_is_refused_as_expired_is_dangerous_whatever_it_showed_before() -> None:
    check, before = self_check(), {"broker": NOW_NS + 90 * NS_PER_DAY}
    for known in ({}, before):
        found = look(check, certificates_end_ns=known, connected=False, broker_has_expired=True)
        level, sentence = found["certificate/broker"]
        assert level is Level.DANGER
        assert "has expired; renew it" in sentence
    assert look(check, certificates_end_ns=before)["certificate/broker"][0] is Level.NORMAL


def test_a_clock_that_is_set_by_an_hour_makes_no_certificate_alarm_come_and_go() -> None:
    check, ends = self_check(), {"client": NOW_NS + 14 * NS_PER_DAY + HOUR_NS // 2}
    levels = [
        look(check, wall_ns=NOW_NS + step_ns, certificates_end_ns=ends)["certificate/client"][0]
        for step_ns in (0, HOUR_NS, 0, -HOUR_NS, HOUR_NS)
    ]
    assert levels == [Level.NORMAL, *[Level.ALERT] * 4]
    renewed = {"client": NOW_NS + 90 * NS_PER_DAY}
    assert look(check, certificates_end_ns=renewed)["certificate/client"][0] is Level.NORMAL


def test_a_certificate_that_is_no_longer_in_use_stands_no_longer() -> None:
    told = frozenset({"certificate/ca", "alarm-flood"})
    assert "certificate/ca" not in look(self_check(), conditions_told=told, connected=False), (
        "nobody knows yet"
    )
    found = look(self_check(), conditions_told=told)
    assert found["certificate/ca"] == (Level.NORMAL, "it is no longer in use")
    assert "alarm-flood" not in found


def test_a_disk_that_fills_is_told_with_what_is_left() -> None:
    level, sentence = look(self_check(), free_bytes=63 * MIB)["store/disk"]
    assert level is Level.ALERT
    assert sentence.startswith("63 MiB are free on the disk of /var/lib/daqsvc, less than 64 MiB: make room")
    assert "store/disk" not in look(self_check()), "nobody has looked"


def test_a_journal_that_cannot_be_written_stands_until_nothing_waits() -> None:
    check = self_check()

    def level(**vitals: int) -> Level:
        return look(check, **vitals)["store/journal"][0]

    assert level(waiting=3) is Level.NORMAL, "a busy disk is no broken one"
    assert level(waiting=3, write_errors=1) is Level.ALERT
    assert level(waiting=5, write_errors=1) is Level.ALERT, "it is tried again at ever longer intervals"
    assert level(write_errors=1) is Level.NORMAL
    assert level(write_errors=1, lost=1, now_ns=NS_PER_S) is Level.DANGER
    assert level(write_errors=1, lost=1, now_ns=100 * NS_PER_S) is Level.NORMAL


@pytest.mark.parametrize(
    ("count", "condition"),
    [
        ("telemetry_dropped", "store/telemetry"),
        ("unwritten", "store/audit-log"),
        ("damaged", "store/damage"),
    ],
)
def test_what_happens_now_and_then_is_one_alarm(count: str, condition: str) -> None:
    check = self_check()
    levels = [
        look(check, now_ns=t_s * NS_PER_S, **{count: happened})[condition][0]
        for t_s, happened in ((0, 0), (1, 3), (30, 3), (60, 4), (119, 4), (121, 4))
    ]
    assert levels == [Level.NORMAL, *[Level.ALERT] * 4, Level.NORMAL]


def test_the_disk_is_asked_for_what_the_service_may_use(tmp_path: Path) -> None:
    assert SelfCheck(tmp_path, 0).free_bytes() > 0
    with pytest.raises(OSError, match="none"):
        SelfCheck(tmp_path / "none", 0).free_bytes()
