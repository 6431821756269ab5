"""The shaft's speed in a look at its bearings, by a keyphasor."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.dsp.keyphasor_edges import EdgeFinder

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.detectors.shaft.probe_checks import KeyphasorProbe

    Floats = NDArray[np.float64]

_LEAST_TURNS = 10
_PARTS = 5
_LIKE_THE_MEDIAN = 0.2
"""Times between edges that differ by more from their median are missing or second pulses."""
_MOST_ODD = 0.2


class SpeedError(ValueError):
    """The pulses of a look tell no speed; the message says why and what to do."""


class ShaftSpeed(NamedTuple):
    """Of a look.

    Attributes:
        rpm: mean.
        drift: how far the fifths of the look are apart, as a share of it.
    """

    rpm: float
    drift: float


def measure_speed(volts: Floats, keyphasor: KeyphasorProbe, rate_hz: float) -> ShaftSpeed:
    """Measure the speed of a shaft that turns about evenly.

    Args:
        volts: float64 ``[n]``, of the keyphasor; NaN where missing.
        keyphasor: its threshold.
        rate_hz: sampling rate.

    Raises:
        SpeedError: there are too few pulses, or too many that are not one a revolution.
    """
    edges = EdgeFinder(keyphasor.threshold_v, keyphasor.hysteresis_v, keyphasor.edge).find(volts)
    if len(edges) <= _LEAST_TURNS:
        raise SpeedError(
            f"{keyphasor.name} shows {len(edges)} pulses in {len(volts) / rate_hz:.3g} s; the shaft stands "
            "still, or the threshold is wrong"
        )
    turns = np.diff(np.array([index + fraction for index, fraction in edges]))
    usual = float(np.median(turns))
    sound = np.abs(turns / usual - 1.0) <= _LIKE_THE_MEDIAN
    if np.mean(~sound) > _MOST_ODD:
        raise SpeedError(
            f"{keyphasor.name}: {int(np.sum(~sound))} of {len(turns)} times between pulses are not a "
            "revolution; adjust its threshold or its hysteresis"
        )
    turns = turns[sound]
    fifths = [float(part.mean()) for part in np.array_split(turns, _PARTS)]
    mean = float(turns.mean())
    return ShaftSpeed(60.0 * rate_hz / mean, (max(fifths) - min(fifths)) / mean)
