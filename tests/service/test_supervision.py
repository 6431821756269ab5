"""Parts that end are started again, said once and counted; what cannot be is passed on."""

from __future__ import annotations

import asyncio
import logging
import re
import threading
from typing import TYPE_CHECKING

import pytest
from support.waiting import eventually

from daqsvc import supervision
from daqsvc.acquisition.link import Backoff
from daqsvc.supervision import OTHERS, Supervisor, over, stop_all
from daqsvc.threads import CallThreads, ThreadLostError, call_in_thread

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.fixture(autouse=True)
def _at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervision, "Backoff", lambda: Backoff(1000, 1000))


async def _for_ever() -> None:
    await asyncio.Event().wait()


async def _fail() -> None:
    raise ValueError("no such thing\nsecond line")


def _sequence(*works: Callable[[], object]) -> tuple[Callable[[], object], list[int]]:
    """Work that does another thing at each start, and for ever the last; and the count of its starts."""
    starts: list[int] = []

    def work() -> object:
        starts.append(1)
        return works[min(len(starts), len(works)) - 1]()

    return work, starts


async def _nothing() -> None:
    return


def _raise_before_there_is_a_coroutine() -> None:
    raise KeyError("at once")


@pytest.mark.sources  # says where an error is, from the folder that the package lies in
async def test_whatever_ends_a_part_it_is_started_again(caplog: pytest.LogCaptureFixture) -> None:
    supervisor = Supervisor()
    work, starts = _sequence(_fail, _nothing, _raise_before_there_is_a_coroutine, _for_ever)
    part = supervisor.keep("clock", work)
    await eventually(lambda: len(starts) == 4, "it has been started four times")
    task = next(t for t in asyncio.all_tasks() if t.get_name() == "clock")
    task.cancel()
    await eventually(lambda: len(starts) == 5, "it is started again")
    assert supervisor.failures == {"clock": 4}
    said = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    here = "tests/service/test_supervision.py"
    assert [re.sub(r"\.py:\d+", ".py", line) for line in said] == [
        f"clock: failed with ValueError: no such thing at {here}; it is started again",
        "clock: it has ended by itself; it is started again (failure 2 of it)",
        f"clock: failed with KeyError: 'at once' at {here}; it is started again (failure 3 of it)",
        "clock: it was cancelled; it is started again (failure 4 of it)",
    ]
    await stop_all([part], 5.0)
    assert part.over.done()


async def test_the_same_failure_is_said_once_and_counted_each_time(caplog: pytest.LogCaptureFixture) -> None:
    supervisor = Supervisor()
    part = supervisor.keep("status", _fail)
    await eventually(lambda: supervisor.failures["status"] > 10, "it has failed often")
    await stop_all([part], 5.0)
    assert len([record for record in caplog.records if record.levelno == logging.ERROR]) == 1


async def test_a_part_that_waits_to_be_started_again_stops_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervision, "Backoff", lambda: Backoff(3600 * 10**9))
    supervisor = Supervisor()
    parts = [supervisor.keep(name, _fail) for name in ("one", "two")]
    await eventually(lambda: supervisor.failures.total() == 2, "both have failed")
    parts[0].leave()
    await stop_all(parts, 5.0)
    assert all(part.over.done() for part in parts)


async def test_a_part_that_may_end_is_over_then() -> None:
    supervisor = Supervisor()
    part = supervisor.keep("driver", _nothing, may_end=lambda: True)
    await over([part])
    assert not supervisor.failures


async def test_a_part_that_is_left_to_itself_is_not_started_again() -> None:
    supervisor = Supervisor()
    ends = asyncio.Event()

    async def until_told() -> None:
        await ends.wait()

    part = supervisor.keep("mqtt", until_told)
    part.leave()
    ends.set()
    await over([part], 5.0)
    assert part.over.done()
    assert not supervisor.failures


async def test_what_ends_the_service_does_so_at_the_first_start_only() -> None:
    supervisor = Supervisor()
    part = supervisor.keep("driver", _fail, fatal=(ValueError,))
    await over([part], 5.0)
    with pytest.raises(ValueError, match="no such thing"):
        supervisor.lost.result()
    later = Supervisor()
    work, starts = _sequence(_nothing, _fail)
    part = later.keep("driver", work, fatal=(ValueError,))
    await eventually(lambda: len(starts) > 3, "it has failed again and again")
    assert not later.lost.done()
    await stop_all([part], 5.0)


@pytest.mark.gives("S18")
async def test_a_part_that_ignores_its_end_is_said_and_left_behind(caplog: pytest.LogCaptureFixture) -> None:
    supervisor = Supervisor()
    may_end = asyncio.Event()

    async def deaf() -> None:
        while not may_end.is_set():
            try:
                await may_end.wait()
            except asyncio.CancelledError:
                continue

    part = supervisor.keep("deaf", deaf)
    await asyncio.sleep(0)
    await stop_all([part], 0.01)
    assert caplog.messages == ["deaf does not stop within 0.01 s and is left behind"]
    may_end.set()
    await over([part], 5.0)


async def test_callbacks_tasks_and_threads_that_nobody_waits_for_are_heard() -> None:
    supervisor = Supervisor()
    with supervisor.hearing():
        asyncio.get_running_loop().call_soon(_raise_before_there_is_a_coroutine)
        thread = threading.Thread(target=_raise_before_there_is_a_coroutine, name="reader")
        thread.start()
        await eventually(lambda: supervisor.failures[OTHERS] == 1, "the callback is heard")
        forgotten = asyncio.create_task(_fail())
        await asyncio.wait({forgotten})
        del forgotten
        await eventually(lambda: supervisor.failures[OTHERS] == 2, "the task is heard")
        await eventually(lambda: supervisor.failures["thread reader"] == 1, "the thread is heard")
        thread.join()


async def test_one_piece_of_work_spares_the_rest() -> None:
    supervisor = Supervisor()
    with supervisor.sparing_others("stream shaft", "a block is lost"):
        raise ValueError
    assert supervisor.failures == {"stream shaft": 1}


async def test_each_call_has_a_thread_that_the_end_does_not_wait_for() -> None:
    loop = asyncio.get_running_loop()
    loop.set_default_executor(CallThreads())
    may_end = threading.Event()
    hanging = [asyncio.ensure_future(asyncio.to_thread(may_end.wait, 20)) for _ in range(40)]
    assert await asyncio.to_thread(lambda: threading.current_thread().daemon)
    await loop.shutdown_default_executor()
    may_end.set()
    assert all(await asyncio.gather(*hanging))


async def test_a_thread_that_is_ended_in_a_call_does_not_end_who_waits() -> None:
    def leave() -> None:
        raise SystemExit

    supervisor = Supervisor()
    with supervisor.hearing():
        outcome = call_in_thread(leave, name="leave")
        with pytest.raises(ThreadLostError):
            await asyncio.wrap_future(outcome)
        await eventually(lambda: supervisor.failures["thread blocking leave"] == 1, "it is heard")
