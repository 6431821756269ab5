"""How fast bytes of a serial port become samples, against pyserial reading the same bytes and dropping them.

Run by ``make bench``. A process of its own writes frames into a pseudo-terminal, first at the pace of the
fastest UARTs (12 Mbaud), then as fast as it takes them: that is memory speed, a hundred times faster than any
UART, and shows what checking and decoding costs. The readers take turns on the same bytes, so that their
ratios hold on any machine, however busy; of the turns the median counts.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import serial
from support.bus_tables import line_layout, serial_bus
from targets import Targets

from daqsvc.acquisition.clock import SystemClock
from drivers.base import BusPort, StreamSpec
from drivers.frames import FrameLayout
from drivers.serial.binary import DELIMITER
from drivers.serial.driver import SerialDriver, framing_of
from sim_hw.nodes.serial_node import PseudoTerminal

if TYPE_CHECKING:
    from daqsvc.acquisition.samples import SampleBlock

PER_FRAME = 500
FRAMES = 40_000
LINES = 400_000
SYNC = b"\xa5\x5a\x0f"
ROUNDS = 7
RATE_HZ = 1e6
CHUNK = 4096
UART_BYTES_PER_S = 12e6 / 10
"""8 bits, a start bit and a stop bit to a character."""


class Cost(NamedTuple):
    """What reading took."""

    wall_s: float
    cpu_s: float


class Case(NamedTuple):
    """One framing, and what a device sends in it.

    Attributes:
        name: in words.
        options: of the bus.
        layout: of its stream.
        data: the bytes.
        samples: how many samples of each channel they hold.
    """

    name: str
    options: dict[str, Any]
    layout: Any
    data: bytes
    samples: int


def frames(name: str, **options: str) -> Case:
    """500 samples of one channel, a counter and a CRC in each frame."""
    layout = FrameLayout.plain(
        frame_id=0,
        length=4 + 2 * PER_FRAME,
        channels=[("a", 16, "signed", 0.001, 0.0)],
        samples_per_frame=PER_FRAME,
        counter_byte=0,
        counter_bits=32,
        first_byte=4,
    )
    index = PER_FRAME * np.arange(FRAMES, dtype=np.int64)
    samples = np.random.default_rng(0).normal(size=(FRAMES, PER_FRAME, 1))
    framing = framing_of(serial_bus(port="/dev/null", **options), [StreamSpec("a", layout, RATE_HZ)])
    data = b"".join(framing.encode("a", index, samples))
    return Case(name, options, layout, data, FRAMES * PER_FRAME)


def lines(name: str, **options: str) -> Case:
    """A counter, three numbers of six decimals and a CRC in each line."""
    axes = ("x", "y", "z")
    layout = line_layout(("seq", *axes), axes, counter="seq")
    samples = np.random.default_rng(0).normal(size=(LINES, 1, 3))
    framing = framing_of(serial_bus(port="/dev/null", **options), [StreamSpec("a", layout, RATE_HZ)])
    data = b"".join(framing.encode("a", np.arange(LINES), samples))
    return Case(name, options, layout, data, LINES)


def write(fd: int, data: bytes, bytes_per_s: float) -> int:
    """Write everything from a process of its own, at most so fast, and exit; returns its id."""
    child = os.fork()
    if child:
        return child
    os.set_blocking(fd, True)
    begun, at = time.monotonic(), 0
    with memoryview(data) as rest:
        while at < len(rest):
            at += os.write(fd, rest[at : at + CHUNK])
            if (early_s := begun + at / bytes_per_s - time.monotonic()) > 0:
                time.sleep(early_s)
    os._exit(0)


def bare(cable: PseudoTerminal, data: bytes, bytes_per_s: float = math.inf) -> Cost:
    """Read everything with pyserial alone."""
    left = len(data)
    with serial.Serial(str(cable.path), 3_000_000, timeout=1) as port:
        begun, cpu = time.perf_counter(), time.process_time()
        child = write(cable.fd, data, bytes_per_s)
        while left:
            left -= len(port.read(min(4096, left)))
        cost = Cost(time.perf_counter() - begun, time.process_time() - cpu)
    os.waitpid(child, 0)
    return cost


def by_frame(cable: PseudoTerminal, data: bytes) -> Cost:
    """Read frame by frame, as pyserial offers it, and decode nothing."""
    left = len(data)
    with serial.Serial(str(cable.path), 3_000_000, timeout=1) as port:
        begun, cpu = time.perf_counter(), time.process_time()
        child = write(cable.fd, data, math.inf)
        while left:
            left -= len(port.read_until(DELIMITER))
        cost = Cost(time.perf_counter() - begun, time.process_time() - cpu)
    os.waitpid(child, 0)
    return cost


async def ours(cable: PseudoTerminal, case: Case, bytes_per_s: float = math.inf) -> Cost:
    """Read everything with the driver, until it is delivered as samples."""
    delivered = 0
    done = asyncio.Event()

    def deliver(block: SampleBlock) -> None:
        nonlocal delivered
        delivered += len(block.samples)
        if delivered == case.samples:
            done.set()

    bus = serial_bus(port=str(cable.path), **{"baud": 3_000_000, **case.options})
    spec = StreamSpec("a", case.layout, RATE_HZ)
    driver = SerialDriver(bus, BusPort("ser0", [spec], SystemClock(), deliver))
    task = asyncio.create_task(driver.run())
    while driver.link.state != "up":
        await asyncio.sleep(0.001)
    begun, cpu = time.perf_counter(), time.process_time()
    child = write(cable.fd, case.data, bytes_per_s)
    async with asyncio.timeout(60):
        await done.wait()
    cost = Cost(time.perf_counter() - begun, time.process_time() - cpu)
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    await asyncio.to_thread(os.waitpid, child, 0)
    return cost


def paced(cable: PseudoTerminal, case: Case, targets: Targets) -> None:
    """Measure at the pace of the fastest UARTs."""
    data = case.data[: case.data.index(DELIMITER, 2 * int(UART_BYTES_PER_S)) + 1]
    few = case._replace(data=data, samples=PER_FRAME * data.count(DELIMITER))
    alone = bare(cable, few.data, UART_BYTES_PER_S)
    whole = asyncio.run(ours(cable, few, UART_BYTES_PER_S))
    ratio, share = alone.wall_s / whole.wall_s, 100 * whole.cpu_s / whole.wall_s
    print(f"  at 12 Mbaud, pyserial alone   {rate(few.data, alone):6.2f} MB/s")
    print(f"  at 12 Mbaud, to blocks        {rate(few.data, whole):6.2f} MB/s, ", end="")
    print(f"ratio {ratio:.2f}, {share:.0f} % of a core")
    targets.ask("0.8 of pyserial alone at 12 Mbaud", f"{ratio:.2f}", ratio / 0.8)


def unpaced(cable: PseudoTerminal, cases: list[Case]) -> None:
    """Measure at memory speed, all framings in turn."""
    turns = [[(bare(cable, c.data), asyncio.run(ours(cable, c))) for c in cases] for _ in range(ROUNDS)]
    for case, costs in zip(cases, zip(*turns, strict=True), strict=True):
        ratio = statistics.median(alone.wall_s / whole.wall_s for alone, whole in costs)
        cpu = statistics.median(alone.cpu_s / whole.cpu_s for alone, whole in costs)
        speeds = [statistics.median(rate(case.data, turn[k]) for turn in costs) for k in (0, 1)]
        print(f"  unpaced, {case.name:<10} pyserial alone {speeds[0]:6.1f} MB/s, ", end="")
        print(f"to blocks {speeds[1]:6.1f} MB/s, ratio {ratio:.2f}, of CPU time {cpu:.2f}")


def main() -> int:
    """Measure and print."""
    targets = Targets()
    cobs = frames("COBS", framing="cobs")
    cases = [cobs, frames("sync word", framing="sync", sync_word=SYNC.hex())]
    cases.append(lines("lines", framing="lines", checksum="crc16"))
    print(f"serial, frames of {PER_FRAME} samples and a CRC, lines of 3 numbers and a CRC:")
    some = cobs.data[: cobs.data.index(DELIMITER, 100_000) + 1]
    with tempfile.TemporaryDirectory() as folder, PseudoTerminal(Path(folder) / "port") as cable:
        paced(cable, cobs, targets)
        print(f"  unpaced, pyserial by frame    {rate(some, by_frame(cable, some)):6.2f} MB/s")
        unpaced(cable, cases)
    return targets.exit_code


def rate(data: bytes, cost: Cost) -> float:
    """MB/s."""
    return len(data) / cost.wall_s / 1e6


if __name__ == "__main__":
    sys.exit(main())
