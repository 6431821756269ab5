"""``analyze`` of a recording with streams of several rates: each is judged by the detectors that read it."""

from __future__ import annotations

import re

import can
import numpy as np
import pytest
from support.snapshot_files import Sampled, write_snapshot

from daqsvc.cli import main
from daqsvc.settings import load_machine_file
from drivers.can.plugin import frame_layout

pytestmark = pytest.mark.integration
EPOCH_S = 1_700_000_000.0
FAST_HZ = 1600.0
SLOW_HZ = 10.0
SECONDS = 4
ACCELERATION_G = np.sin(2 * np.pi * 50.0 * np.arange(int(SECONDS * FAST_HZ)) / FAST_HZ)
TEMPERATURE = 60.0 + np.arange(int(SECONDS * SLOW_HZ)) / 4
PRESSURE = np.full(int(SECONDS * SLOW_HZ) - 1, 2.0)
SENSORS = ["accel", "oil-temp", "oil-press"]


def stream(name, rate_hz, frame_id, samples):
    return f"""
[streams.{name}]
bus = "main"
rate_hz = {rate_hz}

[streams.{name}.layout]
id = {frame_id}
length = 64
counter = {{ byte = 0, bits = 16, counts = "samples" }}
first_byte = 2
samples_per_frame = {samples}
channels = [{{ name = "{name}", type = "float32", scale = 1.0 }}]
"""


@pytest.fixture
def machine(tmp_path):
    path = tmp_path / "gearbox.toml"
    path.write_text(
        f"""
schema_version = 1
site = "plant"
box = "edge-1"

[machine]
name = "gearbox"
speed_rpm = 1480.0

[buses.main]
driver = "can"
interface = "socketcan"
channel = "can0"
fd = true
bitrate = 500000
data_bitrate = 2000000
{stream("temp", SLOW_HZ, 1, 1)}
{stream("press", SLOW_HZ, 2, 1)}
{stream("accel", FAST_HZ, 3, 10)}
[[sensors]]
name = "oil-temp"
type = "trend"
stream = "temp"
channel = "temp"
unit = "degC"

[[sensors]]
name = "oil-press"
type = "trend"
stream = "press"
channel = "press"
unit = "bar"

[[sensors]]
name = "accel"
type = "accelerometer"
stream = "accel"
channel = "accel"
unit = "g"

[pipeline.levels]
window_s = 0.5
velocity_band_hz = [10.0, 640.0]

[[alarms]]
name = "hot"
sensor = "oil-temp"
measure = "value"
alert = 65.0
danger = 95.0
"""
    )
    return path


@pytest.fixture
def log(machine, tmp_path):
    """The vibration, a temperature and a pressure, as `daqsvc record` writes them."""
    path, sent = tmp_path / "g.blf", []
    for name, values in (("temp", TEMPERATURE), ("press", PRESSURE), ("accel", ACCELERATION_G)):
        layout = frame_layout(load_machine_file(machine), name)
        rate_hz, n = load_machine_file(machine).streams[name].rate_hz, layout.samples_per_frame
        blocks = values.reshape(-1, n, 1).astype(np.float32)
        payloads = layout.encode(np.arange(len(blocks)) * n % 2**16, blocks)
        sent += [
            can.Message(
                timestamp=EPOCH_S + (k + 1) * n / rate_hz,
                arbitration_id=layout.frame_id,
                is_extended_id=False,
                is_fd=True,
                data=payload.tobytes(),
            )
            for k, payload in enumerate(payloads)
        ]
    with can.Logger(path) as logger:
        for message in sorted(sent, key=lambda one: one.timestamp):
            logger.on_message_received(message)
    return path


def check(found):
    levels = found["detectors"]
    assert {f"levels/{name}" for name in SENSORS} == set(levels)
    assert levels["levels/accel"]["statistics"]["rms"] == pytest.approx(np.sqrt(0.5), rel=0.02)
    assert levels["levels/oil-press"]["statistics"]["value"] == 2.0
    assert levels["levels/oil-temp"]["decision"] == "alert"
    assert levels["levels/oil-temp"]["history"][-1]["seconds"] == pytest.approx(2.2, abs=0.3)
    assert set(found["data_quality"]["missing"]) == set(SENSORS)
    assert found["data_quality"]["samples"] == len(ACCELERATION_G)
    assert found["data_quality"]["problems"] == []


@pytest.mark.parametrize("suffix", [".blf", ".mf4", ".mat", ".uff"])
def test_every_stream_of_a_can_log_and_of_its_export_is_judged(analyze, machine, log, suffix, capsys):
    recording = log.with_suffix(suffix)
    if suffix != ".blf":
        assert main(["export", str(machine), str(log), "--to", str(recording)]) == 0
    capsys.readouterr()
    code, (found,), err = analyze(machine, recording)
    assert (code, err) == (0, "")
    check(found)


def test_every_stream_of_a_snapshot_is_judged(analyze, machine, tmp_path):
    streams = {
        "temp": Sampled(SLOW_HZ, {"oil-temp": "degC"}, TEMPERATURE[:, None]),
        "press": Sampled(SLOW_HZ, {"oil-press": "bar"}, PRESSURE[:, None]),
        "accel": Sampled(FAST_HZ, {"accel": "g"}, ACCELERATION_G[:, None]),
    }
    snapshot = write_snapshot(tmp_path / "g.mcap", streams, round(EPOCH_S * 1e9))
    code, (found,), err = analyze(machine, snapshot)
    assert (code, err) == (0, "")
    check(found)


def test_channels_at_another_rate_than_the_machine_file_states_are_left_out_with_the_reason(
    analyze, machine, tmp_path
):
    table = tmp_path / "g.npz"
    np.savez(table, fs=FAST_HZ, accel=ACCELERATION_G, temp=TEMPERATURE)
    code, (found,), err = analyze(machine, table)
    assert (code, err) == (0, "")
    assert set(found["detectors"]) == {"levels/accel"}
    [problem] = found["data_quality"]["problems"]
    assert re.match(r"left out oil-temp: the rate is 1600 Hz by the file and 10 Hz by .*; correct", problem)
