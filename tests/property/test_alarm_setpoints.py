"""Setpoints against a plain model that looks at the whole history every time."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daqsvc.alarms.setpoints import Setpoint, SetpointMonitor
from daqsvc.alarms.states import Level

LIMITS = st.tuples(st.none() | st.integers(1, 6), st.none() | st.integers(7, 12)).filter(any)
STEPS = st.lists(
    st.tuples(
        st.one_of(st.integers(-2, 15).map(float), st.just(math.nan), st.just(math.inf), st.just(-math.inf)),
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

    def reached(limit):
        state, since = False, 0
        for end in range(1, len(history) + 1):
            part = history[since:end]
            if state:
                stretch = known_stretch(part, lambda value: value < limit - setpoint.deadband)
                changes = stretch is not None and stretch >= setpoint.off_delay_ns
            else:
                stretch = known_stretch(part, lambda value: value >= limit)
                changes = stretch is not None and stretch >= setpoint.on_delay_ns
            if changes:
                state, since = not state, end
        return state

    if setpoint.danger is not None and reached(setpoint.danger):
        return Level.DANGER
    if setpoint.alert is not None and reached(setpoint.alert):
        return Level.ALERT
    return Level.NORMAL


@given(
    limits=LIMITS,
    deadband=st.integers(0, 4),
    on_delay=st.integers(0, 6),
    off_delay=st.integers(0, 6),
    steps=STEPS,
)
def test_agrees_with_the_model(limits, deadband, on_delay, off_delay, steps):
    setpoint = Setpoint(limits[0], limits[1], deadband, on_delay, off_delay)
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


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({}, "neither"),
        ({"alert": 2.0, "danger": 2.0}, "below"),
        ({"alert": math.nan}, "finite"),
        ({"alert": 1.0, "deadband": -1.0}, "deadband"),
        ({"alert": 1.0, "on_delay_ns": -1}, "negative"),
        ({"alert": 1.0, "off_delay_ns": -1}, "negative"),
    ],
)
def test_nonsense_is_refused(arguments, says):
    with pytest.raises(ValueError, match=says):
        Setpoint(**arguments)
