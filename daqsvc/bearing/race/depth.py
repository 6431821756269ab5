"""How deep a part's lines modulate the whitened envelope: the size of a defect's mark, without a unit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.race.lines import noise_floor
from daqsvc.dsp.envelope import HANN_NOISE_BANDWIDTH

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Real = NDArray[np.float64]

HARMONICS = (1, 2, 3, 4)
HALF_WIDTH = 0.006
"""Half width of a line as a share of its frequency: slip smears it."""


class ModulationDepth:
    """Modulation depth by order of one envelope spectrum.

    Args:
        power: squared peak amplitudes of the envelope over its mean, ``[bins]``.
        notched: bins of the shaft's harmonics, ``[bins]``; they count nothing.
        bins_per_order: bins per order of the shaft.
    """

    def __init__(self, power: Real, notched: NDArray[np.bool_], bins_per_order: float) -> None:
        self.floor = noise_floor(power, bins_per_order)
        self._bins_per_order = bins_per_order
        above = np.where(notched, 0.0, power - self.floor)
        self._summed = np.concatenate(([0.0], np.cumsum(above)))

    def line(self, order: float) -> float:
        """Squared modulation index of the line at an order, 0 if nothing is above the noise."""
        centre = order * self._bins_per_order
        first = int(np.ceil(centre * (1.0 - HALF_WIDTH)))
        last = int(np.floor(centre * (1.0 + HALF_WIDTH))) + 1
        if last >= len(self._summed):
            return 0.0
        return max(0.0, float(self._summed[last] - self._summed[first])) / HANN_NOISE_BANDWIDTH

    def comb(self, order: float) -> float:
        """Root sum of squares of the modulation indices of an order's harmonics."""
        return float(np.sqrt(sum(self.line(h * order) for h in HARMONICS)))
