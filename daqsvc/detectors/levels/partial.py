"""What a window that lacks samples still says for sure: how far its measures may be from the whole one's."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from daqsvc.dsp.levels import SignalLevels

Bounds: TypeAlias = "Mapping[str, tuple[float, float]]"

MIN_PRESENT = 0.5
"""Share of a window's samples that must be there for its levels to be given."""

MOST_MISSING = 0.05
"""Share of a window's samples that may be missing without anything being held for it."""

MOST_ERROR = 0.05
"""A velocity whose standard deviation by the gaps is a larger part of it is held, however few are missing."""

LEAST_KNOWN_ERROR = 0.5
"""A velocity is not given at all if that is more than this part of it."""


def level_bounds(
    found: SignalLevels, lowest: float, highest: float, share: float
) -> dict[str, tuple[float, float]]:
    """Between what the levels of a window surely lie; empty while so few samples are missing that they count.

    Whatever is missing, it cannot have taken anything from the sum of squares, nor made the range of the
    values smaller: RMS and peak have a lower bound. A crest factor has none, for a missing peak and a missing
    quiet time change it in opposite directions. Of the mean it is taken that what is missing lies between
    what was seen.

    Args:
        found: levels of the samples that are there.
        lowest: the lowest of these.
        highest: the highest of these.
        share: of the window's samples, how many are missing.
    """
    if share <= MOST_MISSING:
        return {}
    off = share * (highest - lowest)
    return {
        "mean": (found.mean - off, found.mean + off),
        "rms": (found.rms * math.sqrt(1.0 - share), math.inf),
        "peak": (0.5 * (highest - lowest), math.inf),
        "peak_to_peak": (highest - lowest, math.inf),
        "crest_factor": (0.0, math.inf),
    }


def nothing_known(measures: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Bounds of measures of which nothing is known."""
    return dict.fromkeys(measures, (-math.inf, math.inf))


def not_judged(sensor: str, samples: int) -> str:
    """Why measures of a sensor are held that were there and not looked at, in words for a person."""
    return f"{samples} samples of {sensor} were not judged: this computer was too slow, or they were lost"


def partly_missing(sensor: str, missing: int, count: int, held: Bounds) -> str:
    """Why measures of a sensor are held that could be given, in words for a person.

    Args:
        sensor: its name.
        missing: how many samples of the window are missing.
        count: how many it has.
        held: bounds of the measures that are held; empty if none is.
    """
    if not held:
        return ""
    estimates = "its levels are estimates" if len(held) > 1 else f"{next(iter(held))} is an estimate"
    return (
        f"{missing} of {count} samples of {sensor} are missing: {estimates}, which may raise an alarm but "
        "return none; check bus, device and sensor"
    )
