"""A serial port is left alone for moments, so that few wakes take many bytes, where that costs nothing."""

from __future__ import annotations

import asyncio
import os
import pty
import time
import tty
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from support.bus_tables import line_layout, serial_bus
from support.running_drivers import running
from support.waiting import eventually

from daqsvc.acquisition.clock import NS_PER_S, SystemClock
from drivers.base import BusPort, StreamSpec
from drivers.frames import FrameLayout
from drivers.serial import reader
from drivers.serial.driver import SerialDriver, framing_of
from drivers.serial.pauses import LONGEST_S, PAUSE_BYTES, SHORTEST_S, Pauses, longest_pause_s

if TYPE_CHECKING:
    from drivers.serial.framing import Framing

LINE = b"7,1.0,2.0\n"
LINES = StreamSpec("s", line_layout(("seq", "x", "y"), ("x", "y"), counter="seq"), 500.0)


def lines() -> Framing:
    return framing_of(serial_bus(port="/dev/ttyS0", framing="lines"), [LINES])


class Port:
    """A port that is read as its pauses say; chunks come ``every_s``."""

    def __init__(self, framing: Framing, longest_s: float, every_s: float = 0.002) -> None:
        self.pauses = Pauses(framing, longest_s)
        self.every_s = every_s
        self.now_s = 0.0

    def read(self, chunk: bytes) -> float:
        self.now_s += self.every_s
        pause_s = self.pauses.after(chunk, round(self.now_s * NS_PER_S))
        self.now_s += pause_s
        return pause_s

    def gather(self, chunk: bytes, reads: int) -> list[float]:
        self.pauses.listen()
        return [self.read(chunk) for _ in range(reads)]


def test_after_a_frame_has_ended_the_rest_of_the_gathering_is_pauses() -> None:
    port = Port(lines(), LONGEST_S)
    for _ in range(6):
        port.gather(LINE, 3)
    port.pauses.listen()
    assert port.read(LINE[:5]) == 0.0, "no frame has ended under its eyes"
    assert [port.read(LINE[5:]) for _ in range(3)] == [LONGEST_S] * 3


def test_of_frames_without_a_delimiter_as_many_bytes_are_heard_as_the_longest_has() -> None:
    layout = FrameLayout.plain(
        frame_id=0, length=100, channels=[("x", 16, "signed", 1.0, 0.0)], samples_per_frame=48,
        counter_byte=0, counter_bits=32, first_byte=4,
    )  # fmt: skip
    bus = serial_bus(port="/dev/ttyS0", framing="sync", sync_word="a55a")
    port = Port(framing_of(bus, [StreamSpec("s", layout, 1000.0)]), LONGEST_S)
    pauses = port.gather(bytes(16), 8)
    heard = pauses.index(next(filter(None, pauses))) + 1
    assert heard == -(-(2 + 100 + 2) // 16), "sync word, payload and CRC"


def test_what_comes_seldom_is_read_as_it_comes() -> None:
    assert Port(lines(), LONGEST_S, every_s=0.02).gather(LINE, 20) == [0.0] * 20


def test_what_fills_the_port_is_read_at_once() -> None:
    """A pseudo-terminal is faster than its baud says."""
    port = Port(lines(), LONGEST_S)
    for _ in range(6):
        port.gather(LINE, 3)
    flood = LINE * (PAUSE_BYTES // len(LINE) + 1)
    assert port.read(LINE) == LONGEST_S
    assert port.gather(flood, 20) == [0.0] * 20
    port.pauses.listen()
    assert port.read(LINE) == SHORTEST_S, "and it begins again with short pauses"


@pytest.mark.parametrize(
    ("baud", "wraps_s", "longest_s"),
    [
        (115_200, [10.0, 3.0], LONGEST_S),
        (921_600, [10.0], 1024 * 10 / 921_600),
        (115_200, [10.0, 0.256], 0.016),
        (115_200, [10.0, 0.0], 0.0),
    ],
    ids=["usual", "a port that would be full", "a counter that wraps soon", "no counter"],
)
def test_a_pause_is_no_longer_than_port_and_counters_bear(
    baud: int, wraps_s: list[float], longest_s: float
) -> None:
    assert longest_pause_s(10, baud, wraps_s) == longest_s
    if not longest_s:
        assert Port(lines(), longest_s).gather(LINE, 20) == [0.0] * 20


@pytest.mark.parametrize(
    ("layout", "baud", "longest_s"),
    [
        (line_layout(("seq", "x"), ("x",), counter="seq", bits=16), 115_200, LONGEST_S),
        (line_layout(("seq", "x"), ("x",), counter="seq", bits=8), 115_200, 256 / 1000 / 16),
        (line_layout(("t", "x"), ("x",), time="t"), 115_200, 0.0),
        (line_layout(("seq", "x"), ("x",), counter="seq"), 3_000_000, 1024 * 10 / 3_000_000),
    ],
    ids=["16 bits", "8 bits", "stamps, whose rate is told by arrivals", "3 Mbaud"],
)
async def test_the_driver_knows_what_its_streams_bear(
    monkeypatch: pytest.MonkeyPatch, layout: Any, baud: int, longest_s: float
) -> None:
    given: list[float] = []

    def noted(framing: Framing, longest_s: float) -> Pauses:
        given.append(longest_s)
        return Pauses(framing, longest_s)

    monkeypatch.setattr(reader, "Pauses", noted)
    master, slave = pty.openpty()
    bus = serial_bus(port=os.ttyname(slave), framing="lines", baud=baud)
    port = BusPort("ser0", [StreamSpec("s", layout, 1000.0)], SystemClock(), lambda _block: None)
    driver: Any = SerialDriver(bus, port)
    async with running(driver):
        await eventually(lambda: bool(given))
    os.close(master)
    os.close(slave)
    assert given == [longest_s]


@pytest.mark.integration
async def test_lines_that_come_every_few_ms_gather_in_the_port(monkeypatch: pytest.MonkeyPatch) -> None:
    paused_s: list[float] = []

    def sleep(duration_s: float) -> None:
        paused_s.append(duration_s)
        time.sleep(duration_s)

    monkeypatch.setattr(reader, "time", SimpleNamespace(sleep=sleep, monotonic_ns=time.monotonic_ns))
    master, slave = pty.openpty()
    tty.setraw(slave)
    bus = serial_bus(port=os.ttyname(slave), framing="lines")
    driver: Any = SerialDriver(bus, BusPort("ser0", [LINES], SystemClock(), lambda _block: None))
    async with running(driver):
        for k in range(250):
            os.write(master, b"%d,1.0,2.0\n" % k)
            await asyncio.sleep(0.002)
        await eventually(lambda: driver.streams["s"][0].frames_received >= 249)
    os.close(master)
    os.close(slave)
    assert driver.streams["s"][0].samples_lost == 0
    assert paused_s
    assert max(paused_s) <= LONGEST_S
