"""Setpoints against a plain model that looks at the whole history every time."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daqsvc.alarms.setpoints import Setpoint, SetpointMonitor
from daqsvc.alarms.states import Level

pytestmark = pytest.mark.property
LIMITS = st.tuples(st.none() | st.integers(1, 6), st.none() | st.integers(7, 12)).filter(any)
LOW_LIMITS = st.tuples(st.none() | st.integers(-1, 0), st.none() | st.integers(-9, -2))
STEPS = st.lists(
    st.tuples(
        st.one_of(st.integers(-12, 15).map(float), st.just(math.nan), st.just(math.inf), st.just(-math.inf)),
        st.integers(0, 4),
    ),
    max_size=40,
)


def known_stretch(history, says):
    """Time, between known neighbours, over which the newest values have all fulfilled ``says``.

    None if the newest known value does not.
    """
    if math.isnan(history[-1][1]):
        return None
    total, later = None, None
    for t, value in reversed(history):
        if math.isnan(value):
            later = None
            continue
        if not says(value):
            break
        total = 0 if total is None else total + (0 if later is None else later - t)
        later = t
    return total


def reference(setpoint, history):
    """The level after ``history``, one limit at a time, each by replaying everything."""

    def reached(beyond, clear):
        state, since = False, 0
        for end in range(1, len(history) + 1):
            part = history[since:end]
            stretch = known_stretch(part, clear if state else beyond)
            if stretch is not None and stretch >= (setpoint.off_delay_ns if state else setpoint.on_delay_ns):
                state, since = not state, end
        return state

    def above(limit):
        return limit is not None and reached(
            lambda value: value >= limit, lambda value: value < limit - setpoint.deadband
        )

    def below(limit):
        return limit is not None and reached(
            lambda value: value <= limit, lambda value: value > limit + setpoint.deadband
        )

    if above(setpoint.danger) or below(setpoint.danger_low):
        return Level.DANGER
    if above(setpoint.alert) or below(setpoint.alert_low):
        return Level.ALERT
    return Level.NORMAL


@given(
    limits=LIMITS,
    low_limits=LOW_LIMITS,
    deadband=st.integers(0, 4),
    on_delay=st.integers(0, 6),
    off_delay=st.integers(0, 6),
    steps=STEPS,
)
def test_agrees_with_the_model(limits, low_limits, deadband, on_delay, off_delay, steps):
    setpoint = Setpoint(limits[0], limits[1], deadband, on_delay, off_delay, *low_limits)
    monitor = SetpointMonitor(setpoint)
    history, t_ns = [], 0
    for value, step_ns in steps:
        t_ns += step_ns
        history.append((t_ns, math.nan if value == -math.inf else value))
        assert monitor.update(value, t_ns) is reference(setpoint, history)


@given(
    steps=st.lists(st.sampled_from([math.nan, -math.inf]), max_size=20),
    start=st.sampled_from([0.0, 5.0, 20.0]),
)
def test_missing_values_change_nothing(steps, start):
    monitor = SetpointMonitor(Setpoint(alert=4.0, danger=10.0))
    level = monitor.update(start, 0)
    for t_ns, value in enumerate(steps, 1):
        assert monitor.update(value, t_ns * 10**12) is level


def test_a_gap_does_not_count_towards_a_delay():
    monitor = SetpointMonitor(Setpoint(alert=1.0, on_delay_ns=10))
    assert monitor.update(2.0, 0) is Level.NORMAL
    monitor.hold()
    assert monitor.update(2.0, 100) is Level.NORMAL
    assert monitor.update(2.0, 109) is Level.NORMAL
    assert monitor.update(2.0, 110) is Level.ALERT


def test_after_a_restart_the_value_must_be_clear_of_the_limits_on_both_sides():
    for side in (-1.0, 1.0):
        monitor = SetpointMonitor(Setpoint(alert=10.0, deadband=2.0, alert_low=-10.0))
        monitor.resume(Level.ALERT)
        assert monitor.update(side * 9.0, 0) is Level.ALERT
        assert monitor.reached(side * 9.0).at == side * 10.0
        assert monitor.update(side * 7.9, 0) is Level.NORMAL


def test_a_start_up_multiplies_upper_limits_only():
    monitor = SetpointMonitor(Setpoint(alert=4.0, alert_low=1.0))
    assert monitor.update(6.0, 0, factor=2.0) is Level.NORMAL
    assert monitor.update(1.5, 1, factor=2.0) is Level.NORMAL
    assert monitor.update(0.9, 2, factor=2.0) is Level.ALERT
    assert monitor.reached(0.9).lower


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({}, "neither"),
        ({"alert": 2.0, "danger": 2.0}, "below"),
        ({"alert": math.nan}, "finite"),
        ({"alert_low": 3.0, "alert": 2.0}, "alert_low 3.0 must lie below alert 2.0"),
        ({"danger_low": 2.0, "alert_low": 2.0}, "below"),
        ({"danger_low": -math.inf}, "danger_low -inf"),
        ({"alert": 1.0, "deadband": -1.0}, "deadband"),
        ({"alert": 1.0, "on_delay_ns": -1}, "negative"),
        ({"alert": 1.0, "off_delay_ns": -1}, "negative"),
    ],
)
def test_nonsense_is_refused(arguments, says):
    with pytest.raises(ValueError, match=says):
        Setpoint(**arguments)
