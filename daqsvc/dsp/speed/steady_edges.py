"""Where a sharp edge lies between two samples: where a shaft that turns evenly would have put it.

A pulse with flanks shorter than the sampling interval says only between which two samples its edge lies;
half way between them is wrong by up to half a sample, 3 degrees at 64 samples a revolution, and jumps by a
whole one from one revolution to another. The last edges together say more: of all constant speeds that put
each of them between its own two samples, the middle one places the newest.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.dsp.speed.keyphasor import KeyphasorEdge

    Floats = NDArray[np.float64]

_REACH = 16
_LEAST = 3
_SHARP = 0.8
"""Part of the signal's range that an edge must rise by from one sample to the next to count as sharp."""
_HALF_SAMPLE = 0.5
_ROUNDING = 1e-6
_PULL = 0.1


class SharpEdges:
    """Tells which edges of a signal are sharp, block by block."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the signal."""
        self._last = np.nan
        self._low, self._high = np.inf, -np.inf

    def sharp(self, samples: Floats) -> NDArray[np.bool_]:
        """Whether the signal rises or falls by most of its range so far from the sample before.

        Args:
            samples: float64 ``[n]``; NaN where missing.
        """
        if not len(samples):
            return np.zeros(0, dtype=bool)
        before = np.concatenate(([self._last], samples[:-1]))
        low = np.minimum.accumulate(np.fmin(samples, np.inf))
        high = np.maximum.accumulate(np.fmax(samples, -np.inf))
        low, high = np.minimum(low, self._low), np.maximum(high, self._high)
        with np.errstate(invalid="ignore"):
            sharp: NDArray[np.bool_] = np.abs(samples - before) >= _SHARP * (high - low)
        self._last, self._low, self._high = float(samples[-1]), float(low[-1]), float(high[-1])
        return sharp


class SteadyEdges:
    """Places marks that are known to half a sample only."""

    def __init__(self) -> None:
        self._marks: deque[KeyphasorEdge] = deque(maxlen=_REACH)
        self._placed: KeyphasorEdge | None = None

    def reset(self) -> None:
        """Forget the marks before."""
        self._marks.clear()
        self._placed = None

    def place(self, mark: KeyphasorEdge, *, sharp: bool) -> KeyphasorEdge:
        """The mark, moved by up to half a sample if its edge is sharp and the shaft turns evenly.

        The place moves on with the speed and only gently towards the middle of what the edges allow: where
        they allow a whole sample, any place in it is as good, but none may be left in a jump.
        """
        if not sharp:
            self.reset()
            return mark
        self._marks.append(mark)
        revolution = np.array([one.revolution - mark.revolution for one in self._marks], dtype=np.float64)
        sample = np.array([-one.samples_before(mark) for one in self._marks])
        reach = len(sample)
        allowed = None
        while reach >= _LEAST and allowed is None:
            allowed = _even(revolution[-reach:], sample[-reach:])
            reach //= 2
        offset = 0.0
        if allowed is not None:
            period, offset = allowed
            if self._placed is not None:
                turns = mark.revolution - self._placed.revolution
                ahead = period * turns - self._placed.samples_before(mark)
                offset = ahead + _PULL * (offset - ahead)
            offset = min(max(offset, -_HALF_SAMPLE), _HALF_SAMPLE)
        self._placed = replace(mark.later(offset), revolution=mark.revolution)
        return self._placed


def _even(revolution: Floats, sample: Floats) -> tuple[float, float] | None:
    """Period, and place of the last edge from where it was seen, if the speed is constant; else None."""
    apart = revolution[np.newaxis, :] - revolution[:, np.newaxis]
    later = apart > 0.0
    apart = np.where(later, apart, 1.0)
    gap = sample[np.newaxis, :] - sample[:, np.newaxis]
    shortest = float(np.where(later, (gap - 2.0 * _HALF_SAMPLE) / apart, -np.inf).max())
    longest = float(np.where(later, (gap + 2.0 * _HALF_SAMPLE) / apart, np.inf).min())
    if shortest > longest + _ROUNDING:
        return None
    period = 0.5 * (shortest + longest)
    line = sample - period * revolution
    earliest, latest = float((line - _HALF_SAMPLE).max()), float((line + _HALF_SAMPLE).min())
    return None if earliest > latest + _ROUNDING else (period, 0.5 * (earliest + latest))
