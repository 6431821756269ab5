"""What is recorded of a CAN interface of the kernel, against what can-utils record and make of it."""

from __future__ import annotations

import asyncio
import re
from typing import TYPE_CHECKING, Any

import can
import numpy as np
import pytest
from support.bus_tables import can_bus
from support.can_recordings import STREAMS, books, only_file, replayed
from support.can_standin import frame_bytes
from support.running_drivers import running
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from drivers.base import BusPort
from drivers.can.batches import ERROR
from drivers.can.driver import CanDriver
from drivers.can.record_files import Logs, OneLog

if TYPE_CHECKING:
    from pathlib import Path

    from support.vcan_links import VcanLink

    from drivers.replay.driver import ReplayDriver

GENERATED = 2000
REMOTE_FRAMES = 100
ERROR_FRAMES = 3
SENT = GENERATED + REMOTE_FRAMES + ERROR_FRAMES
LINE = re.compile(r"\((\d+\.\d{6})\) +(\S+) ([0-9A-F]+#\S*)(?: [RT])?\n")


def driver_on(vcan: VcanLink, logs: Logs | None = None, **options: Any) -> CanDriver:
    bus = can_bus(**({"interface": "socketcan", "channel": vcan.name, "fd": True} | options))
    return CanDriver(bus, BusPort("can0", STREAMS, SystemClock(), lambda _: None), logs=logs)


async def call(*command: str | Path) -> str:
    process = await asyncio.create_subprocess_exec(
        *map(str, command), stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
    )
    output, said = await process.communicate()
    assert process.returncode == 0, f"{command}: exit {process.returncode}: {said.decode()}"
    return output.decode()


async def dumped(vcan: VcanLink, frames: int) -> asyncio.subprocess.Process:
    """A candump that ends after so many frames, error frames included, and prints them as it logs them."""
    dump = await asyncio.create_subprocess_exec(
        *("candump", "-L", "-r", "4000000", "-n", str(frames), f"{vcan.name},0:0,#FFFFFFFF"),
        stdout=asyncio.subprocess.PIPE,
    )
    await asyncio.sleep(0.5)  # candump does not say when it listens
    return dump


async def send_of_every_kind(vcan: VcanLink) -> None:
    # Classic, FD and extended frames with random ids, lengths and data; again whenever the queue is full.
    await call("cangen", vcan.name, "-g", "0", "-m", "-n", str(GENERATED), "-p", "10")
    await call("cangen", vcan.name, "-g", "0", "-R", "-n", str(REMOTE_FRAMES), "-p", "10")
    with vcan.sender() as sender:
        for classes in (0x004, 0x088, 0x100):
            sender.send(frame_bytes(ERROR | classes, bytes(range(8))))


def frames_in(text: str) -> tuple[np.ndarray, list[str]]:
    """Times in seconds and frames of a candump log; of the flags of CAN FD only the two that are sent."""
    lines = [LINE.fullmatch(line) for line in text.splitlines(keepends=True)]
    assert all(lines), next(line for line in text.splitlines() if not LINE.fullmatch(line + "\n"))
    times = np.array([float(line[1]) for line in lines if line])
    return times, [re.sub("##(.)", lambda m: f"##{int(m[1], 16) & 3:X}", line[3]) for line in lines if line]


def counted(driver: CanDriver | ReplayDriver) -> dict[str, Any]:
    """All counts but those by id: of random ids only the first 64 are remembered, in the order of a batch."""
    return {name: count for name, count in books(driver).items() if name != "unknown_ids"}


async def recorded(vcan: VcanLink, folder: Path, log_format: str) -> tuple[CanDriver, str]:
    """Traffic recorded by the driver, and as candump saw it."""
    record = {"folder": folder, "format": log_format, "file_mb": 64, "keep_mb": 2048}
    driver = driver_on(vcan, record=record)
    async with running(driver):
        dump = await dumped(vcan, SENT)
        await send_of_every_kind(vcan)
        async with asyncio.timeout(20):
            output, _ = await dump.communicate()
        await eventually(lambda: driver.counters.frames_recorded == SENT)
    return driver, output.decode()


async def test_a_candump_recording_is_what_candump_records(vcan: VcanLink, tmp_path: Path) -> None:
    driver, seen = await recorded(vcan, tmp_path, "candump")
    path = only_file(tmp_path)
    times, frames = frames_in(path.read_text())
    seen_times, seen_frames = frames_in(seen)
    assert len(frames) == SENT
    assert frames == seen_frames
    # One stamp of the kernel, once by way of the monotonic clock: clocks are read some microseconds apart.
    np.testing.assert_allclose(times, seen_times, atol=0.02)
    again, _ = await replayed(path)
    assert counted(again) == counted(driver)


@pytest.mark.parametrize("log_format", ["blf", "asc"])
async def test_recordings_of_other_formats_hold_the_same(
    vcan: VcanLink, tmp_path: Path, log_format: str
) -> None:
    driver, seen = await recorded(vcan, tmp_path, log_format)
    _, seen_frames = frames_in(seen)
    path = only_file(tmp_path)
    # Rewritten by python-can; an error frame loses its contents in ASC and in python-can's candump logs.
    with can.LogReader(path) as log, can.Logger(tmp_path / "again.log") as rewritten:
        for message in log:
            rewritten.on_message_received(message)
    _, frames = frames_in((tmp_path / "again.log").read_text())

    def comparable(frame: str) -> str:
        if frame[0] in "23" and len(frame.split("#", maxsplit=1)[0]) == 8:
            return "error"
        return re.sub(r"#R.*|##.$", "#empty", frame)  # ASC knows no empty CAN FD frame

    assert list(map(comparable, frames)) == list(map(comparable, seen_frames))
    if log_format == "blf":
        again, _ = await replayed(path)
        assert counted(again) == counted(driver)


async def test_can_utils_play_and_convert_a_recording(vcan: VcanLink, tmp_path: Path) -> None:
    driver, _ = await recorded(vcan, tmp_path, "candump")
    path = only_file(tmp_path)
    _, frames = frames_in(path.read_text())

    dump = await dumped(vcan, SENT)
    await call("canplayer", "-t", "-I", path)
    async with asyncio.timeout(20):
        output, _ = await dump.communicate()
    assert frames_in(output.decode())[1] == frames

    await call("log2asc", "-I", path, "-O", tmp_path / "converted.asc", vcan.name)
    again, _ = await replayed(tmp_path / "converted.asc")
    received, expected = counted(again), counted(driver)
    assert received["frames_error"] == expected["frames_error"] == ERROR_FRAMES
    assert again.counters.frames_malformed == 0


async def test_the_whole_bus_is_recorded_unless_it_is_filtered(vcan: VcanLink, tmp_path: Path) -> None:
    counts = []
    for asked in ({}, {"filter": True}):
        log = tmp_path / f"{len(counts)}.log"
        driver = driver_on(vcan, OneLog(log), **asked)
        async with running(driver):
            with vcan.sender() as sender:
                sender.send(frame_bytes(0x7FF, b"of no stream"[:8]))
                sender.send(frame_bytes(0x101, bytes(8)))
            await eventually(lambda: driver.streams["classic"][0].frames_received == 1)  # noqa: B023
        counts.append(driver.counters.frames_recorded)
    assert counts == [2, 1]


async def test_fd_frames_are_recorded_whatever_the_machine_file_says_of_fd(
    vcan: VcanLink, tmp_path: Path
) -> None:
    driver = driver_on(vcan, OneLog(tmp_path / "fd.log"), fd=False)
    async with running(driver):
        with vcan.sender() as sender:
            sender.send(frame_bytes(0x7FF, bytes(64), fd=True))
            sender.send(frame_bytes(0x101, bytes(8)))
        await eventually(lambda: driver.streams["classic"][0].frames_received == 1)
    assert driver.counters.frames_recorded == 2
