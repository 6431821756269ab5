"""Values between samples: band-limited interpolation by a windowed sinc (Kaiser), any fraction of a sample.

Flat to -90 dB up to 0.41 of the lower one of the two rates; what lies above 0.59 of it is gone, so that a
slower grid is not aliased into.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import Samples

HALF_WIDTH = 16
"""Samples at the lower rate that count on either side of a value."""
BETA = 8.96
"""Of the Kaiser window: 0.1102 (A - 8.7) for A = 90 dB."""
PHASES = 512
"""Fractions of a sample that have a filter of their own; linear between them, which errs by -106 dB."""


class FractionalDelay:
    """Takes values of a sampled signal at any places between its samples.

    Args:
        rate_ratio: rate of the values over that of the samples; below 1 the band is narrowed for it.

    Attributes:
        reach: samples that count on either side of a place.
    """

    def __init__(self, rate_ratio: float = 1.0) -> None:
        if not rate_ratio > 0.0:
            raise ValueError(f"rate_ratio is {rate_ratio}; it must be positive")
        band = min(1.0, rate_ratio)
        self.reach = math.ceil(HALF_WIDTH / band)
        fraction = np.arange(PHASES + 1)[:, None] / PHASES
        t = np.arange(1 - self.reach, self.reach + 1) - fraction
        inside = np.sqrt(np.clip(1.0 - (t / self.reach) ** 2, 0.0, None))
        taps = np.sinc(band * t) * np.i0(BETA * inside)
        # A constant stays exactly what it is: the mean position of a shaft is a measured value too.
        self._taps = taps / taps.sum(axis=1, keepdims=True)

    def __call__(self, samples: Samples, places: NDArray[np.float64]) -> Samples:
        """The signal's values at places.

        Args:
            samples: float32 ``[m, channels]``.
            places: float64 ``[n]``, in samples from ``samples[0]``.

        Returns:
            float32 ``[n, channels]``; NaN, in the channel concerned, where one of the ``2 reach`` samples
            around a place is missing: not finite, or outside of ``samples``.
        """
        values = np.full((len(places), samples.shape[1]), np.nan, np.float32)
        before = np.floor(places)
        first = before.astype(np.int64) - (self.reach - 1)
        there = (first >= 0) & (first + 2 * self.reach <= len(samples))
        if not there.any():
            return values
        phase = (places[there] - before[there]) * PHASES
        row = np.minimum(phase.astype(np.int64), PHASES - 1)
        part = (phase - row)[:, None]
        taps = self._taps[row] * (1.0 - part) + self._taps[row + 1] * part
        around = np.lib.stride_tricks.sliding_window_view(samples, 2 * self.reach, axis=0)[first[there]]
        with np.errstate(invalid="ignore"):
            told = np.einsum("nct,nt->nc", around, taps)
        # Infinities of one sign would pass for a value.
        told[~np.isfinite(told)] = np.nan
        values[there] = told
        return values
