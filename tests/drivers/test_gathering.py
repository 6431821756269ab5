"""What comes is gathered, so that a second of a stream costs few turns; a flood is read at once."""

from __future__ import annotations

import asyncio
import math
import os
import pty
import socket
import threading
import time
import tty
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.bus_tables import can_bus, line_layout, serial_bus
from support.can_standin import StandInBus, frame_bytes
from support.running_drivers import running
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from drivers.base import BusPort, StreamSpec
from drivers.can.driver import CanDriver
from drivers.can.socketcan import GATHER_S, UNSTAMPED_GATHER_S, DatagramBuffer, SocketCan, Stamps
from drivers.frames import FrameLayout
from drivers.serial.driver import SerialDriver

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from daqsvc.acquisition.samples import SampleBlock

RATE_HZ = 500.0
STREAM_S = 0.5
TURNS_PER_S = 10.0


class Waits(threading.Event):
    """Notes how long it is waited for, and takes no time over it."""

    def __init__(self) -> None:
        super().__init__()
        self.asked_s: list[float] = []

    def wait(self, timeout: float | None = None) -> bool:
        self.asked_s.append(math.inf if timeout is None else timeout)
        time.sleep(0.0)
        return False


@pytest.fixture
def wire() -> Iterator[Callable[[int], tuple[Callable[[], object], SocketCan]]]:
    """Sockets whose receive buffer is the reader's own, as that of a CAN socket is."""
    opened: list[Any] = []

    def make(receive_buffer_bytes: int) -> tuple[Callable[[], object], SocketCan]:
        sender, receiver = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        receiver.bind(("127.0.0.1", 0))
        sender.connect(receiver.getsockname())
        source = SocketCan(receiver, SystemClock(), receive_buffer_bytes=receive_buffer_bytes)
        opened.extend([sender, source])
        return lambda: sender.send(frame_bytes(0x101, bytes(8))), source

    yield make
    for one in opened:
        one.close()


def test_frames_gather_as_long_as_the_buffer_is_sure_to_hold_them(
    wire: Callable[[int], tuple[Callable[[], object], SocketCan]],
) -> None:
    send, source = wire(4 << 20)
    send()
    assert len(source.read(10.0).ids) == 1
    waits = Waits()
    source.gather(waits)
    assert UNSTAMPED_GATHER_S < waits.asked_s[0] <= GATHER_S, "one wait, as the buffer holds a second of them"

    send, source = wire(64 << 10)
    send()
    assert len(source.read(10.0).ids) == 1
    waits = Waits()
    source.gather(waits)
    assert len(waits.asked_s) > 1, "it is looked after in between"
    assert max(waits.asked_s) < 0.01


def test_a_flood_is_read_when_half_of_the_buffer_is_full(
    wire: Callable[[int], tuple[Callable[[], object], SocketCan]],
) -> None:
    send, source = wire(64 << 10)
    send()
    assert len(source.read(10.0).ids) == 1
    for _ in range(120):
        send()
    waits = Waits()
    source.gather(waits)
    assert len(waits.asked_s) == 1, "there is more than half of the buffer to read"
    assert len(source.read(10.0).ids) == 120, "and nothing of it is lost"


def test_frames_that_the_kernel_does_not_stamp_are_read_as_they_come(
    wire: Callable[[int], tuple[Callable[[], object], SocketCan]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def unstamped(self: DatagramBuffer) -> Stamps:
        none = np.zeros(self._used, np.int64)
        return Stamps(none, none, None)

    send, source = wire(4 << 20)
    monkeypatch.setattr(DatagramBuffer, "stamps", unstamped)
    send()
    assert len(source.read(10.0).ids) == 1
    waits = Waits()
    source.gather(waits)
    assert max(waits.asked_s) <= UNSTAMPED_GATHER_S


@pytest.mark.integration
async def test_a_second_of_can_frames_costs_few_turns() -> None:
    layout = FrameLayout.plain(
        frame_id=0x101,
        length=4,
        channels=[("x", 16, "signed", 1.0, 0.0)],
        samples_per_frame=1,
        counter_byte=0,
        counter_bits=16,
        first_byte=2,
    )
    bus = StandInBus()
    blocks: list[SampleBlock] = []
    port = BusPort("can0", [StreamSpec("s", layout, RATE_HZ)], SystemClock(), blocks.append)
    driver = CanDriver(can_bus(interface="socketcan", channel="can7"), port, open_source=bus.open)
    frames = round(RATE_HZ * STREAM_S)
    async with running(driver):
        begun_s, turns = time.monotonic(), driver.link.turns
        for k in range(frames):
            payload = layout.encode(np.array([k]), np.zeros((1, 1, 1)))[0]
            assert bus.send([frame_bytes(0x101, payload.tobytes())]) == 1
            await asyncio.sleep(1.0 / RATE_HZ)
        await eventually(lambda: driver.streams["s"][0].frames_received == frames)
        turns, lasted_s = driver.link.turns - turns, time.monotonic() - begun_s
    bus.close()
    assert driver.streams["s"][0].samples_lost == 0
    # However slow the host is: each turn but the first takes the time in which frames gather.
    assert turns <= TURNS_PER_S * lasted_s + 2
    assert len(blocks) <= turns


@pytest.mark.integration
async def test_a_second_of_lines_costs_few_turns() -> None:
    master, slave = pty.openpty()
    tty.setraw(slave)
    blocks: list[SampleBlock] = []
    spec = StreamSpec("s", line_layout(("seq", "x"), ("x",), counter="seq"), RATE_HZ)
    bus = serial_bus(port=os.ttyname(slave), framing="lines")
    driver: Any = SerialDriver(bus, BusPort("ser0", [spec], SystemClock(), blocks.append))
    lines = round(RATE_HZ * STREAM_S)
    async with running(driver):
        begun_s, turns = time.monotonic(), driver.link.turns
        for k in range(lines):
            os.write(master, b"%d,1.0\n" % k)
            await asyncio.sleep(1.0 / RATE_HZ)
        # What comes before the first end of a line may be the rest of one.
        await eventually(lambda: driver.streams["s"][0].frames_received >= lines - 1)
        turns, lasted_s = driver.link.turns - turns, time.monotonic() - begun_s
    os.close(master)
    os.close(slave)
    assert driver.streams["s"][0].samples_lost == 0
    assert turns <= TURNS_PER_S * lasted_s + 2
    assert len(blocks) <= turns
