"""Strikes that fit no part of the stated bearing: of another bearing than stated, or of something else.

They are looked for as a family of lines at any order, as damage of an outer race makes it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.race.lines import EXPLAINED_SHARE, HARMONICS, part_lines, significance

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.race.lines import LineEvidence, ModulationDepth
    from daqsvc.bearing.race.verdict import Part, PartEvidence

    Real = NDArray[np.float64]


LOWEST, HIGHEST = 1.3, 12.0
"""Orders between which strikes are looked for: slower ones are of belts and cages."""
SEARCH = 1.1
"""How far that is, as a share of its middle to either side."""
LEAST_Z = 9.0
"""Significance from which on they may make the lines of a weaker part: no noise has it."""
STATED_Z = 15.0
"""Significance from which on they are stated, whatever the parts have."""
LEAST_NATS = 10.0
"""Evidence that their own order must have."""
HALVES = 0.01
"""How near to a whole order, a half or a third of one they may be the shaft's, in orders."""
SMEAR = 0.02
"""How far a harmonic of the shaft may be smeared, as a share."""


@dataclass(frozen=True, slots=True)
class UnknownStrikes:
    """Strikes that fit no part.

    Attributes:
        order: strikes per revolution of the shaft.
        z: significance of their lines, in standard deviations of noise.
    """

    order: float
    z: float

    def lines(self, bearing: BearingOrders) -> list[float]:
        """All orders at which they make lines: as damage of a race does, whatever bearing it is of."""
        return part_lines("outer", self.order, bearing)

    def describe(self, shaft_hz: float) -> str:
        """A note for a person."""
        return (
            f"regular strikes stand out at {self.order * shaft_hz:.1f} Hz (order {self.order:.3f}, "
            f"z {self.z:.1f}) that fit no part of this bearing: check its designation, or look for another "
            "source"
        )


def unknown_strikes(
    views: Sequence[LineEvidence],
    depths: Sequence[ModulationDepth],
    bearing: BearingOrders,
    evidence: Mapping[Part, PartEvidence],
    revolutions: float,
    smear_mirrored: float,
) -> UnknownStrikes | None:
    """The clearest strikes, if they fit no part; None if a part explains them, or none are clear.

    Args:
        views: evidence of lines in several views of the same signal, all on the same bins.
        depths: sizes of lines in these views.
        bearing: fault orders of the stated bearing.
        evidence: of each of its parts.
        revolutions: of the shaft in the record.
        smear_mirrored: power beyond a harmonic of the shaft over that of a line, from which on it is a smear.
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
    for k in (1, 2, 3):
        score[np.abs(k * trials - np.rint(k * trials)) <= HALVES * k] = 0.0
    while True:
        best = int(np.argmax(score))
        order = float(trials[best])
        z = significance(float(score[best]), "outer", revolutions, SEARCH)
        if z < LEAST_Z:
            return None
        about = np.abs(trials - round(order)) <= SMEAR * trials
        if about[best] and min(depth.mirrored(order) for depth in depths) >= smear_mirrored:
            score[about] = 0.0
            continue
        strikes = UnknownStrikes(order, z)
        if any(_explains(part, e, strikes, bearing) for part, e in evidence.items()):
            return None
        return strikes


def _explains(part: Part, e: PartEvidence, strikes: UnknownStrikes, bearing: BearingOrders) -> bool:
    """Whether a part that is found makes these strikes."""
    if e.z < e.z_limit:
        return False
    rates = [e.order]
    if part == "ball":
        # A spot that strikes one race only does so once in each turn of the ball.
        rates.append(0.5 * e.order)
    if not e.testable:
        # What strikes at a multiple instead is stated as the reason.
        rates += [h * e.order for h in HARMONICS]
    if e.z >= strikes.z:
        rates += [line for rate in rates for line in part_lines(part, rate, bearing)]
    return any(abs(strikes.order - rate) <= EXPLAINED_SHARE * rate for rate in rates)
