"""Orbits of a shaft that turns steadily, as files: what a recorder writes, healthy or not, sound or not."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

SPEED_RPM = 3000.0
SAMPLES_PER_REV = 64
RATE_HZ = SPEED_RPM / 60.0 * SAMPLES_PER_REV
AMPLITUDE_UM = 40.0
SAG_UM = 12.0
NOISE_UM = 1.0
VERDICTS = {
    "normal",
    "unbalance",
    "damping_loss",
    "static_load",
    "stiffness_loss",
    "rub",
    "unmodelled",
    "small_change",
}
"""All that the rotor's verdict can be."""
UNBALANCE = 0.8
"""Growth of 1X, in healthy amplitudes."""
ONSET = 80.25
"""In revolutions; not at a mark, where the rounding of the stated speed decides which one it falls into."""

OPTIONS = (
    *("--probes", "x,y", "--speed-rpm", f"{SPEED_RPM:g}", "--natural-frequency-hz", "60"),
    *("--damping-ratio", "0.1", "--clearance-um", "200"),
)
"""What the command line needs to know about these orbits."""


@dataclass
class Orbit:
    """Two probes and a keyphasor.

    Args:
        revolutions: whole revolutions.
        change: complex change of the forward 1X vector from `ONSET` on, in healthy amplitudes.
        until: revolution at which it goes away again.
        seed: of the noise.
    """

    revolutions: int = 120
    change: complex = 0.0
    until: float = math.inf
    seed: int = 1

    def __post_init__(self) -> None:
        index = np.arange(self.revolutions * SAMPLES_PER_REV)
        angle = 2.0 * np.pi * index / SAMPLES_PER_REV
        changed = (index >= ONSET * SAMPLES_PER_REV) & (index < self.until * SAMPLES_PER_REV)
        forward = AMPLITUDE_UM * np.where(changed, 1.0 + self.change, 1.0)
        z = forward * np.exp(1j * (angle - 0.7)) + 0.01 * AMPLITUDE_UM * np.exp(-1j * angle) - 1j * SAG_UM
        rng = np.random.default_rng(self.seed)
        self.x: NDArray[np.float64] = z.real + NOISE_UM * rng.standard_normal(len(z))
        self.y: NDArray[np.float64] = z.imag + NOISE_UM * rng.standard_normal(len(z))
        self.keyphasor = np.where((angle / (2.0 * np.pi)) % 1.0 < 0.1, -2.0, -10.0)

    def save(self, path: Path, **more: Any) -> Path:
        """Write an ``.npz`` with x, y in um, the keyphasor in V, and the rate."""
        np.savez(path, x=self.x, y=self.y, keyphasor=self.keyphasor, fs=RATE_HZ, **more)
        return path
