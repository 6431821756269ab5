"""The alarms of one machine: takes diagnoses, gives the events that follow from them."""

from __future__ import annotations

import uuid
from types import MappingProxyType
from typing import TYPE_CHECKING

from daqsvc.alarms.alarm import Alarm, Instant
from daqsvc.alarms.events import AlarmEvent, EventKind, Identity
from daqsvc.alarms.rules import DiagnosisRule, Finding, LevelRule, Watch
from daqsvc.alarms.states import AlarmState, Hold, Level

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from daqsvc.acquisition.clock import Clock
    from daqsvc.alarms.alarm import AlarmStatus
    from daqsvc.diagnosis.record import Diagnosis

__all__ = ["AlarmManager", "DiagnosisRule", "Identity", "LevelRule"]


class _Ruled:
    """An alarm with its rule, the rule's memory, and the sensors that it rests on."""

    def __init__(self, alarm: Alarm, rule: LevelRule | DiagnosisRule) -> None:
        self.alarm = alarm
        self.detector = rule.detector
        self.sensors = frozenset(rule.sensors)
        self.watch: Watch = rule.watch()


class AlarmManager:
    """Turns diagnoses into alarms, exactly one event per change.

    Besides the alarms of the rules there is one quality alarm per sensor, ``sensor-ok/<sensor>``: it is
    active while a statement about that sensor is missing samples or the sensor is not OK, and it says
    why. A statement that rests on several sensors cannot blame one of them; its quality alarm is
    ``detector-ok/<detector>``.

    - Not OK suppresses every alarm that rests on the sensor, until a good statement comes.
    - Missing holds every state. It never clears anything.

    Not thread-safe: one task takes the diagnoses of a machine in their order.

    Args:
        identity: whose alarms these are.
        rules: one per alarm.
        clock: for the wall-clock label of events and the time of people's actions.
        new_occurrence: gives an id that was never used before; a random UUID by default.

    Raises:
        ValueError: two rules of the same name, or a name that belongs to the quality alarms.
    """

    def __init__(
        self,
        identity: Identity,
        rules: Sequence[LevelRule | DiagnosisRule],
        clock: Clock,
        new_occurrence: Callable[[], str] = lambda: str(uuid.uuid4()),
    ) -> None:
        self._identity = identity
        self._clock = clock
        self._new_occurrence = new_occurrence
        self._ruled: list[_Ruled] = []
        self._alarms: dict[str, Alarm] = {}
        self._not_ok: dict[str, tuple[frozenset[str], str]] = {}
        # By quality alarm and detector: what is said against it. It returns when nobody doubts any more.
        self._doubts: dict[str, dict[str, Diagnosis]] = {}
        for rule in rules:
            if rule.alarm in self._alarms:
                raise ValueError(f"two alarms are named {rule.alarm!r}; give each its own name")
            if rule.alarm.startswith(("sensor-ok/", "detector-ok/")):
                raise ValueError(f"alarm name {rule.alarm!r} is taken by the sensor checks; choose another")
            self._ruled.append(_Ruled(self._add(rule.alarm, latching=rule.latching), rule))

    @property
    def alarms(self) -> Mapping[str, AlarmStatus]:
        """How every alarm stands by now, by name; a quality alarm appears when it is first raised."""
        return MappingProxyType({name: alarm.status for name, alarm in self._alarms.items()})

    def take(self, diagnosis: Diagnosis) -> list[AlarmEvent]:
        """Take in a diagnosis and return what changed, in order; often nothing.

        Raises:
            ValueError: the diagnosis is about another machine.
        """
        if diagnosis.machine != self._identity.machine:
            raise ValueError(
                f"a diagnosis of machine {diagnosis.machine!r} came to the alarms of "
                f"{self._identity.machine!r}"
            )
        at = self._instant(diagnosis.t_ns)
        return list(self._events(diagnosis, at))

    def resume(self, told: Iterable[AlarmEvent], speakers: Mapping[str, Sequence[str]]) -> list[AlarmEvent]:
        """Go on from where the alarms stood when the service ended; before the first diagnosis.

        Every alarm takes over its state, level and occurrence, and holds them until a good diagnosis
        comes, which continues the occurrence or returns it. A suppression holds until whoever asked for
        it says good. Delays begin anew.

        Args:
            told: the last event of each alarm.
            speakers: the detectors that will make statements, with the sensors that these rest on.

        Returns:
            The events by which alarms return to normal that nobody will judge any more: the machine file
            no longer has them, or not what a quality alarm is about.
        """
        for ruled in self._ruled:
            ruled.sensors = frozenset(speakers.get(ruled.detector, ruled.sensors))
        ruled_by_name = {ruled.alarm.name: ruled for ruled in self._ruled}
        quality = {_quality_alarm(detector, sensors)[0] for detector, sensors in speakers.items()}
        withdrawn: list[AlarmEvent] = []
        for event in told:
            ours = event.identity == self._identity
            if ours and event.alarm in ruled_by_name:
                self._resume_ruled(ruled_by_name[event.alarm], event)
            elif event.to_state is AlarmState.NORMAL:
                continue
            elif ours and event.alarm in quality:
                self._resume_quality(event, speakers)
            else:
                withdrawn.append(self._withdraw(event))
        for ruled in self._ruled:
            if ruled.alarm.is_held(Hold.SUPPRESSED) and self._not_ok_reason(ruled) is None:
                # Whoever found a sensor bad is gone; then the alarm's own detector must find it good.
                self._not_ok[ruled.detector] = (frozenset(), "a sensor was not OK before the restart")
        return withdrawn

    def acknowledge(self, alarm: str, by: str = "") -> AlarmEvent:
        """A person has seen the alarm.

        Raises:
            KeyError: no alarm of that name.
            RefusedError: the alarm's state does not allow it; the text is the reason.
        """
        return self._named(alarm).acknowledge(self._instant(self._clock.monotonic_ns()), by)

    def reset(self, alarm: str, by: str = "") -> AlarmEvent:
        """A person lets go of a latched alarm.

        Raises:
            KeyError: no alarm of that name.
            RefusedError: its condition stands, or there is nothing to reset; the text is the reason.
        """
        return self._named(alarm).reset(self._instant(self._clock.monotonic_ns()), by)

    def _events(self, diagnosis: Diagnosis, at: Instant) -> Iterator[AlarmEvent]:
        yield from self._quality(diagnosis, at)
        for ruled in self._ruled:
            # A statement without data changes nothing, not even what an alarm is known to rest on.
            if ruled.detector == diagnosis.detector and diagnosis.sensors and diagnosis.quality != "missing":
                ruled.sensors = frozenset(diagnosis.sensors)
        yield from self._suppression(diagnosis, at)
        for ruled in self._ruled:
            if ruled.detector != diagnosis.detector:
                continue
            if diagnosis.quality != "good" or ruled.alarm.is_held(Hold.SUPPRESSED):
                ruled.watch.hold()
                continue
            finding = ruled.watch.find(diagnosis)
            event = None if finding is None else ruled.alarm.apply(finding, diagnosis, at)
            if event is not None:
                yield event

    def _quality(self, diagnosis: Diagnosis, at: Instant) -> Iterator[AlarmEvent]:
        """Raise, change or return the quality alarm of what the diagnosis rests on."""
        name, subject = _quality_alarm(diagnosis.detector, diagnosis.sensors)
        doubts = self._doubts.setdefault(name, {})
        if diagnosis.quality == "good":
            doubts.pop(diagnosis.detector, None)
        else:
            doubts[diagnosis.detector] = diagnosis
        alarm = self._alarms.get(name)
        if doubts:
            alarm = alarm or self._add(name, latching=False)
            worst = min(doubts.values(), key=lambda doubt: doubt.quality != "not_ok")
            what = "cannot be judged" if worst.quality == "missing" else "not OK"
            because = f": {worst.reason}" if worst.reason else ""
            finding = Finding(Level.ALERT, worst.quality, f"{subject} {what}{because}")
        elif alarm is not None:
            finding = Finding(Level.NORMAL, "good", f"{subject} is good again")
        else:
            return
        event = alarm.apply(finding, diagnosis, at)
        if event is not None:
            yield event

    def _suppression(self, diagnosis: Diagnosis, at: Instant) -> Iterator[AlarmEvent]:
        """Suppress what rests on a sensor that is not OK, and lift that when it is good again."""
        if diagnosis.quality == "not_ok":
            self._blame(diagnosis)
        elif diagnosis.quality == "good":
            self._not_ok.pop(diagnosis.detector, None)
        for ruled in self._ruled:
            reason = self._not_ok_reason(ruled)
            if (reason is not None) == ruled.alarm.is_held(Hold.SUPPRESSED):
                continue
            if reason is not None:
                yield ruled.alarm.suppress(reason, diagnosis, at)
            else:
                yield ruled.alarm.unsuppress("its sensors are good again", diagnosis, at)

    def _not_ok_reason(self, ruled: _Ruled) -> str | None:
        """Why the alarm cannot speak: its own detector says so, or somebody blames one of its sensors."""
        for detector, (sensors, reason) in self._not_ok.items():
            if detector == ruled.detector or (len(sensors) == 1 and sensors <= ruled.sensors):
                return reason
        return None

    def _resume_ruled(self, ruled: _Ruled, event: AlarmEvent) -> None:
        level = event.to_level if event.own_state.is_active else Level.NORMAL
        found = ruled.watch.resume(level, event.cause)
        ruled.alarm.resume(event, found, self._since(event.wall_ns))

    def _resume_quality(self, event: AlarmEvent, speakers: Mapping[str, Sequence[str]]) -> None:
        cause = event.cause
        alarm = self._add(event.alarm, latching=False)
        alarm.resume(event, cause.quality, self._since(event.wall_ns))
        if event.own_state.is_active and cause.quality != "good" and cause.detector in speakers:
            self._doubts.setdefault(event.alarm, {})[cause.detector] = cause
            # What has changed to missing was not OK before, and nobody has said since that it is good.
            if cause.quality == "not_ok" or event.kind is EventKind.CHANGED:
                self._blame(cause)

    def _withdraw(self, event: AlarmEvent) -> AlarmEvent:
        alarm = Alarm(event.identity, event.alarm, latching=False, new_occurrence=self._new_occurrence)
        alarm.resume(event, "", self._since(event.wall_ns))
        now = self._instant(self._clock.monotonic_ns())
        return alarm.withdraw("the machine file no longer has it", event.cause, now)

    def _since(self, wall_ns: int) -> Instant:
        """An instant before the restart, by its label: the monotonic clock may have begun anew."""
        return Instant(self._clock.monotonic_ns() - self._clock.wall_ns() + wall_ns, wall_ns)

    def _blame(self, diagnosis: Diagnosis) -> None:
        """Remember who says what is not OK, and why."""
        reason = diagnosis.reason or "a sensor is not OK"
        self._not_ok[diagnosis.detector] = (frozenset(diagnosis.sensors), reason)

    def _add(self, name: str, *, latching: bool) -> Alarm:
        alarm = Alarm(self._identity, name, latching=latching, new_occurrence=self._new_occurrence)
        self._alarms[name] = alarm
        return alarm

    def _named(self, alarm: str) -> Alarm:
        try:
            return self._alarms[alarm]
        except KeyError:
            known = ", ".join(sorted(self._alarms)) or "none"
            raise KeyError(f"no alarm is named {alarm!r}; there are: {known}") from None

    def _instant(self, t_ns: int) -> Instant:
        """The wall-clock label of a monotonic time."""
        return Instant(t_ns, self._clock.wall_ns() - self._clock.monotonic_ns() + t_ns)


def _quality_alarm(detector: str, sensors: Sequence[str]) -> tuple[str, str]:
    """The quality alarm that a statement bears on, and what it is about."""
    if len(sensors) == 1:
        return f"sensor-ok/{sensors[0]}", sensors[0]
    return f"detector-ok/{detector}", detector
