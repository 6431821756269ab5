"""1X, 2X and what is left without 1X, of signals of which all that is known; kurtosis likewise."""

from __future__ import annotations

import math

import numpy as np
import pytest

from daqsvc.dsp.levels import kurtosis
from daqsvc.dsp.phase import deviation_deg
from daqsvc.dsp.window_orders import phase_lag_deg, steady_angle, window_orders

RATE_HZ = 640.0
T = np.arange(320) / RATE_HZ
ANGLE = math.tau * 10.0 * T


def shaken(angle=ANGLE, first=42.0, lag_deg=135.0, second=7.0, lag_2_deg=300.0):
    return (
        5.0
        + first * np.cos(angle - math.radians(lag_deg))
        + second * np.cos(2.0 * angle - math.radians(lag_2_deg))
    )


@pytest.mark.parametrize("lag_deg", [0.0, 1.0, 89.0, 180.0, 271.0, 359.0])
def test_amplitude_and_lag_of_a_sine_are_its_own(lag_deg):
    found = window_orders(shaken(lag_deg=lag_deg, lag_2_deg=360.0 - lag_deg), ANGLE % math.tau)
    assert abs(found.first) == pytest.approx(42.0)
    assert abs(found.second) == pytest.approx(7.0)
    # Of a perfect signal the last digit decides on which side of 360 it lies.
    assert deviation_deg(phase_lag_deg(found.first, 0.0), lag_deg) < 1e-9
    assert deviation_deg(phase_lag_deg(found.second, 0.0), -lag_deg) < 1e-9
    assert 0.0 <= phase_lag_deg(found.first, 0.0) < 360.0


def test_a_peak_that_comes_a_quarter_turn_after_the_mark_lags_by_90_degrees():
    """The convention itself, without a formula: the sample at which the signal is largest."""
    samples = np.zeros(64)
    samples[13:20] = [0.2, 0.6, 0.9, 1.0, 0.9, 0.6, 0.2]  # peak at sample 16 of 64: a quarter turn
    found = window_orders(np.tile(samples, 4), math.tau * np.arange(256) / 64.0)
    assert phase_lag_deg(found.first, 0.0) == pytest.approx(90.0)
    assert phase_lag_deg(found.second, 0.0) == pytest.approx(180.0)


def test_of_a_square_1x_is_four_over_pi_and_the_rest_is_the_rest():
    square = np.where((ANGLE + 0.01) % math.tau < math.pi, 3.0, -3.0)
    found = window_orders(square, ANGLE)
    assert abs(found.first) == pytest.approx(3.0 * 4.0 / math.pi, rel=2e-3)
    assert abs(found.second) < 1e-9
    assert found.rest_rms == pytest.approx(3.0 * math.sqrt(1.0 - 8.0 / math.pi**2), rel=3e-3)


def test_not_1x_is_what_the_other_orders_leave():
    found = window_orders(shaken(second=7.0) + 3.0 * np.cos(3.0 * ANGLE), ANGLE)
    assert found.rest_rms == pytest.approx(math.hypot(7.0, 3.0) / math.sqrt(2.0))
    alone = window_orders(shaken(second=7.0), ANGLE)
    assert alone.rest_peak_to_peak == pytest.approx(14.0, rel=3e-3)


def test_a_part_of_a_revolution_at_the_end_does_not_leak_into_1x():
    angle = math.tau * 10.7 * T  # 5.35 revolutions
    third = shaken(angle) + 40.0 * np.cos(3.0 * angle)
    assert abs(window_orders(third, angle).first) == pytest.approx(42.0, rel=0.01)


def test_missing_samples_do_not_bias_it():
    samples = shaken()
    samples[np.random.default_rng(1).random(len(samples)) < 0.3] = np.nan
    found = window_orders(samples, ANGLE)
    assert abs(found.first) == pytest.approx(42.0)
    assert found.rest_rms == pytest.approx(7.0 / math.sqrt(2.0), rel=0.05)


@pytest.mark.parametrize(
    ("samples", "angle"),
    [
        (shaken()[:60], ANGLE[:60]),  # less than a revolution
        (shaken(), math.tau * 100.0 * T),  # 6.4 samples in one
        (shaken(), np.full(320, np.nan)),
        (np.where(ANGLE % math.tau < 3.6, np.nan, shaken()), ANGLE),  # the same half of each is missing
        (np.full(320, np.nan), ANGLE),
    ],
)
def test_what_cannot_be_told_is_not(samples, angle):
    assert window_orders(samples, angle) is None


def test_an_angle_that_becomes_known_is_used_from_there():
    angle = np.where(np.arange(320) < 100, np.nan, ANGLE % math.tau)
    samples = shaken()
    samples[:100] = 1e4
    assert abs(window_orders(samples, angle).first) == pytest.approx(42.0)


def test_noise_has_no_phase_and_a_component_in_it_has_one_to_ten_degrees():
    rng = np.random.default_rng(4)
    told, off = 0, []
    for _ in range(200):
        noise = rng.normal(size=320)
        told += window_orders(noise, ANGLE).first != 0 and phase_lag_deg(*_first(noise)) is not None
        lag = phase_lag_deg(*_first(noise + 0.8 * np.cos(ANGLE - 2.0)))
        off += [] if lag is None else [deviation_deg(lag, math.degrees(2.0))]
    assert told == 0
    assert len(off) > 190
    assert np.sqrt(np.mean(np.square(off))) < 10.0


def _first(samples):
    found = window_orders(samples, ANGLE)
    return found.first, found.deviation


@pytest.mark.parametrize("speed_hz", [9.75, 10.0, 10.28])
def test_1x_is_found_beside_the_stated_speed(speed_hz):
    t = np.arange(2560) / RATE_HZ
    samples = 42.0 * np.cos(math.tau * speed_hz * t + 1.0) + np.random.default_rng(2).normal(size=2560)
    angle = steady_angle(samples, 10.0 / RATE_HZ)
    assert (angle[1] - angle[0]) * RATE_HZ / math.tau == pytest.approx(speed_hz, abs=0.01)
    assert abs(window_orders(samples, angle).first) == pytest.approx(42.0, rel=0.01)
    # With the stated speed taken as exact a shaft that is slower or faster by 2.5 % would lose its 1X.
    if speed_hz != 10.0:
        assert abs(window_orders(samples, math.tau * 10.0 * t).first) < 30.0


def test_a_line_outside_of_the_search_is_not_taken_for_1x():
    t = np.arange(2560) / RATE_HZ
    angle = steady_angle(np.cos(math.tau * 11.0 * t), 10.0 / RATE_HZ)
    assert 9.65 <= (angle[1] - angle[0]) * RATE_HZ / math.tau <= 10.35


def test_kurtosis_is_3_of_noise_and_that_of_its_law_of_other_signals():
    rng = np.random.default_rng(0)
    assert kurtosis(rng.normal(5.0, 2.0, 400_000).astype(np.float32)) == pytest.approx(3.0, abs=0.03)
    assert kurtosis(rng.uniform(-1, 1, 400_000).astype(np.float32)) == pytest.approx(1.8, abs=0.01)
    assert kurtosis(np.sin(ANGLE).astype(np.float32)) == pytest.approx(1.5, rel=1e-5)
    assert kurtosis(np.where(ANGLE % math.tau < math.pi, 1, -1).astype(np.float32)) == pytest.approx(1.0)


def test_kurtosis_of_impulses_is_one_over_how_often_they_come():
    samples = np.zeros(1000, np.float32)
    samples[::100] = 1.0
    share = 0.01
    assert kurtosis(samples) == pytest.approx(1.0 / (share * (1 - share)) - 3.0, rel=1e-5)
    samples[5] = np.nan
    share = 10 / 999
    assert kurtosis(samples) == pytest.approx(1.0 / (share * (1 - share)) - 3.0, rel=1e-5)


def test_what_does_not_move_has_no_kurtosis():
    assert kurtosis(np.full(100, 3.0, np.float32)) == 0.0


@pytest.mark.parametrize(
    ("phase", "reference", "off"),
    [(10.0, 350.0, 20.0), (350.0, 10.0, 20.0), (180.0, 0.0, 180.0), (0.0, -360.0, 0.0), (90.0, 100.0, 10.0)],
)
def test_phases_are_apart_the_shorter_way_round(phase, reference, off):
    assert deviation_deg(phase, reference) == pytest.approx(off)
