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
    Floating = NDArray[np.floating]
    Complex = NDArray[np.complex128]
    # Whitened, there is no range of amplitudes left that would need more than single precision.
    Envelope = NDArray[np.float32]
    Band = NDArray[np.complex64]

EXP_MEDIAN = np.log(2.0)
"""Median over mean of an exponential distribution: a periodogram's bins of noise."""

OVERSAMPLING = 1.5
"""Samples of an envelope per bin of its band. One is enough for its square; its logarithm is broader."""

CLIP_MEDIANS = 3.0

THINNING = 4
"""One sample of so many of an envelope is enough for its lowest lines."""
THINNING_TAPS = 7 * THINNING
THINNING_KAISER = 6.5
"""Shape of the low-pass before: what lies where it would fold onto the lines is 60 dB down."""
THINNED_BINS = 0.05
"""Lines up to this share of an envelope's samples are examined in the thinned one."""

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


def running_median(values: Floating, width: int) -> Real:
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
    blocks: Floating = np.lib.stride_tricks.sliding_window_view(values, width)[::hop]
    centres = hop * np.arange(len(blocks)) + 0.5 * (width - 1)
    return np.interp(np.arange(n), centres, row_medians(blocks))


def row_medians(rows: Floating) -> Real:
    """Median of each row, ``[rows]``: that of `numpy.median` five times as fast; NaN is not looked for.

    Args:
        rows: ``[rows, columns]``, not changed.
    """
    half = rows.shape[1] // 2
    parted = np.array(rows, order="C")
    # One place at a time is what the partition is fast at; the one below it is the largest of its side.
    parted.partition(half, axis=1)
    middle = parted[:, half]
    if rows.shape[1] % 2 == 0:
        middle = 0.5 * (parted[:, :half].max(axis=1) + middle)
    return np.asarray(middle, dtype=np.float64)


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
    part = spectrum[round(low_hz * per_hz) : round(high_hz * per_hz)].astype(np.complex64)
    amplitude = np.maximum(np.abs(part), np.finfo(np.float32).tiny)
    median = running_median(amplitude, round(median_hz * per_hz)).astype(np.float32)
    phase = part / amplitude
    clipped = phase * np.minimum(amplitude / median, CLIP_MEDIANS)
    return WhitenedBand(np.asarray(phase, np.complex64), np.asarray(clipped, np.complex64))


def squared_envelope(band: Band, bins: int) -> Envelope:
    """Squared envelope of a band over its mean, 1 on average, on no more samples than it takes.

    Args:
        band: one-sided spectrum of the band; where it lies does not matter.
        bins: how many bins of the envelope's own spectrum will be examined: those are free of aliasing.

    Returns:
        ``[samples]`` at its own rate, over the signal's whole duration.
    """
    least = int(OVERSAMPLING * len(band)) + bins
    # Lengths of small factors only, as of real transforms: those with 7 and 11 take twice as long.
    samples = THINNING * scipy.fft.next_fast_len(-(-least // THINNING), real=True)
    analytic = scipy.fft.ifft(band, samples)
    envelope = analytic.real**2 + analytic.imag**2
    return np.asarray(envelope / envelope.mean(), dtype=np.float32)


def line_power(envelope: Envelope, bins: int) -> Real:
    """Squared peak amplitudes of the lines in an envelope, ``[bins]``, by a Hann-windowed spectrum.

    Args:
        envelope: ``[samples]``, periodic over its length.
        bins: how many are wanted.
    """
    samples = len(envelope)
    centred = envelope - envelope.mean()
    thin = samples % THINNING == 0 and samples > THINNING_TAPS and bins <= THINNED_BINS * samples
    if thin:
        centred = _thinned(centred)
    window = hann(len(centred))
    spectrum = scipy.fft.rfft(centred * window)[:bins].astype(np.complex128)
    power = (spectrum.real**2 + spectrum.imag**2) * (2.0 / window.sum(dtype=np.float64)) ** 2
    return np.asarray(power / _thinned_response(samples, bins) if thin else power)


def _thinned(envelope: Envelope) -> Envelope:
    """One sample of `THINNING`, after a low-pass, ``[samples / THINNING]``."""
    taps = _low_pass().astype(np.float32).reshape(-1, THINNING)
    # Each block of samples meets each block of taps once; the products are then shifted together.
    products = taps @ envelope.reshape(-1, THINNING).T
    thinned: Envelope = products[0]
    for shift in range(1, len(taps)):
        thinned[:-shift] += products[shift, shift:]
        thinned[-shift:] += products[shift, :shift]
    return thinned


@lru_cache(maxsize=1)
def _low_pass() -> Real:
    """Impulse response of the low-pass, ``[THINNING_TAPS]``, 1 at 0 Hz.

    What `scipy.signal.firwin` gives, to the last bit, without the 47 MB of that package.
    """
    lags = np.arange(THINNING_TAPS) - 0.5 * (THINNING_TAPS - 1)
    taps = np.sinc(lags / THINNING) * np.kaiser(THINNING_TAPS, THINNING_KAISER) / THINNING
    return np.asarray(taps / taps.sum(), dtype=np.float64)


@lru_cache(maxsize=8)
def _thinned_response(samples: int, bins: int) -> Real:
    """Power response of the low-pass at the bins of an envelope, ``[bins]``."""
    angle = 2.0 * np.pi * np.arange(bins)[:, np.newaxis] / samples
    # Symmetric taps: the response is a sum of cosines about their middle.
    lags = np.arange(THINNING_TAPS) - 0.5 * (THINNING_TAPS - 1)
    response: Real = np.square(np.cos(angle * lags) @ _low_pass())
    response.setflags(write=False)
    return response


@lru_cache(maxsize=8)
def hann(samples: int) -> Envelope:
    """The periodic Hann window, ``[samples]``; kept, as the same lengths come again and again."""
    window = np.hanning(samples + 1)[:samples].astype(np.float32)
    window.setflags(write=False)
    return window


def levelled(envelope: Envelope, holes: Real) -> Envelope:
    """An envelope with its own mean where nothing of the machine is left: no line comes of it, none is lost.

    Args:
        envelope: ``[n]``.
        holes: ``[holes, 2]``, their beginnings and ends as shares of its length.
    """
    if not len(holes):
        return envelope
    inside = np.zeros(len(envelope), dtype=np.bool_)
    for first, last in np.rint(holes * len(envelope)).astype(np.int64):
        inside[first:last] = True
    return np.where(inside, envelope[~inside].mean(), envelope)
