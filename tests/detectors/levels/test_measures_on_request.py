"""Measures that are made only where they are asked for: the level detector, from samples to statements."""

from __future__ import annotations

import math

import numpy as np
import pytest

from daqsvc.detectors.levels.detector import LevelChannel, LevelDetector
from daqsvc.detectors.levels.shaft_angle import ShaftAngle
from daqsvc.detectors.levels.statements import Limits
from daqsvc.diagnosis.detector import Window
from daqsvc.dsp.speed.keyphasor import KeyphasorProbe
from daqsvc.settings.measures import ON_REQUEST
from sim_hw.plants.rotor import keyphasor_voltage

RATE_HZ = 2560.0
PLAIN = {"mean", "rms", "peak", "peak_to_peak", "crest_factor"}
KEY = KeyphasorProbe("keyphasor", 1, -6.0)


class Rig:
    """A shaft at 600 rpm that one probe sees beside its keyphasor, in windows of half a second."""

    def __init__(self, *limits, listed=(), keyphasor=True, unit="um", rpm=600.0):
        period = 60.0 * RATE_HZ / rpm
        channel = LevelChannel("probe-x", 0, unit, limits, listed=frozenset(listed))
        self.detector = LevelDetector(
            "rig",
            "shaft",
            RATE_HZ,
            [channel],
            speed_rpm=rpm,
            shaft=ShaftAngle(KEY, period) if keyphasor else None,
        )
        self._index = 0
        self._turned = 0.0
        self._rng = np.random.default_rng(3)

    def turn(self, seconds=0.5, rpm=600.0, first=40.0, lag_deg=135.0, second=10.0, lost=0.0, *, pulses=True):
        n = round(seconds * RATE_HZ)
        turns = self._turned + np.arange(n) * rpm / 60.0 / RATE_HZ
        self._turned += n * rpm / 60.0 / RATE_HZ
        angle = math.tau * turns
        x = first * np.cos(angle - math.radians(lag_deg)) + second * np.cos(2.0 * angle - math.radians(20.0))
        x += self._rng.normal(0.0, 0.2, n)
        x[self._rng.random(n) < lost] = np.nan
        volts = keyphasor_voltage(turns) if pulses else np.full(n, -10.0)
        samples = np.column_stack((x, volts)).astype(np.float32)
        window = Window(self._index, samples, round((self._index + n) * 1e9 / RATE_HZ), 1e9 / RATE_HZ)
        self._index += n
        return self.detector.process(window)

    def steady(self, **how):
        """The statement when it has turned for a while."""
        return self.turn(seconds=2.0, **how)[-1]


def test_nothing_is_made_that_nobody_asks_for():
    said = Rig().steady()
    assert set(said.statistics) == PLAIN
    assert set(said.units) == PLAIN - {"crest_factor"}


def test_what_is_listed_is_made_with_its_unit():
    said = Rig(listed=ON_REQUEST).steady()
    assert set(said.statistics) == PLAIN | set(ON_REQUEST) - {"velocity_rms_2_1000"}
    found = said.statistics
    assert found["1x_amplitude"] == pytest.approx(40.0, rel=0.005)
    assert found["2x_amplitude"] == pytest.approx(10.0, rel=0.02)
    assert found["1x_phase_lag"] == pytest.approx(135.0, abs=1.0)
    assert found["2x_phase_lag"] == pytest.approx(20.0, abs=2.0)
    assert found["not_1x_rms"] == pytest.approx(math.hypot(10.0 / 2**0.5, 0.2), rel=0.02)
    assert found["not_1x_peak_to_peak"] == pytest.approx(21.0, abs=1.0)
    # Two sines: by their even moments (3/8 A^4 + 3/8 B^4 + 6/4 A^2 B^2) / power^2, of orders 1 and 2.
    a, b = 40.0, 10.0
    assert found["kurtosis"] == pytest.approx(
        (0.375 * (a**4 + b**4) + 1.5 * a * a * b * b) / ((a * a + b * b) / 2) ** 2, rel=0.01
    )
    assert said.units["1x_phase_lag"] == "deg"
    assert said.units["1x_amplitude"] == said.units["not_1x_peak_to_peak"] == "um"
    assert "kurtosis" not in said.units
    assert said.quality == "good"


def test_an_alarm_asks_and_one_that_comes_with_a_reload_does():
    rig = Rig(Limits("1x_amplitude", 30.0, None))
    said = rig.steady()
    assert set(said.statistics) == PLAIN | {"1x_amplitude"}
    assert said.decision == "alert"
    rig.detector.change_setpoints({"probe-x": [Limits("kurtosis", 5.0, None)]})
    assert set(rig.turn()[0].statistics) == PLAIN | {"kurtosis"}


def test_the_lag_follows_the_mark_at_any_speed():
    rig = Rig(listed=["1x_phase_lag", "1x_amplitude"])
    for rpm in (300.0, 900.0, 1500.0):
        said = rig.turn(seconds=4.0, rpm=rpm)[-1]
        assert said.statistics["1x_phase_lag"] == pytest.approx(135.0, abs=1.5)
        assert said.statistics["1x_amplitude"] == pytest.approx(40.0, rel=0.01)


def test_a_clockwise_shaft_has_the_same_lag():
    """Time runs from the mark to the peak, whichever way the shaft turns."""
    period = 60.0 * RATE_HZ / 600.0
    rig = Rig(listed=["1x_phase_lag"])
    rig.detector = LevelDetector(
        "rig",
        "shaft",
        RATE_HZ,
        [LevelChannel("probe-x", 0, "um", listed=frozenset(["1x_phase_lag"]))],
        speed_rpm=-600.0,
        shaft=ShaftAngle(KEY, period),
    )
    assert rig.steady().statistics["1x_phase_lag"] == pytest.approx(135.0, abs=1.0)


def test_without_a_keyphasor_amplitudes_are_told_and_phases_are_not():
    said = Rig(listed=ON_REQUEST, keyphasor=False).steady(rpm=594.0)
    assert said.statistics["1x_amplitude"] == pytest.approx(40.0, rel=0.01)
    assert said.statistics["not_1x_rms"] == pytest.approx(10.0 / 2**0.5, rel=0.05)
    assert not {"1x_phase_lag", "2x_phase_lag"} & set(said.statistics)
    assert said.quality == "good"


def test_a_phase_that_is_asked_of_a_stream_without_a_keyphasor_is_held_with_a_reason():
    said = Rig(Limits("1x_phase_lag", 30.0, None, reference_deg=135.0), keyphasor=False).steady()
    assert said.quality == "missing"
    assert "has no phase" in said.reason
    assert said.bounds == {"1x_phase_lag": (-math.inf, math.inf)}


def test_while_no_pulses_come_1x_is_held_with_a_reason_and_the_rest_goes_on():
    rig = Rig(Limits("1x_amplitude", 30.0, None), Limits("rms", 100.0, 200.0))
    assert rig.steady().decision == "alert"
    quiet = rig.turn(seconds=3.0, first=10.0, pulses=False)[-1]
    assert (quiet.quality, quiet.decision) == ("missing", "alert")
    assert "keyphasor has no pulses" in quiet.reason
    assert quiet.missing_share == 0.0
    loud = rig.turn(first=160.0, pulses=False)[-1]
    assert loud.decision == "alert"  # rms: 113 um
    assert rig.turn(first=400.0, pulses=False)[-1].decision == "danger"
    # RMS returns by itself; what 1X was stands.
    assert rig.turn(first=10.0, pulses=False)[-1].decision == "alert"
    back = rig.turn(seconds=2.0, first=10.0)[-1]
    assert (back.quality, back.decision, back.bounds) == ("good", "normal", {})


def test_what_stands_of_1x_outlives_windows_that_lack_samples_and_pulses():
    rig = Rig(Limits("1x_amplitude", 30.0, None))
    assert rig.steady().decision == "alert"
    assert rig.turn(first=1.0, lost=0.2)[-1].decision == "alert"
    assert rig.turn(seconds=3.0, first=1.0, pulses=False)[-1].decision == "alert"
    assert rig.turn(seconds=2.0, first=1.0)[-1].decision == "normal"


def test_what_is_only_listed_and_not_known_is_left_out():
    rig = Rig(listed=["1x_amplitude", "kurtosis"])
    rig.steady()
    said = rig.turn(seconds=3.0, pulses=False)[-1]
    assert (said.quality, said.reason) == ("good", "")
    assert set(said.statistics) == PLAIN | {"kurtosis"}


def test_a_small_1x_has_an_amplitude_and_no_phase():
    rig = Rig(Limits("1x_phase_lag", 30.0, None, reference_deg=135.0), listed=["1x_amplitude"])
    said = rig.steady(first=0.01, second=0.0)
    assert said.statistics["1x_amplitude"] < 0.1
    assert "1x_phase_lag" not in said.statistics
    assert said.reason == "1X or 2X of probe-x does not stand out of its noise, so that it has no phase"


def test_a_phase_is_held_against_its_reference_over_360():
    rig = Rig(Limits("1x_phase_lag", 30.0, 60.0, reference_deg=350.0))
    said = rig.steady(lag_deg=10.0)
    assert said.decision == "normal"
    assert said.thresholds == {
        "1x_phase_lag.alert": 30.0,
        "1x_phase_lag.danger": 60.0,
        "1x_phase_lag.reference": 350.0,
    }
    assert rig.turn(lag_deg=25.0)[-1].decision == "alert"
    assert rig.turn(lag_deg=280.0)[-1].decision == "danger"
    assert rig.turn(lag_deg=345.0)[-1].decision == "normal"


def test_with_many_samples_missing_it_is_uncertain_like_a_crest_factor():
    rig = Rig(Limits("1x_amplitude", 30.0, None), listed=["kurtosis"])
    assert rig.steady().decision == "alert"
    some = rig.turn(lost=0.03)[-1]
    assert (some.quality, some.decision) == ("good", "alert")
    assert some.statistics["1x_amplitude"] == pytest.approx(40.0, rel=0.01)
    many = rig.turn(lost=0.2, first=1.0)[-1]
    assert (many.quality, many.decision) == ("missing", "alert")
    assert many.bounds["1x_amplitude"] == many.bounds["kurtosis"] == (0.0, math.inf)


def test_skipped_samples_hold_what_is_asked_for():
    rig = Rig(Limits("kurtosis", 5.0, None))
    window = Window(5000, np.zeros((1280, 2), np.float32), 10**10, 1e9 / RATE_HZ, skipped=400)
    assert rig.detector.process(window)[0].bounds["kurtosis"] == (-math.inf, math.inf)


def test_an_index_that_jumps_starts_the_angle_anew():
    rig = Rig(listed=["1x_phase_lag"])
    rig.steady()
    rig._index += 77  # of a revolution of 256 samples: an angle that went on would be 108 degrees off
    lags = [said.statistics.get("1x_phase_lag") for said in rig.turn(seconds=3.0)]
    assert lags[-1] == pytest.approx(135.0, abs=1.0)
    assert all(lag is None or abs(lag - 135.0) < 3.0 for lag in lags)


@pytest.mark.parametrize(
    ("frequency_hz", "in_10", "in_2"), [(5.0, 0.0, 1.0), (80.0, 1.0, 1.0), (1.0, 0.0, 0.0)]
)
def test_velocity_from_2_hz_stands_beside_that_from_10_hz(frequency_hz, in_10, in_2):
    t = np.arange(4 * 2560) / RATE_HZ
    velocity = 6.0 * np.sin(math.tau * frequency_hz * t)
    channel = LevelChannel("v", 0, "mm/s", listed=frozenset(["velocity_rms_2_1000"]))
    unit = LevelDetector("m", "s", RATE_HZ, [channel], window_s=4.0)
    window = Window(0, velocity.astype(np.float32).reshape(-1, 1), 10**10, 1e9 / RATE_HZ)
    (said,) = unit.process(window)
    assert said.statistics["velocity_rms"] == pytest.approx(in_10 * 6.0 / 2**0.5, abs=0.05)
    assert said.statistics["velocity_rms_2_1000"] == pytest.approx(in_2 * 6.0 / 2**0.5, abs=0.05)
    assert said.units["velocity_rms_2_1000"] == "mm/s"


def test_velocity_from_2_hz_of_an_accelerometer_that_lacks_samples_has_bounds():
    t = np.arange(4 * 2560) / RATE_HZ
    g = 0.02 * np.sin(math.tau * 5.0 * t)
    g[np.random.default_rng(0).random(len(g)) < 0.2] = np.nan
    channel = LevelChannel("a", 0, "g", listed=frozenset(["velocity_rms_2_1000"]))
    unit = LevelDetector("m", "s", RATE_HZ, [channel], window_s=4.0)
    (said,) = unit.process(Window(0, g.astype(np.float32).reshape(-1, 1), 10**10, 1e9 / RATE_HZ))
    expected = 0.02 * 9806.65 / (math.tau * 5.0) / 2**0.5
    assert said.statistics["velocity_rms_2_1000"] == pytest.approx(expected, rel=0.05)
    low, high = said.bounds["velocity_rms_2_1000"]
    assert low < expected < high
