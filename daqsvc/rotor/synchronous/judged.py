"""Revolutions that a watched rotor is judged by, and what several of them show together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.synchronous.signatures import Energy

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.synchronous.baseline import Calibration

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]


_LEAST_ROWS = 8
_THRICE_FLOOR = 0.001
"""Part of the healthy whirl by which 3X may change where nothing touches."""
_LASTING = 0.7
"""Part of the earlier energy that must be left in the later half: a settling rotor shakes less and less."""


@dataclass(frozen=True, slots=True)
class JudgedRevolution:
    """A revolution as the watch keeps it.

    Attributes:
        revolution: its number.
        vector: complex128 ``[5]``, synchronous vector less the baseline of the calibration, um.
        noise: variance of a sample that does not repeat with the shaft, um^2.
        terms: float64 ``[3]``, its `speed_terms`.
        thrice: complex128 ``[2]``, 3X forward and backward, um; NaN if not known.
    """

    revolution: int
    vector: Complexes
    noise: float
    terms: Floats
    thrice: Complexes


def scatter(rows: Sequence[JudgedRevolution]) -> Floats:
    """Variance of the vectors, float64 ``[5]``; zero if there are too few."""
    if len(rows) < _LEAST_ROWS:
        return np.zeros(5)
    vectors = np.array([row.vector for row in rows])
    squares = np.abs(vectors - vectors.mean(axis=0)) ** 2
    return np.asarray(squares.sum(axis=0) / (len(rows) - 1))


@dataclass(frozen=True, slots=True)
class Thrice:
    """3X over a stretch of revolutions.

    Attributes:
        mean: complex128 ``[2]``, forward and backward, um.
        variance: float64 ``[2]``, of one revolution's, um^2.
        revolutions: in the mean.
    """

    mean: Complexes
    variance: Floats
    revolutions: int

    def apart_from(self, before: Thrice, amplitude_um: float) -> Floats:
        """Variance of the difference of both means, float64 ``[2]``, um^2."""
        share = 1.0 / self.revolutions + 1.0 / before.revolutions
        one = np.maximum(self.variance, before.variance)
        return np.asarray(one * share + (_THRICE_FLOOR * amplitude_um) ** 2)


def thrice_of(rows: Sequence[JudgedRevolution]) -> Thrice | None:
    """3X of revolutions; None where too few of them have it."""
    known = np.array([row.thrice for row in rows if np.isfinite(row.thrice).all()])
    if len(known) < _LEAST_ROWS:
        return None
    mean = known.mean(axis=0)
    scatter_um2 = (np.abs(known - mean) ** 2).sum(axis=0) / (len(known) - 1)
    return Thrice(mean, np.asarray(scatter_um2), len(known))


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
