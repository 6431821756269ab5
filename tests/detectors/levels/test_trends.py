"""Trend values: held against setpoints as they come, bridged, missed, and believed or not."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from daqsvc.detectors.levels.statements import Limits
from daqsvc.detectors.levels.trends import TrendChannel, TrendDetector
from daqsvc.diagnosis.detector import Window

SECOND_NS = 10**9
NAN = float("nan")
TEMPERATURE = Limits("value", 80.0, 95.0, 5.0, 0.0)


def window(values, first=0, period_s=1.0):
    samples = np.array(values, np.float32).reshape(len(values), -1)
    period_ns = period_s * SECOND_NS
    return Window(first, samples, round((first + len(samples) - 1) * period_ns), period_ns)


def detector(*, rate_hz=1.0, window_s=0.5, **changes):
    channel = {"sensor": "oil", "column": 0, "unit": "degC", "limits": [TEMPERATURE]} | changes
    return TrendDetector("pump", "trend", rate_hz, [TrendChannel(**channel)], window_s=window_s)


def test_each_value_is_held_against_setpoints_on_both_sides():
    said = detector().process(window([20.0, 80.0, 95.0, 5.0, -1.0, 50.0]))
    assert [d.decision for d in said] == ["normal", "alert", "danger", "alert", "danger", "normal"]
    assert [d.changed for d in said] == [False, True, True, True, True, True]
    assert [d.t_ns for d in said] == [k * SECOND_NS for k in range(6)]
    assert [(d.first_index, d.end_index) for d in said] == [(k, k + 1) for k in range(6)]
    assert [d.statistics for d in said][:2] == [{"value": 20.0}, {"value": 80.0}]
    assert {d.detector for d in said} == {"levels/oil"}
    assert said[0].units == {"value": "degC"}
    assert said[0].thresholds == {
        "value.alert": 80.0,
        "value.danger": 95.0,
        "value.alert_low": 5.0,
        "value.danger_low": 0.0,
    }


@pytest.mark.parametrize("limit", [2.8, 4.5, 7.1, 0.1, -11.3, 65.535, 1013.25])
def test_a_value_at_a_limit_has_reached_it(limit):
    at = detector(limits=[Limits("value", limit, None)], ok_between=(limit - 0.5, limit))
    (said,) = at.process(window([limit]))
    assert (said.decision, said.quality, said.statistics) == ("alert", "good", {"value": limit})
    below = detector(limits=[Limits("value", None, None, limit, None)], ok_between=(limit, limit + 0.5))
    (said,) = below.process(window([limit]))
    assert (said.decision, said.quality) == ("alert", "good")


def test_a_value_that_stands_still_is_no_dead_sensor():
    said = detector().process(window([20.0] * 500))
    assert {d.quality for d in said} == {"good"}


@pytest.mark.parametrize("value", [2e12, -3e38, 1e-40, -1e-45])
@pytest.mark.parametrize("rate_hz", [1.0, 10.0])
def test_a_value_that_no_sensor_measures_is_not_judged(value, rate_hz):
    subject = detector(rate_hz=rate_hz, window_s=1.0)
    before = subject.process(window([85.0] * 10, period_s=1.0 / rate_hz))[-1]
    said = subject.process(window([20.0] * 9 + [value], first=10, period_s=1.0 / rate_hz))[-1]
    assert (before.decision, said.decision) == ("alert", "alert" if rate_hz == 10.0 else "normal")
    assert (said.quality, said.statistics) == ("not_ok", {})
    assert said.reason.startswith(f"oil holds {np.float32(value):.4g} at sample ")
    assert "in any unit; correct its scale or unit" in said.reason
    after = subject.process(window([0.0] * 10, first=20, period_s=1.0 / rate_hz))[-1]
    assert (after.quality, after.decision) == ("good", "danger")


@pytest.mark.parametrize("value", [-3411.0, 1.066e9, -1.5])
def test_a_value_that_is_no_velocity_of_a_machine_is_not_judged_by_zones(value):
    zones = Limits("value", 2.8, 4.5, zones=(1.4, 2.8, 4.5))
    subject = detector(unit="mm/s", limits=[zones], number_keys="order and type")
    said = subject.process(window([3.0, value, -0.5, 900.0]))
    assert [one.quality for one in said] == ["good", "not_ok", "good", "good"]
    assert said[1].reason == (
        f"oil reads {np.float32(value):.4g} mm/s, which is no velocity RMS of a machine; "
        "correct order and type of its channel in the layout, or its scale or unit"
    )
    # What zones do not call a velocity may be anything.
    other = detector(unit="mm/s", limits=[Limits("value", 2.8, 4.5)])
    assert other.process(window([value]))[0].quality == "good"


def swapped(values):
    """What is read of floats in two registers with the words exchanged."""
    return np.array(values, np.float32).view(np.uint16).reshape(-1, 2)[:, ::-1].copy().view(np.float32)[:, 0]


def noisy(mean, n=200):
    return mean * (1.0 + 0.02 * np.random.default_rng(5).standard_normal(n))


@pytest.mark.parametrize(
    ("value", "unit", "quality"),
    [
        (97_320_960.0, "rpm", "not_ok"),  # 1485 as uint32 with its words exchanged
        (-97_320_960.0, "1/min", "not_ok"),
        (1_000_000.0, "rpm", "good"),
        (97_320_960.0, "count", "good"),
        (97_320_960.0, "", "good"),
    ],
)
def test_a_speed_that_no_shaft_has_is_not_judged(value, unit, quality):
    speed = detector(
        unit=unit, limits=[Limits("value", None, None, 1400.0, None)], number_keys="order and type"
    )
    (said,) = speed.process(window([value]))
    assert said.quality == quality
    if quality == "not_ok":
        assert said.reason == (
            f"oil reads {value:.4g} {unit}, and no shaft turns faster than 1,000,000 rpm; correct order and "
            "type of its channel in the layout, or its scale or unit"
        )
        assert said.statistics == {}


@pytest.mark.parametrize("mean", [2.8, -9.4, 25.9, 1480.0])
def test_floats_in_the_wrong_order_are_told_and_do_not_flap(mean):
    subject = detector(limits=[], number_keys="order and type")
    values = swapped(noisy(mean))
    looks_possible = (np.abs(values) > 1e-12) & (np.abs(values) < 1e12)
    assert 20 < looks_possible.sum() < 100
    said = subject.process(window(values))
    qualities = [one.quality for one in said]
    changes = sum(now != before for before, now in pairwise(qualities))
    assert changes <= 3
    assert set(qualities[10:]) == {"not_ok"}
    assert all(not one.statistics for one in said[10:])
    assert "which no sensor measures; correct order and type of its channel in the layout" in said[-1].reason


def test_a_value_that_stays_all_but_zero_is_told():
    subject = detector(number_keys="order and type")
    said = subject.process(window([-1e-19] * 8))
    assert said[-1].quality == "not_ok"
    assert "reads -1e-19, which no sensor measures; correct order and type" in said[-1].reason


def test_what_is_told_of_a_wrong_order_is_over_once_all_values_can_be_measured():
    subject = detector(limits=[])
    assert subject.process(window(swapped(noisy(2.8, 40))))[-1].quality == "not_ok"
    said = subject.process(window(noisy(2.8, 20), first=40))
    assert {one.quality for one in said[:12]} == {"not_ok"}
    assert said[-1].quality == "good"


DYING = [float(0.37**k) for k in range(86)]  # before it is a denormal number
ROUNDING = np.random.default_rng(3).standard_normal(40) * 1e-17
SMALL = {
    "zeros": [0.0] * 40,
    "zeros and values": [0.0, 1.2] * 20,
    "small values": [3e-7, -2e-9, 4e-7, 1e-11] * 10,
    "what dies away": [2.5, *DYING],
    "what dies away in long steps": [3.0, 1e-4, 1e-8, 1e-13, 1e-18, 1e-24, 1e-30, 0.0, 0.0],
    "the rounding of a mean at rest": [*ROUNDING],
    "a machine that starts and stops": [*ROUNDING[:20], *[2.8] * 20, *ROUNDING[:20], 0.0, *[2.8] * 20],
    "large values": [9e11, 1e3, -9e11] * 10,
}


@pytest.mark.parametrize("what", SMALL)
def test_zeros_and_small_values_are_believed(what):
    said = detector(limits=[], number_keys="order and type").process(window(SMALL[what]))
    assert {one.quality for one in said} == {"good"}


def test_a_glitch_now_and_then_is_told_by_itself():
    values = [2.8] * 60
    values[20], values[27], values[40] = 3e20, -2e31, 5e15
    said = detector(limits=[]).process(window(values))
    assert [k for k, one in enumerate(said) if one.quality != "good"] == [20, 27, 40]


def test_a_fast_trend_is_averaged_over_its_window():
    fast = detector(rate_hz=10.0, window_s=1.0)
    assert fast.block == 10
    values = [*[70.0, 90.0] * 5, *[NAN] * 9, 20.0]
    said = fast.process(window(values, period_s=0.1))
    assert [d.statistics["value"] for d in said] == [80.0, 20.0]
    assert [d.end_index for d in said] == [10, 20]


@pytest.mark.parametrize("rate_hz", [1.0, 1 / 60])
def test_a_slow_trend_is_judged_sample_by_sample(rate_hz):
    assert detector(rate_hz=rate_hz).block == 1


def test_two_missing_values_are_bridged_and_the_third_is_told_and_clears_nothing():
    slow = detector()
    assert slow.process(window([85.0]))[0].decision == "alert"
    assert slow.process(window([NAN, NAN], 1)) == []
    assert [d.quality for d in slow.process(window([85.0, NAN, NAN], 3))] == ["good"]
    (missing,) = slow.process(window([np.inf], 6))
    assert (missing.quality, missing.decision, missing.severity) == ("missing", "alert", "alert")
    assert missing.statistics == {}
    assert "the last 3 values of oil did not arrive, or the device had none; check sensor" in missing.reason
    (silence,) = slow.silent(210.0, 99)
    assert (silence.quality, silence.decision, silence.first_index) == ("missing", "alert", 7)
    assert "no samples of stream 'trend' for more than 210.0 s" in silence.reason


def test_before_its_first_value_nothing_is_decided():
    (missing,) = detector().silent(2.0, 0)
    assert (missing.quality, missing.decision) == ("missing", "undetermined")


@pytest.mark.parametrize("broken", [-55.0, 1638.35])
def test_beyond_its_ok_limits_a_sensor_is_not_believed(broken):
    slow = detector(ok_between=(-40.0, 125.0))
    good, not_ok, back = slow.process(window([85.0, broken, 60.0]))
    assert (good.quality, good.decision) == ("good", "alert")
    assert (not_ok.quality, not_ok.decision) == ("not_ok", "alert")
    assert f"oil reads {broken:g} degC, outside its OK limits -40 to 125 degC" in not_ok.reason
    assert (back.quality, back.decision) == ("good", "normal")


def test_a_plain_number_has_no_unit_in_the_reason():
    (said,) = detector(unit="1", limits=[], ok_between=(0.0, 3.0)).process(window([7.0]))
    assert "oil reads 7, outside its OK limits 0 to 3; check" in said.reason


def test_one_such_value_spoils_its_window():
    fast = detector(rate_hz=4.0, window_s=1.0, ok_between=(-40.0, 125.0))
    (said,) = fast.process(window([60.0, 60.0, 150.0, 60.0], period_s=0.25))
    assert said.quality == "not_ok"
    assert "oil reads 150 degC" in said.reason


def test_the_channels_of_a_stream_are_judged_each_for_itself():
    channels = [
        TrendChannel("velocity", 1, "mm/s", [Limits("value", 4.5, None)]),
        TrendChannel("oil", 0, "degC", [TEMPERATURE]),
    ]
    both = TrendDetector("pump", "trend", 1.0, channels)
    said = both.process(window([[60.0, 5.0], [NAN, 5.0], [NAN, 1.0], [NAN, NAN]]))
    assert [(d.detector, d.decision, d.quality) for d in said] == [
        ("levels/velocity", "alert", "good"),
        ("levels/oil", "normal", "good"),
        ("levels/velocity", "alert", "good"),
        ("levels/velocity", "normal", "good"),
        ("levels/oil", "normal", "missing"),
    ]


def test_an_average_that_lacks_values_may_raise_an_alarm_and_returns_none():
    limits = [Limits("value", 30.0, None)]
    unit = TrendDetector("m", "s", 40.0, [TrendChannel("oil", 0, "degC", limits)], window_s=0.5)
    values = np.linspace(19.0, 21.0, 20, dtype=np.float32)

    def said(level, missing):
        samples = values + np.float32(level - 20.0)
        samples[:missing] = np.nan
        (one,) = unit.process(Window(0, samples.reshape(-1, 1), 10**9, 25e6))
        return one.quality, one.decision

    assert said(20.0, 2) == ("good", "normal")
    assert said(30.0, 8) == ("missing", "normal")  # perhaps
    assert said(33.0, 8) == ("missing", "alert")
    assert said(20.0, 8) == ("missing", "alert")
    assert said(20.0, 0) == ("good", "normal")
