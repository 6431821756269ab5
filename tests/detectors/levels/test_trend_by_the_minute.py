"""A value a minute, for hours of simulated time: from the polled register to the alarm."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from types import SimpleNamespace

import pytest
from support.alarm_rig import RIG
from support.bus_tables import modbus_bus
from support.clocks import LoopClock
from support.modbus_layouts import register, registers_layout
from support.modbus_lines import options_of, responding, simulate

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.ring import SampleRing
from daqsvc.alarms.events import EventKind
from daqsvc.alarms.manager import AlarmManager
from daqsvc.alarms.rules import LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.detectors.levels.statements import Limits
from daqsvc.detectors.levels.trends import TrendChannel, TrendDetector
from daqsvc.diagnosis.pipeline import Pipeline
from daqsvc.dsp.quality.missing import Patience
from drivers.base import BusPort, StreamSpec
from drivers.modbus.driver import ModbusDriver
from sim_hw.nodes.modbus_node import PlannedReply
from sim_hw.nodes.modbus_unit import ModbusUnit

pytestmark = pytest.mark.integration
RATE_HZ = 1 / 60
MINUTE_NS = 60 * NS_PER_S
HOT = LevelRule("hot", "oil", "value", Setpoint(alert=80.0, deadband=2.0, on_delay_ns=5 * NS_PER_S))
REGISTERS = registers_layout(1, "holding", [register("oil", 0, "int16")])


class AtOnce:
    """Works while it is asked to, instead of `KernelThreads`: simulated time must not pass meanwhile."""

    def __init__(self, *_):
        pass

    def submit(self, call):
        outcome = asyncio.get_running_loop().create_future()
        outcome.set_result(call())
        return SimpleNamespace(outcome=outcome)

    def enter(self):
        pass

    async def leave(self, _jobs):
        pass


class Oil:
    """The temperature of the oil behind a unit, read once a minute, and the alarms that come of it."""

    def __init__(self):
        self.unit, self.silent, self.events, self._begin_ns = ModbusUnit(), False, [], 0
        ring = SampleRing("trend", ("oil",), 16)
        port = BusPort(
            "mb",
            [StreamSpec("trend", REGISTERS, RATE_HZ)],
            LoopClock(),
            ring.write,
            "retry",
        )
        self._driver = ModbusDriver(modbus_bus(**options_of(serial=True, timeout_ms=500.0)), port)
        channel = TrendChannel("oil", 0, "degC", [Limits("value", 80.0, None)])
        detector = TrendDetector("rig", "trend", RATE_HZ, [channel])
        self._pipeline = Pipeline(
            {"trend": ring}, [detector], self._take, LoopClock(), patience={"trend": Patience(1e9 / RATE_HZ)}
        )
        self._manager = AlarmManager(RIG, [HOT], LoopClock())

    def _take(self, diagnosis):
        after_min = (LoopClock().monotonic_ns() - self._begin_ns) / MINUTE_NS
        self.events += [(event.alarm, event.kind, after_min) for event in self._manager.take(diagnosis)]

    def set(self, temperature_deg_c):
        self.unit.put("holding", 0, struct.pack(">h", temperature_deg_c))

    @contextlib.asynccontextmanager
    async def running(self):
        self._begin_ns = LoopClock().monotonic_ns()
        plan = lambda _unit, _pdu: PlannedReply("silent" if self.silent else "none")  # noqa: E731
        async with responding({1: self.unit}, plan, serial=True):
            tasks = [asyncio.create_task(self._driver.run()), asyncio.create_task(self._pipeline.run())]
            yield
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    @property
    def polls_lost(self):
        return self._driver.streams["trend"][0].samples_lost


@pytest.fixture(autouse=True)
def no_threads(monkeypatch):
    async def at_once(work, /, *arguments):
        return work(*arguments)

    monkeypatch.setattr(asyncio, "to_thread", at_once)
    monkeypatch.setattr("daqsvc.diagnosis.pipeline.KernelThreads", AtOnce)


def test_an_alarm_of_a_value_a_minute_is_raised_held_and_returned():
    oil = Oil()

    async def main():
        oil.set(45)
        async with oil.running():
            await asyncio.sleep(120.5 * 60)
            oil.set(85)
            await asyncio.sleep(30 * 60)
            oil.silent = True
            oil.set(45)
            await asyncio.sleep(60 * 60)
            oil.silent = False
            await asyncio.sleep(30 * 60)

    simulate(main)
    told = [(alarm, kind) for alarm, kind, _ in oil.events]
    assert told == [
        ("hot", EventKind.RAISED),
        ("sensor-ok/oil", EventKind.RAISED),
        ("sensor-ok/oil", EventKind.RETURNED),
        ("hot", EventKind.RETURNED),
    ]
    raised, missed, back, returned = (after_min for _, _, after_min in oil.events)
    # The first value that is too high is read at 121 min, and the second, after the delay, at 122 min.
    assert raised == pytest.approx(122, abs=0.02)
    # The last one before the silence is of 150 min.
    assert missed == pytest.approx(153.5, abs=0.02)
    assert 210 < back < 214
    assert returned == back


@pytest.mark.parametrize("lost", [1, 2])
def test_a_lost_poll_or_two_are_no_matter(lost):
    oil = Oil()

    async def main():
        oil.set(85)
        async with oil.running():
            await asyncio.sleep(30)
            for _ in range(20):
                await asyncio.sleep((10 - lost) * 60)
                oil.silent = True
                await asyncio.sleep(lost * 60)
                oil.silent = False
            await asyncio.sleep(5 * 60)

    simulate(main)
    assert oil.polls_lost == 20 * lost
    assert [(alarm, kind) for alarm, kind, _ in oil.events] == [("hot", EventKind.RAISED)]
