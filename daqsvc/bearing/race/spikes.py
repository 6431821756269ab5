"""Single wrong samples and steps in an accelerometer's channel: found by their shape, and taken out.

No housing moves from one sample to the next as a wrong sample does: it, and a step of the supply, have a
shape of their own in the whitened channel, which is known exactly. What has that shape and nothing else is
estimated by least squares and subtracted; a strike in the bearing rings on and does not have it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.bearing.race.prewhitening import Prewhitening

    Real = NDArray[np.float64]

LEAST_DEVIATIONS = 12.0
JUMP_DEVIATIONS = 1.5
"""Least step that is looked for in the mean of revolutions, over the deviation within them."""
LASTING, LASTING_SHARE = 3, 0.5
"""So much of a step is there for so many revolutions."""
ROUNDS = 12
"""One event can hide another."""
REST_SHARE = 0.06
"""What is left of an event over what the shape explains, at most; strikes of measured bearings leave 0.57 and
more. What is in doubt is a knock, if it is loud: less of the channel is left then, and nothing invented."""
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
        found = shapes.explain(whitened, events) or shapes.locate(
            whitened, _jumps(values, revolution, 2 * whitening.half)
        )
        if not found:
            break
        values = values.copy()
        for place, height, step in found:
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
        found = []
        for jump, height in jumps:
            tries = np.arange(max(jump - reach, reach), min(jump + reach, len(whitened) - reach))
            if not len(tries):
                continue
            fit = whitened[tries[:, np.newaxis] + self._window] @ self._shapes[steps].T
            # The height is known: what is left is least where height * fit - height^2 * energy / 2 is most.
            gain = height * fit - 0.5 * height**2 * self._energy[steps]
            row, shape = np.unravel_index(int(np.argmax(gain)), gain.shape)
            found.append((int(tries[row]) + self._places[steps][shape][0], height, True))
        return found
