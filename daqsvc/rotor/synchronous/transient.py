"""Unbalance or damping? The steady orbits can be the same; the way from one to the other is not.

After an abrupt change at t0 the deviation from the old orbit starts at rest and grows into the new one:

    d(t) = d_1 (exp(i w t) - p exp(l_1 t) - q exp(l_2 t)),   p + q = 1,   p l_1 + q l_2 = i w

An unbalance leaves the poles l where they are and may make any d_1. A loss of damping moves the poles, and
d_1 follows from them. This needs poles that are known well, hence a calibration from a run-up.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.laval import unbalance_response
from daqsvc.rotor.synchronous.vectors import HARMONICS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.rotor.synchronous.baseline import Calibration
    from daqsvc.rotor.synchronous.vectors import Healthy

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

REVOLUTIONS = 8
"""Revolutions after the departure that the comparison takes."""
BEFORE = 4
"""Revolutions before the estimated onset that it reaches back."""
KNOWN_WITHIN = 0.05
"""Relative tolerance of frequency and damping up to which the poles are known well enough."""

_ONSETS = np.arange(-2.5, 3.01, 0.125)
_DAMPING_LEFT = np.geomspace(0.05, 0.97, 24)
# What a loss of all damping in the bearings also does at most, in parts: to the frequency, to the modal mass.
_FREQUENCY_SHIFT = np.array([-0.08, -0.04, 0.0, 0.02])
_MASS_SHIFT = np.array([-0.15, -0.075, 0.0, 0.03])
_GAIN_TOLERANCE = 0.05
"""Part of the new orbit that the damping model may miss."""
_POINTS_PER_REV = 16
_ARRIVED = 0.2
"""Relative distance of the settled orbit from where the transient leads, up to which it was abrupt."""


@dataclass(frozen=True, slots=True)
class Transient:
    """Samples around the onset of a change.

    Attributes:
        turns: float64 ``[n]``, shaft angle in revolutions since the estimated onset, increasing.
        deviation: complex128 ``[n]``, position less the healthy orbit, um.
        noise: variance of the complex noise of a sample, um^2.
    """

    turns: Floats
    deviation: Complexes
    noise: float


@dataclass(frozen=True, slots=True)
class Comparison:
    """What the transient shows.

    Attributes:
        damping_nats: log-likelihood ratio of a loss of damping over an unbalance.
        forward: change of the forward 1X vector that the better of the two leads to, um.
    """

    damping_nats: float
    forward: complex

    def holds(self, change: complex) -> bool:
        """Whether the orbit has come to where the better model leads: a change that creeps does not."""
        return abs(change - self.forward) <= _ARRIVED * abs(change)


def compare(transient: Transient, healthy: Healthy) -> Comparison:
    """Loss of damping against unbalance, both at their best onset and parameters.

    Args:
        transient: what happened around the onset.
        healthy: the machine before, with a rotor known within `KNOWN_WITHIN`.
    """
    rotor, speed = healthy.rotor, healthy.speed_rad_s
    turns, deviation, noise = _thinned(transient)
    spread = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    omegas = rotor.natural_frequency_rad_s * (1.0 + rotor.natural_frequency_tolerance * spread)
    zetas = rotor.damping_ratio * (1.0 + rotor.damping_tolerance * spread)
    forward = complex(healthy.baseline[1])

    unbalance, by_unbalance = -math.inf, 0j
    for omega in omegas:
        for zeta in zetas:
            product, energy = _against(turns, deviation, speed, omega, zeta)
            gained = np.abs(product) ** 2 / energy
            best = int(gained.argmax())
            if gained[best] > unbalance:
                unbalance, by_unbalance = float(gained[best]), complex(product[best] / energy[best])

    damping, by_damping = -math.inf, 0j
    for omega in omegas[1::2]:
        before = complex(unbalance_response(speed / omega, rotor.damping_ratio))
        for left in _DAMPING_LEFT:
            for frequency in 1.0 + (1.0 - left) * _FREQUENCY_SHIFT:
                zeta = rotor.damping_ratio * left
                product, energy = _against(turns, deviation, speed, omega * frequency, zeta)
                after = complex(unbalance_response(speed / (omega * frequency), zeta)) / before
                for mass in 1.0 + (1.0 - left) * _MASS_SHIFT:
                    step = forward * (mass * after - 1.0)
                    # d_1 lies about the step: maximise 2 Re(d* p) - |d|^2 e - w |d - step|^2 over d.
                    weight = noise / (_GAIN_TOLERANCE * abs(forward * mass * after)) ** 2
                    pulled = product + weight * step
                    gained = np.abs(pulled) ** 2 / (energy + weight) - weight * abs(step) ** 2
                    best = int(gained.argmax())
                    if gained[best] > damping:
                        damping = float(gained[best])
                        by_damping = complex(pulled[best] / (energy[best] + weight))
    return Comparison((damping - unbalance) / noise, by_damping if damping > unbalance else by_unbalance)


def _thinned(transient: Transient) -> tuple[Floats, Complexes, float]:
    """Deviation in the frame that turns with the shaft, averaged to `_POINTS_PER_REV`."""
    turning = transient.deviation * np.exp(-2j * math.pi * transient.turns)
    per_rev = len(turning) / (transient.turns[-1] - transient.turns[0])
    factor = max(1, round(per_rev / _POINTS_PER_REV))
    count = len(turning) // factor * factor
    mean = turning[:count].reshape(-1, factor).mean(axis=1)
    turns = transient.turns[:count].reshape(-1, factor).mean(axis=1)
    return turns, mean, transient.noise / factor


def _against(
    turns: Floats, deviation: Complexes, speed_rad_s: float, omega: float, zeta: float
) -> tuple[Complexes, Floats]:
    """Inner product of the deviation with the unit response, and its energy, for every onset."""
    since = np.maximum(turns[np.newaxis, :] - _ONSETS[:, np.newaxis], 0.0)
    time = 2.0 * math.pi * since / speed_rad_s
    root = omega * complex(-zeta, math.sqrt(1.0 - zeta**2))
    other = root.conjugate()
    turning = 1j * speed_rad_s
    p = (turning - other) / (root - other)
    response = 1.0 - p * np.exp((root - turning) * time) - (1.0 - p) * np.exp((other - turning) * time)
    product = (response.conj() * deviation).sum(axis=1)
    energy = np.maximum((np.abs(response) ** 2).sum(axis=1), 1e-12)
    return np.asarray(product), np.asarray(energy)


@dataclass(frozen=True, slots=True)
class _Orbit:
    revolution: int
    turns: Floats
    position: Complexes


class LastOrbits:
    """The samples of the last revolutions, as far back as a comparison reaches.

    Args:
        abrupt: revolutions in the window of a departure that a comparison is made for, at most.
    """

    def __init__(self, abrupt: int) -> None:
        self._orbits: deque[_Orbit] = deque(maxlen=REVOLUTIONS + BEFORE + abrupt + 2)

    def add(self, revolution: int, turns: Floats, position: Complexes) -> None:
        """Keep a revolution.

        Args:
            revolution: its number.
            turns: float64 ``[n]``, shaft angle in revolutions from its beginning.
            position: complex128 ``[n]``, um; NaN where missing.
        """
        self._orbits.append(_Orbit(revolution, turns, position))

    def compare(self, onset: int, healthy: Calibration) -> Comparison | None:
        """The transient about an onset, unbalance against loss of damping; None if too little was kept."""
        orbits = [orbit for orbit in self._orbits if orbit.revolution >= onset - BEFORE]
        if len(orbits) < REVOLUTIONS + BEFORE:
            return None
        turns = np.concatenate([orbit.turns + (orbit.revolution - onset) for orbit in orbits])
        position = np.concatenate([orbit.position for orbit in orbits])
        whirl = np.exp(2j * math.pi * np.outer(turns, HARMONICS)) @ healthy.baseline
        there = np.isfinite(position)
        transient = Transient(turns[there], (position - whirl)[there], healthy.noise)
        return compare(transient, healthy.healthy)
