"""What a run-up says about a rotor, and what follows from it for other speeds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.laval import LavalRotor, unbalance_response

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

LAVAL_LIMIT = 0.05
"""Fit error, and backward over forward 1X, up to which a machine counts as a Laval rotor."""

_ROTOR_TOLERANCE = 0.02
"""What a fitted rotor may still be off at best: independent rotor codes agree to that."""
_GENERIC_TOLERANCE = 0.2
"""The same where the machine is no Laval rotor, and the figures only name the nearest one."""


class NotLavalError(ValueError):
    """The machine is no Laval rotor, so nothing follows from one speed for another."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunUpFit:
    """A Laval rotor fitted to a run-up or a coast-down. Uncertainties are standard deviations.

    Attributes:
        natural_frequency_hz: undamped natural frequency omega_s / 2 pi.
        damping_ratio: zeta.
        eccentricity_um: complex mass eccentricity e; its argument is the heavy spot's angle from the mark.
        centre_um: where the shaft runs at standstill of the whirl, c; sag and the probes' zero are in it.
        covariance: float64 ``[4, 4]`` of ln f, ln zeta, and real and imaginary part of ln e.
        centre_uncertainty_um: of each coordinate of ``centre_um``.
        ellipticity: backward over forward whirl, rms over the record, beyond what noise can make of it.
        noise_um: standard deviation of the noise of one probe's sample.
        fit_error: rms of what repeats with the shaft and no Laval rotor does, beyond what noise can make of
            it, over that of the whirl.
        speed_range_rpm: lowest and highest speed seen.
        revolutions: in the record.
    """

    natural_frequency_hz: float
    damping_ratio: float
    eccentricity_um: complex
    centre_um: complex
    covariance: Floats
    centre_uncertainty_um: float
    ellipticity: float
    noise_um: float
    fit_error: float
    speed_range_rpm: tuple[float, float]
    revolutions: int

    @property
    def natural_frequency_uncertainty_hz(self) -> float:
        """Standard deviation of the natural frequency."""
        return self.natural_frequency_hz * math.sqrt(self.covariance[0, 0])

    @property
    def damping_uncertainty(self) -> float:
        """Standard deviation of the damping ratio."""
        return self.damping_ratio * math.sqrt(self.covariance[1, 1])

    @property
    def eccentricity_uncertainty_um(self) -> float:
        """Standard deviation of the eccentricity's modulus."""
        return abs(self.eccentricity_um) * math.sqrt(self.covariance[2, 2])

    @property
    def heavy_spot_uncertainty_deg(self) -> float:
        """Standard deviation of the eccentricity's argument."""
        return math.degrees(math.sqrt(self.covariance[3, 3]))

    @property
    def laval(self) -> bool:
        """Whether one Laval rotor explains the whole record."""
        return self.fit_error <= LAVAL_LIMIT and self.ellipticity <= LAVAL_LIMIT

    def describe(self) -> str:
        """The verdict in words."""
        low, high = self.speed_range_rpm
        seen = f"from {low:.0f} to {high:.0f} rpm"
        if self.laval:
            return (
                f"one Laval rotor explains the orbit {seen} within {100.0 * self.fit_error:.1f} %: 1X at any "
                "speed in between follows from it, and loss of damping can be told from unbalance"
            )
        limit = f"at most {100.0 * LAVAL_LIMIT:.0f} % each"
        return (
            f"no Laval rotor explains the orbit {seen} (unexplained {100.0 * self.fit_error:.0f} %, backward "
            f"over forward whirl {100.0 * self.ellipticity:.0f} %, {limit}): calibrate at every speed that "
            "is watched; nothing follows from one speed for another"
        )

    def rotor(self, *, clearance_um: float | None = None, static_sag_um: float | None = None) -> LavalRotor:
        """What is known about the rotor from now on; with wide tolerances if it is no Laval rotor."""
        least = _ROTOR_TOLERANCE if self.laval else _GENERIC_TOLERANCE
        frequency, damping = (2.0 * math.sqrt(self.covariance[i, i]) for i in (0, 1))
        return LavalRotor(
            natural_frequency_hz=self.natural_frequency_hz,
            damping_ratio=self.damping_ratio,
            natural_frequency_tolerance=min(0.9, max(least, frequency)),
            damping_tolerance=min(0.9, max(least, damping)),
            clearance_um=clearance_um,
            static_sag_um=static_sag_um,
        )

    def predict(self, speed_rpm: float) -> tuple[complex, float]:
        """1X vector at a steady speed.

        Args:
            speed_rpm: shaft speed, in the direction of the run-up.

        Returns:
            The forward 1X vector in um, and the standard deviation of it, in um.

        Raises:
            NotLavalError: the machine is no Laval rotor.
            ValueError: a speed outside of those seen.
        """
        if not self.laval:
            raise NotLavalError(
                f"1X at {speed_rpm:.0f} rpm cannot be predicted: the machine is no Laval rotor (the run-up "
                f"fits within {100.0 * self.fit_error:.0f} %, backward over forward whirl is "
                f"{100.0 * self.ellipticity:.0f} %, at most {100.0 * LAVAL_LIMIT:.0f} % each); record it at "
                "that speed"
            )
        low, high = self.speed_range_rpm
        if not low <= speed_rpm <= high:
            raise ValueError(
                f"1X at {speed_rpm:.0f} rpm cannot be predicted: the run-up went from {low:.0f} to "
                f"{high:.0f} rpm; give a speed in between"
            )
        ratio = speed_rpm / 60.0 / self.natural_frequency_hz
        vector = complex(self.eccentricity_um * unbalance_response(ratio, self.damping_ratio))
        step = 1e-5
        moved = np.array(
            [
                unbalance_response(ratio / (1.0 + step), self.damping_ratio),
                unbalance_response(ratio, self.damping_ratio * (1.0 + step)),
            ]
        )
        here = unbalance_response(ratio, self.damping_ratio)
        slope = np.concatenate(((moved / here - 1.0) / step, [1.0, 1j]))
        variance = float((slope.conj() @ self.covariance @ slope).real)
        return vector, abs(vector) * math.sqrt(max(variance, 0.0))
