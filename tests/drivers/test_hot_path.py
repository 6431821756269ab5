"""No per-sample Python in the hot path: the work of the interpreter does not grow with the samples."""

from __future__ import annotations

import sys

import can
import numpy as np
import pytest
from support.bus_tables import can_bus

from daqsvc.acquisition.clock import SystemClock
from daqsvc.acquisition.ring import SampleRing
from daqsvc.detectors.levels.detector import LevelChannel, LevelDetector
from daqsvc.diagnosis.detector import Window
from drivers.base import BusPort, StreamSpec
from drivers.can.adapter import batch_of
from drivers.can.driver import CanDriver
from drivers.frames import FrameLayout

pytestmark = pytest.mark.integration
FRAMES = 200


def interpreter_events(samples_per_frame: int) -> int:
    """Calls, lines and C calls of bringing 200 frames from CAN messages to the levels of their samples."""
    layout = FrameLayout.plain(
        frame_id=1,
        length=64,
        channels=[("a", 16, "signed", 1.0, 0.0)],
        samples_per_frame=samples_per_frame,
        counter_byte=0,
        counter_bits=16,
        first_byte=2,
        crc_byte=62,
    )
    rate_hz = 400.0 * samples_per_frame
    ring = SampleRing("s", ("a",), 100_000)
    port = BusPort(
        "b",
        [StreamSpec("s", layout, rate_hz)],
        SystemClock(),
        ring.write,
    )
    driver = CanDriver(can_bus(interface="virtual", channel="hot-path"), port)
    detector = LevelDetector("m", "s", rate_hz, [LevelChannel("a", 0, "g")], window_s=0.25)
    detector.warm()
    index = samples_per_frame * np.arange(FRAMES, dtype=np.int64)
    samples = np.random.default_rng(0).integers(-9, 9, (FRAMES, samples_per_frame, 1)).astype(float)
    payloads = layout.encode(index, samples)
    messages = [
        can.Message(arbitration_id=1, is_extended_id=False, is_fd=True, data=p.tobytes()) for p in payloads
    ]
    arrival_ns = [2_500_000 * k for k in range(FRAMES)]
    driver._sorter.sort(batch_of(messages, arrival_ns), 0)  # what is compiled or cached once does not count
    events = 0

    def count(*_: object) -> object:
        nonlocal events
        events += 1
        return count

    sys.settrace(count)  # type: ignore[arg-type]
    sys.setprofile(count)  # type: ignore[arg-type]
    try:
        driver.accept(driver._sorter.sort(batch_of(messages, arrival_ns), 0))
        for assembler in driver._assemblers.values():
            assembler.flush()
        got = ring.read(0, FRAMES * samples_per_frame)
        detector.process(Window(0, got, 0, 1e9 / rate_hz))
    finally:
        sys.settrace(None)
        sys.setprofile(None)
    assert np.array_equal(got.ravel(), samples.ravel())
    return events


def test_thirty_samples_a_frame_cost_the_interpreter_what_one_does() -> None:
    interpreter_events(1)  # what is done once in a process does not count
    one, thirty = interpreter_events(1), interpreter_events(30)
    assert thirty == pytest.approx(one, rel=0.02), (
        f"{one} events for {FRAMES} samples, {thirty} for 30 times as many"
    )
