"""A bearing with an accelerometer on rotor and housing: detection and isolation, window by window."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from daqsvc.bearing.isolation import Isolation, IsolationRule
from daqsvc.bearing.likelihood import Detection, WhittleDetector
from daqsvc.bearing.model import BearingModel
from daqsvc.bearing.ratio_rule import RatioRule
from daqsvc.bearing.residual import CORNER_HZ, TwoSensorResidual
from daqsvc.bearing.sliding_mode import SlidingGains, SlidingPair, UnitEnergies

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from daqsvc.bearing.model import BearingParameters
    from daqsvc.bearing.ratio_rule import Race

UNITS_CORNER_PER_BALL_MODE = 0.25
"""Corner of the residual that drives the sliding units: below, the races look alike to them."""


@dataclass(frozen=True, slots=True)
class TwoSensorFinding:
    """What a window says.

    Attributes:
        verdict: ``"normal"`` if nothing is detected, else that of the isolation.
        group: parts that cannot be told apart, the verdict among them unless it is ``"inner_or_outer"``.
        detection: of a change in the total residual.
        isolation: which race, by the likelihood of its hits; None if nothing is detected.
        energies: of the sliding units.
        units: which race by the ratio of those energies, for corroboration; None if nothing is detected.
    """

    verdict: Race | Literal["normal", "inner_or_outer"]
    group: tuple[str, ...]
    detection: Detection
    isolation: Isolation | None
    energies: UnitEnergies
    units: Race | Literal["inner_or_outer"] | None


class TwoSensorMonitor:
    """Learns a healthy machine and judges windows of 0.5 s or so.

    Args:
        parameters: of the healthy bearing.
        rate_hz: sampling rate; both accelerometers must be flat to a good part of its half.
        y: ``[n, 2]``, healthy accelerations of rotor and housing in m/s^2, 2 s or more.
        v: ``[n]``, force of the known unbalance on the rotor in N; none if not given.
        mismatch: share by which each parameter may be wrong.
        false_alarm_rate: of detection, per window.

    Raises:
        ValueError: the healthy record is too short, or a figure out of range.
    """

    def __init__(
        self,
        parameters: BearingParameters,
        rate_hz: float,
        y: NDArray[np.floating],
        v: NDArray[np.floating] | None = None,
        *,
        mismatch: float = 0.1,
        false_alarm_rate: float = 0.003,
    ) -> None:
        self._total = TwoSensorResidual(parameters, rate_hz)
        healthy = self._total.process(y, v)
        self._detector = WhittleDetector(parameters, rate_hz, healthy, false_alarm_rate=false_alarm_rate)
        self._isolation = IsolationRule(parameters, rate_hz, healthy, mismatch=mismatch)
        ball_hz = BearingModel(parameters).modes_hz[2]
        corner_hz = min(max(UNITS_CORNER_PER_BALL_MODE * ball_hz, CORNER_HZ), 0.3 * rate_hz)
        self._drive = TwoSensorResidual(parameters, rate_hz, corner_hz=corner_hz)
        drive = self._drive.process(y, v)
        gains = SlidingGains.from_healthy(drive)
        self._units = SlidingPair(gains)
        self._ratio = RatioRule(parameters, UnitEnergies.of(SlidingPair(gains).process(drive)))
        self.reset()

    def take(self, y: NDArray[np.floating], v: NDArray[np.floating] | None = None) -> TwoSensorFinding:
        """Judge the next window; windows follow one another, or `reset` comes between.

        Args:
            y: ``[n, 2]``, accelerations in m/s^2; NaN where missing.
            v: ``[n]``, force of the known unbalance in N.

        Raises:
            ValueError: the window holds no stretch of residual that is long enough to judge.
        """
        residual = self._total.process(y, v)
        detection = self._detector.judge(residual)
        energies = UnitEnergies.of(self._units.process(self._drive.process(y, v)))
        if not detection.detected:
            return TwoSensorFinding("normal", ("normal",), detection, None, energies, None)
        isolation = self._isolation.judge(residual)
        units = self._ratio.judge(energies)
        return TwoSensorFinding(isolation.verdict, isolation.group, detection, isolation, energies, units)

    def reset(self) -> None:
        """Forget the samples, not the machine: the next window starts anew."""
        self._total.reset()
        self._drive.reset()
