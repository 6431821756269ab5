"""Streams by which nothing can be judged: their detectors get nothing, and hold what they have said."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.waiting import eventually

from daqsvc.acquisition.clock import NS_PER_S, DrivenClock, SystemClock
from daqsvc.acquisition.ring import SampleRing
from daqsvc.acquisition.samples import Quality, SampleBlock
from daqsvc.acquisition.standing import StreamStanding, StreamState
from daqsvc.alarms.manager import AlarmManager, Identity
from daqsvc.diagnosis.pipeline import Pipeline
from daqsvc.diagnosis.record import Diagnosis

if TYPE_CHECKING:
    from daqsvc.diagnosis.detector import Window

pytestmark = pytest.mark.integration
BLOCK = 10
DOUBT = "the device sends 1000 Hz, the file states 2000"


class Listener:
    """Says of each window where it begins."""

    name, stream, block = "levels", "s", BLOCK

    def __init__(self) -> None:
        self.windows: list[Window] = []

    def warm(self) -> None:
        """Nothing to compile."""

    def process(self, window: Window) -> list[Diagnosis]:
        self.windows.append(window)
        end = window.first_index + len(window.samples)
        return [Diagnosis("m", self.name, window.t_end_ns, "s", window.first_index, end, "N")]

    def silent(self, silence_s: float, t_ns: int) -> list[Diagnosis]:
        return [Diagnosis("m", self.name, t_ns, "s", 0, 0, "N", quality="missing", reason=f"{silence_s:g} s")]


async def write(ring: SampleRing, listener: Listener | None = None, quality: Quality = Quality.GOOD) -> None:
    """One block into the ring; wait until it has been processed, or for some turns of the loop."""
    before = len(listener.windows) if listener else 0
    first = ring.end_index
    samples = np.ones((BLOCK, 1), np.float32)
    ring.write(SampleBlock("s", first, samples, 1000 * first, 1000.0, quality=quality))
    async with asyncio.timeout(20):
        for _ in range(20):
            await asyncio.sleep(0)
        while listener and len(listener.windows) == before:
            await asyncio.sleep(0.001)


async def test_nothing_is_judged_by_a_stream_in_doubt() -> None:
    ring, listener, said = SampleRing("s", ("a",), 1000), Listener(), []
    pipeline = Pipeline({"s": ring}, [listener], said.append, SystemClock())
    running = asyncio.create_task(pipeline.run())
    await write(ring, listener)
    await eventually(lambda: len(said) >= 1, "that is stated")
    pipeline.stand("s", StreamState(DOUBT, proven=True))
    assert [(d.quality, d.reason, d.decision) for d in said[1:]] == [("missing", DOUBT, "N")]
    await write(ring)
    await write(ring)
    pipeline.stand("s", StreamState())
    await write(ring)  # may have begun before the doubt was over
    await write(ring, listener)
    await eventually(lambda: len(said) >= 3, "that is stated")
    ring.close()
    await running
    assert [(w.first_index, w.skipped) for w in listener.windows] == [(0, 0), (40, 30)]
    assert pipeline.counters["levels"].samples_withheld == 30
    assert [d.first_index for d in said if d.quality == "good"] == [0, 40]


async def test_a_break_among_samples_that_are_withheld_comes_with_those_after_them() -> None:
    ring, listener = SampleRing("s", ("a",), 1000), Listener()
    pipeline = Pipeline({"s": ring}, [listener], [].append, SystemClock())
    running = asyncio.create_task(pipeline.run())
    await write(ring, listener)
    pipeline.stand("s", StreamState(DOUBT, proven=True))
    await write(ring, quality=Quality.PLACE_ESTIMATED)
    pipeline.stand("s", StreamState())
    await write(ring)
    await write(ring, listener)
    ring.close()
    await running
    first, *_, last = listener.windows
    assert (first.breaks, last.skipped > 0, last.breaks) == ((), True, (last.first_index,))


async def test_what_is_said_before_the_rate_is_known_waits_for_it() -> None:
    ring, listener, said = SampleRing("s", ("a",), 1000), Listener(), []
    pipeline = Pipeline({"s": ring}, [listener], said.append, SystemClock())
    running = asyncio.create_task(pipeline.run())
    pipeline.stand("s", StreamState("", proven=False))
    await write(ring, listener)
    await write(ring, listener)
    await asyncio.sleep(0.02)
    assert said == []
    pipeline.stand("s", StreamState())
    await eventually(lambda: len(said) >= 2, "that is stated")
    ring.close()
    await running
    assert [d.first_index for d in said] == [0, 10]


async def test_what_was_said_before_the_rate_was_found_wrong_is_never_told() -> None:
    ring, listener, said = SampleRing("s", ("a",), 1000), Listener(), []
    pipeline = Pipeline({"s": ring}, [listener], said.append, SystemClock())
    running = asyncio.create_task(pipeline.run())
    pipeline.stand("s", StreamState("", proven=False))
    await write(ring, listener)
    await asyncio.sleep(0.02)
    pipeline.stand("s", StreamState(DOUBT, proven=True))
    ring.close()
    await running
    assert [(d.quality, d.reason) for d in said] == [("missing", DOUBT)]


async def test_a_doubt_takes_over_the_quality_alarm_of_a_stream_that_was_silent() -> None:
    ring, clock = SampleRing("s", ("a",), 1000), SystemClock()
    alarms, told = AlarmManager(Identity("lab", "box", "m"), [], clock), []
    pipeline = Pipeline({"s": ring}, [Listener()], lambda d: told.extend(alarms.take(d)), clock)
    running = asyncio.create_task(pipeline.run())
    async with asyncio.timeout(20):
        while not told:
            await asyncio.sleep(0.01)  # it is silent
    pipeline.stand("s", StreamState(DOUBT, proven=True))
    other = "the counter makes no sense"
    pipeline.stand("s", StreamState(other, proven=True))
    assert [event.kind.value for event in told] == ["raised", "changed"]
    assert told[1].message.endswith(DOUBT)
    ring.close()
    await running


async def test_a_device_that_stops_while_a_doubt_stands_is_silent_and_no_longer_doubted() -> None:
    ring, clock = SampleRing("s", ("a",), 1000), DrivenClock()
    alarms, events = AlarmManager(Identity("lab", "box", "m"), [], clock), []
    listener = Listener()
    pipeline = Pipeline({"s": ring}, [listener], lambda d: events.extend(alarms.take(d)), clock)
    standing = StreamStanding("s", pipeline.stand)
    running = asyncio.create_task(pipeline.run())

    async def live(seconds: int, doubt: str | None) -> list[tuple[str, str]]:
        """What the quality alarm says while frames come that are doubted so, or none (None)."""
        before = len(events)
        for _ in range(10 * seconds):
            if doubt is not None:
                standing.update(doubt, clock.monotonic_ns(), known=True)
            if doubt == "":
                first, t_ns = ring.end_index, clock.monotonic_ns()
                ring.write(SampleBlock("s", first, np.ones((BLOCK, 1), np.float32), t_ns, NS_PER_S / 100))
                await asyncio.sleep(0.01)
            clock.advance_to(clock.monotonic_ns() + NS_PER_S // 10)
            await asyncio.sleep(0)
            events.extend(alarms.tick())
        return [(event.kind.value, event.message.partition("judged: ")[2]) for event in events[before:]]

    other = "the device's counter stands still at 7"
    silence = "no samples of stream 's' for more than 2.0 s; check bus and device"
    assert await live(2, "") == []
    # However long it stands, while frames come.
    assert await live(9, DOUBT) == [("raised", DOUBT)]
    assert await live(9, None) == [("changed", silence)]
    assert await live(9, DOUBT) == [("changed", DOUBT)]
    assert await live(9, None) == [("changed", silence)]
    assert await live(9, other) == [("changed", other)]
    assert await live(9, None) == [("changed", silence)]
    assert await live(9, "") == [("returned", "")]
    assert await live(9, None) == [("raised", "2 s")], "as its detector says it"
    ring.close()
    await running
