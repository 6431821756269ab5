"""Alarms on trend values: start-up by a speed that is polled, votes, bypass, latching, and lost values."""

from __future__ import annotations

import numpy as np
import pytest
from support.alarm_rig import RIG, AlarmRig, alarm_handling, kinds
from support.clocks import SettableClock

from daqsvc.alarms.commands import Verb
from daqsvc.alarms.rules import LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.states import AlarmState, Level
from daqsvc.alarms.voting import VotingRule
from daqsvc.detectors.levels.statements import Limits
from daqsvc.detectors.levels.trends import TrendChannel, TrendDetector
from daqsvc.diagnosis.detector import Window
from daqsvc.settings.alarms import StartUp

SECOND_NS = 1_000_000_000
NAN = float("nan")
STARTS = StartUp(detector="levels/speed", measure="value", between=(100.0, 2700.0))
ZONES = Setpoint(alert=2.8, danger=4.5, deadband=0.2)


class Trends:
    """Trend values of one stream, sample by sample, and the alarms that they feed."""

    def __init__(self, *rules, sensors=("vx",), rate_hz=1.0, **more):
        self._clock = SettableClock()
        self.rig = AlarmRig(*rules, clock=self._clock, **more)
        channels = [
            TrendChannel(name, column, "mm/s", [Limits("value", 2.8, 4.5)], (0.0, 3000.0))
            for column, name in enumerate(sensors)
        ]
        self._detector = TrendDetector(RIG.machine, "trend", rate_hz, channels)
        self._period_s = 1 / rate_hz
        self._index = 0

    def read(self, *values):
        """The next value of each sensor; what is told of it."""
        self._clock.advance(self._period_s)
        row = np.array([values], np.float32)
        window = Window(self._index, row, self._clock.monotonic_ns(), self._period_s * SECOND_NS)
        self._index += 1
        events = []
        for said in self._detector.process(window):
            events += self.rig.told(self.rig.manager.take(said))
        return kinds(events)

    def level(self, alarm):
        return self.rig.status(alarm).level


def test_a_speed_among_the_registers_multiplies_limits_at_a_start_up():
    rule = LevelRule("vibration", "vx", "value", ZONES, trip_multiply=2.0)
    trends = Trends(rule, sensors=("speed", "vx"), handling=alarm_handling(start_up=STARTS))
    assert trends.read(0.0, 1.0) == []
    assert trends.read(900.0, 5.0) == []  # through the critical speed
    assert trends.read(1800.0, 5.6) == [("vibration", "raised")]
    assert trends.level("vibration") is Level.ALERT
    assert trends.read(2950.0, 1.0) == [("vibration", "returned")]
    assert trends.read(2950.0, 2.9) == [("vibration", "raised")]


def test_two_of_three_must_agree_and_a_lost_one_has_no_vote():
    rule = VotingRule("vibration", ("a", "b", "c"), 2, "value", ZONES)
    trends = Trends(rule, sensors=("a", "b", "c"))
    trends.read(1.0, 1.0, 1.0)
    assert trends.read(3.0, 1.0, 1.0) == []
    assert trends.read(3.0, 3.0, 1.0) == [("vibration", "raised")]
    for _ in range(2):
        assert trends.read(3.0, NAN, 1.0) == []
    assert trends.read(3.0, NAN, 1.0) == [("sensor-ok/b", "raised")]
    assert trends.level("vibration") is Level.ALERT
    assert trends.read(1.0, 1.0, 1.0) == [("vibration", "returned"), ("sensor-ok/b", "returned")]


@pytest.mark.parametrize("latching", [False, True])
def test_lost_values_neither_clear_nor_reset(latching):
    rule = LevelRule("vibration", "vx", "value", ZONES, latching=latching)
    trends = Trends(rule, rate_hz=1 / 60)
    assert trends.read(5.0) == [("vibration", "raised")]
    told = [kind for _ in range(500) for kind in trends.read(NAN)]
    assert told == [("sensor-ok/vx", "raised")]
    assert trends.level("vibration") is Level.DANGER
    back = [("sensor-ok/vx", "returned"), ("vibration", "latched" if latching else "returned")]
    assert trends.read(1.0) == back


def test_delays_count_from_value_to_value_over_two_that_are_lost():
    setpoint = Setpoint(alert=2.8, on_delay_ns=200 * SECOND_NS)
    trends = Trends(LevelRule("vibration", "vx", "value", setpoint), rate_hz=1 / 60)
    trends.read(3.0)
    for value in (NAN, NAN):
        assert trends.read(value) == []
    assert trends.read(3.0) == []
    assert trends.read(3.0) == [("vibration", "raised")]


def test_a_delay_stands_still_while_values_are_missing():
    setpoint = Setpoint(alert=2.8, on_delay_ns=200 * SECOND_NS)
    trends = Trends(LevelRule("vibration", "vx", "value", setpoint), rate_hz=1 / 60)
    trends.read(3.0)
    for _ in range(60):
        trends.read(NAN)
    told = [trends.read(3.0) for _ in range(5)]
    assert ("vibration", "raised") not in [kind for kinds_told in told[:4] for kind in kinds_told]
    assert told[4] == [("vibration", "raised")]


def test_a_bypassed_alarm_goes_on_below_and_a_broken_sensor_suppresses():
    trends = Trends(LevelRule("vibration", "vx", "value", ZONES))
    trends.read(1.0)
    trends.rig.ask(Verb.BYPASS, "vibration")
    trends.read(5.0)
    status = trends.rig.status("vibration")
    assert (status.state, status.own_state) == (
        AlarmState.OUT_OF_SERVICE,
        AlarmState.ACTIVE_UNACKNOWLEDGED,
    )
    trends.rig.ask(Verb.UNBYPASS, "vibration")
    assert trends.read(5000.0) == [("sensor-ok/vx", "raised"), ("vibration", "suppressed")]
    assert trends.read(1.0) == [
        ("sensor-ok/vx", "returned"),
        ("vibration", "unsuppressed"),
        ("vibration", "returned"),
    ]
