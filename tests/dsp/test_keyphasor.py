"""Keyphasor: edges between samples, angle and speed, missing and double pulses, any cut into blocks."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.examples import examples

from daqsvc.dsp.speed.keyphasor import KeyphasorTracker
from sim_hw.plants.rotor import keyphasor_voltage

pytestmark = pytest.mark.property


def tracker(period=64.0, **options):
    return KeyphasorTracker(**{"threshold": -6.0, "hysteresis": 0.5, "period_samples": period, **options})


def ramps(period, phase, revolutions, *, skip=(), width=0.2):
    """Pulses with straight flanks two samples long, whose middle (0 V of -1..1) is the edge.

    Revolution ``i`` has its rising edge at sample ``(i + phase) * period``; those in ``skip`` have none.
    """
    t = np.arange(round(revolutions * period), dtype=np.float64)
    signal = np.full(len(t), -1.0)
    for i in range(revolutions):
        if i in skip:
            continue
        rise, fall = (i + phase) * period, (i + phase + width) * period
        pulse = np.minimum(np.clip(t - rise, -1.0, 1.0), np.clip(fall - t, -1.0, 1.0))
        signal = np.maximum(signal, pulse)
    return signal


def angle_error(angle, expected):
    """Largest difference of two angles in rad, around the circle; NaN left out."""
    known = ~np.isnan(angle)
    assert known.any()
    return float(np.abs(np.angle(np.exp(1j * (angle - expected)[known]))).max())


@settings(max_examples=examples(60), deadline=None)
@given(period=st.floats(12.0, 300.0), phase=st.floats(0.05, 0.7), off=st.floats(0.9, 1.1))
def test_edges_of_straight_flanks_are_exact(period, phase, off):
    subject = tracker(period * off, threshold=0.0, hysteresis=0.2)
    track = subject.process(ramps(period, phase, 12))
    edges = (np.arange(12) + phase) * period
    np.testing.assert_allclose(track.edges, edges, atol=1e-6)
    assert track.period_samples == pytest.approx(period, rel=1e-7)
    sample = np.arange(len(track.angle_rad))
    assert angle_error(track.angle_rad, 2 * math.pi * (sample / period - phase)) < 1e-5
    # Known from the second edge on, and not before.
    assert np.isnan(track.angle_rad[: math.floor(edges[1])]).all()
    assert not np.isnan(track.angle_rad[math.ceil(edges[1]) :]).any()


@settings(max_examples=examples(40), deadline=None)
@given(per_rev=st.floats(48.0, 256.0), noise_v=st.floats(0.0, 0.05), seed=st.integers(0, 1000))
def test_angle_of_a_simulated_probe(per_rev, noise_v, seed):
    revolution = np.arange(round(30 * per_rev)) / per_rev
    rng = np.random.default_rng(seed)
    voltage = keyphasor_voltage(revolution) + noise_v * rng.standard_normal(len(revolution))
    track = tracker(per_rev).process(voltage)
    # A smooth flank of a 1/32 revolution, cut by straight lines between samples: a quarter sample at most.
    assert angle_error(track.angle_rad, 2 * math.pi * revolution) < 2 * math.pi * 0.25 / per_rev + 0.01
    assert track.period_samples == pytest.approx(per_rev, rel=0.01)


@settings(max_examples=examples(60), deadline=None)
@given(
    period=st.floats(12.0, 100.0),
    phase=st.floats(0.05, 0.7),
    cuts=st.lists(st.floats(0.0, 1.0), max_size=15),
    lost=st.lists(st.tuples(st.floats(0.0, 1.0), st.integers(1, 60)), max_size=4),
    skip=st.sets(st.integers(1, 18), max_size=5),
)
def test_cutting_changes_nothing(period, phase, cuts, lost, skip):
    signal = ramps(period, phase, 20, skip=skip)
    for where, count in lost:
        begin = int(where * len(signal))
        signal[begin : begin + count] = np.nan
    options = {"threshold": 0.0, "hysteresis": 0.2}
    whole, pieces = tracker(period, **options), tracker(period, **options)
    expected = whole.process(signal)
    borders = [0, *sorted(int(cut * len(signal)) for cut in cuts), len(signal)]
    tracks = [pieces.process(signal[a:b]) for a, b in itertools.pairwise(borders)]
    np.testing.assert_array_equal(np.concatenate([t.angle_rad for t in tracks]), expected.angle_rad)
    edges = np.concatenate([t.edges + a for t, a in zip(tracks, borders, strict=False)])
    np.testing.assert_allclose(edges, expected.edges, rtol=0.0, atol=1e-9)
    assert pieces.counts == whole.counts
    assert pieces.revolutions_since_edge == whole.revolutions_since_edge


@settings(max_examples=examples(60), deadline=None)
@given(period=st.floats(20.0, 200.0), skip=st.sets(st.integers(3, 17), max_size=10))
def test_missing_pulses_are_counted_and_the_angle_runs_on(period, skip):
    subject = tracker(period, threshold=0.0, hysteresis=0.2)
    track = subject.process(ramps(period, 0.4, 20, skip=skip))
    trailing = next((i for i in range(20) if 19 - i not in skip), 0)
    assert subject.counts.missing == len(skip) - trailing
    assert subject.counts.accepted == 20 - len(skip)
    assert subject.counts.rejected == 0
    sample = np.arange(len(track.angle_rad))
    assert angle_error(track.angle_rad, 2 * math.pi * (sample / period - 0.4)) < 1e-5


@settings(max_examples=examples(60), deadline=None)
@given(
    period=st.floats(40.0, 200.0),
    extra=st.dictionaries(st.integers(3, 17), st.floats(0.35, 0.65), max_size=8),
)
def test_double_pulses_are_rejected_and_bend_nothing(period, extra):
    signal = ramps(period, 0.3, 20)
    t = np.arange(len(signal))
    for revolution, part in extra.items():
        rise = (revolution + 0.3 + part) * period
        signal = np.maximum(signal, np.minimum(np.clip(t - rise, -1, 1), np.clip(rise + 5 - t, -1, 1)))
    subject = tracker(period, threshold=0.0, hysteresis=0.2)
    track = subject.process(signal)
    assert subject.counts.rejected == len(extra)
    assert subject.counts.accepted == 20
    assert subject.counts.missing == 0
    assert angle_error(track.angle_rad, 2 * math.pi * (t / period - 0.3)) < 1e-5


@settings(max_examples=examples(30), deadline=None)
@given(part=st.floats(0.3, 0.7))
def test_first_pulse_may_be_a_wrong_one(part):
    period = 50.0
    signal = ramps(period, 0.3, 20)
    t = np.arange(len(signal))
    signal = np.where(t < period, -1.0, signal)
    rise = (0.3 + part) * period
    signal = np.maximum(signal, np.minimum(np.clip(t - rise, -1, 1), np.clip(rise + 3 - t, -1, 1)))
    subject = tracker(period, threshold=0.0, hysteresis=0.2)
    track = subject.process(signal)
    settled = t > 5 * period
    expected = 2 * math.pi * (t / period - 0.3)
    assert angle_error(track.angle_rad[settled], expected[settled]) < 1e-5


@settings(max_examples=examples(40), deadline=None)
@given(seed=st.integers(0, 1000), noise=st.floats(0.0, 0.09))
def test_hysteresis_keeps_noise_from_making_edges(seed, noise):
    signal = ramps(64.0, 0.3, 20) * 0.3
    signal += np.clip(noise * np.random.default_rng(seed).standard_normal(len(signal)), -0.09, 0.09)
    subject = tracker(64.0, threshold=0.0, hysteresis=0.2)
    subject.process(signal)
    assert subject.counts.accepted == 20
    assert subject.counts.rejected == 0


def test_falling_edge_is_the_rising_one_upside_down():
    signal = ramps(64.0, 0.3, 10)
    rising = tracker(64.0, threshold=0.1, hysteresis=0.2).process(signal)
    falling = tracker(64.0, threshold=-0.1, hysteresis=0.2, edge="falling").process(-signal)
    np.testing.assert_array_equal(rising.angle_rad, falling.angle_rad)


def test_edge_next_to_a_missing_sample_marks_nothing():
    signal = ramps(64.0, 0.5, 6)
    signal[3 * 64 + 31] = np.nan
    subject = tracker(64.0, threshold=0.0, hysteresis=0.2)
    track = subject.process(signal)
    assert len(track.edges) == 5
    assert subject.counts.missing == 1


def test_line_starts_anew_after_the_shaft_has_slipped():
    one, other = ramps(64.0, 0.2, 10), ramps(64.0, 0.6, 10)
    subject = tracker(64.0, threshold=0.0, hysteresis=0.2)
    track = subject.process(np.concatenate((one, other)))
    sample = np.arange(len(track.angle_rad))
    late = sample > 16 * 64
    expected = 2 * math.pi * (sample / 64.0 - 0.6)
    assert angle_error(track.angle_rad[late], expected[late]) < 1e-6
    assert subject.counts.rejected == 3


def test_time_without_edges_is_told():
    subject = tracker(64.0, threshold=0.0, hysteresis=0.2)
    subject.process(np.full(160, -1.0))
    assert subject.revolutions_since_edge == pytest.approx(2.5)
    subject.process(ramps(64.0, 0.5, 4))
    assert subject.revolutions_since_edge == pytest.approx(0.5, abs=0.03)
    assert subject.locked
    subject.reset()
    assert not subject.locked
    assert np.isnan(subject.process(np.full(10, -1.0)).angle_rad).all()


def pulses(turns, *, width=0.2):
    """Pulses with straight flanks two samples long at the whole numbers of a shaft's turns; exact edges."""
    sample = np.arange(len(turns), dtype=np.float64)
    whole = np.arange(math.ceil(turns[0]), math.floor(turns[-1]) - 1)
    signal = np.full(len(turns), -1.0)
    for rise, fall in zip(
        np.interp(whole, turns, sample), np.interp(whole + width, turns, sample), strict=True
    ):
        near = slice(max(0, int(rise) - 2), int(fall) + 3)
        there = sample[near]
        pulse = np.minimum(np.clip(there - rise, -1.0, 1.0), np.clip(fall - there, -1.0, 1.0))
        signal[near] = np.maximum(signal[near], pulse)
    return signal


@settings(max_examples=examples(25), deadline=None)
@given(
    slow=st.floats(120.0, 250.0),
    ratio=st.floats(2.0, 8.0),
    revolutions=st.integers(80, 200),
    down=st.booleans(),
)
def test_run_up_from_any_speed_leaves_no_lag(slow, ratio, revolutions, down):
    # Constant acceleration from 1 to `ratio` times the slow speed.
    begin, end = 1.0 / slow, ratio / slow
    n = round(2 * revolutions / (begin + end))
    sample = np.arange(n)
    turns = 0.3 + begin * sample + 0.5 * (end - begin) / n * sample**2
    if down:
        turns = turns[-1] - turns[::-1] + 0.3
    subject = tracker(50.0, threshold=0.0, hysteresis=0.2, period_range=(10.0, 400.0))
    track = subject.process(pulses(turns))
    expected = 2 * math.pi * turns
    first = int(np.argmin(np.isnan(track.angle_rad)))
    assert turns[first] < 6
    # An edge is interpolated on a straight flank, and the shaft's own turning is not straight there.
    assert angle_error(track.angle_rad[turns > 14], expected[turns > 14]) < 2e-3
    assert angle_error(track.angle_rad, expected) < 0.1
    assert subject.counts.rejected == subject.counts.missing == 0


@settings(max_examples=examples(15), deadline=None)
@given(seed=st.integers(0, 1000), per_rev=st.floats(40.0, 100.0))
def test_drift_is_followed_without_lag(seed, per_rev):
    sample = np.arange(round(300 * per_rev))
    speed = (1.0 + 0.01 * np.sin(2 * math.pi * sample / (100 * per_rev))) / per_rev
    turns = 0.5 + np.cumsum(speed)
    noise = 0.03 * np.clip(np.random.default_rng(seed).standard_normal(len(sample)), -3, 3)
    track = tracker(per_rev, threshold=0.0, hysteresis=0.2).process(pulses(turns) + noise)
    settled = turns > 14
    error = np.angle(np.exp(1j * (track.angle_rad - 2 * math.pi * turns)))[settled]
    # Scatter of the edges, 0.03 samples, and what a straight line through eight edges lags: 1.8 degrees.
    assert np.degrees(np.abs(error).max()) < 1.2 + 360 * 0.1 / per_rev
    assert np.degrees(error.std()) < 0.6


@settings(max_examples=examples(40), deadline=None)
@given(
    period=st.floats(40.0, 200.0),
    early=st.lists(st.floats(-0.15, 0.15), min_size=2, max_size=2),
    at=st.integers(14, 16),
)
def test_two_misplaced_edges_bend_nothing(period, early, at):
    turns = 0.5 + np.arange(round(25 * period)) / period
    signal = pulses(turns)
    sample = np.arange(len(turns))
    for revolution, off in zip((at, at + 3), early, strict=True):
        middle = round((revolution - 0.5) * period)
        near = np.abs(sample - middle) < 0.45 * period
        signal[near] = np.interp(sample[near] - off * period, sample, signal)
    track = tracker(period, threshold=0.0, hysteresis=0.2).process(signal)
    error = np.angle(np.exp(1j * (track.angle_rad - 2 * math.pi * turns)))
    known = turns > 10
    assert np.abs(error[known]).max() < 0.03


def test_acceleration_is_not_carried_on_for_ever():
    # The speed falls by 4 % a revolution until the pulses stop, and stays there.
    period = 64.0 * np.minimum(1.04 ** np.arange(40), 1.04**12)
    edges = 20.0 + np.concatenate(([0.0], np.cumsum(period)))
    turns = np.interp(np.arange(edges[-1]), edges, np.arange(len(edges)))
    signal = pulses(turns)
    signal[turns > 12.7] = -1.0
    track = tracker(64.0, threshold=0.0, hysteresis=0.2).process(signal)
    unwrapped = np.unwrap(track.angle_rad[turns > 3]) / (2 * math.pi)
    assert (np.diff(unwrapped) > 0.0).all()
    # Carried on, it would have come to rest in ten revolutions and turned back.
    speed = np.diff(unwrapped)[-1] * period[-1]
    assert 0.5 <= speed < 1.0


def test_lock_at_a_part_of_the_speed_is_found_out():
    # Every other pulse missing at first, then all are there.
    signal = ramps(64.0, 0.5, 40, skip={1, 3, 5, 7, 9})
    subject = tracker(64.0, threshold=0.0, hysteresis=0.2, period_range=(10.0, 400.0))
    track = subject.process(signal)
    assert subject.period_samples == pytest.approx(64.0)
    sample = np.arange(len(signal))
    late = sample > 22 * 64
    assert angle_error(track.angle_rad[late], (2 * math.pi * (sample / 64.0 - 0.5))[late]) < 1e-6


def test_lock_at_a_multiple_of_the_speed_is_found_out():
    # Two pulses a revolution at first, half a revolution apart.
    signal = np.concatenate((ramps(32.0, 0.5, 6), ramps(64.0, 0.25, 30)))
    subject = tracker(64.0, threshold=0.0, hysteresis=0.2, period_range=(10.0, 400.0))
    track = subject.process(signal)
    assert subject.period_samples == pytest.approx(64.0)
    sample = np.arange(len(signal))
    late = sample > 12 * 64
    assert angle_error(track.angle_rad[late], (2 * math.pi * (sample / 64.0 - 0.25))[late]) < 1e-6


def test_revolutions_are_not_counted_through_a_standstill():
    signal = np.concatenate((ramps(64.0, 0.5, 10), np.full(6400, -1.0), ramps(64.0, 0.2, 10)))
    subject = tracker(64.0, threshold=0.0, hysteresis=0.2)
    track = subject.process(signal)
    assert subject.counts.missing == 0
    assert subject.counts.accepted == 20
    sample = np.arange(len(signal)) - 7040
    late = sample > 2 * 64
    assert angle_error(track.angle_rad[late], (2 * math.pi * (sample / 64.0 - 0.2))[late]) < 1e-6


@pytest.mark.parametrize(
    ("figures", "words"),
    [
        ({"threshold": math.nan}, "threshold is nan"),
        ({"hysteresis": -0.1}, "hysteresis is -0.1"),
        ({"period": 1.5}, "1.5 samples per revolution"),
        ({"edge": "left"}, "'left'"),
        ({"line_edges": 1}, "through 1 edges"),
        ({"period_range": (1.0, 64.0)}, "between 1.0 and 64.0 samples"),
        ({"period_range": (64.0, 32.0)}, "shortest must be above 2"),
    ],
)
def test_impossible_figures_are_refused(figures, words):
    with pytest.raises(ValueError, match=words):
        tracker(**figures)
