"""What the run-up of each geometry shows, read in noise of 20 dB."""

from __future__ import annotations

import functools
import math
import zlib
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.calibration.run_up import RunUpFit, fit_run_up, revolutions_of
from daqsvc.rotor.calibration.two_modes import TwoModeFit, fit_two_modes
from daqsvc.rotor.synchronous.vectors import synchronous_vectors

if TYPE_CHECKING:
    from pathlib import Path


@functools.lru_cache(maxsize=16)
def identified(folder: Path, geometry: str, seed: int) -> tuple[RunUpFit, TwoModeFit]:
    """The nearest Laval rotor and the two modes of a geometry, from its run-up."""
    with np.load(folder / f"bank-{geometry}-run-up.npz".replace(" ", "-")) as kept:
        z, angle, rate_hz = kept["z_um"].astype(np.complex128), kept["angle_rad"], float(kept["rate_hz"])
    rng = np.random.default_rng([seed, zlib.crc32(geometry.encode())])
    noise = math.sqrt(float(np.var(z)) / 2.0 / 100.0)
    z = z + noise * (rng.standard_normal(len(z)) + 1j * rng.standard_normal(len(z)))
    nearest = fit_run_up(np.column_stack((z.real, z.imag)), angle, rate_hz)
    return nearest, fit_two_modes(
        synchronous_vectors(revolutions_of(z, angle)),
        rate_hz,
        natural_frequency_hz=nearest.natural_frequency_hz,
        damping_ratio=nearest.damping_ratio,
    )
