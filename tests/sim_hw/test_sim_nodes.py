from __future__ import annotations

import asyncio
import math
import struct
import uuid

import can
import numpy as np
import pytest
from support.modbus_layouts import register, registers_layout

from daqsvc.acquisition.clock import DrivenClock
from drivers.frames import FrameLayout
from sim_hw.link_faults import Fault, FaultCounts, LinkFaults
from sim_hw.nodes.can_node import CanNode, quantised, to_frames
from sim_hw.nodes.modbus_node import ModbusNode
from sim_hw.nodes.modbus_unit import ModbusUnit
from sim_hw.nodes.pacing import SHORTEST_SLEEP_NS, DrivenPacer, RealTimePacer

MS = 1_000_000
LAYOUT = FrameLayout.plain(
    frame_id=0x101,
    length=64,
    channels=[("x", 16, "signed", 0.01, 0.0), ("y", 16, "signed", 0.02, 1.0)],
    samples_per_frame=10,
    counter_byte=0,
    counter_bits=16,
    first_byte=2,
    crc_byte=62,
)
CLASSIC = FrameLayout.plain(
    frame_id=0x1ABCDEF,
    extended=True,
    length=8,
    channels=[("x", 16, "signed", 0.01, 0.0)],
    samples_per_frame=3,
    counter_byte=0,
    counter_bits=8,
    counts="frames",
    first_byte=2,
)
SAMPLES = np.random.default_rng(11).normal(0, 50, (2007, 2))


class RecordingBus:
    """Stands in for a bus of python-can: keeps what is sent, and when, on a clock."""

    channel_info = "a bus in a test"

    def __init__(self, clock=None, refusals=0):
        self.clock = clock
        self.refusals = refusals
        self.sent = []

    def send(self, message, timeout=None):
        assert timeout == 0, "a send that waits would block the event loop"
        if self.refusals:
            self.refusals -= 1
            raise can.CanOperationError("Failed to transmit: No buffer space available", 105)
        self.sent.append((self.clock.monotonic_ns() if self.clock else 0, message))


class AtOnce:
    async def wait_until(self, t_ns):
        await asyncio.sleep(0)


class HandClock:
    """A real clock moved by whoever sleeps on it."""

    def __init__(self, overslept_ns=0):
        self.now_ns = 5_000
        self.overslept_ns = overslept_ns
        self.sleeps = []

    def monotonic_ns(self):
        return self.now_ns

    def wall_ns(self):
        return 0

    async def sleep_ns(self, duration_ns):
        self.sleeps.append(duration_ns)
        if duration_ns > 0:
            self.now_ns += duration_ns + self.overslept_ns
        await asyncio.sleep(0)


def decoded(bus, layout):
    payloads = np.array([list(message.data) for _, message in bus.sent], np.uint8)
    return layout.decode(payloads)


async def test_samples_arrive_as_the_wire_resolves_them():
    clock = DrivenClock()
    bus = RecordingBus(clock)
    node = CanNode(bus, LAYOUT, SAMPLES, 640.0, first_index=65_530)
    await node.play(DrivenPacer(clock, lambda: 0, 0))
    frames = decoded(bus, LAYOUT)
    assert frames.intact.all()
    assert np.array_equal(frames.counter, (65_530 + 10 * np.arange(200)) % 65_536)
    received = frames.samples.reshape(-1, 2)
    assert np.array_equal(received, quantised(SAMPLES, LAYOUT))
    assert np.abs(received - SAMPLES[:2000]).max() <= 0.0101
    assert (node.frames_sent, node.samples_sent, node.send_retries) == (200, 2000, 0)
    assert node.injected == FaultCounts(frames_in=200)


async def test_frames_leave_when_their_last_sample_is_taken():
    clock = DrivenClock(start_ns=77)
    bus = RecordingBus(clock)
    node = CanNode(bus, LAYOUT, SAMPLES, 640.0)
    await node.play(DrivenPacer(clock, lambda: 0, 0))
    expected = 77 + np.rint((np.arange(200) * 10 + 9) / 640.0 * 1e9)
    assert np.array_equal([t_ns for t_ns, _ in bus.sent], expected)
    assert node.duration_ns == expected[-1] - 77


async def test_messages_are_what_the_layout_says():
    fd, classic = RecordingBus(), RecordingBus()
    await CanNode(fd, LAYOUT, SAMPLES[:10], 1.0).play(AtOnce())
    await CanNode(classic, CLASSIC, SAMPLES[:3, :1], 1.0).play(AtOnce())
    ((_, long),), ((_, short),) = fd.sent, classic.sent
    assert (long.arbitration_id, long.is_extended_id, long.is_fd, long.bitrate_switch) == (
        0x101,
        False,
        True,
        True,
    )
    assert (short.arbitration_id, short.is_extended_id, short.is_fd) == (0x1ABCDEF, True, False)
    assert (long.dlc, short.dlc) == (64, 8)


async def test_faults_are_really_done_to_the_frames():
    faults = LinkFaults(drop=0.1, duplicate=0.1, reorder=0.1, corrupt=0.1, seed=3, reorder_within_ns=40 * MS)
    bus = RecordingBus()
    node = CanNode(bus, LAYOUT, np.tile(SAMPLES, (5, 1)), 640.0, faults=faults)
    await node.play(AtOnce())
    counts = node.injected
    assert min(counts.dropped, counts.duplicated, counts.reordered, counts.corrupted) > 30
    frames = decoded(bus, LAYOUT)
    assert len(bus.sent) == node.frames_sent == counts.frames_in - counts.dropped + counts.duplicated
    assert np.count_nonzero(~frames.intact) == counts.corrupted
    seen = frames.counter[frames.intact] // 10
    assert len(np.unique(seen)) == counts.frames_in - counts.lost
    assert len(seen) - len(np.unique(seen)) == counts.duplicated
    assert np.count_nonzero(seen < np.maximum.accumulate(seen)) == counts.reordered
    assert node.samples_sent == 10 * counts.frames_in


async def test_counts_stop_where_the_playing_stops():
    faults = LinkFaults(drop=0.5, seed=1)
    clock = DrivenClock()
    bus = RecordingBus(clock)
    node = CanNode(bus, LAYOUT, SAMPLES, 640.0, faults=faults)
    assert node.injected == FaultCounts()
    stop_at = clock.monotonic_ns() + 1_000 * MS
    playing = asyncio.create_task(
        node.play(DrivenPacer(clock, lambda: 1 if clock.monotonic_ns() >= stop_at else 0, 0))
    )
    while clock.monotonic_ns() < stop_at:
        await asyncio.sleep(0)
    playing.cancel()
    with pytest.raises(asyncio.CancelledError):
        await playing
    planned = faults.plan(to_frames(SAMPLES, LAYOUT, 640.0).t_ns, 64)
    done = planned.fault[planned.t_ns <= 1_000 * MS]
    assert node.injected == FaultCounts(len(done), int(np.count_nonzero(done == Fault.DROPPED)))
    assert len(bus.sent) == node.frames_sent == np.count_nonzero(done != Fault.DROPPED)


async def test_a_full_queue_is_offered_the_frame_again():
    bus = RecordingBus(refusals=4)
    node = CanNode(bus, LAYOUT, SAMPLES, 640.0)
    await node.play(AtOnce())
    assert node.send_retries == 4
    assert np.array_equal(decoded(bus, LAYOUT).samples.reshape(-1, 2), quantised(SAMPLES, LAYOUT))


async def test_a_bus_that_takes_nothing_is_given_up():
    node = CanNode(RecordingBus(refusals=10**9), LAYOUT, SAMPLES, 640.0, give_up_s=0.01)
    with pytest.raises(TimeoutError, match=r"a bus in a test has refused frame 0x101.*No buffer space"):
        await node.play(AtOnce())
    assert node.samples_sent == 0


async def test_virtual_bus_carries_every_frame():
    channel = uuid.uuid4().hex
    with (
        can.Bus(interface="virtual", channel=channel) as device,
        can.Bus(interface="virtual", channel=channel) as listener,
    ):
        await CanNode(device, LAYOUT, SAMPLES, 640.0).play(AtOnce())
        received = [listener.recv(0) for _ in range(200)]
        assert listener.recv(0) is None
    payloads = np.array([list(message.data) for message in received], np.uint8)
    assert np.array_equal(LAYOUT.decode(payloads).samples.reshape(-1, 2), quantised(SAMPLES, LAYOUT))


@pytest.mark.parametrize(
    ("samples", "rate_hz", "message"),
    [
        (SAMPLES[:, :1], 1.0, r"samples are \[2007, 1\].*\[n, 2\].*x, y"),
        (SAMPLES[:9], 1.0, "9 samples do not fill one frame 0x101 of 10"),
        (SAMPLES, 0.0, "rate_hz is 0.0"),
        (SAMPLES * 1000, 1.0, "'[xy]': .* does not fit"),
    ],
)
def test_samples_that_do_not_suit_the_layout_are_refused(samples, rate_hz, message):
    with pytest.raises(ValueError, match=message):
        to_frames(samples, LAYOUT, rate_hz)


def test_clipping_saturates_like_an_input():
    clipped = quantised(np.full((10, 2), 1e6), LAYOUT, clip=True)
    assert np.allclose(clipped, [327.67, 1 + 0.02 * 32767])


async def test_the_clock_stands_still_while_the_receiver_is_behind():
    clock, backlog, readings = DrivenClock(start_ns=0), [0], []

    async def receiver():
        for _ in range(5):
            await asyncio.sleep(0.003)
            readings.append(clock.monotonic_ns())
        backlog[0] = 2

    backlog[0] = 3
    reading = asyncio.create_task(receiver())
    await DrivenPacer(clock, lambda: backlog[0], 2).wait_until(10 * MS)
    await reading
    assert readings == [0] * 5
    assert clock.monotonic_ns() == 10 * MS


async def test_time_passes_in_steps_that_others_can_follow():
    clock, seen = DrivenClock(start_ns=0), []

    async def follower():
        while True:
            await clock.sleep_ns(1)
            seen.append(clock.monotonic_ns())

    following = asyncio.create_task(follower())
    await asyncio.sleep(0)
    await DrivenPacer(clock, lambda: 0, 0).wait_until(11 * MS)
    following.cancel()
    assert max(np.diff([0, *seen, 11 * MS])) <= 2 * MS


async def test_two_devices_share_a_pacer_and_each_wakes_at_its_own_time():
    clock = DrivenClock(start_ns=0)
    pacer = DrivenPacer(clock, lambda: 0, 0)
    woken = []

    async def device(name, times_us):
        for t_us in times_us:
            await pacer.wait_until(t_us * 1000)
            woken.append((clock.monotonic_ns() // 1000, t_us, name))

    await asyncio.gather(device("a", range(0, 40_000, 1_700)), device("b", range(50, 40_000, 4_100)))
    assert all(now_us == t_us for now_us, t_us, _ in woken)
    assert len(woken) == 24 + 10


@pytest.mark.parametrize("overslept_ns", [0, 3 * MS])
async def test_speed_is_a_limit(overslept_ns):
    clock, real = DrivenClock(start_ns=0), HandClock(overslept_ns)
    pacer = DrivenPacer(clock, lambda: 0, 0, speed=20.0, real=real)
    start_ns = real.now_ns
    for t_ms in range(3, 900, 3):
        await pacer.wait_until(t_ms * MS)
        assert clock.monotonic_ns() == t_ms * MS
        elapsed_ns = real.now_ns - start_ns
        assert elapsed_ns * 20 >= t_ms * MS - 20 - 20 * SHORTEST_SLEEP_NS
        # Sleeping too long once does not slow down what follows.
        assert elapsed_ns <= t_ms * MS / 20 + MS + overslept_ns


async def test_time_held_for_the_receiver_is_not_caught_up():
    clock, real = DrivenClock(start_ns=0), HandClock()
    pacer = DrivenPacer(clock, lambda: int(5_000 + 3 * MS < real.now_ns < 400 * MS), 0, speed=2.0, real=real)
    await pacer.wait_until(10 * MS)
    held_until_ns = real.now_ns
    assert held_until_ns >= 400 * MS
    before_ms = clock.monotonic_ns()
    await pacer.wait_until(50 * MS)
    assert real.now_ns - held_until_ns >= (50 * MS - before_ms) / 2 - 1000


async def test_a_receiver_that_stopped_is_an_error():
    real = HandClock()
    pacer = DrivenPacer(DrivenClock(), lambda: 9, 4, stall_s=2.0, real=real)
    with pytest.raises(TimeoutError, match=r"9 behind \(limit 4\) for 2 s"):
        await pacer.wait_until(MS)


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan])
def test_speed_must_be_positive(speed):
    with pytest.raises(ValueError, match="speed is"):
        DrivenPacer(DrivenClock(), lambda: 0, 0, speed=speed)


async def test_real_time_deadlines_do_not_drift():
    clock = HandClock(overslept_ns=700_000)
    pacer = RealTimePacer(clock)
    await pacer.wait_until(0)
    start_ns = clock.now_ns
    for i in range(1, 1000):
        await pacer.wait_until(i * 2 * MS)
        assert 0 <= clock.now_ns - start_ns - i * 2 * MS <= 700_000
    # Late by much: what is due goes out at once, and no more than that.
    clock.now_ns += 10 * MS
    before_ns = clock.now_ns
    for i in range(1000, 1005):
        await pacer.wait_until(i * 2 * MS)
    assert clock.now_ns == before_ns
    await pacer.wait_until(1010 * 2 * MS)
    assert clock.now_ns >= start_ns + 1010 * 2 * MS


def test_registers_that_a_modbus_unit_does_not_have_are_refused_as_devices_do() -> None:
    unit = ModbusUnit()
    layout = registers_layout(1, "holding", [register("x", 10, "int16", scale=0.1)])
    ModbusNode(unit, layout, np.array([[4.2], [5.0]]), 1.0)
    read = lambda address, count: unit.answer(struct.pack(">BHH", 3, address, count))  # noqa: E731
    # It has measured before it is asked for the first time.
    assert read(10, 1) == struct.pack(">BBH", 3, 2, 42)
    for address, count in [(9, 1), (9, 2), (10, 2), (500, 125), (65_535, 2)]:
        assert read(address, count) == bytes([0x83, 2])
    assert unit.answer(struct.pack(">BHHBH", 16, 500, 1, 2, 7)) == bytes([0x90, 2])
    assert unit.answer(struct.pack(">BHH", 4, 10, 1)) == bytes([0x84, 2])
