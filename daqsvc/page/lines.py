"""Lines of a spectrum, and fewer of them to be sent."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


HANN_POWER = 1.5
"""The power of all lines of a wave over that of its highest one, by a Hann window."""


def amplitudes(values: Any) -> Floats:
    """Peak amplitudes of the lines of a complex spectrum, without mean and missing samples; by a Hann window.

    Args:
        values: ``[n]``, real or complex; NaN where missing.

    Returns:
        ``[n]``, at the frequencies of `numpy.fft.fftfreq`; of a real signal half of each line is at minus its
        frequency.
    """
    there = np.isfinite(values)
    centred = np.where(there, values - values[there].mean(), 0.0)
    window = np.hanning(len(values) + 1)[:-1]
    lines: Floats = np.abs(np.fft.fft(centred * window)) / (window * there).sum()
    return lines


def one_sided(values: Floats, rate_hz: float) -> tuple[Floats, Floats]:
    """Frequencies, Hz, and peak amplitudes of a real signal up to half its rate, both ``[n // 2 + 1]``.

    Args:
        values: ``[n]``; NaN where missing.
        rate_hz: samples per second.
    """
    lines = 2.0 * amplitudes(values)[: len(values) // 2 + 1]
    return np.arange(len(lines)) * rate_hz / len(values), lines


def size_of(lines: Floats) -> float:
    """The amplitude of one wave whose line these five are, wherever it lies between them.

    A Hann window spreads a wave over its neighbours: its highest line is up to 15 % too low, the power of all
    of them is not.
    """
    return float(np.sqrt(np.sum(np.square(lines)) / HANN_POWER))


def largest(frequency: Floats, lines: Floats, most: int) -> tuple[Floats, Floats]:
    """The largest line of each group of neighbours, so that there are no more than so many."""
    group = -(-len(lines) // most)
    if group == 1:
        return frequency, lines
    whole = len(lines) // group * group
    parts = lines[:whole].reshape(-1, group)
    kept = parts.argmax(axis=1) + group * np.arange(len(parts))
    return frequency[kept], lines[kept]
