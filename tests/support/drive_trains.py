"""Vibration of a gear and of an induction motor beside a bearing in good order."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.signal
from support.race_signals import RATE_HZ, SPEED_RPM, strikes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

SECONDS = 10.0


def geared(teeth: int, mate: int, *, mesh: float = 0.5, knock: float = 0.0, seed: int = 0) -> Floats:
    """A gear on the shaft: its mesh, modulated by both gears, and a tooth of the mate that knocks.

    Args:
        teeth: of the gear on the shaft.
        mate: teeth of the other one.
        mesh: amplitude of the mesh over the deviation of the noise.
        knock: size of the knock, once a turn of the mate.
        seed: of the noise.
    """
    samples = strikes(None, SECONDS, seed=seed)
    t = np.arange(len(samples)) / RATE_HZ
    shaft_hz = SPEED_RPM / 60.0
    mate_hz = shaft_hz * teeth / mate
    wave = sum(size * np.cos(2 * np.pi * k * teeth * shaft_hz * t + k) for k, size in ((1, 1.0), (2, 0.5)))
    samples += (
        mesh * wave * (1.0 + 0.3 * np.cos(2 * np.pi * shaft_hz * t) + 0.5 * np.cos(2 * np.pi * mate_hz * t))
    )
    struck = np.zeros(len(samples))
    struck[np.rint(np.arange(int(mate_hz * SECONDS)) / mate_hz * RATE_HZ).astype(int)] = knock
    pole = np.exp(-2 * np.pi * 200.0 / RATE_HZ + 2j * np.pi * 3000.0 / RATE_HZ)
    return np.asarray(samples + np.imag(scipy.signal.lfilter([1.0], [1.0, -pole], struck)))


def motor_driven(
    speed_rpm: float, mains_hz: float = 50.0, *, pole_pass_hz: float = 0.0, seed: int = 0
) -> Floats:
    """A motor whose forces come and go at twice the mains, and make its noise louder and softer.

    Args:
        speed_rpm: of the shaft.
        mains_hz: line frequency.
        pole_pass_hz: of sidebands; 0 for none.
        seed: of the noise.
    """
    noise = np.random.default_rng(seed).standard_normal(int(SECONDS * RATE_HZ))
    t = np.arange(len(noise)) / RATE_HZ
    turn = 2 * np.pi * speed_rpm / 60.0 * t
    shaft = sum(size * np.cos(k * turn + k) for k, size in ((1, 0.5), (2, 0.3), (3, 0.2)))
    force = np.sin(4 * np.pi * mains_hz * t) * (
        1.0 + 0.6 * (pole_pass_hz > 0.0) * np.cos(2 * np.pi * pole_pass_hz * t)
    )
    return np.asarray(noise * (1.0 + 0.5 * np.abs(np.sin(2 * np.pi * mains_hz * t))) + shaft + 0.4 * force)
