"""How late the event loop is while a device does its worst: counters that stand still or leap, and floods.

Run by ``make bench``. Another process sends CAN frames over a local socket, or bytes over a pseudo-terminal,
through the whole driver into a ring; a second, healthy CAN bus at 1 kHz runs beside it and must lose nothing.
Each load lasts some seconds; memory is looked at before and after. What the other end has taken is counted,
and a load of which less than half was reached is a target missed.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import asyncio
import contextlib
import os
import pty
import resource
import select
import socket
import subprocess
import sys
import time
import tty
from typing import Any, NamedTuple

import numpy as np
from support import bus_tables
from support.can_standin import frame_bytes
from targets import Targets

from daqsvc.acquisition.clock import SystemClock
from daqsvc.acquisition.ring import SampleRing
from drivers.base import BusPort, StreamSpec
from drivers.can.driver import CanDriver
from drivers.can.socketcan import SocketCan
from drivers.frames import FrameLayout
from drivers.serial.driver import SerialDriver

LOAD_S = 4.0
TICK_S = 0.005
LATE_MS = 20.0
GROWTH_MB = 24.0
REACHED = 0.5
"""Least share of a load that must have been driven."""
PATIENCE_S = 2.0
"""How much longer than `LOAD_S` a sender may take on a busy machine."""
SEND_BUFFER_BYTES = 8 << 20
"""Room for frames while the reader gathers, as much as `drivers.socketcan` asks of the kernel."""
SO_SNDBUFFORCE = 32
"""linux/socket.h; beyond the limit of the system, which `SO_SNDBUF` keeps to."""
RATE_HZ = 1000.0
LAYOUT = FrameLayout.plain(
    frame_id=0x101,
    length=8,
    channels=[("x", 16, "signed", 0.001, 0.0)],
    samples_per_frame=1,
    counter_byte=0,
    counter_bits=32,
    first_byte=4,
)
LINES = bus_tables.line_layout(("seq", "x"), ("x",), counter="seq")


class Load(NamedTuple):
    """What a device sends: frames a second, and how it counts."""

    bus: str
    counter: str
    frames_per_s: float


LOADS = [
    Load("can", "sound", 1000),
    Load("can", "still", 1000),
    Load("can", "random", 1000),
    Load("can", "random", 4000),
    Load("can", "random", 8000),
    Load("can", "corrupt", 1000),
    Load("can", "sound", 10_000),
    Load("can", "sound", 100_000),
    Load("lines", "still", 1000),
    Load("lines", "random", 4000),
    Load("lines", "sound", 10_000),
    Load("lines", "sound", 100_000),
]


def counters(load: Load, first: int, n: int, rng: np.random.Generator) -> np.ndarray:
    """The next counters of a device."""
    sound = (first + np.arange(n)) % 2**32
    if load.counter == "still":
        return np.full(n, 77)
    if load.counter == "random":
        return rng.integers(0, 2**32, n)
    if load.counter == "corrupt":
        return np.where(rng.random(n) < 0.2, rng.integers(0, 2**32, n), sound)
    return sound


def encoded(load: Load, counts: list[int]) -> list[bytes]:
    """What is written for these counters: a CAN frame at a time, or all lines together."""
    if load.bus == "can":
        return [frame_bytes(0x101, count.to_bytes(4, "little") + bytes(4)) for count in counts]
    return [b"".join(b"%d,0.5\n" % count for count in counts)]


def put(fd: int, data: bytes, until_s: float) -> bool:
    """Have the other end take all of it; whether it did in time."""
    room = select.poll()
    room.register(fd, select.POLLOUT)
    while data:
        try:
            data = data[os.write(fd, data) :]
        except BlockingIOError:
            if time.monotonic() > until_s:
                return False
            room.poll(10)
    return True


def send(load: Load, fd: int) -> tuple[int, float]:
    """Send at real time for `LOAD_S`, or as fast as the other end takes it.

    Returns:
        How many frames or lines the other end has taken, and in what time, in s.
    """
    rng = np.random.default_rng(1)
    os.set_blocking(fd, False)
    sent, total = 0, round(LOAD_S * load.frames_per_s)
    begun_s = time.monotonic()
    until_s = begun_s + LOAD_S + PATIENCE_S
    is_taken = True
    while is_taken and sent < total and time.monotonic() < until_s:
        due = min(round((time.monotonic() - begun_s) * load.frames_per_s), total)
        counts = counters(load, sent, due - sent, rng).tolist()
        pieces = encoded(load, counts)
        for data in pieces:
            is_taken = put(fd, data, until_s)
            if not is_taken:
                break
            sent += len(counts) // len(pieces)
        time.sleep(0.001)
    return sent, max(time.monotonic() - begun_s, LOAD_S)


def can_bus(name: str) -> tuple[CanDriver, int, list[socket.socket]]:
    """A CAN bus, and the file descriptor to send on."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
    with contextlib.suppress(PermissionError):
        ours.setsockopt(socket.SOL_SOCKET, SO_SNDBUFFORCE, SEND_BUFFER_BYTES)
    ring = SampleRing("s", ("x",), 100_000)
    port = BusPort(name, [StreamSpec("s", LAYOUT, RATE_HZ)], SystemClock(), ring.write)
    table = bus_tables.can_bus(interface="socketcan", channel=name)
    driver = CanDriver(table, port, open_source=lambda _port, _sorter: SocketCan(theirs, port.clock))
    return driver, ours.fileno(), [ours]


def serial_port() -> tuple[SerialDriver, int, list[Any]]:
    """A serial port, and the file descriptor to send on."""
    ours, theirs = pty.openpty()
    tty.setraw(ours)
    ring = SampleRing("s", ("x",), 100_000)
    table = bus_tables.serial_bus(port=os.ttyname(theirs), framing="lines")
    port = BusPort("tty", [StreamSpec("s", LINES, RATE_HZ)], SystemClock(), ring.write)
    return SerialDriver(table, port), ours, [ours, theirs]


async def lateness(late_ms: list[float]) -> None:
    """How late a timer of 5 ms is, until cancelled."""
    loop = asyncio.get_running_loop()
    while True:
        due = loop.time() + TICK_S
        await asyncio.sleep(TICK_S)
        late_ms.append(1000.0 * (loop.time() - due))


def sender(load: Load, fd: int) -> subprocess.Popen[bytes]:
    """A process that sends."""
    words = [sys.executable, __file__, "--send", *map(str, load), str(fd)]
    return subprocess.Popen(words, pass_fds=[fd], stdout=subprocess.PIPE)


class Measured(NamedTuple):
    """What a load has done.

    Attributes:
        driven_per_s: frames a second that the driver's end has taken.
        p99_ms: 99th percentile of the lateness of the event loop.
        growth_mb: of the process's memory.
        lost: samples of the healthy bus.
        said: of the hostile stream.
    """

    driven_per_s: float
    p99_ms: float
    growth_mb: float
    lost: int
    said: str


async def under(load: Load) -> Measured:
    """Have a device do its worst for a while."""
    hostile: CanDriver | SerialDriver
    ends: list[Any]
    hostile, fd, ends = can_bus("hostile") if load.bus == "can" else serial_port()
    healthy, healthy_fd, more_ends = can_bus("healthy")
    late_ms: list[float] = []
    running = [asyncio.create_task(driver.run()) for driver in (hostile, healthy)]
    while any(driver.link.state != "up" for driver in (hostile, healthy)):
        await asyncio.sleep(0.01)
    await asyncio.sleep(0.5)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    senders = [sender(load, fd), sender(Load("can", "sound", RATE_HZ), healthy_fd)]
    while not hostile.streams["s"][0].frames_received:
        await asyncio.sleep(0.01)
    watching = asyncio.create_task(lateness(late_ms))
    while any(process.poll() is None for process in senders):
        await asyncio.sleep(0.1)
    watching.cancel()
    (driven, took_s), (healthy_sent, _) = (map(float, p.communicate()[0].split()) for p in senders)
    growth = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    await asyncio.sleep(0.2)
    for task in running:
        task.cancel()
    await asyncio.gather(*running, watching, return_exceptions=True)
    counted = healthy.streams["s"][0]
    lost = round(healthy_sent) - counted.samples_received
    for end in ends + more_ends:
        os.close(end) if isinstance(end, int) else end.close()
    said = hostile.streams["s"][1].doubt or "fine"
    return Measured(driven / took_s, float(np.percentile(late_ms, 99)), growth, lost, said)


def main() -> int:
    """Measure and print; the first load is a healthy device, which says how busy the machine is by itself."""
    targets = Targets()
    for load in LOADS:
        found = asyncio.run(under(load))
        reached = found.driven_per_s / load.frames_per_s
        name = f"{load.bus}, {load.counter} counter, {load.frames_per_s:g}/s"
        driven = f"{found.driven_per_s:.0f}/s{'' if reached >= REACHED else ' (not reached)'}"
        print(
            f"{name:32} driven {driven}, p99 {found.p99_ms:.1f} ms, memory +{found.growth_mb:.1f} MB,"
            f" healthy bus lost {found.lost}; {found.said}"
        )
        targets.ask(f"{name}: at least {REACHED:.0%} of it driven", driven, reached / REACHED)
        targets.ask(
            f"{name}: at most {LATE_MS:g} ms late, p99", f"{found.p99_ms:.1f} ms", LATE_MS / found.p99_ms
        )
        targets.ask(
            f"{name}: memory flat", f"{found.growth_mb:.1f} MB", GROWTH_MB / max(found.growth_mb, 1.0)
        )
        targets.ask(
            f"{name}: no sample of the healthy bus lost", f"{found.lost} lost", 0.0 if found.lost else 1.0
        )
    return targets.exit_code


if __name__ == "__main__":
    if sys.argv[1:2] == ["--send"]:
        bus, counter, rate, fd_ = sys.argv[2:]
        print(*send(Load(bus, counter, float(rate)), int(fd_)))
    else:
        sys.exit(main())
