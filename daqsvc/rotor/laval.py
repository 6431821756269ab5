"""Steady response of the Laval rotor to unbalance and to a force, with what is not known about it.

In physical units, for the calibrated machine: omega_s and zeta are given with a tolerance, and whatever is
predicted from them is averaged over that box (`LavalRotor.box`). A run-up's two modes are kept with
them (`LavalRotor.two_modes`).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.rotor.model import RotorParameters

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

STANDARD_GRAVITY_M_S2 = 9.80665

_BOX_POINTS = 5


def compliance(order_speed: Floats | float, damping_ratio: Floats | float) -> Complexes:
    """Deflection per static deflection of a force that turns with the given speed.

    Args:
        order_speed: speed of the force over the natural frequency, k Omega / omega_s.
        damping_ratio: zeta.
    """
    speed = np.asarray(order_speed, dtype=np.float64)
    return np.asarray(1.0 / (1.0 - speed**2 + 2j * np.asarray(damping_ratio) * speed))


def unbalance_response(speed: Floats | float, damping_ratio: Floats | float) -> Complexes:
    """1X vector per eccentricity (paper, section II): w^2 / (1 - w^2 + 2 i zeta w).

    Args:
        speed: speed over natural frequency, w = Omega / omega_s.
        damping_ratio: zeta.
    """
    return np.asarray(np.asarray(speed, dtype=np.float64) ** 2 * compliance(speed, damping_ratio))


@dataclass(frozen=True, slots=True, kw_only=True)
class LavalRotor:
    """What is known about a rotor beyond its recordings.

    Attributes:
        natural_frequency_hz: undamped natural frequency of the healthy shaft.
        damping_ratio: zeta of the healthy shaft.
        natural_frequency_tolerance: half width of what the frequency may be, relative.
        damping_tolerance: the same of the damping ratio.
        clearance_um: radial clearance, if known.
        static_sag_um: sag of the shaft under its weight towards -y; that of a horizontal disc on a
            massless shaft, g / omega_s^2, if not given. 0 for a vertical shaft.
        two_modes: the same rotor with the two modes of its run-up and a clearance of 1 um, so that its orbits
            are in um. None where no run-up was seen, or two modes do not explain it.
        plain_bearings: whether oil films carry the shaft; None: not known.

    Raises:
        ValueError: a figure that no rotor has.
    """

    natural_frequency_hz: float
    damping_ratio: float
    natural_frequency_tolerance: float = 0.2
    damping_tolerance: float = 0.2
    clearance_um: float | None = None
    static_sag_um: float | None = None
    two_modes: RotorParameters | None = None
    plain_bearings: bool | None = None

    def __post_init__(self) -> None:
        positive = {"natural_frequency_hz": self.natural_frequency_hz, "damping_ratio": self.damping_ratio}
        if self.clearance_um is not None:
            positive["clearance_um"] = self.clearance_um
        for name, value in positive.items():
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"rotor: {name} is {value}; it must be a finite number above 0")
        if self.damping_ratio >= 1.0:
            raise ValueError(
                f"rotor: damping_ratio is {self.damping_ratio}; a shaft that whirls has less than 1"
            )
        for name in ("natural_frequency_tolerance", "damping_tolerance"):
            value = getattr(self, name)
            if not 0.0 <= value < 1.0:
                raise ValueError(f"rotor: {name} is {value}; it is relative, from 0 to below 1")

    @property
    def natural_frequency_rad_s(self) -> float:
        """omega_s."""
        return 2.0 * math.pi * self.natural_frequency_hz

    @property
    def sag_um(self) -> float:
        """Sag under the shaft's own weight, as given or as gravity makes it."""
        if self.static_sag_um is not None:
            return self.static_sag_um
        return STANDARD_GRAVITY_M_S2 / self.natural_frequency_rad_s**2 * 1e6

    @property
    def box(self) -> tuple[Floats, Floats]:
        """Frequencies in rad/s and damping ratios that may be, equally likely, float64 ``[B]`` each."""
        spread = np.linspace(-1.0, 1.0, _BOX_POINTS)
        frequency = 1.0 + self.natural_frequency_tolerance * spread
        damping = 1.0 + self.damping_tolerance * spread
        omega, zeta = np.meshgrid(
            self.natural_frequency_rad_s * frequency, self.damping_ratio * damping, indexing="ij"
        )
        return omega.ravel(), zeta.ravel()

    def speed_slope(self, speed_rad_s: float) -> tuple[complex, float]:
        """How the 1X vector follows the speed, and how well that is known.

        Returns:
            d ln H / d ln Omega averaged over the box, and the standard deviation of it there.
        """
        return _speed_slope(self, speed_rad_s)


@functools.lru_cache(maxsize=256)
def _speed_slope(rotor: LavalRotor, speed_rad_s: float) -> tuple[complex, float]:
    # Asked for every revolution with the same speed of calibration.
    omega, zeta = rotor.box
    step = 1e-4
    here = unbalance_response(speed_rad_s / omega, zeta)
    there = unbalance_response(speed_rad_s * (1.0 + step) / omega, zeta)
    slope = (there / here - 1.0) / step
    mean = complex(slope.mean())
    return mean, float(np.sqrt(np.mean(np.abs(slope - mean) ** 2)))
