"""What an alarm watches: a measure against setpoints, or the decision of a detector."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarms.setpoints import SetpointMonitor
from daqsvc.alarms.states import Level
from daqsvc.errors.alarms import CANNOT_JUDGE
from daqsvc.errors.code import coded
from daqsvc.rounding import readable, unit_behind, with_unit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from collections.abc import Set as AbstractSet

    from daqsvc.alarms.events import AlarmEvent
    from daqsvc.alarms.setpoints import Limit, Setpoint
    from daqsvc.diagnosis.record import Diagnosis

log = logging.getLogger(__name__)

_LARGE_ODDS = 2.0
"""From so many decades on, odds are a power of ten: 10^6 to 1."""
SURE = 0.999
"""More digits than this no model of a machine deserves."""

UNDETERMINED = "undetermined"
"""The decision of a detector that cannot decide yet."""

DEPARTURE = "departure"
"""The decision of a detector that sees a change, but not yet of what."""

TOO_HIGH, TOO_LOW = "high", "low"
"""What is found of a measure that can be either."""

PHASE = "phase"
"""What is found where an amplitude is within its limits, and its phase is not."""

MACHINE_GROUP = "machine"
"""The first-out group of an alarm that names none: all alarms of the machine compete."""

MOST_FIGURES = 3
"""In the sentence of a statement that has nothing but figures."""

_IN_WORDS = {
    DEPARTURE: "a change, its cause not yet known",
    "changed": "a change, its cause not yet known",
    "unmodelled": "an unmodelled change",
    "small_change": "a small change",
    "inner": "damage of the inner race",
    "outer": "damage of the outer race",
    "ball": "damage of a rolling element",
    "inner_or_outer": "damage of the inner or outer race",
}
"""Decisions that are no names of a state."""


class RuleFinding(NamedTuple):
    """What a rule finds in a diagnosis.

    Attributes:
        level: the level by now.
        identity: what is found, where a level can have several causes, e.g. ``"F1L2"``.
        say: puts the finding into words. Few findings become an event; what is not asked for is not made.
        differs_by_words: whether other words, apart from figures, are another finding, too.
    """

    level: Level
    identity: str
    say: Callable[[], str]
    differs_by_words: bool = False

    @property
    def sentence(self) -> str:
        """The finding for a person, without the name of the alarm; to be asked before the next diagnosis."""
        return self.say()


class Circumstances(NamedTuple):
    """What else a judgement depends on.

    Attributes:
        starting: whether the machine starts up.
        not_ok: sensors that somebody states are not OK.
    """

    starting: bool = False
    not_ok: AbstractSet[str] = frozenset()


class Watch(Protocol):
    """The memory of one rule."""

    def find(self, diagnosis: Diagnosis, circumstances: Circumstances) -> RuleFinding | None:
        """What a good diagnosis states, or a partial one; None if nothing is new and everything holds."""
        ...

    def hold(self, diagnosis: Diagnosis) -> None:
        """A diagnosis was not good: what was known stays known."""
        ...

    def resume(self, level: Level, event: AlarmEvent) -> str:
        """Go on from before a restart.

        Args:
            level: the level that was active; normal if the condition was gone.
            event: the last event.

        Returns:
            `RuleFinding.identity` of what was active; empty if ``event`` does not have it.
        """
        ...


class Rule(Protocol):
    """What an alarm watches.

    Attributes:
        alarm: name of the alarm.
        latching: whether the alarm outlives its condition until it is reset.
        group: the first-out group that it competes in.
        detectors: the detectors whose diagnoses feed it.
        sensors: the sensors that it rests on before any diagnosis has named them.
        spare: how many of these may be not OK before the alarm is suppressed.
    """

    @property
    def alarm(self) -> str: ...  # noqa: D102  all six are described above
    @property
    def latching(self) -> bool: ...  # noqa: D102
    @property
    def group(self) -> str: ...  # noqa: D102
    @property
    def detectors(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def sensors(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def spare(self) -> int: ...  # noqa: D102

    def limits(self, units: Mapping[str, str]) -> str:
        """The limits that it judges by, in words; empty if it has none.

        Args:
            units: of measures that have one.
        """
        ...

    def watch(self) -> Watch:
        """A fresh memory for this rule."""
        ...


class Beside(NamedTuple):
    """A second measure of an alarm.

    Attributes:
        measure: key in `Diagnosis.statistics`.
        setpoint: the limits, in the unit of the measure.
    """

    measure: str
    setpoint: Setpoint


@dataclass(frozen=True, slots=True)
class LevelRule:
    """An alarm on a measure of one sensor, fed by the diagnoses of ``levels/<sensor>``.

    Attributes:
        alarm: name of the alarm.
        sensor: name of the sensor.
        measure: key in `Diagnosis.statistics`, e.g. ``"rms"``.
        setpoint: the limits, in the unit of the measure.
        latching: whether the alarm outlives its condition until it is reset.
        trip_multiply: factor on the limits while the machine starts up.
        group: the first-out group that it competes in.
        beside: another measure of the sensor with limits of its own: the phase of an amplitude. The level is
            that of the worse of the two; start-up does not multiply its limits.
        value_names: values of the measure that have a name, and that name: those of a state.
    """

    alarm: str
    sensor: str
    measure: str
    setpoint: Setpoint
    latching: bool = False
    trip_multiply: float = 1.0
    group: str = MACHINE_GROUP
    beside: Beside | None = None
    value_names: tuple[tuple[float, str], ...] = ()

    @property
    def detectors(self) -> tuple[str, ...]:
        """The detector whose diagnoses feed this rule."""
        return (f"levels/{self.sensor}",)

    @property
    def sensors(self) -> tuple[str, ...]:
        """The sensors that the rule rests on before any diagnosis has named them."""
        return (self.sensor,)

    @property
    def spare(self) -> int:
        """None: without its sensor the alarm is suppressed."""
        return 0

    def limits(self, units: Mapping[str, str]) -> str:
        """See `Rule.limits`."""
        limits = self.setpoint.in_words(units.get(self.measure, ""))
        if self.beside is None:
            return limits
        measure, setpoint = self.beside
        return f"{limits}, {measure} {setpoint.in_words(units.get(measure, ''))}"

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
        evidence_nats: what is found must have at least this evidence (`decision_evidence`), where the
            detector gives any; with less, everything holds. What is normal needs none.
        group: the first-out group that it competes in.
    """

    alarm: str
    detector: str
    latching: bool = False
    evidence_nats: float = 0.0
    group: str = MACHINE_GROUP

    @property
    def detectors(self) -> tuple[str, ...]:
        """The detector that the alarm follows."""
        return (self.detector,)

    @property
    def sensors(self) -> tuple[str, ...]:
        """None: the detector names its sensors in every diagnosis."""
        return ()

    @property
    def spare(self) -> int:
        """None: the detector needs all of its sensors."""
        return 0

    def limits(self, units: Mapping[str, str]) -> str:
        """None: the detector judges."""
        del units
        return ""

    def watch(self) -> Watch:
        """A fresh memory for this rule."""
        return _DecisionWatch(self)


def decision_evidence(diagnosis: Diagnosis) -> float | None:
    """The evidence for the decision, in nats; None if the detector states none.

    A detector that follows the lead of its decision over every other mode (``lead.M``) has the evidence of
    the narrowest lead over a mode outside the group. While it only knows that the mode has been left, the
    evidence against it (``cusum.M``, the most of the group). Any other states the evidence of each fault
    over none.
    """
    evidence, decision = diagnosis.evidence, diagnosis.decision
    among = {decision, *diagnosis.group}
    leads = {name.removeprefix("lead."): nats for name, nats in evidence.items() if name.startswith("lead.")}
    if leads and decision == DEPARTURE:
        values = [evidence[f"cusum.{mode}"] for mode in among if f"cusum.{mode}" in evidence]
        return _finite(max(values, default=math.nan))
    if leads:
        return _finite(min((nats for mode, nats in leads.items() if mode not in among), default=math.nan))
    return _finite(max((evidence[mode] for mode in among if mode in evidence), default=math.nan))


def _odds(nats: float) -> str:
    """The same as the odds on the finding, in parentheses; empty if there is no evidence for it."""
    decades = nats / math.log(10.0)
    if decades <= 0.0:
        return ""
    return f" ({math.exp(nats):.2g} to 1)" if decades < _LARGE_ODDS else f" (10^{decades:.0f} to 1)"


def _finite(nats: float) -> float | None:
    return nats if math.isfinite(nats) else None


class MeasureWatch:
    """A measure of one sensor against a setpoint; states once if its detector does not have the measure.

    Args:
        alarm: name of the alarm.
        measure: key in `Diagnosis.statistics`.
        setpoint: the limits.
        trip_multiply: factor on the limits while the machine starts up.
        value_names: names of values of the measure, if it is a state.
    """

    def __init__(
        self,
        alarm: str,
        measure: str,
        setpoint: Setpoint,
        trip_multiply: float,
        value_names: Iterable[tuple[float, str]] = (),
    ) -> None:
        self._alarm = alarm
        self._measure = measure
        self._trip_multiply = trip_multiply
        self._value_names = dict(value_names)
        self._reported_absent = False
        self._factor = 1.0
        self.monitor = SetpointMonitor(setpoint)
        self.setpoint = setpoint

    def find(self, diagnosis: Diagnosis, circumstances: Circumstances) -> tuple[Level, float] | None:
        """The level and the value; None, and everything holds, without the measure.

        Of a value of which only bounds are known: a level that has risen to where the value is for sure, with
        the bound that states it. None if it has not.
        """
        value = diagnosis.statistics.get(self._measure)
        factor = self._trip_multiply if circumstances.starting else 1.0
        if (bounds := diagnosis.bounds.get(self._measure)) is not None:
            before = self.monitor.level
            level = self.monitor.rise(*bounds, diagnosis.t_ns, factor)
            if level <= before:
                return None
            self._factor = factor
            return level, self._nearer(bounds)
        if value is not None:
            self._factor = factor
            value = self.setpoint.judged(value)
            return self.monitor.update(value, diagnosis.t_ns, self._factor), value
        self.monitor.hold()
        if not self._reported_absent:
            self._reported_absent = True
            log.error(
                "alarm %s cannot be judged: %s measures %s, not %r; correct the alarm's measure",
                self._alarm,
                diagnosis.detector,
                ", ".join(diagnosis.statistics) or "nothing",
                self._measure,
                extra=coded(CANNOT_JUDGE),
            )
        return None

    def sure(self, bounds: tuple[float, float]) -> tuple[Level, float]:
        """The level at which a value between bounds is for sure, and the bound that states it."""
        return self.monitor.sure(*bounds), self._nearer(bounds)

    def _nearer(self, bounds: tuple[float, float]) -> float:
        """The bound that is nearer to the machine in good order."""
        limit = self.monitor.reached(bounds[0])
        return bounds[limit is not None and limit.lower]

    def side(self, value: float) -> str:
        """Where the present level was reached, as an identity; empty if there is one side only."""
        limit = self.monitor.reached(value)
        if limit is None or self.setpoint.highest_low is None:
            return ""
        return TOO_LOW if limit.lower else TOO_HIGH

    def in_words(self, diagnosis: Diagnosis, sensor: str, value: float) -> str:
        """The value of ``sensor`` and the limit that makes the present level of it.

        Args:
            diagnosis: where it comes from.
            sensor: name of the sensor.
            value: as `find` gives it.
        """
        unit = unit_behind(diagnosis.units.get(self._measure, ""))
        limit = self.monitor.reached(value)
        named = f" ({name})" if (name := self._value_names.get(value)) else ""
        measured = f"{self._measure} of {sensor} is {readable(value)}{unit}{named}"
        if self._measure in diagnosis.bounds:
            most = "most" if limit is not None and limit.lower else "least"
            lacks = f"{readable(100.0 * (diagnosis.missing_share or 0.0), 2)} % of its samples are missing"
            measured = f"{self._measure} of {sensor} is at {most} {readable(value)}{unit} though {lacks}"
        elif self.setpoint.reference_deg is not None:
            phase, reference = diagnosis.statistics[self._measure], self.setpoint.reference_deg
            measured = (
                f"{self._measure} of {sensor} is {readable(phase)}{unit}, {readable(value)}{unit} from its "
                f"reference of {reference:g}{unit}"
            )
        if zone := self.setpoint.zone(value):
            measured += f", zone {zone} of ISO 20816-3"
        if limit is not None:
            side = "lower " if limit.lower else ""
            multiplied = f" times {self._factor:g} at start-up" if self._factor > 1.0 and not side else ""
            comparison = f"{measured}, {side}{limit.level.label} limit {readable(limit.at)}{unit}{multiplied}"
            return f"{comparison}{self._until_it_ends(limit, value, unit)}"
        low, high = self.setpoint.highest_low, self.setpoint.lowest
        if low is not None and high is not None:
            return f"{measured}, between its limits of {readable(low)} and {readable(high)}{unit}"
        if low is not None:
            return f"{measured}, above its limit of {readable(low)}{unit}"
        return measured if high is None else f"{measured}, below its limit of {readable(high)}{unit}"

    def _until_it_ends(self, limit: Limit, value: float, unit: str) -> str:
        """Why a level stands whose limit the value keeps by now; empty while it does not keep it."""
        inside = limit.at - value if not limit.lower else value - limit.at
        if inside <= 0.0 or self._factor > 1.0:
            return ""
        end = limit.at + (self.setpoint.deadband if limit.lower else -self.setpoint.deadband)
        side = "above" if limit.lower else "below"
        delay_s = self.setpoint.off_delay_ns / NS_PER_S
        lasting = f" for {delay_s:g} s" if delay_s else ""
        return f", which ends {side} {readable(end)}{unit}{lasting}"


class _LevelWatch:
    def __init__(self, rule: LevelRule) -> None:
        self._sensor = rule.sensor
        self._watch = MeasureWatch(
            rule.alarm, rule.measure, rule.setpoint, rule.trip_multiply, rule.value_names
        )
        self._beside = None if rule.beside is None else MeasureWatch(rule.alarm, *rule.beside, 1.0)

    def find(self, diagnosis: Diagnosis, circumstances: Circumstances) -> RuleFinding | None:
        finding = self._watch.find(diagnosis, circumstances)
        if self._beside is not None:
            return self._worse(finding, self._beside, diagnosis, circumstances)
        return None if finding is None else self._finding(diagnosis, *finding)

    def _finding(self, diagnosis: Diagnosis, level: Level, value: float) -> RuleFinding:
        return RuleFinding(
            level, self._watch.side(value), lambda: self._watch.in_words(diagnosis, self._sensor, value)
        )

    def _worse(
        self,
        finding: tuple[Level, float] | None,
        beside: MeasureWatch,
        diagnosis: Diagnosis,
        circumstances: Circumstances,
    ) -> RuleFinding | None:
        """What the worse of both measures states; None where that one is not known: it holds then."""
        other = beside.find(diagnosis, circumstances)
        level = max(self._watch.monitor.level, beside.monitor.level)
        if finding is not None and finding[0] is level:
            return self._finding(diagnosis, *finding)
        if other is None or other[0] is not level:
            return None
        return RuleFinding(level, PHASE, lambda: beside.in_words(diagnosis, self._sensor, other[1]))

    def hold(self, diagnosis: Diagnosis) -> None:  # noqa: ARG002  there is one sensor only
        self._watch.monitor.hold()
        if self._beside is not None:
            self._beside.monitor.hold()

    def resume(self, level: Level, event: AlarmEvent) -> str:
        if self._beside is not None and event.finding == PHASE:
            self._beside.monitor.resume(level)
            return event.finding
        sides = {TOO_LOW: True, TOO_HIGH: False}
        self._watch.monitor.resume(level, lower=sides.get(event.finding))
        return event.finding


class _DecisionWatch:
    def __init__(self, rule: DiagnosisRule) -> None:
        self._rule = rule
        self._group: tuple[str, ...] | None = None

    def find(self, diagnosis: Diagnosis, circumstances: Circumstances) -> RuleFinding | None:  # noqa: ARG002
        if diagnosis.decision == UNDETERMINED:
            return None
        level, evidence = Level.of(diagnosis.severity), decision_evidence(diagnosis)
        if level is not Level.NORMAL and evidence is not None and evidence < self._rule.evidence_nats:
            return None
        if diagnosis.changed or self._group is None:
            # A group may flicker with the evidence from statement to statement; only what the detector itself
            # calls a change makes another finding of it.
            self._group = diagnosis.group
        return RuleFinding(
            level,
            _identity(diagnosis.decision, self._group),
            lambda: self._sentence(diagnosis, evidence),
        )

    def hold(self, diagnosis: Diagnosis) -> None:
        """The detector itself holds its decision."""

    def resume(self, level: Level, event: AlarmEvent) -> str:  # noqa: ARG002  it has no memory of levels
        if event.finding:
            self._group = tuple(event.finding.split("|"))
        return event.finding

    @staticmethod
    def _sentence(diagnosis: Diagnosis, evidence: float | None) -> str:
        decision = diagnosis.decision
        sentence = f"{diagnosis.detector} finds {_IN_WORDS.get(decision, decision)}"
        if diagnosis.where:
            sentence += f" at {diagnosis.where}"
        probability = diagnosis.probabilities.get(decision, 0.0)
        if probability > 0.5:  # a smaller one states less than the words
            sentence += ", p > 0.999" if probability > SURE else f", p = {probability:.3f}"
        if evidence is not None:
            sentence += f", evidence {evidence:.3g} nats{_odds(evidence)}"
        others = [_IN_WORDS.get(mode, mode) for mode in diagnosis.group if mode not in decision.split("_or_")]
        if others:
            how = "possibly" if decision == DEPARTURE else "not told apart from"
            sentence += f", {how} {', '.join(others)}"
        return ", ".join([sentence, *_figures(diagnosis)])


def _figures(diagnosis: Diagnosis) -> Iterator[str]:
    """What was measured and its limits, of a statement that rests on nothing else."""
    if diagnosis.model or diagnosis.probabilities or diagnosis.evidence:
        return
    level = "danger" if diagnosis.severity == "danger" else "alert"
    limits = {name: diagnosis.thresholds.get(f"{name}.{level}") for name in diagnosis.statistics}
    limited = [name for name, limit in limits.items() if limit is not None]
    for name in (limited or list(limits))[:MOST_FIGURES]:
        unit, limit = diagnosis.units.get(name, ""), limits[name]
        yield f"{name} is {with_unit(diagnosis.statistics[name], unit)}"
        if limit is not None:
            yield f"{level} limit {with_unit(limit, unit)}"


def _identity(decision: str, group: tuple[str, ...]) -> str:
    """The decision with all that it cannot be told apart from; the name of a change represents its group."""
    if decision == DEPARTURE:
        return decision
    return "|".join([decision, *sorted(set(group) - {decision})])
