"""Run-ups of finite-element rotors: what the fit finds, what it predicts, and what it must not.

Recordings of ``../shared/data/ross`` with white noise added to each probe, SNR in AC power over the record;
20 seeds each. All bounds are maxima over the seeds.
"""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest

from daqsvc.rotor.calibration.run_up import fit_run_up
from daqsvc.rotor.laval import unbalance_response

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.rotor.calibration.run_up import RunUpFit

SEEDS = range(20)
OMEGA_S, ZETA = 535.2191942310874, 0.18
SPEEDS = (1.0, 0.95, 0.7, 0.5)

pytestmark = [pytest.mark.data, pytest.mark.statistical]


@cache
def recording(data: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """Orbit in um, angle and rate of the run-up."""
    held = np.load(data / "ross" / "A_runup_healthy_e0p1.npz")
    rate_hz, w0, w1, duration_s = (float(held[name]) for name in ("fs", "w0", "w1", "T"))
    xy = 1e6 * np.column_stack([held["x_disc"], held["y_disc"]]).astype(np.float64)
    t = np.arange(len(xy)) / rate_hz
    return xy, w0 * t + (w1 - w0) / duration_s * t**2 / 2.0, rate_hz


@cache
def fits(data: Path, snr_db: float) -> tuple[RunUpFit, ...]:
    xy, angle, rate_hz = recording(data)
    deviation = xy.std(axis=0) * 10.0 ** (-snr_db / 20.0)
    return tuple(
        fit_run_up(
            xy + deviation * np.random.default_rng([seed, 77]).standard_normal(xy.shape), angle, rate_hz
        )
        for seed in (SEEDS if math.isfinite(snr_db) else [0])
    )


@cache
def steady_vector(data: Path) -> complex:
    """1X of the same rotor at the critical speed, from its steady recording."""
    held = np.load(data / "ross" / "A1_healthy_e0p1.npz")
    begin, spr = int(held["steady_start"]), int(held["spr"])
    z = 1e6 * (held["x_disc"] + 1j * held["y_disc"].astype(np.complex128))[begin:]
    z = z[: len(z) // spr * spr]
    angle = float(held["omega"]) * (begin + np.arange(len(z))) / float(held["fs"])
    return complex((z * np.exp(-1j * angle)).mean())


@pytest.mark.parametrize(
    ("snr_db", "frequency", "damping"), [(math.inf, 5e-4, 0.005), (10.0, 2e-3, 0.015), (0.0, 5e-3, 0.05)]
)
def test_natural_frequency_and_damping(data: Path, snr_db: float, frequency: float, damping: float) -> None:
    for fit in fits(data, snr_db):
        assert math.tau * fit.natural_frequency_hz == pytest.approx(OMEGA_S, rel=frequency)
        assert fit.damping_ratio == pytest.approx(ZETA, rel=damping)
        assert fit.laval
        assert fit.rotor().natural_frequency_tolerance == pytest.approx(0.02)


@pytest.mark.parametrize(("snr_db", "most"), [(math.inf, 0.003), (10.0, 0.01), (0.0, 0.03)])
def test_predicts_1x_at_other_speeds(data: Path, snr_db: float, most: float) -> None:
    at_critical = complex(unbalance_response(1.0, ZETA))
    for speed in SPEEDS:
        truth = steady_vector(data) * complex(unbalance_response(speed, ZETA)) / at_critical
        for fit in fits(data, snr_db):
            vector, _ = fit.predict(speed * OMEGA_S * 30.0 / math.pi)
            assert abs(vector - truth) < most * abs(truth)


def test_uncertainties_cover_what_noise_does(data: Path) -> None:
    """Of 20 runs x 2 figures at 0 dB at least 34 lie within two standard deviations (binomial, 99 %)."""
    inside = 0
    for fit in fits(data, 0.0):
        inside += abs(math.tau * fit.natural_frequency_hz - OMEGA_S) < 2.0 * math.tau * (
            fit.natural_frequency_uncertainty_hz
        )
        inside += abs(fit.damping_ratio - ZETA) < 2.0 * fit.damping_uncertainty
    assert inside >= 34
