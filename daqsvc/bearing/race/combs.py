"""Combs of kinematic lines: the evidence of all lines of a part together, searched over slip."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.race.lines import LineEvidence
    from daqsvc.bearing.race.verdict import Part

    Real = NDArray[np.float64]


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
