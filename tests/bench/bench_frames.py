"""How fast frames become samples: our batches against python-can's Notifier with a decode per frame.

Run by ``make bench``. All figures are CPU time of one process in one run, so that their ratios hold on any
machine, however busy.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import asyncio
import struct
import time

import can
import numpy as np
from support.bus_tables import can_bus

from daqsvc.acquisition.clock import SystemClock
from daqsvc.acquisition.ring import SampleRing
from drivers.base import BusPort, StreamSpec
from drivers.can.driver import CanDriver
from drivers.frames import FrameLayout

FRAMES = 20_000
PER_FRAME = 30
UNPACK = struct.Struct("<H30h")


def layout() -> FrameLayout:
    """30 samples of one channel, a counter and a CRC in 64 bytes."""
    return FrameLayout.plain(
        frame_id=0x201,
        length=64,
        channels=[("a", 16, "signed", 0.001, 0.0)],
        samples_per_frame=PER_FRAME,
        counter_byte=0,
        counter_bits=16,
        first_byte=2,
        crc_byte=62,
    )


def messages() -> list[can.Message]:
    """What a device sends."""
    index = PER_FRAME * np.arange(FRAMES, dtype=np.int64)
    samples = np.random.default_rng(0).normal(size=(FRAMES, PER_FRAME, 1))
    payloads = layout().encode(index, samples)
    return [
        can.Message(arbitration_id=0x201, is_extended_id=False, is_fd=True, data=p.tobytes())
        for p in payloads
    ]


def decode_alone(sent: list[can.Message]) -> tuple[float, float]:
    """CPU microseconds per frame: decoded as one batch, and one by one with struct."""
    payloads = np.frombuffer(b"".join(m.data for m in sent), np.uint8).reshape(FRAMES, 64)
    begun = time.process_time()
    layout().decode(payloads)
    batch = time.process_time() - begun
    begun = time.process_time()
    for message in sent:
        _, *raw = UNPACK.unpack_from(message.data)
        [0.001 * value for value in raw]
    return 1e6 * batch / FRAMES, 1e6 * (time.process_time() - begun) / FRAMES


async def with_driver(sent: list[can.Message]) -> float:
    """CPU microseconds per frame, sending included, from the bus into the ring."""
    ring = SampleRing("s", ("a",), 100_000)
    port = BusPort("b", [StreamSpec("s", layout(), 12_000.0)], SystemClock(), ring.write)
    driver = CanDriver(can_bus(interface="virtual", channel="bench-driver", fd=True), port)
    running = asyncio.create_task(driver.run())
    while driver.link.state != "up":
        await asyncio.sleep(0.01)
    begun = time.process_time()
    with can.Bus(interface="virtual", channel="bench-driver", protocol=can.CanProtocol.CAN_FD) as bus:
        await asyncio.to_thread(send, bus, sent)
        while driver.streams["s"][0].samples_received < FRAMES * PER_FRAME:
            await asyncio.sleep(0.005)
    spent = time.process_time() - begun
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    return 1e6 * spent / FRAMES


async def with_notifier(sent: list[can.Message]) -> float:
    """The same with python-can's Notifier on the event loop and a decode per frame."""
    received = 0
    done = asyncio.Event()

    def take(message: can.Message) -> None:
        nonlocal received
        _, *raw = UNPACK.unpack_from(message.data)
        [0.001 * value for value in raw]
        received += 1
        if received == FRAMES:
            done.set()

    options = {"interface": "virtual", "channel": "bench-notifier", "protocol": can.CanProtocol.CAN_FD}
    with can.Bus(**options) as receiver, can.Bus(**options) as bus:
        notifier = can.Notifier(receiver, [take], loop=asyncio.get_running_loop())
        begun = time.process_time()
        await asyncio.to_thread(send, bus, sent)
        await done.wait()
        spent = time.process_time() - begun
        await asyncio.to_thread(notifier.stop)
    return 1e6 * spent / FRAMES


def send(bus: can.BusABC, sent: list[can.Message]) -> None:
    """Put everything on the bus."""
    for message in sent:
        bus.send(message)


def main() -> None:
    """Measure and print."""
    sent = messages()
    begun = time.process_time()
    with can.Bus(interface="virtual", channel="bench-send", protocol=can.CanProtocol.CAN_FD) as bus:
        send(bus, sent)
    sending = 1e6 * (time.process_time() - begun) / FRAMES
    batch, one_by_one = decode_alone(sent)
    print(f"decode, batch   {batch:6.2f} us per frame of {PER_FRAME} samples, CRC checked")
    print(f"decode, struct  {one_by_one:6.2f} us per frame, unchecked, {one_by_one / batch:.1f} times that")
    ours = asyncio.run(with_driver(sent)) - sending
    theirs = asyncio.run(with_notifier(sent)) - sending
    print(f"bus to ring     {ours:6.2f} us per frame: python-can's recv, CRC, time base, order, loss, ring")
    print(
        f"Notifier        {theirs:6.2f} us per frame: recv and unpack alone, {theirs / ours:.1f} times ours"
    )


if __name__ == "__main__":
    main()
