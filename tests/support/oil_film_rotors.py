"""A rotor on short journal bearings on pedestals, by its own equations, to hold predicted faults against.

Shaft, oil films and pedestals in series carry one mass. The films are those of Ocvirk's short bearing, with
the coefficients of Friswell, Penny, Garvey and Lees, "Dynamics of Rotating Machines", 2010, section 5.5.2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from support.two_mode_rotors import RATE_HZ, UNIT_HZ


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmMachine:
    """In units of the mass and of 30 Hz; the length is um.

    Attributes:
        shaft: stiffness of the shaft.
        pedestals: stiffness of the pedestals in x and y.
        clearance_um: of the journal bearings.
        oil: viscosity: load of a film at an eccentricity of 1, over speed, without its own function of that.
        eccentricity_um: complex.
        load: static, in um of the unit stiffness, x + iy.
    """

    shaft: float = 1.5
    pedestals: tuple[float, float] = (5.0, 9.0)
    clearance_um: float = 60.0
    oil: float = 60.0
    eccentricity_um: complex = 10.0 * np.exp(0.8j)
    load: complex = -60.0j

    def _journal(self, w: float) -> float:
        """Eccentricity of the journal over the clearance, under the load."""
        sought = self.oil * w / abs(self.load)

        def beyond(e: float) -> float:
            return (1 - e**2) ** 2 / (e * math.sqrt(16 * e**2 + math.pi**2 * (1 - e**2))) - sought

        return float(brentq(beyond, 1e-4, 0.999))

    def _film(self, w: float) -> tuple[np.ndarray, np.ndarray]:
        """Stiffness and damping of the films, float64 ``[2, 2]``, for a load that points anywhere."""
        e, pi = self._journal(w), math.pi
        root = math.sqrt(1 - e**2)
        h = (pi**2 * (1 - e**2) + 16 * e**2) ** -1.5
        turning = pi**2 * (1 + 2 * e**2)
        stiffness = np.array(
            [
                [
                    4 * (pi**2 * (2 - e**2) + 16 * e**2),
                    pi * (pi**2 * (1 - e**2) ** 2 - 16 * e**4) / (e * root),
                ],
                [
                    -pi * (turning * (1 - e**2) + 32 * e**2 * (1 + e**2)) / (e * root),
                    4 * (turning + 32 * e**2 * (1 + e**2) / (1 - e**2)),
                ],
            ]
        )
        cross = -8 * (turning - 16 * e**2)
        damping = np.array(
            [
                [2 * pi * root * (turning - 16 * e**2) / e, cross],
                [cross, 2 * pi * (pi**2 * (1 - e**2) ** 2 + 48 * e**2) / (e * root)],
            ]
        )
        turned = np.angle(self.load / -1j)
        way = np.array([[math.cos(turned), -math.sin(turned)], [math.sin(turned), math.cos(turned)]])
        size = h * abs(self.load) / self.clearance_um
        return way @ (size * stiffness) @ way.T, way @ (size / w * damping) @ way.T

    def orbit(self, speed_hz: float) -> tuple[complex, complex]:
        """Steady 1X, forward and backward, um."""
        w = speed_hz / UNIT_HZ
        stiffness, damping = self._film(w)
        given = np.eye(2) / self.shaft + np.diag(1.0 / np.array(self.pedestals))
        given = given + np.linalg.inv(stiffness + 1j * w * damping)
        force = self.eccentricity_um * w**2 * np.array([1.0, -1j])
        x, y = np.linalg.solve(np.linalg.inv(given) - w**2 * np.eye(2), force)
        return complex(x + 1j * y) / 2.0, complex(x - 1j * y).conjugate() / 2.0

    def rest(self, speed_hz: float) -> complex:
        """Where the disc rests on shaft, journals and pedestals, um."""
        e = self._journal(speed_hz / UNIT_HZ)
        aside = math.atan2(math.pi * math.sqrt(1 - e**2), 4 * e)  # attitude angle, the way the shaft turns
        journal = self.clearance_um * e * self.load / abs(self.load) * np.exp(1j * aside)
        bent = self.load / self.shaft + complex(
            self.load.real / self.pedestals[0], self.load.imag / self.pedestals[1]
        )
        return complex(journal + bent)

    def vector(self, speed_hz: float) -> np.ndarray:
        """Synchronous vector, complex128 ``[7]`` um."""
        return np.array([self.rest(speed_hz), *self.orbit(speed_hz), 0.0, 0.0, 0.0, 0.0])

    def run_up(self, from_hz: float, to_hz: float, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Position and angle of a run-up so slow that the whirl is steady at each speed."""
        t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
        angle = math.tau * (from_hz * t + 0.5 * (to_hz - from_hz) / seconds * t**2)
        speeds = np.linspace(from_hz, to_hz, 200)
        vectors = np.array([self.vector(speed)[:3] for speed in speeds])
        speed = from_hz + (to_hz - from_hz) / seconds * t
        rest, forward, backward = (np.interp(speed, speeds, part) for part in vectors.T)
        return rest + forward * np.exp(1j * angle) + backward * np.exp(-1j * angle), angle
