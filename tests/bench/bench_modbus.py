"""How often a Modbus unit is polled in a second: the driver, against a bare loop of pymodbus.

Run by ``make bench``. The unit answers in a process of its own, over TCP on this machine, at once: what a
poll takes is what the clients make of it. They take many short turns, so that both find the machine equally
busy, and each turn of the driver is compared with those of the bare loop before and after it. The driver is
asked for more samples a second than the bare loop has just polled: the work must limit it, and not its
schedule, which makes up for no moment in which the machine was busy elsewhere.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import asyncio
import contextlib
import statistics
import subprocess
import sys
import time
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from pymodbus.client import AsyncModbusTcpClient
from support.bus_tables import modbus_bus
from support.modbus_layouts import register, registers_layout
from targets import Targets

from daqsvc.acquisition.clock import SystemClock
from drivers.base import BusPort, StreamSpec
from drivers.modbus.driver import ModbusDriver
from sim_hw.nodes.modbus_node import ModbusTcpServer
from sim_hw.nodes.modbus_unit import ModbusUnit

if TYPE_CHECKING:
    from daqsvc.acquisition.samples import SampleBlock

UNIT = 1
CHANNELS = 8
ROUNDS = 40
ROUND_S = 0.2
WARM_UP_S = 0.05
ASKED_FOR = 1.5
LAYOUT = registers_layout(
    UNIT, "input", [register(f"c{k}", k, "int16", scale=0.001) for k in range(CHANNELS)]
)


class Polls(NamedTuple):
    """Polls in a second, and what one takes of a CPU."""

    per_s: float
    cpu_us: float


async def serve() -> None:
    """The other process: answer until standard input is closed."""
    unit = ModbusUnit()
    unit.map("input", 0, CHANNELS)
    server = ModbusTcpServer({UNIT: unit})
    await server.start()
    print(server.port, flush=True)
    await asyncio.to_thread(sys.stdin.read)
    server.stop()


async def bare(port: int) -> Polls:
    """pymodbus alone: ask, and take the registers as it has decoded them."""
    client = AsyncModbusTcpClient("127.0.0.1", port=port)
    await client.connect()
    polls, cpu, begun = 0, 0.0, 0.0
    for duration_s in (WARM_UP_S, ROUND_S):
        polls, cpu, begun = 0, time.process_time(), time.perf_counter()
        while time.perf_counter() - begun < duration_s:
            reply = await client.read_input_registers(0, count=CHANNELS, device_id=UNIT)
            polls += len(reply.registers) == CHANNELS
    elapsed = time.perf_counter() - begun
    found = Polls(polls / elapsed, 1e6 * (time.process_time() - cpu) / polls)
    client.close()
    await asyncio.sleep(0)
    return found


async def ours(port: int, rate_hz: float) -> Polls:
    """The driver: ask, judge, decode to physical units, put on a time base, deliver blocks."""
    samples = 0

    def deliver(block: SampleBlock) -> None:
        nonlocal samples
        samples += len(block.samples)

    bus = modbus_bus(transport="tcp", host="127.0.0.1", tcp_port=port)
    driver = ModbusDriver(bus, BusPort("mb", [StreamSpec("s", LAYOUT, rate_hz)], SystemClock(), deliver))
    task = asyncio.create_task(driver.run())
    while not samples:
        await asyncio.sleep(0.001)
    await asyncio.sleep(WARM_UP_S)
    polls, cpu, begun = driver.counters.replies, time.process_time(), time.perf_counter()
    await asyncio.sleep(ROUND_S)
    polls, elapsed = driver.counters.replies - polls, time.perf_counter() - begun
    found = Polls(polls / elapsed, 1e6 * (time.process_time() - cpu) / polls)
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    return found


def alternate(port: int) -> tuple[list[Polls], list[Polls]]:
    """Turns of the bare loop, and turns of the driver between them."""
    theirs, mine = [asyncio.run(bare(port))], []
    for _ in range(ROUNDS):
        mine.append(asyncio.run(ours(port, ASKED_FOR * theirs[-1].per_s)))
        theirs.append(asyncio.run(bare(port)))
    return theirs, mine


def typical(turns: list[Polls]) -> Polls:
    """The median of each figure."""
    return Polls(*(statistics.median(column) for column in zip(*turns, strict=True)))


def main() -> int:
    """Measure and print."""
    targets = Targets()
    with subprocess.Popen(
        [sys.executable, __file__, "--serve"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as server:
        assert server.stdin is not None
        assert server.stdout is not None
        port = int(server.stdout.readline())
        theirs, mine = alternate(port)
        server.stdin.close()
    around = [(before.per_s + after.per_s) / 2.0 for before, after in pairwise(theirs)]
    ratio = statistics.median(turn.per_s / polled for turn, polled in zip(mine, around, strict=True))
    print(f"Modbus TCP, {CHANNELS} registers a poll, on this machine:")
    for who, turns in (("pymodbus alone", theirs), ("to blocks", mine)):
        usual = typical(turns)
        print(f"  {who:14s}  {usual.per_s:7.0f} polls/s, {usual.cpu_us:5.0f} us of CPU each")
    targets.ask("0.9 of the polls of a bare loop", f"{ratio:.2f}", ratio / 0.9)
    return targets.exit_code


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        asyncio.run(serve())
    else:
        sys.exit(main())
