"""Envelopes of a whitened band: what is left of a signal when every frequency counts the same.

A defect of a bearing modulates noise and resonances far above the rate at which it strikes. Which band it
modulates is not known beforehand and differs between machines. Whitening gives all bands one voice, so that
the modulation is found without choosing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Real = NDArray[np.float64]
    Complex = NDArray[np.complex128]

EXP_MEDIAN = np.log(2.0)
"""Median over mean of an exponential distribution: a periodogram's bins of noise."""

HANN_NOISE_BANDWIDTH = 1.5
"""Bins over which a line of a Hann-windowed spectrum spreads its power."""


@dataclass(frozen=True, slots=True)
class WhitenedBand:
    """A band of a real signal's spectrum in two whitened forms.

    Attributes:
        phase: unit amplitude in every bin (cepstrum pre-whitening): only the phases are left, `[bins]`.
        clipped: divided by the local median amplitude, lines clipped to three medians, `[bins]`.
        first_bin: the bin of the spectrum at which the band begins.
        samples: length of the signal.
    """

    phase: Complex
    clipped: Complex
    first_bin: int
    samples: int


def running_median(values: Real, width: int) -> Real:
    """Median over about ``width`` neighbours, from half-overlapping blocks with straight lines between.

    Args:
        values: ``[n]``.
        width: in bins; no less than 3 are used.

    Returns:
        ``[n]``, constant beyond the centres of the first and last block.
    """
    n = len(values)
    hop = max(min(width, n) // 4, 1)
    width = 4 * hop
    if n <= 2 * width:
        return np.full(n, float(np.median(values)))
    blocks = np.lib.stride_tricks.sliding_window_view(values, width)[::hop]
    centres = hop * np.arange(len(blocks)) + 0.5 * (width - 1)
    return np.interp(np.arange(n), centres, np.median(blocks, axis=1))


def whiten(signal: Real, rate_hz: float, low_hz: float, high_hz: float, median_hz: float) -> WhitenedBand:
    """Whiten a band of a signal.

    Args:
        signal: ``[n]``, any unit.
        rate_hz: its sample rate.
        low_hz: where the band begins.
        high_hz: where it ends.
        median_hz: width of the local median amplitude.
    """
    n = len(signal)
    first, last = round(low_hz * n / rate_hz), round(high_hz * n / rate_hz)
    spectrum = scipy.fft.rfft(signal)[first:last]
    amplitude = np.abs(spectrum)
    np.maximum(amplitude, np.finfo(np.float64).tiny, out=amplitude)
    median = running_median(amplitude, round(median_hz * n / rate_hz))
    phase = spectrum / amplitude
    clipped = phase * np.minimum(amplitude / np.maximum(median, np.finfo(np.float64).tiny), 3.0)
    return WhitenedBand(phase, clipped, first, n)


def squared_envelope(band: Complex, samples: int) -> Real:
    """Squared envelope of a band, over its mean, ``[samples]``: 1 on average.

    Args:
        band: one-sided spectrum of the band, ``[bins]``; where it lies does not matter.
        samples: length of the signal that it was taken from.
    """
    analytic = scipy.fft.ifft(band, samples)
    envelope = analytic.real**2 + analytic.imag**2
    return np.asarray(envelope / envelope.mean(), dtype=np.float64)


def line_power(envelope: Real, bins: int) -> Real:
    """Squared peak amplitudes of the lines in an envelope, ``[bins]``, by a Hann-windowed spectrum."""
    n = len(envelope)
    window = np.hanning(n + 1)[:n]
    spectrum = scipy.fft.rfft((envelope - envelope.mean()) * window)[:bins]
    power = (spectrum.real**2 + spectrum.imag**2) * (2.0 / window.sum()) ** 2
    return np.asarray(power, dtype=np.float64)
