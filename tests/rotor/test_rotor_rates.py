"""Thresholds from how often a bank may be wrong."""

from __future__ import annotations

import math

import pytest

from daqsvc.rotor.decision import DecisionRules

PAPER = {"speed_rpm": 600.0, "samples_per_rev": 64.0, "modes": 4}


def test_defaults_come_from_one_false_alarm_in_50000_revolutions_and_ten_thousand_hours():
    rules = DecisionRules.from_rates(false_alarms_per_1000_rev=0.02, mtbf_hours=10_000.0, **PAPER)
    default = DecisionRules()
    assert rules.threshold_nats == pytest.approx(default.threshold_nats, abs=0.2)
    assert rules.back_threshold_nats == pytest.approx(default.back_threshold_nats, abs=0.2)
    assert rules.threshold_nats == pytest.approx(-math.log(0.02 / 1000.0 / 64.0 / 3.0))


def test_ten_times_fewer_false_alarms_cost_two_nats():
    often, rarely = (
        DecisionRules.from_rates(false_alarms_per_1000_rev=rate, mtbf_hours=None, **PAPER)
        for rate in (0.1, 0.01)
    )
    assert rarely.threshold_nats - often.threshold_nats == pytest.approx(math.log(10.0))
    assert rarely.back_threshold_nats == often.back_threshold_nats == DecisionRules().back_threshold_nats


def test_direction_of_rotation_does_not_matter():
    forward, backward = (
        DecisionRules.from_rates(
            false_alarms_per_1000_rev=None, mtbf_hours=500.0, **{**PAPER, "speed_rpm": speed}
        )
        for speed in (600.0, -600.0)
    )
    assert forward == backward
    assert forward.threshold_nats == DecisionRules().threshold_nats


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("name", ["false_alarms_per_1000_rev", "mtbf_hours"])
def test_impossible_rates_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=name):
        DecisionRules.from_rates(
            **{"false_alarms_per_1000_rev": None, "mtbf_hours": None, name: value}, **PAPER
        )


def test_rate_that_asks_for_no_evidence_is_refused():
    with pytest.raises(ValueError, match="threshold_nats is -"):
        DecisionRules.from_rates(false_alarms_per_1000_rev=1e6, mtbf_hours=None, **PAPER)
