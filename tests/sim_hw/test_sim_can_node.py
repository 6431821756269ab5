"""A simulated CAN device whose bus is lost, or is shared with a babbling node."""

from __future__ import annotations

import asyncio
import errno
import threading

import can
import numpy as np

from drivers.frames import FrameLayout
from sim_hw.link_faults import FaultCounts
from sim_hw.node_faults import Babble, FaultWindow, NodeFaults
from sim_hw.nodes.can_node import CanNode

LAYOUT = FrameLayout.plain(
    frame_id=0x101,
    length=64,
    channels=[("x", 16, "signed", 0.01, 0.0)],
    samples_per_frame=10,
    counter_byte=0,
    counter_bits=16,
    first_byte=2,
    crc_byte=62,
)
PATIENCE_S = 60.0
SAMPLES = np.random.default_rng(7).normal(0, 50, (2000, 1))


class Wire:
    """Stands in for the buses of one interface, which fails from one frame to another."""

    channel_info = "a wire in a test"

    def __init__(self, down=range(0)):
        self.down = down
        self.may_open = threading.Event()
        self.may_open.set()
        self.offered = 0
        self.sent = []
        self.opened = self.closed = self.absences = 0

    def open(self):
        assert self.may_open.wait(PATIENCE_S)
        if self.absences:
            self.absences -= 1
            raise can.CanInitializationError("no such device")
        self.opened += 1
        return self

    def send(self, message, timeout=None):
        self.offered += 1
        if self.offered - 1 in self.down:
            raise can.CanOperationError("Network is down", errno.ENETDOWN)
        self.sent.append(message)

    def shutdown(self):
        self.closed += 1


class AtOnce:
    async def wait_until(self, t_ns):
        await asyncio.sleep(0)


class BackAt(AtOnce):
    """The bus may be opened again when it is time for a frame, and is open before that is sent."""

    def __init__(self, wire, frame):
        self.wire, self.frame = wire, frame

    async def wait_until(self, t_ns):
        await asyncio.sleep(0)
        if t_ns >= round((10 * self.frame + 9) / 640.0 * 1e9) and not self.wire.may_open.is_set():
            self.wire.may_open.set()
            async with asyncio.timeout(PATIENCE_S):
                while self.wire.closed < 1:
                    await asyncio.sleep(0.001)
                await asyncio.sleep(0.05)


async def test_frames_are_lost_and_counted_while_the_bus_is() -> None:
    """However long it takes to open the bus again: nothing of that time is sent later."""
    wire = Wire(down=[50])
    node = CanNode(wire.open(), LAYOUT, SAMPLES, 640.0, reopen=wire.open)
    wire.may_open.clear()
    wire.absences = 2
    await node.play(BackAt(wire, 120))
    assert (node.frames_unsent, node.frames_sent, node.samples_sent) == (70, 130, 2000)
    counters = LAYOUT.decode(np.array([list(m.data) for m in wire.sent], np.uint8)).counter
    assert (counters // 10).tolist() == [*range(50), *range(120, 200)]
    node.close()
    assert wire.opened == wire.closed == 2


async def test_a_bus_that_opens_after_its_node_has_left_is_shut_down() -> None:
    wire = Wire(down=[50])
    node = CanNode(wire.open(), LAYOUT, SAMPLES, 640.0, reopen=wire.open)
    wire.may_open.clear()
    await node.play(AtOnce())
    assert node.frames_unsent == 150
    node.close()
    wire.may_open.set()
    async with asyncio.timeout(PATIENCE_S):
        while wire.closed < 2:
            await asyncio.sleep(0.001)
    assert wire.opened == 2


async def test_a_babbling_node_s_frames_lie_between_the_device_s_own() -> None:
    wire = Wire()
    faults = NodeFaults(babble=[Babble(FaultWindow(0.5, 1.0), 100.0, 0x7)])
    node = CanNode(wire.open(), LAYOUT, SAMPLES, 640.0, faults=faults)
    await node.play(AtOnce())
    ids = [message.arbitration_id for message in wire.sent]
    assert ids.count(0x7) == 50
    assert ids.count(0x101) == 200
    first, last = ids.index(0x7), len(ids) - 1 - ids[::-1].index(0x7)
    # 32 of the device's 64 frames a second pass in that half of a second.
    assert ids[first:last].count(0x101) in {31, 32}
    assert node.injected == FaultCounts(frames_in=200, babbled=50)
    assert node.frames_sent == 200
