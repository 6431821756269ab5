"""Whether a revolution is sound, at a glance: what watches a shaft asks it forty times a second.

`daqsvc.dsp.quality.probes` finds out what is wrong with a revolution, and states it. Nearly none has anything
wrong with it, and that is seen in one pass over its samples.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from daqsvc.dsp.quality.clipped import CLIPPED_REVOLUTION, LEAST_IN_REVOLUTION
from daqsvc.dsp.quality.probes import DEAD
from daqsvc.dsp.quality.stuck import LONGER, RUNS
from daqsvc.dsp.quality.unit import MOST_IN_ANY_UNIT
from daqsvc.kernels import njit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

_ROUNDING = 1e-6
"""A standard deviation that is nearer to its limit, relatively, is left to the whole of the checks."""


@njit("float64(float64[:, ::1], int64)", cache=True, nogil=True, error_model="numpy")
def _sound_deviation(samples: Floats, column: int) -> float:
    """The standard deviation of a probe that is not clipped and stands still nowhere; NaN if it may be."""
    n = len(samples)
    lowest = highest = samples[0, column]
    total, at_lowest, at_highest = 0.0, 0, 0
    runs, run, longest, second = 0, 0, 0, 0
    for k in range(n):
        value = samples[k, column]
        total += value
        if value < lowest:
            lowest, at_lowest = value, 0
        if value > highest:
            highest, at_highest = value, 0
        at_lowest += value == lowest
        at_highest += value == highest
        if k and value == samples[k - 1, column]:
            run += 1
        else:
            runs, longest, second = runs + 1, max(longest, run), max(second, min(longest, run))
            run = 1
    longest, second = max(longest, run), max(second, min(longest, run))
    if max(at_lowest, at_highest) >= max(CLIPPED_REVOLUTION * n, LEAST_IN_REVOLUTION):
        return math.nan
    # A run is a standstill if it is much longer than enough others: see `daqsvc.dsp.quality.stuck`.
    if runs == 1 or (runs > RUNS and longest >= LONGER * second):
        return math.nan
    mean, squares = total / n, 0.0
    for k in range(n):
        squares += (samples[k, column] - mean) ** 2
    return math.sqrt(squares / n)


@njit("boolean(float64[:, ::1], float64)", cache=True, nogil=True, error_model="numpy")
def is_sound(samples: Floats, least_motion_um: float) -> bool:
    """Whether there is nothing that `daqsvc.dsp.quality.probes.RevolutionJudge.judge` could find fault with.

    Args:
        samples: float64 ``[n, 3]``, n at least 1: two probes in micrometres, and the keyphasor; NaN where
            missing.
        least_motion_um: standard deviation that each probe must show at least.

    Returns:
        False if it has to be examined closely; that may still find nothing.
    """
    for value in samples.flat:
        if not abs(value) <= MOST_IN_ANY_UNIT:
            return False
    one, other = _sound_deviation(samples, 0), _sound_deviation(samples, 1)
    least = max(least_motion_um, DEAD * max(one, other)) * (1.0 + _ROUNDING)
    return one > least and other > least
