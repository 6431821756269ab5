"""What all drivers have in common: trying a link again, and blocking calls that are cancelled."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import subprocess
import sys
import threading
import weakref
from typing import TYPE_CHECKING

import pytest
from support.given_codes import had

from daqsvc.acquisition.link import Link
from drivers import reconnect
from drivers.base import BusPort, DeviceAbsentError
from drivers.reconnect import Attempt, CannotOpenError, ended, in_thread, run_with_reconnect

if TYPE_CHECKING:
    from collections.abc import Callable

    from drivers.base import StartPolicy

ABSENT = Attempt(present=False, useful=False, reason="nobody is there")
USEFUL = Attempt(present=True, useful=True, reason="the plug is out")
USELESS = Attempt(present=True, useful=False, reason="it failed at once")
MANY = 12
FIRST_CEILING_NS = 250_000_000


class _NotedWaits:
    """A clock on which every wait is over at once, and noted."""

    def __init__(self) -> None:
        self.waits_ns: list[int] = []

    def now_ns(self) -> int:
        return 0

    def wall_ns(self) -> int:
        return 0

    async def sleep_ns(self, duration_ns: int) -> None:
        self.waits_ns.append(duration_ns)
        await asyncio.sleep(0)


def _port(clock: _NotedWaits, start: StartPolicy = "retry") -> BusPort:
    return BusPort("can0", (), clock, lambda _block: None, start)


async def _kept(outcomes: list[Attempt | None], start: StartPolicy = "retry") -> tuple[Link, list[int], int]:
    left = iter(outcomes)
    made = 0

    async def attempt() -> Attempt | None:
        nonlocal made
        made += 1
        return next(left)

    clock, link = _NotedWaits(), Link("CAN bus 'can0'")
    await run_with_reconnect(link, _port(clock, start), attempt)
    return link, clock.waits_ns, made


async def test_a_link_is_tried_until_there_is_nothing_more_to_come() -> None:
    link, waits_ns, made = await _kept([ABSENT, USELESS, USEFUL, None])
    assert made == 4
    assert len(waits_ns) == 3
    assert link.reason == "the plug is out"


async def test_the_wait_grows_unless_something_came_over_the_link() -> None:
    longest_ns = {}
    for outcome in (ABSENT, USELESS, USEFUL):
        _, waits_ns, _ = await _kept([outcome] * MANY + [None])
        longest_ns[outcome] = max(waits_ns)
    assert longest_ns[USEFUL] <= FIRST_CEILING_NS < min(longest_ns[ABSENT], longest_ns[USELESS])


async def test_an_attempt_that_fails_unforeseen_is_said_once_and_tried_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    made = 0

    async def attempt() -> Attempt | None:
        nonlocal made
        made += 1
        if made < 4:
            raise KeyError("a mistake")
        return None

    link = Link("CAN bus 'can0'")
    await run_with_reconnect(link, _port(_NotedWaits(), "error"), attempt)
    assert made == 4
    assert [record.levelname for record in caplog.records].count("ERROR") == 1
    assert link.reason == "its driver failed: 'a mistake'"


async def test_a_driver_that_is_started_again_tries_what_was_there_before() -> None:
    link, left = Link("CAN bus 'can0'"), iter([ABSENT, None])
    link.up()

    async def attempt() -> Attempt | None:
        return next(left)

    await run_with_reconnect(link, _port(_NotedWaits(), "error"), attempt)
    assert next(left, "none") == "none", "it was not given up"


async def test_a_reader_whose_thread_is_gone_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reconnect, "LOOK_S", 0.01)
    reason: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    reader = threading.Thread(target=lambda: None)
    reader.start()
    async with asyncio.timeout(20):
        assert await ended(reason, reader) == "its reader has ended without a reason"
    reason.set_result("it was closed")
    assert await ended(reason, reader) == "it was closed"


async def test_an_absent_device_is_an_error_only_at_the_start_and_only_where_that_is_asked_for() -> None:
    with pytest.raises(DeviceAbsentError, match=r"^CAN bus 'can0': nobody is there$") as absent:
        await _kept([ABSENT], start="error")
    assert absent.value.code.id == "B27"
    had("B27", absent.value)
    for there_once in (USEFUL, USELESS):
        _, waits_ns, _ = await _kept([there_once, ABSENT, None], start="error")
        assert len(waits_ns) == 2


async def test_an_absent_device_may_be_gone_without() -> None:
    _, waits_ns, made = await _kept([ABSENT], start="ignore")
    assert (made, waits_ns) == (1, [])


@pytest.mark.parametrize(
    ("start", "said"),
    [
        ("error", []),  # whoever gets the exception says it
        pytest.param(
            "ignore",
            ["it is left out until the service starts again, as start = 'ignore' asks for"],
            marks=pytest.mark.gives("B30"),
        ),
        pytest.param("retry", ["it is being tried again"], marks=pytest.mark.gives("B29")),
    ],
)
async def test_what_is_said_of_an_absent_device_is_what_is_done_about_it(
    start: StartPolicy, said: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    with contextlib.suppress(DeviceAbsentError):
        await _kept([ABSENT, ABSENT, None], start=start)
    assert [r.message for r in caplog.records] == [
        f"CAN bus 'can0': nobody is there; {what}" for what in said
    ]


async def test_a_link_that_cannot_be_opened_is_absent() -> None:
    left = iter([CannotOpenError("it cannot be opened: no such interface"), None])

    async def attempt() -> None:
        if (error := next(left)) is not None:
            raise error

    clock, link = _NotedWaits(), Link("CAN bus 'can0'")
    await run_with_reconnect(link, _port(clock), attempt)
    assert (link.reason, len(clock.waits_ns)) == ("it cannot be opened: no such interface", 1)
    left = iter([CannotOpenError("it cannot be opened: no such interface")])
    with pytest.raises(DeviceAbsentError, match=r"^CAN bus 'can0': it cannot be opened: no such interface$"):
        await run_with_reconnect(link, _port(clock, "error"), attempt)


def _call_that_waits(go_on: threading.Event) -> Callable[[], str]:
    def call() -> str:
        go_on.wait(60)
        return "opened"

    return call


async def test_what_opens_after_its_driver_was_cancelled_is_closed_again() -> None:
    go_on, undone = threading.Event(), []
    opening = asyncio.create_task(in_thread(_call_that_waits(go_on), undo=undone.append))
    await asyncio.sleep(0.01)
    opening.cancel()
    await asyncio.sleep(0.01)
    assert not opening.done()
    go_on.set()
    with pytest.raises(asyncio.CancelledError):
        await opening
    assert undone == ["opened"]


async def test_a_call_that_never_ends_is_waited_for_with_patience_only() -> None:
    go_on = threading.Event()
    opening = asyncio.create_task(in_thread(_call_that_waits(go_on), patience_s=0.02))
    await asyncio.sleep(0.01)
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    assert not go_on.is_set()
    go_on.set()
    await asyncio.gather(*(asyncio.all_tasks() - {asyncio.current_task()}))


async def test_what_opens_long_after_its_driver_was_cancelled_is_closed_again_too() -> None:
    go_on, undone = threading.Event(), threading.Event()
    opening = asyncio.create_task(
        in_thread(_call_that_waits(go_on), undo=lambda _opened: undone.set(), patience_s=0.02)
    )
    await asyncio.sleep(0.01)
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    assert not undone.is_set()
    go_on.set()
    assert await asyncio.to_thread(undone.wait, 10)


class _Opened:
    """What a call has opened when it fails; large, as buffers are."""


@pytest.mark.parametrize("patience_s", [None, 0.5])
async def test_what_a_call_that_failed_has_opened_is_let_go_at_once(patience_s: float | None) -> None:
    opened: list[weakref.ref[_Opened]] = []

    def fails() -> None:
        half_open = _Opened()
        opened.append(weakref.ref(half_open))
        message = "the interface is down"
        raise OSError(message)

    gc.disable()
    try:
        with contextlib.suppress(OSError):
            await in_thread(fails, patience_s=patience_s)
        async with asyncio.timeout(10):
            while opened[0]() is not None:  # its thread has yet to end
                await asyncio.sleep(0.001)
    finally:
        gc.enable()


def test_a_process_does_not_wait_for_a_call_that_hangs() -> None:
    script = """
import asyncio, threading
from drivers.reconnect import in_thread

async def main():
    task = asyncio.create_task(in_thread(threading.Event().wait, patience_s=0.02))
    await asyncio.sleep(0.01)
    task.cancel()
    await asyncio.wait({task})

asyncio.run(main())
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)


async def test_what_failed_needs_no_undoing() -> None:
    go_on, undone = threading.Event(), []

    def fails() -> str:
        go_on.wait(60)
        message = "taken"
        raise OSError(message)

    opening = asyncio.create_task(in_thread(fails, undo=undone.append))
    await asyncio.sleep(0.01)
    opening.cancel()
    await asyncio.sleep(0.01)
    go_on.set()
    with pytest.raises(asyncio.CancelledError):
        await opening
    assert undone == []
