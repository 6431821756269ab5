"""The CAN driver on a CAN interface of the kernel, with can-utils as a peer that shares no code with it."""

from __future__ import annotations

import asyncio
import re
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from support.bus_tables import can_bus
from support.can_standin import frame_bytes
from support.clocks import QuickClock
from support.running_drivers import CountingDevice, running
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from drivers.base import BusPort, StreamSpec
from drivers.can.batches import ERROR
from drivers.can.driver import CanDriver
from drivers.frames import FrameLayout

if TYPE_CHECKING:
    from support.vcan_links import VcanLink

    from daqsvc.acquisition.samples import SampleBlock

LAYOUT = FrameLayout.plain(
    frame_id=0x101,
    length=8,
    channels=[("x", 16, "signed", 0.5, 0.0)],
    samples_per_frame=3,
    counter_byte=0,
    counter_bits=16,
    first_byte=2,
    byte_order="big",
)


def driver_on(vcan: VcanLink, blocks: list[SampleBlock], **options: Any) -> CanDriver:
    chosen = {"interface": "socketcan", "channel": vcan.name, "fd": True} | options
    port = BusPort("can0", [StreamSpec("s", LAYOUT, 3000.0)], QuickClock(), blocks.append)
    return CanDriver(can_bus(**chosen), port)


async def call(*command: str) -> str:
    process = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)
    output, _ = await process.communicate()
    assert process.returncode == 0, f"{' '.join(command)}: exit {process.returncode}"
    return output.decode()


async def test_frames_of_can_utils_become_samples(vcan: VcanLink, tmp_path: Path) -> None:
    blocks: list[SampleBlock] = []
    driver = driver_on(vcan, blocks)
    async with running(driver):
        # By one process: a counter that goes on by 3 ms after half a second on a busy machine is a restart.
        log = tmp_path / "two.log"
        frames = ["101#0000000100020003", "101#0003FFFFFFFE7FFF"]
        lines = [f"(1.{3000 * k:06}) {vcan.name} {frame}\n" for k, frame in enumerate(frames)]
        log.write_text("".join(lines))
        await call("canplayer", "-I", str(log))
        await eventually(lambda: driver.streams["s"][0].frames_received == 2)
    got = np.concatenate([block.samples for block in blocks])[:, 0]
    assert got.tolist() == [0.5, 1.0, 1.5, -0.5, -1.0, 16383.5]
    assert blocks[0].first_index == 0


async def test_what_cangen_sends_is_counted_as_candump_counts_it(vcan: VcanLink, tmp_path: Path) -> None:
    driver = driver_on(vcan, [], filter=False)
    seen_by_candump = tmp_path / "candump.log"
    async with running(driver):
        with seen_by_candump.open("wb") as log:
            dump = await asyncio.create_subprocess_exec(
                "candump", "-L", "-r", "4000000", "-n", "2000", vcan.name, stdout=log
            )
        await asyncio.sleep(0.5)  # candump does not say when it listens
        # Classic, FD and extended frames with random ids, lengths and data; again whenever the queue is full.
        await call("cangen", vcan.name, "-g", "0", "-m", "-n", "2000", "-p", "10")
        async with asyncio.timeout(20):
            await dump.wait()
        counters = driver.counters
        await eventually(
            lambda: counters.frames_unknown + counters.frames_remote + _of_stream(driver) == 2000
        )
    seen = re.findall(r" ([0-9A-F]+)#", seen_by_candump.read_text())
    assert len(seen) == 2000
    expected: dict[str, int] = {}
    for text in seen:
        name = f"{int(text, 16):#x} ({29 if len(text) == 8 else 11} bit)"
        expected[name] = expected.get(name, 0) + 1
    remembered = {name: n for name, n in driver.counters.unknown_ids.items() if expected.get(name) != n}
    assert len(driver.counters.unknown_ids) == 64
    # Remote frames are counted apart, so an id may have been seen more often by candump.
    assert sum(expected.get(name, 0) - n for name, n in remembered.items()) <= driver.counters.frames_remote
    assert driver.counters.frames_overrun == 0


def _of_stream(driver: CanDriver) -> int:
    counters = driver.streams["s"][0]
    return counters.frames_received + counters.frames_wrong_length


async def test_candump_sees_what_the_simulated_node_sends(vcan: VcanLink) -> None:
    import can

    from sim_hw.nodes.can_node import CanNode
    from sim_hw.nodes.pacing import RealTimePacer

    dump = await asyncio.create_subprocess_exec(
        "candump", "-L", "-n", "20", vcan.name, stdout=asyncio.subprocess.PIPE
    )
    await asyncio.sleep(0.3)
    samples = np.arange(60.0)[:, None] / 2
    with can.Bus(interface="socketcan", channel=vcan.name, fd=True) as bus:
        await CanNode(bus, LAYOUT, samples, 3000.0).play(RealTimePacer(SystemClock()))
    assert dump.stdout is not None
    lines = (await dump.stdout.read()).decode().splitlines()
    await dump.wait()
    payloads = [re.search(r" 101#([0-9A-F]{16})$", line) for line in lines]
    numbers = np.array([[int(p[1][at : at + 4], 16) for at in (0, 4, 8, 12)] for p in payloads if p])
    assert numbers[:, 0].tolist() == list(range(0, 60, 3))
    assert numbers[:, 1:].ravel().tolist() == list(range(60))


async def test_a_link_that_goes_down_a_hundred_times_leaves_nothing_behind(vcan: VcanLink) -> None:
    def held() -> tuple[int, int, int]:
        readers = sum(t.name.startswith("can-reader") for t in threading.enumerate())
        return readers, len(list(Path("/proc/self/fd").iterdir())), len(asyncio.all_tasks())

    blocks: list[SampleBlock] = []
    driver = driver_on(vcan, blocks)
    sent = 0
    async with running(driver):
        await asyncio.sleep(0.1)
        before = held()
        for k in range(1, 101):
            await eventually(lambda: driver.link.state == "up")
            with vcan.sender() as sender:
                for _ in range(3):
                    sender.send(frame_bytes(0x101, (3 * sent).to_bytes(2, "big") + bytes(6)))
                    sent += 1
            await eventually(lambda: driver.streams["s"][0].frames_received == sent)  # noqa: B023
            vcan.down()
            await eventually(lambda: driver.link.losses == k)  # noqa: B023
            vcan.up()
        await eventually(lambda: driver.link.state == "up")
        after = held()
    assert after == before
    assert driver.streams["s"][0].samples_received == 3 * sent
    assert driver.streams["s"][0].samples_lost == 0


async def test_an_adapter_that_is_unplugged_is_opened_again(vcan: VcanLink) -> None:
    driver = driver_on(vcan, [])
    device = CountingDevice(3000.0, 3)
    async with running(driver):
        for k in range(1, 6):
            await eventually(lambda: driver.link.state == "up")
            with vcan.sender() as sender:
                counter = 3 * device.frame() % 2**16
                sender.send(frame_bytes(0x101, counter.to_bytes(2, "big") + bytes(6)))
            await eventually(lambda: driver.streams["s"][0].frames_received == k)  # noqa: B023
            await asyncio.to_thread(vcan.remove)
            await eventually(lambda: driver.link.losses == k and "No such device" in driver.link.reason)  # noqa: B023
            await asyncio.to_thread(vcan.add)
        await eventually(lambda: driver.link.state == "up")
    counters, _ = driver.streams["s"]
    assert (counters.samples_received, counters.frames_rejected) == (15, 0)
    assert counters.samples_lost == device.samples_since_first - 15


async def test_bus_off_takes_the_link_down_until_the_controller_restarts(vcan: VcanLink) -> None:
    driver = driver_on(vcan, [])
    async with running(driver):
        with vcan.sender() as sender:
            sender.send(frame_bytes(ERROR | 0x204, b"\0\x20\0\0\0\0\x80\x07"))
            await eventually(lambda: driver.counters.controller_state == "error-passive")
            assert driver.link.state == "up"
            sender.send(frame_bytes(ERROR | 0x40, bytes(8)))
            await eventually(lambda: driver.link.state == "down")
            assert "restart-ms" in driver.link.reason
            sender.send(frame_bytes(ERROR | 0x100, bytes(8)))
            await eventually(lambda: driver.link.state == "up")
            sender.send(frame_bytes(0x101, bytes(8)))
            await eventually(lambda: driver.streams["s"][0].frames_received == 1)
    assert (driver.counters.bus_off, driver.counters.restarts, driver.link.losses) == (1, 1, 1)
    assert (driver.counters.tx_errors, driver.counters.rx_errors) == (128, 7)
    assert driver.counters.frames_error == 3
