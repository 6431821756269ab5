"""Vibration levels of a window: RMS, peak, crest factor, and RMS in a band."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    _Weights: TypeAlias = tuple[NDArray[np.float64], NDArray[np.float64]]

STANDARD_GRAVITY = 9.80665
"""m/s2 per g (CGPM 1901)."""


class SignalLevels(NamedTuple):
    """Levels of one channel over one window, about its mean.

    Attributes:
        mean: mean value, in the unit of the samples.
        rms: root mean square about the mean, same unit.
        peak: largest deviation from the mean, same unit.
        crest_factor: peak over RMS; 0 if nothing moves.
        peak_to_peak: from the lowest to the highest value, same unit; so are the limits of shaft vibration
            (ISO 20816-3, annex; API 670).
    """

    mean: float
    rms: float
    peak: float
    crest_factor: float
    peak_to_peak: float


def levels(samples: NDArray[np.float32]) -> SignalLevels:
    """Levels of the samples that are there; NaN rows are left out.

    Args:
        samples: float32 ``[n]`` with at least one finite value.
    """
    there = samples[np.isfinite(samples)].astype(np.float64)
    mean = float(there.mean())
    swing = there - mean
    rms = float(np.sqrt(np.mean(swing**2)))
    peak = float(np.abs(swing).max())
    return SignalLevels(mean, rms, peak, peak / rms if rms > 0 else 0.0, float(np.ptp(there)))


@lru_cache(maxsize=64)
def band_weights(n: int, rate_hz: float, low_hz: float, high_hz: float, *, integrate: bool) -> _Weights:
    """Hann taper float64 ``[n]``, and the weight of each bin of the real FFT, float64 ``[n // 2 + 1]``.

    A power spectrum of tapered samples, summed with these weights, is the mean square in the band, over
    omega^2 if ``integrate`` asks for it.
    """
    frequency_hz = np.fft.rfftfreq(n, 1 / rate_hz)
    inside = (frequency_hz >= low_hz) & (frequency_hz <= high_hz)
    weight = inside.astype(np.float64)
    if integrate:
        weight[inside] /= (2 * np.pi * frequency_hz[inside]) ** 2
    taper = np.hanning(n)
    # One-sided spectrum: every bin but the first and last stands for two.
    return taper, 2 * weight / (n * np.sum(taper**2))


def band_rms(
    samples: NDArray[np.float64], rate_hz: float, low_hz: float, high_hz: float, *, integrate: bool = False
) -> float:
    """RMS of a window in a frequency band, after integration in time if asked (ISO 20816-1).

    The window is tapered (Hann) so that what does not fit into it does not leak to low frequencies,
    where integration would blow it up; the taper's loss of power is made good.

    Args:
        samples: float64 ``[n]``, finite, n at least 4.
        rate_hz: sampling rate.
        low_hz: lower edge of the band, above 0.
        high_hz: upper edge of the band.
        integrate: whether to give the RMS of the integral: velocity from acceleration.

    Returns:
        In the unit of the samples; times seconds if integrated.
    """
    taper, weight = band_weights(len(samples), rate_hz, low_hz, high_hz, integrate=integrate)
    spectrum = np.fft.rfft((samples - samples.mean()) * taper)
    return float(np.sqrt(np.sum((spectrum.real**2 + spectrum.imag**2) * weight)))
