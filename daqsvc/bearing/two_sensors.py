"""A bearing with an accelerometer on rotor and housing: detection and isolation, window by window."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from daqsvc.bearing.impact import STEADY, BurstMeter
from daqsvc.bearing.isolation import Isolation, IsolationRule, isolation_spectrum, short_lines
from daqsvc.bearing.likelihood import Detection, WhittleDetector, detection_spectrum
from daqsvc.bearing.model import BearingModel
from daqsvc.bearing.residual import CORNER_HZ, TwoSensorResidual
from daqsvc.bearing.sliding_mode import RatioRule, SlidingGains, SlidingPair, UnitEnergies

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from daqsvc.bearing.impact import HealthySpectrum
    from daqsvc.bearing.model import BearingParameters
    from daqsvc.bearing.sliding_mode import Race

UNITS_CORNER_PER_BALL_MODE = 0.25
"""Corner of the residual that drives the sliding units: below, the races look alike to them."""


@dataclass(frozen=True, slots=True)
class TwoSensorFinding:
    """What a window states.

    Attributes:
        verdict: ``"normal"`` if nothing is detected, ``"changed"`` if what is detected does not come in
            impacts, else that of the isolation.
        group: parts that cannot be told apart, the verdict among them unless it is ``"inner_or_outer"``.
        detection: of a change in the total residual.
        bursts: how much more the energy scatters than that of steady noise; NaN if nothing is detected.
        isolation: which race, by the likelihood of its impacts; None if there are none.
        energies: of the sliding units.
        ratio_db: of those energies, see `RatioRule.ratio_db`; NaN if nothing is detected.
        units: which race that ratio states, for corroboration; None if nothing is detected.
    """

    verdict: Race | Literal["normal", "changed", "inner_or_outer"]
    group: tuple[str, ...]
    detection: Detection
    bursts: float
    isolation: Isolation | None
    energies: UnitEnergies
    ratio_db: float
    units: Race | Literal["inner_or_outer"] | None


@dataclass(frozen=True, slots=True)
class PairModel:
    """What has to be known of a bearing with two accelerometers.

    Attributes:
        parameters: of the bearing.
        m_s2_per_unit: of the accelerometers on rotor and housing.
        mismatch: share by which each parameter may be wrong.
    """

    parameters: BearingParameters
    m_s2_per_unit: tuple[float, float] = (1.0, 1.0)
    mismatch: float = 0.1


@dataclass(frozen=True, slots=True)
class HealthyPair:
    """What two accelerometers show of a healthy machine; see `learn_pair`.

    Attributes:
        parameters: of the bearing, which the residual was made with.
        rate_hz: sampling rate.
        detection: spectrum that `WhittleDetector` compares with.
        isolation: spectrum that `IsolationRule` compares with.
        gains: of the sliding units.
        energies: of the sliding units.
    """

    parameters: BearingParameters
    rate_hz: float
    detection: HealthySpectrum
    isolation: HealthySpectrum
    gains: SlidingGains
    energies: UnitEnergies


def learn_pair(
    parameters: BearingParameters,
    rate_hz: float,
    y: NDArray[np.floating],
    v: NDArray[np.floating] | None = None,
) -> HealthyPair:
    """Learn a healthy machine.

    Args:
        parameters: of the healthy bearing.
        rate_hz: sampling rate; both accelerometers must be flat to a good part of its half.
        y: ``[n, 2]``, healthy accelerations of rotor and housing in m/s^2, 2 s or more; NaN where missing.
        v: ``[n]``, force of the known unbalance on the rotor in N; none if not given.

    Raises:
        ValueError: the record is too short, or an accelerometer is dead.
    """
    residual = TwoSensorResidual(parameters, rate_hz).process(y, v)
    drive = units_residual(parameters, rate_hz).process(y, v)
    gains = SlidingGains.from_healthy(drive)
    return HealthyPair(
        parameters=parameters,
        rate_hz=rate_hz,
        detection=detection_spectrum(residual, rate_hz),
        isolation=isolation_spectrum(residual, rate_hz),
        gains=gains,
        energies=UnitEnergies.of(SlidingPair(gains).process(drive)),
    )


def units_residual(parameters: BearingParameters, rate_hz: float) -> TwoSensorResidual:
    """The residual that drives the sliding units.

    Raises:
        ValueError: the rate is too low for the usual corner.
    """
    ball_hz = BearingModel(parameters).modes_hz[2]
    corner_hz = min(max(UNITS_CORNER_PER_BALL_MODE * ball_hz, CORNER_HZ), 0.3 * rate_hz)
    return TwoSensorResidual(parameters, rate_hz, corner_hz=corner_hz)


class TwoSensorMonitor:
    """Judges windows of half a second to a few seconds against the healthy machine.

    Args:
        healthy: the healthy machine.
        mismatch: share by which each parameter may be wrong.
        false_alarm_rate: of detection, per window.
        repeatability_db: standard deviation of the healthy machine's level from run to run.

    Raises:
        ValueError: an accelerometer was dead, or a figure is out of range.
    """

    def __init__(
        self,
        healthy: HealthyPair,
        *,
        mismatch: float = 0.1,
        false_alarm_rate: float = 0.003,
        repeatability_db: float = 0.0,
    ) -> None:
        parameters, rate_hz = healthy.parameters, healthy.rate_hz
        self._total = TwoSensorResidual(parameters, rate_hz)
        self._drive = units_residual(parameters, rate_hz)
        self._detector = WhittleDetector(
            parameters,
            rate_hz,
            healthy.detection,
            false_alarm_rate=false_alarm_rate,
            repeatability_db=repeatability_db,
        )
        self._isolation = IsolationRule(parameters, rate_hz, healthy.isolation, mismatch=mismatch)
        frame, _, kept = short_lines(rate_hz)
        self._bursts = BurstMeter(parameters, healthy.isolation, frame, kept)
        self._units = SlidingPair(healthy.gains)
        self._ratio = RatioRule(parameters, healthy.energies)
        self.reset()

    def evaluate(
        self, y: NDArray[np.floating], v: NDArray[np.floating] | None = None, *, suspected: bool = False
    ) -> TwoSensorFinding:
        """Judge the next window; windows follow one another, or `reset` comes between.

        Args:
            y: ``[n, 2]``, accelerations in m/s^2; NaN where missing.
            v: ``[n]``, force of the known unbalance in N.
            suspected: ask which race it is even if nothing is detected: something else has found a fault.

        Raises:
            ValueError: the window holds no stretch of residual that is long enough to judge.
        """
        residual = self._total.process(y, v)
        detection = self._detector.judge(residual)
        energies = UnitEnergies.of(self._units.process(self._drive.process(y, v)))
        if not (detection.detected or suspected):
            return TwoSensorFinding(
                "normal", ("normal",), detection, math.nan, None, energies, math.nan, None
            )
        bursts = self._bursts.measure(residual)
        if not bursts >= STEADY:
            verdict: Literal["normal", "changed"] = "changed" if detection.detected else "normal"
            return TwoSensorFinding(verdict, (verdict,), detection, bursts, None, energies, math.nan, None)
        isolation = self._isolation.judge(residual)
        return TwoSensorFinding(
            verdict=isolation.verdict,
            group=isolation.group,
            detection=detection,
            bursts=bursts,
            isolation=isolation,
            energies=energies,
            ratio_db=self._ratio.ratio_db(energies),
            units=self._ratio.judge(energies),
        )

    def reset(self) -> None:
        """Forget the samples, not the machine: the next window starts again."""
        self._total.reset()
        self._drive.reset()
