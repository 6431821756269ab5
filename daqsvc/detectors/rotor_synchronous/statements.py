"""What the watch of a calibrated rotor reports, as diagnoses: when, and in which words."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from daqsvc.diagnosis.record import Diagnosis
from daqsvc.rotor.synchronous.departure import threshold_for
from daqsvc.rotor.synchronous.severity import levels

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy as np
    from numpy.typing import NDArray

    from daqsvc.diagnosis.record import Severity
    from daqsvc.dsp.quality import Quality
    from daqsvc.dsp.quality.probes import RevolutionQuality
    from daqsvc.rotor.synchronous.baseline import Calibration
    from daqsvc.rotor.synchronous.signatures import Identification
    from daqsvc.rotor.synchronous.watch import WatchReport, WatchRules

    Complexes = NDArray[np.complex128]

MODEL = "laval-rotor-synchronous/1"

UNDETERMINED = "undetermined"
"""Decision while there is no baseline."""
DEPARTURE = "departure"
"""Decision while the machine has changed and the cause is not yet known."""

_STEADY_S = 1.0
"""How often a statement is made while nothing changes."""
_LARGE = 1.0
"""A change larger than this part of the healthy whirl is danger, whatever it is ..."""
_NO_LONGER_LARGE = 0.8
"""... until it is smaller than this part."""
_UNITS = {
    "speed": "rpm",
    "1x.amplitude": "um",
    "1x.phase": "deg",
    "mean.x": "um",
    "mean.y": "um",
    "noise": "um",
    "line.frequency": "Hz",
    "line.amplitude": "um",
    "departure": "nat",
    "departure.energy": "nat",
}
_SUFFIXES = {"_um": "um", "_deg": "deg"}
_DIRECTIONS = frozenset(("change_deg", "shift_deg"))
"""Figures of a level that are directions in the plane of the orbit."""


@dataclass(frozen=True, slots=True)
class Standing:
    """The state after a revolution.

    Attributes:
        report: the last report of the watch; None if there was none yet.
        calibration: the baseline; None while there is none.
        mean: complex128 ``[5]``, mean of the last few synchronous vectors in um; NaN if not known.
        speed_rpm: speed of the last revolution.
        revolutions: revolutions since the start.
        onset_index: absolute index of the sample that the change began with; None if there is none.
    """

    report: WatchReport | None
    calibration: Calibration | None
    mean: Complexes
    speed_rpm: float
    revolutions: int
    onset_index: int | None = None


class Stater:
    """Turns standings into diagnoses, at most one a revolution, and remembers what was stated.

    Args:
        machine: name of the machine.
        detector: name of the detector.
        stream: name of the stream.
        sensors: names of the sensors.
        clockwise: whether the vectors are mirrored in x.
        rate_hz: sampling rate.
        rules: thresholds of the watch.
    """

    def __init__(
        self,
        *,
        machine: str,
        detector: str,
        stream: str,
        sensors: tuple[str, ...],
        clockwise: bool,
        rate_hz: float,
        rules: WatchRules,
    ) -> None:
        self._machine = machine
        self._detector = detector
        self._stream = stream
        self._sensors = sensors
        self._clockwise = clockwise
        self._steady_samples = round(_STEADY_S * rate_hz)
        departure = threshold_for(rules.false_alarms_per_1000_rev)
        self._thresholds = {
            "departure": departure,
            "departure.energy": rules.energy_threshold_nats * departure / 20.0,
            "identity": rules.naming.margin_nats,
            "severity.name": rules.naming.least_severity,
            "severity.danger": _LARGE,
        }
        self._decision = UNDETERMINED
        self._group: tuple[str, ...] = ()
        self._large = False
        self._quality: Quality = "good"
        self._stated_index: int | None = None

    def maybe(
        self, standing: Standing, verdict: RevolutionQuality, end_index: int, t_ns: int
    ) -> Diagnosis | None:
        """The statement after a revolution, if there is something to state.

        Args:
            standing: the present state.
            verdict: what the last revolutions are worth.
            end_index: absolute index of the sample after the revolution.
            t_ns: monotonic time of the last sample of it.
        """
        report = standing.report
        decision, group = self._decided(standing)
        news = (
            (decision, set(group)) != (self._decision, set(self._group))
            or verdict.quality != self._quality
            or (report is not None and (report.departed or report.looked))
        )
        due = self._stated_index is None or end_index - self._stated_index >= self._steady_samples
        return self.state(standing, verdict, end_index, t_ns) if news or due else None

    def state(self, standing: Standing, verdict: RevolutionQuality, end_index: int, t_ns: int) -> Diagnosis:
        """The statement after a revolution; arguments as of `maybe`."""
        decision, group = self._decided(standing)
        changed = decision != self._decision or set(group) != set(self._group)
        first_index = standing.onset_index
        if first_index is None:
            first_index = end_index if self._stated_index is None else self._stated_index
        self._decision, self._group = decision, group
        identification = None if standing.report is None else standing.report.identification
        self._large = identification is not None and identification.severity > (
            _NO_LONGER_LARGE if self._large else _LARGE
        )
        self._quality, self._stated_index = verdict.quality, end_index
        return self._diagnosis(
            standing, verdict, first_index=min(first_index, end_index), end_index=end_index, t_ns=t_ns,
            changed=changed,
        )  # fmt: skip

    def silence(self, standing: Standing, verdict: RevolutionQuality, end_index: int, t_ns: int) -> Diagnosis:
        """A statement that holds what was stated last and changes nothing; arguments as of `maybe`."""
        return self._diagnosis(
            standing, verdict, first_index=end_index, end_index=end_index, t_ns=t_ns, changed=False
        )

    def _decided(self, standing: Standing) -> tuple[str, tuple[str, ...]]:
        """Decision and group by now."""
        report = standing.report
        if report is None or report.state == "calibrating":
            # A baseline that is sought again is no reason to forget what was found.
            return self._decision, self._group
        identification = report.identification
        if report.state == "watching":
            return "normal", ()
        if identification is None:
            return DEPARTURE, ()
        group = identification.group if len(identification.group) > 1 else ()
        if not identification.named:
            return DEPARTURE, identification.group
        if self._decision in group:
            return self._decision, group
        return identification.verdict, group

    def _severity(self) -> Severity:
        if self._decision in {UNDETERMINED, "normal"}:
            return "normal"
        return "danger" if self._large or self._decision == "rub" else "alert"

    def _diagnosis(
        self,
        standing: Standing,
        verdict: RevolutionQuality,
        *,
        first_index: int,
        end_index: int,
        t_ns: int,
        changed: bool,
    ) -> Diagnosis:
        report = standing.report
        identification = None if report is None else report.identification
        statistics = self._statistics(standing)
        return Diagnosis(
            machine=self._machine,
            detector=self._detector,
            t_ns=t_ns,
            stream=self._stream,
            first_index=first_index,
            end_index=end_index,
            decision=self._decision,
            changed=changed,
            severity=self._severity(),
            probabilities={}
            if identification is None
            else {str(k): p for k, p in identification.probabilities.items()},
            group=self._group,
            statistics=statistics,
            units=_units(statistics),
            thresholds=self._thresholds,
            evidence={}
            if identification is None
            else {str(k): nats for k, nats in identification.evidence.items()},
            revolutions=float(standing.revolutions),
            quality=verdict.quality,
            reason=verdict.reason,
            sensors=self._sensors,
            model=MODEL,
        )

    def _statistics(self, standing: Standing) -> dict[str, float]:
        report, calibration = standing.report, standing.calibration
        statistics = {"speed": standing.speed_rpm}
        if math.isfinite(standing.mean[1].real):
            centre, forward = (self._unmirrored(complex(part)) for part in standing.mean[:2])
            statistics |= {
                "1x.amplitude": abs(forward),
                "1x.phase": math.degrees(cmath.phase(forward)) % 360.0,
                "mean.x": centre.real,
                "mean.y": centre.imag,
            }
        if calibration is not None:
            statistics["noise"] = calibration.noise_um
            statistics["calibration.revolutions"] = float(calibration.revolutions)
        if report is not None and report.evidence is not None:
            statistics["departure"] = report.evidence.nats
            statistics["departure.energy"] = report.evidence.energy_nats
        if report is not None and report.identification is not None:
            statistics["severity"] = report.identification.severity
            if (line := report.identification.line) is not None:
                statistics |= line.figures()
            if calibration is not None and report.identification.named:
                statistics |= self._levels(report.identification, calibration)
        return statistics

    def _levels(self, identification: Identification, calibration: Calibration) -> dict[str, float]:
        """How large the fault is, for every member of the group: `levels`, angles as in `_unmirrored`."""
        figures = {}
        for fault, level in levels(identification, calibration).items():
            for name, value in level.items():
                mirrored = self._clockwise and name in _DIRECTIONS
                figures[f"{fault}.{name}"] = (180.0 - value) % 360.0 if mirrored else value
        return figures

    def _unmirrored(self, position: complex) -> complex:
        return -position.conjugate() if self._clockwise else position


def _units(statistics: Iterable[str]) -> dict[str, str]:
    """Unit of each statistic that has one: stated, or the end of its name."""
    units = {name: _UNITS.get(name, "") for name in statistics}
    for name in statistics:
        for suffix, unit in _SUFFIXES.items():
            if name.endswith(suffix):
                units[name] = unit
    return {name: unit for name, unit in units.items() if unit}
