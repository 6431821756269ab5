"""The CAN driver on python-can's virtual bus, and on one that fails in every way we know."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import can
import numpy as np
import pytest
from support.bus_tables import can_bus
from support.can_standin import FaultyBus
from support.clocks import QuickClock, SettableClock
from support.running_drivers import begun
from support.waiting import eventually

from daqsvc.notice import NOTICE
from drivers.base import BusPort, DeviceAbsentError, StreamSpec
from drivers.can.driver import CanDriver
from drivers.fields import Field
from drivers.frames import FrameLayout, Selector
from sim_hw.bus_socket_hub import overflow_message

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.acquisition.samples import SampleBlock

pytestmark = pytest.mark.integration
PER_FRAME = 10


def layout(frame_id: int = 0x101) -> FrameLayout:
    return FrameLayout.plain(
        frame_id=frame_id,
        length=64,
        channels=[
            ("x", 16, "signed", 1.0, 0.0),
            ("y", 16, "signed", 1.0, 0.0),
            ("k", 16, "signed", 1.0, 0.0),
        ],
        samples_per_frame=PER_FRAME,
        counter_byte=0,
        counter_bits=16,
        first_byte=2,
        crc_byte=62,
    )


def message(frame: int, **changes: Any) -> can.Message:
    samples = np.full((1, PER_FRAME, 3), float(frame % 1000))
    data = layout().encode(np.array([frame * PER_FRAME], np.int64), samples)[0].tobytes()
    return can.Message(
        **({"arbitration_id": 0x101, "is_extended_id": False, "is_fd": True, "data": data} | changes)
    )


def port(blocks: list[SampleBlock], **changes: Any) -> BusPort:
    arguments: dict[str, Any] = {
        "name": "can0",
        "streams": [StreamSpec("shaft", layout(), 1000.0)],
        "clock": QuickClock(),
        "deliver": blocks.append,
    }
    return BusPort(**(arguments | changes))


FAULTY = can_bus(interface="faulty", channel="test", fd=True)


@pytest.fixture(autouse=True)
def _renew() -> None:
    FaultyBus.renew()


async def test_frames_of_a_virtual_bus_become_blocks() -> None:
    blocks: list[SampleBlock] = []
    bus_table = can_bus(interface="virtual", channel="test_frames_become_blocks", fd=True)
    driver = CanDriver(bus_table, port(blocks))
    async with begun(driver):
        await eventually(lambda: driver.link.state == "up")
        with can.Bus(
            interface="virtual", channel=bus_table.channel, protocol=can.CanProtocol.CAN_FD
        ) as sender:
            for frame in range(100):
                sender.send(message(frame))
            await eventually(lambda: driver.streams["shaft"][0].samples_received == 100 * PER_FRAME)
    got = np.concatenate([b.samples for b in blocks])
    assert (got[:, 0] == np.repeat(np.arange(100), PER_FRAME)).all()
    assert blocks[0].first_index == 0
    assert driver.streams["shaft"][0].samples_lost == 0


async def test_what_is_no_sample_is_counted_and_said_once(caplog: pytest.LogCaptureFixture) -> None:
    blocks: list[SampleBlock] = []
    driver = CanDriver(FAULTY, port(blocks))
    short = message(1).data[:40]
    strays = [
        *[message(0, arbitration_id=0x7FF)] * 3,
        *[message(0, is_extended_id=True)] * 2,
        *[message(1, data=short)] * 4,
        message(1, data=bytes(8), is_fd=False),
        can.Message(arbitration_id=0x101, is_remote_frame=True, is_extended_id=False, dlc=8),
        can.Message(arbitration_id=4, is_error_frame=True),
        message(1, data=bytes(64)),  # CRC wrong
    ]
    with caplog.at_level(NOTICE):
        async with begun(driver):
            for k, stray in enumerate(strays):
                FaultyBus.inbox.put(stray)
                FaultyBus.inbox.put(message(k))
            await eventually(lambda: driver.streams["shaft"][0].frames_received == len(strays) + 1)
    counters = driver.streams["shaft"][0]
    assert driver.counters.frames_unknown == 5
    assert driver.counters.unknown_ids == {"0x7ff (11 bit)": 3, "0x101 (29 bit)": 2}
    assert counters.frames_wrong_length == 5
    assert counters.frames_corrupt == 1
    assert (driver.counters.frames_remote, driver.counters.frames_error) == (1, 1)
    assert (counters.samples_received, counters.samples_lost) == (len(strays) * PER_FRAME, 0)
    said = [r.message for r in caplog.records]
    assert sum("0x7ff (11 bit) the first of them" in text for text in said) == 1
    assert sum("CRC of a frame, or the checksum of a line, does not match" in text for text in said) == 1
    assert len(said) == 3, "every kind is said once, however many there are"
    assert sum("bytes, its layout 64" in text for text in said) == 1


async def test_a_silent_stream_says_what_comes_in_its_place() -> None:
    blocks: list[SampleBlock] = []
    streams = [StreamSpec("shaft", layout(), 1000.0), StreamSpec("other", layout(0x55), 1000.0)]
    clock = SettableClock()
    driver = CanDriver(FAULTY, port(blocks, streams=streams, clock=clock))
    async with begun(driver):
        await eventually(lambda: driver.link.state == "up")
        assert driver.link.why_silent("shaft") == ""
        assert driver.link.quiet() == "no frame at all on can0 for 1 s"
        for frame_id in (0x320, 0x7A0):
            FaultyBus.inbox.put(message(0, arbitration_id=frame_id))
        await eventually(lambda: driver.counters.frames_unknown == 2)
        assert driver.link.why_silent("shaft") == (
            "the bus works, as other frames come on can0: 0x320 (11 bit), 0x7a0 (11 bit); "
            "compare the id 0x101 (11 bit), or check the device"
        )
        assert driver.link.quiet() == ""
        FaultyBus.inbox.put(message(1, data=message(1).data[:40]))
        await eventually(lambda: driver.streams["shaft"][0].frames_wrong_length == 1)
        said = "its frames 0x101 have 40 bytes, the layout 64; correct the layout"
        assert driver.link.faults["shaft"] == said
        assert "compare the id 0x55" in driver.link.faults["other"]
        FaultyBus.inbox.put(message(2))
        await eventually(lambda: driver.streams["shaft"][0].frames_received == 1)
        assert "have 40 bytes" not in driver.link.why_silent("shaft")
        clock.advance(11.0)
        assert dict(driver.link.faults) == {}, "nothing comes any more"
        assert driver.link.quiet() == "no frame at all on can0 for 1 s"


@pytest.mark.parametrize("filter_", [None, True, False])
def test_what_the_kernel_leaves_out_is_not_taken_for_silence(*, filter_: bool | None) -> None:
    bus = can_bus(interface="socketcan", channel="can0", filter=filter_)
    driver = CanDriver(bus, port([], streams=[StreamSpec("shaft", layout(), 1000.0)], clock=SettableClock()))
    assert driver.link.quiet() == ("no frame at all on can0 for 1 s" if filter_ is False else "")


def paged(page: int) -> FrameLayout:
    """The layout of frames whose last byte is this page."""
    selector = Selector("Page", Field(8 * 63, 8), frozenset({page}))
    return replace(layout(), crc_byte=None, selectors=(selector,))


async def test_a_device_that_is_off_is_not_taken_for_a_bus_that_works(
    caplog: pytest.LogCaptureFixture,
) -> None:
    blocks: list[SampleBlock] = []
    streams = [StreamSpec("shaft", paged(0), 1000.0)]
    clock = SettableClock()
    driver = CanDriver(FAULTY, port(blocks, streams=streams, clock=clock))
    pages = [message(0, data=bytes([*message(0).data[:63], page])) for page in (0, 1)]
    with caplog.at_level("WARNING"):
        async with begun(driver):
            for frame in (*pages, message(0, arbitration_id=0x320)):
                FaultyBus.inbox.put(frame)
            await eventually(lambda: driver.counters.frames_unknown == 2)
            clock.advance(2.0)
            assert driver.link.why_silent("shaft") == "", "all that came, came with the frames of the stream"
            FaultyBus.inbox.put(message(0, arbitration_id=0x320))
            await eventually(lambda: driver.counters.frames_unknown == 3)
            assert driver.link.why_silent("shaft").startswith(
                "the bus works, as other frames come on can0: 0x320"
            )
            FaultyBus.inbox.put(pages[1])
            await eventually(lambda: driver.counters.frames_unknown == 4)
            assert driver.link.why_silent("shaft") == (
                "only other pages of its message come on can0: 0x101 (11 bit), Page 1; compare the DBC "
                "file with the manual of the device"
            )
    assert driver.counters.unknown_ids == {"0x101 (11 bit), Page 1": 2, "0x320 (11 bit)": 2}
    assert [r.message for r in caplog.records if "such as 0x101 (11 bit), Page 1; they" in r.message]


@pytest.mark.parametrize(
    ("failure", "reason"),
    [
        (can.CanOperationError("Network is down", 100), "Network is down"),
        (OSError(19, "No such device"), "No such device"),
        (RuntimeError("adapter went mad"), "its reader failed: adapter went mad"),
        (can.Message(arbitration_id=0x40, is_error_frame=True), "bus-off"),
    ],
)
async def test_a_lost_bus_is_opened_again_and_its_loss_counted(
    failure: Any, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    blocks: list[SampleBlock] = []
    driver = CanDriver(FAULTY, port(blocks))
    with caplog.at_level(NOTICE):
        async with begun(driver):
            for frame in range(5):
                FaultyBus.inbox.put(message(frame))
            await eventually(lambda: driver.streams["shaft"][0].frames_received == 5)
            FaultyBus.open_errors += [can.CanInitializationError("still away")] * 3
            FaultyBus.inbox.put(failure)
            await eventually(lambda: driver.link.losses == 1)
            await eventually(lambda: FaultyBus.opened == 2)
            for frame in range(7, 12):
                FaultyBus.inbox.put(message(frame))
            await eventually(lambda: driver.streams["shaft"][0].samples_received >= 10 * PER_FRAME)
    assert driver.streams["shaft"][0].samples_lost == 2 * PER_FRAME
    assert driver.streams["shaft"][0].samples_received == 10 * PER_FRAME
    said = [r.message for r in caplog.records]
    lost = [r.message for r in caplog.records if "is lost" in r.message]
    assert len(lost) == 1
    assert reason in lost[0]
    assert sum(text.endswith("is back") for text in said) == 1
    assert FaultyBus.closed == FaultyBus.opened


async def test_an_adapter_that_reports_bus_off_by_its_state_is_opened_again() -> None:
    driver = CanDriver(FAULTY, port([]))
    async with begun(driver):
        await eventually(lambda: driver.link.state == "up")
        FaultyBus.dead = True
        await eventually(lambda: driver.counters.bus_off >= 1)
        FaultyBus.dead = False
        await eventually(lambda: driver.link.state == "up")


async def test_a_hundred_losses_leave_no_thread_behind() -> None:
    import threading

    blocks: list[SampleBlock] = []
    driver = CanDriver(FAULTY, port(blocks))
    before = threading.active_count()
    async with begun(driver):
        for k in range(100):
            await eventually(lambda: driver.link.state == "up")
            FaultyBus.inbox.put(message(k))
            FaultyBus.inbox.put(can.CanOperationError("down"))
            await eventually(lambda k=k: driver.link.losses == k + 1)
        await eventually(lambda: driver.link.state == "up")
        assert sum(t.name.startswith("can-reader") for t in threading.enumerate()) == 1
    assert FaultyBus.closed == FaultyBus.opened
    assert driver.streams["shaft"][0].samples_received == 100 * PER_FRAME
    readers = [t for t in threading.enumerate() if t.name.startswith("can-reader")]
    assert not readers, f"{threading.active_count()} threads, {before} before"


async def test_absent_at_start_follows_the_policy() -> None:
    FaultyBus.open_errors = [can.CanInitializationError("no such interface")]
    with pytest.raises(DeviceAbsentError, match=r"'can0'.*no such interface"):
        await CanDriver(FAULTY, port([], start="error")).run()
    FaultyBus.open_errors = [can.CanInitializationError("no such interface")]
    ignoring = CanDriver(FAULTY, port([], start="ignore"))
    await ignoring.run()
    assert ignoring.counters.open_failures == 1
    FaultyBus.open_errors = [OSError("no"), can.CanInitializationError("no"), ValueError("no")]
    retrying = CanDriver(FAULTY, port([]))
    async with begun(retrying):
        await eventually(lambda: retrying.link.state == "up")
    assert retrying.counters.open_failures == 3


async def test_what_is_held_back_is_handed_over_at_the_end() -> None:
    blocks: list[SampleBlock] = []
    driver = CanDriver(FAULTY, port(blocks, streams=[StreamSpec("shaft", layout(), 1000.0, 10_000_000_000)]))
    async with begun(driver):
        for frame in (0, 1, 3):
            FaultyBus.inbox.put(message(frame))
        await eventually(lambda: driver.streams["shaft"][0].frames_received == 3)
        assert not blocks
    assert [b.first_index for b in blocks] == [0, 3 * PER_FRAME]
    assert blocks[1].lost_before == PER_FRAME


async def test_the_virtual_bus_tells_of_its_overflows_as_a_controller_does(tmp_path: Path) -> None:
    path = str(tmp_path / "can0")
    blocks: list[SampleBlock] = []
    driver = CanDriver(can_bus(interface="unixbus", channel=path, fd=True), port(blocks))
    async with begun(driver):
        await eventually(lambda: driver.link.state == "up")
        with can.Bus(interface="unixbus", channel=path, fd=True, hub="join") as peer:
            peer.send(overflow_message(0.0, path))
            await eventually(lambda: driver.counters.frames_error == 1)
    assert (driver.counters.rx_overflows, driver.counters.overruns) == (1, 1)
