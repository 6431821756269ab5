"""The shaft's speed from its harmonics, near a stated one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft

from daqsvc.dsp.envelope import running_median

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Real = NDArray[np.float64]

HARMONICS = np.arange(1, 9)
WEIGHTS = np.where(HARMONICS < 4, 1.0, 0.5)
CAP_NATS = 4.0
"""Most that one harmonic counts: a strong line that is not the shaft's must not decide alone."""
PRIOR_SHARE = 0.006
"""Spread of the true speed about the stated one. A weaker prior was drawn to the lines of the bearing."""
SEEN_NATS = 5.0


@dataclass(frozen=True, slots=True)
class ShaftRate:
    """The shaft's rate of revolution.

    Attributes:
        rate_hz: revolutions per second.
        seen: whether harmonics of the shaft stand out at that rate.
    """

    rate_hz: float
    seen: bool


def shaft_rate(signal: Real, rate_hz: float, stated_hz: float, tolerance: float) -> ShaftRate:
    """Refine a stated shaft rate by the harmonics of the shaft in a signal.

    Args:
        signal: ``[n]``.
        rate_hz: its sample rate.
        stated_hz: stated revolutions per second.
        tolerance: how far to search, as a share.
    """
    n = len(signal)
    window = np.hanning(n + 1)[:n]
    top = min(stated_hz * (1.0 + tolerance) * (HARMONICS[-1] + 2.0), 0.5 * rate_hz)
    # Only the lowest lines are needed: decimating first saves the transform of the rest.
    spectrum = scipy.fft.rfft((signal - signal.mean()) * window)[: int(top * n / rate_hz) + 1]
    power = spectrum.real**2 + spectrum.imag**2
    ratio = power / np.maximum(running_median(power, round(2.0 * stated_hz * n / rate_hz)), 1e-300)
    score = np.minimum(np.log(np.maximum(ratio, 1e-12)), CAP_NATS)
    step = rate_hz / n / HARMONICS[-1] / 2.0
    count = int(np.ceil(tolerance * stated_hz / step))
    candidates = stated_hz + step * np.arange(-count, count + 1)
    bins = np.rint(np.outer(candidates, HARMONICS) * n / rate_hz).astype(np.int64)
    heard = bins < len(score)
    votes = np.where(heard, score[np.minimum(bins, len(score) - 1)], 0.0) @ WEIGHTS
    total = votes - 2.0 * ((candidates / stated_hz - 1.0) / PRIOR_SHARE) ** 2
    best = int(np.argmax(total))
    return ShaftRate(float(candidates[best]), bool(votes[best] > SEEN_NATS))
