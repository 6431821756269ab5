"""A vibration and temperature sensor on a serial line, read by the service: its alarms come and go."""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct
import sys

import numpy as np
import pytest
from support.live_service import running, watch_of
from support.machine_files import MACHINES, changed
from support.waiting import PATIENCE_S, eventually

from daqsvc.alarms.states import AlarmState, Level
from daqsvc.alarms.status import AlarmStatus
from daqsvc.settings import load_machine_file
from sim_hw.nodes.modbus_node import ModbusRtuServer, PlannedReply
from sim_hw.nodes.modbus_unit import ModbusUnit

pytestmark = pytest.mark.integration
PUMP = MACHINES / "modbus-vibration-temperature.toml"
AXIAL, RADIAL, TEMPERATURE = 17, 21, 19
UNHEARD = AlarmStatus(AlarmState.NORMAL, Level.NORMAL, None, None, "")


def pump(folder):
    """The pump on a line of this test, ten values a second and short delays; and the place of that line."""
    link = folder / "ttyUSB0"
    text, _ = changed(
        PUMP,
        ("/dev/ttyUSB0", str(link)),
        ("timeout_ms = 500.0", "timeout_ms = 200.0\ndemotion_s = 0.2"),
        ("[pipeline.levels]", "[pipeline.levels]\nwindow_s = 0.1\n"),
    )
    for old, new in [("rate_hz = 1.0", "rate_hz = 10.0"), ("on_delay_s = 5.0", "on_delay_s = 0.2")]:
        text = text.replace(old, new)
    for delay in ("on_delay_s = 10.0", "off_delay_s = 10.0"):
        text = text.replace(delay, delay.replace("10.0", "0.3"))
    path = folder / "pump.toml"
    path.write_text(text, encoding="utf-8")
    return load_machine_file(path), link


class Sensor:
    """The two sensors of the pump, set by hand; silent when they are told to be."""

    def __init__(self, link):
        self.unit = ModbusUnit()
        self.unit.map("holding", 0, 64)
        self.silent = False
        self._server = ModbusRtuServer({1: self.unit}, link, self._plan)

    def _plan(self, unit, pdu):
        return PlannedReply("silent") if self.silent else PlannedReply()

    def set(self, address, value, scale):
        self.unit.put("holding", address, struct.pack(">h", round(value / scale)))

    def shake(self, velocity_mm_s, address=RADIAL):
        self.set(address, velocity_mm_s, 0.001)

    def heat(self, temperature_deg_c):
        self.set(TEMPERATURE, temperature_deg_c, 0.05)

    @contextlib.contextmanager
    def plugged_in(self):
        self._server.start()
        try:
            yield self
        finally:
            self._server.stop()


@contextlib.asynccontextmanager
async def watched(folder):
    """The sensors, and how the alarms stand that the service makes of them."""
    machine, link = pump(folder)
    sensor = Sensor(link)
    sensor.shake(1.2)
    sensor.heat(45.0)
    sensor.unit.put("holding", 35, struct.pack(">h", 900))
    with sensor.plugged_in():
        async with running(machine, folder / "store") as service:
            manager = service.alarms.manager
            counters = watch_of(service).pipeline.counters["trends/drive-end"]
            await eventually(lambda: counters.windows > 0, "the first value is judged")
            yield sensor, lambda name: manager.alarms.get(name, UNHEARD)


async def test_an_alarm_comes_and_goes_with_the_velocity(tmp_path):
    async with watched(tmp_path) as (sensor, alarm):
        assert alarm("de-vibration").level is Level.NORMAL
        sensor.shake(3.1)
        await eventually(lambda: alarm("de-vibration").level is Level.ALERT, "alert at 3.1 mm/s")
        assert alarm("de-vibration").first_out
        assert "value of de-radial is 3.1 mm/s, alert limit 2.8 mm/s" in alarm("de-vibration").message
        sensor.shake(7.5, AXIAL)
        await eventually(lambda: alarm("de-vibration").level is Level.DANGER, "danger at 7.5 mm/s")
        sensor.shake(1.0, AXIAL)
        sensor.shake(2.7)  # below the setpoint, but not below its deadband
        await eventually(lambda: alarm("de-vibration").level is Level.ALERT, "no danger any more")
        sensor.shake(1.2)
        await eventually(
            lambda: alarm("de-vibration").state is AlarmState.RETURNED_UNACKNOWLEDGED, "all is well again"
        )
        assert alarm("nde-vibration").since is None
        assert alarm("de-temperature").since is None


@pytest.mark.long
async def test_a_dead_unit_raises_quality_and_clears_nothing(tmp_path):
    async with watched(tmp_path) as (sensor, alarm):
        sensor.shake(3.1)
        await eventually(lambda: alarm("de-vibration").level is Level.ALERT, "alert at 3.1 mm/s")
        sensor.silent = True
        sensor.shake(1.2)
        names = [f"sensor-ok/{end}-{what}" for end in ("de", "nde") for what in ("radial", "temperature")]
        await eventually(
            lambda: all(alarm(name).level is Level.ALERT for name in names),
            "every sensor of the unit is missed",
        )
        message = alarm("sensor-ok/de-radial").message
        assert "no samples of stream 'drive-end': no unit answers; the last one asked: unit " in message
        assert "has not answered within 200 ms" in message
        assert alarm("de-vibration").state is AlarmState.ACTIVE_UNACKNOWLEDGED
        sensor.silent = False
        await eventually(
            lambda: alarm("de-vibration").state is AlarmState.RETURNED_UNACKNOWLEDGED,
            "the unit is back, and its values are good",
        )
        await eventually(
            lambda: all(alarm(name).level is Level.NORMAL for name in names), "nothing is missed any more"
        )


async def test_a_temperature_leaves_its_window_both_ways_and_a_broken_sensor_says_nothing(tmp_path):
    async with watched(tmp_path) as (sensor, alarm):
        sensor.heat(81.0)
        await eventually(lambda: alarm("de-temperature").level is Level.ALERT, "too hot")
        sensor.unit.put("holding", TEMPERATURE, b"\x7f\xff")  # an open sensor: 1638.35 degrees
        await eventually(lambda: alarm("de-temperature").state is AlarmState.SUPPRESSED, "it is not believed")
        assert alarm("de-temperature").own_state is AlarmState.ACTIVE_UNACKNOWLEDGED
        assert "reads 1638.35 degC, outside its OK limits" in alarm("sensor-ok/de-temperature").message
        sensor.heat(45.0)
        await eventually(
            lambda: alarm("de-temperature").state is AlarmState.RETURNED_UNACKNOWLEDGED,
            "it is believed",
        )
        sensor.heat(1.0)
        await eventually(
            lambda: alarm("de-temperature").state is AlarmState.ACTIVE_UNACKNOWLEDGED, "it freezes"
        )
        assert "is 1 degC, lower alert limit 2 degC" in alarm("de-temperature").message


@pytest.mark.long
async def test_the_simulator_plays_a_trend_that_raises_an_alarm_and_returns_it(tmp_path):
    machine, link = pump(tmp_path)
    names = [sensor.name for sensor in machine.sensors]
    trend = np.tile([1.1, 1.2, 45.0, 0.9, 1.0, 40.0], (45, 1))
    trend[10:25, names.index("nde-radial")] = 4.7
    np.savetxt(tmp_path / "trend.csv", trend, fmt="%.3f", delimiter=",", header=",".join(names), comments="")
    playing = ["sim", machine.path, "--recording", tmp_path / "trend.csv", "--fs", "10", "--link", link]
    async with running(machine, tmp_path / "store") as service:
        sim = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "daqsvc", *playing, stdout=asyncio.subprocess.PIPE
        )
        async with asyncio.timeout(PATIENCE_S):
            output, _ = await sim.communicate()
        assert sim.returncode == 0
        assert json.loads(output)["complete"]
        alarm = lambda: service.alarms.manager.alarms["nde-vibration"]  # noqa: E731
        await eventually(
            lambda: alarm().state is AlarmState.RETURNED_UNACKNOWLEDGED, "the alarm has come and gone"
        )
