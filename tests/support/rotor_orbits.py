"""Orbits made from synchronous vectors: what the tests of the calibrated rotor feed it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.dsp.speed.revolutions import Revolutions
from daqsvc.rotor.laval import LavalRotor, unbalance_response
from daqsvc.rotor.synchronous.vectors import WITH_THRICE

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

RATE_HZ = 640.0
PER_REV = 64
ROTOR = LavalRotor(natural_frequency_hz=10.0, damping_ratio=0.18, clearance_um=100.0, static_sag_um=10.0)
"""The paper's rotor at its critical speed, known within 20 %."""
SPEED_RAD_S = 2.0 * math.pi * 10.0
HEALTHY = np.array([-10.0j, 10.0 * complex(unbalance_response(1.0, 0.18)), 0.0, 0.0, 0.0])


def orbits(
    vectors: ArrayLike,
    noise_um: float = 0.0,
    seed: int = 0,
    per_rev: int = PER_REV,
    deviation: NDArray[np.float64] | None = None,
) -> Revolutions:
    """Revolutions with the given synchronous vectors, ``[R, 5]`` or ``[R, 7]``, in white noise."""
    rows: NDArray[Any] = np.atleast_2d(vectors)
    theta = 2.0 * math.pi * np.arange(per_rev) / per_rev
    z = rows @ np.exp(1j * np.outer(WITH_THRICE[: rows.shape[1]], theta))
    rng = np.random.default_rng(seed)
    z = z.ravel() + noise_um * (rng.standard_normal(z.size) + 1j * rng.standard_normal(z.size))
    count = len(rows)
    period = np.full(count, float(per_rev)) / (1.0 + (0.0 if deviation is None else deviation))
    return Revolutions(
        first_index=0,
        xy=np.column_stack((z.real, z.imag)),
        angle_rad=np.tile(theta, count),
        starts=np.arange(count, dtype=np.int64) * per_rev,
        period_samples=period,
        trusted=np.ones(count, dtype=bool),
    )
