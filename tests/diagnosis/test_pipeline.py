"""The pipeline: order, catching up, overruns, and a detector that breaks its contract."""

from __future__ import annotations

import asyncio
import logging
import math
import threading
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.waiting import PATIENCE_S, eventually

from daqsvc.acquisition.clock import DrivenClock, SystemClock
from daqsvc.acquisition.ring import SampleRing
from daqsvc.acquisition.samples import SampleBlock
from daqsvc.diagnosis.pipeline import Pipeline
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.dsp.quality.missing import Patience
from daqsvc.supervision import Supervisor

if TYPE_CHECKING:
    from daqsvc.diagnosis.detector import Window

pytestmark = pytest.mark.integration
CLOCK = SystemClock()


class Listener:
    """Remembers its windows; raises on demand, or waits."""

    def __init__(self, name: str, block: int, *, fail_at: int | None = None) -> None:
        self.name, self.stream, self.block = name, "s", block
        self.windows: list[Window] = []
        self.threads: set[str] = set()
        self.fail_at = fail_at
        self.go_on = threading.Event()
        self.go_on.set()
        self.warmed = False

    def warm(self) -> None:
        self.warmed = True

    def process(self, window: Window) -> list[Diagnosis]:
        self.go_on.wait(PATIENCE_S)
        self.threads.add(threading.current_thread().name)
        self.windows.append(window)
        if len(self.windows) - 1 == self.fail_at:
            raise ZeroDivisionError("a detector broke its contract")
        end = window.first_index + len(window.samples)
        return [Diagnosis("m", self.name, window.t_end_ns, "s", window.first_index, end, "N")]

    def silent(self, silence_s: float, t_ns: int) -> list[Diagnosis]:
        return [Diagnosis("m", self.name, t_ns, "s", 0, 0, "N", quality="missing", reason=f"{silence_s:g} s")]


def write(ring: SampleRing, n: int) -> None:
    first = ring.end_index
    samples = np.arange(first, first + n, dtype=np.float32)[:, None]
    ring.write(SampleBlock("s", first, samples, 1000 * first, 1000.0))


async def test_every_detector_sees_every_sample_in_order_off_the_loop() -> None:
    ring = SampleRing("s", ("a",), 1000)
    detectors = [Listener("one", 7), Listener("two", 16)]
    said: list[Diagnosis] = []
    pipeline = Pipeline({"s": ring}, detectors, said.append, CLOCK)
    await pipeline.warm()
    assert all(d.warmed for d in detectors)
    running = asyncio.create_task(pipeline.run())
    for n in (3, 30, 5, 100, 1, 60):
        write(ring, n)
        await asyncio.sleep(0.002)
    ring.close()
    await running
    for detector in detectors:
        got = np.concatenate([w.samples[:, 0] for w in detector.windows])
        whole = 199 // detector.block * detector.block
        np.testing.assert_array_equal(got, np.arange(whole))
        assert all(w.t_end_ns == 1000 * (w.first_index + len(w.samples) - 1) for w in detector.windows)
        assert all(name.startswith("kernel") for name in detector.threads)
        assert [d.first_index for d in said if d.detector == detector.name] == [
            w.first_index for w in detector.windows
        ]
    assert not [t for t in threading.enumerate() if t.name.startswith("kernel")]


async def test_a_detector_that_is_too_slow_learns_exactly_what_it_missed() -> None:
    ring = SampleRing("s", ("a",), 50)
    slow = Listener("slow", 10)
    pipeline = Pipeline({"s": ring}, [slow], lambda _: None, CLOCK)
    running = asyncio.create_task(pipeline.run())
    slow.go_on.clear()
    write(ring, 10)
    await asyncio.sleep(0.05)
    write(ring, 175)
    slow.go_on.set()
    await asyncio.sleep(0.05)
    ring.close()
    await running
    assert [(w.first_index, len(w.samples), w.skipped) for w in slow.windows] == [(0, 10, 0), (135, 50, 125)]
    assert pipeline.counters["slow"].samples_skipped == 125


async def test_only_a_detector_with_samples_can_be_found_to_stand_still() -> None:
    ring = SampleRing("s", ("a",), 50)
    quick, hung = Listener("quick", 10), Listener("hung", 10)
    pipeline = Pipeline({"s": ring}, [quick, hung], lambda _: None, CLOCK)
    running = asyncio.create_task(pipeline.run())
    assert {part: progress.step for part, progress in pipeline.progress().items()} == {
        "detector quick": None,
        "detector hung": None,
    }
    hung.go_on.clear()
    write(ring, 10)
    await eventually(lambda: pipeline.counters["quick"].windows == 1, "it has its window")
    await asyncio.sleep(0.05)
    before = pipeline.progress()
    assert before["detector quick"].step is None, "it waits for samples"
    assert before["detector hung"].step is not None
    assert before["detector hung"].thread is not None
    write(ring, 30)
    await asyncio.sleep(0.05)
    assert pipeline.progress()["detector hung"] == before["detector hung"]
    hung.go_on.set()
    await eventually(lambda: pipeline.counters["hung"].samples == 40, "it has caught up")
    await asyncio.sleep(0.05)
    assert pipeline.progress()["detector hung"].step is None
    ring.close()
    await running


async def test_an_outage_longer_than_the_ring_is_no_fault_of_the_detector(
    caplog: pytest.LogCaptureFixture,
) -> None:
    ring = SampleRing("s", ("a",), 16)
    quick = Listener("quick", 4)
    pipeline = Pipeline({"s": ring}, [quick], lambda _: None, CLOCK)
    running = asyncio.create_task(pipeline.run())
    write(ring, 8)
    await asyncio.sleep(0.02)
    block = SampleBlock("s", 108, np.full((4, 1), 1.0, np.float32), 108_000, 1000.0, lost_before=100)
    ring.write(block)
    await asyncio.sleep(0.02)
    ring.close()
    await running
    # The windows after the outage know of all that lies between; the figures, of what was there to be had.
    assert [(w.first_index, len(w.samples), w.skipped) for w in quick.windows] == [(0, 8, 0), (96, 16, 88)]
    assert pipeline.counters["quick"].samples_skipped == 0
    assert not caplog.records


async def test_a_detector_that_raises_is_heard_once_and_goes_on(caplog: pytest.LogCaptureFixture) -> None:
    ring = SampleRing("s", ("a",), 50)
    broken = Listener("broken", 10, fail_at=0)
    said: list[Diagnosis] = []
    pipeline = Pipeline({"s": ring}, [broken], said.append, CLOCK)
    running = asyncio.create_task(pipeline.run())
    for count in (1, 2, 3):
        write(ring, 10)
        await eventually(lambda count=count: len(said) == count, "the window is judged")
    ring.close()
    await running
    assert pipeline.counters["broken"].failures == 1
    assert [(d.first_index, d.decision, d.quality) for d in said] == [
        (0, "N", "missing"),
        (10, "N", "good"),
        (20, "N", "good"),
    ]
    assert said[0].reason == "detector broken has failed: ZeroDivisionError: a detector broke its contract"
    errors = [r.message for r in caplog.records if r.levelno >= logging.ERROR]
    assert len(errors) == 1
    assert "detector broken: failed with ZeroDivisionError" in errors[0]


async def test_one_that_raises_each_time_is_in_doubt_all_the_time() -> None:
    ring = SampleRing("s", ("a",), 50)
    broken = Listener("broken", 10)
    broken.process = always_failing  # type: ignore[method-assign,assignment]
    said: list[Diagnosis] = []
    supervisor = Supervisor()
    pipeline = Pipeline({"s": ring}, [broken], said.append, CLOCK, supervisor=supervisor)
    running = asyncio.create_task(pipeline.run())
    for count in range(1, 4):
        write(ring, 10)
        await eventually(lambda count=count: len(said) == count)
    ring.close()
    await running
    assert {d.quality for d in said} == {"missing"}
    assert supervisor.failures["detector broken"] == 3


async def said_of_a_failed_window(broken: Listener) -> list[Diagnosis]:
    """What a pipeline reports of one window, in which its detector fails."""
    ring, said = SampleRing("s", ("a",), 50), list[Diagnosis]()
    running = asyncio.create_task(Pipeline({"s": ring}, [broken], said.append, CLOCK).run())
    write(ring, 10)
    await eventually(lambda: len(said) == 1, "the window has failed")
    ring.close()
    await running
    return said


@pytest.mark.parametrize("speaks_for", ["broken", "broken/x"])
async def test_one_that_fails_says_nothing_of_its_sensor(speaks_for: str) -> None:
    broken = Listener("broken", 10, fail_at=0)
    held = Diagnosis("m", speaks_for, 0, "s", 0, 0, "N", quality="missing", sensors=("x",))
    broken.silent = lambda _silence_s, t_ns: [replace(held, t_ns=t_ns)]  # type: ignore[method-assign]
    said = await said_of_a_failed_window(broken)
    assert [(d.detector, d.quality, d.sensors) for d in said] == [(speaks_for, "missing", ())]


class UnsayableError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("nested")


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (SystemExit(0), "it raises SystemExit: 0"),
        (KeyboardInterrupt(), "it raises KeyboardInterrupt"),
        (GeneratorExit(), "it raises GeneratorExit"),
        (asyncio.CancelledError(), "it raises CancelledError"),
        (UnsayableError(), "it raises UnsayableError"),
        (ValueError("\ud800"), "it raises ValueError"),
    ],
)
async def test_whatever_ends_a_detector_is_one_failed_window(
    error: BaseException, words: str, caplog: pytest.LogCaptureFixture
) -> None:
    ring = SampleRing("s", ("a",), 50)
    broken = Listener("broken", 10)

    def fail(*_: object) -> list[Diagnosis]:
        raise error

    judge, broken.process = broken.process, fail  # type: ignore[method-assign]
    said: list[Diagnosis] = []
    pipeline = Pipeline({"s": ring}, [broken], said.append, CLOCK)
    broken.warm = fail  # type: ignore[method-assign,assignment]
    await pipeline.warm()
    running = asyncio.create_task(pipeline.run())
    for count in range(1, 4):
        write(ring, 10)
        await eventually(lambda count=count: len(said) == count, "the window has failed")
    broken.process = judge  # type: ignore[method-assign]
    write(ring, 10)
    await eventually(lambda: len(said) == 4, "the window is judged")
    ring.close()
    await running
    assert [d.quality for d in said] == ["missing"] * 3 + ["good"]
    assert {d.reason for d in said[:3]} == {f"detector broken has failed: RuntimeError: {words}"}
    assert pipeline.counters["broken"].failures == 3
    errors = [r.getMessage() for r in caplog.records if r.levelno >= logging.ERROR]
    assert all(f"detector broken: failed with RuntimeError: {words}" in line for line in errors)


async def test_a_statement_in_the_name_of_another_detector_is_a_failure() -> None:
    ring = SampleRing("s", ("a",), 50)
    broken = Listener("broken", 10)
    own = broken.process
    broken.process = lambda window: [replace(one, detector="levels") for one in own(window)]  # type: ignore[method-assign]
    said: list[Diagnosis] = []
    pipeline = Pipeline({"s": ring}, [broken], said.append, CLOCK)
    running = asyncio.create_task(pipeline.run())
    write(ring, 10)
    await eventually(lambda: len(said) == 1, "the window has failed")
    ring.close()
    await running
    words = "detector broken has failed: it returns a statement of 'levels'; name it broken"
    assert [(d.detector, d.quality, d.reason) for d in said] == [("broken", "missing", words)]


UNTOLD: dict[str, tuple[dict[str, Any], str]] = {
    "nan": ({"statistics": {"rms": math.nan}}, "rms is nan; give a finite number, or leave it out"),
    "text": ({"thresholds": {"rms": "high"}}, "rms is 'high', which is not a number"),
    "names": (
        {"evidence": {1: 2.0}},
        "1 in its evidence is no name; give a text of 200 characters at most",
    ),
    "unit": ({"units": {"rms": "\udc00"}}, "rms is '\\udc00'; give a text"),
    "decision": ({"decision": "N\x1b[31m"}, "decision is 'N\\x1b[31m'; give a text"),
    "reason": ({"reason": "a\nb"}, "reason is 'a\\nb'; give a text of 2000 characters at most"),
    "severity": ({"severity": "grave"}, "there is no severity 'grave'"),
    "quality": ({"quality": ["good"]}, "there is no quality ['good']"),
    "sensors": ({"sensors": ("x", None)}, "sensors is None, which is not a text"),
    "bounds": ({"bounds": {"rms": (0.0, math.inf)}}, "rms is inf; give a finite number"),
    "revolutions": ({"revolutions": math.nan}, "revolutions is nan; give a finite number"),
    "index": ({"end_index": None}, "end_index is None, which is not a whole number"),
    "future": ({"t_ns": 10**30}, f"t_ns is {10**30}; give the time of its last sample, from "),
    "past": ({"t_ns": -(10**15)}, f"t_ns is -{10**15}; give the time of its last sample, from "),
    "time": ({"t_ns": "now"}, "t_ns is 'now', which is not a whole number"),
}


@pytest.mark.parametrize("untold", UNTOLD)
async def test_a_statement_by_hand_is_held_to_what_a_judgement_is(
    untold: str, caplog: pytest.LogCaptureFixture
) -> None:
    odd, words = UNTOLD[untold]
    broken = Listener("broken", 10)
    own = broken.process
    broken.process = lambda window: [replace(one, **odd) for one in own(window)]  # type: ignore[method-assign]
    said = await said_of_a_failed_window(broken)
    begins = f"detector broken has failed: it returns a statement that cannot be sent: {words}"
    assert said[0].reason.startswith(begins)
    [line] = [r.getMessage() for r in caplog.records if r.levelno >= logging.ERROR]
    assert line.isprintable()


def always_failing(window: Window) -> list[Diagnosis]:
    raise RuntimeError("boom")


@pytest.mark.gives("D20")
async def test_without_detectors_it_lasts_as_long_as_the_rings_and_says_what_falls_silent(
    caplog: pytest.LogCaptureFixture,
) -> None:
    clock, ring = DrivenClock(), SampleRing("s", ("a",), 50)
    running = asyncio.create_task(Pipeline({"s": ring}, [], lambda _: None, clock).run())
    write(ring, 10)
    for _ in range(40):
        await asyncio.sleep(0.002)
        clock.advance_to(clock.monotonic_ns() + 250_000_000)
    assert not running.done(), "it is not started again and again"
    assert [r.message for r in caplog.records] == [
        "no samples of stream 's' for more than 2.0 s; check bus and device; no detector reads them"
    ]
    ring.close()
    await asyncio.sleep(0.002)
    clock.advance_to(clock.monotonic_ns() + 1_000_000_000)
    await running


async def test_a_silence_is_said_once_and_again_after_the_next() -> None:
    clock, ring = DrivenClock(), SampleRing("s", ("a",), 50)
    said: list[Diagnosis] = []
    pipeline = Pipeline({"s": ring}, [Listener("one", 10)], said.append, clock)
    running = asyncio.create_task(pipeline.run())
    silences = []
    for second in range(1, 16):
        if second in {1, 2, 8}:
            write(ring, 10)
        for _ in range(4):
            await asyncio.sleep(0.005)
            clock.advance_to(clock.monotonic_ns() + 250_000_000)
        silences.append(sum(d.quality == "missing" for d in said))
    assert silences[:3] == [0, 0, 0]
    assert silences[4:7] == [1, 1, 1]
    assert silences[7:9] == [1, 1]
    assert silences[11:] == [2, 2, 2, 2]
    ring.close()
    await running


def explained() -> tuple[DrivenClock, SampleRing, dict[str, str], list[Diagnosis], asyncio.Task[None]]:
    """A pipeline over a silent stream ``s``, what the bus knows of that, and what is said."""
    clock, ring, known = DrivenClock(), SampleRing("s", ("a",), 50), {"s": ""}
    said: list[Diagnosis] = []
    pipeline = Pipeline({"s": ring}, [Listener("one", 10)], said.append, clock, why_silent=known.__getitem__)
    return clock, ring, known, said, asyncio.create_task(pipeline.run())


async def test_what_the_bus_knows_of_a_silence_is_said_also_when_it_comes_later() -> None:
    clock, ring, known, said, running = explained()
    for quarter in range(1, 41):
        known["s"] = "unit 1 refuses that" if quarter > 20 else ""
        await asyncio.sleep(0.005)
        clock.advance_to(clock.monotonic_ns() + 250_000_000)
    assert [one.reason for one in said] == ["2 s", "no samples of stream 's': unit 1 refuses that"]
    ring.close()
    await running


@pytest.mark.parametrize("stands", [True, False])
async def test_another_reason_for_a_silence_is_said_once_it_stands(stands) -> None:
    clock, ring, known, said, running = explained()
    silent, aside = "unit 33 has not answered within 500 ms", "unit 33 is set aside: unit 33 has not answered"
    reasons = [silent, silent, f"{aside} within 500 ms"]
    for half in range(1, 181):
        # Asked now and then, the unit is silent; else it is set aside: that is one reason.
        known["s"] = reasons[half % 3]
        if half > 60 and (stands or half % 10):
            known["s"] = "unit 33 refuses function 3: illegal data address (register 4)"
        if half > 120 and (stands or half % 10):
            known["s"] = ""
        await asyncio.sleep(0.005)
        clock.advance_to(clock.monotonic_ns() + 500_000_000)
    begin = "no samples of stream 's'"
    first, *later = [one.reason for one in said]
    assert first.startswith(f"{begin}: unit 33 ")
    if stands:
        refused, unknown = later
        assert refused == f"{begin}: unit 33 refuses function 3: illegal data address (register 4)"
        assert "has not answered" not in unknown
    else:
        assert later == [], "as long as the first reason comes back, it is the one"
    ring.close()
    await running


async def test_a_bus_on_which_nothing_comes_is_named_and_what_comes_later_too() -> None:
    clock, ring = DrivenClock(), SampleRing("s", ("a",), 50)
    said: list[Diagnosis] = []
    known = {"s": ""}
    pipeline = Pipeline(
        {"s": ring},
        [Listener("one", 10)],
        said.append,
        clock,
        why_silent=lambda stream: known[stream],
        bus_quiet=lambda stream: "" if known[stream] else "no frame at all on can0 for 1 s",
    )
    running = asyncio.create_task(pipeline.run())
    for quarter in range(1, 41):
        known["s"] = "the bus works" if quarter > 20 else ""
        await asyncio.sleep(0.005)
        clock.advance_to(clock.monotonic_ns() + 250_000_000)
    nothing, other = (one.reason for one in said)
    assert nothing.endswith("for more than 2.0 s, and no frame at all on can0 for 1 s; check bus and device")
    assert other == "no samples of stream 's': the bus works"
    ring.close()
    await running


async def test_silence_counts_from_when_the_driver_is_ready_but_not_for_ever() -> None:
    clock, ring = DrivenClock(), SampleRing("s", ("a",), 50)
    said: list[Diagnosis] = []
    ready = False
    pipeline = Pipeline(
        {"s": ring}, [Listener("one", 10)], said.append, clock, is_prepared_for=lambda _stream: not ready
    )
    running = asyncio.create_task(pipeline.run())
    silent_at: list[float] = []
    for half_second in range(1, 100):
        ready = half_second > 40
        await asyncio.sleep(0.005)
        clock.advance_to(clock.monotonic_ns() + 500_000_000)
        silent_at += [half_second / 2] * (len(said) - len(silent_at))
    assert silent_at == [pytest.approx(22.5, abs=0.6)]
    write(ring, 10)
    ready = False
    for half_second in range(100, 640):
        await asyncio.sleep(0.001)
        clock.advance_to(clock.monotonic_ns() + 500_000_000)
        silent_at += [half_second / 2] * (sum(d.quality == "missing" for d in said) - len(silent_at))
    assert silent_at[1:] == [pytest.approx(302.5, abs=3.0)]
    ring.close()
    await running


async def test_a_stream_that_is_sampled_once_a_minute_is_silent_after_minutes_only() -> None:
    clock, ring = DrivenClock(), SampleRing("s", ("a",), 50)
    said: list[Diagnosis] = []
    pipeline = Pipeline({"s": ring}, [Listener("one", 1)], said.append, clock, patience={"s": Patience(60e9)})
    running = asyncio.create_task(pipeline.run())
    await asyncio.sleep(0.005)
    silent_at = []
    for half_seconds in range(1, 1000):
        if half_seconds in {1, 121, 481}:  # the values of the second and the third minute are lost
            write(ring, 1)
        clock.advance_to(clock.monotonic_ns() + 500_000_000)
        for _ in range(4):
            await asyncio.sleep(0)
        silent_at += [half_seconds / 2] * (len([d for d in said if d.quality == "missing"]) - len(silent_at))
    assert silent_at == [481 / 2 + 210.0]
    ring.close()
    await running
