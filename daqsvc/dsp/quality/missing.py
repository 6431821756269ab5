"""Samples that are missing: how many may be, what is still sure without them, and when a stream is silent.

How many may be missing depends on what the rest is used for, and on nothing else. The spectrum of an
accelerometer suffers from a hundredth (`ACCELEROMETER_SHARE`), levels are estimates from a twentieth on
(`MOST_MISSING`). A revolution is fitted with three quarters of its samples (`REVOLUTION_SHARE`), levels and
a whole recording are used with half of them. What watches a machine and what reads a recording have the
same limits.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from daqsvc.rounding import counted

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from daqsvc.dsp.levels import SignalLevels

    Floats: TypeAlias = NDArray[np.float64]

Bounds: TypeAlias = "Mapping[str, tuple[float, float]]"

ACCELEROMETER_SHARE = 0.01
"""Share of an accelerometer's samples that may be missing; single ones are bridged."""

REVOLUTION_SHARE = 0.25
"""Share of a revolution's samples that may be missing."""

OBSERVED_SHARE = 0.5
"""Share of a revolution's samples that observers, which predict from sample to sample, may do without."""

RECORDING_SHARE = 0.5
"""Share of a recording's samples, or of its revolutions, that may be missing or unusable."""

MIN_PRESENT = 0.5
"""Share of a window's samples that must be there for its levels to be given."""

MOST_MISSING = 0.05
"""Share of a window's samples that may be missing without anything being held for it."""

MOST_ERROR = 0.05
"""A velocity whose standard deviation by the gaps is a larger part of it is held, however few are missing."""

LEAST_KNOWN_ERROR = 0.5
"""A velocity is not given at all if that is more than this part of it."""

_NS_PER_S = 10**9

BRIDGED = 2
"""Values in a row that may be missing: until then the last one holds. A lost poll is no lost sensor."""

SILENCE_NS = 2 * _NS_PER_S
"""A stream from which nothing has come for so long is silent, ..."""

SILENT_PERIODS = BRIDGED + 1.5
"""... but not before so many of its sampling periods: a value that is polled once a minute is no silence."""

UNKNOWN_NS = 60 * _NS_PER_S
"""How often a device takes snapshots that are not declared as such, until it has been seen."""

_REMEMBERED = 8


@dataclass(slots=True)
class EdgeCounts:
    """What became of the pulses of a keyphasor since the start.

    Attributes:
        accepted: edges that marked a revolution.
        missing: revolutions without an edge, found out at the next one.
        rejected: edges that came where none can be: second pulses, noise.
    """

    accepted: int = 0
    missing: int = 0
    rejected: int = 0


def lacking(name: str, signal: Floats, effect: str = "") -> str:
    """Why an accelerometer, or the keyphasor beside it, cannot be used for the samples that it lacks.

    Args:
        name: of the sensor.
        signal: float64 ``[n]``, NaN where missing.
        effect: what that entails, to be stated with it.

    Returns:
        Empty if no more than `ACCELEROMETER_SHARE` of them are missing.
    """
    missing = int(np.isnan(signal).sum())
    if missing <= ACCELEROMETER_SHARE * len(signal):
        return ""
    return f"{name}: {missing} of {len(signal)} samples are missing{effect}; check the bus and the device"


def level_bounds(
    measured: SignalLevels, lowest: float, highest: float, share: float
) -> dict[str, tuple[float, float]]:
    """Between what the levels of a window surely lie; empty while so few samples are missing that they count.

    Whatever is missing, it cannot have taken anything from the sum of squares, nor made the range of the
    values smaller: RMS and peak have a lower bound. A crest factor has none, for a missing peak and a missing
    quiet time change it in opposite directions. Of the mean it is taken that what is missing lies between
    what was seen.

    Args:
        measured: levels of the samples that are there.
        lowest: the lowest of these.
        highest: the highest of these.
        share: of the window's samples, how many are missing.
    """
    if share <= MOST_MISSING:
        return {}
    off = share * (highest - lowest)
    return {
        "mean": (measured.mean - off, measured.mean + off),
        "rms": (measured.rms * math.sqrt(1.0 - share), math.inf),
        "peak": (0.5 * (highest - lowest), math.inf),
        "peak_to_peak": (highest - lowest, math.inf),
        "crest_factor": (0.0, math.inf),
    }


def nothing_known(measures: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Bounds of measures of which nothing is known."""
    return dict.fromkeys(measures, (-math.inf, math.inf))


def not_judged(sensor: str, samples: int) -> str:
    """Why measures of a sensor are held that were there and not examined, in words for a person."""
    many = f"{counted(samples, 'sample')} of {sensor} {'was' if samples == 1 else 'were'} not judged"
    return f"{many}: this computer was too slow, or the bus lost {'it' if samples == 1 else 'them'}"


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


class Patience:
    """How long a stream may be silent, by how often something comes of it.

    Args:
        period_ns: time between its samples; 0 for a fast stream.
        snapshots: whether it comes in snapshots.
        every_ns: how often one is asked for; None if the device takes them by itself: that is seen then.
    """

    def __init__(
        self, period_ns: float = 0.0, *, snapshots: bool = False, every_ns: int | None = None
    ) -> None:
        self._period_ns = period_ns
        self._snapshots = snapshots
        self._every_ns = every_ns
        self._seen_ns: deque[int] = deque(maxlen=_REMEMBERED)

    @property
    def ns(self) -> int:
        """After so long with nothing the stream is silent."""
        period_ns = self._period_ns
        if self._snapshots:
            stated_ns = [] if self._every_ns is None else [self._every_ns]
            period_ns = max([*stated_ns, *self._seen_ns], default=UNKNOWN_NS)
        return max(SILENCE_NS, round(SILENT_PERIODS * period_ns))

    def heard_after(self, duration_ns: int) -> None:
        """Something has come, so long after the last that came (at first: after the start)."""
        self._seen_ns.append(duration_ns)
