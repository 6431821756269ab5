"""A window in which a sensor dies, comes back or leaves its gap limits is not good; a healthy one is."""

from __future__ import annotations

import numpy as np
import pytest
from support.alarm_rig import AlarmRig

from daqsvc.alarms.rules import LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.states import Level
from daqsvc.detectors.levels.detector import GapCheck, LevelChannel, LevelDetector
from daqsvc.detectors.levels.statements import Limits
from daqsvc.diagnosis.detector import Window

RATE_HZ = 300.0
BLOCK = 150
STEP = 0.127
"""Of a 12-bit converter, 1 mV at 7.87 mV/um."""
GAP = GapCheck(0.00787, -10.0, -18.0, -2.0)
T = np.arange(12 * BLOCK) / RATE_HZ
SHAFT = LevelRule("shaft", "probe-x", "rms", Setpoint(alert=40.0, danger=60.0))


def detector(gap: GapCheck | None = GAP) -> LevelDetector:
    channel = LevelChannel("probe-x", 0, "um", [Limits("rms", 40.0, 60.0)], gap)
    return LevelDetector("rig", "s", RATE_HZ, [channel], window_s=BLOCK / RATE_HZ)


def statements(samples: np.ndarray, gap: GapCheck | None = GAP):
    window = Window(0, samples.astype(np.float32)[:, None], 60 * 10**9, 1e9 / RATE_HZ)
    return detector(gap).process(window)


def quantised(samples: np.ndarray, step: float = STEP) -> np.ndarray:
    return step * np.round(samples / step)


def vibration(seed: int = 0, rms: float = 65.0) -> np.ndarray:
    return quantised(np.random.default_rng(seed).normal(0, rms, len(T)))


@pytest.mark.parametrize("stands_at", [0.0, 300.0, "where it was"])
@pytest.mark.parametrize("dies", [3 * BLOCK + 40, 3 * BLOCK + 75, 4 * BLOCK - 20])
@pytest.mark.parametrize("back", [6 * BLOCK + 20, 7 * BLOCK - 20])
def test_no_window_with_a_dead_part_is_good(stands_at, dies, back):
    samples = vibration()
    samples[dies:back] = samples[dies - 1] if stands_at == "where it was" else stands_at
    said = statements(samples)
    qualities = [d.quality for d in said]
    assert qualities == ["good"] * 3 + ["not_ok"] * 4 + ["good"] * 5
    assert {d.decision for d in said} == {"danger"}
    still = 4 * BLOCK - dies
    assert f"for {still} of 150 samples" in said[3].reason or f"for {still + 1} of 150" in said[3].reason
    assert "does not move at all" in said[4].reason


def test_a_contact_that_fails_within_a_window_is_told():
    samples = vibration()
    samples[700:760] = 0.0
    said = statements(samples)
    assert [d.quality for d in said].count("not_ok") == 2
    assert "probe-x was stuck at 0 um for 50 of 150 samples" in said[4].reason


def test_a_service_that_starts_beside_a_dead_sensor_waits_for_a_window_that_is_alive():
    samples = vibration()
    samples[: 3 * BLOCK - 3] = 0.0
    assert [d.quality for d in statements(samples)] == ["not_ok"] * 3 + ["good"] * 9


@pytest.mark.parametrize("dies", [3 * BLOCK + 1, 3 * BLOCK + 75, 4 * BLOCK - 15])
def test_an_alarm_neither_returns_nor_falls_while_its_sensor_dies_and_comes_back(dies):
    samples = vibration()
    samples[dies : 6 * BLOCK + 75] = 0.0
    rig = AlarmRig(SHAFT)
    events = [event for d in statements(samples) for event in rig.told(rig.manager.take(d))]
    told = [(event.kind.value, event.to_level) for event in events if event.alarm == "shaft"]
    assert told == [("raised", Level.DANGER), ("suppressed", Level.DANGER), ("unsuppressed", Level.DANGER)]


@pytest.mark.parametrize("leaves", [3 * BLOCK, 3 * BLOCK + 75, 4 * BLOCK - 4, 4 * BLOCK - 1])
def test_a_gap_that_steps_out_of_its_limits_and_back_raises_nothing(leaves):
    samples = vibration(rms=5.0)
    samples[leaves : 6 * BLOCK + 1] -= 1270.0  # to -20 V
    said = statements(samples)
    assert [d.quality for d in said] == ["good"] * 3 + ["not_ok"] * 4 + ["good"] * 5
    rig = AlarmRig(SHAFT)
    events = [event for d in said for event in rig.told(rig.manager.take(d))]
    assert [e.kind.value for e in events if e.alarm == "shaft"] == ["suppressed", "unsuppressed"]


def test_a_gap_limit_that_is_passed_for_part_of_a_window_is_named_with_the_farthest_voltage():
    samples = vibration(rms=5.0)
    samples[200:230] = -1270.6
    reason = statements(samples)[1].reason
    assert "gap voltage of probe-x reached -20.00 V, for 30 of 150 samples outside its OK limits" in reason


def test_a_glitch_of_two_samples_is_not_the_probe():
    samples = vibration(rms=5.0)
    samples[[200, 201]] = -1270.6
    assert statements(samples)[1].quality == "good"


HEALTHY = {
    "sine": 20 * np.sin(2 * np.pi * 24.7 * T),
    "slow sine without noise": quantised(20 * np.sin(2 * np.pi * 1.1 * T), 0.5),
    "square wave": np.sign(np.sin(2 * np.pi * 1.2 * T + 0.1)),
    "keyphasor": np.where((3.1 * T) % 1 < 0.1, -2.0, -10.0),
    "noise of half a step": quantised(np.random.default_rng(1).normal(0, 0.5, len(T)), 1.0),
    "noise of a quarter of a step": quantised(np.random.default_rng(2).normal(0, 0.27, len(T)), 1.0),
    "every value ten times": np.repeat(np.random.default_rng(3).normal(size=len(T) // 10), 10),
    "impacts": quantised(30 * np.exp(-80 * (T % 0.19)) * np.cos(380 * (T % 0.19)), 1.0),
    "clipped on both sides": np.clip(quantised(30 * np.sin(2 * np.pi * 12.3 * T), 1.0), -20, 20),
}


@pytest.mark.parametrize("name", HEALTHY)
def test_a_healthy_signal_is_good_in_every_window(name):
    assert [d.reason for d in statements(HEALTHY[name], gap=None)] == [""] * 12


def test_a_dead_probe_near_zero_stands_at_zero():
    (said,) = detector().process(
        Window(0, np.full((BLOCK, 1), -2.27374e-13, np.float32), 10**9, 1e9 / RATE_HZ)
    )
    assert "probe-x does not move at all (0 um)" in said.reason
