"""What an alarm watches: a measure against setpoints, or the decision of a detector."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

from daqsvc.alarms.setpoints import SetpointMonitor
from daqsvc.alarms.states import Level

if TYPE_CHECKING:
    from daqsvc.alarms.setpoints import Setpoint
    from daqsvc.diagnosis.record import Diagnosis

log = logging.getLogger(__name__)

SURE = 0.999
"""More digits than this no model of a machine deserves."""

UNDETERMINED = "undetermined"
"""The decision of a detector that cannot say yet."""

DEPARTURE = "departure"
"""The decision of a detector that sees a change, but not yet of what."""

_IN_WORDS = {
    DEPARTURE: "a change, its cause not yet known",
    "unmodelled": "an unmodelled change",
    "small_change": "a small change",
}
"""Decisions that are no names of a state."""


class Finding(NamedTuple):
    """What a rule makes of a diagnosis.

    Attributes:
        level: the level by now.
        identity: what is found, where a level can have several causes, e.g. ``"F1L2"``.
        sentence: the finding for a person, without the name of the alarm.
    """

    level: Level
    identity: str
    sentence: str


class Watch(Protocol):
    """The memory of one rule."""

    def find(self, diagnosis: Diagnosis) -> Finding | None:
        """What a good diagnosis says; None if it says nothing new and everything holds."""
        ...

    def hold(self) -> None:
        """A diagnosis was not good: what was known stays known."""
        ...

    def resume(self, level: Level, cause: Diagnosis) -> str:
        """Go on from before a restart.

        Args:
            level: the level that stood; normal if the condition was gone.
            cause: the diagnosis behind the last event.

        Returns:
            `Finding.identity` of what stood; empty if ``cause`` does not tell.
        """
        ...


@dataclass(frozen=True, slots=True)
class LevelRule:
    """An alarm on a measure of one sensor, fed by the diagnoses of ``levels/<sensor>``.

    Attributes:
        alarm: name of the alarm.
        sensor: name of the sensor.
        measure: key in `Diagnosis.statistics`, e.g. ``"rms"``.
        setpoint: the limits, in the unit of the measure.
        latching: whether the alarm outlives its condition until it is reset.
    """

    alarm: str
    sensor: str
    measure: str
    setpoint: Setpoint
    latching: bool = False

    @property
    def detector(self) -> str:
        """The detector whose diagnoses feed this rule."""
        return f"levels/{self.sensor}"

    @property
    def sensors(self) -> tuple[str, ...]:
        """The sensors that the rule rests on before any diagnosis has named them."""
        return (self.sensor,)

    def watch(self) -> Watch:
        """A fresh memory for this rule."""
        return _LevelWatch(self)


@dataclass(frozen=True, slots=True)
class DiagnosisRule:
    """An alarm on the decision of a detector: one alarm, refined as the decision changes.

    Attributes:
        alarm: name of the alarm.
        detector: name of the detector; the level is the severity of its decision.
        latching: whether the alarm outlives its condition until it is reset.
    """

    alarm: str
    detector: str
    latching: bool = False

    @property
    def sensors(self) -> tuple[str, ...]:
        """None: the detector names its sensors in every diagnosis."""
        return ()

    def watch(self) -> Watch:
        """A fresh memory for this rule."""
        return _DecisionWatch(self)


class _LevelWatch:
    def __init__(self, rule: LevelRule) -> None:
        self._rule = rule
        self._monitor = SetpointMonitor(rule.setpoint)
        self._reported_absent = False

    def find(self, diagnosis: Diagnosis) -> Finding | None:
        rule = self._rule
        value = diagnosis.statistics.get(rule.measure)
        if value is None:
            self._monitor.hold()
            if not self._reported_absent:
                self._reported_absent = True
                log.error(
                    "alarm %s cannot be judged: %s measures %s, not %r; correct the alarm's measure",
                    rule.alarm,
                    diagnosis.detector,
                    ", ".join(diagnosis.statistics) or "nothing",
                    rule.measure,
                )
            return None
        level = self._monitor.update(value, diagnosis.t_ns)
        return Finding(level, "", self._sentence(diagnosis, value, level))

    def hold(self) -> None:
        self._monitor.hold()

    def resume(self, level: Level, cause: Diagnosis) -> str:  # noqa: ARG002  a level has one cause only
        self._monitor.resume(level)
        return ""

    def _sentence(self, diagnosis: Diagnosis, value: float, level: Level) -> str:
        rule = self._rule
        unit = f" {diagnosis.units[rule.measure]}" if rule.measure in diagnosis.units else ""
        measured = f"{rule.measure} of {rule.sensor} is {value:.4g}{unit}"
        limit = rule.setpoint.limit(level)
        if limit is not None:
            return f"{measured}, {level.label} limit {limit:.4g}{unit}"
        lowest = rule.setpoint.alert if rule.setpoint.alert is not None else rule.setpoint.danger
        return f"{measured}, below its limit of {lowest:.4g}{unit}"


class _DecisionWatch:
    def __init__(self, rule: DiagnosisRule) -> None:
        self._detector = rule.detector
        self._group: tuple[str, ...] | None = None

    def find(self, diagnosis: Diagnosis) -> Finding | None:
        if diagnosis.decision == UNDETERMINED:
            return None
        if diagnosis.changed or self._group is None:
            # A group may flicker with the evidence from statement to statement; only what the detector itself
            # calls a change makes another finding of it.
            self._group = diagnosis.group
        identity = _identity(diagnosis.decision, self._group)
        return Finding(Level.of(diagnosis.severity), identity, self._sentence(diagnosis))

    def hold(self) -> None:
        """The detector itself holds its decision."""

    def resume(self, level: Level, cause: Diagnosis) -> str:  # noqa: ARG002  it has no memory of levels
        if cause.detector != self._detector:
            return ""
        self._group = cause.group
        return _identity(cause.decision, cause.group)

    @staticmethod
    def _sentence(diagnosis: Diagnosis) -> str:
        decision = diagnosis.decision
        sentence = f"{diagnosis.detector} finds {_IN_WORDS.get(decision, decision)}"
        probability = diagnosis.probabilities.get(decision, 0.0)
        if probability > 0.5:  # a smaller one says less than the words
            sentence += ", p > 0.999" if probability > SURE else f", p = {probability:.3f}"
        others = [mode for mode in diagnosis.group if mode != decision]
        if others:
            how = "possibly" if decision == DEPARTURE else "not told apart from"
            sentence += f", {how} {', '.join(others)}"
        return sentence


def _identity(decision: str, group: tuple[str, ...]) -> str:
    """What is found, with what it is not told apart from; what a change may be is settled by its name."""
    if decision == DEPARTURE:
        return decision
    return "|".join([decision, *sorted(set(group) - {decision})])
