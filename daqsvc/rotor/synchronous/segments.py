"""Stretches of revolutions in which the machine does not change, and what they scatter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.synchronous.identify import Energy

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.synchronous.baseline import Calibration

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

_LEAST_ROWS = 8
_LASTING = 0.7
"""Part of the earlier energy that must be left in the later half: a settling rotor shakes less and less."""


@dataclass(frozen=True, slots=True)
class JudgedRevolution:
    """A revolution as the watch keeps it.

    Attributes:
        revolution: its number.
        vector: complex128 ``[5]``, synchronous vector less the baseline of the calibration, um.
        noise: variance of a sample that does not repeat with the shaft, um^2.
        speed: relative deviation from the speed of the calibration.
    """

    revolution: int
    vector: Complexes
    noise: float
    speed: float


def scatter(rows: Sequence[JudgedRevolution]) -> Floats:
    """Variance of the vectors, float64 ``[5]``; zero of too few to tell."""
    if len(rows) < _LEAST_ROWS:
        return np.zeros(5)
    vectors = np.array([row.vector for row in rows])
    squares = np.abs(vectors - vectors.mean(axis=0)) ** 2
    return np.asarray(squares.sum(axis=0) / (len(rows) - 1))


def noise_scatter(rows: Sequence[JudgedRevolution]) -> float:
    """Relative variance of the energy."""
    noise = np.array([row.noise for row in rows])
    mean = float(noise.mean())
    return float(noise.var(ddof=1)) / mean**2 if mean > 0.0 else 0.0


def lasting_energy(rows: Sequence[JudgedRevolution], healthy: Calibration) -> Energy | None:
    """The energy of the later half against the healthy one; None while it dies away."""
    half = len(rows) // 2
    earlier, later = _energy(rows[:half], healthy), _energy(rows[half:], healthy)
    return later if later.excess >= _LASTING * earlier.excess else None


def _energy(rows: Sequence[JudgedRevolution], healthy: Calibration) -> Energy:
    if not rows:
        return Energy()
    noise = float(np.mean([row.noise for row in rows]))
    excess = max(0.0, noise - healthy.noise)
    share = 1.0 / len(rows) + 1.0 / healthy.revolutions
    scale = 2.0 * healthy.noise_variance * share * healthy.noise**2
    return Energy(excess, excess**2 / scale)
