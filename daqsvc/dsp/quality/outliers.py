"""Outliers of an accelerometer's channel: single wrong samples, steps, and transients from outside.

The tests of a bearing give every frequency of their band one voice. An event that is small beside the
vibration as a whole can yet be louder than all of the bands where the machine is quiet, and then its phases
are all that is seen. So outliers are looked for where they do harm: in the channel whitened by a spectrum
that no single event bends (`Prewhitening`).

No housing moves from one sample to the next as a wrong sample does. A wrong sample and a step of the supply
each have their own shape in the whitened channel, which is known exactly. What has only that shape is
estimated by least squares and subtracted (`despiked`); a strike in the bearing rings on and does not have it.
A transient is much louder than anything that the machine does every revolution (`find_transients`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import scipy.fft
from scipy.ndimage import uniform_filter1d
from scipy.signal import oaconvolve

from daqsvc.dsp.envelope import EXP_MEDIAN, row_medians

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    Real: TypeAlias = NDArray[np.float64]

Stretch: TypeAlias = tuple[int, int]
"""First sample, and the one after the last."""

RESOLUTION_HZ = 60.0
SEGMENTS = 200
"""As many are enough for a median spectrum."""


MIRRORED = 1 / 3
"""What the whitened channel counts at its ends: half of it is made of the mirror image."""


class Prewhitening:
    """A filter without delay that whitens the band of the race test.

    Its spectrum is the median over short segments: what happens in less than half of them does not count.

    Args:
        samples: ``[n]``, that it is made for.
        rate_hz: their sample rate.
        low_hz: where the band begins.
        high_hz: where it ends.

    Attributes:
        kernel: ``[2 half + 1]``, its impulse response, scaled so that noise of the channel's median spectrum
            comes out with unit deviation.
        half: samples on either side of the middle of the kernel.
    """

    def __init__(self, samples: Real, rate_hz: float, low_hz: float, high_hz: float) -> None:
        length = 2 ** int(np.ceil(np.log2(rate_hz / RESOLUTION_HZ)))
        hop = max(length // 2, (len(samples) - length) // SEGMENTS)
        segments = np.lib.stride_tricks.sliding_window_view(samples, length)[::hop]
        taper = np.hanning(length)
        centred = (segments - segments.mean(axis=1, keepdims=True)) * taper
        amplitude = np.sqrt(row_medians(np.abs(scipy.fft.rfft(centred, axis=1)).T ** 2))
        frequency = scipy.fft.rfftfreq(length, 1.0 / rate_hz)
        band = (frequency >= low_hz) & (frequency <= high_hz) & (amplitude > 0.0)
        gain = np.where(band, 1.0 / np.where(band, amplitude, 1.0), 0.0)
        self.half = length // 2
        response = scipy.fft.fftshift(scipy.fft.irfft(gain, length))
        kernel = np.append(response, response[0])
        kernel[[0, -1]] *= 0.5
        variance = float(np.mean(band)) / (EXP_MEDIAN * float(np.square(taper).sum()))
        self.kernel = kernel / np.sqrt(max(variance, np.finfo(np.float64).tiny))

    def rescale(self, samples: Real, limit: float) -> bool:
        """Let a channel come out with unit deviation, if it comes out with more than a limit.

        Args:
            samples: ``[n]``.
            limit: deviation, as its median shows it.

        Returns:
            Whether it did.
        """
        deviation = float(np.sqrt(np.median(np.square(self(samples)[::SPARSE])) / NORMAL_SQUARE_MEDIAN))
        if deviation > limit:
            self.kernel /= deviation
        return deviation > limit

    def __call__(self, samples: Real) -> Real:
        """The whitened channel, ``[n]``; beyond its ends it is thought to go on as its mirror image."""
        centred = (samples - samples.mean()).astype(np.float32)
        extended = np.pad(centred, self.half, mode="reflect", reflect_type="odd")
        # Noise comes out as 1, and nothing finer matters: single precision does, and takes half the time.
        whitened = oaconvolve(extended, self.kernel.astype(np.float32), mode="valid")
        whitened[: self.half] *= MIRRORED
        whitened[len(whitened) - self.half :] *= MIRRORED
        return whitened


def loudest_by_revolution(whitened: Real, revolution: int) -> Real:
    """Largest absolute value in each revolution, ``[revolutions]``."""
    count = len(whitened) // revolution
    return np.asarray(np.abs(whitened[: count * revolution]).reshape(count, revolution).max(axis=1))


LEAST_DEVIATIONS = 12.0
JUMP_DEVIATIONS = 1.5
"""Least step that is looked for in the mean of revolutions, over the deviation within them."""
LASTING, LASTING_SHARE = 3, 0.5
"""Share of a step that lasts, and for how many revolutions."""
ROUNDS = 12
"""One event can hide another."""
REST_SHARE = 0.06
"""What is left of an event over what the shape explains, at most; strikes of measured bearings leave 0.57 and
more. What is in doubt is a transient, if it is loud: less of the channel is left then, and nothing
invented."""
LOOKED_AT = 1 / 4
"""How far around an event its rest is looked for, as a share of the kernel's half."""
NORMAL_SQUARE_MEDIAN = 0.455
SPARSE = 8
"""One sample of so many gives the median of all."""
SPIKE_REACH = 2
STEP_REACH = 1 / 8
"""How far it may lie from the largest whitened sample: in samples, and as a share of the kernel's half."""


@dataclass(frozen=True, slots=True)
class Despiked:
    """A channel without single wrong samples and steps.

    Attributes:
        values: ``[n]``.
        spikes: places of the samples that were wrong, ascending.
        steps: place and height of each step, by place.
    """

    values: Real
    spikes: tuple[int, ...]
    steps: tuple[tuple[int, float], ...]


def despiked(samples: Real, whitened: Real, whitening: Prewhitening, revolution: int) -> Despiked:
    """Take out single wrong samples and steps.

    Args:
        samples: ``[n]``.
        whitened: the same through ``whitening``.
        whitening: of the channel.
        revolution: samples of one.
    """
    shapes: _Shapes | None = None
    values, spikes = samples, set[int]()
    steps: dict[int, float] = {}
    for _ in range(ROUNDS):
        events = loud_places(whitened, LEAST_DEVIATIONS, int(LOOKED_AT * whitening.half))
        shapes = shapes or _Shapes(whitening)
        located = shapes.explain(whitened, events) or shapes.locate(
            whitened, _jumps(values, revolution, 2 * whitening.half)
        )
        if not located:
            break
        values = values.copy()
        for place, height, step in located:
            if step:
                values[place:] -= height
                steps[place] = steps.get(place, 0.0) + height
            else:
                values[place] -= height
                spikes.add(place)
        whitened = whitening(values)
    return Despiked(values, tuple(sorted(spikes)), tuple(sorted(steps.items())))


def loud_places(whitened: Real, limit: float, apart: int) -> NDArray[np.int64]:
    """The largest sample of each group beyond a limit; groups are further apart than ``apart`` samples."""
    size = np.abs(whitened)
    beyond = np.flatnonzero(size > limit)
    if not len(beyond):
        return beyond
    first = np.flatnonzero(np.diff(beyond, prepend=-apart - 1) > apart)
    groups = np.split(beyond, first[1:])
    return np.array([group[np.argmax(size[group])] for group in groups])


def _jumps(samples: Real, revolution: int, apart: int) -> list[tuple[int, float]]:
    """Place and height of sudden changes of the mean, from one revolution to the next."""
    turns = samples[: len(samples) // revolution * revolution].reshape(-1, revolution)
    means = turns.mean(axis=1)
    limit = JUMP_DEVIATIONS * float(np.median(turns.std(axis=1)))
    if np.abs(means[2:] - means[:-2]).max(initial=0.0) < limit:
        return []
    summed = np.concatenate(([0.0], np.cumsum(samples - means.mean())))
    sliding = (summed[revolution:] - summed[:-revolution]) / revolution
    change = sliding[revolution:] - sliding[:-revolution]
    places = loud_places(change, limit, max(revolution, apart)) + revolution
    jumps = []
    for place in places:
        turn, height = place // revolution, float(change[place - revolution])
        before, behind = means[max(turn - LASTING, 0) : turn], means[turn + 1 : turn + 1 + LASTING]
        if len(before) and len(behind):
            # A single event moves the mean of one revolution, a step those of all that follow.
            lasting = float(np.median(behind) - np.median(before))
            if lasting * height > LASTING_SHARE * height**2:
                jumps.append((int(place), height))
    return jumps


class _Shapes:
    """What a wrong sample and a step look like in the whitened channel, at the places that they may have."""

    def __init__(self, whitening: Prewhitening) -> None:
        half = whitening.half
        reach = max(SPIKE_REACH, int(STEP_REACH * half))
        around = int(LOOKED_AT * half)
        self._window = np.arange(-around, around + 1)
        spike = np.pad(whitening.kernel, reach)
        step = np.pad(np.cumsum(whitening.kernel), reach)
        spikes = range(-SPIKE_REACH, SPIKE_REACH + 1)
        stepped = range(-reach, reach + 1)
        middle = self._window + half + reach
        self._shapes = np.array(
            [spike[middle - shift] for shift in spikes] + [step[middle - shift] for shift in stepped]
        )
        self._energy = np.square(self._shapes).sum(axis=1)
        self._places = [(shift, False) for shift in spikes] + [(shift, True) for shift in stepped]

    def explain(self, whitened: Real, events: NDArray[np.int64]) -> list[tuple[int, float, bool]]:
        """Place and height of each event that is a wrong sample or a step, and whether it is a step."""
        margin = len(self._window) // 2 + SPIKE_REACH
        if not len(events):
            return []
        inside = events[(events >= margin) & (events < len(whitened) - margin)]
        around = whitened[inside[:, np.newaxis] + self._window]
        height = around @ self._shapes.T / self._energy
        explained = np.square(height) * self._energy
        best = explained.argmax(axis=1)
        most = explained[np.arange(len(inside)), best]
        usual = len(self._window) * float(np.median(np.square(whitened[::SPARSE]))) / NORMAL_SQUARE_MEDIAN
        fits = np.square(around).sum(axis=1) - most <= usual + REST_SHARE * most
        return [
            (
                int(inside[row]) + self._places[best[row]][0],
                float(height[row, best[row]]),
                self._places[best[row]][1],
            )
            for row in np.flatnonzero(fits)
        ]

    def locate(self, whitened: Real, jumps: list[tuple[int, float]]) -> list[tuple[int, float, bool]]:
        """The exact place of each jump whose height is known."""
        steps = slice(2 * SPIKE_REACH + 1, None)
        reach = len(self._window) // 2
        events = []
        for jump, height in jumps:
            tries = np.arange(max(jump - reach, reach), min(jump + reach, len(whitened) - reach))
            if not len(tries):
                continue
            fit = whitened[tries[:, np.newaxis] + self._window] @ self._shapes[steps].T
            # The height is known: what is left is least where height * fit - height^2 * energy / 2 is most.
            gain = height * fit - 0.5 * height**2 * self._energy[steps]
            row, shape = np.unravel_index(int(np.argmax(gain)), gain.shape)
            events.append((int(tries[row]) + self._places[steps][shape][0], height, True))
        return events


LOUD_DEVIATIONS, LOUD_FACTOR = 15.0, 4.0
"""An event is a transient beyond this many deviations and this many times what the machine shows ..."""
DOMINANT_DEVIATIONS, DOMINANT_FACTOR = 8.0, 2.5
DOMINANT_SHARE = 0.25
"""... or beyond these, if so much of the fourth power of the whole channel is its alone: the noise of the
squared envelope's spectrum comes of it then."""
USUAL_QUANTILE = 0.75
"""What the machine shows by itself: a quarter of all revolutions show as much or more."""
RUNG_DOWN = 1.5
"""Level over the machine's own loudest down to which a transient rings."""
LEVEL_S = 2e-3
EVENT_S = 5e-3
TAPER_S = 1e-3


def find_transients(signal: Real, rate_hz: float, revolution: int) -> list[Stretch]:
    """Where transients from outside are.

    Strikes of a damaged bearing, and rubs, come back in every revolution or every few of them: they set the
    level that a transient is compared with.

    Args:
        signal: ``[n]``, without mean, of about unit deviation between its events.
        rate_hz: its sample rate.
        revolution: samples of one.
    """
    usual = float(np.quantile(loudest_by_revolution(signal, revolution), USUAL_QUANTILE))
    size = np.abs(signal)
    events = size > max(DOMINANT_DEVIATIONS, DOMINANT_FACTOR * usual)
    if not events.any():
        return []
    fourth = signal**4
    span = max(3, round(EVENT_S * rate_hz))
    dominant = uniform_filter1d(fourth, span) * span > DOMINANT_SHARE * fourth.sum()
    events &= dominant | (size > max(LOUD_DEVIATIONS, LOUD_FACTOR * usual))
    if not events.any():
        return []
    width = max(3, round(LEVEL_S * rate_hz))
    level = np.sqrt(np.maximum(uniform_filter1d(np.square(signal), width), 0.0))
    usual_level = float(np.quantile(loudest_by_revolution(level, revolution), USUAL_QUANTILE))
    loud = np.flatnonzero(events | (level > RUNG_DOWN * usual_level))
    taper = width + round(TAPER_S * rate_hz)
    stretches = runs(loud, 2 * taper)
    n = len(signal)
    return [
        (max(first - taper, 0), min(last + taper, n)) for first, last in stretches if events[first:last].any()
    ]


def merged(stretches: Iterable[Stretch]) -> list[Stretch]:
    """The same stretches without overlaps, ascending."""
    joined: list[Stretch] = []
    for first, last in sorted(stretches):
        if joined and first <= joined[-1][1]:
            joined[-1] = (joined[-1][0], max(last, joined[-1][1]))
        else:
            joined.append((first, last))
    return joined


def blanked(samples: Real, stretches: Iterable[Stretch], rate_hz: float) -> Real:
    """The channel with some stretches faded out: a straight line from before to behind.

    Args:
        samples: ``[n]``.
        stretches: where.
        rate_hz: its sample rate.
    """
    values = samples.copy()
    taper = max(2, round(TAPER_S * rate_hz))
    for first, last in stretches:
        count = last - first
        before = np.median(samples[max(first - 4 * taper, 0) : first + 1])
        behind = np.median(samples[last - 1 : last + 4 * taper])
        line = np.linspace(before, behind, count)
        edge = min(taper, count // 2)
        fade = np.zeros(count)
        fade[:edge] = 0.5 + 0.5 * np.cos(np.pi * (np.arange(edge) + 1.0) / (edge + 1.0))
        fade[count - edge :] = fade[:edge][::-1]
        values[first:last] = line + fade * (samples[first:last] - line)
    return values


def runs(places: NDArray[np.int64], gap: int) -> list[Stretch]:
    """Ascending places in runs that are further apart than ``gap``."""
    if not len(places):
        return []
    cuts = np.flatnonzero(np.diff(places) > gap)
    firsts = places[np.concatenate(([0], cuts + 1))]
    lasts = places[np.concatenate((cuts, [len(places) - 1]))] + 1
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))
