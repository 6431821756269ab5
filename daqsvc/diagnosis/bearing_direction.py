"""Inner or outer race by direction: accelerometers on rotor and housing, and the bearing's masses.

The exact residual of `daqsvc.bearing.residual` separates the races; two sliding units make energies of its
components, and their ratio names the race. What the healthy machine leaves in them is learnt anew at each
start, on the first look at which the machine is in good order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.bearing.residual import TwoSensorResidual
from daqsvc.bearing.sliding_mode import SlidingGains, SlidingPair, UnitEnergies

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.bearing.model import BearingParameters
    from daqsvc.bearing.race.verdict import Part

    Floats = NDArray[np.float64]

SEPARATE = 0.25
"""Part of the rolling elements' own frequency from which on the races differ: below, these follow the races
at once, and inner and outer race look alike to any two sensors."""
_LEAST_EXCESS = 0.1
"""Part of the healthy energy by which a unit must be off for it to count; less is not told from noise."""
_RACE_DB = 4.5
"""A race's displacement has so much more energy than the other's; a ball meets both."""
_BALL_DB = 1.5


class Direction(NamedTuple):
    """What two accelerometers say of a fault.

    Attributes:
        group: the parts that remain, the likeliest first.
        ratio_db: energy of the inner race's displacement over the outer race's; NaN if neither is above what
            the healthy machine shows.
    """

    group: tuple[Part, ...]
    ratio_db: float


@dataclass(frozen=True, slots=True)
class TwoSensors:
    """A bearing with an accelerometer on its rotor beside the one on its housing.

    Attributes:
        rotor: name of the one on the rotor.
        column: its column in the stream.
        parameters: of the bearing.
        m_s2_per_unit: of rotor and housing.
    """

    rotor: str
    column: int
    parameters: BearingParameters
    m_s2_per_unit: tuple[float, float] = (1.0, 1.0)


class RaceDirection:
    """Names the faulty race of one bearing.

    Args:
        two: its accelerometers and parameters.
        rate_hz: sampling rate.

    Raises:
        ValueError: the sampling rate is too low for the bearing's rolling elements.
    """

    def __init__(self, two: TwoSensors, rate_hz: float) -> None:
        p = two.parameters
        self._two = two
        ball_hz = math.sqrt((p.k_s + p.k_c) / p.m_b) / math.tau
        self._residual = TwoSensorResidual(p, rate_hz, corner_hz=SEPARATE * ball_hz)
        self._gains: SlidingGains | None = None
        self._healthy = UnitEnergies(math.nan, math.nan)

    @property
    def ready(self) -> bool:
        """Whether the healthy machine is known."""
        return self._gains is not None

    def learn(self, pair: Floats) -> None:
        """Learn from the machine in good order.

        Args:
            pair: float64 ``[n, 2]``, rotor and housing in their units; NaN where missing.
        """
        residual = self._separated(pair)
        if residual is not None:
            self._gains = SlidingGains.from_healthy(residual)
            self._healthy = self._energies(residual, self._gains)

    def judge(self, pair: Floats) -> Direction | None:
        """Name the faulty race of a window in which something has changed.

        Args:
            pair: float64 ``[n, 2]``, rotor and housing in their units; NaN where missing.

        Returns:
            None before the healthy machine is known, or if too much is missing.
        """
        residual = self._separated(pair)
        if self._gains is None or residual is None:
            return None
        found, p = self._energies(residual, self._gains), self._two.parameters
        # The outer unit is driven by the inner race's component, and the other way round.
        inner = found.outer_unit / self._healthy.outer_unit - 1.0
        outer = found.inner_unit / self._healthy.inner_unit - 1.0
        if not max(inner, outer) > _LEAST_EXCESS:
            return Direction(("inner", "outer", "ball"), math.nan)
        least = _LEAST_EXCESS / 2.0
        inner_m2 = max(inner, least) * self._healthy.outer_unit * (p.m_r / p.k_s) ** 2
        outer_m2 = max(outer, least) * self._healthy.inner_unit * (p.m_h / p.k_c) ** 2
        ratio_db = 10.0 * math.log10(inner_m2 / outer_m2)
        race: Part = "inner" if ratio_db > 0.0 else "outer"
        if abs(ratio_db) >= _RACE_DB:
            return Direction((race,), ratio_db)
        return Direction(("ball",) if abs(ratio_db) <= _BALL_DB else (race, "ball"), ratio_db)

    def _separated(self, pair: Floats) -> Floats | None:
        """The residual of a window, complete rows only; None if there is none."""
        self._residual.reset()
        residual = self._residual.process(pair * self._two.m_s2_per_unit)
        residual = residual[np.isfinite(residual).all(axis=1)]
        return residual if len(residual) else None

    @staticmethod
    def _energies(residual: Floats, gains: SlidingGains) -> UnitEnergies:
        return UnitEnergies.of(SlidingPair(gains).process(residual))
