"""Voting: one alarm on the same measure of several sensors, raised when enough of them agree.

A sensor that is missing samples or not OK has no vote: it counts for neither side. If it is beyond a limit
whatever the missing samples were, it votes for that limit; it never votes against one. A level is reached
when enough sensors vote for it. It is left when there would be too few votes even if every sensor without a
vote voted for it. Between the two it stays as it was. Sensors that drop out therefore neither raise the alarm
nor clear it, and the number of votes that it takes stays the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from daqsvc.alarms.rules import MACHINE_GROUP, MeasureWatch, RuleFinding
from daqsvc.alarms.states import Level

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.alarms.events import AlarmEvent
    from daqsvc.alarms.rules import Circumstances, Watch
    from daqsvc.alarms.setpoints import Setpoint
    from daqsvc.diagnosis.record import Diagnosis

_LEVELS = (Level.DANGER, Level.ALERT)


@dataclass(frozen=True, slots=True)
class VotingRule:
    """An alarm on a measure of several sensors, of which `vote` must agree.

    Attributes:
        alarm: name of the alarm.
        sensors: names of the sensors; each is judged against the setpoint by itself.
        vote: how many of them must have reached a level.
        measure: key in `Diagnosis.statistics`, e.g. ``"rms"``.
        setpoint: the limits, in the unit of the measure.
        latching: whether the alarm outlives its condition until it is reset.
        trip_multiply: factor on the limits while the machine starts up.
        group: the first-out group that it competes in.

    Raises:
        ValueError: a sensor has two votes, or the number of votes cannot be reached.
    """

    alarm: str
    sensors: tuple[str, ...]
    vote: int
    measure: str
    setpoint: Setpoint
    latching: bool = False
    trip_multiply: float = 1.0
    group: str = MACHINE_GROUP

    def __post_init__(self) -> None:
        if len(set(self.sensors)) < len(self.sensors):
            raise ValueError(f"alarm {self.alarm}: a sensor is listed twice in {', '.join(self.sensors)}")
        if not 1 <= self.vote <= len(self.sensors):
            raise ValueError(
                f"alarm {self.alarm}: {self.vote} votes of {len(self.sensors)} sensors cannot be; "
                f"ask for 1 to {len(self.sensors)}"
            )

    @property
    def detectors(self) -> tuple[str, ...]:
        """The detectors whose diagnoses feed this rule."""
        return tuple(f"levels/{sensor}" for sensor in self.sensors)

    @property
    def spare(self) -> int:
        """How many sensors may be not OK before a vote cannot be reached."""
        return len(self.sensors) - self.vote

    def limits(self, units: Mapping[str, str]) -> str:
        """See `Rule.limits`."""
        return self.setpoint.in_words(units.get(self.measure, ""))

    def watch(self) -> Watch:
        """A fresh memory for this rule."""
        return _VotingWatch(self)


class _VotingWatch:
    def __init__(self, rule: VotingRule) -> None:
        self._rule = rule
        self._sensor_of = dict(zip(rule.detectors, rule.sensors, strict=True))
        self._watches = {
            sensor: MeasureWatch(rule.alarm, rule.measure, rule.setpoint, rule.trip_multiply)
            for sensor in rule.sensors
        }
        self._votes: dict[str, Level] = {}
        self._at_least: dict[str, Level] = {}
        self._level = Level.NORMAL

    def find(self, diagnosis: Diagnosis, circumstances: Circumstances) -> RuleFinding | None:
        sensor = self._sensor_of[diagnosis.detector]
        watch = self._watches[sensor]
        finding = watch.find(diagnosis, circumstances)
        self._votes.pop(sensor, None)
        self._at_least.pop(sensor, None)
        bounds = diagnosis.bounds.get(self._rule.measure)
        if bounds is not None:
            finding = watch.sure(bounds)
        if finding is None:
            return None
        vote, value = finding
        if bounds is None:
            self._votes[sensor] = vote
        else:
            self._at_least[sensor] = vote
        valid = {name: level for name, level in self._votes.items() if name not in circumstances.not_ok}
        sure_of = {name: level for name, level in self._at_least.items() if name not in circumstances.not_ok}
        silent = len(self._rule.sensors) - len(valid)
        level = self._level
        for reached in _LEVELS:
            votes = sum(level >= reached for level in valid.values())
            # A sensor that lacks samples may add its vote, but not state that it has none.
            if votes + sum(level >= reached for level in sure_of.values()) >= self._rule.vote:
                level = max(level, reached)
            elif votes + silent < self._rule.vote and level >= reached:
                level = Level(reached - 1)
        if bounds is not None and level <= self._level:
            return None
        self._level = level
        known = valid | sure_of
        return RuleFinding(level, "", lambda: self._sentence(watch.in_words(diagnosis, sensor, value), known))

    def hold(self, diagnosis: Diagnosis) -> None:
        sensor = self._sensor_of[diagnosis.detector]
        self._watches[sensor].monitor.hold()
        self._votes.pop(sensor, None)
        self._at_least.pop(sensor, None)

    def resume(self, level: Level, event: AlarmEvent) -> str:  # noqa: ARG002  a level has one cause only
        self._level = level
        for watch in self._watches.values():
            # Which sensors had reached it is not known: each counts until it is below the deadband.
            watch.monitor.resume(level)
        return ""

    def _sentence(self, last: str, valid: dict[str, Level]) -> str:
        """Who votes for what, and the value that made the difference."""
        agreed = sorted(name for name, level in valid.items() if level > Level.NORMAL)
        silent = sorted(set(self._rule.sensors) - set(valid))
        sentence = f"{len(agreed)} of {len(self._rule.sensors)} sensors are at a limit"
        sentence += f" ({', '.join(agreed)})" if agreed else ""
        sentence += f", it takes {self._rule.vote}; {last}"
        return sentence + (f"; no vote from {', '.join(silent)}" if silent else "")
