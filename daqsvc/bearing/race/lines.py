"""The lines of a part in an envelope's spectrum: their evidence, their size, and their significance in noise.

Evidence is found for a line at every frequency, narrow or smeared by slip. Gaussian noise has no kinematic
lines, yet the best of many offsets always scores something. The mean of that score grows with the logarithms
of the revolutions in the record and of the searched slip. It was fitted on 2400 records of white noise of 60
to 300 revolutions, sampled at 12 and 25.6 kHz, of four bearings.

The lines of a part together make a comb, which is searched over slip (`best_comb`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.dsp.envelope import EXP_MEDIAN, HANN_NOISE_BANDWIDTH, running_median

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.race.verdict import Part

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
        notched: bins of lines that are no bearing's, ``[bins]``: harmonics of the shaft, of gears and motors.
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


def line_notch(power: Real, bins_per_order: float, others: Sequence[float] = ()) -> NDArray[np.bool_]:
    """Bins of lines that are no bearing's with their skirts, and those below the lowest order, ``[bins]``.

    A skirt reaches down a line's flank as long as it falls, `SKIRT_BINS` bins at most.

    Args:
        power: envelope spectrum, ``[bins]``.
        bins_per_order: bins per order of the shaft.
        others: orders of lines besides the harmonics of the shaft.
    """
    n = len(power)
    notch = np.zeros(n, dtype=np.bool_)
    notch[: int(np.ceil(LOWEST_ORDER * bins_per_order))] = True
    for order in (*range(1, NOTCHED_HARMONICS + 1), *others):
        centre = order * bins_per_order
        first, last = int(np.ceil(centre - NOTCH_BINS)), int(np.floor(centre + NOTCH_BINS))
        if first < 1 or last >= n - 1:
            continue
        while centre - (first - 1) <= SKIRT_BINS and power[first - 1] < power[first]:
            first -= 1
        while last + 1 < n and last + 1 - centre <= SKIRT_BINS and power[last + 1] < power[last]:
            last += 1
        notch[first : last + 1] = True
    return notch


def hann_averages(bins: NDArray[np.int64]) -> Real:
    """Independent values in the mean of so many neighbouring bins of a Hann-windowed periodogram."""
    return bins / (1.0 + 2.0 * (0.444 * (1.0 - 1.0 / bins) + 0.028 * np.maximum(1.0 - 2.0 / bins, 0.0)))


def line_evidence(power: Real, bins_per_order: float, others: Sequence[float] = ()) -> LineEvidence:
    """Test every bin, and every bin's neighbourhood of two widths, for more power than its surroundings.

    The test is the generalised likelihood ratio of a gamma distribution's scale, one-sided.

    Args:
        power: envelope spectrum, ``[bins]``.
        bins_per_order: bins per order of the shaft.
        others: orders of lines, besides the harmonics of the shaft, that are no bearing's.
    """
    ratio = power / np.maximum(noise_floor(power, bins_per_order), 1e-300)
    notched = line_notch(power, bins_per_order, others)
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
        np.maximum(best, hann_averages(bins) * _excess(np.maximum(mean, 1.0)), out=best)
    return LineEvidence(np.log1p(best), notched, bins_per_order)


def _excess(ratio: Real) -> Real:
    return ratio - 1.0 - np.log(ratio)


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
        """What is on the far side of the nearest harmonic of the shaft over what is on the near side.

        Args:
            order: of a line; compared is what is within twice its distance from that harmonic, or `SMEAR`.

        Returns:
            About 1 where the harmonic itself is smeared, as speed that wanders smears it to either side;
            about 0 beside its own line.
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


REVOLUTIONS = 75.0
SLIP = 0.015
TAIL_Z = 5.0
TAIL_PROBABILITY = 4e-4
TAIL_SCALE = 0.65
"""The scores have an exponential tail in noise, not a Gaussian one."""


@dataclass(frozen=True, slots=True)
class NoiseScore:
    """Score of the best comb in Gaussian noise, ``mean + slope ln(N / 75) + search ln(slip / 0.015)``."""

    mean: float
    slope: float
    search: float
    deviation: float


NULL: Mapping[Part, NoiseScore] = {
    "inner": NoiseScore(2.23, 0.61, 0.49, 0.60),
    "outer": NoiseScore(1.68, 0.56, 0.43, 0.59),
    "ball": NoiseScore(2.26, 0.78, 0.58, 0.66),
}


def significance(score: float, part: Part, revolutions: float, slip: float) -> float:
    """How many standard deviations a score is above what noise gives.

    Args:
        score: of the part's best comb.
        part: whose.
        revolutions: of the shaft in the record.
        slip: how far the comb was searched, as a share.
    """
    null = NULL[part]
    mean = null.mean + null.slope * math.log(revolutions / REVOLUTIONS) + null.search * math.log(slip / SLIP)
    return (score - mean) / null.deviation


def false_alarm_probability(z: float) -> float:
    """Probability that a part's significance reaches ``z`` in Gaussian noise, in one record.

    Exact enough above 3; an upper bound below.
    """
    return min(1.0, TAIL_PROBABILITY * math.exp((TAIL_Z - z) / TAIL_SCALE))


@dataclass(frozen=True, slots=True)
class Tooth:
    """A line of a comb at ``harmonic * fundamental + sideband * modulation``, with its weight."""

    harmonic: int
    sideband: int
    weight: float


INNER_TEETH = (
    *(Tooth(h, 0, 1.0) for h in (1, 2, 3, 4)),
    *(Tooth(h, s, 0.5) for h in (1, 2) for s in (-1, 1)),
)
OUTER_TEETH = (*(Tooth(h, 0, 1.0) for h in (1, 2, 3, 4)), Tooth(5, 0, 0.5))
BALL_TEETH = (
    *(Tooth(h, 0, 1.0) for h in (1, 2, 3)),
    *(Tooth(h, s, 0.5) for h in (1, 2) for s in (-1, 1)),
)
TEETH: Mapping[Part, tuple[Tooth, ...]] = {"inner": INNER_TEETH, "outer": OUTER_TEETH, "ball": BALL_TEETH}
CAGE_WEIGHT = 0.5
CAGE_HARMONICS = (1, 2, 3, 4)
HIGHEST_ORDER_SHARE = 1.02


@dataclass(frozen=True, slots=True)
class Comb:
    """The best comb of a part.

    Attributes:
        score: weighted sum of the log evidences of its lines.
        order: its fundamental order.
    """

    score: float
    order: float


def fundamental(orders: BearingOrders, part: Part) -> float:
    """The order that a part's comb is made of."""
    return orders.ball_pass if part == "ball" else float(getattr(orders, part))


def part_lines(part: Part, order: float, orders: BearingOrders) -> list[float]:
    """All orders at which damage of a part makes lines: harmonics with two sidebands, and mixed ones.

    Args:
        part: the part.
        order: its fundamental order as found.
        orders: the stated orders.
    """
    modulation = orders.cage if part == "ball" else 1.0
    return [h * order + s * modulation for h in range(1, 7) for s in range(-2, 3)]


def highest_order(orders: BearingOrders) -> float:
    """The highest order that any comb looks at."""
    tops = [
        max(t.harmonic * fundamental(orders, part) + t.sideband for t in teeth)
        for part, teeth in TEETH.items()
    ]
    return HIGHEST_ORDER_SHARE * max(tops)


def best_comb(views: Sequence[LineEvidence], orders: BearingOrders, part: Part, slip: float) -> Comb:
    """Search a part's comb over slip, in several views of the same signal at once.

    At every offset the least of the views counts: each is fooled by something that the others are not.

    Args:
        views: evidence of lines, up to `highest_order`, all on the same bins.
        orders: the stated orders.
        part: whose comb.
        slip: how far to search, as a share of the fundamental order.
    """
    teeth = TEETH[part]
    scale = views[0].bins_per_order
    trials = _trials(fundamental(orders, part), slip, max(t.harmonic for t in teeth), scale)
    modulation = orders.cage if part == "ball" else 1.0
    places = np.array([t.harmonic * trials + t.sideband * modulation for t in teeth])
    weights = np.array([t.weight for t in teeth])
    score = np.min([weights @ _at(view, places) for view in views], axis=0)
    best = int(np.argmax(score))
    total = float(score[best])
    if part == "ball":
        total += CAGE_WEIGHT * _best_cage(views, orders.cage, slip)
    return Comb(total, float(trials[best]))


def _best_cage(views: Sequence[LineEvidence], cage: float, slip: float) -> float:
    """Evidence for the cage's rate and for the shaft modulated by it: a ball passes the load zone with it."""
    cages = _trials(cage, slip, max(CAGE_HARMONICS), views[0].bins_per_order)
    places = np.array([h * cages for h in CAGE_HARMONICS] + [1.0 - cages, 1.0 + cages])
    return float(np.min([_at(view, places).sum(axis=0) for view in views], axis=0).max())


def _trials(order: float, slip: float, harmonics: int, bins_per_order: float) -> Real:
    """Orders to try: half a bin apart at the highest harmonic."""
    step = 0.5 / harmonics / bins_per_order
    count = int(np.ceil(slip * order / step))
    return np.asarray(order + step * np.arange(-count, count + 1), dtype=np.float64)


def _at(evidence: LineEvidence, orders: Real) -> Real:
    bins = np.rint(orders * evidence.bins_per_order).astype(np.int64)
    return evidence.log_ratio[np.minimum(bins, len(evidence.log_ratio) - 1)]
