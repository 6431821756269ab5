"""Bode plots: modes found, split critical speeds seen, sweeps followed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.run_ups import RATE_HZ, record

from daqsvc.dsp.speed.revolutions import Revolutions
from daqsvc.rotor.calibration.bode import fit_bode
from daqsvc.rotor.laval import unbalance_response
from daqsvc.rotor.synchronous.baseline import NotCalibratableError
from daqsvc.rotor.synchronous.vectors import synchronous_vectors

SPEED_RPM = np.linspace(1000.0, 2200.0, 80)
RUNOUT = 3.0 - 1.0j


def plot(*modes: tuple[float, float, complex], noise: float = 0.2) -> np.ndarray:
    """Vectors of modes of critical speed, damping ratio and gain."""
    rng = np.random.default_rng(8)
    vectors = RUNOUT + noise * (rng.standard_normal(80) + 1j * rng.standard_normal(80))
    for critical, damping, gain in modes:
        vectors = vectors + gain * unbalance_response(SPEED_RPM / critical, damping)
    return vectors


def test_one_mode_with_runout() -> None:
    fit = fit_bode(SPEED_RPM, plot((1600.0, 0.05, 4.0j)))
    assert fit.critical_speeds_rpm == pytest.approx((1600.0,), rel=1e-3)
    assert fit.damping_ratios == pytest.approx((0.05,), rel=0.02)
    assert abs(fit.gains[0] - 4.0j) < 0.1
    assert abs(fit.runout - RUNOUT) < 0.1
    assert fit.vector_error < 0.03
    np.testing.assert_allclose(fit.at(SPEED_RPM), fit.fitted, rtol=1e-9)


def test_a_split_critical_speed_is_two_modes_and_one_is_one() -> None:
    split = plot((1550.0, 0.03, 3.0), (1680.0, 0.03, 2.0j))
    fit = fit_bode(SPEED_RPM, split)
    assert fit.critical_speeds_rpm == pytest.approx((1550.0, 1680.0), rel=2e-3)
    assert fit_bode(SPEED_RPM, split, modes=1).vector_error > 5.0 * fit.vector_error
    assert len(fit_bode(SPEED_RPM, plot((1600.0, 0.05, 4.0))).gains) == 1


def test_a_sweep_is_followed_with_its_late_peak_and_its_ringing() -> None:
    """0.8 s over the critical speed of 2400 rpm: steady vectors put it late and see more damping."""
    xy, angle = record(zeta=0.04, duration_s=0.8)
    whole = np.arange(1, int(angle[-1] / math.tau) + 1)
    edges = np.interp(whole * math.tau, angle, np.arange(len(angle)))
    starts = np.ceil(edges).astype(np.int64)
    part = slice(starts[0], starts[-1])
    vectors = synchronous_vectors(
        Revolutions(
            first_index=0,
            xy=xy[part],
            angle_rad=np.mod(angle[part], math.tau),
            starts=starts[:-1] - starts[0],
            period_samples=np.diff(edges),
            trusted=np.ones(len(starts) - 1, dtype=bool),
        )
    ).vectors[:, 1]
    speed_rpm = 60.0 * RATE_HZ / np.diff(edges)
    swept = fit_bode(speed_rpm, vectors, modes=1, sweep_rpm_per_s=(75.0 - 12.0) * 60.0 / 0.8)
    assert swept.critical_speeds_rpm[0] == pytest.approx(2400.0, rel=5e-3)
    assert swept.damping_ratios[0] == pytest.approx(0.04, rel=0.1)
    assert swept.vector_error < 0.05
    steady = fit_bode(speed_rpm, vectors, modes=1)
    assert steady.vector_error > 4.0 * swept.vector_error
    assert steady.critical_speeds_rpm[0] > 2440.0


def test_what_cannot_be_fitted_is_said() -> None:
    vectors = plot((1600.0, 0.05, 4.0))
    with pytest.raises(NotCalibratableError, match="a Bode plot of 5 vectors at 5 speeds cannot be fitted"):
        fit_bode(SPEED_RPM[:5], vectors[:5])
    with pytest.raises(NotCalibratableError, match="speeds of a Bode plot must be above 0 and grow"):
        fit_bode(SPEED_RPM[::-1], vectors)
    with pytest.raises(NotCalibratableError, match="a sweep of 0 rpm/s is none"):
        fit_bode(SPEED_RPM, vectors, sweep_rpm_per_s=0)
