"""Setpoints from a recording of the healthy machine."""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from sim_hw.demo.errors import DemoError
from sim_hw.demo.machines import Setpoints

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.recording.recording import Recording

WINDOW_S = 0.5
ALERT = 1.5
DANGER = 3.0
"""Limits over the loudest window of the healthy machine."""

MOST_RATIO = 1000


def setpoints(healthy: Recording, rate_hz: float) -> Setpoints:
    """Alert and danger limits of the RMS of each channel.

    The healthy recording is first brought to the rate of the one it is compared with: at a higher rate
    it would hold vibration that the other cannot.

    Args:
        healthy: recording of the healthy machine.
        rate_hz: rate of the recording to come.

    Raises:
        DemoError: the recording is shorter than one window, or a channel of it does not move.
    """
    # Imported here: it takes over a second, and only --baseline needs it.
    from scipy.signal import resample_poly  # noqa: PLC0415

    ratio = Fraction(rate_hz / healthy.rate_hz).limit_denominator(MOST_RATIO)
    found = Setpoints()
    for column, name in enumerate(healthy.names):
        samples: NDArray[np.float64] = healthy.samples[:, column]
        if np.ptp(samples) == 0.0:
            raise DemoError(
                f"baseline {healthy.source} does not move: every sample of {name} is {samples[0]:g}; "
                "give a recording of the running machine"
            )
        if ratio != 1:
            samples = resample_poly(samples - samples.mean(), ratio.numerator, ratio.denominator)
        size = round(WINDOW_S * rate_hz)
        count = len(samples) // size
        if not count:
            raise DemoError(
                f"baseline {healthy.source} lasts {len(samples) / rate_hz:.2f} s; give at least {WINDOW_S} s"
            )
        windows = samples[: count * size].reshape(count, size)
        loudest = float(windows.std(axis=1).max())
        found[name] = (ALERT * loudest, DANGER * loudest)
    return found
