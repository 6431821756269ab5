"""What is known about a healthy machine, and which of its baselines holds at a speed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from daqsvc.rotor.synchronous.baseline import SPEED_TOLERANCE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daqsvc.rotor.calibration.run_up_fit import RunUpFit
    from daqsvc.rotor.laval import LavalRotor
    from daqsvc.rotor.synchronous.baseline import Calibration


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationRecord:
    """What is known about a healthy machine.

    Attributes:
        rotor: the rotor, as it was given or as the run-up shows it.
        steady: baselines, one for each speed.
        steady_sources: the recording that each baseline comes from.
        run_up: what a run-up showed, if there was one.
        run_up_source: the recording of it.
        written: label of the date, ISO 8601; empty if not known.
    """

    rotor: LavalRotor
    steady: tuple[Calibration, ...] = ()
    steady_sources: tuple[str, ...] = ()
    run_up: RunUpFit | None = None
    run_up_source: str = ""
    written: str = ""

    def at(self, speed_rpm: float | None = None) -> Calibration:
        """The baseline of a speed.

        Args:
            speed_rpm: shaft speed of either sign; may be left out if there is one baseline only.

        Raises:
            ValueError: there is none of that speed, or several and no speed was given.
        """
        if not self.steady:
            raise ValueError(
                "the calibration holds a run-up only and no steady baseline; calibrate again with a "
                "recording at the speed that is watched"
            )
        if speed_rpm is not None:
            return baseline_at(self.steady, speed_rpm)
        if len(self.steady) > 1:
            raise ValueError(
                f"the calibration holds baselines at {_speeds(self.steady)} rpm; say at which speed"
            )
        return self.steady[0]


def baseline_at(baselines: Sequence[Calibration], speed_rpm: float) -> Calibration:
    """The baseline that holds at a speed.

    Args:
        baselines: one or more.
        speed_rpm: shaft speed of either sign.

    Raises:
        ValueError: there is none within `SPEED_TOLERANCE` of it.
    """
    nearest = min(baselines, key=lambda one: abs(one.speed_rpm - abs(speed_rpm)))
    if abs(abs(speed_rpm) / nearest.speed_rpm - 1.0) > SPEED_TOLERANCE:
        raise ValueError(
            f"the calibration holds no baseline within {100.0 * SPEED_TOLERANCE:.0f} % of "
            f"{abs(speed_rpm):.1f} rpm, but at {_speeds(baselines)} rpm; calibrate at that speed"
        )
    return nearest


def _speeds(baselines: Sequence[Calibration]) -> str:
    return ", ".join(f"{baseline.speed_rpm:.1f}" for baseline in baselines)
