"""Revolutions: what is trusted when the keyphasor fails, the lag, the memory, and what is refused."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest

from daqsvc.dsp.speed.revolutions import FixedSpeedCutter, KeyphasorCutter, OrbitCutter
from sim_hw.plants.rotor import keyphasor_voltage


def cutter(period=64.0, **options):
    return KeyphasorCutter(threshold=-6.0, hysteresis=0.5, period_samples=period, **options)


def steady(revolutions, per_rev=64.0, begin=0.5):
    turns = begin + np.arange(round(revolutions * per_rev)) / per_rev
    xy = np.stack((np.cos(2 * math.pi * turns), np.sin(2 * math.pi * turns)), axis=1)
    return turns, xy


def angle_errors(got, turns):
    expected = 2 * math.pi * turns[got.first_index : got.first_index + len(got.xy)]
    return np.abs(np.angle(np.exp(1j * (got.angle_rad - expected))))


def per_sample(got, values):
    return np.repeat(values, np.diff(np.append(got.starts, len(got.xy))))


def test_a_fixed_speed_needs_no_marker_and_begins_at_angle_zero():
    subject = FixedSpeedCutter(2.5)
    got = subject.process(np.arange(12.0).reshape(6, 2), None)
    np.testing.assert_allclose(got.angle_rad, 2 * math.pi * np.array([0.0, 0.4, 0.8, 0.2, 0.6]))
    assert got.starts.tolist() == [0, 3]
    assert got.xy[:, 0].tolist() == [0.0, 2.0, 4.0, 6.0, 8.0]
    assert got.period_samples.tolist() == [2.5, 2.5]
    # The next one begins with the sample held back.
    rest = subject.process(np.zeros((3, 2)), None)
    assert (rest.first_index, rest.starts.tolist(), rest.xy[0, 0]) == (5, [0], 10.0)


def test_keyphasor_revolutions_come_one_late():
    turns, xy = steady(40)
    marker = keyphasor_voltage(turns)
    subject = cutter()
    lag = []
    for begin in range(0, len(xy), 8):
        got = subject.process(xy[begin : begin + 8], marker[begin : begin + 8])
        lag += [(begin + 8 - got.first_index - len(got.xy)) / 64] if len(got) else []
    assert len(lag) > 30
    assert max(lag[1:]) < 1.2


def test_a_dead_keyphasor_is_bridged_by_guesses_in_bounded_memory():
    _, xy = steady(2000)
    subject = cutter()
    done = trusted = 0
    tracemalloc.start()
    for begin in range(0, len(xy), 640):
        got = subject.process(xy[begin : begin + 640], np.full(640, -10.0))
        done += len(got)
        trusted += int(got.trusted.sum())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert trusted == 0
    assert done > 1940
    # 55 revolutions of the slowest speed are waited for at first: 35,000 samples of 16 bytes.
    assert peak < 4e6


def test_a_keyphasor_that_comes_back_is_trusted_again():
    turns, xy = steady(60)
    marker = keyphasor_voltage(turns)
    marker[20 * 64 : 30 * 64] = -10.0
    got = cutter().process(xy, marker)
    trusted = per_sample(got, got.trusted)
    error = angle_errors(got, turns)
    assert error[trusted].max() < 0.03
    revolution = turns[got.first_index + got.starts]
    silent = (revolution > 19.4) & (revolution < 30.4)
    assert not got.trusted[silent].any()
    assert got.trusted[~silent].all()
    assert len(got) == 58


def test_a_slipped_mark_is_not_trusted_and_the_samples_stay_in_a_row():
    turns, xy = steady(60)
    marker = np.concatenate((keyphasor_voltage(turns[:1920]), keyphasor_voltage(turns[1920:] + 0.4)))
    got = cutter().process(xy, marker)
    assert abs(len(got.xy) - got.period_samples.sum()) < 1.0
    slipped = np.flatnonzero(~got.trusted)
    assert 1 <= len(slipped) <= 4
    truth = np.where(np.arange(len(turns)) < 1920, turns, turns + 0.4)
    assert angle_errors(got, truth)[per_sample(got, got.trusted)].max() < 0.03


def test_a_jump_of_the_speed_is_not_trusted():
    speed = np.where(np.arange(3840) < 1930, 1 / 64.0, 1.35 / 64.0)
    turns = 0.5 + np.cumsum(speed)
    got = cutter().process(np.zeros((3840, 2)), keyphasor_voltage(turns))
    doubted = turns[got.first_index + got.starts[~got.trusted]]
    # The revolution with the jump, at 30.7 turns, and the next; a smaller jump is taken as it comes.
    assert np.round(doubted).tolist() == [30, 31]
    speed = np.where(np.arange(3840) < 1930, 1 / 64.0, 1.1 / 64.0)
    turns = 0.5 + np.cumsum(speed)
    assert cutter().process(np.zeros((3840, 2)), keyphasor_voltage(turns)).trusted.all()


def test_one_misplaced_pulse_is_not_trusted_on_either_side():
    turns, xy = steady(40)
    marker = keyphasor_voltage(turns + 0.15 * ((turns > 19.5) & (turns < 20.5)))
    got = cutter().process(xy, marker)
    assert np.round(turns[got.first_index + got.starts[~got.trusted]]).tolist() == [19, 20]


def test_falling_edges():
    turns, xy = steady(20)
    got = cutter(edge="falling").process(xy, keyphasor_voltage(turns))
    # The pulse is a sixteenth wide at its foot, half of that where it crosses -6 V.
    assert angle_errors(got, turns - 1 / 32).max() < 0.03


def test_missing_probe_samples_are_passed_on_as_they_are():
    turns, xy = steady(20)
    xy[300:310] = np.nan
    got = cutter().process(xy, keyphasor_voltage(turns))
    assert got.trusted.all()
    np.testing.assert_array_equal(got.xy, xy[got.first_index : got.first_index + len(got.xy)])


def test_an_orbit_lost_for_long_is_searched_anew():
    turns, xy = steady(200)
    xy += 0.1 * np.random.default_rng(2).standard_normal(xy.shape)
    xy[80 * 64 : 120 * 64] = np.nan
    subject = OrbitCutter(64.0)
    got = subject.process(xy)
    begins = turns[got.first_index + got.starts]
    assert got.trusted[(begins > 2) & (begins < 78)].all()
    # Three revolutions are bridged on either side.
    assert not got.trusted[(begins > 84) & (begins < 116)].any()
    assert got.trusted[begins > 140].all()
    error = np.degrees(angle_errors(got, turns))
    assert error[per_sample(got, got.trusted & (begins > 140))].max() < 5
    assert subject.counts.missing > 15


def test_an_orbit_that_loses_its_1x_is_not_trusted():
    turns, xy = steady(200)
    rng = np.random.default_rng(4)
    xy[turns > 80] = 0.0
    xy += 0.3 * rng.standard_normal(xy.shape)
    got = OrbitCutter(64.0).process(xy)
    begins = turns[got.first_index + got.starts]
    assert got.trusted[begins < 76].all()
    # What is left of the good phases in the window carries the angle for a while.
    assert not got.trusted[(begins > 90) & (begins < 180)].any()


def test_no_late_crossing_changes_what_was_overdue():
    # Eight revolutions without a pulse, settled sample by sample or by the edge that ends them.
    turns, xy = steady(60)
    marker = keyphasor_voltage(turns)
    marker[20 * 64 + 16 : 28 * 64 + 16] = -10.0
    whole, one = cutter().process(xy, marker), cutter()
    pieces = [one.process(xy[a : a + 1], marker[a : a + 1]) for a in range(len(xy))]
    np.testing.assert_array_equal(np.concatenate([p.angle_rad for p in pieces]), whole.angle_rad)
    np.testing.assert_array_equal(np.concatenate([p.trusted for p in pieces]), whole.trusted)


def test_an_orbit_without_1x_is_never_trusted():
    rng = np.random.default_rng(3)
    got = OrbitCutter(64.0).process(rng.standard_normal((64 * 100, 2)))
    assert len(got) > 80
    assert not got.trusted.any()


def test_a_phase_that_jumps_with_a_fault_becomes_the_new_zero_slowly():
    turns, _ = steady(200)
    jumped = turns + np.where(turns > 100, 1 / 12, 0.0)
    xy = np.stack((np.cos(2 * math.pi * jumped), np.sin(2 * math.pi * jumped)), axis=1)
    got = OrbitCutter(64.0).process(xy)
    assert got.trusted.all()
    shift = np.degrees(
        np.angle(np.exp(1j * (got.angle_rad - 2 * math.pi * turns[got.first_index :][: len(got.xy)])))
    )
    begins = per_sample(got, turns[got.first_index + got.starts])
    assert np.abs(shift[begins < 80]).max() < 1
    assert np.abs(shift[begins > 140] - 30).max() < 1
    half = begins[np.argmax(shift > 15)]
    assert 98 < half < 112


@pytest.mark.parametrize("make", [FixedSpeedCutter, cutter, OrbitCutter])
@pytest.mark.parametrize("period", [1.9, math.nan, math.inf, -64.0])
def test_impossible_periods_are_refused(make, period):
    with pytest.raises(ValueError, match=rf"revolutions of {period} samples"):
        make(period)


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"two probes \[n, 2\], not from an array \[5, 3\]"):
        FixedSpeedCutter(64.0).process(np.zeros((5, 3)))
    with pytest.raises(ValueError, match=r"5 samples of the probes, but \[4\]"):
        cutter().process(np.zeros((5, 2)), np.zeros(4))
    with pytest.raises(ValueError, match="needs the keyphasor's samples"):
        cutter().process(np.zeros((5, 2)), None)
