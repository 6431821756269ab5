"""Drop-outs that come as numbers: runs of one and the same value in a channel that otherwise moves."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Real = NDArray[np.float64]

LEAST_RUN = 4
"""Three differences of nothing in a row."""
COARSE_RUN = 64
COARSE = 0.5
"""Least difference over the median one beyond which a converter is coarse: its channel rests by itself."""
NEAR_LIMIT = 0.025
"""So near to the extremes of all others, as a share of their range, a value is a limit."""
FALSE_RUNS = 1e-2
"""Runs that a whole record shows by itself, at most."""


def stuck(samples: Real) -> NDArray[np.bool_]:
    """Samples that belong to a run of one value, longer than the channel's own converter makes any.

    Args:
        samples: ``[n]``, all finite.

    Returns:
        ``[n]``; runs at the ends of the range are clipping and not marked.
    """
    n = len(samples)
    steps = np.abs(np.diff(samples))
    rests = steps == 0.0
    if not (rests[2:] & rests[1:-1] & rests[:-2]).any():
        return np.zeros(n, dtype=np.bool_)
    starts = np.flatnonzero(np.concatenate(([True], steps != 0.0)))
    lengths = np.diff(starts, append=n)
    moving = steps[steps != 0.0]
    repeated = min(float(np.mean(lengths > 1)), 0.99)
    least = max(LEAST_RUN, math.ceil(1.0 + math.log(FALSE_RUNS / n) / math.log(max(repeated, 1e-9))))
    if not len(moving) or moving.min() > COARSE * np.median(moving):
        least = max(least, COARSE_RUN)
    long = lengths >= least
    rest = samples[np.repeat(~long, lengths)]
    if not len(rest):
        return np.zeros(n, dtype=np.bool_)
    # A clipped channel comes to its limit steadily; what rests far beyond all the rest has dropped out.
    low, high = float(rest.min()), float(rest.max())
    near, values = NEAR_LIMIT * (high - low), samples[starts]
    clipped = (np.abs(values - low) <= near) | (np.abs(values - high) <= near)
    return np.repeat(long & ~clipped, lengths)
