"""A running service whose samples get lost, or come in blocks: what its alarms then do, and do not."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import can
import numpy as np
import pytest
from support.live_service import running, watch_of
from support.machine_files import MACHINES
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.settings import parse_machine_file
from drivers.can.plugin import frame_layout
from drivers.make import stream_layout
from sim_hw.link_faults import LinkFaults
from sim_hw.nodes.can_node import CanNode
from sim_hw.nodes.modbus_node import ModbusTcpServer, PlannedReply
from sim_hw.nodes.modbus_unit import ModbusUnit, WaveformStore, encode
from sim_hw.nodes.pacing import RealTimePacer

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.service import Service

pytestmark = pytest.mark.integration
MOTOR = MACHINES / "motor-accelerometer.toml"
RATE_HZ = 12_000.0
PER_FRAME = 30
LIMIT_MM_S = 4.0
ALARM = f"""
[[alarms]]
name = "velocity"
sensor = "accel-de"
measure = "velocity_rms"
alert = {LIMIT_MM_S}
"""


class Heard:
    """What the detectors of a service say, and the alarms' events that follow."""

    def __init__(self, service: Service) -> None:
        self.said = []
        self.events = []
        manager, take = service.alarms.manager, service.alarms.manager.take

        def heard(diagnosis):
            events = take(diagnosis)
            self.said.append(diagnosis)
            self.events += [(event.alarm, event.kind.value) for event in events]
            return events

        manager.take = heard


def vibration_g(mm_s, first, count, rate_hz=RATE_HZ):
    """A 1X of 50 Hz of so much velocity RMS, under noise of a tenth of its acceleration."""
    amplitude_g = np.sqrt(2.0) * mm_s / 1000.0 * 2 * np.pi * 50.0 / 9.80665
    t = np.arange(first, first + count) / rate_hz
    noise = np.random.default_rng(first).normal(scale=0.1 * amplitude_g, size=count)
    return (amplitude_g * np.sin(2 * np.pi * 50.0 * t) + noise)[:, np.newaxis]


@pytest.mark.long
async def test_a_live_alert_does_not_return_while_frames_are_lost(tmp_path: Path) -> None:
    text = MOTOR.read_text().partition("[[alarms]]")[0] + ALARM
    text = text.replace('interface = "socketcan"', 'interface = "virtual"').replace('"can0"', '"lossy"', 1)
    text = text.replace('channel = "can0"', 'channel = "lossy"').replace('bus = "lossy"', 'bus = "can0"')
    text = text.replace("window_s = 0.5", "window_s = 0.2")
    machine = parse_machine_file(text, MOTOR)
    layout = frame_layout(machine, "drive-end")
    # Loud, and as loud while 30 % of the frames are lost, and quiet while they are, and quiet.
    parts = [(1.15, 0.0, 0.8), (1.15, 0.3, 1.6), (0.5, 0.3, 0.8), (0.5, 0.0, 0.8)]
    lossy_from = lossy_to = 0
    async with running(machine, tmp_path / "store") as service:
        heard = Heard(service)
        await eventually(lambda: service.drivers[0].link.state == "up", "the bus is up")
        first = 0
        with can.Bus(interface="virtual", channel="lossy", protocol=can.CanProtocol.CAN_FD) as bus:
            for part, (loudness, drop, seconds) in enumerate(parts):
                count = round(seconds * RATE_HZ / PER_FRAME) * PER_FRAME
                samples = vibration_g(loudness * LIMIT_MM_S, first, count)
                node = CanNode(bus, layout, samples, RATE_HZ, faults=LinkFaults(drop=drop), first_index=first)
                await node.play(RealTimePacer(SystemClock()))
                lossy_from, lossy_to = (
                    (first if part == 1 else lossy_from),
                    (first if part == 3 else lossy_to),
                )
                first += count
        await eventually(lambda: heard.said and heard.said[-1].end_index >= first - 2400, "all is judged")
        counters = service.drivers[0].streams["drive-end"][0]
        assert counters.samples_lost > 0.2 * (lossy_to - lossy_from)
    assert [event for event in heard.events if event[0] == "velocity"] == [
        ("velocity", "raised"),
        ("velocity", "returned"),
    ]
    assert ("sensor-ok/accel-de", "raised") in heard.events
    lossy = [d for d in heard.said if d.first_index >= lossy_from and d.end_index <= lossy_to]
    assert len(lossy) >= 10
    assert {(d.quality, d.decision) for d in lossy} == {("missing", "alert")}
    assert np.mean([d.missing_share for d in lossy]) == pytest.approx(0.3, abs=0.06)


WAVEFORMS = """
schema_version = 1
site = "lab"
box = "edge-1"
[machine]
name = "pump"
speed_rpm = 3000.0
[buses.io]
driver = "modbus"
transport = "tcp"
host = "127.0.0.1"
tcp_port = {port}
writes = [{{ unit = 1, address = 99 }}]
[streams.casing]
bus = "io"
rate_hz = 3200.0
[streams.casing.layout]
way = "waveform"
unit = 1
block_id = 0
address = 100
samples = 640
trigger = {{ address = 99, every_s = {every_s} }}
channels = [{{ name = "x", place = 0, type = "int16", scale = 0.0005 }}]
[[sensors]]
name = "accel-de"
type = "accelerometer"
stream = "casing"
channel = "x"
unit = "g"
[pipeline.levels]
window_s = 0.5
"""


@pytest.mark.long
async def test_waveforms_of_a_device_that_is_asked_now_and_then_are_judged_block_by_block(
    tmp_path: Path,
) -> None:
    every_s, count = 0.6, 640
    written_s: list[float] = []

    def plan(_unit: int, pdu: bytes) -> PlannedReply:
        if pdu[0] == 16:
            written_s.append(time.monotonic())
        return PlannedReply()

    unit = ModbusUnit()
    server = ModbusTcpServer({1: unit}, plan)
    await server.start()
    text = WAVEFORMS.format(port=server.port, every_s=every_s) + ALARM
    machine = parse_machine_file(text, tmp_path / "machine.toml")
    layout = stream_layout(machine, "casing")
    store = WaveformStore(unit, layout)
    async with running(machine, tmp_path / "store") as service:
        heard = Heard(service)
        for taken in range(7):
            await eventually(lambda taken=taken: len(written_s) > taken, "a block is asked for")
            samples = vibration_g(1.15 * LIMIT_MM_S, taken * count, count, 3200.0)
            store.put(taken * count, encode(layout, samples))
        await eventually(lambda: len(heard.said) == 7, "all blocks are judged")
        counters = service.drivers[0].streams["casing"][0]
        assert (counters.samples_received, counters.samples_lost) == (7 * count, 0)
        assert watch_of(service).rings["casing"].end_index > 6 * every_s * 3200.0
    server.stop()
    # Never sooner than it reads, but for the grain of the clock.
    assert np.diff(written_s).min() > every_s - 0.05
    assert {(d.quality, d.end_index - d.first_index) for d in heard.said} == {("good", count)}
    velocity = [d.statistics["velocity_rms"] for d in heard.said]
    assert velocity == pytest.approx([1.15 * LIMIT_MM_S] * 7, rel=0.03)
    assert heard.events == [("velocity", "raised")]
