"""The response of a Laval rotor to an unbalance that turns with any shaft angle, and its fit to a record.

    z'' + 2 zeta omega_s z' + omega_s^2 (z - c) = e (theta'^2 - i theta'') exp(i theta)

The right-hand side is -e d^2/dt^2 exp(i theta), so the response is that of the transfer function
-s^2 / (s^2 + 2 zeta omega_s s + omega_s^2) to e exp(i theta), and the angle need not be differentiated.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import cont2discrete, lfilter

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]


def forcing_of(angle_rad: Floats) -> Complexes:
    """What drives a rotor sampled at this angle, complex128 ``[n]``, so that ramps between samples are exact.

    Ramps between the samples of a turning vector pass sinc^2 of its turns in a step; the rest are images at
    the sampling rate, which a rotor does not follow.

    Args:
        angle_rad: float64 ``[n]``, unwrapped.
    """
    return np.asarray(np.exp(1j * angle_rad) / np.sinc(np.gradient(angle_rad) / math.tau) ** 2)


def whirl_by_unbalance(
    forcing: Complexes, angle_rad: Floats, step_s: float, omega: float, zeta: float
) -> Complexes:
    """Motion of a rotor at rest to unit eccentricity that turns with the angle, complex128 ``[n]``.

    Args:
        forcing: `forcing_of` the angle.
        angle_rad: float64 ``[n]``, unwrapped.
        step_s: time between samples.
        omega: natural frequency in rad/s.
        zeta: damping ratio.
    """
    damping = 2.0 * zeta * omega
    numerator, denominator, _ = cont2discrete(
        (np.array([damping, omega**2]), np.array([1.0, damping, omega**2])), step_s, method="foh"
    )
    return np.asarray(lfilter(numerator.ravel(), denominator, forcing) - np.exp(1j * angle_rad))


class Chirp:
    """The record, and a Laval rotor's response to its shaft angle.

    Args:
        z: complex128 ``[n]``, the orbit in um.
        angle_rad: float64 ``[n]``.
        rate_hz: samples per second.
        averaged: samples that are averaged, in the record and in the model alike.
    """

    def __init__(self, z: Complexes, angle_rad: Floats, rate_hz: float, averaged: int) -> None:
        self._step_s = 1.0 / rate_hz
        self._averaged = averaged
        self._length = len(z) // averaged * averaged
        self._time_s = np.arange(len(z)) * self._step_s
        self._angle_rad = angle_rad
        self._forcing = forcing_of(angle_rad)
        self._recorded = z
        seen = self._mean(z)
        self._there = np.isfinite(seen)
        self._seen = seen[self._there]

    def _mean(self, values: Complexes) -> Complexes:
        return np.asarray(values[: self._length].reshape(-1, self._averaged).mean(axis=1))

    def columns(self, omega: float, zeta: float) -> Complexes:
        """Complex128 ``[m, 4]``: response to unit eccentricity, unit centre, and the two free motions."""
        forced, *free = (self._mean(column)[self._there] for column in self._motions(omega, zeta))
        return np.column_stack((forced, np.ones(len(forced)), *free))

    def _motions(self, omega: float, zeta: float) -> Iterator[Complexes]:
        """Response to unit eccentricity and the two free motions, complex128 ``[n]`` each."""
        yield whirl_by_unbalance(self._forcing, self._angle_rad, self._step_s, omega, zeta)
        pole = omega * complex(-zeta, math.sqrt(1.0 - zeta**2))
        yield np.exp(pole * self._time_s)
        yield np.exp(pole.conjugate() * self._time_s)

    def solve(self, omega: float, zeta: float) -> tuple[Complexes, Complexes, Complexes]:
        """Best linear parameters complex128 ``[4]``, residual ``[m]`` and columns ``[m, 4]``."""
        columns = self.columns(omega, zeta)
        linear: Complexes = np.asarray(np.linalg.lstsq(columns, self._seen, rcond=1e-10)[0], np.complex128)
        return linear, self._seen - columns @ linear, columns

    def split(self, omega: float, zeta: float, linear: Complexes) -> tuple[Complexes, Complexes]:
        """The record as the whirl by unbalance and what the model leaves of it, complex128 ``[n]`` each."""
        forced, *free = self._motions(omega, zeta)
        whirl = linear[0] * forced
        left = self._recorded - whirl - linear[1] - linear[2] * free[0] - linear[3] * free[1]
        return whirl, left
