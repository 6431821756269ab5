"""Up to which frequency a record holds anything: it may be low-passed, or sampled more slowly than it states.

Above the edge of a low-pass, or above half the rate that a record was first sampled with, there is next to
nothing. That shows as a level that falls by far more, within less than an octave, than structures make it
fall. What lies beyond shows nothing of the machine and dilutes what does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.signal

from daqsvc.dsp.quality.upsampled import upsampling

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Real = NDArray[np.float64]

_SEGMENT = 4096
_BANDS = 128
_MOST = 1 << 20
"""Samples that are examined: an edge is there all the time."""
_FIRST, _LAST = 8, 109
"""Bands between which an edge is looked for: filters against aliasing end just below half the rate."""
_BELOW = (1.8, 1.25)
"""The level below an edge is taken from its frequency over these."""
_FALL_DB = 27.0
"""A fall of the level that is an edge. Measured records of three sets fell by at most 24 dB; low-passed (4th
order and more) or upsampled, the same fell by 29 dB and more."""


def occupied_top_hz(samples: Real, rate_hz: float) -> float | None:
    """Where a record ends in frequency; None where it reaches up to half its rate, or is too short.

    Args:
        samples: ``[n]``, finite.
        rate_hz: their sample rate.
    """
    if len(samples) < 2 * _SEGMENT:
        return None
    stored = upsampling(samples)
    if stored is not None:
        # Above lie images of what is below.
        return 0.5 * rate_hz / stored.factor
    # Windowed, as strong slow lines leak far up.
    _, power = scipy.signal.welch(samples[:_MOST], rate_hz, nperseg=_SEGMENT)
    bands = power[:-1].reshape(_BANDS, -1)
    # Lines do not touch a median.
    level_db: Real = 10.0 * np.log10(
        np.maximum(np.median(bands, axis=1), 1e-30 * float(power.max()) + 1e-300)
    )
    for edge in range(_FIRST, _LAST):
        first, last = int(edge / _BELOW[0]), int(edge / _BELOW[1])
        below_db = float(np.percentile(level_db[first : last + 1], 25))
        if below_db - float(np.percentile(level_db[edge + 1 :], 95)) > _FALL_DB:
            return (edge + 1) * 0.5 * rate_hz / _BANDS
    return None
