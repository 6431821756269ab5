"""Run-ups of a rotor integrated by an ODE solver: they share no arithmetic with the fit."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

RATE_HZ = 4000.0
NATURAL_HZ = 40.0
OMEGA = 2.0 * math.pi * NATURAL_HZ
ECCENTRICITY = 20.0 * np.exp(0.7j)
CENTRE = 5.0 - 150.0j


@cache
def clean_record(
    *,
    rate_hz: float = RATE_HZ,
    natural_hz: float = NATURAL_HZ,
    zeta: float = 0.08,
    speeds_hz: tuple[float, float] = (12.0, 75.0),
    duration_s: float = 4.0,
    stiffness_y: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Orbit in um and shaft angle of a rotor whose speed grows evenly, integrated in the time domain."""
    w0, w1 = (2.0 * math.pi * f for f in speeds_hz)
    growth, omega = (w1 - w0) / duration_s, 2.0 * math.pi * natural_hz
    stiff = np.array([1.0, stiffness_y])

    def motion(t: float, state: np.ndarray) -> np.ndarray:
        position, velocity = state[:2], state[2:]
        angle, speed = w0 * t + growth * t * t / 2.0, w0 + growth * t
        force = ECCENTRICITY * (speed**2 - 1j * growth) * np.exp(1j * angle)
        pull = omega**2 * stiff * (position - [CENTRE.real, CENTRE.imag])
        return np.concatenate(
            (velocity, np.array([force.real, force.imag]) - 2 * zeta * omega * velocity - pull)
        )

    t = np.arange(round(duration_s * rate_hz)) / rate_hz
    start = [CENTRE.real, CENTRE.imag, 0.0, 0.0]
    solved = solve_ivp(
        motion, (0.0, t[-1]), start, t_eval=t, method="DOP853", rtol=1e-8, atol=1e-6, max_step=2e-2
    )
    return solved.y[:2].T, w0 * t + growth * t * t / 2.0


def record(noise_um: float = 0.0, seed: int = 0, **run_up: Any) -> tuple[np.ndarray, np.ndarray]:
    """The same with noise on both probes."""
    xy, angle = clean_record(**run_up)
    return xy + noise_um * np.random.default_rng(seed).standard_normal(xy.shape), angle
