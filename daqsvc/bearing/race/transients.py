"""Knocks from outside: single events much louder than anything that the machine does every revolution."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from scipy.ndimage import uniform_filter1d

from daqsvc.bearing.race.prewhitening import loudest_by_revolution

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    Real: TypeAlias = NDArray[np.float64]

Stretch: TypeAlias = tuple[int, int]
"""First sample, and the one after the last."""

LOUD_DEVIATIONS, LOUD_FACTOR = 15.0, 4.0
"""An event is a knock beyond so many deviations and so many times what the machine shows by itself ..."""
DOMINANT_DEVIATIONS, DOMINANT_FACTOR = 8.0, 2.5
DOMINANT_SHARE = 0.25
"""... or beyond these, if so much of the fourth power of the whole channel is its alone: the noise of the
squared envelope's spectrum comes of it then."""
USUAL_QUANTILE = 0.75
"""What the machine shows by itself: a quarter of all revolutions show as much or more."""
RUNG_DOWN = 1.5
"""Level over the machine's own loudest down to which a knock rings."""
LEVEL_S = 2e-3
EVENT_S = 5e-3
TAPER_S = 1e-3


def find_transients(signal: Real, rate_hz: float, revolution: int) -> list[Stretch]:
    """Where somebody knocks.

    Strikes of a damaged bearing, and rubs, come back in every revolution or every few of them: they set the
    level that a knock is held against.

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


def levelled(envelope: NDArray[np.float32], holes: Real) -> NDArray[np.float32]:
    """An envelope with its own mean where nothing of the machine is left: no line comes of it, none is lost.

    Args:
        envelope: ``[n]``.
        holes: ``[holes, 2]``, their beginnings and ends as shares of its length.
    """
    if not len(holes):
        return envelope
    inside = np.zeros(len(envelope), dtype=np.bool_)
    for first, last in np.rint(holes * len(envelope)).astype(np.int64):
        inside[first:last] = True
    return np.where(inside, envelope[~inside].mean(), envelope)
