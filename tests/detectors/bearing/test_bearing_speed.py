"""Bearings of a machine of variable speed: a keyphasor tells the speed, and a change of it clears nothing."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.bearing_signals import OUTER, RATE_HZ, SPEED_RPM, healthy, knocks

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.bearing.geometry import bearing_orders
from daqsvc.detectors.bearing.detector import BearingDetector
from daqsvc.detectors.bearing.housed import HousedBearing
from daqsvc.diagnosis.detector import Window
from daqsvc.dsp.speed.keyphasor import KeyphasorProbe
from daqsvc.dsp.speed.steadiness import SpeedError, measure_speed

if TYPE_CHECKING:
    from daqsvc.diagnosis.record import Diagnosis

pytestmark = pytest.mark.integration
KEYPHASOR = KeyphasorProbe("key", 1, threshold_v=-6.0)


def pulses(turns: np.ndarray) -> np.ndarray:
    """A keyphasor over shaft angles in revolutions: -10 V with a notch to -2 V."""
    return np.where(turns % 1.0 < 0.03, -2.0, -10.0)


def at_speed(seconds: float, speed_rpm: float, seed: int, *, damaged: bool = False) -> np.ndarray:
    """Housing and keyphasor, float32 ``[n, 2]``; damage of the outer race strikes at its order.

    What is made at one speed is that of another if it is played at another rate.
    """
    faster = speed_rpm / SPEED_RPM
    found = healthy(seconds * faster, seed, rate_hz=RATE_HZ / faster)
    if damaged:
        found += knocks(seconds * faster, OUTER, seed + 1, size=1.0, rate_hz=RATE_HZ / faster)
    turns = np.arange(len(found)) / RATE_HZ * speed_rpm / 60.0 + 0.4
    return np.column_stack((found, pulses(turns))).astype(np.float32)


def detector(**more: object) -> BearingDetector:
    bearing = HousedBearing("drive-end", "accel-de", 0, bearing_orders("6205-2RS"))
    given = {
        "machine": "motor", "stream": "housing", "rate_hz": RATE_HZ, "speed_rpm": SPEED_RPM,
        "bearings": [bearing], "keyphasor": KEYPHASOR, "calibrate_s": 10.0, **more,
    }  # fmt: skip
    return BearingDetector(**given)


def feed(watch: BearingDetector, *parts: np.ndarray) -> list[Diagnosis]:
    samples = np.concatenate(parts)
    period_ns = NS_PER_S / RATE_HZ
    ends = np.arange(0, len(samples) + 1, watch.block)
    said: list[Diagnosis] = []
    for begin, end in pairwise(ends):
        said += watch.process(Window(begin, samples[begin:end], round((end - 1) * period_ns), period_ns))
    return said


def test_the_lines_are_looked_for_at_the_measured_speed() -> None:
    """At 10 % more than stated: without the keyphasor the strikes are at no order of the bearing."""
    fast = at_speed(10.0, 1.1 * SPEED_RPM, 3, damaged=True)
    said = feed(detector(), fast)
    assert said[-1].decision == "outer"
    assert said[-1].statistics["speed"] == pytest.approx(1.1 * SPEED_RPM, rel=0.005)
    assert feed(detector(keyphasor=None), fast)[-1].decision != "outer"


def test_volts_that_no_sensor_measures_are_named() -> None:
    samples = at_speed(10.0, SPEED_RPM, 3, damaged=True)
    samples[::1000, 1] = 3e30
    said = feed(detector(), samples)
    assert {one.quality for one in said} == {"not_ok"}
    assert "key holds 3e+30 at sample 0" in said[-1].reason


def test_another_speed_begins_anew_and_clears_nothing() -> None:
    watch = detector()
    slow = 0.85 * SPEED_RPM
    parts = (
        at_speed(10.0, SPEED_RPM, 11),
        at_speed(10.0, SPEED_RPM, 13, damaged=True),
        at_speed(30.0, slow, 15),  # nothing strikes here, but nothing is known of the healthy machine either
        at_speed(40.0, SPEED_RPM, 17),
    )
    said = feed(watch, *parts)
    assert watch.baseline is not None
    assert watch.baseline.speed_rpm == pytest.approx(SPEED_RPM, rel=0.002)
    raised, away, back = said[7], said[8:20], said[20]
    assert (raised.decision, raised.quality) == ("outer", "good")
    assert "the speed has gone from 1797 to 1527 rpm: the evidence begins again" in away[0].reason
    assert "the healthy state is that at 1797 rpm: only damage with lines shows" in away[-1].reason
    assert {(d.quality, d.decision, d.changed) for d in away} == {("not_ok", "outer", False)}
    assert (back.quality, back.decision) == ("not_ok", "outer")
    assert "from 1527 to 1797 rpm" in back.reason
    # Back at the speed of the healthy machine eight good looks take it back.
    assert [d.decision for d in said[-8:]][-1] == "normal"
    assert [d.decision for d in said[21:28]] == ["outer"] * 7


def test_a_fault_shows_at_another_speed_too() -> None:
    parts = at_speed(10.0, SPEED_RPM, 21), at_speed(10.0, 0.85 * SPEED_RPM, 23, damaged=True)
    said = feed(detector(), *parts)
    assert (said[-1].decision, said[-1].quality) == ("outer", "good")


def test_a_healthy_state_is_learnt_at_one_speed() -> None:
    watch = detector()
    feed(watch, at_speed(7.5, SPEED_RPM, 31), at_speed(7.5, 0.8 * SPEED_RPM, 33))
    assert watch.baseline is None
    feed_on = at_speed(5.0, 0.8 * SPEED_RPM, 35)
    period_ns = NS_PER_S / RATE_HZ
    first = round(15.0 * RATE_HZ)
    for begin in range(0, len(feed_on), watch.block):
        watch.process(Window(first + begin, feed_on[begin : begin + watch.block], 0, period_ns))
    assert watch.baseline is not None
    assert watch.baseline.speed_rpm == pytest.approx(0.8 * SPEED_RPM, rel=0.002)


def test_a_run_up_or_a_dead_keyphasor_is_named_and_holds() -> None:
    steady = at_speed(10.0, SPEED_RPM, 41, damaged=True)
    run_up = at_speed(2.5, SPEED_RPM, 43)
    t = np.arange(len(run_up)) / RATE_HZ
    run_up[:, 1] = pulses(SPEED_RPM / 60.0 * (t + 0.02 * t**2))
    dead = at_speed(2.5, SPEED_RPM, 45)
    dead[:, 1] = -10.0
    said = feed(detector(), steady, run_up, dead)
    assert [(d.quality, d.decision) for d in said[-2:]] == [("not_ok", "outer")] * 2
    assert "the speed changes by 7" in said[-2].reason
    assert "key shows 0 pulses in 2.5 s; the shaft stands still, or the threshold is wrong" in said[-1].reason


@pytest.mark.parametrize("speed_rpm", [600.0, 1797.3, 6000.0])
def test_the_speed_is_right_to_a_thousandth(speed_rpm) -> None:
    turns = np.arange(round(2.5 * RATE_HZ)) / RATE_HZ * speed_rpm / 60.0
    speed = measure_speed(pulses(turns), KEYPHASOR, RATE_HZ)
    assert speed.rpm == pytest.approx(speed_rpm, rel=1e-3)
    assert speed.drift < 2e-3


def test_lost_and_second_pulses_do_not_matter_until_there_are_many() -> None:
    turns = np.arange(round(2.5 * RATE_HZ)) / RATE_HZ * 30.0
    volts = pulses(turns)
    volts[2400:2500] = np.nan
    volts[(turns > 20.5) & (turns < 20.53)] = -2.0
    assert measure_speed(volts, KEYPHASOR, RATE_HZ).rpm == pytest.approx(1800.0, rel=1e-3)
    noise = np.random.default_rng(1).choice([-10.0, -2.0], len(turns))
    with pytest.raises(SpeedError, match="times between pulses are not a revolution; adjust its threshold"):
        measure_speed(noise, KEYPHASOR, RATE_HZ)
