"""The run-up fit against rotors integrated by an ODE solver: shares no arithmetic with the fit."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.given_codes import had
from support.run_ups import CENTRE, ECCENTRICITY, RATE_HZ, record

from daqsvc.rotor.calibration.run_up import NotLavalError, fit_run_up
from daqsvc.rotor.laval import unbalance_response
from daqsvc.rotor.synchronous.baseline import NotCalibratableError


def test_finds_every_figure_of_a_clean_run_up() -> None:
    fit = fit_run_up(*record(), RATE_HZ)
    assert fit.natural_frequency_hz == pytest.approx(40.0, rel=2e-4)
    assert fit.damping_ratio == pytest.approx(0.08, rel=2e-3)
    assert abs(fit.eccentricity_um - ECCENTRICITY) < 0.05
    assert abs(fit.centre_um - CENTRE) < 0.05
    assert fit.fit_error < 0.002
    assert fit.ellipticity < 0.002
    assert fit.noise_um < 0.05
    assert fit.laval
    low, high = fit.speed_range_rpm
    assert 720.0 <= low < 760.0
    assert 4450.0 < high <= 4500.0


def test_a_coast_down_says_the_same() -> None:
    fit = fit_run_up(*record(speeds_hz=(75.0, 12.0)), RATE_HZ)
    assert fit.natural_frequency_hz == pytest.approx(40.0, rel=2e-4)
    assert fit.damping_ratio == pytest.approx(0.08, rel=2e-3)
    assert abs(fit.eccentricity_um - ECCENTRICITY) < 0.05


def test_a_fast_run_up_is_not_taken_for_a_chain_of_steady_speeds() -> None:
    """In 0.8 s over the critical speed the peak comes 4 % late; the fit must know why."""
    xy, angle = record(zeta=0.04, duration_s=0.8)
    fit = fit_run_up(xy, angle, RATE_HZ)
    assert fit.natural_frequency_hz == pytest.approx(40.0, rel=1e-3)
    assert fit.damping_ratio == pytest.approx(0.04, rel=0.02)


@pytest.mark.long
def test_uncertainties_cover_the_errors() -> None:
    """95 % intervals of 4 figures over 24 noise runs: at least 84 of 96 (binomial, 99.9 %)."""
    inside = 0
    for seed in range(24):
        fit = fit_run_up(*record(60.0, seed), RATE_HZ)
        off = [
            (fit.natural_frequency_hz - 40.0) / fit.natural_frequency_uncertainty_hz,
            (fit.damping_ratio - 0.08) / fit.damping_uncertainty,
            (abs(fit.eccentricity_um) - 20.0) / fit.eccentricity_uncertainty_um,
            (fit.centre_um - CENTRE).imag / fit.centre_uncertainty_um,
        ]
        inside += sum(abs(z) < 1.96 for z in off)
        assert fit.noise_um == pytest.approx(60.0, rel=0.05)
        assert fit.laval
    assert inside >= 84


def test_predicts_steady_vectors_within_their_uncertainty() -> None:
    fit = fit_run_up(*record(noise_um=30.0), RATE_HZ)
    for speed_hz in (20.0, 36.0, 40.0, 60.0):
        vector, deviation = fit.predict(60.0 * speed_hz)
        truth = ECCENTRICITY * complex(unbalance_response(speed_hz / 40.0, 0.08))
        assert abs(vector - truth) < 4.0 * deviation
        assert deviation < 0.02 * abs(truth)


def test_no_speed_is_predicted_that_was_not_seen() -> None:
    fit = fit_run_up(*record(), RATE_HZ)
    with pytest.raises(ValueError, match=r"1X at 6000 rpm cannot be predicted: the run-up went from 7\d\d"):
        fit.predict(6000.0)


def test_a_rotor_of_two_stiffnesses_is_no_laval_rotor() -> None:
    fit = fit_run_up(*record(stiffness_y=0.8, noise_um=5.0), RATE_HZ)
    assert not fit.laval
    assert fit.ellipticity > 0.05
    with pytest.raises(NotLavalError, match="1X at 2400 rpm cannot be predicted: the machine is no Laval"):
        fit.predict(2400.0)
    assert fit.rotor().natural_frequency_tolerance >= 0.2
    assert fit_run_up(*record(), RATE_HZ).rotor().natural_frequency_tolerance == pytest.approx(0.02)


def test_missing_samples_change_nothing_but_the_noise() -> None:
    xy, angle = record(noise_um=5.0)
    rng = np.random.default_rng(3)
    xy[rng.random(len(xy)) < 0.1] = np.nan
    xy[7000:7030, 0] = np.nan
    fit = fit_run_up(xy, angle, RATE_HZ)
    assert fit.natural_frequency_hz == pytest.approx(40.0, rel=2e-3)
    assert fit.noise_um == pytest.approx(5.0, rel=0.05)


def test_refuses_a_run_up_below_the_critical_speed() -> None:
    xy, angle = record(speeds_hz=(8.0, 14.0), noise_um=5.0)
    xy, angle = xy[4000:], angle[4000:]  # the start from rest rings at the natural frequency, and shows it
    with pytest.raises(NotCalibratableError, match=r"does not show the (natural frequency|damping ratio)"):
        fit_run_up(xy, angle, RATE_HZ)


def test_refuses_a_steady_speed() -> None:
    xy, angle = record(speeds_hz=(30.0, 30.5))
    with pytest.raises(NotCalibratableError, match=r"the speed goes from 1800 to 183. rpm only") as refused:
        fit_run_up(xy, angle, RATE_HZ)
    assert refused.value.code.id == "R16"
    had("R16", refused.value)


def test_refuses_a_handful_of_revolutions() -> None:
    xy, angle = record(duration_s=0.3)
    with pytest.raises(NotCalibratableError, match=r"the run-up has 1. whole revolutions; a fit needs 20"):
        fit_run_up(xy, angle, RATE_HZ)


def test_refuses_noise() -> None:
    _, angle = record()
    noise = np.random.default_rng(5).standard_normal((len(angle), 2))
    with pytest.raises(NotCalibratableError, match=r"there is no whirl|does not show"):
        fit_run_up(noise, angle, RATE_HZ)


def test_refuses_swapped_probes() -> None:
    xy, angle = record(noise_um=5.0)
    with pytest.raises(
        NotCalibratableError, match=r"turns against the stated rotation .* swap the probes, or"
    ):
        fit_run_up(xy[:, ::-1], angle, RATE_HZ)


def test_refuses_an_angle_that_does_not_grow() -> None:
    xy, angle = record()
    with pytest.raises(ValueError, match="must grow from sample to sample; unwrap it"):
        fit_run_up(xy, np.mod(angle, 2.0 * math.pi), RATE_HZ)
    with pytest.raises(ValueError, match="orbit \\[n, 2\\] with an angle \\[n\\]"):
        fit_run_up(xy[:-1], angle, RATE_HZ)
