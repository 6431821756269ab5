"""Whether an accelerometer's peaks are cut off by the range of its converter."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

CLIPPED_SHARE = 0.01
"""Part of the samples at the ends of the range from which on a signal cannot be judged."""
_LEAST = 8
_USUAL = 4
"""A coarse converter repeats its values between the ends as well, but those at the ends least often."""


class ClippedError(ValueError):
    """A signal is clipped.

    Attributes:
        samples: how many samples stand at the ends.
    """

    def __init__(self, message: str, samples: int) -> None:
        super().__init__(message)
        self.samples = samples


def refuse_clipped(signal: Floats) -> None:
    """Refuse a signal whose peaks all end at one value.

    Args:
        signal: float64 ``[n]``; NaN where missing.

    Raises:
        ClippedError: it is clipped.
    """
    values, counts = np.unique(signal[np.isfinite(signal)], return_counts=True)
    if len(values) < 2:
        return  # dead, which the race test says
    least = max(_LEAST, _USUAL * int(counts[1:-1].max(initial=0)), CLIPPED_SHARE * len(signal))
    ends = {float(values[end]): int(counts[end]) for end in (0, -1) if counts[end] >= least}
    if ends:
        at = " and ".join(f"{value:.6g}" for value in ends)
        raise ClippedError(
            f"channel is clipped: {sum(ends.values())} of {len(signal)} samples are at {at}; use a sensor or "
            "a gain with a larger range",
            sum(ends.values()),
        )
