"""What is wrong with the samples of accelerometers that a person should know, whatever the verdict."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.analysis.acceleration import M_S2_PER_UNIT
from daqsvc.analysis.quality import count_bad
from daqsvc.bearing.race.quality import OFFSET_NOTE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.analysis.acceleration import AccelerationUnit
    from daqsvc.analysis.quality import DataQuality
    from daqsvc.bearing.race.verdict import RaceVerdict

    Floats = NDArray[np.float64]

_LEAST_M_S2 = 1e-4
_MOST_M_S2 = 10_000.0
"""No accelerometer on a housing shows less than its own noise, or more r.m.s. than destroys it."""


def accelerometer_quality(names: Sequence[str], samples: Floats, unit: AccelerationUnit) -> DataQuality:
    """Count what is missing, and tell of sizes that no acceleration has; the race test tells of offsets.

    Args:
        names: of the channels.
        samples: float64 ``[n, channels]`` as they were recorded.
        unit: that they are said to be in.
    """
    quality = count_bad(names, samples)
    for name, column in zip(names, samples.T, strict=True):
        signal = column[np.isfinite(column)]
        if not len(signal):
            continue
        rms = float(signal.std())
        if np.ptp(signal) == 0.0:
            continue  # dead: the race test says so; the rounding of its mean is no vibration
        m_s2 = rms * M_S2_PER_UNIT.get(unit, float("nan"))
        if m_s2 < _LEAST_M_S2 or m_s2 > _MOST_M_S2:
            quality = quality.with_problem(
                f"{name}: vibrates with {rms:.3g} {unit} r.m.s., which no housing does: the unit looks "
                "wrong; correct --unit (g, m/s2 or V)"
            )
    return quality


def with_repairs(quality: DataQuality, races: Mapping[str, RaceVerdict]) -> DataQuality:
    """The same with what the race test found wrong with the samples and put right.

    Args:
        quality: what is known so far.
        races: what each channel shows, of those that could be judged.
    """
    for name, race in races.items():
        for repair in race.repairs:
            quality = quality.with_problem(f"{name}: {repair}")
    return with_offsets(quality, races)


def with_offsets(quality: DataQuality, races: Mapping[str, RaceVerdict]) -> DataQuality:
    """The same with the offsets that the race test met.

    Args:
        quality: what is known so far.
        races: what each channel shows, of those that could be judged.
    """
    for name, race in races.items():
        for note in race.notes:
            if note.startswith(OFFSET_NOTE):
                quality = quality.with_problem(f"{name}: {note}; check the sensor's supply")
    return quality
