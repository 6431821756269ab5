"""What the service says of itself: once when it begins, once when it is over, and not for every wobble."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarms.states import Level
from daqsvc.self_check import MIB, BusHealth, SelfCheck, Vitals, conditions
from daqsvc.settings.registry import bus_tables
from drivers.base import BusCounters
from drivers.can.errors import CanCounters
from drivers.serial.driver import SerialCounters

STORE = Path("/var/lib/daqsvc")
FINE: dict[str, Any] = {
    "now_ns": 0,
    "conditions_reported": frozenset(),
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
    found = look(self_check(), free_bytes=65 * MIB)
    assert {level for level, _ in found.values()} == {Level.NORMAL}
    assert set(found) == {
        *(f"store/{part}" for part in ("disk", "journal", "damage", "telemetry", "audit-log")),
    }


def test_a_disk_that_fills_is_told_by_the_limit() -> None:
    level, sentence = look(self_check(), free_bytes=63 * MIB)["store/disk"]
    assert level is Level.ALERT
    assert sentence.startswith("less than 64 MiB are free on the disk of /var/lib/daqsvc: make room")
    assert look(self_check(), free_bytes=0)["store/disk"] == (level, sentence), (
        "it stays true as the rest goes"
    )
    level, sentence = look(self_check(), free_bytes=64 * MIB)["store/disk"]
    assert (level, sentence) == (Level.NORMAL, "64 MiB or more are free on the disk of /var/lib/daqsvc")
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


def test_set_aside_is_said_of_files_that_are_there() -> None:
    for there in (False, True):
        check = self_check()
        look(check)
        _, sentence = look(check, damaged=1, set_aside=there)["store/damage"]
        assert ("corrupt-" in sentence) is there


NOW_AND_THEN = {
    "store/journal": {"lost": 1},
    "store/damage": {"damaged": 1},
    "store/telemetry": {"telemetry_dropped": 1},
    "store/audit-log": {"unwritten": 1},
    "bus-overrun/can0": {"buses": {"can0": BusHealth(1, 0, "error-active")}},
    "bus-controller/can0": {"buses": {"can0": BusHealth(0, 1, "error-active")}},
    "bus-recording/can0": {"buses": {"can0": BusHealth(0, 0, "error-active", 1)}},
}


@pytest.mark.parametrize("condition", NOW_AND_THEN)
def test_after_a_restart_nothing_is_normal_before_it_was_watched_for_a_minute(condition: str) -> None:
    told = frozenset(NOW_AND_THEN)

    def levels(check: SelfCheck, seconds: list[int], **vitals: Any) -> list[Level | None]:
        fine = {"buses": {"can0": BusHealth(0, 0, "error-active")}} | vitals
        found = [look(check, conditions_reported=told, now_ns=t_s * NS_PER_S, **fine) for t_s in seconds]
        return [one[condition][0] if condition in one else None for one in found]

    assert levels(self_check(), [5, 6, 64, 66]) == [None, None, None, Level.NORMAL]
    again = self_check()
    assert levels(again, [5]) == [None]
    assert levels(again, [30, 60, 89], **NOW_AND_THEN[condition])[0] is not None
    assert levels(again, [91], **NOW_AND_THEN[condition]) == [Level.NORMAL], "a minute after the last time"
    silent = self_check()
    if condition.startswith("bus-"):
        deaf = {"buses": {"can0": BusHealth(0, 0, "error-active", heard=False)}}
        assert levels(silent, [5, 500], **deaf) == [None, None], "nothing has come from the bus"
        assert levels(silent, [501, 562]) == [None, Level.NORMAL]


def test_the_disk_is_asked_for_what_the_service_may_use(tmp_path: Path) -> None:
    assert SelfCheck(tmp_path, 0).free_bytes() > 0
    with pytest.raises(OSError, match="none"):
        SelfCheck(tmp_path / "none", 0).free_bytes()


def test_what_a_bus_loses_to_a_full_buffer_is_one_alarm() -> None:
    check = self_check()

    def overrun(t_s: int, **overruns: int) -> dict[str, tuple[Level, str]]:
        buses = {name: BusHealth(count, 0, None) for name, count in overruns.items()}
        return look(check, now_ns=t_s * NS_PER_S, buses=buses)

    assert overrun(0, can0=0, can1=0)["bus-overrun/can0"] == (Level.NORMAL, "no buffer of bus can0 overflows")
    found = [
        overrun(t_s, can0=count, can1=0) for t_s, count in ((1, 40), (30, 40), (60, 41), (119, 41), (121, 41))
    ]
    assert [f["bus-overrun/can0"][0] for f in found] == [*[Level.ALERT] * 4, Level.NORMAL]
    assert {f["bus-overrun/can1"][0] for f in found} == {Level.NORMAL}
    assert len({f["bus-overrun/can0"][1] for f in found[:4]}) == 1, "nothing new is said"
    assert "bus-controller/can0" not in found[0], "it has none"


def test_a_controller_that_leaves_the_bus_is_dangerous_and_one_near_it_is_told() -> None:
    check = self_check()
    stages = [
        (0, 0, "error-active", Level.NORMAL, "is sound"),
        (1, 0, "error-warning", Level.NORMAL, "is sound"),
        (2, 0, "error-passive", Level.ALERT, "is error-passive: look at wiring, termination and bit rate"),
        (3, 1, "bus-off", Level.DANGER, "is bus-off: look at wiring, termination and bit rate"),
        (300, 1, "bus-off", Level.DANGER, "is bus-off"),
        (301, 2, "error-active", Level.DANGER, "went bus-off within the last minute"),
        (362, 2, "error-active", Level.NORMAL, "is sound"),
    ]
    for t_s, bus_off, state, level, words in stages:
        health = BusHealth(0, bus_off, state)  # type: ignore[arg-type]
        found = look(check, now_ns=t_s * NS_PER_S, buses={"can0": health})["bus-controller/can0"]
        assert found[0] is level, state
        assert words in found[1]


def test_frames_that_are_missing_from_a_recording_are_an_alarm_until_a_minute_after_the_last() -> None:
    check = self_check()
    levels = []
    for t_s, unrecorded in ((0, 0), (1, 10), (50, 11), (109, 11), (111, 11)):
        buses = {"can0": BusHealth(0, 0, "error-active", unrecorded)}
        level, words = look(check, now_ns=t_s * NS_PER_S, buses=buses)["bus-recording/can0"]
        levels.append(level)
        assert "missing from " in words
    assert levels == [Level.NORMAL, *[Level.ALERT] * 3, Level.NORMAL]


def test_a_bus_that_is_no_longer_there_has_no_alarm() -> None:
    told = frozenset({"bus-overrun/can1", "bus-controller/can1", "bus-overrun/can0"})
    found = look(self_check(), conditions_reported=told, buses={"can0": BusHealth(0, 0, "error-active")})
    gone = (Level.NORMAL, "there is no such bus any more")
    assert found["bus-overrun/can1"] == found["bus-controller/can1"] == gone
    assert "bus-overrun/can0" not in found, "it was not watched for long enough"


def test_the_alarms_of_a_bus_are_known_before_they_are_raised() -> None:
    drivers = {"can0": "can", "tty": "serial", "plc": "modbus", "log": "replay"}
    buses = {name: bus_tables()[driver].self_checks for name, driver in drivers.items()}
    assert set(conditions(buses)) - set(conditions()) == {
        "bus-overrun/can0",
        "bus-controller/can0",
        "bus-recording/can0",
        "bus-overrun/tty",
    }


def test_every_kind_of_bus_says_what_its_buffers_lost() -> None:
    assert BusCounters().overruns == 0
    assert CanCounters(frames_overrun=7, rx_overflows=2).overruns == 9
    assert SerialCounters(overruns=5).overruns == 5
