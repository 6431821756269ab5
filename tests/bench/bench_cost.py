"""What watching a machine costs: CPU seconds of the service for each second of the machine, on a ladder.

Run by ``make bench``. Two machines send in real time from a process of their own: three channels of 3.2 kS/s
over CAN FD, with levels and a rotor bank, and 500 lines of text a second, with levels. Each stands on two
rungs: the driver alone, which receives, times and orders the samples, and the whole service. CPU time counts,
so that the ratio of the rungs holds on any machine, however busy. The least of some rounds is told: what else
the host does only adds to it.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import os
import pty
import re
import socket
import subprocess
import sys
import tempfile
import time
import tty
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from support.can_standin import frames_bytes
from support.machine_files import LAVAL
from support.many_machines import healthy_payloads
from targets import Targets

from daqsvc.acquisition.clock import SystemClock
from daqsvc.box import Box
from daqsvc.service import Service
from daqsvc.settings import parse_machine_file
from drivers.can.driver import CanDriver
from drivers.can.plugin import frame_layout
from drivers.can.socketcan import SocketCan
from drivers.make import bus_drivers

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from daqsvc.settings import MachineFile
    from drivers.base import Driver

ROUNDS = 3
ROUND_S = 4.0
SETTLED_S = 6.0
"""Kernels are there, rate and offset of the device's clock are known, and the bank has found its mode."""
CAN_HZ = 3200.0
LINES_HZ = 500.0
MOST_CAN = 0.04
MOST_LINES = 0.025
"""CPU seconds for a second of the machine, at the most: docs/driver-contract.md has what was measured."""

LINES = """
schema_version = 1
site = "lab"
box = "edge-1"
machine = {{ name = "fan", speed_rpm = 1480.0 }}
pipeline.levels = {{ window_s = 1.0, velocity_band_hz = [10.0, 200.0] }}
store.directory = "{store}"

[buses.casing]
driver = "serial"
port = "{port}"
baud = 115_200
framing = "lines"

[streams.casing]
bus = "casing"
rate_hz = {rate_hz}

[streams.casing.layout]
line = ["seq", "v", "h"]
counter = {{ column = "seq", bits = 16 }}
channels = [{{ name = "v" }}, {{ name = "h" }}]

[[sensors]]
name = "v"
type = "accelerometer"
stream = "casing"
channel = "v"
unit = "g"

[[sensors]]
name = "h"
type = "accelerometer"
stream = "casing"
channel = "h"
unit = "g"
"""


class Wire(NamedTuple):
    """A machine on a wire of its own.

    Attributes:
        machine: its machine file.
        sender: what the other process is called with, to send until it is ended.
        descriptor: the end of the wire that it sends to.
        bring: gives a driver the other end, if its machine file does not name it.
    """

    machine: MachineFile
    sender: str
    descriptor: int
    bring: Callable[[Driver], None]


def rig(store: Path) -> MachineFile:
    """The Laval rig of the examples, faster, and without a broker."""
    text = LAVAL.read_text()
    text = re.sub(r"(?ms)^\[mqtt\].*?(?=^\[store\])", "", text)
    text = text.replace("rate_hz = 640.0", f"rate_hz = {CAN_HZ}").replace("/var/lib/daqsvc", str(store))
    return parse_machine_file(text, store / "rig.toml")


def can_wire(store: Path) -> Wire:
    """Three channels over CAN FD; the socket carries the bytes of SocketCAN."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)

    def bring(driver: Driver) -> None:
        assert isinstance(driver, CanDriver)
        driver._open_source = lambda _port, _sorter: SocketCan(theirs.dup(), SystemClock())

    return Wire(rig(store), "can", ours.detach(), bring)


def line_wire(store: Path) -> Wire:
    """Lines of text over a pseudo-terminal."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    text = LINES.format(store=store, port=os.ttyname(slave), rate_hz=LINES_HZ)
    return Wire(parse_machine_file(text, store / "lines.toml"), "lines", master, lambda _driver: None)


def can_frames() -> list[bytes]:
    """A healthy rotor, over and over."""
    layout = frame_layout(rig(Path(tempfile.gettempdir())), "shaft")
    return frames_bytes(layout.frame_id, healthy_payloads(layout, CAN_HZ))


def line_bytes() -> list[bytes]:
    """A counter and two numbers a line, over all counts."""
    waves = np.random.default_rng(0).normal(size=(2**16, 2))
    return [f"{k},{v:.4f},{h:.4f}\n".encode() for k, (v, h) in enumerate(waves.tolist())]


def send(what: str, descriptor: int) -> None:
    """The other process: send at the rate, over and over, until it is ended."""
    sent, per_s = (can_frames(), CAN_HZ / 10) if what == "can" else (line_bytes(), LINES_HZ)
    begun, k = time.monotonic(), 0
    while True:
        if (early_s := begun + k / per_s - time.monotonic()) > 0.0:
            time.sleep(early_s)
        os.write(descriptor, sent[k % len(sent)])
        k += 1


async def cost_s(wire: Wire) -> float:
    """CPU seconds of this process for a second of the machine, which it watches by now."""
    sender = subprocess.Popen(  # noqa: ASYNC220 - returns at once
        [sys.executable, __file__, "--send", wire.sender, str(wire.descriptor)], pass_fds=[wire.descriptor]
    )
    try:
        await asyncio.sleep(SETTLED_S)
        costs = []
        for _ in range(ROUNDS):
            cpu_s, begun_s = time.process_time(), time.monotonic()
            await asyncio.sleep(ROUND_S)
            costs.append((time.process_time() - cpu_s) / (time.monotonic() - begun_s))
    finally:
        sender.terminate()
        sender.wait()
    return min(costs)


@contextlib.asynccontextmanager
async def alone(wire: Wire) -> AsyncIterator[Driver]:
    """The driver without anybody who reads what it delivers."""
    (driver,) = bus_drivers(wire.machine, SystemClock(), lambda _block: None)
    wire.bring(driver)
    task = asyncio.create_task(driver.run())
    yield driver
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


@contextlib.asynccontextmanager
async def whole(wire: Wire, store: Path) -> AsyncIterator[Driver]:
    """The service."""
    service, stop = Service(Box.single(wire.machine), store), asyncio.Event()
    wire.bring(service.drivers[0])
    task = asyncio.create_task(service.run(stop))
    await service.ready.wait()
    yield service.drivers[0]
    stop.set()
    await task


async def rungs(make: Callable[[Path], Wire], name: str, targets: Targets) -> tuple[float, float]:
    """What the driver alone costs, and what the service does, each in CPU seconds a second."""
    costs = []
    for rung in (alone, whole):
        with tempfile.TemporaryDirectory() as folder:
            store = Path(folder)
            wire = make(store)
            async with alone(wire) if rung is alone else whole(wire, store) as driver:
                costs.append(await cost_s(wire))
                ((counters, _),) = driver.streams.values()
            os.close(wire.descriptor)
        received = counters.samples_received
        lost = counters.samples_lost if received else math.inf
        targets.ask(f"no sample lost, {name}", f"{lost} of {received}", 0.0 if lost else math.inf)
    return costs[0], costs[1]


def main() -> int:
    """Measure and print."""
    targets = Targets()
    logging.disable()  # of a service that waits for its sender
    asked = ((can_wire, "3 x 3.2 kS/s CAN FD", MOST_CAN), (line_wire, "500 lines/s of text", MOST_LINES))
    for make, name, most in asked:
        driver_s, service_s = asyncio.run(rungs(make, name, targets))
        print(
            f"{name:<20} {driver_s:.4f} CPU s for a second of the machine into blocks, {service_s:.4f} "
            f"with everything: {service_s / driver_s:.1f} times that"
        )
        targets.ask(f"at most {most} CPU s a second, {name}", f"{service_s:.4f}", most / service_s)
    return targets.exit_code


if __name__ == "__main__":
    if sys.argv[1:2] == ["--send"]:
        send(sys.argv[2], int(sys.argv[3]))
    else:
        sys.exit(main())
