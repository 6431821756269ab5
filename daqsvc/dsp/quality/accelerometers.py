"""Whether the channel of an accelerometer is fit for the tests of a bearing; put right where that is honest.

Missing samples and drop-outs are bridged, wrong samples and steps taken out, transients faded out, a
wandering mean followed. Each repair is reported, with its place. A channel without defects stays as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft
from scipy.ndimage import median_filter

from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.quality.clipped import CLIPPED_NOTE_SHARE, CLIPPED_SHARE, clipped_share
from daqsvc.dsp.quality.missing import ACCELEROMETER_SHARE
from daqsvc.dsp.quality.outliers import Prewhitening, blanked, despiked, find_transients, merged, runs
from daqsvc.dsp.quality.stuck import DEAD_SHARE, coarse_step, dropouts
from daqsvc.dsp.quality.unit import refuse_beyond_any_unit, refuse_still
from daqsvc.dsp.quality.upsampled import SHARE_OF_RATE, even_pace, upsampling
from daqsvc.rounding import counted, counted_are, rounded_up

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.dsp.quality.outliers import Stretch
    from daqsvc.dsp.quality.upsampled import Upsampling

    Real = NDArray[np.float64]

OFFSET_DEVIATIONS = 5.0
OFFSET_NOTE = "the channel has an offset"
GAP_TAPER_S = 2e-3
"""A channel that breaks off makes noise of its own: it fades out before, and in behind."""
BRIDGED = 4
"""A longer bridge over missing samples leaves a hole in the envelope, which shows nothing of the machine."""
LEAST_REVOLUTIONS = 25.0
LEAST_BAND = 3.0
"""Top of the analysed band over its bottom, at least."""
COARSE_NOTE = 0.5
"""Step of a converter over what the channel vibrates with (r.m.s.), from which on it is noted."""
COARSE_RESTS = 0.9
"""Share of samples that repeat the one before, from which on a coarse converter is no reason for it."""
COARSE_LOUD = 4.0
"""Steps of a coarse converter that a channel which often rests is away from its middle, now and then ..."""
COARSE_OFTEN = 0.999
"""... beyond this quantile, at least: a dead input flutters by a step or two."""


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


def checked(samples: Real, rate_hz: float, speed_rpm: float, band_hz: tuple[float, float]) -> CheckedSamples:
    """The samples as float64, fit for the test.

    Args:
        samples: ``[n]``, any unit proportional to acceleration.
        rate_hz: their sample rate.
        speed_rpm: stated speed of the shaft.
        band_hz: where the band of the test begins, and where it ends if the rate allows.

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
    low_hz, top_hz = band_hz[0], min(SHARE_OF_RATE * rate_hz, band_hz[1])
    if top_hz < LEAST_BAND * low_hz:
        raise UnfitError(
            "sample rate",
            f"is {rate_hz:g} Hz, which leaves the band {low_hz:g} to {top_hz:g} Hz",
            f"sample with {rounded_up(LEAST_BAND * low_hz / SHARE_OF_RATE, 4)} Hz or more",
        )
    revolutions = len(x) / rate_hz * speed_rpm / 60.0
    if revolutions < LEAST_REVOLUTIONS:
        raise UnfitError(
            "record",
            f"is too short: {len(x) / rate_hz:.3g} s are {revolutions:.3g} revolutions",
            f"give {LEAST_REVOLUTIONS:g} revolutions or more, better 75",
        )
    refuse_beyond_any_unit(x)
    x, gaps, notes, repairs, stored = _bridged(x, rate_hz, low_hz)
    refuse_still(x)
    # Between the samples that were measured nothing can be wrong by itself.
    measured_hz = rate_hz if stored is None else rate_hz / stored.factor
    band_hz = low_hz, min(top_hz, SHARE_OF_RATE * measured_hz)
    mended = repaired(x, measured_hz, round(60.0 * measured_hz / speed_rpm), band_hz)
    x = mended.values
    clipped = clipped_share(x)
    if clipped > CLIPPED_SHARE:
        raise UnfitError(
            "channel",
            f"is clipped: {clipped:.1%} of its samples are at {x.min():.4g} or {x.max():.4g}",
            "use a sensor or a gain with a larger range",
        )
    if clipped > CLIPPED_NOTE_SHARE:
        notes.append(f"{clipped:.2%} of the samples are clipped: sizes are too small")
    stretches = (*gaps, *mended.stretches)
    if stored is not None:
        x = stored.joined(x, len(samples))
        stretches = stored.spread(stretches, len(samples))
    offset, deviation = float(x.mean()), float(x.std())
    if abs(offset) > OFFSET_DEVIATIONS * deviation:
        notes.append(f"{OFFSET_NOTE} of {offset:.4g}, {abs(offset) / deviation:.0f} times what it measures")
    return CheckedSamples(
        x - offset,
        tuple(notes),
        (*repairs, *mended.repairs),
        stretches,
    )


def _bridged(
    x: Real, rate_hz: float, least_hz: float
) -> tuple[Real, list[Stretch], list[str], list[str], Upsampling | None]:
    """What was measured, bridged where it is missing; where that is long, notes, repairs, and upsampling."""
    good = np.isfinite(x)
    missing = 1.0 - float(good.mean())
    if missing > ACCELEROMETER_SHARE:
        raise UnfitError(
            "channel", f"lacks {missing:.1%} of its samples (NaN or infinite)", "check sensor and cable"
        )
    if missing:
        x = _interpolated(x, good)
    notes = (
        [f"{counted_are(int((~good).sum()), 'sample')} missing: bridged; check the bus and the device"]
        if missing
        else []
    )
    stored = upsampling(x)
    if stored is not None:
        notes.append(f"the channel was {stored.describe(rate_hz)}: only what was measured is used")
        _refuse_narrow(stored, rate_hz, least_hz)
        x, good = stored.measured(x), stored.measured(good)
        rate_hz /= stored.factor
    notes += _resolution(x, rate_hz)
    held = dropouts(x) & good
    if good.all() and not held.any():
        return x, [], notes, [], stored
    lost = ~good | held
    sentences = []
    if held.any():
        dropped = runs(np.flatnonzero(held), 1)
        first_s = dropped[0][0] / rate_hz
        what = f"{counted(len(dropped), 'time')} ({held.mean():.1%} of its samples), first at {first_s:.4g} s"
        if lost.mean() > ACCELEROMETER_SHARE:
            raise UnfitError("channel", f"stands still {what}", "check what drops its samples out")
        sentences.append(f"the channel stands still {what}: bridged; check what drops its samples out")
        x = _interpolated(x, ~held)
    long = [(first, last) for first, last in runs(np.flatnonzero(lost), 1) if last - first > BRIDGED]
    taper = round(GAP_TAPER_S * rate_hz)
    long = merged((max(first - taper, 0), min(last + taper, len(x))) for first, last in long)
    x = blanked(x, long, rate_hz)
    return x, long, notes, sentences, stored


def _refuse_narrow(stored: Upsampling, rate_hz: float, least_hz: float) -> None:
    """Refuse a record that was sampled too slowly, however fast it is stored.

    Raises:
        UnfitError: it is such a record.
    """
    top_hz = SHARE_OF_RATE * rate_hz / stored.factor
    if top_hz < LEAST_BAND * least_hz:
        raise UnfitError(
            "channel",
            f"was {stored.describe(rate_hz)}, which leaves the band {least_hz:g} to {top_hz:.0f} Hz",
            f"sample with {rounded_up(LEAST_BAND * least_hz / SHARE_OF_RATE, 4)} Hz or more",
        )


def _resolution(measured: Real, rate_hz: float) -> list[str]:
    """A note where a converter's steps are large beside what it measures.

    Raises:
        UnfitError: they are too large, or the channel is dead, or its samples were repeated.
    """
    moves = np.diff(measured)
    steady = float(np.mean(moves == 0.0))
    step = coarse_step(moves)
    deviation = float(measured.std())
    if steady <= DEAD_SHARE and (step is None or step <= COARSE_NOTE * deviation):
        return []
    if steady > DEAD_SHARE and (pace := even_pace(moves != 0.0)) is not None:
        raise UnfitError(
            "channel",
            f"was sampled at about {1e-3 * rate_hz / pace:.3g} kHz and upsampled: {steady:.0%} of its "
            "samples repeat the one before, at an even pace",
            "give the recording at the rate that it was sampled with",
        )
    if step is None or steady > COARSE_RESTS:
        raise UnfitError(
            "channel", f"is dead: {steady:.0%} of its samples repeat the one before", "check sensor and cable"
        )
    away = np.quantile(np.abs(measured - np.median(measured)), COARSE_OFTEN)
    if steady > DEAD_SHARE and away < COARSE_LOUD * step:
        raise UnfitError(
            "channel",
            f"is too coarse: it moves in steps of {step:.3g}, and {steady:.0%} of its samples repeat the one "
            "before",
            "set a more sensitive range or gain, or check sensor and cable",
        )
    note = (
        f"the channel's resolution is coarse: steps of {step:.3g}, and it vibrates with {deviation:.3g} "
        "r.m.s.: smaller signs of damage stay unseen; set a more sensitive range or gain"
    )
    return [note]


def _interpolated(x: Real, good: NDArray[np.bool_]) -> Real:
    """Straight lines over what is not good."""
    place = np.arange(len(x))
    return np.interp(place, place[good], x[good])


PASSES = 4
"""A loud transient hides what is wrong beside it."""
WANDERING_DEVIATIONS = 1.0
"""Range of the mean of single revolutions over the deviation within them, from which on it is followed."""
MOST_BLANKED = 0.2
MOST_SPIKES = 0.003
STEADY_REVOLUTIONS = 5
"""What begins and ends within so many revolutions is vibration, or a single event."""
MIDDLE_OF = 50
"""One sample of so many gives the spread of all."""
STRAY_DEVIATION = 3.0
"""Deviation of the whitened channel from which on its filter does not whiten: the foot of a steep low-pass is
lifted so far that only this is seen. Measured records have 0.6 to 1.8, one low-passed steeply had 22."""
_LISTED = 3
EMPTY_SHARE = 1e-8
"""Share of a channel's power in the analysed band below which it holds nothing: that of 14 bits rounded."""


@dataclass(frozen=True, slots=True)
class Repaired:
    """A channel that the race test can hear.

    Attributes:
        values: ``[n]``.
        repairs: what was put right, in sentences.
        stretches: where nothing of the machine is left, by sample.
    """

    values: Real
    repairs: tuple[str, ...]
    stretches: tuple[Stretch, ...]


def repaired(samples: Real, rate_hz: float, revolution: int, band_hz: tuple[float, float]) -> Repaired:
    """Put a channel right.

    Args:
        samples: ``[n]``, all finite, without drop-outs.
        rate_hz: their sample rate.
        revolution: samples of one revolution of the shaft.
        band_hz: where the analysed band begins and ends.

    Raises:
        UnfitError: too much is wrong.
    """
    whitening = _whitening_of(samples, rate_hz, band_hz)
    values = samples
    spikes: set[int] = set()
    steps: list[tuple[int, float]] = []
    stretches: list[Stretch] = []
    wandered = ""
    for _ in range(PASSES):
        whitened = whitening(values)
        clean = despiked(values, whitened, whitening, revolution)
        if clean.values is not values:
            values, whitened = clean.values, whitening(clean.values)
            spikes.update(clean.spikes)
            steps += clean.steps
        values, sentences = _steadied(values, revolution)
        wandered = wandered or sentences
        events = merged(
            [
                *find_transients(whitened, rate_hz, revolution),
                *find_transients(_unit(values), rate_hz, revolution),
            ]
        )
        if not events:
            break
        stretches = merged([*stretches, *events])
        lost = sum(last - first for first, last in stretches) / len(samples)
        if lost > MOST_BLANKED:
            _refuse_empty_band(samples, rate_hz, band_hz)
            raise UnfitError(
                "channel",
                f"is much louder for {lost:.0%} of its time, first at {stretches[0][0] / rate_hz:.2f} s, "
                "than the machine is otherwise",
                "give a recording of steady running without impacts, and check cable and mounting",
            )
        values = blanked(values, events, rate_hz)
    if len(spikes) > MOST_SPIKES * len(samples):
        _refuse_empty_band(samples, rate_hz, band_hz)
        wrong = f"{counted(len(spikes), 'wrong sample')} of {len(samples)}"
        raise UnfitError("channel", f"has {wrong}", "check cable and converter")
    repairs = []
    if spikes:
        repairs.append(_spikes_in_words(sorted(spikes), rate_hz))
    if steps:
        repairs.append(_steps_in_words(sorted(steps), rate_hz))
    if wandered:
        repairs.append(wandered)
    if stretches:
        repairs.append(_knocks_in_words(stretches, rate_hz))
    return Repaired(values, tuple(repairs), tuple(stretches))


def _whitening_of(samples: Real, rate_hz: float, band_hz: tuple[float, float]) -> Prewhitening:
    """What whitens a channel in its band.

    Raises:
        UnfitError: its band is empty.
    """
    whitening = Prewhitening(samples, rate_hz, *band_hz)
    if whitening.rescale(samples, STRAY_DEVIATION):
        _refuse_empty_band(samples, rate_hz, band_hz)
    return whitening


def _refuse_empty_band(samples: Real, rate_hz: float, band_hz: tuple[float, float]) -> None:
    """Refuse a channel whose band holds nothing but rounding, which looks like wrong samples once whitened.

    Raises:
        UnfitError: it is such a channel.
    """
    power = np.abs(scipy.fft.rfft((samples - samples.mean()) * np.hanning(len(samples)))) ** 2
    frequency = scipy.fft.rfftfreq(len(samples), 1.0 / rate_hz)
    inside = float(power[(frequency >= band_hz[0]) & (frequency <= band_hz[1])].sum())
    if inside < EMPTY_SHARE * power.sum():
        raise UnfitError(
            "channel",
            f"holds nothing but rounding from {band_hz[0]:g} to {band_hz[1]:g} Hz beside its "
            f"{frequency[power.argmax()]:.0f} Hz",
            "this is no accelerometer on a running machine: check channel, sensor and filter",
        )


def _steadied(samples: Real, revolution: int) -> tuple[Real, str]:
    """The channel without a wandering mean: its two ends, which a spectrum joins, must meet."""
    count = len(samples) // revolution
    turns = samples[: count * revolution].reshape(count, revolution)
    means = median_filter(turns.mean(axis=1), STEADY_REVOLUTIONS, mode="nearest")
    usual = float(np.median(turns.std(axis=1)))
    if np.ptp(means) <= WANDERING_DEVIATIONS * usual:
        return samples, ""
    middles = (np.arange(count) + 0.5) * revolution
    drift = np.interp(np.arange(len(samples)), middles, means)
    first, last = means[np.sort([means.argmin(), means.argmax()])]
    sentences = (
        f"the channel's mean moves from {first:.4g} to {last:.4g}, slowly (it vibrates with {usual:.3g} "
        "r.m.s.): followed and subtracted; check the sensor's supply and temperature"
    )
    return samples - drift, sentences


def _unit(samples: Real) -> Real:
    """The channel about its middle, of unit deviation as far as single events do not count."""
    low, middle, high = np.quantile(samples[::MIDDLE_OF], (0.1587, 0.5, 0.8413))
    return np.asarray((samples - middle) / max(0.5 * (high - low), np.finfo(np.float64).tiny))


def _spikes_in_words(spikes: list[int], rate_hz: float) -> str:
    return (
        f"{_count(len(spikes), 'sample', 'samples')} that no housing can follow, {_at(spikes, rate_hz)}: "
        "replaced by what the neighbours predict; check cable and converter"
    )


def _steps_in_words(steps: list[tuple[int, float]], rate_hz: float) -> str:
    heights = ", ".join(f"{height:+.4g}" for _, height in steps[:_LISTED]) + _more(len(steps))
    return (
        f"the channel's mean moves in {_count(len(steps), 'step', 'steps')} ({heights}), "
        f"{_at([place for place, _ in steps], rate_hz)}: taken out; check the sensor's supply"
    )


def _knocks_in_words(stretches: list[Stretch], rate_hz: float) -> str:
    lost_s = sum(last - first for first, last in stretches) / rate_hz
    return (
        f"{_count(len(stretches), 'knock', 'knocks')} much louder than the machine, "
        f"{_at([first for first, _ in stretches], rate_hz)}: {lost_s:.3f} s left out; check what strikes the "
        "housing, and the sensor's mounting"
    )


def _count(number: int, one: str, many: str) -> str:
    return f"{number} {one if number == 1 else many}"


def _more(number: int) -> str:
    return ", ..." if number > _LISTED else ""


def _at(places: list[int], rate_hz: float) -> str:
    """``at 1.204 s``, ``at 0.31, 0.422, 0.518, ... s``."""
    return f"at {', '.join(f'{place / rate_hz:.4g}' for place in places[:_LISTED])}{_more(len(places))} s"
