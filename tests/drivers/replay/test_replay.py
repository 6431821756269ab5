"""Recordings come out of the replay driver as they were recorded, whatever state the file is in."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import logging
import re
from typing import TYPE_CHECKING, Any

import can
import numpy as np
import pytest
from conformance.virtual_can_transport import PER_FRAME, layout
from support.bus_tables import replay_bus, table_layout
from support.examples import first_of

from daqsvc.acquisition.clock import NS_PER_S, DrivenClock
from daqsvc.settings import load_machine_file
from drivers.base import BusPort, StreamSpec
from drivers.frames import FrameLayout
from drivers.make import bus_drivers
from drivers.replay.driver import ReplayDriver
from drivers.replay.growing import candump_log

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import SampleBlock

pytestmark = pytest.mark.integration
RATE_HZ = 1000.0
FRAMES = 120
FRAME_S = PER_FRAME / RATE_HZ
EPOCH_S = 1_640_995_200.0


def messages(frames: int = FRAMES, sign: int = 1, channel: int = 1) -> list[can.Message]:
    number = np.arange(frames * PER_FRAME).reshape(frames, PER_FRAME)
    samples = np.stack([sign * (number % 30_000), -(number % 7)], axis=2).astype(np.float32)
    payloads = layout().encode(PER_FRAME * np.arange(frames), samples)
    return [
        can.Message(
            timestamp=EPOCH_S + k * FRAME_S,
            arbitration_id=0x101,
            is_extended_id=False,
            is_fd=True,
            bitrate_switch=True,
            data=payload.tobytes(),
            channel=channel,
        )
        for k, payload in enumerate(payloads)
    ]


def write(path: Path, what: list[can.Message]) -> Path:
    with can.Logger(path) as logger:
        for message in what:
            logger.on_message_received(message)
    return path


class Played:
    """A driver that plays a file in simulated time."""

    def __init__(self, path: Path, streams: list[StreamSpec[Any]] | None = None, **options: Any) -> None:
        self.clock = DrivenClock()
        self.blocks: list[SampleBlock] = []
        spec: list[StreamSpec[Any]] = streams or [StreamSpec("shaft", layout(), RATE_HZ)]
        port = BusPort("replay", spec, self.clock, self.blocks.append)
        self.driver = ReplayDriver(replay_bus(file=path, **options), port)

    async def to_its_end(self) -> None:
        """Play until the driver has ended by itself."""
        task = asyncio.create_task(self.driver.run())
        async with asyncio.timeout(20):
            while not task.done():
                await self.step()
        await task

    async def until_received(self, samples: int) -> None:
        """Play until so many samples are delivered, and stop."""
        task = asyncio.create_task(self.driver.run())
        try:
            async with asyncio.timeout(20):
                while self.driver.streams["shaft"][0].samples_received < samples:
                    assert not task.done()
                    await self.step()
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task

    async def step(self) -> None:
        if self.clock._sleepers:
            self.clock.advance_to(self.clock.monotonic_ns() + NS_PER_S // 100)
        await asyncio.sleep(0.0002)

    @property
    def x(self) -> np.ndarray[Any, Any]:
        return np.concatenate([block.samples[:, 0] for block in self.blocks])


@pytest.mark.parametrize("ending", [".log", ".asc", ".blf", ".log.gz"])
async def test_every_format_plays_as_it_was_recorded(tmp_path: Path, ending: str) -> None:
    path = write(tmp_path / f"run{ending.removesuffix('.gz')}", messages())
    if ending.endswith(".gz"):
        packed = tmp_path / f"run{ending}"
        packed.write_bytes(gzip.compress(path.read_bytes()))
        path = packed
    played = Played(path)
    begun_ns = played.clock.monotonic_ns()
    await played.to_its_end()
    np.testing.assert_array_equal(played.x, np.arange(FRAMES * PER_FRAME) % 30_000)
    assert played.driver.streams["shaft"][0].samples_lost == 0
    assert played.driver.link.state == "down"
    assert played.driver.link.reason == "end of file"
    took_s = (played.clock.monotonic_ns() - begun_ns) / NS_PER_S
    # A slow machine takes longer; that the times are those of the recording the period below shows.
    assert took_s > (FRAMES - 1) * FRAME_S - 0.1, "not at the pace of the recording"
    # BLF and ASC are written with 10 and 1 microseconds.
    assert played.blocks[-1].period_ns == pytest.approx(1e6, abs=20)


async def test_unpaced_it_does_not_wait(tmp_path: Path) -> None:
    path = write(tmp_path / "run.log", messages(1000))
    played = Played(path, pace="unpaced")
    before_ns = played.clock.monotonic_ns()
    await played.driver.run()
    assert played.clock.monotonic_ns() == before_ns
    np.testing.assert_array_equal(played.x, np.arange(1000 * PER_FRAME) % 30_000)
    assert played.blocks[-1].t_first_ns - played.blocks[0].t_first_ns == pytest.approx(
        (played.blocks[-1].first_index - played.blocks[0].first_index) * 1e6, abs=2000
    )


async def test_the_samples_of_a_log_are_counted_on_when_it_is_played_again(tmp_path: Path) -> None:
    path = write(tmp_path / "run.log", messages())
    played = Played(path, at_end="loop")
    await played.until_received(3 * FRAMES * PER_FRAME)
    counters, time_base = played.driver.streams["shaft"]
    assert played.driver.counters.passes >= 2
    assert (counters.samples_lost, counters.frames_rejected, time_base.restarts) == (0, 0, 0)
    index = np.concatenate([np.arange(block.first_index, block.end_index) for block in played.blocks])
    np.testing.assert_array_equal(np.diff(index), 1)
    np.testing.assert_array_equal(
        played.x[: 3 * FRAMES * PER_FRAME], np.tile(np.arange(FRAMES * PER_FRAME), 3)
    )
    t_ns = np.array([block.t_first_ns for block in played.blocks])
    np.testing.assert_allclose(np.diff(t_ns), np.diff([b.first_index for b in played.blocks]) * 1e6, atol=2e5)


@pytest.mark.long
async def test_the_samples_of_a_table_are_counted_on_when_it_is_played_again(tmp_path: Path) -> None:
    x, y = np.arange(250.0), np.linspace(-1, 1, 250)
    np.savez(tmp_path / "run.npz", probe_x=x, probe_y=y)
    (tmp_path / "run.csv").write_text(
        "no,probe_x,probe_y\n" + "".join(f"{k},{a},{b}\n" for k, (a, b) in enumerate(zip(x, y, strict=True)))
    )
    table = table_layout(("x", "probe_x", 2.0, 1.0), ("y", "probe_y", 1.0, 0.0))
    for name in ("run.npz", "run.csv"):
        played = Played(tmp_path / name, [StreamSpec("shaft", table, 100.0)], at_end="loop")
        await played.until_received(600)
        np.testing.assert_array_equal(played.x[:600], np.tile(2 * x + 1, 3)[:600].astype(np.float32))
        assert played.driver.streams["shaft"][0].samples_lost == 0
        assert played.driver.streams["shaft"][1].restarts == 0


async def test_lines_that_are_no_frames_are_counted_while_a_log_is_written(tmp_path: Path) -> None:
    path = write(tmp_path / "whole.log", messages(9))
    lines = path.read_text().splitlines(keepends=True)
    growing = tmp_path / "growing.log"
    # Some loggers number the channels.
    lines = [line.replace(" can1 ", " 1 ") for line in lines]
    growing.write_text("".join(lines[:3]) + "nonsense\n(x) can0 1#2\n(1.0) can0\n" + lines[3][:30])
    played = Played(growing, at_end="wait")
    task = asyncio.create_task(played.driver.run())
    async with asyncio.timeout(20):
        while played.driver.streams["shaft"][0].frames_received < 3:
            await played.step()
        assert played.driver.counters.frames_malformed == 3
        with growing.open("a") as file:  # the rest of the line that was being written, and more
            file.write(lines[3][30:] + "".join(lines[4:]))
        while played.driver.streams["shaft"][0].frames_received < 9:
            await played.step()
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    np.testing.assert_array_equal(played.x, np.arange(9 * PER_FRAME))
    assert played.driver.counters.frames_malformed == 3


class GrowingLog:
    """A log of 1000 frames that is written line by line while it is played."""

    def __init__(self, folder: Path) -> None:
        self._lines = write(folder / "whole.log", messages(1000)).read_text().splitlines(keepends=True)
        self._path = folder / "growing.log"
        self._path.touch()
        self._written = 0
        self.played = Played(self._path, at_end="wait")
        self._begun_ns = self.played.clock.monotonic_ns()

    def log(self, *, clock_off_s: float = 0.0) -> None:
        """Write the frames that the device has sent by now, stamped by a clock that is off by so much."""
        now_ns = self.played.clock.monotonic_ns()
        sent = (now_ns - self._begun_ns) * round(RATE_HZ) // NS_PER_S // PER_FRAME
        with self._path.open("a") as file:
            for line in self._lines[self._written : sent]:
                seconds, rest = line[1:].split(")", 1)
                file.write(f"({float(seconds) + clock_off_s:.6f}){rest}")
        self._written = sent

    async def play(self, seconds: float, *, clock_off_s: float = 0.0) -> None:
        """Let it be written and played for a while."""
        until_ns = self.played.clock.monotonic_ns() + round(seconds * NS_PER_S)
        async with asyncio.timeout(20):
            while self.played.clock.monotonic_ns() < until_ns:
                self.log(clock_off_s=clock_off_s)
                await self.played.step()
            while self.played.driver.streams["shaft"][0].frames_received < self._written:
                await self.played.step()

    def lateness_s(self) -> NDArray[np.float64]:
        """How late each block is by its time stamp, against when its device has sampled it."""
        blocks = self.played.blocks
        t_ns = np.array([block.t_first_ns - self._begun_ns for block in blocks])
        return t_ns / NS_PER_S - np.array([block.first_index for block in blocks]) / RATE_HZ


async def test_a_growing_log_that_is_read_late_keeps_its_times(tmp_path: Path) -> None:
    log = GrowingLog(tmp_path)
    task = asyncio.create_task(log.played.driver.run())
    await log.play(1.0)
    # The process stands still, and the log is written on.
    log.played.clock.advance_to(log.played.clock.monotonic_ns() + 3 * NS_PER_S)
    await log.play(1.0)
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    counters, time_base = log.played.driver.streams["shaft"]
    assert (counters.samples_lost, counters.frames_rejected, time_base.restarts) == (0, 0, 0)
    np.testing.assert_array_equal(log.played.x, np.arange(len(log.played.x)))
    assert np.ptp(log.lateness_s()) < 0.06


@pytest.mark.parametrize("step_s", [-3600.0, -5.0, 5.0, 3600.0])
async def test_a_growing_log_is_played_on_when_its_clock_is_set(tmp_path: Path, step_s: float) -> None:
    log = GrowingLog(tmp_path)
    task = asyncio.create_task(log.played.driver.run())
    await log.play(1.0)
    await log.play(1.0, clock_off_s=step_s)
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    counters, time_base = log.played.driver.streams["shaft"]
    assert (counters.samples_lost, counters.frames_rejected, time_base.restarts) == (0, 0, 0)
    assert np.ptp(log.lateness_s()) < 0.12


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.blf", b"no BLF", "a.blf cannot be read as a CAN log"),
        ("a.xyz", b"", "a.xyz cannot be read as a CAN log: No read support for unknown log format"),
        ("a.db", b"", "a data base cannot be played, can_logconvert of python-can makes a BLF of it"),
        ("a.npz", b"no zip", "a.npz cannot be read: it is not a zip archive"),
        ("a.csv", b"p,q\n1,2\n3,4\n", "a.csv has no channel 'x'; it holds p (2), q (2)"),
        ("a.csv", b"x,y\n1,two\n", "a.csv is not numeric; it holds x (1), y (not numeric)"),
        ("a.log", None, "there is no file"),
    ],
)
async def test_a_file_that_cannot_be_read_is_a_bus_that_cannot_be_opened(
    tmp_path: Path, name: str, content: bytes | None, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    table = table_layout(("x", "x", 1.0, 0.0), ("y", "y", 1.0, 0.0))
    is_table = name.endswith((".csv", ".npz"))
    played = Played(
        tmp_path / name, [StreamSpec("shaft", table if is_table else layout(), RATE_HZ)], at_end="loop"
    )
    task = asyncio.create_task(played.driver.run())
    with caplog.at_level(logging.WARNING):
        async with asyncio.timeout(20):
            while played.driver.counters.open_failures < 3:
                await played.step()
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    assert said in played.driver.link.reason
    assert len(caplog.records) == 1, "it is said once, not at every try"


def damaged(path: Path) -> Path:
    """A log whose last third is gone, as after a power failure."""
    whole = path.read_bytes()
    path.write_bytes(whole[: 2 * len(whole) // 3])
    return path


def zipped(path: Path) -> Path:
    packed = path.with_suffix(f"{path.suffix}.gz")
    packed.write_bytes(gzip.compress(path.read_bytes()))
    return packed


@pytest.mark.gives("B43")
@pytest.mark.parametrize("name", first_of("run.blf", "run.log.gz", "run.asc.gz"))
@pytest.mark.parametrize("at_end", ["stop", "loop"])
async def test_what_is_left_of_a_damaged_log_is_played_and_the_damage_said_once(
    tmp_path: Path, name: str, at_end: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = write(tmp_path / name.removesuffix(".gz"), messages(20_000))
    path = damaged(zipped(path) if name.endswith(".gz") else path)
    played = Played(path, at_end=at_end, pace="unpaced")
    counters = played.driver.counters
    if at_end == "stop":
        await played.to_its_end()
        assert counters.passes_damaged == 1
        assert "damaged behind frame" in played.driver.link.reason
    else:
        task = asyncio.create_task(played.driver.run())
        async with asyncio.timeout(60):
            while counters.passes_damaged < 3:
                await asyncio.sleep(0.01)
                assert played.driver.link.losses == 0
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
    assert (counters.passes, counters.reader_failures) == (0, 0)
    stream, time_base = played.driver.streams["shaft"]
    assert stream.frames_received > 1000
    assert (stream.samples_lost, stream.frames_duplicate, time_base.restarts) == (0, 0, 0)
    said = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(said) == 1
    assert "is damaged behind frame" in said[0]


@pytest.mark.parametrize("ending", [".log", ".asc", ".trc"])
async def test_a_line_that_is_no_frame_is_counted_and_costs_itself_alone(
    tmp_path: Path, ending: str, caplog: pytest.LogCaptureFixture
) -> None:
    sent = [
        can.Message(
            timestamp=EPOCH_S + k / 100, arbitration_id=0x101, is_extended_id=False, data=[k, 0, k, 0]
        )
        for k in range(100)
    ]
    path = write(tmp_path / f"run{ending}", sent)
    lines = path.read_text().splitlines(keepends=True)
    frames = [k for k, line in enumerate(lines) if re.search(" 0*101[ #]", line)]
    assert len(frames) == 100
    # The first frame, two in a row, and the last one, which has lost half a byte.
    bad = [frames[0], frames[50], frames[51], frames[99]]
    for k in bad[:-1]:
        lines[k] = re.sub(" 0*101([ #])", r" Z0Z\1", lines[k])
    lines[bad[-1]] = ("6" if ending == ".log" else "6Q").join(lines[bad[-1]].rsplit("63", 1))
    path.write_text("".join(lines))
    plain = FrameLayout.plain(
        frame_id=0x101,
        length=4,
        channels=[("x", 16, "unsigned", 1.0, 0.0)],
        samples_per_frame=1,
        counter_byte=0,
        counter_bits=16,
        first_byte=2,
    )
    played = Played(path, [StreamSpec("shaft", plain, 100.0)], pace="unpaced")
    await played.to_its_end()
    assert played.driver.counters.frames_malformed == len(bad)
    assert played.driver.link.reason == "end of file"
    lost = {0, 50, 51, 99}
    np.testing.assert_array_equal(played.x, [k for k in range(100) if k not in lost])
    said = [record.getMessage() for record in caplog.records if "is no frame" in record.getMessage()]
    assert len(said) == 1
    assert f"line {bad[0] + 1}, " in said[0]


class FussyReader(can.io.generic.MessageReader):
    """A reader of a plugin, whose file can only be closed by the thread that has opened it."""

    def __init__(self, file: object, **_: object) -> None:
        self._messages = messages()

    def __iter__(self) -> Iterator[can.Message]:
        return iter(self._messages)

    def stop(self) -> None:
        raise RuntimeError("closed in another thread")


async def test_a_reader_that_cannot_be_closed_takes_nothing_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(can.io.MESSAGE_READERS, ".fussy", FussyReader)
    (tmp_path / "run.fussy").touch()
    played = Played(tmp_path / "run.fussy")
    await played.to_its_end()
    assert played.driver.link.reason == "end of file"
    assert len(played.x) == FRAMES * PER_FRAME


def two_channels(path: Path) -> Path:
    """Twins on two buses: the same ids and counters, other values."""
    pairs = zip(messages(sign=-1, channel=0), messages(channel=1), strict=True)
    return write(path, [message for pair in pairs for message in pair])


@pytest.mark.parametrize(
    ("ending", "first", "second"), [(".log", "can0", "can1"), (".asc", "1", "2"), (".blf", "1", "2")]
)
async def test_one_channel_of_a_log_is_played_and_others_are_said_once(
    tmp_path: Path, ending: str, first: str, second: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = two_channels(tmp_path / f"run{ending}")
    for channel, said in ((None, second), (first, second), (second, first)):
        caplog.clear()
        options = {} if channel is None else {"channel": channel}
        played = Played(path, pace="unpaced", at_end="stop", **options)
        await played.to_its_end()
        counters = played.driver.streams["shaft"][0]
        assert (counters.frames_received, counters.frames_duplicate, counters.samples_lost) == (FRAMES, 0, 0)
        assert played.driver.counters.frames_other_channel == FRAMES
        np.testing.assert_array_equal(np.sign(played.x[1:]), 1 if channel == second else -1)
        [message] = [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING]
        assert f"the log has frames of channel {said} too" in message


async def test_a_channel_that_the_log_does_not_have_is_told_with_those_it_has(tmp_path: Path) -> None:
    path = two_channels(tmp_path / "run.log")
    played = Played(path, channel="can2")
    await played.to_its_end()
    assert not played.blocks
    assert played.driver.link.reason == (
        "it has no frame of channel 'can2'; write another of its channels as channel: can0, can1"
    )


async def test_a_machine_file_replays_a_table_in_the_units_of_its_sensors(tmp_path: Path) -> None:
    volts = np.linspace(-8.0, -10.0, 64)
    np.savez(tmp_path / "gap.npz", probe_v=volts)
    (tmp_path / "machine.toml").write_text(
        """
schema_version = 1
site = "lab"
box = "edge-1"

[machine]
name = "replayed"
speed_rpm = 600.0

[buses.tape]
driver = "replay"
file = "gap.npz"
pace = "unpaced"

[streams.shaft]
bus = "tape"
rate_hz = 640.0
layout = { columns = [{ name = "x", column = "probe_v" }] }

[[sensors]]
name = "probe-x"
type = "proximity"
stream = "shaft"
channel = "x"
unit = "um"
sensitivity_mv_per_unit = -7.87
gap_ok_v = [-18.0, -2.0]
angle_deg = 45.0
"""
    )
    machine = load_machine_file(tmp_path / "machine.toml")
    blocks: list[SampleBlock] = []
    [driver] = bus_drivers(machine, DrivenClock(), blocks.append)
    await driver.run()
    got = np.concatenate([block.samples[:, 0] for block in blocks])
    np.testing.assert_allclose(got, volts / -7.87e-3, rtol=1e-6)


def test_what_candump_wrote_is_read_and_the_rest_counted() -> None:
    text = (
        "(1.000001) can0 123#0102\n\n(nan) can0 123#\n(2) vcan0 123##0"
        + "11" * 65
        + "\n(3.0) can0 12345678#R4\n"
    )
    log = candump_log(text)
    assert [(m.arbitration_id, bytes(m.data), m.is_remote_frame) for m in log] == [
        (0x123, b"\x01\x02", False),
        (0x12345678, b"", True),
    ]
    assert log.malformed == 2
    assert (log.first_malformed_at, log.first_malformed) == (3, "'(nan) can0 123#'")
