"""A rotor on supports that differ in x and y, by its own equations, to hold identified observers against.

The disc on a shaft, the shaft on springs with dampers: M z" + ks (z - s) = f, kb s + cb s' = ks (z - s).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete, lfilter

from daqsvc.rotor.calibration.run_up import RunUpFit, fit_run_up, revolutions_of
from daqsvc.rotor.calibration.two_modes import TwoModeFit, fit_two_modes
from daqsvc.rotor.synchronous.vectors import WITH_THRICE, synchronous_vectors

if TYPE_CHECKING:
    from collections.abc import Callable

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


def fitted(position: np.ndarray, angle: np.ndarray) -> tuple[RunUpFit, TwoModeFit]:
    """What ``daqsvc calibrate`` finds in a run-up: the nearest Laval rotor, and two modes."""
    nearest = fit_run_up(np.column_stack((position.real, position.imag)), angle, RATE_HZ)
    return nearest, fit_two_modes(
        synchronous_vectors(revolutions_of(position, angle)),
        RATE_HZ,
        natural_frequency_hz=nearest.natural_frequency_hz,
        damping_ratio=nearest.damping_ratio,
    )


def vector_of(machine: Machine, speed_hz: float) -> np.ndarray:
    """Synchronous vector of the machine, complex128 ``[5]`` um."""
    return np.array([machine.rest, *machine.orbit(speed_hz), 0.0, 0.0, 0.0, 0.0])


def touching(machine: Machine, speed_hz: float, wall: complex, stiffness: float) -> np.ndarray:
    """Synchronous vector of the machine where it touches a flat wall, by its equations of motion.

    Args:
        machine: the machine.
        speed_hz: of the shaft.
        wall: the point of the wall that is nearest to the origin, um; its normal points to the origin.
        stiffness: of the wall, in that of the unit.
    """
    normal = np.array([wall.real, wall.imag]) / abs(wall)

    def push(place: np.ndarray) -> np.ndarray:
        return -stiffness * max(0.0, float(place @ normal) - abs(wall)) * normal

    z, theta = pushed(machine, speed_hz, push, settled=60, seen=40)
    return np.array([np.mean(z * np.exp(-1j * k * theta)) for k in WITH_THRICE])


def rubbing(
    machine: Machine, speed_hz: float, clearance_um: float, stiffness: float, friction: float, seen: int
) -> tuple[np.ndarray, np.ndarray]:
    """Position and angle where it touches a round stator about the origin, 64 samples a revolution.

    Args:
        machine: the machine.
        speed_hz: of the shaft.
        clearance_um: of the stator.
        stiffness: of the stator, in that of the unit.
        friction: Coulomb's; the surface slips against the whirl's direction, as that of a wide shaft does.
        seen: revolutions, after sixty in which it settles.
    """

    def push(place: np.ndarray) -> np.ndarray:
        x, y = place
        radius = math.hypot(x, y)
        force = stiffness * max(0.0, radius - clearance_um)
        return -force / radius * np.array([x - friction * y, y + friction * x]) if force else np.zeros(2)

    return pushed(machine, speed_hz, push, settled=60, seen=seen)


def pushed(
    machine: Machine, speed_hz: float, push: Callable[[np.ndarray], np.ndarray], *, settled: int, seen: int
) -> tuple[np.ndarray, np.ndarray]:
    """Position and angle under a force that depends on the position, 64 samples a revolution.

    Args:
        machine: the machine.
        speed_hz: of the shaft.
        push: the force at a place, both float64 ``[2]``, um and um of the unit stiffness.
        settled: revolutions before the first sample.
        seen: revolutions of samples.
    """
    w = speed_hz / UNIT_HZ
    springs, dampers = np.array(machine.supports), np.array(machine.dampers)

    def moved(t: float, state: np.ndarray) -> np.ndarray:
        place, speed, foot = state[:2], state[2:4], state[4:]
        bent = machine.shaft * (place - foot)
        turning = machine.eccentricity_um * w**2 * np.exp(1j * w * t) + machine.load
        force = np.array([turning.real, turning.imag]) - bent + push(place)
        return np.concatenate((speed, force, (bent - springs * foot) / dampers))

    rest = machine.rest
    feet = [machine.load.real / springs[0], machine.load.imag / springs[1]]
    begin = np.array([rest.real, rest.imag, 0.0, 0.0, *feet])
    theta = math.tau * np.arange(64 * seen) / 64.0
    at = (math.tau * settled + theta) / w
    found = solve_ivp(moved, (0.0, at[-1]), begin, t_eval=at, rtol=1e-7, atol=1e-6, max_step=0.2 / w)
    return found.y[0] + 1j * found.y[1], theta
