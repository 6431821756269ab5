"""What comes over a CAN bus is recorded as it came, whatever the disk does, and nobody waits for it."""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import re
import resource
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import can
import numpy as np
import pytest
from support.bus_tables import can_bus
from support.can_recordings import (
    ENDINGS,
    batch,
    books,
    numbers,
    only_file,
    recorded_driver,
    replayed,
    samples,
    traffic,
)
from support.can_standin import StandInBus, frame_bytes
from support.clocks import SettableClock
from support.running_drivers import running
from support.waiting import eventually

from daqsvc.acquisition.clock import NS_PER_S, DrivenClock, SystemClock
from drivers.base import BusPort
from drivers.can import record as can_record
from drivers.can.adapter import batch_of
from drivers.can.errors import CanCounters
from drivers.can.record import CanRecorder
from drivers.can.record_files import LogFile, LogFolder, OneLog

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.samples import SampleBlock
    from drivers.can.record_files import Logs

pytestmark = pytest.mark.integration
FORMATS = list(ENDINGS)


@pytest.fixture
async def bus() -> AsyncIterator[StandInBus]:
    made = StandInBus()
    yield made
    made.close()


def folder(path: Path, log_format: str, **limits: float) -> dict[str, Any]:
    return {"folder": path, "format": log_format, "file_mb": 64, "keep_mb": 2048, **limits}


def recorder(logs: Logs, clock: Clock | None = None) -> tuple[CanRecorder, CanCounters]:
    counters = CanCounters()
    made = CanRecorder("CAN bus 'can0'", "can0", logs, clock or SystemClock(), counters)
    made.start()
    return made, counters


@pytest.mark.parametrize("log_format", FORMATS)
async def test_a_recording_replays_as_the_bus_was_received(
    bus: StandInBus, tmp_path: Path, log_format: str
) -> None:
    sent = traffic(120)
    blocks: list[SampleBlock] = []
    driver = recorded_driver(bus, folder(tmp_path, log_format), blocks)
    async with running(driver):
        for at in range(0, len(sent), 50):
            assert bus.send(sent[at : at + 50]) == len(sent[at : at + 50])
            await asyncio.sleep(0.002)
        await eventually(lambda: driver.streams["dbc"][0].frames_received == 120)
    assert (driver.counters.frames_recorded, driver.counters.frames_unrecorded) == (len(sent), 0)
    path = only_file(tmp_path)
    assert re.fullmatch(rf"can0-\d{{8}}T\d{{6}}\.\d{{6}}Z\{ENDINGS[log_format]}", path.name)

    again, played = await replayed(path)

    assert samples(played) == samples(blocks)
    assert books(again) == books(driver)
    assert again.link.reason == "end of file"


@pytest.mark.parametrize("log_format", FORMATS)
def test_every_frame_is_there_to_the_bit_with_its_time(tmp_path: Path, log_format: str) -> None:
    clock = DrivenClock(wall_start_ns=1_790_000_000 * NS_PER_S)
    frames = [
        can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\x00\x01\xff"),
        can.Message(arbitration_id=0x7FF, is_extended_id=False, data=b""),
        can.Message(arbitration_id=0x1ABCDEF, data=bytes(range(8))),
        can.Message(arbitration_id=0x12, is_extended_id=True, data=b"\xaa"),
        can.Message(arbitration_id=0x55, is_extended_id=False, is_remote_frame=True, dlc=6),
        can.Message(arbitration_id=0x56, is_extended_id=True, is_remote_frame=True, dlc=0),
        can.Message(arbitration_id=0x57, is_extended_id=False, is_fd=True, data=bytes(range(64))),
        can.Message(arbitration_id=0x58, is_fd=True, bitrate_switch=True, data=b"x" * 12),
        can.Message(
            arbitration_id=0x59,
            is_fd=True,
            bitrate_switch=True,
            error_state_indicator=True,
            is_extended_id=False,
            data=b"1",
        ),
    ]
    made, counters = recorder(OneLog(tmp_path / f"run{ENDINGS[log_format]}"), clock)
    t_ns = [NS_PER_S + 1234_000 * k for k in range(len(frames))]
    made.record(batch_of(frames[:5], t_ns[:5]))
    made.record(batch_of(frames[5:], t_ns[5:]))
    made.close()
    assert counters.frames_recorded == len(frames)
    with can.LogReader(tmp_path / f"run{ENDINGS[log_format]}") as log:
        found = list(log)
    for was, got in zip(frames, found, strict=True):
        # ASC counts from its first frame; channel and direction are the writer's business.
        assert got.equals(was, timestamp_delta=None, check_channel=False, check_direction=False), (was, got)
    times = np.array([message.timestamp for message in found])
    np.testing.assert_allclose(times - times[0], 1234e-6 * np.arange(len(frames)), atol=5e-7)
    if log_format != "asc":
        assert times[0] == pytest.approx(1_790_000_000.0, abs=1e-3)


def test_a_candump_log_says_what_error_and_remote_frames_say(tmp_path: Path) -> None:
    clock = DrivenClock(wall_start_ns=1_790_000_000 * NS_PER_S)
    made, _ = recorder(OneLog(tmp_path / "run.log"), clock)
    error = can.Message(
        arbitration_id=0x24, is_extended_id=False, is_error_frame=True, data=b"\0\x20" + bytes(6)
    )
    remote = can.Message(arbitration_id=0x55, is_extended_id=False, is_remote_frame=True, dlc=6)
    made.record(batch_of([error, remote], [NS_PER_S, NS_PER_S + 1_500]))
    made.close()
    assert (tmp_path / "run.log").read_text() == (
        "(1790000000.000000) can0 20000024#0020000000000000\n(1790000000.000001) can0 055#R6\n"
    )


def test_a_step_of_the_wall_clock_is_no_step_between_frames(tmp_path: Path) -> None:
    clock = SettableClock(NS_PER_S, 1_790_000_000 * NS_PER_S)
    logs = LogFolder(tmp_path, "can0", "candump", file_bytes=2000.0, keep_bytes=1e9)
    made, counters = recorder(logs, clock)
    made.record(batch(0, 10))
    while counters.frames_recorded < 10:
        os.sched_yield()
    clock.set_wall(-3600)
    made.record(batch(10, 100))  # in the same file, which is full with it
    while counters.frames_recorded < 110:
        os.sched_yield()
    made.record(batch(110, 1))
    made.close()
    later, first = sorted(tmp_path.iterdir())
    with can.LogReader(first) as log:
        times = np.array([message.timestamp for message in log])
    np.testing.assert_allclose(np.diff(times), 1e-6, atol=3e-7)
    assert len(times) == 110
    with can.LogReader(later) as log:
        [message] = log
    assert message.timestamp == pytest.approx(1_790_000_000 - 3600 + 110e-6, abs=1e-6)


@pytest.mark.parametrize("log_format", FORMATS)
def test_the_oldest_files_make_room_and_no_others(tmp_path: Path, log_format: str) -> None:
    foreign = [tmp_path / "can0-notes.log", tmp_path / "can00-20200101T000000.000000Z.blf"]
    for path in foreign:
        path.write_bytes(bytes(50_000))
    older = tmp_path / "can0-20200101T000000.000000Z.asc"
    older.write_bytes(bytes(50_000))
    clock = DrivenClock(wall_start_ns=1_790_000_000 * NS_PER_S)
    logs = LogFolder(tmp_path, "can0", log_format, file_bytes=20_000, keep_bytes=100_000)
    made, counters = recorder(logs, clock)
    for k in range(200):
        made.record(batch(100 * k, 100))
        # Numbers that do not compress; a container of BLF is written when its time has come.
        clock.advance_to(clock.monotonic_ns() + NS_PER_S)
        while counters.frames_recorded < 100 * (k + 1):
            os.sched_yield()
    made.close()
    ours = sorted(set(tmp_path.iterdir()) - set(foreign))
    assert all(path.exists() for path in foreign)
    assert older not in ours
    assert len(ours) > 2
    assert sum(path.stat().st_size for path in ours) <= 100_000 + 10_000  # it may pass by one batch
    kept = numbers(*ours)
    assert kept == list(range(kept[0], 20_000)), "what is kept is the end, without a gap"


class FullDisk:
    """`os.pwrite` of a disk that is full after a while: it takes half of what is written, then nothing.

    Args:
        writes: how many it takes whole before that.
    """

    def __init__(self, writes: int) -> None:
        self.writes = writes
        self._half = True
        self._write = os.pwrite

    def __call__(self, descriptor: int, data: memoryview, at: int) -> int:
        if at == 0 and len(data) == 144:
            return self._write(descriptor, data, at)  # the header of BLF is there already
        if self.writes > 0:
            self.writes -= 1
            return self._write(descriptor, data, at)
        if self._half:
            self._half = False
            return self._write(descriptor, data[: len(data) // 2], at)
        raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.gives("B42")
@pytest.mark.parametrize("log_format", FORMATS)
@pytest.mark.parametrize("writes", [3, 0])
def test_a_full_disk_costs_what_is_counted_and_is_said_once(
    tmp_path: Path,
    log_format: str,
    writes: int,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.WARNING)
    disk = FullDisk(writes)
    monkeypatch.setattr(os, "pwrite", disk)
    clock = DrivenClock(wall_start_ns=1_790_000_000 * NS_PER_S)
    made, counters = recorder(LogFolder(tmp_path, "can0", log_format, file_bytes=1e9, keep_bytes=1e10), clock)

    def settled(frames: int) -> None:
        while counters.frames_recorded + counters.frames_unrecorded < frames:
            os.sched_yield()

    for k in range(100):
        if k == 80:
            assert counters.frames_unrecorded >= 1000
            disk.writes = 1 << 30
        made.record(batch(100 * k, 100))
        clock.advance_to(clock.monotonic_ns() + NS_PER_S)
        settled(100 * (k + 1))
    made.close()
    assert counters.frames_recorded + counters.frames_unrecorded == 100 * 100
    files = sorted(tmp_path.iterdir())
    there = numbers(*files)
    assert len(there) == counters.frames_recorded, "what is in the files is what is counted"
    assert there == sorted(set(there))
    assert there[-2000:] == list(range(8000, 10_000)), "it goes on when there is room"
    assert there[:-2000] == list(range(100 * writes))
    assert len(files) == (2 if writes else 1), "nothing is left of files that could not be written"
    assert [record.levelno for record in caplog.records] == [logging.WARNING] * 2
    away, back = (record.getMessage() for record in caplog.records)
    assert f"cannot be recorded in {tmp_path}: No space left on device" in away
    assert f"{counters.frames_unrecorded} frames are missing" in back


async def test_files_that_the_system_limits_go_on_in_others(bus: StandInBus, tmp_path: Path) -> None:
    """A real refusal of the kernel, half-way through a write: EFBIG."""
    driver = recorded_driver(bus, None, logs=OneLog(tmp_path / "run.log"))
    sent = [frame_bytes(0x300, k.to_bytes(8, "little")) for k in range(2000)]
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    async with running(driver):
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))
        try:
            counters = driver.counters
            for at, until in ((0, 500), (500, 2000)):  # in less than the second after which it is tried again
                assert bus.send(sent[at:until]) == until - at
                await eventually(lambda: counters.frames_recorded + counters.frames_unrecorded == until)  # noqa: B023
            await asyncio.sleep(1.1)  # until it is tried again
            bus.send(sent[:1])
            await eventually(lambda: counters.frames_recorded + counters.frames_unrecorded == 2001)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert driver.counters.frames_unrecorded > 0
    there = numbers(tmp_path / "run.log", tmp_path / "run-2.log")
    assert len(there) == driver.counters.frames_recorded
    assert there[: len(there) - 1] == list(range(len(there) - 1))
    assert there[-1] == 0
    assert (tmp_path / "run.log").stat().st_size <= 50_000


def test_a_disk_that_takes_a_little_now_and_then_is_spoken_of_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    disk = FullDisk(0)
    monkeypatch.setattr(os, "pwrite", disk)
    clock = DrivenClock()
    logs = LogFolder(tmp_path, "can0", "candump", file_bytes=1e9, keep_bytes=1e10)
    made, counters = recorder(logs, clock)
    for k in range(60):
        if k % 4 == 3:
            disk.writes += 1
        made.record(batch(k, 1))
        clock.advance_to(clock.monotonic_ns() + NS_PER_S)
        while counters.frames_recorded + counters.frames_unrecorded <= k:
            os.sched_yield()
    made.close()
    assert counters.frames_recorded == len(numbers(*tmp_path.iterdir())) == 15
    assert len(caplog.records) == 1


@pytest.mark.parametrize("trouble", ["missing", "a file", "read-only"])
async def test_a_folder_that_cannot_be_written_stops_nothing(
    bus: StandInBus,
    tmp_path: Path,
    trouble: str,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    caplog.set_level(logging.WARNING)
    place = tmp_path / "can"
    if trouble == "a file":
        place.write_bytes(b"")
    elif trouble == "read-only":
        place.mkdir()

        def refused(*_arguments: object, **_options: object) -> None:
            raise OSError(errno.EROFS, "Read-only file system")

        monkeypatch.setattr(Path, "open", refused)  # root may write wherever the disk can be written
    driver = recorded_driver(bus, folder(place, "blf"))
    sent = traffic(20)
    async with running(driver):
        bus.send(sent)
        await eventually(lambda: driver.counters.frames_unrecorded == len(sent))
    assert driver.streams["fd"][0].frames_received == 20
    assert driver.counters.frames_recorded == 0
    said = [r.getMessage() for r in caplog.records if "recorded" in r.getMessage()]
    assert len(said) == 1
    assert f"in {place}: " in said[0]


def hung(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """A disk that takes nothing until the event is set."""
    go_on = threading.Event()
    flush = LogFile.flush

    def held_up(log: LogFile) -> None:
        go_on.wait()
        flush(log)

    monkeypatch.setattr(LogFile, "flush", held_up)
    return go_on


async def test_a_slow_disk_costs_its_own_frames_only(
    bus: StandInBus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    monkeypatch.setattr(can_record, "MOST_FRAMES_HELD", 500)
    go_on = hung(monkeypatch)
    sent = traffic(1000)
    driver = recorded_driver(bus, folder(tmp_path, "candump"))
    async with running(driver):
        try:
            on_wire = 0
            while on_wire < len(sent):  # it holds less than all of them
                on_wire += bus.send(sent[on_wire : on_wire + 100])
                await asyncio.sleep(0.001)
            await eventually(lambda: driver.streams["dbc"][0].frames_received == 1000)
            assert driver.counters.frames_recorded == 0
            assert driver.counters.frames_unrecorded >= len(sent) - 500
        finally:
            go_on.set()
    assert all(stream.samples_lost == 0 for stream, _ in driver.streams.values())
    assert driver.counters.frames_recorded > 0
    assert driver.counters.frames_recorded + driver.counters.frames_unrecorded == len(sent)
    path = only_file(tmp_path)
    assert len(path.read_text().splitlines()) == driver.counters.frames_recorded
    assert sum("come faster than they can be recorded" in r.getMessage() for r in caplog.records) == 1


async def test_a_disk_that_hangs_does_not_keep_the_service_from_stopping(
    bus: StandInBus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    monkeypatch.setattr(can_record, "PATIENCE_S", 0.05)
    go_on = hung(monkeypatch)
    sent = traffic(10)
    driver = recorded_driver(bus, folder(tmp_path, "blf"))
    async with running(driver):
        bus.send(sent)
        await eventually(lambda: driver.streams["dbc"][0].frames_received == 10)
    assert driver.counters.frames_unrecorded == len(sent)
    assert any("within 0.05 s and are given up" in record.getMessage() for record in caplog.records)
    go_on.set()
    for thread in threading.enumerate():
        if thread.name.startswith("can-recorder"):
            await asyncio.to_thread(thread.join)
    assert driver.counters.frames_recorded == 0, "what was given up is not counted twice"


@pytest.mark.parametrize("log_format", FORMATS)
async def test_a_file_that_breaks_off_anywhere_is_played_that_far(tmp_path: Path, log_format: str) -> None:
    whole = tmp_path / f"whole{ENDINGS[log_format]}"
    made, _ = recorder(OneLog(whole))
    for k in range(20):
        made.record(batch(20 * k, 20))
    made.close()
    content = whole.read_bytes()
    broken = tmp_path / f"broken{ENDINGS[log_format]}"
    most = -1
    for size in sorted({*range(1, len(content), max(1, len(content) // 40)), len(content) - 1}):
        if size < 200:
            continue  # not even the beginning of a file
        broken.write_bytes(content[:size])
        frames = await frames_played(broken)
        assert frames >= most, "more of the file, and fewer frames"
        most = frames
    assert most >= 399


async def frames_played(path: Path) -> int:
    driver, _ = await replayed(path)
    assert driver.link.reason == "end of file" or "is damaged behind frame" in driver.link.reason
    counters = driver.streams["classic"][0]
    return counters.frames_received + counters.frames_rejected + counters.frames_duplicate


async def test_a_file_that_somebody_deletes_is_begun_anew(bus: StandInBus, tmp_path: Path) -> None:
    driver = recorded_driver(bus, folder(tmp_path, "candump"))
    async with running(driver):
        bus.send(traffic(1))
        await eventually(lambda: driver.counters.frames_recorded == 4)
        path = only_file(tmp_path)
        path.unlink()
        for k in (1, 2):  # what is written to the deleted file is gone with it
            bus.send([frame_bytes(0x300, bytes([k]))])
            await eventually(lambda: driver.counters.frames_recorded == 4 + k)  # noqa: B023
    path = only_file(tmp_path)
    assert path.read_text().endswith(" 300#02\n")


async def test_the_recording_outlives_the_link(bus: StandInBus, tmp_path: Path) -> None:
    driver = recorded_driver(bus, folder(tmp_path, "blf"))
    async with running(driver):
        for k in range(3):
            await eventually(lambda: driver.link.state == "up")
            bus.send([frame_bytes(0x101, bytes([0, 3 * k, *bytes(6)]))])
            await eventually(lambda: driver.streams["classic"][0].frames_received == k + 1)  # noqa: B023
            bus.unplug()
            await eventually(lambda: driver.link.losses == k + 1)  # noqa: B023
            bus.plug_in()
    path = only_file(tmp_path)
    assert len(numbers(path)) == driver.counters.frames_recorded == 3
    assert not [t for t in threading.enumerate() if t.name.startswith("can-recorder")]


@pytest.mark.parametrize(
    ("options", "missing"),
    [
        ({"interface": "kvaser", "channel": "0", "fd": False}, True),
        ({"interface": "kvaser", "channel": "0", "fd": True}, False),
        ({"interface": "socketcan", "channel": "can0", "fd": False}, False),
    ],
)
def test_fd_frames_that_an_adapter_is_told_not_to_read_are_said_to_be_missing(
    options: dict[str, Any], *, missing: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    port = BusPort("can0", [], SystemClock(), print)
    logs = OneLog(tmp_path / "run.log")
    made = can_record.recorder_of(can_bus(**options), port, "CAN bus 'can0'", CanCounters(), logs)
    assert made is not None
    assert ("CAN FD frames are neither read nor recorded" in caplog.text) is missing
