"""How deep a part's lines modulate the whitened envelope: the size of a defect's mark, without a unit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.race.lines import noise_floor
from daqsvc.dsp.envelope import HANN_NOISE_BANDWIDTH

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Real = NDArray[np.float64]

HARMONICS = (1, 2, 3, 4)
HALF_WIDTH = 0.006
"""Half width of a line as a share of its frequency: slip smears it."""

SMEAR = 0.01
"""How far a harmonic of the shaft is smeared at least that is taken for a line of a bearing, as a share."""
FLAT_TOP = 0.98


class ModulationDepth:
    """Modulation depth by order of one envelope spectrum.

    Args:
        power: squared peak amplitudes of the envelope over its mean, ``[bins]``.
        notched: bins of the shaft's harmonics, ``[bins]``; they count nothing.
        bins_per_order: bins per order of the shaft.
    """

    def __init__(self, power: Real, notched: NDArray[np.bool_], bins_per_order: float) -> None:
        self.floor = noise_floor(power, bins_per_order)
        self._power = power
        self._notched = notched
        self._bins_per_order = bins_per_order
        above = np.where(notched, 0.0, power - self.floor)
        self._summed = np.concatenate(([0.0], np.cumsum(above)))

    def without(self, explained: NDArray[np.bool_]) -> ModulationDepth:
        """The same with nothing in some bins.

        Args:
            explained: ``[bins]``.
        """
        return ModulationDepth(self._power, self._notched | explained, self._bins_per_order)

    def line(self, order: Real) -> Real:
        """Squared modulation indices of the lines at some orders, 0 where nothing is above the noise.

        Args:
            order: ``[n]``.
        """
        centre = order * self._bins_per_order
        last_bin = len(self._summed) - 1
        first = np.ceil(centre * (1.0 - HALF_WIDTH)).astype(np.int64)
        last = np.floor(centre * (1.0 + HALF_WIDTH)).astype(np.int64) + 1
        above = self._summed[np.minimum(last, last_bin)] - self._summed[np.minimum(first, last_bin)]
        kept = np.where(last <= last_bin, np.maximum(above, 0.0), 0.0)
        return np.asarray(kept / HANN_NOISE_BANDWIDTH, dtype=np.float64)

    def mirrored(self, order: float) -> float:
        """What stands on the far side of the nearest harmonic of the shaft over what stands on the near one.

        Args:
            order: of a line; compared is what is within twice its distance from that harmonic, or `SMEAR`.

        Returns:
            About 1 where the harmonic itself is smeared, as speed that wanders smears it to either side;
            about 0 beside a line of its own.
        """
        harmonic = round(order)
        gap = float(np.copysign(max(2.0 * abs(order - harmonic), SMEAR * order), order - harmonic))
        middle, near, far = (
            min(round(at * self._bins_per_order), len(self._summed) - 1)
            for at in (harmonic, harmonic + gap, harmonic - gap)
        )
        own, other = (abs(float(self._summed[at] - self._summed[middle])) for at in (near, far))
        return other / max(own, 1e-300)

    def comb(self, order: Real) -> Real:
        """Root sums of squares of the modulation indices of some orders' harmonics, ``[n]``."""
        return np.asarray(np.sqrt(np.sum([self.line(h * order) for h in HARMONICS], axis=0)))


def sharpest(views: Sequence[ModulationDepth], order: float, reach: float, bins_per_order: float) -> float:
    """The order about another at which the lines are deepest.

    Evidence for smeared lines has a broad top; the lines themselves sit somewhere below it.

    Args:
        views: depths by several views of the same signal; their squares are summed.
        order: where to look.
        reach: how far, as a share.
        bins_per_order: bins per order of the shaft.
    """
    step = 0.5 / HARMONICS[-1] / bins_per_order
    count = int(reach * order / step)
    trials = np.asarray(order + step * np.arange(-count, count + 1), dtype=np.float64)
    depth = np.sum([view.comb(trials) ** 2 for view in views], axis=0)
    # A line narrower than what is summed has a flat top: its middle is the line.
    top = np.flatnonzero(depth >= FLAT_TOP * depth.max())
    deepest = int(np.argmax(depth))
    run = top[np.abs(top - deepest) <= 2.0 * HALF_WIDTH * order / step]
    return float(trials[run].mean())
