"""Which race by direction: accelerometers on rotor and housing, compared with the healthy machine.

The monitor of `daqsvc.bearing.two_sensors`, evaluation by evaluation: whether the residual holds more than
the healthy machine's, from which race its impacts come, and what the sliding units show.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from daqsvc.bearing.race.verdict import PARTS
from daqsvc.bearing.two_sensors import TwoSensorMonitor

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from daqsvc.bearing.identify import ChangeRules
    from daqsvc.bearing.race.verdict import Part
    from daqsvc.bearing.two_sensors import HealthyPair, PairModel

    Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Direction:
    """What two accelerometers show in an evaluation.

    Attributes:
        detected: whether the residual is not the healthy machine's.
        group: parts that the evidence leaves possible, the likeliest first; empty if there are no impacts.
        change_nats: logarithm of the likelihood ratio of a fault.
        limit_nats: from which it is detected.
        inner_nats: evidence of the impacts that are the inner race's.
        outer_nats: evidence of the impacts that are the outer race's.
        bursts: how much more the energy scatters than that of steady noise; NaN if nothing was suspected.
        ratio_db: energy of the inner race's displacement over the outer race's by the sliding units; NaN if
            neither stands out.
    """

    detected: bool
    group: tuple[Part, ...] = ()
    change_nats: float = math.nan
    limit_nats: float = math.nan
    inner_nats: float = 0.0
    outer_nats: float = 0.0
    bursts: float = math.nan
    ratio_db: float = math.nan

    @property
    def decides(self) -> bool:
        """Whether it leaves out any part."""
        return 0 < len(self.group) < len(PARTS)


@dataclass(frozen=True, slots=True)
class TwoSensors:
    """A bearing with an accelerometer on its rotor beside the one on its housing.

    Attributes:
        rotor: name of the one on the rotor.
        column: its column in the stream.
        model: of the bearing.
    """

    rotor: str
    column: int
    model: PairModel


class RaceDirection:
    """Detects a fault of one bearing, and names its race.

    Args:
        two: its accelerometers and masses.
        healthy: the healthy machine.
        rules: how sure a change must be, and how well the healthy machine repeats itself.

    Raises:
        ValueError: the healthy machine was learnt with other masses, springs or dampers.
    """

    def __init__(self, two: TwoSensors, healthy: HealthyPair, rules: ChangeRules) -> None:
        if healthy.parameters != two.model.parameters:
            raise ValueError(
                f"the healthy state of {two.rotor} was learnt with other masses, springs or dampers; "
                "calibrate again, or restore them"
            )
        self._m_s2_per_unit = two.model.m_s2_per_unit
        self._monitor = TwoSensorMonitor(
            healthy,
            mismatch=two.model.mismatch,
            false_alarm_rate=rules.false_alarm_probability,
            repeatability_db=rules.repeatability_db,
        )

    def judge(self, pair: Floats, *, suspected: bool = False) -> Direction | None:
        """Judge an evaluation.

        Args:
            pair: float64 ``[n, 2]``, rotor and housing in their units; NaN where missing.
            suspected: name the race even if nothing is detected: something else has found a fault.

        Returns:
            None if too much is missing to decide.
        """
        self._monitor.reset()
        try:
            evaluated = self._monitor.evaluate(pair * self._m_s2_per_unit, suspected=suspected)
        except ValueError:
            return None  # no stretch between the gaps is as long as a frame
        isolation = evaluated.isolation
        return Direction(
            detected=evaluated.detection.detected,
            group=() if isolation is None else isolation.group,
            change_nats=evaluated.detection.statistic,
            limit_nats=evaluated.detection.limit,
            inner_nats=0.0 if isolation is None else isolation.inner_nats,
            outer_nats=0.0 if isolation is None else isolation.outer_nats,
            bursts=evaluated.bursts,
            ratio_db=evaluated.ratio_db,
        )
