"""Evidence for a line at every frequency of an envelope spectrum, narrow or smeared by slip."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.dsp.envelope import EXP_MEDIAN, running_median

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    Real = NDArray[np.float64]

FLOOR_ORDERS = 2.0
"""Width of the local noise level, in orders."""
NOTCHED_HARMONICS = 25
NOTCH_BINS = 1.6
SKIRT_BINS = 5
LOWEST_ORDER = 0.25
HALF_WIDTHS = (0.004, 0.01)
"""Half widths of smeared lines, as shares of their frequency, beside the single bin: slip smears a ball's."""

EXPLAINED_SHARE = 0.012
EXPLAINED_BINS = 3.0
"""How far a line's evidence reaches to either side of it, as a share and in bins."""


@dataclass(frozen=True, slots=True)
class LineEvidence:
    """An envelope spectrum as evidence.

    Attributes:
        log_ratio: ``ln(1 + g)`` with ``g`` the generalised log-likelihood ratio for a line, ``[bins]``.
        notched: bins that belong to harmonics of the shaft, ``[bins]``.
        bins_per_order: bins per order of the shaft.
    """

    log_ratio: Real
    notched: NDArray[np.bool_]
    bins_per_order: float

    def about(self, orders: Iterable[float]) -> NDArray[np.bool_]:
        """Bins whose evidence lines at some orders explain, ``[bins]``."""
        explained = np.zeros(len(self.log_ratio), dtype=np.bool_)
        for order in orders:
            reach = max(EXPLAINED_SHARE * order * self.bins_per_order, EXPLAINED_BINS)
            centre = order * self.bins_per_order
            explained[max(int(centre - reach), 0) : int(centre + reach) + 2] = True
        return explained

    def without(self, explained: NDArray[np.bool_]) -> LineEvidence:
        """The same with no evidence in some bins: what another part's lines explain."""
        return replace(self, log_ratio=np.where(explained, 0.0, self.log_ratio))

    def at(self, order: float) -> float:
        """Log-likelihood ratio in nats for a line at an order; 0 beyond the spectrum."""
        place = round(order * self.bins_per_order)
        return float(np.expm1(self.log_ratio[place])) if 0 <= place < len(self.log_ratio) else 0.0


def noise_floor(power: Real, bins_per_order: float) -> Real:
    """Local mean of the noise in a power spectrum, ``[bins]``, robust against lines."""
    return np.asarray(running_median(power, round(FLOOR_ORDERS * bins_per_order)) / EXP_MEDIAN)


def shaft_notch(power: Real, bins_per_order: float) -> NDArray[np.bool_]:
    """Bins of the shaft's harmonics with their skirts, and those below the lowest order, ``[bins]``.

    A skirt reaches down a line's flank as long as it falls, `SKIRT_BINS` bins at most.
    """
    n = len(power)
    notch = np.zeros(n, dtype=np.bool_)
    notch[: int(np.ceil(LOWEST_ORDER * bins_per_order))] = True
    for harmonic in range(1, NOTCHED_HARMONICS + 1):
        centre = harmonic * bins_per_order
        first, last = int(np.ceil(centre - NOTCH_BINS)), int(np.floor(centre + NOTCH_BINS))
        if last >= n - 1:
            break
        while centre - (first - 1) <= SKIRT_BINS and power[first - 1] < power[first]:
            first -= 1
        while last + 1 < n and last + 1 - centre <= SKIRT_BINS and power[last + 1] < power[last]:
            last += 1
        notch[first : last + 1] = True
    return notch


def hann_looks(bins: NDArray[np.int64]) -> Real:
    """Independent values in the mean of so many neighbouring bins of a Hann-windowed periodogram."""
    return bins / (1.0 + 2.0 * (0.444 * (1.0 - 1.0 / bins) + 0.028 * np.maximum(1.0 - 2.0 / bins, 0.0)))


def line_evidence(power: Real, bins_per_order: float) -> LineEvidence:
    """Test every bin, and every bin's neighbourhood of two widths, for more power than its surroundings.

    The test is the generalised likelihood ratio of a gamma distribution's scale, one-sided.

    Args:
        power: envelope spectrum, ``[bins]``.
        bins_per_order: bins per order of the shaft.
    """
    ratio = power / np.maximum(noise_floor(power, bins_per_order), 1e-300)
    notched = shaft_notch(power, bins_per_order)
    ratio[notched] = 1.0
    n = len(power)
    best = _excess(np.maximum(ratio, 1.0))
    summed = np.concatenate(([0.0], np.cumsum(ratio)))
    index = np.arange(n)
    for share in HALF_WIDTHS:
        half = np.rint(share * index).astype(np.int64)
        first, last = np.maximum(index - half, 0), np.minimum(index + half + 1, n)
        bins = last - first
        mean = (summed[last] - summed[first]) / bins
        np.maximum(best, hann_looks(bins) * _excess(np.maximum(mean, 1.0)), out=best)
    return LineEvidence(np.log1p(best), notched, bins_per_order)


def _excess(ratio: Real) -> Real:
    return ratio - 1.0 - np.log(ratio)
