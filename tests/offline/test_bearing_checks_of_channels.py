"""What is known against a recording whose channel shows no machine, or whose orders are mistaken."""

from __future__ import annotations

import numpy as np
import pytest
from support.race_signals import BEARING, RATE_HZ, SPEED_RPM, strikes

from daqsvc.bearing.geometry import BearingOrders, bearing_orders
from daqsvc.bearing.race import race_test
from daqsvc.detectors.bearing.recorded_checks import ball_order_problem
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.quality.unit import refuse_no_machine


@pytest.mark.parametrize("rms_g", [2e-5, 1e-6])
def test_the_noise_of_an_unplugged_sensor_is_no_machine(rms_g: float) -> None:
    noise = rms_g * np.random.default_rng(0).standard_normal(60_000)
    verdict = race_test(noise, RATE_HZ, SPEED_RPM, BEARING)
    with pytest.raises(UnfitError, match=r"shows no machine: \S+ g r.m.s.*check sensor, cable"):
        refuse_no_machine(noise, "g", seen=verdict.speed_seen or verdict.verdict != "normal")
    refuse_no_machine(noise * 1e4, "g", seen=verdict.speed_seen or verdict.verdict != "normal")


def test_a_quiet_machine_whose_speed_is_seen_is_one() -> None:
    samples = 1e-5 * strikes(None)
    verdict = race_test(samples, RATE_HZ, SPEED_RPM, BEARING)
    assert verdict.speed_seen
    refuse_no_machine(samples, "g", seen=verdict.speed_seen or verdict.verdict != "normal")


@pytest.mark.parametrize("designation", ["6205-2RS", "6203"])
def test_twice_the_frequency_of_a_balls_spin_is_noticed(designation: str) -> None:
    right = bearing_orders(designation)
    twice = BearingOrders(inner=right.inner, outer=right.outer, ball=2.0 * right.ball, cage=right.cage)
    assert f"BSF {twice.ball:g} is twice" in ball_order_problem(twice)
    assert not ball_order_problem(right)
