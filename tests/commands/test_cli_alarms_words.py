"""Words of the command line about alarms: times, ages, states."""

from __future__ import annotations

import argparse

import pytest

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.commands.alarm_journal import AlarmView, ago, current_table, history_table
from daqsvc.commands.alarms import user_name
from daqsvc.commands.arguments import duration


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("90s", 90), ("30m", 1800), ("8h", 28_800), ("2d", 172_800), ("1h30m", 5400), ("1d1h1m1s", 90_061)],
)
def test_a_time_is_its_parts_together(text: str, seconds: float) -> None:
    assert duration(text) == seconds


@pytest.mark.parametrize("text", ["", "30", "0m", "-1h", "1.5h", "1 h", "30m1h", "m", "1h30", "367d", "٣h"])
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError):
        duration(text)


@pytest.mark.parametrize(
    ("age_s", "words"),
    [(0, "0 s"), (59, "59 s"), (60, "1 min"), (7199, "1 h"), (200_000, "2 d"), (-30, "0 s")],
)
def test_an_age_is_told_in_its_largest_unit(age_s: int, words: str) -> None:
    assert ago(age_s * NS_PER_S) == words


def test_a_clock_that_was_set_back_is_no_negative_age() -> None:
    assert ago(-3600 * NS_PER_S) == "the clock was ahead"


def test_behind_sudo_is_a_person(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 0)
    monkeypatch.setenv("SUDO_USER", "ann")
    assert user_name() == "ann"
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    assert user_name() != "ann", "without sudo anybody may set that variable"
    monkeypatch.setattr("os.getuid", lambda: 4_000_000)
    assert user_name() == "uid 4000000"


EVENT = {
    "machine": "m",
    "alarm": "a",
    "kind": "raised",
    "level": "alert",
    "state": "active_unacknowledged",
    "occurrence": None,
    "wall_ns": 0,
    "message": "a was found",
    "code": None,
}


@pytest.mark.parametrize(
    ("others", "ends"),
    [
        ({}, "a was found [A17]"),
        ({"code": "D22"}, "a was found [D22]"),
        ({"kind": "acknowledged", "code": "D22"}, "a was found [D22]"),
        ({"level": "normal", "kind": "returned", "state": "normal"}, "a was found"),
    ],
)
def test_the_message_of_an_alarm_ends_with_its_code(others: dict[str, str], ends: str) -> None:
    event = EVENT | others
    assert current_table([AlarmView(event, 0, "a was found")], 0).endswith(f"  {ends}")
    # As in the log, what a person has done has no code: it is no fault.
    assert history_table([event]).endswith(f"  {'a was found' if 'kind' in others else ends}")


def test_what_lies_beneath_a_cover_is_shown() -> None:
    told = EVENT | {
        "state": "shelved",
        "covered": "active_acknowledged",
        "shelved_until_wall_ns": 1_795_264_095 * NS_PER_S,
        "chattering": True,
    }
    line = current_table([AlarmView(told, 0, "-")], 0).splitlines()[1]
    assert "shelved until 2026-" in line
    assert "(over active acknowledged), chattering" in line
