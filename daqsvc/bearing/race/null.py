"""What the combs find in noise, and how significant a find is, its search included.

Gaussian noise has no kinematic lines, yet the best of many offsets always scores something. The mean of that
score grows with the logarithms of the revolutions in the record and of the searched slip; it was fitted on
2400 records of white noise of 60 to 300 revolutions, sampled at 12 and 25.6 kHz, of four bearings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.bearing.race.verdict import Part

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
