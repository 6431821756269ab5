"""How fast bytes of a serial port become samples, against pyserial reading the same bytes and dropping them.

Run by ``make bench``. A process of its own writes frames into a pseudo-terminal, first at the pace of the
fastest UARTs (12 Mbaud), then as fast as it takes them: that is memory speed, a hundred times faster than any
UART, and shows what decoding costs. The readers take turns on the same bytes, so that their ratios hold on
any machine, however busy.
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
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import serial
from targets import Targets

from daqsvc.acquisition.clock import SystemClock
from drivers.base import BusPort, StreamSpec
from drivers.frames import FrameLayout
from drivers.serial_binary import BodyCodec, CobsFraming
from drivers.serial_port import SerialDriver
from sim_hw.nodes.pseudo_terminal import PseudoTerminal

if TYPE_CHECKING:
    from daqsvc.acquisition.samples import SampleBlock

PER_FRAME = 500
FRAMES = 20_000
ROUNDS = 5
RATE_HZ = 1e6
CHUNK = 4096
UART_BYTES_PER_S = 12e6 / 10
"""8 bits, a start bit and a stop bit to a character."""


class Cost(NamedTuple):
    """What reading took."""

    wall_s: float
    cpu_s: float


def layout() -> FrameLayout:
    """500 samples of one channel and a counter."""
    return FrameLayout.plain(
        frame_id=0,
        length=4 + 2 * PER_FRAME,
        channels=[("a", 16, "signed", 0.001, 0.0)],
        samples_per_frame=PER_FRAME,
        counter_byte=0,
        counter_bits=32,
        first_byte=4,
    )


def stream() -> bytes:
    """What a device sends."""
    index = PER_FRAME * np.arange(FRAMES, dtype=np.int64)
    samples = np.random.default_rng(0).normal(size=(FRAMES, PER_FRAME, 1))
    return b"".join(CobsFraming(BodyCodec({"a": layout()})).encode("a", index, samples))


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
            time.sleep(max(begun + at / bytes_per_s - time.monotonic(), 0.0))
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
            left -= len(port.read_until(b"\0"))
        cost = Cost(time.perf_counter() - begun, time.process_time() - cpu)
    os.waitpid(child, 0)
    return cost


async def ours(cable: PseudoTerminal, data: bytes, bytes_per_s: float = math.inf) -> Cost:
    """Read everything with the driver, until it is delivered as samples."""
    expected = PER_FRAME * data.count(b"\0")
    delivered = 0
    done = asyncio.Event()

    def deliver(block: SampleBlock) -> None:
        nonlocal delivered
        delivered += len(block.samples)
        if delivered == expected:
            done.set()

    options = {"port": str(cable.path), "baud": 3_000_000, "framing": "cobs"}
    spec = StreamSpec("a", layout(), RATE_HZ)
    driver = SerialDriver(BusPort("ser0", options, [spec], SystemClock(), deliver))
    task = asyncio.create_task(driver.run())
    while driver.link.state != "up":
        await asyncio.sleep(0.001)
    begun, cpu = time.perf_counter(), time.process_time()
    child = write(cable.fd, data, bytes_per_s)
    async with asyncio.timeout(60):
        await done.wait()
    cost = Cost(time.perf_counter() - begun, time.process_time() - cpu)
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    await asyncio.to_thread(os.waitpid, child, 0)
    return cost


def main() -> int:
    """Measure and print."""
    targets = Targets()
    data = stream()
    frame = len(data) // FRAMES
    few = data[: data.index(b"\0", 2 * int(UART_BYTES_PER_S)) + 1]
    some = data[: data.index(b"\0", 100_000) + 1]
    with tempfile.TemporaryDirectory() as folder, PseudoTerminal(Path(folder) / "port") as cable:
        paced = bare(cable, few, UART_BYTES_PER_S), asyncio.run(ours(cable, few, UART_BYTES_PER_S))
        slow = by_frame(cable, some)
        rounds = [(bare(cable, data), asyncio.run(ours(cable, data))) for _ in range(ROUNDS)]
    print(f"serial, COBS frames of {frame} bytes, {PER_FRAME} samples and a CRC each:")
    paced_ratio, share = paced[0].wall_s / paced[1].wall_s, 100 * paced[1].cpu_s / paced[1].wall_s
    print(f"  at 12 Mbaud, pyserial alone   {rate(few, paced[0]):6.2f} MB/s")
    print(
        f"  at 12 Mbaud, to blocks        {rate(few, paced[1]):6.2f} MB/s, ratio {paced_ratio:.2f}, ",
        end="",
    )
    print(f"{share:.0f} % of a core")
    beside = statistics.median(b.wall_s / o.wall_s for b, o in rounds)
    cpu = statistics.median(b.cpu_s / o.cpu_s for b, o in rounds)
    print(f"  unpaced, pyserial by frame    {rate(some, slow):6.2f} MB/s")
    print(f"  unpaced, pyserial alone       {max(rate(data, cost) for cost, _ in rounds):6.1f} MB/s")
    print(
        f"  unpaced, to blocks            {max(rate(data, cost) for _, cost in rounds):6.1f} MB/s, ", end=""
    )
    print(f"ratio {beside:.2f}, of CPU time {cpu:.2f}")
    targets.ask("0.8 of pyserial alone at 12 Mbaud", f"{paced_ratio:.2f}", paced_ratio / 0.8)
    return targets.exit_code


def rate(data: bytes, cost: Cost) -> float:
    """MB/s."""
    return len(data) / cost.wall_s / 1e6


if __name__ == "__main__":
    sys.exit(main())
