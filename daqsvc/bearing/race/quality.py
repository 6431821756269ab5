"""Samples that no verdict must rest on: recognised before the test, named with a remedy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.race.verdict import RaceInputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.bearing.race.rules import RaceRules

    Real = NDArray[np.float64]

MISSING_SHARE = 0.01
CLIPPED_SHARE = 0.01
CLIPPED_NOTE_SHARE = 1e-4
LEAST_CLIPPED = 3
NEAR_LIMIT = 0.025
PILED_UP = 1.5
"""Samples at the extreme value over those within 2.5 % of the range of it, beyond which it is a limit."""
DEAD_SHARE = 0.5
OFFSET_DEVIATIONS = 5.0
SHIFT_DEVIATIONS = 1.0
LEAST_REVOLUTIONS = 25.0
LEAST_BAND = 3.0
"""Top of the analysed band over its bottom, at least."""


@dataclass(frozen=True, slots=True)
class CheckedSamples:
    """Samples fit for the test.

    Attributes:
        values: ``[n]``, without mean; single missing samples lie on their neighbours' line.
        notes: what is odd about them without spoiling the test.
    """

    values: Real
    notes: tuple[str, ...]


def checked(samples: Real, rate_hz: float, speed_rpm: float, rules: RaceRules) -> CheckedSamples:
    """The samples as float64, fit for the test.

    Args:
        samples: ``[n]``, any unit proportional to acceleration.
        rate_hz: their sample rate.
        speed_rpm: stated speed of the shaft.
        rules: the rules of the test.

    Raises:
        RaceInputError: no verdict can rest on these samples.
    """
    x = np.asarray(samples, dtype=np.float64)
    if x.ndim != 1:
        raise RaceInputError("samples", f"have shape {list(x.shape)}", "give one channel, [n]")
    if not (np.isfinite(rate_hz) and rate_hz > 0.0):
        raise RaceInputError("sample rate", f"is {rate_hz} Hz", "give the rate of the recording")
    if not (np.isfinite(speed_rpm) and speed_rpm > 0.0):
        raise RaceInputError(
            "shaft speed", f"is {speed_rpm} rpm", "give the speed: kinematic lines lie at multiples of it"
        )
    top_hz = min(0.48 * rate_hz, rules.high_hz)
    if top_hz < LEAST_BAND * rules.low_hz:
        raise RaceInputError(
            "sample rate",
            f"is {rate_hz:g} Hz, which leaves the band {rules.low_hz:g} to {top_hz:g} Hz",
            f"sample with {LEAST_BAND * rules.low_hz / 0.48:.0f} Hz or more",
        )
    revolutions = len(x) / rate_hz * speed_rpm / 60.0
    if revolutions < LEAST_REVOLUTIONS:
        raise RaceInputError(
            "record",
            f"is too short: {len(x) / rate_hz:.3g} s are {revolutions:.3g} revolutions",
            f"give {LEAST_REVOLUTIONS:g} revolutions or more, better 75",
        )
    x = _clean(x)
    mean, deviation = float(x.mean()), float(x.std())
    thirds = [float(part.mean()) for part in np.array_split(x, 3)]
    notes = []
    clipped = _clipped_share(x)
    if clipped > CLIPPED_NOTE_SHARE:
        notes.append(f"{clipped:.2%} of the samples are clipped: sizes are too small")
    if max(thirds) - min(thirds) > SHIFT_DEVIATIONS * deviation:
        notes.append(
            f"the channel's mean moves from {thirds[0]:.4g} to {thirds[2]:.4g}: check the sensor's supply"
        )
    elif abs(mean) > OFFSET_DEVIATIONS * deviation:
        notes.append(
            f"the channel has an offset of {mean:.4g}, {abs(mean) / deviation:.0f} times what it measures"
        )
    return CheckedSamples(x - mean, tuple(notes))


def _clean(x: Real) -> Real:
    """Fill single missing samples; refuse what is dead or clipped."""
    good = np.isfinite(x)
    missing = 1.0 - float(good.mean())
    if missing > MISSING_SHARE:
        raise RaceInputError(
            "channel", f"lacks {missing:.1%} of its samples (NaN or infinite)", "check sensor and cable"
        )
    if missing:
        place = np.arange(len(x))
        x = np.interp(place, place[good], x[good])
    steady = float(np.mean(np.diff(x) == 0.0))
    if steady > DEAD_SHARE:
        raise RaceInputError(
            "channel", f"is dead: {steady:.0%} of its samples repeat the one before", "check sensor and cable"
        )
    clipped = _clipped_share(x)
    if clipped > CLIPPED_SHARE:
        raise RaceInputError(
            "channel",
            f"is clipped: {clipped:.1%} of its samples stand at {x.min():.4g} or {x.max():.4g}",
            "use a sensor or a gain with a larger range",
        )
    return x


def _clipped_share(x: Real) -> float:
    """Share of samples that stand at a limit: more of them than just short of it."""
    low, high = float(x.min()), float(x.max())
    short = NEAR_LIMIT * (high - low)
    clipped = 0
    for at, near in ((x == low, x < low + short), (x == high, x > high - short)):
        count = int(np.count_nonzero(at))
        if count >= LEAST_CLIPPED and count > PILED_UP * (np.count_nonzero(near) - count):
            clipped += count
    return clipped / len(x)
