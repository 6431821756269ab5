"""Does a shaft turn evenly: its mean speed and drift by pulses, and whether it runs up or coasts down."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.dsp.speed.keyphasor import EdgeFinder

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.dsp.speed.keyphasor import KeyphasorProbe

    Floats = NDArray[np.float64]

_LEAST_TURNS = 10
_PARTS = 5
_LIKE_THE_MEDIAN = 0.2
"""Times between edges that differ by more from their median are missing or second pulses."""
_MOST_ODD = 0.2


class SpeedError(ValueError):
    """The pulses of an evaluation show no speed; the message states why and what to do."""


class ShaftSpeed(NamedTuple):
    """Of an evaluation.

    Attributes:
        rpm: mean.
        drift: how far the fifths of the evaluation are apart, as a share of it.
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


RUN_UP = 0.05
"""Part of the speed by which it may move: a baseline holds no farther."""

_STAGES = 5
_LOOKS = 4
"""Spectra in a stage of a long recording; in a short one it is one."""
_LONG = 512
"""Samples of each of these spectra from which on it is long."""
_EVEN = 0.02
"""Part of the whole trend that every stage must have, so that a step or a scatter is none."""
_AVERAGED = 8
"""Pulses that a period is averaged over: a second pulse or a tooth does not make a trend."""
_LEAST_SAMPLES = 64
_PADDING = 4


class Trend(NamedTuple):
    """Speed at the beginning and at the end, rpm."""

    from_rpm: float
    to_rpm: float

    def describe(self) -> str:
        """What it does."""
        goes = "rises" if self.to_rpm > self.from_rpm else "falls"
        return f"the speed {goes} from {self.from_rpm:.0f} to {self.to_rpm:.0f} rpm"


def trend_of_pulses(places: Floats, rate_hz: float) -> Trend | None:
    """The trend of a keyphasor; None if the speed is steady within `RUN_UP`, or no trend.

    Args:
        places: float64, where its pulses are, in samples.
        rate_hz: sampling rate.
    """
    if len(places) < 2 * _STAGES + _AVERAGED:
        return None
    periods = (places[_AVERAGED:] - places[:-_AVERAGED]) / _AVERAGED
    first, last = (float(np.median(np.diff(end))) for end in (places[:4], places[-4:]))
    return _trend(60.0 * rate_hz / periods, 60.0 * rate_hz / first, 60.0 * rate_hz / last)


def trend_of_orbit(samples: Floats, rate_hz: float) -> Trend | None:
    """The same by the strongest line of an orbit.

    Args:
        samples: float64 ``[n, 2]``, two probes, NaN where missing.
        rate_hz: sampling rate.
    """
    z = samples[:, 0] + 1j * samples[:, 1]
    if len(z) < _STAGES * _LEAST_SAMPLES:
        return None
    looks = _STAGES * (_LOOKS if len(z) >= _STAGES * _LOOKS * _LONG else 1)
    speeds_rpm = np.array([_strongest(part, rate_hz) for part in np.array_split(z, looks)])
    return _trend(speeds_rpm, float(speeds_rpm[0]), float(speeds_rpm[-1]))


def _trend(speeds_rpm: Floats, first_rpm: float, last_rpm: float) -> Trend | None:
    stages = [float(np.median(part)) for part in np.array_split(speeds_rpm, _STAGES)]
    logs = np.log(np.maximum(stages, 1e-9))
    whole = float(logs[-1] - logs[0])
    if abs(whole) < math.log1p(RUN_UP) or (np.diff(logs) / whole < _EVEN).any():
        return None
    # An end that lies within the trend is chance: the median of its stage is farther out then.
    outer, inner = (min, max) if whole > 0.0 else (max, min)
    return Trend(outer(stages[0], first_rpm), inner(stages[-1], last_rpm))


def _strongest(z: NDArray[np.complex128], rate_hz: float) -> float:
    """Where the most power of both senses is, in rpm."""
    there = np.isfinite(z)
    if not there.any():
        return 0.0
    still = np.where(there, z - z[there].mean(), 0.0) * np.hanning(len(z))
    size = _PADDING * 2 ** math.ceil(math.log2(len(z)))
    power = np.abs(np.fft.fft(still, size)) ** 2
    bins = np.arange(_PADDING, size // 2)
    strongest: int = bins[np.argmax(power[bins] + power[-bins])].item()
    return 60.0 * rate_hz * strongest / float(size)
