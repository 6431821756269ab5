"""How fast CAN frames are received: our SocketCAN reader, python-can's Notifier, and a bare socket.

Run by ``make bench``. The frames lie ready in a local socket that carries the bytes of SocketCAN, so that it
runs on a kernel without CAN, too. The ratios are of CPU time in one process and one run, and hold on any
machine, however busy. At the end another process sends to the whole driver at real time: 50,000 frames a
second for 30 s, 8 channels of 12.8 kS/s in CAN FD frames, and 10,000 frames a second that are recorded.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import asyncio
import math
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import can
import cantools
import numpy as np
from can.interfaces.socketcan.socketcan import SocketcanBus
from support.bus_tables import can_bus
from support.can_standin import frames_bytes
from targets import Targets

from daqsvc.acquisition.clock import SystemClock
from daqsvc.acquisition.ring import SampleRing
from drivers.base import BusPort, StreamSpec
from drivers.can.batches import LONGEST, CanBatch, FrameDemultiplexer
from drivers.can.driver import CanDriver
from drivers.can.record_files import ENDINGS, LogFile, encoder_for
from drivers.can.socketcan import SO_TIMESTAMPNS, SocketCan
from drivers.frames import FrameLayout

if TYPE_CHECKING:
    from collections.abc import Callable

    from drivers.can.record_files import LogFormat

IDS = tuple(range(0x100, 0x108))
FRAMES = 16_384
ROUNDS = 5
PER_FRAME = 3
RATE_FRAMES = 50_000
RATE_S = 30.0
VIBRATION_CHANNELS = 8
VIBRATION_HZ = 12_800.0
VIBRATION_S = 10.0
RECORDED_FRAMES = 10_000
"""A second: more than a CAN bus of 1 Mbit/s carries."""
RECORDED_S = 5.0
RECORDED_BATCH = 512
SEND_BUFFER_BYTES = 64 << 20
_SO_SNDBUFFORCE = 32

DBC = 'VERSION ""\nBU_: N\n' + "".join(
    f"BO_ {frame_id} M{frame_id:x}: 8 N\n"
    ' SG_ Count : 0|16@1+ (1,0) [0|65535] "" N\n'
    + "".join(f' SG_ X{k} : {16 * (k + 1)}|16@1- (0.001,0) [-33|33] "g" N\n' for k in range(PER_FRAME))
    for frame_id in IDS
)


def layout(frame_id: int) -> FrameLayout:
    """A counter and three samples in eight bytes: what the DBC file says, too."""
    return FrameLayout.plain(
        frame_id=frame_id,
        length=8,
        channels=[("x", 16, "signed", 0.001, 0.0)],
        samples_per_frame=PER_FRAME,
        counter_byte=0,
        counter_bits=16,
        first_byte=2,
    )


def vibration_layout() -> FrameLayout:
    """A counter and three samples of eight channels in 64 bytes of CAN FD."""
    return FrameLayout.plain(
        frame_id=IDS[0],
        length=64,
        channels=[(f"c{k}", 16, "signed", 0.001, 0.0) for k in range(VIBRATION_CHANNELS)],
        samples_per_frame=PER_FRAME,
        counter_byte=0,
        counter_bits=16,
        first_byte=2,
    )


class Load(NamedTuple):
    """What another process sends at real time."""

    layout: FrameLayout
    frames_per_s: float
    duration_s: float

    @property
    def frames(self) -> int:
        """All of them."""
        return round(self.frames_per_s * self.duration_s)


LOADS = {
    "flood": Load(layout(IDS[0]), RATE_FRAMES, RATE_S),
    "vibration": Load(vibration_layout(), VIBRATION_HZ / PER_FRAME, VIBRATION_S),
    "recorded": Load(layout(IDS[0]), RECORDED_FRAMES, RECORDED_S),
}


def frames() -> list[bytes]:
    """What eight devices send, frame by frame in turn."""
    n = FRAMES // len(IDS)
    samples = np.random.default_rng(0).normal(size=(n, PER_FRAME, 1))
    index = PER_FRAME * np.arange(n, dtype=np.int64)
    each = [frames_bytes(i, layout(i).encode(index, samples)) for i in IDS]
    return [frame for turn in zip(*each, strict=True) for frame in turn]


def full_socket(sent: list[bytes]) -> socket.socket:
    """A socket that all of the frames lie in."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        ours.setsockopt(socket.SOL_SOCKET, _SO_SNDBUFFORCE, SEND_BUFFER_BYTES)
    except PermissionError:
        sys.exit("bench_can: the socket cannot hold the frames; run it as root")
    theirs.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    for frame in sent:
        ours.send(frame)
    theirs.setblocking(False)
    ours.detach()  # left open until the process ends: a closed end would be an end of file
    return theirs


SORTER = FrameDemultiplexer([StreamSpec(f"{i:x}", layout(i), 1000.0) for i in IDS])
DATABASE = cantools.database.load_string(DBC, "dbc")
"""The first round compiles what either of them compiles; the median leaves that out."""


def with_reader(sock: socket.socket) -> int:
    """Receive, sort to eight streams and decode with our reader."""
    source = SocketCan(sock, SystemClock())
    received = 0
    while received < FRAMES:
        found = SORTER.sort(source.read(0.0), source.error_classes)
        received += sum(len(part.samples) for part in found.frames.values())
    return received


def with_notifier(sock: socket.socket) -> int:
    """Receive with python-can's Notifier on an event loop, decode with cantools."""
    bus = SocketcanBus.__new__(SocketcanBus)  # around our socket, as its own constructor leaves it
    bus.socket, bus.channel, bus._bcm_sockets, bus._filters = sock, "bench", {}, None
    bus._is_filtered, bus._periodic_tasks, bus._is_shutdown = True, [], True

    async def receive() -> int:
        received = 0
        done = asyncio.Event()

        def take(message: can.Message) -> None:
            nonlocal received
            DATABASE.decode_message(message.arbitration_id, message.data)
            received += 1
            if received == FRAMES:
                done.set()

        notifier = can.Notifier(bus, [take], loop=asyncio.get_running_loop())
        await done.wait()
        notifier.stop()
        return received

    return asyncio.run(receive())


def with_bare_socket(sock: socket.socket) -> int:
    """Receive into one buffer, decode nothing."""
    room = bytearray(72)
    received = 0
    while received < FRAMES:
        sock.recv_into(room)
        received += 1
    return received


def cost_us(receive: Callable[[socket.socket], int], sent: list[bytes]) -> float:
    """CPU microseconds per frame, the median of a few rounds."""
    costs = []
    for _ in range(ROUNDS):
        with full_socket(sent) as sock:
            begun = time.process_time()
            received = receive(sock)
            costs.append(1e6 * (time.process_time() - begun) / received)
    return statistics.median(costs)


def send_at_rate(load: Load, descriptor: int) -> None:
    """The other process: send at the rate, and say how many frames the socket did not take."""
    refused = 0
    with socket.socket(fileno=descriptor) as sock:
        sock.setblocking(False)
        n = load.frames
        payloads = np.zeros((n, load.layout.length), np.uint8)
        payloads[:, :2] = (PER_FRAME * np.arange(n)).astype(np.uint16)[:, None].view(np.uint8)
        sent = frames_bytes(IDS[0], payloads)
        begun = time.monotonic()
        done = 0
        while done < n:
            due = min(n, int((time.monotonic() - begun) * load.frames_per_s))
            for frame in sent[done:due]:
                try:
                    sock.send(frame)
                except BlockingIOError:
                    refused += 1
            done = due
            time.sleep(0.001)
    print(refused)


def recording_us(log_format: LogFormat, folder: Path) -> float:
    """CPU microseconds per frame of 8 bytes that it takes to record, the median of a few rounds."""
    rng = np.random.default_rng(0)
    frames = CanBatch(
        np.full(RECORDED_BATCH, IDS[0], np.uint32),
        np.full(RECORDED_BATCH, 8, np.int64),
        rng.integers(0, 256, (RECORDED_BATCH, LONGEST)).astype(np.uint8),
        np.arange(RECORDED_BATCH) * 100_000,
    )
    costs = []
    for round_ in range(ROUNDS):
        log = LogFile(folder / f"{log_format}-{round_}", encoder_for(log_format, "can0"), time.time_ns())
        begun = time.process_time()
        for _ in range(FRAMES // RECORDED_BATCH):
            log.add(frames.kept())
            log.flush()
        costs.append(1e6 * (time.process_time() - begun) / FRAMES)
        log.close()
    return statistics.median(costs)


async def at_rate(name: str, record: dict[str, Any] | None = None) -> tuple[int, int, float]:
    """Frames received and lost, and the CPU share of one core, of a load through the driver into a ring.

    Frames that were to be recorded and are not count as lost.
    """
    load = LOADS[name]
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setsockopt(socket.SOL_SOCKET, _SO_SNDBUFFORCE, SEND_BUFFER_BYTES)
    rate_hz = load.frames_per_s * PER_FRAME
    ring = SampleRing("s", load.layout.channels, 1_000_000)
    port = BusPort(
        "b",
        [StreamSpec("s", load.layout, rate_hz)],
        SystemClock(),
        ring.write,
    )
    bus = can_bus(interface="socketcan", channel="stand-in", record=record)
    driver = CanDriver(bus, port, open_source=lambda _port, _sorter: SocketCan(theirs, port.clock))
    running = asyncio.create_task(driver.run())
    while driver.link.state != "up":
        await asyncio.sleep(0.01)
    sender = subprocess.Popen(  # noqa: ASYNC220 - returns at once
        [sys.executable, __file__, "--send", name, str(ours.fileno())],
        pass_fds=[ours.fileno()],
        stdout=subprocess.PIPE,
        text=True,
    )
    counters = driver.streams["s"][0]
    wanted = load.frames
    while not counters.frames_received:
        await asyncio.sleep(0.01)
    begun, begun_at = time.process_time(), time.monotonic()
    while sender.poll() is None:
        await asyncio.sleep(0.2)
    share = (time.process_time() - begun) / (time.monotonic() - begun_at)
    output, _ = sender.communicate()
    refused = int(output)
    while counters.frames_received < wanted - refused:
        await asyncio.sleep(0.05)
    ours.close()
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    lost = refused + counters.samples_lost // PER_FRAME
    if record is not None:
        lost += wanted - driver.counters.frames_recorded
    return counters.samples_received // PER_FRAME, lost, share


def main() -> int:
    """Measure and print."""
    targets = Targets()
    sent = frames()
    ours, theirs, bare = (cost_us(way, sent) for way in (with_reader, with_notifier, with_bare_socket))
    print(
        f"SocketCAN reader  {ours:6.2f} us of CPU per frame: received, time-stamped, sorted by 8 ids, decoded"
    )
    print(f"Notifier+cantools {theirs:6.2f} us per frame on the same frames: {theirs / ours:.1f} times that")
    print(
        f"bare recv_into    {bare:6.2f} us per frame, decoding nothing: ours has {bare / ours:.2f} its speed"
    )
    received, lost, share = asyncio.run(at_rate("flood"))
    print(
        f"{RATE_FRAMES} frames/s     {received} received and {lost} lost in {RATE_S:.0f} s, through driver "
        f"and time base into the ring, at {100 * share:.0f} % of one core"
    )
    _, also_lost, share = asyncio.run(at_rate("vibration"))
    print(
        f"{VIBRATION_CHANNELS} x {VIBRATION_HZ / 1e3:g} kS/s    over CAN FD at real time into the ring: "
        f"{100 * share:.0f} % of one core, {also_lost} frames lost in {VIBRATION_S:.0f} s"
    )
    with tempfile.TemporaryDirectory() as folder:
        costs = {log_format: recording_us(log_format, Path(folder)) for log_format in ENDINGS}
        record = {"folder": folder, "format": "blf", "file_mb": 1, "keep_mb": 2}
        _, unrecorded, recorded_share = asyncio.run(at_rate("recorded", record))
    _, _, plain_share = asyncio.run(at_rate("recorded"))
    print(
        "recording         "
        + ", ".join(f"{cost:.1f} us as {log_format}" for log_format, cost in costs.items())
        + " of CPU per frame of 8 bytes, in a thread of its own"
    )
    print(
        f"{RECORDED_FRAMES} frames/s     recorded as blf: {100 * recorded_share:.0f} % of one core, "
        f"not recorded: {100 * plain_share:.0f} %; {unrecorded} frames missing in {RECORDED_S:.0f} s"
    )
    targets.ask("10 times Notifier and cantools", f"{theirs / ours:.1f} times", theirs / ours / 10.0)
    targets.ask("0.8 of a bare recv_into", f"{bare / ours:.2f}", bare / ours / 0.8)
    lost += also_lost + unrecorded
    targets.ask("no frame lost", f"{lost} lost", math.inf if lost == 0 else 0.0)
    return targets.exit_code


if __name__ == "__main__":
    if sys.argv[1:2] == ["--send"]:
        send_at_rate(LOADS[sys.argv[2]], int(sys.argv[3]))
    else:
        sys.exit(main())
