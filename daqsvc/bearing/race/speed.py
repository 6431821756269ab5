"""The shaft's speed from its harmonics, near a stated one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft

from daqsvc.bearing.race.verdict import RaceInputError
from daqsvc.dsp.envelope import hann, running_median
from daqsvc.dsp.order_speed import find_speed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Real = NDArray[np.float64]
    Complex = NDArray[np.complex128]

HARMONICS = np.arange(1, 9)
WEIGHTS = np.where(HARMONICS < 4, 1.0, 0.5)
CAP_NATS = 4.0
"""Most that one harmonic counts: a strong line that is not the shaft's must not decide alone."""
PRIOR_SHARE = 0.006
"""Spread of the true speed about the stated one. A weaker prior was drawn to the lines of the bearing."""
HIGHEST_ORDER = 16.0
"""Highest multiple of the stated rate that the slower series keeps."""
LINE_REVOLUTIONS = 160.0
"""As many are enough to see 1X to 3X sharply; more cost more than they give."""
LINE_DEVIATION_SHARE = 0.002
"""Largest deviation of a speed from the lines of 1X to 3X that is taken before the votes of all harmonics."""
SEEN_NATS = 7.0
"""Votes that noise gathers once in a thousand records of 300 revolutions."""
CAGE_SLIP = 0.02
LEAST_POWER = 1e-300
LEAST_RATIO = 1e-12


@dataclass(frozen=True, slots=True)
class ShaftRate:
    """The shaft's rate of revolution.

    Attributes:
        rate_hz: revolutions per second.
        seen: whether harmonics of the shaft stand out at that rate.
        sharp: whether it is known to a fraction of the search.
    """

    rate_hz: float
    seen: bool
    sharp: bool = False


def shaft_rate(
    spectrum: Complex, step_hz: float, stated_hz: float, tolerance: float, cage: float
) -> ShaftRate:
    """Refine a stated shaft rate by the harmonics of the shaft in a signal.

    The lines of 1X to 3X decide where they stand out (`find_speed`); otherwise eight harmonics vote, each
    with a limited voice.

    Args:
        spectrum: one-sided spectrum of the signal, unwindowed.
        step_hz: between its bins.
        stated_hz: stated revolutions per second.
        tolerance: how far to search, as a share.
        cage: order of the bearing's cage.

    Raises:
        RaceInputError: the harmonics of a wholly different speed are there, and none of this one.
    """
    # All that matters lies at low frequencies: as a slower series it is found in no time.
    bins = min(int(HIGHEST_ORDER * stated_hz / step_hz), len(spectrum) - 1)
    low = spectrum[:bins].copy()
    low[0] = 0.0
    samples = scipy.fft.next_fast_len(2 * bins, real=True)
    signal = scipy.fft.irfft(low, samples)
    rate_hz = samples * step_hz
    voted, votes = _vote(signal, rate_hz, stated_hz, tolerance)
    enough = signal[: int(LINE_REVOLUTIONS * rate_hz / stated_hz)]
    try:
        line = find_speed(enough[:, np.newaxis], rate_hz, stated_hz)
    except ValueError as error:
        # A damaged ball makes lines at 1X less the cage's rate that can outweigh the shaft's own.
        seen = votes > SEEN_NATS
        if seen or _cage_line(enough, rate_hz, (1.0 - cage) * stated_hz):
            return ShaftRate(voted, seen)
        raise RaceInputError(
            "shaft speed or sample rate",
            f"is wrong: {error}",
            "give the speed of this recording and the rate it was sampled with",
        ) from error
    sharp = line.seen and line.deviation_hz <= LINE_DEVIATION_SHARE * stated_hz
    if sharp and abs(line.hz / stated_hz - 1.0) <= tolerance:
        return ShaftRate(line.hz, seen=True, sharp=True)
    return ShaftRate(voted, votes > SEEN_NATS)


def _cage_line(series: Real, rate_hz: float, line_hz: float) -> bool:
    """Whether the line at 1X less the cage's rate stands out, as a speed of its own."""
    try:
        line = find_speed(series[:, np.newaxis], rate_hz, line_hz)
    except ValueError:
        return False
    return line.seen and abs(line.hz / line_hz - 1.0) < CAGE_SLIP


def _score(signal: Real, rate_hz: float, width_hz: float) -> tuple[Real, float]:
    """Log of the periodogram over its local median, and its bins per Hz."""
    spectrum = scipy.fft.rfft(signal * hann(len(signal)))
    power = spectrum.real**2 + spectrum.imag**2
    per_hz = len(signal) / rate_hz
    ratio = power / np.maximum(running_median(power, round(width_hz * per_hz)), LEAST_POWER)
    return np.log(np.maximum(ratio, LEAST_RATIO)), per_hz


def _vote(signal: Real, rate_hz: float, stated_hz: float, tolerance: float) -> tuple[float, float]:
    """The rate that most harmonics speak for, and their votes in nats."""
    score, per_hz = _score(signal, rate_hz, 2.0 * stated_hz)
    np.minimum(score, CAP_NATS, out=score)
    step = 0.5 / per_hz / HARMONICS[-1]
    count = int(np.ceil(tolerance * stated_hz / step))
    candidates = stated_hz + step * np.arange(-count, count + 1)
    bins = np.rint(np.outer(candidates, HARMONICS) * per_hz).astype(np.int64)
    heard = bins < len(score)
    votes = np.where(heard, score[np.minimum(bins, len(score) - 1)], 0.0) @ WEIGHTS
    total = votes - 2.0 * ((candidates / stated_hz - 1.0) / PRIOR_SHARE) ** 2
    best = int(np.argmax(total))
    return float(candidates[best]), float(votes[best])
