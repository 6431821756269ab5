"""Recordings whose time stamps cannot be: each is one sentence, and nothing waits for it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.bus_tables import replay_bus
from support.waiting import eventually

from daqsvc.acquisition.clock import DrivenClock
from drivers.base import BusPort, StreamSpec
from drivers.frames import FrameLayout
from drivers.replay.driver import ReplayDriver

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.integration
LAYOUT = FrameLayout.plain(
    frame_id=0x101,
    length=4,
    channels=[("x", 16, "signed", 1.0, 0.0)],
    samples_per_frame=1,
    counter_byte=0,
    counter_bits=16,
    first_byte=2,
)
FRAMES = 300


async def play(path: Path, pace: str = "recorded") -> ReplayDriver:
    clock = DrivenClock()
    bus = replay_bus(file=path, at_end="stop", pace=pace)
    driver = ReplayDriver(bus, BusPort("tape", [StreamSpec("s", LAYOUT, 100.0)], clock, lambda _: None))
    task = asyncio.create_task(driver.run())

    async def pass_time() -> None:
        while True:
            clock.advance_to(clock.monotonic_ns() + 20_000_000)
            await asyncio.sleep(0.0005)

    passing = asyncio.create_task(pass_time())
    try:
        await eventually(lambda: bool(driver.link.reason))
    finally:
        for one in (task, passing):
            one.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await one
    return driver


def log(path: Path, stamps: list[str]) -> Path:
    lines = [f"({t}) can0 101#{(k % 65536).to_bytes(2, 'little').hex()}0100" for k, t in enumerate(stamps)]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    "stamp", ["9999999999.000000", "99999999999999999999.0", "nan", "-9999999999.0", "inf"]
)
async def test_a_time_that_cannot_be_costs_its_line(
    stamp: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stamps = [f"{1.7e9 + k / 100:.6f}" for k in range(FRAMES)]
    stamps[100] = stamp
    with caplog.at_level(logging.WARNING):
        driver = await play(log(tmp_path / "run.log", stamps))
    assert driver.link.reason == "end of file"
    assert (driver.counters.frames_malformed, driver.counters.reader_failures) == (1, 0)
    counters, _ = driver.streams["s"]
    assert (counters.samples_received, counters.samples_lost) == (FRAMES - 1, 1)
    assert len([r for r in caplog.records if "no frame" in r.message]) == 1


@pytest.mark.parametrize("leap_s", [8e8, -8e8, -1.7e9, 86_400.0])
@pytest.mark.parametrize("pace", ["recorded", "unpaced"])
async def test_a_leap_in_time_is_said_once_and_played_over(
    leap_s: float, pace: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    times = 1.7e9 + np.arange(FRAMES) / 100
    times[100] += leap_s
    times[200:] += leap_s
    with caplog.at_level(logging.WARNING):
        driver = await play(log(tmp_path / "run.log", [f"{t:.6f}" for t in times]), pace)
    assert driver.link.reason == "end of file"
    assert driver.counters.time_leaps >= 2
    assert driver.counters.reader_failures == 0
    counters, _ = driver.streams["s"]
    assert counters.frames_received == FRAMES
    assert counters.samples_received + counters.frames_rejected == FRAMES
    assert len([r for r in caplog.records if "time stamps leap" in r.message]) == 1


async def test_a_log_of_nothing_but_impossible_times_ends(tmp_path: Path) -> None:
    driver = await play(log(tmp_path / "run.log", ["9999999999.000000"] * 50))
    assert driver.link.reason == "end of file"
    assert driver.counters.frames_malformed == 50
