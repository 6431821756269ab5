"""Samples that no verdict must rest on: recognised before the test, put right or named with a remedy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.race.repair import repaired
from daqsvc.bearing.race.stuck import stuck
from daqsvc.bearing.race.transients import blanked, merged, runs
from daqsvc.dsp.quality import UnfitError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.bearing.race.rules import RaceRules
    from daqsvc.bearing.race.transients import Stretch

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
OFFSET_NOTE = "the channel has an offset"
GAP_TAPER_S = 2e-3
"""A channel that breaks off makes noise of its own: it fades out before, and in behind."""
BRIDGED = 4
"""A longer bridge over missing samples leaves a hole in the envelope, which says nothing of the machine."""
LEAST_REVOLUTIONS = 25.0
LEAST_BAND = 3.0
"""Top of the analysed band over its bottom, at least."""


@dataclass(frozen=True, slots=True)
class CheckedSamples:
    """Samples fit for the test.

    Attributes:
        values: ``[n]``, without mean and without what was wrong with them.
        notes: what is odd about them without spoiling the test.
        repairs: what was put right.
        stretches: where nothing of the machine is left, by sample.
    """

    values: Real
    notes: tuple[str, ...]
    repairs: tuple[str, ...]
    stretches: tuple[Stretch, ...]


def checked(samples: Real, rate_hz: float, speed_rpm: float, rules: RaceRules) -> CheckedSamples:
    """The samples as float64, fit for the test.

    Args:
        samples: ``[n]``, any unit proportional to acceleration.
        rate_hz: their sample rate.
        speed_rpm: stated speed of the shaft.
        rules: the rules of the test.

    Raises:
        UnfitError: no verdict can rest on these samples.
    """
    x = np.asarray(samples, dtype=np.float64)
    if x.ndim != 1:
        raise UnfitError("samples", f"have shape {list(x.shape)}", "give one channel, [n]")
    if not (np.isfinite(rate_hz) and rate_hz > 0.0):
        raise UnfitError("sample rate", f"is {rate_hz} Hz", "give the rate of the recording")
    if not (np.isfinite(speed_rpm) and speed_rpm > 0.0):
        raise UnfitError(
            "shaft speed", f"is {speed_rpm} rpm", "give the speed: kinematic lines lie at multiples of it"
        )
    top_hz = min(0.48 * rate_hz, rules.high_hz)
    if top_hz < LEAST_BAND * rules.low_hz:
        raise UnfitError(
            "sample rate",
            f"is {rate_hz:g} Hz, which leaves the band {rules.low_hz:g} to {top_hz:g} Hz",
            f"sample with {LEAST_BAND * rules.low_hz / 0.48:.0f} Hz or more",
        )
    revolutions = len(x) / rate_hz * speed_rpm / 60.0
    if revolutions < LEAST_REVOLUTIONS:
        raise UnfitError(
            "record",
            f"is too short: {len(x) / rate_hz:.3g} s are {revolutions:.3g} revolutions",
            f"give {LEAST_REVOLUTIONS:g} revolutions or more, better 75",
        )
    x, gaps, notes, repairs = _bridged(x, rate_hz)
    mended = repaired(x, rate_hz, round(60.0 * rate_hz / speed_rpm), (rules.low_hz, top_hz))
    x = mended.values
    clipped = _clipped_share(x)
    if clipped > CLIPPED_SHARE:
        raise UnfitError(
            "channel",
            f"is clipped: {clipped:.1%} of its samples stand at {x.min():.4g} or {x.max():.4g}",
            "use a sensor or a gain with a larger range",
        )
    if clipped > CLIPPED_NOTE_SHARE:
        notes.append(f"{clipped:.2%} of the samples are clipped: sizes are too small")
    offset, deviation = float(x.mean()), float(x.std())
    if abs(offset) > OFFSET_DEVIATIONS * deviation:
        notes.append(f"{OFFSET_NOTE} of {offset:.4g}, {abs(offset) / deviation:.0f} times what it measures")
    return CheckedSamples(
        x - offset,
        tuple(notes),
        (*repairs, *mended.repairs),
        (*gaps, *mended.stretches),
    )


def _bridged(x: Real, rate_hz: float) -> tuple[Real, list[Stretch], list[str], list[str]]:
    """The channel with straight lines over what is missing, where they are long, notes, and repairs."""
    good = np.isfinite(x)
    missing = 1.0 - float(good.mean())
    if missing > MISSING_SHARE:
        raise UnfitError(
            "channel", f"lacks {missing:.1%} of its samples (NaN or infinite)", "check sensor and cable"
        )
    if missing:
        x = _interpolated(x, good)
    steady = float(np.mean(np.diff(x) == 0.0))
    if steady > DEAD_SHARE:
        raise UnfitError(
            "channel", f"is dead: {steady:.0%} of its samples repeat the one before", "check sensor and cable"
        )
    held = stuck(x) & good
    if not missing and not held.any():
        return x, [], [], []
    lost = ~good | held
    told = []
    if held.any():
        dropped = runs(np.flatnonzero(held), 1)
        first_s = dropped[0][0] / rate_hz
        what = f"{len(dropped)} times ({held.mean():.1%} of its samples), first at {first_s:.4g} s"
        if lost.mean() > MISSING_SHARE:
            raise UnfitError("channel", f"stands still {what}", "check what drops its samples out")
        told.append(f"the channel stands still {what}: bridged; check what drops its samples out")
        x = _interpolated(x, ~held)
    long = [(first, last) for first, last in runs(np.flatnonzero(lost), 1) if last - first > BRIDGED]
    taper = round(GAP_TAPER_S * rate_hz)
    long = merged((max(first - taper, 0), min(last + taper, len(x))) for first, last in long)
    x = blanked(x, long, rate_hz)
    notes = (
        [f"{int((~good).sum())} samples are missing: bridged; check the bus and the device"]
        if missing
        else []
    )
    return x, long, notes, told


def _interpolated(x: Real, good: NDArray[np.bool_]) -> Real:
    """Straight lines over what is not good."""
    place = np.arange(len(x))
    return np.interp(place, place[good], x[good])


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
