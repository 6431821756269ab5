"""Speed of an orbit: accuracy and stated uncertainty, sense of rotation, what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.examples import first_of

from daqsvc.dsp.speed.orbit import estimate_speed

RATE_HZ = 640.0
RPM = 600.0


def orbit(
    revolutions=50, *, rpm=RPM, minor=0.2, snr_db=math.inf, seed=0, harmonic=0.0, dc=0.0, clockwise=False
):
    """An ellipse with half axes 1 + minor and 1 - minor, noise against the forward 1X of one channel."""
    n = round(revolutions * 60 * RATE_HZ / RPM)
    turn = 2j * math.pi * np.arange(n) * rpm / 60 / RATE_HZ
    z = np.exp(turn + 0.3j) + minor * np.exp(-turn) + harmonic * np.exp(2 * turn + 1j) + dc
    xy = np.stack((z.real, -z.imag if clockwise else z.imag), axis=1)
    noise = math.sqrt(0.5) * 10 ** (-snr_db / 20)
    return xy + noise * np.random.default_rng(seed).standard_normal(xy.shape)


@pytest.mark.parametrize("off", [0.98, 0.995, 1.0, 1.005, 1.02])
@pytest.mark.parametrize("stated", [RPM, None])
def test_clean_orbit_among_harmonics_and_dc(off, stated):
    xy = orbit(50.4, rpm=off * RPM, harmonic=0.4, dc=100 - 80j)
    found = estimate_speed(xy, RATE_HZ, stated)
    assert found.speed_rpm == pytest.approx(off * RPM, rel=1e-7)
    assert found.direction == "forward"


@pytest.mark.long
@pytest.mark.parametrize(("snr_db", "bound"), first_of((20, 1.36e-5), (0, 1.36e-4)))
def test_noise_costs_what_it_must_and_the_uncertainty_says_so(snr_db, bound):
    # Cramer-Rao: sqrt(6 s^2 / (A^2 N^3)) rad per sample, s^2 = A^2 at 0 dB, N = 3200, 0.098 rad per sample.
    found = [estimate_speed(orbit(snr_db=snr_db, minor=0.0, seed=seed), RATE_HZ, RPM) for seed in range(200)]
    error = np.array([f.speed_rpm for f in found]) / RPM - 1.0
    # 200 runs know a standard deviation to 5 %; +-15 % holds with 99.7 % confidence.
    assert np.std(error) == pytest.approx(bound, rel=0.15)
    assert abs(np.mean(error)) < 3 * bound / math.sqrt(200)
    stated = np.array([f.uncertainty_rpm for f in found]) / RPM
    assert np.sqrt(np.mean(stated**2)) == pytest.approx(bound, rel=0.1)


def test_drifting_speed_widens_the_uncertainty():
    sample = np.arange(3200)
    turns = np.cumsum(1.0 + 0.005 * np.sin(2 * np.pi * sample / 1600)) / 64
    xy = np.stack((np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)), axis=1)
    steady, drifting = estimate_speed(orbit(), RATE_HZ, RPM), estimate_speed(xy, RATE_HZ, RPM)
    assert drifting.uncertainty_rpm > 5e-5 * RPM > 1e2 * steady.uncertainty_rpm


@pytest.mark.parametrize("snr_db", [0, 40])
def test_sense_of_rotation(snr_db):
    turning = orbit(snr_db=snr_db, clockwise=True)
    assert estimate_speed(turning, RATE_HZ, RPM).direction == "backward"
    assert estimate_speed(turning[:, ::-1], RATE_HZ, RPM).direction == "forward"
    clockwise = estimate_speed(turning, RATE_HZ, -RPM)
    assert clockwise.direction == "forward"
    assert clockwise.speed_rpm == pytest.approx(-RPM, rel=1e-3)
    assert estimate_speed(orbit(snr_db=snr_db, minor=0.99), RATE_HZ, RPM).direction == "straight"
    # What a difference of 10 % says depends on the noise.
    expected = "forward" if snr_db == 40 else "straight"
    assert estimate_speed(orbit(10, snr_db=snr_db, minor=0.9), RATE_HZ, RPM).direction == expected


def test_missing_samples_are_left_out():
    xy = orbit(snr_db=20)
    xy[500:900] = np.nan
    xy[::7, 1] = np.inf
    found = estimate_speed(xy, RATE_HZ, RPM)
    assert abs(found.speed_rpm - RPM) < 4 * found.uncertainty_rpm < 1e-3 * RPM


@pytest.mark.parametrize(
    ("xy", "stated", "words"),
    [
        (orbit(3), RPM, "192 samples at 640 Hz and 600 rpm are 3 revolutions of 64 samples"),
        (orbit(), 9000.0, "revolutions of 4.27 samples; .* at least 5 samples"),
        (orbit(), 0.0, "0 revolutions"),
        (orbit(0.2), None, "too few"),
        (np.full((3200, 2), np.nan), None, "too few"),
        (np.full((3200, 2), np.nan), RPM, r"no 1X line within 10% of 600 rpm"),
        (np.full((3200, 2), 7.0), RPM, "no 1X line"),
        (np.random.default_rng(1).standard_normal((3200, 2)), RPM, "no 1X line"),
        (np.random.default_rng(1).standard_normal((3200, 2)), None, "no 1X line: check that the shaft turns"),
        (orbit(rpm=0.8 * RPM), RPM, "no 1X line"),
    ],
)
def test_refusals(xy, stated, words):
    with pytest.raises(ValueError, match=words):
        estimate_speed(xy, RATE_HZ, stated)
