"""One observer's estimates, sample by sample, which the bank keeps to itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor import kernels
from daqsvc.rotor.discretise import discretise

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.discretise import BankMode

    Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Estimates:
    """What an observer expected at every sample, before it saw it.

    Attributes:
        x: float64 ``[n]``, horizontal position in clearances.
        vx: float64 ``[n]``, horizontal velocity in clearances per normalised time.
        y: float64 ``[n]``, vertical position in clearances.
        innovations: float64 ``[n, 2]``, measured less expected position in clearances.
    """

    x: Floats
    vx: Floats
    y: Floats
    innovations: Floats


def observe(
    modes: Sequence[BankMode], xy: Floats, angle_rad: Floats, *, noise: float, duration: float
) -> dict[str, Estimates]:
    """Let free-running observers follow a measurement, from a disc that rests in the centre.

    Args:
        modes: the observers' models, the healthy one first.
        xy: float64 ``[n, 2]``, measured position in clearances.
        angle_rad: float64 ``[n]``, shaft angle.
        noise: standard deviation of the measured position in clearances.
        duration: normalised time between samples.

    Returns:
        Estimates by the name of the mode.
    """
    observers = discretise(modes, noise=noise, duration=duration)
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    orbits = _orbits(observers, cos, sin)
    # A state is the deviation from the mode's own orbit.
    states = -orbits[0]
    deviations = np.empty_like(orbits)
    usable = np.ones(1, dtype=np.bool_)
    scores = np.empty((len(modes), 1))
    for k in range(len(xy)):
        deviations[k] = states
        now = slice(k, k + 1)
        kernels.run_free(xy[now], usable, cos[now], sin[now], observers, states, scores)
    expected = orbits + deviations
    return {
        mode.name: Estimates(
            x=expected[:, i, 0],
            vx=expected[:, i, 1],
            y=expected[:, i, 2],
            innovations=xy - expected[:, i, [0, 2]],
        )
        for i, mode in enumerate(modes)
    }


def _orbits(observers: NDArray[np.void], cos: Floats, sin: Floats) -> Floats:
    """Reference orbits as states, float64 ``[n, M, 4]``."""
    turning = (observers["a"] + 1j * observers["b"]) * (cos + 1j * sin)[:, np.newaxis]
    velocity = 1j * observers["speed"] * turning
    position = turning + observers["rest_x"] + 1j * observers["rest_y"]
    return np.stack((position.real, velocity.real, position.imag, velocity.imag), axis=-1)
