"""What the combs find in noise, and how significant a find is, its search included.

Gaussian noise has no kinematic lines, yet the best of many offsets always scores something. The mean of that
score grows with the logarithm of the revolutions in the record; it was fitted on white noise of 50 to 300
revolutions, sampled at 12 to 51 kHz.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.bearing.race.verdict import Part

REVOLUTIONS = 75.0
TAIL_Z = 5.0
TAIL_PROBABILITY = 4e-4
TAIL_SCALE = 0.65
"""The scores have an exponential tail in noise, not a Gaussian one."""


@dataclass(frozen=True, slots=True)
class NoiseScore:
    """Score of the best comb in Gaussian noise: ``mean + slope ln(N / 75)``, and its deviation."""

    mean: float
    slope: float
    deviation: float


NULL: Mapping[Part, NoiseScore] = {
    "inner": NoiseScore(2.27, 0.75, 0.60),
    "outer": NoiseScore(1.79, 0.58, 0.57),
    "ball": NoiseScore(2.55, 0.97, 0.70),
}


def significance(score: float, part: Part, revolutions: float) -> float:
    """How many standard deviations a score is above what noise gives."""
    null = NULL[part]
    return (score - null.mean - null.slope * math.log(revolutions / REVOLUTIONS)) / null.deviation


def false_alarm_probability(z: float) -> float:
    """Probability that a part's significance reaches ``z`` in Gaussian noise, in one record.

    Exact enough above 3; an upper bound below.
    """
    return min(1.0, TAIL_PROBABILITY * math.exp((TAIL_Z - z) / TAIL_SCALE))
