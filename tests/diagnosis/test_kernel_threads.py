"""Threads that compute: none is lost for good, and none keeps another from its work."""

from __future__ import annotations

import asyncio
import ctypes
import threading
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.acquisition.ring import SampleRing
from daqsvc.acquisition.samples import Quality, SampleBlock
from daqsvc.diagnosis import pipeline as pipeline_module
from daqsvc.diagnosis.pipeline import KernelThreads, Pipeline
from daqsvc.dsp.quality import missing
from daqsvc.supervision import Supervisor

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from daqsvc.diagnosis.detector import Window
    from daqsvc.diagnosis.record import Diagnosis


@pytest.fixture
def kernels() -> Iterator[Callable[[int], KernelThreads]]:
    made: list[KernelThreads] = []

    def make(count: int) -> KernelThreads:
        made.append(KernelThreads(count, failures.append))
        return made[-1]

    failures: list[BaseException] = []
    make.failures = failures  # type: ignore[attr-defined]
    yield make
    for each in made:
        each.close()
        each.join()


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
    (thread,) = threads._threads
    begun = threading.Event()

    def spin() -> None:
        begun.set()
        while True:
            pass

    job = threads.submit(spin)
    await asyncio.to_thread(begun.wait, 20)
    _kill(thread)
    async with asyncio.timeout(20):
        with pytest.raises(RuntimeError, match="interrupted by SystemExit"):
            await job.outcome
        assert await threads.submit(lambda: 3).outcome == 3


async def test_a_call_that_hangs_is_given_up_and_its_thread_replaced(
    kernels: Callable[[int], KernelThreads],
) -> None:
    threads = kernels(1)
    may_end = threading.Event()
    job = threads.submit(lambda: may_end.wait(60))
    waiting = threads.submit(lambda: 4)
    await eventually(lambda: job.thread is not None, "it has begun")
    assert not threads.replace(waiting), "it has not begun"
    assert threads.replace(job)
    assert not threads.replace(job), "once"
    async with asyncio.timeout(20):
        assert await waiting.outcome == 4
        may_end.set()
        assert await job.outcome


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
