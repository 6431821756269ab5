"""A rotor on supports that differ in x and y, by its own equations, to hold identified observers against.

The disc on a shaft, the shaft on springs with dampers: M z" + ks (z - s) = f, kb s + cb s' = ks (z - s).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import cont2discrete, lfilter

RATE_HZ = 4000.0
UNIT_HZ = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """In units of the mass and of 30 Hz.

    Attributes:
        shaft: stiffness of the shaft.
        supports: stiffness of the supports in x and y.
        dampers: damping of the supports in x and y.
        eccentricity_um: complex.
        load: static, in um of the unit stiffness, x + iy.
    """

    shaft: float = 1.5
    supports: tuple[float, float] = (2.4, 3.6)
    dampers: tuple[float, float] = (2.0, 2.0)
    eccentricity_um: complex = 10.0 * np.exp(0.8j)
    load: complex = -40.0j

    def damped(self, part: float) -> Machine:
        """With dampers that have lost some of their force."""
        return replace(self, dampers=(part * self.dampers[0], part * self.dampers[1]))

    def softened(self, part: float) -> Machine:
        """With supports that have lost some of their stiffness."""
        return replace(self, supports=(part * self.supports[0], part * self.supports[1]))

    def stiffness(self, axis: int, w: float) -> complex:
        """Dynamic stiffness of one axis at the disc."""
        return 1.0 / (1.0 / self.shaft + 1.0 / complex(self.supports[axis], w * self.dampers[axis]))

    def orbit(self, speed_hz: float) -> tuple[complex, complex]:
        """Steady 1X, forward and backward, um."""
        w = speed_hz / UNIT_HZ
        force = self.eccentricity_um * w**2
        x = force / (self.stiffness(0, w) - w**2)
        y = -1j * force / (self.stiffness(1, w) - w**2)
        return (x + 1j * y) / 2.0, ((x - 1j * y) / 2.0).conjugate()

    @property
    def rest(self) -> complex:
        """Static position, um."""
        x, y = (self.stiffness(axis, 0.0).real for axis in (0, 1))
        return complex(self.load.real / x, self.load.imag / y)

    def move(self, angle_rad: np.ndarray) -> np.ndarray:
        """Position of the disc from rest, complex128 ``[n]`` um, for the angle of every sample."""
        step = math.tau * UNIT_HZ / RATE_HZ
        rate = np.gradient(angle_rad, step)
        turning = self.eccentricity_um * np.exp(1j * angle_rad) * (rate**2 - 1j * np.gradient(rate, step))
        seen = []
        for axis, f in enumerate((turning.real, turning.imag)):
            kb, cb, ks = self.supports[axis], self.dampers[axis], self.shaft
            # Of x: (cb s + ks + kb) / (m s^2 (cb s + ks + kb) + ks (cb s + kb))
            numerator, denominator = np.array([cb, ks + kb]), np.array([cb, ks + kb, ks * cb, ks * kb])
            b, a, _ = cont2discrete((numerator, denominator), step, method="foh")
            seen.append(lfilter(b.ravel(), a, f))
        return seen[0] + 1j * seen[1] + self.rest


def run_up(machine: Machine, from_hz: float, to_hz: float, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Position and angle of a run-up that is even in time."""
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    angle = math.tau * (from_hz * t + 0.5 * (to_hz - from_hz) / seconds * t**2)
    return machine.move(angle), angle
