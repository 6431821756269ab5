"""Revolutions: any cut into blocks, exact edges, constant acceleration, missing and double pulses, run-up."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.examples import examples

from daqsvc.dsp.speed.revolutions import FixedSpeedCutter, KeyphasorCutter, OrbitCutter
from sim_hw.plants.rotor import keyphasor_voltage

pytestmark = pytest.mark.property


def keyphasor_cutter(period=64.0, **options):
    return KeyphasorCutter(
        **{"threshold": 0.0, "hysteresis": 0.2, "period_samples": period, "edge": "rising", **options}
    )


def pulses(turns, *, skip=(), extra=(), width=0.2):
    """Pulses whose flanks are straight in angle, two samples long or more, at whole numbers of turns.

    Those in ``skip`` are left out, those in ``extra`` (any number of turns) are there too.
    """
    sample = np.arange(len(turns), dtype=np.float64)
    rises = [t for t in range(math.ceil(turns[0]), math.floor(turns[-1])) if t not in skip]
    signal = np.full(len(turns), -1.0)
    for rise_turn in [*rises, *extra]:
        rise, fall = np.interp([rise_turn, rise_turn + width], turns, sample)
        near = slice(max(0, int(rise) - 2), int(fall) + 3)
        pulse = np.minimum(np.clip(sample[near] - rise, -1.0, 1.0), np.clip(fall - sample[near], -1.0, 1.0))
        signal[near] = np.maximum(signal[near], pulse)
    return signal


def orbit(turns, *, seed=0, noise=0.0):
    z = np.exp(2j * math.pi * (turns + 0.1)) + 0.2 * np.exp(-2j * math.pi * turns) + 3.0 - 4.0j
    xy = np.stack((z.real, z.imag), axis=1)
    return xy + noise * np.random.default_rng(seed).standard_normal(xy.shape)


def constant_acceleration(begin_period, end_period, revolutions):
    """Turns at every sample of a run between two speeds, from half a turn before a mark."""
    begin, end = 1.0 / begin_period, 1.0 / end_period
    n = round(2 * revolutions / (begin + end))
    sample = np.arange(n)
    return 0.5 + begin * sample + 0.5 * (end - begin) / n * sample**2


def errors(got, turns):
    """Error of the angle in rad per sample, and whether its revolution is trusted."""
    span = slice(got.first_index, got.first_index + len(got.xy))
    error = np.angle(np.exp(1j * (got.angle_rad - 2 * math.pi * turns[span])))
    return error, np.repeat(got.trusted, np.diff(np.append(got.starts, len(got.xy))))


def process_in_pieces(cutter, xy, marker, cuts):
    borders = [0, *sorted(int(cut * len(xy)) for cut in cuts), len(xy)]
    return [
        cutter.process(xy[a:b], None if marker is None else marker[a:b])
        for a, b in itertools.pairwise(borders)
    ]


def assert_same(pieces, whole):
    """The pieces follow each other without a gap, and make up the whole."""
    pieces = [piece for piece in pieces if len(piece)]
    for before, after in itertools.pairwise(pieces):
        assert after.first_index == before.first_index + len(before.xy)
    if not pieces:
        assert len(whole) == 0
        return
    first = pieces[0].first_index
    assert first == whole.first_index
    np.testing.assert_array_equal(np.concatenate([p.xy for p in pieces]), whole.xy)
    starts = [p.starts + p.first_index - first for p in pieces]
    np.testing.assert_array_equal(np.concatenate(starts), whole.starts)
    np.testing.assert_array_equal(np.concatenate([p.trusted for p in pieces]), whole.trusted)
    for name in ("angle_rad", "period_samples"):
        got = np.concatenate([getattr(p, name) for p in pieces])
        np.testing.assert_allclose(got, getattr(whole, name), rtol=0.0, atol=1e-9)


def assert_sound(got):
    """What holds of revolutions however bad the signal."""
    assert got.xy.shape == (len(got.angle_rad), 2)
    assert len(got.starts) == len(got.period_samples) == len(got.trusted) == len(got)
    assert ((got.angle_rad >= 0.0) & (got.angle_rad < 2 * math.pi)).all()
    assert (got.period_samples > 0.0).all()
    if len(got):
        lengths = np.diff(np.append(got.starts, len(got.xy)))
        assert got.starts[0] == 0
        assert (np.abs(lengths - got.period_samples) < 1.0 + 1e-9).all()
        # The angle rises within a revolution.
        rises = np.diff(got.angle_rad) > 0.0
        rises[got.starts[1:] - 1] = True
        assert rises.all()


cuts_anywhere = st.lists(st.floats(0.0, 1.0), max_size=12)


@settings(max_examples=examples(40), deadline=None)
@given(period=st.floats(3.0, 100.0), cuts=cuts_anywhere)
def test_fixed_speed_in_any_blocks(period, cuts):
    turns = np.arange(2000) / period
    xy = orbit(turns)
    whole = FixedSpeedCutter(period).process(xy)
    assert_sound(whole)
    assert len(whole) in {math.floor(2000 / period), math.floor(1999 / period)}
    assert whole.trusted.all()
    np.testing.assert_allclose(whole.period_samples, period, rtol=1e-9)
    assert np.abs(errors(whole, turns)[0]).max() < 1e-9
    assert_same(process_in_pieces(FixedSpeedCutter(period), xy, None, cuts), whole)


@settings(max_examples=examples(60), deadline=None)
@given(
    period=st.floats(12.0, 100.0),
    ratio=st.floats(0.4, 2.5),
    cuts=cuts_anywhere,
    lost=st.lists(st.tuples(st.floats(0.0, 1.0), st.integers(1, 60)), max_size=3),
    skip=st.sets(st.integers(1, 50), max_size=20),
    extra=st.lists(st.floats(1.0, 38.0), max_size=6),
    silent=st.tuples(st.integers(4, 30), st.integers(0, 12)),
)
def test_keyphasor_in_any_blocks(period, ratio, cuts, lost, skip, extra, silent):
    turns = constant_acceleration(period, ratio * period, 40)
    skip |= set(range(silent[0], sum(silent)))
    marker, xy = pulses(turns, skip=skip, extra=extra), orbit(turns)
    for where, count in lost:
        begin = int(where * len(marker))
        marker[begin : begin + count] = np.nan
    one, other = keyphasor_cutter(period), keyphasor_cutter(period)
    whole = one.process(xy, marker)
    assert_sound(whole)
    assert_same(process_in_pieces(other, xy, marker, cuts), whole)
    assert other.counts == one.counts


@settings(max_examples=examples(10), deadline=None)
@given(
    seed=st.integers(0, 100),
    cuts=cuts_anywhere,
    lost=st.lists(st.tuples(st.floats(0.0, 1.0), st.integers(1, 1500)), max_size=2),
    noise=st.sampled_from([0.1, 0.7, 10.0]),
)
def test_orbit_in_any_blocks(seed, cuts, lost, noise):
    turns = np.arange(80 * 40) / 40.3
    xy = orbit(turns, seed=seed, noise=noise)
    for where, count in lost:
        begin = int(where * len(xy))
        xy[begin : begin + count] = np.nan
    whole = OrbitCutter(40.0).process(xy)
    assert_sound(whole)
    assert_same(process_in_pieces(OrbitCutter(40.0), xy, None, cuts), whole)


@settings(max_examples=examples(40), deadline=None)
@given(period=st.floats(12.0, 300.0), phase=st.floats(0.0, 0.99), off=st.floats(0.2, 5.0))
def test_edges_of_straight_flanks_are_exact(period, phase, off):
    turns = phase + np.arange(round(14 * period)) / period
    got = keyphasor_cutter(max(period * off, 3.0)).process(orbit(turns), pulses(turns))
    assert_sound(got)
    assert got.trusted.all()
    assert len(got) in {10, 11, 12}
    # Far below a thousandth of a sample.
    np.testing.assert_allclose(got.period_samples, period, atol=1e-6)
    assert np.abs(errors(got, turns)[0]).max() < 1e-6


@settings(max_examples=examples(15), deadline=None)
@given(
    fast=st.floats(30.0, 80.0),
    ratio=st.floats(1.0, 8.0),
    revolutions=st.integers(160, 220),
    down=st.booleans(),
)
def test_constant_acceleration_leaves_no_error(fast, ratio, revolutions, down):
    turns = constant_acceleration(ratio * fast, fast, revolutions)
    if down:
        turns = turns[-1] - turns[::-1] + 0.5
    # Never a fifth faster than in the revolution before.
    got = keyphasor_cutter(fast * math.sqrt(ratio)).process(orbit(turns), pulses(turns))
    assert_sound(got)
    assert got.trusted.all()
    assert len(got) >= turns[-1] - turns[0] - 4
    # The first and last revolution have a neighbour on one side only; both parabolas are exact.
    assert np.abs(errors(got, turns)[0]).max() < 1e-3


@settings(max_examples=examples(20), deadline=None)
@given(direction=st.sampled_from([1, -1]), phase=st.floats(0.0, 1.0), noise_v=st.floats(0.0, 0.05))
def test_run_up_over_1_to_8_with_a_simulated_probe(direction, phase, noise_v):
    # 107 to 856 rad/s in 3 s, sampled at 17445 Hz: 13 % faster from the first revolution to the next.
    t = np.arange(52336) / 17445.4
    turns = (107.04 * t + 0.5 * (856.35 - 107.04) / 3.0 * t**2) / (2 * math.pi)
    turns = phase + (turns if direction > 0 else turns[-1] - turns[::-1])
    marker = keyphasor_voltage(turns) + noise_v * np.random.default_rng(5).standard_normal(len(turns))
    got = keyphasor_cutter(300.0, threshold=-6.0, hysteresis=0.5).process(orbit(turns), marker)
    assert got.trusted.all()
    assert len(got) >= turns[-1] - turns[0] - 4
    # A noisy flank, 64 samples to the revolution's 128 at full speed: a tenth of a sample.
    error = errors(got, turns)[0]
    assert np.abs(error).max() < 2e-3 + 0.3 * noise_v
    assert error.std() < 4e-4 + 0.05 * noise_v


@settings(max_examples=examples(40), deadline=None)
@given(
    period=st.floats(30.0, 200.0),
    first=st.integers(6, 20),
    missing=st.integers(1, 7),
    ratio=st.sampled_from([1.0, 0.7, 1.4]),
)
def test_up_to_three_missing_pulses_are_bridged(period, first, missing, ratio):
    turns = constant_acceleration(period, ratio * period, 40)
    skip = set(range(first, first + missing))
    subject = keyphasor_cutter(period)
    got = subject.process(orbit(turns), pulses(turns, skip=skip))
    assert_sound(got)
    assert len(got) == 37
    error, trusted = errors(got, turns)
    assert np.abs(error[trusted]).max() < 1e-3
    assert (~got.trusted).sum() == (0 if missing <= 3 else missing + 1)
    # Those that are not trusted begin with the pulse before the missing ones.
    if missing > 3:
        assert np.flatnonzero(~got.trusted)[0] == first - 2
    assert subject.counts.missing == missing
    assert subject.counts.accepted == 39 - missing


@settings(max_examples=examples(40), deadline=None)
@given(
    period=st.floats(40.0, 200.0),
    ratio=st.sampled_from([1.0, 0.8, 1.25]),
    # One that comes exactly half a revolution later for four revolutions makes twice the speed.
    extra=st.dictionaries(
        st.integers(6, 35), st.one_of(st.floats(0.3, 0.46), st.floats(0.54, 0.7)), max_size=12
    ),
)
def test_double_pulses_change_nothing(period, ratio, extra):
    turns = constant_acceleration(period, ratio * period, 40)
    subject = keyphasor_cutter(period)
    got = subject.process(
        orbit(turns), pulses(turns, extra=[turn + part for turn, part in extra.items()], width=0.1)
    )
    assert got.trusted.all()
    assert len(got) == 37
    assert np.abs(errors(got, turns)[0]).max() < 1e-3
    assert subject.counts.rejected == len(extra)


@settings(max_examples=examples(40), deadline=None)
@given(
    period=st.floats(16.0, 120.0),
    expected=st.sampled_from([0.5, 0.8, 1.0, 1.25, 2.0]),
    before=st.floats(0.0, 30.0),
    lost=st.floats(1.0, 60.0),
    hum_per_turn=st.floats(0.15, 12.0),
    hum=st.sampled_from([0.0, 1.5]),
    noise=st.sampled_from([0.0, 0.3, 1.0, 7.0]),
    seed=st.integers(0, 1000),
    cuts=cuts_anywhere,
)
def test_pulses_that_come_back_are_believed_again(
    period, expected, before, lost, hum_per_turn, hum, noise, seed, cuts
):
    turns = 0.3 + np.arange(round((before + lost + 40) * period)) / period
    marker = pulses(turns)
    begin, end = round(before * period), round((before + lost) * period)
    rng = np.random.default_rng(seed)
    marker[begin:end] = hum * np.sin(2 * math.pi * (hum_per_turn * turns[begin:end] + rng.uniform()))
    marker[begin:end] += noise * rng.standard_normal(end - begin)
    xy = orbit(turns)
    got = keyphasor_cutter(expected * period).process(xy, marker)
    assert_sound(got)
    assert_same(process_in_pieces(keyphasor_cutter(expected * period), xy, marker, cuts), got)
    # Whatever the line was locked to, eight edges in step unmask it, and eight more fill it.
    begins = turns[got.first_index + got.starts]
    back = begins > turns[end] + 20.0
    assert back.sum() >= 15
    assert got.trusted[back].all()
    np.testing.assert_allclose(got.period_samples[back], period, rtol=1e-3)
    error, _ = errors(got, turns)
    late = np.repeat(back, np.diff(np.append(got.starts, len(got.xy))))
    assert np.abs(error[late]).max() < 0.02


@settings(max_examples=examples(15), deadline=None)
@given(
    cutter=st.sampled_from(["fixed", "keyphasor", "orbit"]),
    before=st.integers(0, 1000),
    period=st.floats(30.0, 60.0),
)
def test_after_a_reset_nothing_is_left_of_before(cutter, before, period):
    make = {"fixed": FixedSpeedCutter, "keyphasor": keyphasor_cutter, "orbit": OrbitCutter}[cutter]
    turns = 0.3 + np.arange(2500) / period
    xy, marker = orbit(turns, noise=0.1), pulses(turns)
    used, fresh = make(period), make(period)
    used.process(np.full((before, 2), 5.0), np.sin(np.arange(before)))
    used.reset()
    assert_same([used.process(xy, marker)], fresh.process(xy, marker))


@settings(max_examples=examples(8), deadline=None)
@given(
    seed=st.integers(0, 1000),
    law=st.sampled_from(["off by 2 %", "off by -2 %", "ramp", "sine"]),
    backward=st.booleans(),
)
def test_orbit_at_0_db_follows_drift(seed, law, backward):
    # 0 dB: noise in each channel as strong as the 1X in it; 64 samples a revolution, 350 revolutions.
    revolution = np.arange(350 * 64) / 64.0
    speed = {
        "off by 2 %": np.full(len(revolution), 1.02),
        "off by -2 %": np.full(len(revolution), 0.98),
        "ramp": 1.0 + 0.01 * np.clip((revolution - 50.0) / 100.0, 0.0, 1.0),
        "sine": 1.0 + 0.01 * np.sin(2 * math.pi * revolution / 100.0),
    }[law]
    turns = np.cumsum(speed) / 64.0
    z = np.exp(2j * math.pi * turns)
    xy = np.stack((z.real, -z.imag if backward else z.imag), axis=1) + np.array([100.0, -50.0])
    xy += math.sqrt(0.5) * np.random.default_rng(seed).standard_normal(xy.shape)
    got = OrbitCutter(64.0).process(xy)
    assert_sound(got)
    assert got.trusted.all()
    assert len(got) >= turns[-1] - turns[0] - 7
    error, _ = errors(got, turns)
    error = np.degrees(np.angle(np.exp(1j * error) / np.mean(np.exp(1j * error))))
    # 1.6 in the mean of many runs; read at the end of the parabola it would be 2.5.
    assert error.std() < 2.3


@pytest.mark.parametrize("noise", [0.0, 0.7])
def test_first_angle_of_an_orbit_is_that_of_its_1x(noise):
    turns = np.arange(64 * 60) / 64.0
    got = OrbitCutter(63.0).process(orbit(turns, noise=noise))
    # `orbit` has its 1X a tenth of a turn ahead of the shaft.
    error, _ = errors(got, turns + 0.1)
    assert abs(float(np.mean(error))) < 0.005 + 0.05 * noise
