"""Vibration levels of a window: RMS, peak, crest factor, kurtosis, RMS in a band; with samples missing, too.

In a band a filled-in value is wrong twice: what is missing takes its power along, and the edges of the gaps
spread the power of all frequencies over all others. Integration blows that up at the low ones: one sample in
fifty lost of an accelerometer that hears a loud bearing makes a velocity that is not there.

The autocovariance has neither fault. Its mean product at lag k needs only the pairs of samples that
are there. Its expectation is right whatever else is missing, as long as samples are not lost because of
their value. The power in a band is a sum over lags of it (Wiener and Khinchin), so it is right on average,
too. With negative lags and taper, it is exactly the sum of a complete window.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
import scipy.fft

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]
    _Weights: TypeAlias = tuple[Floats, Floats]


SURE = 4.0
"""Bounds are so many standard deviations wide on either side."""
_LEAST_ERROR = 0.01
"""Share of the power that is never known better when anything is missing."""
_LEAST_PAIRS = 0.02
"""A lag of which a smaller share of pairs is there shows nothing."""
_LEAST_LAG = 1e-3
"""Nor does one at which the taper leaves a smaller share of the power."""


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


def kurtosis(samples: NDArray[np.float32]) -> float:
    """Fourth standardised moment of the samples that are there: 3 of Gaussian noise, 1.5 of a sine.

    A bearing with impacts raises it long before the RMS (Dyer and Stewart 1978). It is no excess: 3 is not
    taken off.

    Args:
        samples: float32 ``[n]`` with at least one finite value; NaN rows are left out.

    Returns:
        A pure number, 1 at least; 0 if nothing moves.
    """
    there = samples[np.isfinite(samples)].astype(np.float64)
    squared = (there - there.mean()) ** 2
    power = float(squared.mean())
    return float(np.mean(squared**2)) / power**2 if power > 0 else 0.0


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
    # One-sided spectrum: every bin but the first and last represents two.
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


class BandEstimate(NamedTuple):
    """RMS in a band of a window that lacks samples, in the unit of the samples (times s if integrated).

    Attributes:
        rms: the estimate; 0 where that of the power is negative, which chance may make it.
        low: it is hardly below this (`SURE` standard deviations of the power).
        high: nor above this.
        error: standard deviation of ``rms`` as a part of it; infinite if it is 0.
    """

    rms: float
    low: float
    high: float
    error: float


def gapped_band_rms(
    samples: Floats, rate_hz: float, low_hz: float, high_hz: float, *, integrate: bool = False
) -> BandEstimate:
    """`band_rms` of a window that lacks samples, with the error that this brings.

    The error is that beside the complete window, not beside the machine: of the gaps' own spectrum, by which
    each frequency's power leaks into all others, only the mean is known and taken off. How far chance may be
    from it follows from the power that leaks.

    Args:
        samples: float64 ``[n]``, n at least 4, at least two of them finite; what is not finite is missing.
        rate_hz: sampling rate.
        low_hz: lower edge of the band, above 0.
        high_hz: upper edge of the band.
        integrate: whether to give the RMS of the integral: velocity from acceleration.
    """
    n = len(samples)
    taper, weight = band_weights(n, rate_hz, low_hz, high_hz, integrate=integrate)
    there = np.isfinite(samples)
    swing = np.where(there, samples - samples[there].mean(), 0.0)
    whole, pairs = _taper_products(n), _products(there * taper)
    share = pairs / np.maximum(whole, np.finfo(np.float64).tiny)
    known = (whole > _LEAST_LAG * whole[0]) & (share > _LEAST_PAIRS)
    covariance = np.where(known, _products(swing * taper) / np.where(known, share, 1.0), 0.0)
    spectrum = _spectrum(covariance)
    power = float(np.sum(spectrum * weight))

    present = float(np.sum(there * taper) / np.sum(taper))
    # What the gaps leak, beside the samples that are there: their spectrum without its mean.
    leak = np.maximum(_spectrum(np.where(known, covariance * (share / present**2 - 1.0), 0.0)), 0.0)
    # Squares of Gaussian amplitudes; a Hann taper makes one of two neighbouring bins.
    variance = 2.0 * np.sum(weight**2 * (2.0 * np.maximum(spectrum, 0.0) * leak + leak**2))
    deviation = math.hypot(math.sqrt(variance), _LEAST_ERROR * power)
    return BandEstimate(
        math.sqrt(max(power, 0.0)),
        math.sqrt(max(power - SURE * deviation, 0.0)),
        math.sqrt(max(power + SURE * deviation, 0.0)),
        0.5 * deviation / power if power > 0.0 else math.inf,
    )


def _products(values: Floats) -> Floats:
    """Sums of products of values that are k apart, for k from 0 on; float64 ``[n]``."""
    n = len(values)
    size = scipy.fft.next_fast_len(2 * n, real=True)
    spectrum = scipy.fft.rfft(values, size)
    return np.asarray(scipy.fft.irfft(spectrum.real**2 + spectrum.imag**2, size)[:n])


@lru_cache(maxsize=64)
def _taper_products(n: int) -> Floats:
    return _products(np.hanning(n))


def _spectrum(covariance: Floats) -> Floats:
    """At the bins of a real FFT of ``n``, where lags k and k - n are alike; float64 ``[n // 2 + 1]``."""
    both = covariance.copy()
    both[1:] += covariance[:0:-1]
    return np.asarray(scipy.fft.rfft(both).real)
