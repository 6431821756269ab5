"""The healthy machine as hypotheses about its faults need it, and the densities they are weighed by."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.synchronous.vectors import HARMONICS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.rotor.laval import LavalRotor

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

DC, FORWARD, BACKWARD = (HARMONICS.index(k) for k in (0, 1, -1))

SPREADS = np.array([0.1, 0.3, 1.0, 3.0])
"""Sizes that a change may have, in parts of the healthy orbit."""


@dataclass(frozen=True, slots=True)
class Healthy:
    """The healthy machine, as far as the signatures need it.

    Attributes:
        baseline: complex128 ``[5]``, its synchronous vector in um.
        speed_rad_s: shaft speed.
        rotor: what is known about the rotor.
        laval: whether the machine behaves like a Laval rotor; if not, stiffness loss is any change of mean
            position and 1X together, and damping loss any change of 1X.
    """

    baseline: Complexes
    speed_rad_s: float
    rotor: LavalRotor
    laval: bool

    @property
    def amplitude_um(self) -> float:
        """Amplitude A of the healthy whirl, the measure of every change."""
        return float(np.sqrt(np.sum(np.abs(self.baseline[1:]) ** 2)))

    @property
    def whirl_um(self) -> float:
        """The part of it that unbalance makes: 1X in both senses."""
        return float(np.hypot(abs(self.baseline[FORWARD]), abs(self.baseline[BACKWARD])))

    @property
    def ellipticity(self) -> float:
        """Backward over forward 1X."""
        return float(abs(self.baseline[BACKWARD]) / max(abs(self.baseline[FORWARD]), 1e-12))


def log_density(values: Complexes | Floats, variance: Floats) -> Floats:
    """Log density of circular complex normal values, without the constant ln pi."""
    return np.asarray(-(np.abs(values) ** 2) / variance - np.log(variance))


def density(value: complex, variance: float) -> float:
    """The same of one value."""
    return -(abs(value) ** 2) / variance - math.log(variance)


def log_mean(values: Floats) -> float:
    """Logarithm of the mean of what has these logarithms; minus infinity if all are."""
    top = float(values.max())
    if not math.isfinite(top):
        return top
    return top + math.log(float(np.exp(values - top).mean()))
