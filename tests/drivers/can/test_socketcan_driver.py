"""The CAN driver over the SocketCAN reader, on a stand-in socket; on the real thing: tests/hil."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.bus_tables import can_bus
from support.can_standin import StandInBus, frame_bytes
from support.running_drivers import CountingDevice, running
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.notice import NOTICE
from drivers.base import BusPort, StreamSpec
from drivers.can.batches import ERROR
from drivers.can.driver import CanDriver
from drivers.frames import DecodedBatch, FrameLayout

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from daqsvc.acquisition.samples import SampleBlock

pytestmark = pytest.mark.integration
LAYOUT = FrameLayout.plain(
    frame_id=0x101,
    length=8,
    channels=[("x", 16, "signed", 1.0, 0.0)],
    samples_per_frame=3,
    counter_byte=0,
    counter_bits=16,
    first_byte=2,
)


def sample_frame(frame: int) -> bytes:
    payload = LAYOUT.encode(np.array([3 * frame], np.int64), np.full((1, 3, 1), float(frame)))[0]
    return frame_bytes(0x101, payload.tobytes())


def driver_on(bus: StandInBus, blocks: list[SampleBlock]) -> CanDriver:
    port = BusPort("can0", [StreamSpec("s", LAYOUT, 3000.0)], SystemClock(), blocks.append)
    return CanDriver(can_bus(interface="socketcan", channel="can7"), port, open_source=bus.open)


@pytest.fixture
async def bus() -> AsyncIterator[StandInBus]:
    made = StandInBus()
    yield made
    made.close()


async def test_frames_become_blocks_and_strays_are_counted(bus: StandInBus) -> None:
    blocks: list[SampleBlock] = []
    driver = driver_on(bus, blocks)
    async with running(driver):
        bus.send([sample_frame(k) for k in range(50)])
        bus.send([frame_bytes(0x7FF, b""), b"no frame", frame_bytes(0x101, b"short")])
        bus.send([sample_frame(k) for k in range(50, 100)])
        await eventually(lambda: driver.streams["s"][0].frames_received == 100)
    got = np.concatenate([block.samples for block in blocks])[:, 0]
    assert got.tolist() == np.repeat(np.arange(100), 3).tolist()
    assert (driver.counters.frames_unknown, driver.counters.frames_malformed) == (1, 1)
    assert driver.streams["s"][0].frames_wrong_length == 1
    assert driver.streams["s"][0].samples_lost == 0


@pytest.mark.gives("B40")
@pytest.mark.parametrize("restart", [frame_bytes(ERROR | 0x100, bytes(8)), sample_frame(0)])
async def test_bus_off_takes_the_link_down_until_the_controller_is_back(
    bus: StandInBus, restart: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    driver = driver_on(bus, [])
    with caplog.at_level(NOTICE):
        async with running(driver):
            bus.send([frame_bytes(ERROR | 0x204, b"\0\x20\0\0\0\0\x80\x07")] * 2)
            await eventually(lambda: driver.counters.controller_state == "error-passive")
            assert driver.link.state == "up"
            bus.send([frame_bytes(ERROR | 0x40, bytes(8))])
            await eventually(lambda: driver.link.state == "down")
            assert "`ip link set can7 type can restart`" in driver.link.reason
            bus.send([restart])
            await eventually(lambda: driver.link.state == "up")
            assert driver.counters.controller_state == "error-active"
    assert bus.opened == 1, "the socket lives through bus-off"
    assert (driver.counters.bus_off, driver.counters.error_passives, driver.link.losses) == (1, 2, 1)
    said = [record.message for record in caplog.records]
    assert sum("is error-passive" in text for text in said) == 1
    assert sum("is lost" in text for text in said) == 1
    assert sum("is back" in text for text in said) == 1


async def test_bus_off_and_restart_in_one_batch_are_one_loss() -> None:
    driver = driver_on(StandInBus(), [])
    driver.link.up()
    source_errors = np.array([ERROR | 0x40, ERROR | 0x100], np.uint32)
    from drivers.can.errors import ErrorCounts

    driver.accept(DecodedBatch(errors=ErrorCounts.of(source_errors, np.zeros((2, 8), np.uint8))))
    assert (driver.link.state, driver.link.losses) == ("up", 1)


async def test_a_bus_that_is_opened_again_keeps_its_state_until_something_comes(bus: StandInBus) -> None:
    driver, device = driver_on(bus, []), CountingDevice(3, 3000.0)
    passive = frame_bytes(ERROR | 0x4, bytes([0, 0x30, 0, 0, 0, 0, 0, 0]))
    async with running(driver):
        bus.send([sample_frame(device.frame()), passive])
        await eventually(lambda: driver.counters.controller_state == "error-passive")
        bus.unplug()
        await eventually(lambda: driver.link.state == "down")
        bus.plug_in()
        await eventually(lambda: driver.link.state == "up")
        assert driver.counters.controller_state == "error-passive", "an adapter that is silent says nothing"
        bus.send([sample_frame(device.frame())])
        await eventually(lambda: driver.counters.controller_state == "error-active")
        bus.send([passive, sample_frame(device.frame())])
        await eventually(lambda: driver.streams["s"][0].frames_received == 3)
        assert driver.counters.controller_state == "error-passive", "frames alone do not make it active again"


@pytest.mark.gives("B41")
async def test_frames_that_the_kernel_dropped_are_counted_and_said_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    driver = driver_on(StandInBus(), [])
    with caplog.at_level(NOTICE):
        driver.accept(DecodedBatch(notes={"frames_overrun": 3}))
        driver.accept(DecodedBatch(notes={"frames_overrun": 4}))
    assert driver.counters.frames_overrun == 7
    assert [record.message for record in caplog.records if "receive_buffer_bytes" in record.message] == [
        caplog.records[0].message
    ]


async def test_an_adapter_that_is_unplugged_is_opened_again(bus: StandInBus) -> None:
    driver = driver_on(bus, [])
    device = CountingDevice(3000.0, 3)
    async with running(driver):
        bus.send([sample_frame(device.frame())])
        await eventually(lambda: driver.streams["s"][0].frames_received == 1)
        bus.unplug()
        await eventually(lambda: driver.link.state == "down")
        bus.plug_in()
        await eventually(lambda: driver.link.state == "up")
        bus.send([sample_frame(device.frame())])
        await eventually(lambda: driver.streams["s"][0].frames_received == 2)
    counters, _ = driver.streams["s"]
    assert (counters.samples_received, counters.frames_rejected) == (6, 0)
    assert counters.samples_lost == device.samples_since_first - 6
