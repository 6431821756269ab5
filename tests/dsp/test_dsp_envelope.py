"""The shortcuts of the envelope's spectrum give what the long way gives."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.fft
from scipy.signal import firwin

from daqsvc.dsp.envelope import (
    THINNED_BINS,
    THINNING,
    THINNING_KAISER,
    THINNING_TAPS,
    _low_pass,
    hann,
    line_power,
    row_medians,
    squared_envelope,
)

SAMPLES = 48_000


def whole_power(envelope: np.ndarray, bins: int) -> np.ndarray:
    """Squared peak amplitudes from the spectrum of every sample."""
    window = hann(len(envelope))
    spectrum = scipy.fft.rfft((envelope - envelope.mean()) * window)[:bins]
    return np.abs(spectrum) ** 2 * (2.0 / window.sum(dtype=np.float64)) ** 2


@pytest.mark.parametrize("columns", [5, 6, 301, 300])
def test_row_medians_are_those_of_numpy(columns: int) -> None:
    rows = np.random.default_rng(0).standard_normal((40, columns))
    kept = rows.copy()
    assert np.array_equal(row_medians(rows), np.median(rows, axis=1))
    assert np.array_equal(rows, kept)


def test_a_thinned_envelope_has_the_lines_of_the_whole_one() -> None:
    envelope = np.random.default_rng(1).exponential(size=SAMPLES).astype(np.float32)
    bins = int(THINNED_BINS * SAMPLES)
    whole, thinned = whole_power(envelope, bins), line_power(envelope, bins)
    assert np.abs(np.sqrt(thinned) - np.sqrt(whole)).max() < 3e-3 * np.sqrt(whole.mean())


def test_a_tone_that_would_fold_onto_a_line_does_not() -> None:
    # Just below the thinned rate: it would stand at the bin 1000, 20 times as large as the line at 700.
    place = np.arange(SAMPLES) / SAMPLES
    folding = 10.0 * np.cos(2.0 * np.pi * (SAMPLES // THINNING - 1000) * place)
    line = 0.5 * np.cos(2.0 * np.pi * 700 * place)
    power = line_power((1.0 + line + folding).astype(np.float32), 2000)
    assert np.sqrt(power[700]) == pytest.approx(0.5, rel=1e-3)
    assert np.sqrt(power[1000]) < 1e-3 * 10.0


def test_lines_beyond_the_thinned_range_are_still_told() -> None:
    place = np.arange(SAMPLES) / SAMPLES
    power = line_power((1.0 + 0.3 * np.cos(2.0 * np.pi * 15_000 * place)).astype(np.float32), 20_000)
    assert np.sqrt(power[15_000]) == pytest.approx(0.3, rel=1e-3)


@pytest.mark.parametrize("bins_of_band", [11_000, 57_777, 118_880])
def test_an_envelope_is_as_long_as_the_transforms_are_fast_and_can_be_thinned(bins_of_band: int) -> None:
    envelope = squared_envelope(np.ones(bins_of_band, dtype=np.complex64), 500)
    assert len(envelope) % THINNING == 0
    left = len(envelope)
    for factor in (2, 3, 5):
        while left % factor == 0:
            left //= factor
    assert left == 1


def test_the_low_pass_is_that_of_scipy_to_the_last_bit() -> None:
    taps = firwin(THINNING_TAPS, 0.5 / THINNING, window=("kaiser", THINNING_KAISER), fs=1.0)
    assert np.array_equal(_low_pass(), taps)
