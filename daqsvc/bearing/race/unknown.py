"""Strikes that fit no part of the stated bearing: of another bearing than stated, or of something else.

They are looked for as a family of lines at any order, as damage of an outer race makes it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.race.lines import HARMONICS, fundamental, significance
from daqsvc.bearing.race.verdict import PARTS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.race.lines import LineEvidence

    Real = NDArray[np.float64]


LOWEST, HIGHEST = 1.3, 12.0
"""Orders between which strikes are looked for: slower ones are of belts and cages."""
SEARCH = 1.1
"""How far that is, as a share of its middle to either side."""
LEAST_Z = 15.0
"""Significance from which on they are stated."""
LEAST_NATS = 10.0
"""Evidence that their own order must have."""
NEAR = 0.025
"""How near to a line of the bearing they may be its own, as a share."""
SMEAR = 0.02
"""How far a harmonic of the shaft may be smeared, as a share."""
HALVES = 0.01
"""How near to a half or a third of an order they may be the shaft's, in orders."""


@dataclass(frozen=True, slots=True)
class UnknownStrikes:
    """Strikes that fit no part.

    Attributes:
        order: strikes per revolution of the shaft.
        z: significance of their lines, in standard deviations of noise.
    """

    order: float
    z: float

    def describe(self, shaft_hz: float) -> str:
        """A note for a person."""
        return (
            f"regular strikes stand out at {self.order * shaft_hz:.1f} Hz (order {self.order:.3f}, "
            f"z {self.z:.1f}) that fit no part of this bearing: check its designation, or look for another "
            "source"
        )


def unknown_strikes(
    views: Sequence[LineEvidence], orders: BearingOrders, revolutions: float
) -> UnknownStrikes | None:
    """The clearest strikes that fit no part; None if none are clear.

    Args:
        views: evidence of lines in several views of the same signal, all on the same bins.
        orders: of the stated bearing.
        revolutions: of the shaft in the record.
    """
    least = np.min([view.log_ratio for view in views], axis=0)
    scale = views[0].bins_per_order
    trials: Real = np.arange(LOWEST, HIGHEST, 0.5 / HARMONICS[-1] / scale)
    bins = np.rint(np.outer(trials, HARMONICS) * scale).astype(np.int64)
    ratios = np.where(bins < len(least), least[np.minimum(bins, len(least) - 1)], 0.0)
    score = ratios.sum(axis=1)
    # What has the clearest line at a multiple of its order strikes so often itself.
    own = (ratios[:, 0] >= np.log1p(LEAST_NATS)) & (ratios[:, 0] >= ratios.max(axis=1) - np.log(2.0))
    score[~own] = 0.0
    best = int(np.argmax(score))
    order = float(trials[best])
    z = significance(float(score[best]), "outer", revolutions, SEARCH)
    return UnknownStrikes(order, z) if z >= LEAST_Z and _is_free(order, orders) else None


def _is_free(order: float, orders: BearingOrders) -> bool:
    """Whether an order is none of a bearing, and no whole, half or third one of the shaft."""
    parts = [h * fundamental(orders, part) for part in PARTS for h in (1, 2)]
    sides = [orders.inner + side for side in (-1.0, 1.0)]
    sides += [orders.ball_pass + side * orders.cage for side in (-1.0, 1.0)]
    cages = [h * orders.cage for h in range(3, 7)] + [h * (1.0 - orders.cage) for h in range(2, 6)]
    if any(abs(order / own - 1.0) <= NEAR for own in (*parts, *sides, *cages)):
        return False
    shaft = abs(order - round(order)) <= SMEAR * order
    return not shaft and all(abs(k * order - round(k * order)) > HALVES * k for k in (2, 3))
