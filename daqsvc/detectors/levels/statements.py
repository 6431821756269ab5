"""What is stated of a sensor's level: compared with its setpoints, and kept while the data is not good."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from daqsvc.diagnosis.record import Diagnosis
from daqsvc.dsp.phase import deviation_deg

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daqsvc.diagnosis.record import Severity
    from daqsvc.dsp.quality import Quality

NO_BOUNDS: Mapping[str, tuple[float, float]] = MappingProxyType({})
"""Of statistics that are all certain."""

_DECISIONS: tuple[Severity, ...] = ("normal", "alert", "danger")


_ZONE_NAMES = ("zone_b", "zone_c", "zone_d")


class Limits(NamedTuple):
    """Setpoints of one measure; None where there is none.

    Attributes:
        measure: key of the statistics.
        alert: upper setpoint, in the unit of the measure.
        danger: the same.
        alert_low: lower setpoint.
        danger_low: the same.
        reference_deg: a phase that the measure is compared with: its setpoints are how far it may be from it.
        zones: where zones B, C and D of a standard begin, in the unit of the measure.
    """

    measure: str
    alert: float | None
    danger: float | None
    alert_low: float | None = None
    danger_low: float | None = None
    reference_deg: float | None = None
    zones: tuple[float, float, float] | None = None

    def severity(self, low: float, high: float) -> Severity:
        """How bad a value is that lies between ``low`` and ``high``, at least: a limit is reached at it."""
        if self.reference_deg is not None:
            # Of a phase between bounds nothing is known.
            low = high = deviation_deg(low, self.reference_deg) if low == high else 0.0
        if _reached(low, high, self.danger, self.danger_low):
            return "danger"
        return "alert" if _reached(low, high, self.alert, self.alert_low) else "normal"

    @property
    def thresholds(self) -> dict[str, float]:
        """What there is, by names such as ``"rms.alert"``."""
        described = {
            "alert": self.alert,
            "danger": self.danger,
            "alert_low": self.alert_low,
            "danger_low": self.danger_low,
            "reference": self.reference_deg,
            **dict(zip(_ZONE_NAMES, self.zones or (), strict=False)),
        }
        return {f"{self.measure}.{name}": limit for name, limit in described.items() if limit is not None}


class Evidence(NamedTuple):
    """What a statement rests on.

    Attributes:
        first_index: first sample.
        end_index: one past the last one.
        t_ns: monotonic time of the last one.
    """

    first_index: int
    end_index: int
    t_ns: int


class LevelStatements:
    """States the levels of the sensors of one stream, as detector ``levels/<sensor>``.

    Args:
        machine: name of the machine.
        stream: name of the stream.
        model: name and version of what measures them.
    """

    def __init__(self, machine: str, stream: str, model: str) -> None:
        self._machine = machine
        self._stream = stream
        self._model = model
        self._decided: dict[str, Severity] = {}
        self._by_limits: dict[tuple[str, Limits], Severity] = {}

    def state(
        self,
        sensor: str,
        limits: Sequence[Limits],
        evidence: Evidence,
        statistics: Mapping[str, float],
        units: Mapping[str, str],
        quality: Quality = "good",
        reason: str = "",
        missing_share: float | None = None,
        bounds: Mapping[str, tuple[float, float]] = NO_BOUNDS,
        unknown: tuple[str, ...] = (),
    ) -> Diagnosis:
        """One statement about one sensor.

        Args:
            sensor: its name.
            limits: its setpoints.
            evidence: the samples that it rests on.
            statistics: what was measured.
            units: of the statistics that have one.
            quality: of the data.
            reason: why that is not good.
            missing_share: share of the samples that are missing; None if that is not what it is about.
            bounds: of the statistics that are uncertain by that, between what they lie; they may make the
                decision worse, never better.
            unknown: measures that are not known although the samples are there: what was found of them
                stands, and the others are judged as ever.
        """
        before = self._decided.get(sensor)
        severity = before or "normal"
        if quality == "good" or bounds:
            for limit in limits:
                if limit.measure not in unknown:
                    of_limit = limit.severity(*_span(limit.measure, statistics, bounds))
                    if limit.measure in bounds:
                        of_limit = max(
                            of_limit, self._by_limits.get((sensor, limit), "normal"), key=_DECISIONS.index
                        )
                    self._by_limits[sensor, limit] = of_limit
            each = (self._by_limits.get((sensor, limit), "normal") for limit in limits)
            worst: Severity = max(each, key=_DECISIONS.index, default="normal")
            better = _DECISIONS.index(worst) < _DECISIONS.index(severity)
            severity = severity if better and not bounds.keys() <= set(unknown) else worst
        if quality == "good" or severity != (before or "normal"):
            self._decided[sensor] = severity
        return Diagnosis(
            machine=self._machine,
            detector=f"levels/{sensor}",
            t_ns=evidence.t_ns,
            stream=self._stream,
            first_index=evidence.first_index,
            end_index=evidence.end_index,
            decision=self._decided.get(sensor, "undetermined"),
            changed=before not in {None, severity},
            severity=severity,
            statistics=statistics,
            units=units,
            thresholds={name: value for limit in limits for name, value in limit.thresholds.items()},
            quality=quality,
            reason=reason,
            sensors=(sensor,),
            model=self._model,
            missing_share=missing_share,
            bounds=bounds,
        )


def _span(
    measure: str, statistics: Mapping[str, float], bounds: Mapping[str, tuple[float, float]]
) -> tuple[float, float]:
    return bounds[measure] if measure in bounds else (statistics[measure], statistics[measure])


def _reached(low: float, high: float, upper: float | None, lower: float | None) -> bool:
    return (upper is not None and low >= upper) or (lower is not None and high <= lower)
