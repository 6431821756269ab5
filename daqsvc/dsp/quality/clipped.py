"""Whether a signal's peaks are cut off by the range of its sensor or converter.

A coarse converter repeats its values between the extremes as well, and a sine only twice as often at its
top as elsewhere. A clipped signal repeats its extreme four times as often as any other value
(`ends_cut_off`). What differs is how much of it spoils the result. A revolution has its peaks in a
sixteenth of its samples at least, an accelerometer's spectrum tolerates a hundredth, and of a whole
recording of probes a few samples are worth a remark.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.dsp.quality import UnfitError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

CLIPPED_SHARE = 0.01
"""Part of an accelerometer's samples at the ends of its range from which on it cannot be judged."""
CLIPPED_NOTE_SHARE = 1e-4
"""Part of them from which on it is reported."""
CLIPPED_REVOLUTION = 1 / 16
"""Part of a revolution at one extreme value that makes a probe clipped."""
LEAST_CUT_OFF = 8
"""How often a recording must reach its extreme value."""
LEAST_IN_REVOLUTION = 3.0
_USUAL = 4
"""An extreme value is a limit if it comes so many times as often as any other."""
_LEAST_PILED_UP = 3
_NEAR_LIMIT = 0.025
_PILED_UP = 1.5
"""Samples at the extreme value over those within 2.5 % of the range of it, beyond which it is a limit."""


class ClippedError(UnfitError):
    """A signal is clipped.

    Args:
        thing: what is clipped.
        value: what was found.
        remedy: what to do about it.
        samples: how many samples are at the ends.
    """

    def __init__(self, thing: str, value: str, remedy: str, samples: int) -> None:
        super().__init__(thing, value, remedy)
        self.samples = samples


def ends_cut_off(signal: Floats, least: float) -> dict[float, int]:
    """The extreme values that a signal is cut off at, and how many samples are there: lowest first.

    Args:
        signal: float64 ``[n]``; NaN where missing.
        least: samples that must be at one; four times those at any other value are needed besides.

    Returns:
        Empty of a signal that is not clipped, or does not move.
    """
    values, counts = np.unique(signal[np.isfinite(signal)], return_counts=True)
    if len(values) < 2:
        return {}
    least = max(least, _USUAL * int(counts[1:-1].max(initial=0)))
    return {float(values[end]): int(counts[end]) for end in (0, -1) if counts[end] >= least}


def clipped_at(signal: Floats) -> float | None:
    """The extreme value that a revolution is clipped at, or None.

    Args:
        signal: float64 ``[n]``, without missing samples.
    """
    least = max(CLIPPED_REVOLUTION * len(signal), LEAST_IN_REVOLUTION)
    # Sorting costs more than this evaluation, which leaves nothing to sort in nearly every revolution.
    if all(np.count_nonzero(signal == extreme) < least for extreme in (signal.min(), signal.max())):
        return None
    return next(iter(ends_cut_off(signal, least)), None)


def never_clipped(signals: Floats) -> bool:
    """Whether signals come so rarely to their extremes that `clipped_at` finds none clipped.

    Args:
        signals: float64 ``[n, m]``, finite.
    """
    least = max(CLIPPED_REVOLUTION * len(signals), LEAST_IN_REVOLUTION)
    ends = (signals.min(axis=0), signals.max(axis=0))
    return bool(max(np.count_nonzero(signals == end) for end in ends) < least)


def refuse_clipped(signal: Floats) -> None:
    """Refuse an accelerometer whose peaks all end at one value.

    Args:
        signal: float64 ``[n]``; NaN where missing.

    Raises:
        ClippedError: it is clipped.
    """
    ends = ends_cut_off(signal, max(LEAST_CUT_OFF, CLIPPED_SHARE * len(signal)))
    if ends:
        at = " and ".join(f"{value:.6g}" for value in ends)
        raise ClippedError(
            "channel",
            f"is clipped: {sum(ends.values())} of {len(signal)} samples are at {at}",
            "use a sensor or a gain with a larger range",
            sum(ends.values()),
        )


def clipped_share(signal: Floats) -> float:
    """Share of samples that are at a limit: more of them than just short of it.

    It finds fewer clipped samples than `refuse_clipped` needs, where the converter is fine. So it is asked
    after that, of a channel that was put right.

    Args:
        signal: float64 ``[n]``, none missing.
    """
    low, high = float(signal.min()), float(signal.max())
    short = _NEAR_LIMIT * (high - low)
    clipped = 0
    for at, near in ((signal == low, signal < low + short), (signal == high, signal > high - short)):
        count = int(np.count_nonzero(at))
        if count >= _LEAST_PILED_UP and count > _PILED_UP * (np.count_nonzero(near) - count):
            clipped += count
    return clipped / len(signal)
