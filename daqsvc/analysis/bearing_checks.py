"""What is wrong with the samples of accelerometers that a person should know, whatever the verdict."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.analysis.acceleration import M_S2_PER_UNIT
from daqsvc.analysis.quality import count_bad
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.quality.accelerometers import OFFSET_NOTE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.analysis.acceleration import AccelerationUnit
    from daqsvc.analysis.quality import DataQuality
    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.race.verdict import RaceVerdict

    Floats = NDArray[np.float64]

_LEAST_M_S2 = 1e-4
_MOST_M_S2 = 10_000.0
"""No accelerometer on a housing shows less than its own noise, or more r.m.s. than destroys it."""
_LEAST_MACHINE_M_S2 = 1e-3
"""A tenth of a milli-g: what a good accelerometer shows by itself where nothing turns."""
_TWICE_TOLERANCE = 0.1


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


def refuse_no_machine(samples: Floats, unit: AccelerationUnit, race: RaceVerdict) -> None:
    """Refuse a channel that shows no machine at all, as of a sensor that is unplugged.

    Args:
        samples: ``[n]``, as they were recorded.
        unit: that they are said to be in.
        race: what the race test says of them.

    Raises:
        UnfitError: they are quieter than any machine, and no harmonics of a shaft stand out.
    """
    rms = float(np.nanstd(samples))
    quiet = rms * M_S2_PER_UNIT.get(unit, float("nan")) < _LEAST_MACHINE_M_S2
    if quiet and not race.speed_seen and race.verdict == "normal":
        raise UnfitError(
            "channel",
            f"shows no machine: {rms:.3g} {unit} r.m.s. and no speed that its harmonics confirm",
            "check sensor, cable and --unit",
        )


def ball_order_problem(orders: BearingOrders) -> str:
    """What is odd about a stated BSF; empty if nothing: BPFI and BPFO alone determine it.

    Their sum is the number of balls, their difference over it the ratio of ball to pitch diameter, times the
    cosine of the contact angle, which makes BSF smaller by itself; so only about twice the value is told.

    Args:
        orders: as stated.
    """
    balls = max(round(orders.inner + orders.outer), 1)
    ratio = (orders.inner - orders.outer) / balls
    expected = (1.0 - ratio**2) / (2.0 * ratio)
    if abs(orders.ball / (2.0 * expected) - 1.0) > _TWICE_TOLERANCE:
        return ""
    return (
        f"BSF {orders.ball:g} is twice what BPFI {orders.inner:g} and BPFO {orders.outer:g} make it "
        f"({expected:.3f}): some data sheets state 2 BSF; give half of it"
    )


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
