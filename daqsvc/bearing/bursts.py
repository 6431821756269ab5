"""Whether what a residual holds beyond the healthy machine's comes in bursts, as hits do, or steadily.

A race is named by which side the excess is on, and any excess is on some side: a noisier sensor, a changed
gain and steady forces look like one race or the other, too. But they are stationary, and hits are not. In
frames as short as a hit, the energies of stationary Gaussian noise scatter in a known way, whatever its level
and spectrum; those of hits scatter more, for some frames hold one and others do not.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing import impact
from daqsvc.bearing.model import BearingModel

if TYPE_CHECKING:
    from daqsvc.bearing.impact import HealthySpectrum
    from daqsvc.bearing.model import BearingParameters, Floats

STEADY = 2.0
"""Scatter of the energies over that of stationary noise, below which there are no hits. Half a second of it
has 0.8 to 1.3, a fault at -5 dB 5 and more."""
_LEAST_FRAMES = 32


class BurstMeter:
    """Measures how a residual scatters.

    Args:
        parameters: of the healthy bearing.
        healthy: of the healthy machine, by `daqsvc.bearing.isolation.isolation_spectrum`.
        frame: samples of a frame of that.
        kept: bool ``[frame // 2 + 1]``, its lines.
    """

    def __init__(
        self, parameters: BearingParameters, healthy: HealthySpectrum, frame: int, kept: impact.Mask
    ) -> None:
        self._frame, self._kept = frame, kept
        along, _ = impact.best_direction(healthy.covariance, np.diag(BearingModel(parameters).D))
        self._along = along.conj()
        self._alike = impact.energy_correlation(len(along))

    def measure(self, residual: Floats) -> float:
        """Variance of the frames' energies over that of stationary noise; NaN if too little is there.

        Every line counts by what it holds beyond the healthy machine's noise.

        Args:
            residual: float64 ``[n, 2]`` in m/s^2; frames with NaN are left out.
        """
        frames = impact.spectra(residual, self._frame)[:, self._kept]
        if len(frames) < _LEAST_FRAMES:
            return math.nan
        energies = np.abs(np.einsum("tfi,fi->tf", frames, self._along)) ** 2
        mean = energies.mean(axis=0)
        weight = np.maximum(1.0 - 1.0 / mean, 0.0)
        stationary = weight @ self._alike @ weight
        if not stationary > 0.0:
            return math.nan
        return float((energies / mean @ weight).var() / stationary)
