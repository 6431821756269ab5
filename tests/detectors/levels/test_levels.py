"""Levels of signals whose levels are known."""

from __future__ import annotations

import numpy as np
import pytest

from daqsvc.detectors.levels.detector import GapCheck, LevelChannel, LevelDetector
from daqsvc.detectors.levels.statements import Limits
from daqsvc.diagnosis.detector import Window
from daqsvc.dsp.levels import band_rms, levels

RATE_HZ = 2000.0
T = np.arange(2000) / RATE_HZ


def window(samples: np.ndarray, first: int = 0) -> Window:
    return Window(first, samples.astype(np.float32).reshape(len(samples), -1), 10**9, 1e9 / RATE_HZ)


def detector(**changes: object) -> LevelDetector:
    channel = {"sensor": "probe-x", "column": 0, "unit": "um"} | changes
    return LevelDetector("m", "s", RATE_HZ, [LevelChannel(**channel)], window_s=0.5)  # type: ignore[arg-type]


def test_levels_of_a_sine_are_those_of_a_sine() -> None:
    found = levels((3.0 + 2.0 * np.sin(2 * np.pi * 50 * T)).astype(np.float32))
    assert found.mean == pytest.approx(3.0, abs=1e-6)
    assert found.rms == pytest.approx(2**0.5, rel=1e-6)
    assert found.peak == pytest.approx(2.0, rel=1e-6)
    assert found.crest_factor == pytest.approx(2**0.5, rel=1e-6)


@pytest.mark.parametrize("frequency_hz", [25.0, 80.3, 333.3])
def test_velocity_of_a_sine_is_its_acceleration_over_omega(frequency_hz: float) -> None:
    acceleration = 5.0 * np.sin(2 * np.pi * frequency_hz * T + 0.3)
    expected = 5.0 / (2 * np.pi * frequency_hz) / 2**0.5
    assert band_rms(acceleration, RATE_HZ, 10, 1000, integrate=True) == pytest.approx(expected, rel=0.01)
    assert band_rms(acceleration, RATE_HZ, 10, 1000) == pytest.approx(5 / 2**0.5, rel=0.01)


def test_what_lies_outside_the_band_does_not_count() -> None:
    slow, offset = np.sin(2 * np.pi * 4 * T), 100.0
    assert band_rms(slow + offset, RATE_HZ, 10, 1000) < 0.01
    assert band_rms(np.sin(2 * np.pi * 600 * T), RATE_HZ, 10, 500) < 1e-6


def test_white_noise_keeps_its_power() -> None:
    noise = np.random.default_rng(0).normal(size=200_000)
    assert band_rms(noise, RATE_HZ, 0.01, 1000) == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize(("unit", "per_g"), [("g", 1.0), ("mg", 1e3), ("m/s2", 9.80665), ("mm/s2", 9806.65)])
@pytest.mark.parametrize(("zone_c", "decision"), [(1.0, "alert"), (1.2, "normal")])
def test_velocity_in_the_detector_is_in_mm_per_s_whatever_the_unit_of_the_acceleration(
    unit: str, per_g: float, zone_c: float, decision: str
) -> None:
    acceleration = per_g * 0.1 * np.sin(2 * np.pi * 100 * T[:1000])
    limits = [Limits("velocity_rms", zone_c, 4.5)]
    (said,) = detector(unit=unit, limits=limits).process(window(acceleration))
    expected = 0.1 * 9.80665 / (2 * np.pi * 100) / 2**0.5 * 1000  # 1.10 mm/s
    assert said.statistics["velocity_rms"] == pytest.approx(expected, rel=0.01)
    assert said.statistics["rms"] == pytest.approx(0.1 * per_g / 2**0.5, rel=1e-4)
    own = dict.fromkeys(("mean", "rms", "peak", "peak_to_peak"), unit)
    assert said.units == {**own, "velocity_rms": "mm/s"}
    assert said.decision == decision


def test_each_window_is_held_against_the_setpoints() -> None:
    unit = detector(limits=[Limits("rms", 1.0, 2.0), Limits("peak", None, 10.0)])
    noise = np.random.default_rng(0).normal(size=4000)
    loud = np.concatenate(
        [0.5 * noise[:1000], 1.5 * noise[1000:2000], 3 * noise[2000:3000], 0.5 * noise[3000:]]
    )
    loud[3500] = 20.0
    said = unit.process(window(loud, first=70))
    assert [d.decision for d in said] == ["normal", "alert", "danger", "danger"]
    assert [d.changed for d in said] == [False, True, True, False]
    assert [(d.first_index, d.end_index) for d in said][1] == (1070, 2070)
    assert said[0].t_ns == 10**9 - 3000 * 500_000
    assert said[0].thresholds == {"rms.alert": 1.0, "rms.danger": 2.0, "peak.danger": 10.0}


def test_missing_samples_hold_the_decision_and_say_so() -> None:
    unit = detector(limits=[Limits("rms", 1.0, None)])
    noise = 2 * np.random.default_rng(0).normal(size=1000)
    assert unit.process(window(noise))[0].decision == "alert"
    some = noise.copy()
    some[:400] = np.nan
    assert unit.process(window(some))[0].statistics["rms"] == pytest.approx(2.0, rel=0.1)
    few = noise.copy()
    few[:501] = np.nan
    (held,) = unit.process(window(few))
    assert (held.quality, held.decision, held.severity, held.changed) == ("missing", "alert", "alert", False)
    assert "only 499 of 1000 samples of probe-x" in held.reason
    (first,) = detector().process(window(np.full(1000, np.nan)))
    assert (first.quality, first.decision) == ("missing", "undetermined")


@pytest.mark.parametrize("gap_v", [-20.0, -1.0])
def test_a_gap_voltage_outside_its_limits_is_not_ok(gap_v: float) -> None:
    unit = detector(gap=GapCheck(0.00787, -10.0, -18.0, -2.0))
    noise = np.random.default_rng(0).normal(size=1000)
    assert unit.process(window(noise))[0].quality == "good"
    (said,) = unit.process(window(noise + (gap_v + 10) / 0.00787))
    assert said.quality == "not_ok"
    assert said.statistics["gap_voltage"] == pytest.approx(gap_v, abs=0.01)
    assert f"gap voltage of probe-x is {gap_v:.2f} V, outside its OK limits -18 to -2 V" in said.reason


def test_a_sensor_that_does_not_move_at_all_is_dead() -> None:
    (said,) = detector().process(window(np.full(1000, 3.5)))
    assert said.quality == "not_ok"
    assert "does not move at all (3.5 um)" in said.reason


def test_infinities_count_as_missing() -> None:
    samples = np.random.default_rng(0).normal(size=1000)
    samples[10] = np.inf
    (said,) = detector(unit="g").process(window(samples))
    assert said.quality == "good"
    assert np.isfinite(list(said.statistics.values())).all()


def test_peak_to_peak_is_the_whole_range_also_of_what_is_not_symmetric() -> None:
    samples = np.zeros(100, np.float32)
    samples[[3, 50]] = 30.0, -10.0
    samples[7] = np.nan
    found = levels(samples)
    assert found.peak_to_peak == 40.0
    assert found.peak == pytest.approx(30.0, abs=0.5)
    watching = detector(limits=[Limits("peak_to_peak", 35.0, 50.0, None, None)])
    assert watching.process(window(20.0 * np.sin(2 * np.pi * 50 * T[:500])))[0].severity == "alert"


def test_after_a_reload_the_next_window_is_judged_by_the_new_setpoints() -> None:
    rms_1 = np.sqrt(2.0) * np.sin(2 * np.pi * 20.0 * np.arange(640) / 640.0).astype(np.float32)[:, None]
    detector = LevelDetector("rig", "shaft", 640.0, [LevelChannel("x", 0, "um", [Limits("rms", 2.0, 3.0)])])
    said = [one.severity for one in detector.process(Window(0, rms_1, 10**9, 10**9 / 640))]
    detector.change_setpoints({"x": [Limits("rms", 0.5, 0.9)], "keyphasor": []})
    [*_, last] = detector.process(Window(640, rms_1, 2 * 10**9, 10**9 / 640))
    assert {*said} == {"normal"}
    assert (last.severity, last.thresholds) == ("danger", {"rms.alert": 0.5, "rms.danger": 0.9})
