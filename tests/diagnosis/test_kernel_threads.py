"""Threads that compute: none is lost for good, and none keeps another from its work."""

from __future__ import annotations

import asyncio
import ctypes
import os
import threading
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.acquisition.ring import SampleRing
from daqsvc.acquisition.samples import Quality, SampleBlock
from daqsvc.diagnosis import pipeline as pipeline_module
from daqsvc.diagnosis.pipeline import NICE, KernelThreads, Pipeline
from daqsvc.dsp.quality import missing
from daqsvc.supervision import Supervisor

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Sequence

    from daqsvc.diagnosis.detector import Window
    from daqsvc.diagnosis.record import Diagnosis


@pytest.fixture
async def kernels() -> AsyncIterator[Callable[[int], KernelThreads]]:
    made: list[KernelThreads] = []

    def make(count: int) -> KernelThreads:
        made.append(KernelThreads(count, failures.append))
        made[-1].enter()
        return made[-1]

    failures: list[BaseException] = []
    make.failures = failures  # type: ignore[attr-defined]
    yield make
    for each in made:
        await each.leave([])
        assert not each._threads


def _kill(thread: threading.Thread) -> None:
    ctypes.pythonapi.PyThreadState_SetAsyncExc(
        ctypes.c_ulong(thread.ident or 0), ctypes.py_object(SystemExit)
    )


async def test_calls_are_made_and_failures_passed_on(kernels: Callable[[int], KernelThreads]) -> None:
    threads = kernels(2)
    jobs = [threads.submit(lambda n=n: 10 // n) for n in (1, 0, 5)]
    assert await jobs[0].outcome == 10
    with pytest.raises(ZeroDivisionError):
        await jobs[1].outcome
    assert await jobs[2].outcome == 2


async def test_calls_one_after_the_other_are_made_by_the_same_thread(
    kernels: Callable[[int], KernelThreads],
) -> None:
    """Its processor knows the kernels; two by turns took a fifth more of the whole service."""
    threads = kernels(3)
    all_three = threading.Barrier(3)
    jobs = [threads.submit(all_three.wait) for _ in range(3)]
    assert {await job.outcome for job in jobs} == {0, 1, 2}, "those that wait for each other go side by side"
    by = set()
    for _ in range(10):
        await eventually(lambda: len(threads._idle) == 3, "all wait")
        by.add(await threads.submit(threading.get_ident).outcome)
    assert len(by) == 1


async def test_what_computes_makes_way_for_the_event_loop(
    kernels: Callable[[int], KernelThreads],
) -> None:
    own = os.getpriority(os.PRIO_PROCESS, 0)
    theirs = await kernels(1).submit(lambda: os.getpriority(os.PRIO_PROCESS, 0)).outcome
    assert theirs == min(own + NICE, 19)
    assert os.getpriority(os.PRIO_PROCESS, 0) == own


async def test_threads_are_there_while_somebody_uses_them(
    kernels: Callable[[int], KernelThreads],
) -> None:
    threads = kernels(2)
    assert not threads._threads, "there is nothing to do yet"
    assert await threads.submit(lambda: 1).outcome == 1
    threads.enter()
    may_end = threading.Event()
    job = threads.submit(lambda: may_end.wait(60))
    leaving = asyncio.create_task(threads.leave([job]))
    await eventually(lambda: job.thread is not None, "it has begun")
    assert await threads.submit(lambda: 2).outcome == 2, "there is one more who uses them"
    assert not leaving.done(), "its call is under way"
    may_end.set()
    await leaving
    assert len(threads._threads) == 2
    await threads.leave([])
    assert not threads._threads
    threads.enter()
    assert await threads.submit(lambda: 3).outcome == 3, "another one uses them later"


async def test_an_idle_thread_that_is_killed_makes_the_next_call_all_the_same(
    kernels: Callable[[int], KernelThreads],
) -> None:
    threads = kernels(1)
    assert await threads.submit(lambda: 1).outcome == 1
    (thread,) = threads._threads
    for _ in range(3):
        _kill(thread)
        async with asyncio.timeout(20):
            assert await threads.submit(lambda: 2).outcome == 2
    assert len(kernels.failures) == 3


async def test_a_thread_that_is_killed_in_a_call_fails_it_and_goes_on(
    kernels: Callable[[int], KernelThreads],
) -> None:
    threads = kernels(1)
    begun = threading.Event()

    def spin() -> None:
        begun.set()
        while True:
            pass

    job = threads.submit(spin)
    await asyncio.to_thread(begun.wait, 20)
    (thread,) = threads._threads
    _kill(thread)
    async with asyncio.timeout(20):
        with pytest.raises(RuntimeError, match="interrupted by SystemExit"):
            await job.outcome
        assert await threads.submit(lambda: 3).outcome == 3


async def test_a_call_that_takes_long_has_its_thread_to_itself_and_one_that_hangs_is_given_up(
    kernels: Callable[[int], KernelThreads],
) -> None:
    threads = kernels(1)
    may_end = threading.Event()
    slow, hanging, waiting = (
        threads.submit(call) for call in (lambda: may_end.wait(60), lambda: may_end.wait(60), lambda: 4)
    )
    await eventually(lambda: slow.thread is not None, "it has begun")
    threads.set_apart(hanging)
    assert not hanging.apart, "it has not begun"
    threads.set_apart(slow)
    await eventually(lambda: hanging.thread is not None, "another thread goes on")
    threads.set_apart(slow)
    assert len(threads._threads) == 1, "once"
    threads.set_apart(hanging)
    async with asyncio.timeout(20):
        assert await waiting.outcome == 4
    threads.give_up(hanging)
    leaving = asyncio.create_task(threads.leave([slow, hanging]))
    await eventually(lambda: not threads._threads, "those without work end")
    assert not leaving.done(), "one takes long"
    assert threads._apart == {slow.thread}
    may_end.set()
    await leaving
    assert await hanging.outcome
    threads.enter()


class _Counting:
    """A detector that counts, and does something else besides."""

    stream, block = "s", 10

    def __init__(self, name: str, besides: Callable[[], None] = lambda: None) -> None:
        self.name = name
        self.windows = 0
        self._besides = besides

    def warm(self) -> None:
        raise RuntimeError(f"{self.name} does not compile")

    def process(self, _window: Window) -> Sequence[Diagnosis]:
        self.windows += 1
        self._besides()
        return []

    def silent(self, _silence_s: float, _now_ns: int) -> Sequence[Diagnosis]:
        raise RuntimeError(f"{self.name} has no words")


async def test_what_one_detector_does_is_no_matter_to_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline_module, "LONG_S", 0.05)
    monkeypatch.setattr(pipeline_module, "HANG_S", 0.1)
    monkeypatch.setattr(missing, "SILENCE_NS", 0)
    monkeypatch.setattr(pipeline_module, "LOOK_NS", 10_000_000)
    may_end = threading.Event()
    hanging = [_Counting(f"hangs-{n}", lambda: may_end.wait(60) or None) for n in range(3)]
    sound = _Counting("sound")
    ring = SampleRing("s", ("x",), 1000)
    supervisor = Supervisor()
    pipeline = Pipeline({"s": ring}, [*hanging, sound], lambda _: None, SystemClock(), supervisor=supervisor)
    await pipeline.warm()
    assert supervisor.failures == dict.fromkeys([f"detector {d.name}" for d in (*hanging, sound)], 1)
    running = asyncio.create_task(pipeline.run())
    for first in range(0, 200, 10):
        done = sound.windows
        samples = np.zeros((10, 1), np.float32)
        ring.write(SampleBlock("s", first, samples, first * 10**6, 1e6, 0, Quality.GOOD))
        await eventually(lambda done=done: sound.windows > done, "the sound one goes on")
    assert [each.windows for each in hanging] == [1, 1, 1]
    may_end.set()
    ring.close()
    await running
    assert sound.windows == 20
