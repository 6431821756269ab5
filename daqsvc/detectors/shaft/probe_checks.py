"""The probes of a rotor bank, and signs that one does not see a turning shaft, whatever it shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.diagnosis.record import DataQuality

    Floats = NDArray[np.float64]

_CLIPPED = 1 / 16
"""Part of a revolution at one extreme value that makes a probe clipped."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether the last revolution can be trusted, and why not."""

    quality: DataQuality = "good"
    reason: str = ""


def stands_still(probes: Floats) -> bool:
    """Whether a probe repeats one value through a block, as none does that sees a turning shaft.

    Args:
        probes: float64 ``[n, 2]``.
    """
    return len(probes) > 2 and bool((probes == probes[0]).all(axis=0).any())


def clipped_at(signal: Floats) -> float | None:
    """The extreme value that a signal is clipped at, or None.

    Args:
        signal: float64 ``[n]``, a revolution without missing samples.

    A coarse converter repeats its values between the extremes as well, and a sine only twice as often at
    its top as elsewhere: a clipped signal repeats its extreme four times as often as any other value.
    """
    least = max(_CLIPPED * len(signal), 3.0)
    if all(np.count_nonzero(signal == extreme) < least for extreme in (signal.min(), signal.max())):
        return None
    values, counts = np.unique(signal, return_counts=True)
    usual = int(counts[1:-1].max(initial=0))
    least = max(least, 4.0 * usual)
    for extreme in (0, -1):
        if counts[extreme] >= least:
            return float(values[extreme])
    return None
