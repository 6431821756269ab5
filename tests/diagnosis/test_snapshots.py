"""Blocks that were taken by themselves: each is a window of its own, and nothing between them is missing."""

from __future__ import annotations

import asyncio
import re

import numpy as np
import pytest
from support.alarm_rig import AlarmRig
from support.bearing_signals import OUTER, SPEED_RPM, healthy, knocks
from support.bearing_signals import RATE_HZ as BEARING_HZ
from support.machine_files import MACHINES, problems_of

from daqsvc.acquisition.clock import DrivenClock
from daqsvc.acquisition.ring import RingReader, SampleRing
from daqsvc.acquisition.samples import SampleBlock
from daqsvc.alarms.manager import LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.bearing.geometry import bearing_orders
from daqsvc.detectors.bearing.detector import BearingDetector
from daqsvc.detectors.bearing.housed import HousedBearing
from daqsvc.detectors.levels.detector import LevelChannel, LevelDetector
from daqsvc.detectors.levels.trends import TrendChannel, TrendDetector
from daqsvc.diagnosis.detector import Window
from daqsvc.diagnosis.pipeline import Pipeline
from daqsvc.dsp.quality.missing import SILENT_PERIODS, UNKNOWN_NS, Patience
from daqsvc.settings import describe, parse_machine_file

RATE_HZ = 3200.0
PERIOD_NS = 1e9 / RATE_HZ
SAMPLES = 1024
EVERY = 6400
SECOND_NS = 1_000_000_000


def snapshot(k, amplitude=1.0, *, lost=0, samples=SAMPLES):
    """The k-th of blocks of .32 s every 2 s, in m/s2: a 1X of 50 Hz."""
    first = k * EVERY
    t = np.arange(first, first + samples) / RATE_HZ
    values = (amplitude * np.sqrt(2.0) * np.sin(2 * np.pi * 50.0 * t)).astype(np.float32).reshape(-1, 1)
    pause = (EVERY - SAMPLES if k else 0) - lost
    return SampleBlock("s", first, values, round(first * PERIOD_NS), PERIOD_NS, lost, pause_before=pause)


async def test_each_snapshot_is_read_by_itself_whatever_block_a_detector_asks_for():
    ring = SampleRing("s", ("x",), 96_000)
    reader = RingReader(ring)
    chunks = []

    async def follow():
        while len(chunks) < 4:
            chunks.append(await reader.read(1600, 64))

    following = asyncio.create_task(follow())
    for k in range(4):
        ring.write(snapshot(k, lost=SAMPLES if k == 3 else 0))
        await asyncio.sleep(0)
    await following
    assert [chunk.first_index for chunk in chunks] == [0, EVERY, 2 * EVERY, 3 * EVERY]
    for k, chunk in enumerate(chunks):
        np.testing.assert_array_equal(chunk.samples, snapshot(k).samples)
    assert all(chunk.snapshot and not chunk.skipped for chunk in chunks)
    assert (ring.samples_lost, reader.samples_skipped, reader.behind) == (SAMPLES, 0, 0)


async def test_a_reader_that_is_too_slow_misses_whole_snapshots_and_is_told_how_many_samples():
    ring = SampleRing("s", ("x",), EVERY + SAMPLES)
    ring.write(snapshot(0))
    reader = RingReader(ring)
    reader.position = 0
    for k in range(1, 5):
        ring.write(snapshot(k))
    chunk = await reader.read(1600, 64)
    assert (chunk.first_index, chunk.skipped) == (3 * EVERY, 3 * SAMPLES)
    assert reader.samples_skipped == 3 * SAMPLES
    assert (await reader.read(1600, 64)).first_index == 4 * EVERY


def test_a_snapshot_is_measured_whole_whatever_its_length():
    levels = LevelDetector("m", "s", RATE_HZ, [LevelChannel("a", 0, "m/s2")], window_s=0.5)
    trends = TrendDetector("m", "s", RATE_HZ, [TrendChannel("t", 0, "m/s2")], window_s=0.1)
    for samples in (SAMPLES, 5 * SAMPLES, 160):
        values = snapshot(1, samples=samples).samples
        window = Window(EVERY, values, 10**9, PERIOD_NS, snapshot=True)
        (level,) = levels.process(window)
        (trend,) = trends.process(window)
        assert (level.quality, level.end_index - level.first_index) == ("good", samples)
        assert level.statistics["rms"] == pytest.approx(1.0, rel=0.02)
        # The band begins at 10 Hz: in .05 s not all of 50 Hz lies within it.
        tolerance = 0.02 if samples >= SAMPLES else 0.2
        velocity = 1000.0 / (2 * np.pi * 50.0)
        assert level.statistics["velocity_rms"] == pytest.approx(velocity, rel=tolerance)
        assert trend.statistics["value"] == pytest.approx(float(values.mean()), abs=1e-5)


async def wait(clock, seconds):
    for _ in range(round(2 * seconds)):
        clock.advance_to(clock.monotonic_ns() + SECOND_NS // 2)
        for _ in range(3):
            await asyncio.sleep(0)


async def test_snapshots_raise_no_alarm_of_quality_and_the_time_between_them_is_no_silence():
    clock = DrivenClock()
    ring = SampleRing("s", ("x",), 96_000)
    detector = LevelDetector("rig", "s", RATE_HZ, [LevelChannel("a", 0, "m/s2")], window_s=0.5)
    rig = AlarmRig(LevelRule("high", "a", "velocity_rms", Setpoint(alert=4.5)))
    said = []
    pipeline = Pipeline(
        {"s": ring},
        [detector],
        lambda diagnosis: said.append((diagnosis, rig.manager.take(diagnosis))),
        clock,
        patience={"s": Patience(snapshots=True, every_ns=2 * SECOND_NS)},
    )
    running = asyncio.create_task(pipeline.run())
    for k in range(40):
        ring.write(snapshot(k, 2.0 if 10 <= k < 20 else 1.0))
        while len(said) <= k:
            await asyncio.sleep(0.001)
        await wait(clock, 2)
    assert {diagnosis.quality for diagnosis, _ in said} == {"good"}
    assert [(event.alarm, event.kind.value) for _, events in said for event in events] == [
        ("high", "raised"),
        ("high", "returned"),
    ]
    assert len(said) == 40
    await wait(clock, 8)
    silent, _ = said[-1]
    assert (len(said), silent.quality) == (41, "missing")
    ring.close()
    await running


def test_how_often_a_device_takes_blocks_by_itself_is_seen():
    patience = Patience(snapshots=True)
    assert patience.ns == round(SILENT_PERIODS * UNKNOWN_NS)
    for seconds in (5, 600, 580):
        patience.heard_after(seconds * SECOND_NS)
    assert patience.ns == round(SILENT_PERIODS * 600 * SECOND_NS)
    asked = Patience(snapshots=True, every_ns=60 * SECOND_NS)
    asked.heard_after(2 * SECOND_NS)
    assert asked.ns == round(SILENT_PERIODS * 60 * SECOND_NS)
    assert Patience(1e9 / 10).ns == 2 * SECOND_NS


BLOCKS = """
schema_version = 1
site = "lab"
box = "edge-1"
[machine]
name = "pump"
speed_rpm = 3000.0
[buses.io]
driver = "modbus"
transport = "tcp"
host = "192.0.2.1"
[streams.casing]
bus = "io"
rate_hz = 12800.0
[streams.casing.layout]
way = "waveform"
unit = 1
block_id = 0
address = 100
samples = 32000
channels = [{ name = "x", place = 0, type = "int16", scale = 0.0005 }]
[[sensors]]
name = "accel-de"
type = "accelerometer"
stream = "casing"
channel = "x"
unit = "g"
[pipeline.bearing]
bearings = [{ name = "drive-end", sensor = "accel-de", type = "6205-2RS" }]
"""


def test_a_bearing_looks_at_each_block_and_too_short_ones_are_refused(tmp_path):
    path = tmp_path / "machine.toml"
    assert parse_machine_file(BLOCKS, path).streams["casing"].layout.samples == 32_000
    (problem,) = problems_of(BLOCKS.replace("samples = 32000", "samples = 8192"), path)
    assert problem.key == "streams.casing.layout.samples"
    assert "are 0.64 s at 12800 Hz; a bearing is judged by 1.25 s or more" in str(problem)


def test_a_bearing_is_raised_by_two_blocks_that_agree():
    orders = bearing_orders("6205-2RS")
    watch = BearingDetector(
        machine="pump",
        stream="casing",
        rate_hz=BEARING_HZ,
        speed_rpm=SPEED_RPM,
        bearings=[HousedBearing("drive-end", "accel-de", 0, orders)],
        calibrate_s=60.0,
    )
    count = round(2.5 * BEARING_HZ)
    said = []
    for k in range(6):
        samples = healthy(2.5, k) + (knocks(2.5, OUTER, 50 + k, size=0.6) if k > 2 else 0.0)
        first = k * 10 * count
        column = samples.astype(np.float32).reshape(-1, 1)
        said += watch.process(Window(first, column, 10**9 + first, 1e9 / BEARING_HZ, snapshot=True))
    assert [d.quality for d in said] == ["good"] * 6
    assert [d.decision for d in said] == ["normal"] * 4 + ["outer"] * 2
    assert [d.end_index - d.first_index for d in said] == [count] * 6
    (short,) = watch.process(
        Window(100 * count, np.ones((500, 1), np.float32), 10**12, 1e9 / BEARING_HZ, snapshot=True)
    )
    assert (short.quality, short.decision) == ("missing", "outer")
    assert "a block of casing is 0.0417 s long, and a bearing is judged by 1.25 s or more" in short.reason


def test_check_says_that_the_levels_of_blocks_are_those_of_each_block():
    file = MACHINES.parents[1] / "tests" / "guard" / "specimens" / "specimen-modbus.toml"
    levels = "\n[pipeline.levels]\nwindow_s = 0.5\nvelocity_band_hz = [10.0, 40.0]\n"
    machine = parse_machine_file(file.read_text() + levels, file)
    of_blocks = {
        sensor.name
        for sensor in machine.sensors
        if sensor.type != "trend" and machine.streams[sensor.stream].layout.block is not None
    }
    assert of_blocks
    found = re.search(r"over each block of ([^;\n]+)", describe(machine))
    assert found is not None
    assert of_blocks == set(found[1].split(", "))
