"""Which race, by the ratio of the energies of the two sliding units.

A fault of the inner race pushes the outer race's unit off its surface and leaves the inner race's unit in
peace, and the other way round; a ball meets both races and pushes both off. With the model a little wrong the
matched unit is not quite in peace, the less so the larger the fault is: absolute limits then call every large
fault a ball's. The ratio of the two energies does not depend on the size of the fault.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from daqsvc.bearing.model import BearingParameters
    from daqsvc.bearing.sliding_mode import UnitEnergies

Race = Literal["inner", "outer", "ball"]
"""The faulty part; ``"ball"`` is also what inner and outer race together look like."""

BOUNDARY_DB = 3.5
"""Between a race and a ball, in dB of the ratio of the two displacements' energies; a ball's is 0 dB."""
LEAST_EXCESS = 0.2
"""Energies are not told from the healthy ones nearer than this share of them."""


@dataclass(frozen=True, slots=True)
class RatioRule:
    """Judges the energies of a `SlidingPair` against those of the healthy machine.

    Attributes:
        parameters: of the bearing; D turns accelerations back into displacements.
        healthy: energies on the healthy machine.
        boundary_db: between a race and a ball.

    Raises:
        ValueError: the healthy energies are not finite and above 0.
    """

    parameters: BearingParameters
    healthy: UnitEnergies
    boundary_db: float = BOUNDARY_DB

    def __post_init__(self) -> None:
        for name, value in (("inner", self.healthy.inner_unit), ("outer", self.healthy.outer_unit)):
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(
                    f"ratio rule: the healthy energy of the {name} unit is {value}; it must be a finite "
                    "number above 0: record the healthy machine for longer"
                )

    def ratio_db(self, energies: UnitEnergies) -> float:
        """Energy of the inner race's displacement over the outer race's in dB; NaN if neither stands out."""
        p = self.parameters
        # The outer unit is driven by the inner race's component, and the other way round.
        inner = energies.outer_unit / self.healthy.outer_unit - 1.0
        outer = energies.inner_unit / self.healthy.inner_unit - 1.0
        if not max(inner, outer) > LEAST_EXCESS:
            return math.nan
        inner = max(inner, LEAST_EXCESS) * self.healthy.outer_unit * (p.m_r / p.k_s) ** 2
        outer = max(outer, LEAST_EXCESS) * self.healthy.inner_unit * (p.m_h / p.k_c) ** 2
        return 10.0 * math.log10(inner / outer)

    def judge(self, energies: UnitEnergies) -> Race | Literal["inner_or_outer"]:
        """Name the faulty part.

        Args:
            energies: over a window in which a fault was detected.
        """
        ratio_db = self.ratio_db(energies)
        if math.isnan(ratio_db):
            return "inner_or_outer"
        if abs(ratio_db) < self.boundary_db:
            return "ball"
        return "inner" if ratio_db > 0.0 else "outer"
