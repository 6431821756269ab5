"""What speaks for harmonics of a shaft at any speed: in the signal itself, and in the envelope of its band.

Every harmonic has a voice of `CAP_NATS` at most, so that no strong line decides alone. A speed that is true
gathers more voices than any other, whichever lines the other happens to meet.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft

from daqsvc.dsp.envelope import hann, running_median

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Real = NDArray[np.float64]
    Complex = NDArray[np.complex128]

HARMONICS: Real = np.arange(1.0, 9.0)
WEIGHTS = np.where(HARMONICS < 4, 1.0, 0.5)
CAP_NATS = 4.0
"""Most that one harmonic counts: a strong line that is not the shaft's must not decide alone."""
ENVELOPE_WEIGHT = 0.5
"""What the envelope's lines count against the signal's: those of the bearing stand there, too."""
MAINS_HZ = (50.0, 60.0)
MAINS_BINS = 2.0
"""How far the skirt of a line of the mains reaches."""
HIGHEST_ORDER = 18.0
"""Highest multiple of the stated rate that is looked at: eight harmonics of the fastest speed held against
it."""
MEDIAN_ORDERS = 2.0
"""Width of the local noise level, in multiples of the stated rate."""
LEAST_POWER = 1e-300
LEAST_RATIO = 1e-12


@dataclass(frozen=True, slots=True)
class Voices:
    """Voices for a line at every frequency of a spectrum.

    Attributes:
        nats: log of the power over its local median, capped, ``[bins]``.
        per_hz: bins per Hz.
    """

    nats: Real
    per_hz: float

    @classmethod
    def of(cls, power: Real, per_hz: float, stated_hz: float) -> Voices:
        """The voices of a power spectrum.

        Args:
            power: ``[bins]``.
            per_hz: bins per Hz.
            stated_hz: stated revolutions per second.
        """
        median = running_median(power, round(MEDIAN_ORDERS * stated_hz * per_hz))
        nats = np.log(np.maximum(power / np.maximum(median, LEAST_POWER), LEAST_RATIO))
        return cls(np.minimum(nats, CAP_NATS), per_hz)

    def at(self, hz: Real) -> Real:
        """Voices at some frequencies; 0 beyond the spectrum."""
        bins = np.rint(hz * self.per_hz).astype(np.int64)
        return np.where(bins < len(self.nats), self.nats[np.minimum(bins, len(self.nats) - 1)], 0.0)


@dataclass(frozen=True, slots=True)
class ShaftHarmonics:
    """Voices of the signal and of its envelope.

    Attributes:
        signal: the low lines of the signal.
        envelope: the lines of the whitened band's envelope: where the shaft modulates it.
    """

    signal: Voices
    envelope: Voices

    def votes(self, rates_hz: Real) -> Real:
        """Votes for some rates of revolution in nats, ``[n]``."""
        return np.asarray(self.voices(rates_hz, HARMONICS) @ WEIGHTS)

    def voices(self, rates_hz: Real, orders: Real) -> Real:
        """Voices at some orders of some rates of revolution, ``[rates, orders]``."""
        hz = np.outer(rates_hz, orders)
        return np.asarray(self.signal.at(hz) + ENVELOPE_WEIGHT * self.envelope.at(hz))

    def mains_votes(self, rate_hz: float) -> float:
        """The part of a rate's votes that lines of the mains may have cast."""
        hz: Real = rate_hz * HARMONICS
        reach = MAINS_BINS / self.signal.per_hz
        near = np.zeros(len(hz), dtype=np.bool_)
        for line_hz in MAINS_HZ:
            near |= np.abs(hz - line_hz * np.maximum(np.rint(hz / line_hz), 1.0)) <= reach
        return float((near * WEIGHTS) @ np.maximum(self.signal.at(hz), 0.0))

    def grid(self, low_hz: float, high_hz: float) -> Real:
        """Rates between two, half a bin apart at the highest harmonic."""
        return np.arange(low_hz, high_hz, 0.5 / self.signal.per_hz / float(HARMONICS[-1]))


def shaft_harmonics(
    series: Real, series_rate_hz: float, envelope_power: Real, per_hz: float, stated_hz: float
) -> ShaftHarmonics:
    """Listen for harmonics of a shaft.

    Args:
        series: ``[n]``, the signal below `HIGHEST_ORDER` times the stated rate.
        series_rate_hz: samples of it per second.
        envelope_power: power spectrum of the band's envelope, ``[bins]``.
        per_hz: bins of it per Hz.
        stated_hz: stated revolutions per second.
    """
    spectrum = scipy.fft.rfft(series * hann(len(series)))
    power = spectrum.real**2 + spectrum.imag**2
    signal = Voices.of(power, len(series) / series_rate_hz, stated_hz)
    kept = envelope_power[: int(HIGHEST_ORDER * stated_hz * per_hz) + 1]
    return ShaftHarmonics(signal, Voices.of(kept, per_hz, stated_hz))


def slow_series(spectrum: Complex, step_hz: float, stated_hz: float) -> tuple[Real, float]:
    """The low part of a signal as a slower series, which costs no time, and its samples per second.

    Args:
        spectrum: one-sided spectrum of the signal, unwindowed.
        step_hz: between its bins.
        stated_hz: stated revolutions per second.
    """
    bins = min(int(HIGHEST_ORDER * stated_hz / step_hz), len(spectrum) - 1)
    low = spectrum[:bins].copy()
    low[0] = 0.0
    samples = scipy.fft.next_fast_len(2 * bins, real=True)
    return scipy.fft.irfft(low, samples), samples * step_hz
