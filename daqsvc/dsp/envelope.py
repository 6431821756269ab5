"""Envelopes of a whitened band: what is left of a signal when every frequency counts the same.

A defect of a bearing modulates noise and resonances far above the rate at which it strikes. Which band it
modulates is not known beforehand and differs between machines. Whitening gives all bands one voice, so that
the modulation is found without choosing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Real = NDArray[np.float64]
    Complex = NDArray[np.complex128]
    # Whitened, there is no range of amplitudes left that would need more than single precision.
    Envelope = NDArray[np.float32]
    Band = NDArray[np.complex64]

EXP_MEDIAN = np.log(2.0)
"""Median over mean of an exponential distribution: a periodogram's bins of noise."""

OVERSAMPLING = 1.5
"""Samples of an envelope per bin of its band. One is enough for its square; its logarithm is broader."""

CLIP_MEDIANS = 3.0

HANN_NOISE_BANDWIDTH = 1.5
"""Bins over which a line of a Hann-windowed spectrum spreads its power."""


@dataclass(frozen=True, slots=True)
class WhitenedBand:
    """A band of a real signal's spectrum in two whitened forms.

    Attributes:
        phase: unit amplitude in every bin (cepstrum pre-whitening): only the phases are left, ``[bins]``.
        clipped: divided by the local median amplitude, lines clipped to `CLIP_MEDIANS`, ``[bins]``.
    """

    phase: Band
    clipped: Band


def running_median(values: Real, width: int) -> Real:
    """Median over about ``width`` neighbours, from half-overlapping blocks with straight lines between.

    Args:
        values: ``[n]``.
        width: in bins; no less than 2 are used.

    Returns:
        ``[n]``, constant beyond the centres of the first and last block.
    """
    n = len(values)
    hop = max(min(width, n) // 2, 1)
    width = 2 * hop
    if n <= 2 * width:
        return np.full(n, float(np.median(values)))
    blocks = np.lib.stride_tricks.sliding_window_view(values, width)[::hop]
    centres = hop * np.arange(len(blocks)) + 0.5 * (width - 1)
    return np.interp(np.arange(n), centres, np.median(blocks, axis=1))


def whiten(
    spectrum: Complex, samples: int, rate_hz: float, low_hz: float, high_hz: float, median_hz: float
) -> WhitenedBand:
    """Whiten a band of a signal.

    Args:
        spectrum: one-sided spectrum of the signal, unwindowed.
        samples: length of the signal.
        rate_hz: its sample rate.
        low_hz: where the band begins.
        high_hz: where it ends.
        median_hz: width of the local median amplitude.
    """
    per_hz = samples / rate_hz
    part = spectrum[round(low_hz * per_hz) : round(high_hz * per_hz)]
    amplitude = np.maximum(np.abs(part), np.finfo(np.float64).tiny)
    median = running_median(amplitude, round(median_hz * per_hz))
    phase = part / amplitude
    clipped = phase * np.minimum(amplitude / median, CLIP_MEDIANS)
    return WhitenedBand(phase.astype(np.complex64), clipped.astype(np.complex64))


def squared_envelope(band: Band, bins: int) -> Envelope:
    """Squared envelope of a band over its mean, 1 on average, on no more samples than it takes.

    Args:
        band: one-sided spectrum of the band; where it lies does not matter.
        bins: how many bins of the envelope's own spectrum will be looked at: those are free of aliasing.

    Returns:
        ``[samples]`` at a rate of its own, over the signal's whole duration.
    """
    analytic = scipy.fft.ifft(band, scipy.fft.next_fast_len(int(OVERSAMPLING * len(band)) + bins))
    envelope = analytic.real**2 + analytic.imag**2
    return np.asarray(envelope / envelope.mean(), dtype=np.float32)


def line_power(envelope: Envelope, bins: int) -> Real:
    """Squared peak amplitudes of the lines in an envelope, ``[bins]``, by a Hann-windowed spectrum."""
    window = hann(len(envelope))
    spectrum = scipy.fft.rfft((envelope - envelope.mean()) * window)[:bins].astype(np.complex128)
    return np.asarray((spectrum.real**2 + spectrum.imag**2) * (2.0 / window.sum(dtype=np.float64)) ** 2)


@lru_cache(maxsize=8)
def hann(samples: int) -> Envelope:
    """The periodic Hann window, ``[samples]``; kept, as the same lengths come again and again."""
    window = np.hanning(samples + 1)[:samples].astype(np.float32)
    window.setflags(write=False)
    return window
