"""The protocol of sd_notify(3), and what makes a part of the service count as stalled."""

from __future__ import annotations

import os
import threading
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from support.notify_sockets import NotifySocket

from daqsvc.commands import service_manager
from daqsvc.commands.service_manager import ServiceManager, _Follower
from daqsvc.supervision import Progress, StallWatch

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize("abstract", [False, True])
def test_what_is_told_comes_as_datagrams_of_assignments(
    *, abstract: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with NotifySocket(None if abstract else tmp_path) as systemd:
        monkeypatch.setenv("NOTIFY_SOCKET", systemd.address)
        monkeypatch.setenv("WATCHDOG_USEC", "3000000")
        monkeypatch.setenv("WATCHDOG_PID", f"{os.getpid()}")
        manager = ServiceManager.of_environment()
        assert manager.watchdog_s == 3.0
        assert not {"NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"} & os.environ.keys(), "for no child"
        assert manager.tell(READY=1, STATUS="a sentence\nof two lines")
        assert systemd.next() == {"READY": "1", "STATUS": "a sentence of two lines"}
        manager.stopping()
        assert systemd.next() == {"STOPPING": "1", "STATUS": "stopping"}
    assert manager.tell(READY=1) is False, "nobody is there any more"
    manager.close()


@pytest.mark.parametrize(
    ("variables", "watchdog_s"),
    [
        ({}, None),
        ({"WATCHDOG_USEC": "3000000"}, None),
        ({"NOTIFY_SOCKET": "vsock:2:1234", "WATCHDOG_USEC": "3000000"}, None),
        ({"NOTIFY_SOCKET": "/nowhere", "WATCHDOG_USEC": "3000000", "WATCHDOG_PID": "1"}, None),
        ({"NOTIFY_SOCKET": "/nowhere", "WATCHDOG_USEC": "soon"}, None),
        ({"NOTIFY_SOCKET": "/nowhere", "WATCHDOG_USEC": "500000"}, 0.5),
    ],
)
def test_the_watchdog_is_on_only_where_somebody_waits_for_this_process(
    variables: dict[str, str], watchdog_s: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    manager = ServiceManager.of_environment()
    assert manager.watchdog_s == watchdog_s
    assert manager.tell(READY=1) is (variables.get("NOTIFY_SOCKET") != "/nowhere")
    manager.close()


def stalls(steps: list[Any], every_s: float = 1.0, thread: threading.Thread | None = None) -> list[bool]:
    """At each look, whether a part with these steps has stalled, if it may stand still for 3 s."""
    now = iter(steps)
    stalled = StallWatch(lambda: {"part": Progress(next(now), thread)}).hold_to(3.0, "it is restarted")
    return [bool(stalled(every_s * n)) for n in range(len(steps))]


def test_a_part_has_stalled_that_has_work_and_takes_no_step(caplog: pytest.LogCaptureFixture) -> None:
    assert stalls([1, 1, 1, 1, 1, 2, 2]) == [False, False, False, True, True, False, False]
    assert [record.message for record in caplog.records] == [
        "part has stalled, without a step for 3 s: it is restarted",
        "part works again",
    ]


def test_a_part_that_several_watch_is_said_once_with_all_that_follows(
    caplog: pytest.LogCaptureFixture,
) -> None:
    watch = StallWatch(lambda: {"part": Progress(1)})
    for_systemd, for_health = watch.hold_to(6.0, "it is restarted"), watch.hold_to(3.0, "it is unhealthy")
    seen = [(bool(for_systemd(float(s))), bool(for_health(float(s)))) for s in range(9)]
    assert seen == [(False, False)] * 3 + [(False, True)] * 3 + [(True, True)] * 3
    assert [record.message for record in caplog.records] == [
        "part has stalled, without a step for 3 s: it is unhealthy; after 6 s: it is restarted"
    ]


def test_a_part_without_work_or_that_gets_on_has_not_stalled() -> None:
    assert not any(stalls([None] * 9))
    assert not any(stalls([1, 1, None, 1, 1, None, 1, 1]))
    assert not any(stalls([*range(9)], every_s=2.0))


def test_a_process_that_was_suspended_or_starved_has_not_stalled(monkeypatch: pytest.MonkeyPatch) -> None:
    assert stalls([1, 1, 1], every_s=3600.0) == [False, False, True], "one long pause is no standstill"
    waited = iter(range(100))
    monkeypatch.setattr("daqsvc.supervision.kept_waiting_s", lambda _: float(next(waited)))
    assert not any(stalls([1] * 20, thread=threading.current_thread())), "it waits for a processor"


@pytest.mark.parametrize(
    ("told", "watchdog_s", "warning"),
    [
        pytest.param(
            "300000",
            0.3,
            "WatchdogSec= is 0.3 s, and the limit of parts is 3 s",
            marks=pytest.mark.gives("S17"),
        ),
        ("3000000", 3.0, ""),
        *[(odd, None, f"WATCHDOG_USEC is '{odd}', not a number") for odd in ("0", "-5", "abc", "1e20")],
    ],
)
def test_a_watchdog_that_is_too_short_or_no_number_is_warned_of_once(
    told: str,
    watchdog_s: float | None,
    warning: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", "/nowhere")
    monkeypatch.setenv("WATCHDOG_USEC", told)
    monkeypatch.delenv("WATCHDOG_PID", raising=False)
    manager = ServiceManager.of_environment()
    manager.close()
    assert manager.watchdog_s == watchdog_s
    assert len(caplog.records) == bool(warning)
    assert warning in caplog.text


def served(stalls: StallWatch, awaited: dict[str, str] | None = None, depth: int = 0) -> Any:
    """A service that runs."""
    outbox = SimpleNamespace(counters=SimpleNamespace(shut=0, unbacked=0, depth=depth, waiting=0))
    return SimpleNamespace(
        ready=SimpleNamespace(is_set=lambda: True),
        awaited=lambda *, patient: awaited or {},
        stalls=stalls,
        driver_reports=[],
        alarms=SimpleNamespace(managers={}, outbox=outbox, outputs={}),
    )


def telling(manager: ServiceManager, monkeypatch: pytest.MonkeyPatch) -> list[dict[str, object]]:
    """What a manager is going to tell."""
    told: list[dict[str, object]] = []
    monkeypatch.setattr(manager, "tell", lambda **one: told.append(one) or True)
    return told


def test_a_reload_before_the_service_is_ready_does_not_make_it_ready(monkeypatch: pytest.MonkeyPatch) -> None:
    """systemd would wait for no bus any more, and then for signs of life that nobody gives."""
    awaited = {"can0": "no samples have come yet"}
    manager = ServiceManager("@nobody", 5.0)
    told = telling(manager, monkeypatch)
    follower = _Follower(manager, served(StallWatch(dict), awaited))
    follower.look(0.0)
    manager.reloading(begins=True)
    manager.reloading(begins=False)
    follower.look(2.0)
    assert told[-1]["STATUS"] == "waiting for bus can0: no samples have come yet", "these words stand again"
    follower.look(20.0)
    assert not any({"READY", "RELOADING", "WATCHDOG"} & one.keys() for one in told)
    assert [one["STATUS"] for one in told if "STATUS" in one][1:3] == ["reloading", "reloaded"]
    # The bus may come while machine files are gone over to: then the end of that is nobody's business.
    manager.reloading(begins=True)
    awaited.clear()
    follower.look(21.0)
    manager.reloading(begins=False)
    assert [one.get("READY") for one in told if "READY" in one] == [1]
    assert {"WATCHDOG": 1} in told
    manager.close()


def test_a_reload_of_a_service_that_is_ready_is_told_and_its_watchdog_fed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    awaited: dict[str, str] = {}
    manager = ServiceManager("@nobody", 5.0)
    told = telling(manager, monkeypatch)
    follower = _Follower(manager, served(StallWatch(dict), awaited))
    follower.look(0.0)
    manager.reloading(begins=True)
    assert told[-1]["RELOADING"] == 1
    awaited["can1"] = "no samples have come yet"
    manager.reloading(begins=False)
    assert told[-1]["READY"] == 1
    told.clear()
    for second in range(1, 10):
        follower.look(float(second))
    assert sum("WATCHDOG" in one for one in told) >= 3, "also while a bus is awaited that the reload brought"
    manager.close()


def test_time_is_asked_for_from_the_beginning_until_the_service_is_followed_and_not_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service_manager, "EXTEND_EVERY_S", 0.01)
    monkeypatch.setattr(service_manager, "START_MOST_S", 0.03)
    with NotifySocket(tmp_path) as systemd:
        manager = ServiceManager(systemd.address)
        manager.starting()
        assert manager._starting is not None
        # Nothing of the service is there yet; whatever hangs then is not waited for without end.
        manager._starting.join()
        for _ in range(3):
            told = systemd.next()
            assert told is not None
            assert told["STATUS"].startswith("starting: ")
            assert told["EXTEND_TIMEOUT_USEC"] == "30000000"
        assert systemd.next(0.0) is None
        manager.close()

        manager = ServiceManager(systemd.address)
        monkeypatch.setattr(service_manager, "START_MOST_S", 1e9)
        manager.starting()
        systemd.until("EXTEND_TIMEOUT_USEC")
        thread = manager._starting
        manager._end_starting()
        assert thread is not None
        thread.join()
        manager.close()


@pytest.mark.parametrize(
    ("outputs", "depth", "said"),
    [
        ((), 7, "7 alarm messages kept for a broker"),
        ((), 1, "1 alarm message kept for a broker"),
        ((), 0, ""),
        (("mqtt",), 7, "7 alarm messages wait for the broker"),
        (("mqtt",), 1, "1 alarm message waits for the broker"),
    ],
)
def test_the_status_names_no_broker_that_there_is_not(
    outputs: tuple[str, ...], depth: int, said: str
) -> None:
    service = served(StallWatch(dict), depth=depth)
    service.alarms.outputs = dict.fromkeys(outputs, SimpleNamespace(figures=dict))
    assert service_manager._in_short(service) == ("0 of 0 buses up; alarms: none", said)


@pytest.mark.gives("S10")
@pytest.mark.parametrize(("watchdog_s", "held_to_s"), [(0.5, 3.0), (3.0, 3.0), (5.0, 5.0)])
def test_parts_are_held_to_the_watchdog_but_to_three_seconds_at_least(
    watchdog_s: float, held_to_s: float, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    fed: list[bool] = []
    manager = ServiceManager("@nobody", watchdog_s)
    monkeypatch.setattr(manager, "tell", lambda **told: fed.append("WATCHDOG" in told) or True)
    follower = _Follower(manager, served(StallWatch(lambda: {"part": Progress(1)})))
    every_s, last_s = 0.25, 0.0
    for look in range(40):
        fed.clear()
        follower.look(look * every_s)
        last_s = look * every_s if any(fed) else last_s
    manager.close()
    assert held_to_s - watchdog_s / 2 - every_s <= last_s < held_to_s
    assert f"part has stalled, without a step for {held_to_s:g} s: " in caplog.text
