"""The alarms of one machine: takes diagnoses and commands, gives the events that follow from them."""

from __future__ import annotations

import uuid
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from difflib import get_close_matches
from types import MappingProxyType
from typing import TYPE_CHECKING

from daqsvc.alarms.alarm import Alarm
from daqsvc.alarms.commands import Verb
from daqsvc.alarms.conditions import (
    ALARM_FLOOD,
    RESERVED,
    TRIP_MULTIPLY,
    is_condition,
    no_statement,
    statement,
    unjudged,
)
from daqsvc.alarms.events import AlarmEvent, Doubt, EventKind, Identity
from daqsvc.alarms.expected import Expected
from daqsvc.alarms.flood import FirstOut, FloodWatch, where_to_look
from daqsvc.alarms.handling import CALM, AlarmCounters, ShelvingEnds, shelving_ns
from daqsvc.alarms.quality import PREFIXES, SensorHealth, in_words
from daqsvc.alarms.ruled import Ruled, RuledAlarms
from daqsvc.alarms.rules import Circumstances, DiagnosisRule, LevelRule, RuleFinding
from daqsvc.alarms.start_up import StartUpSignal
from daqsvc.alarms.states import AlarmState, CommandNotAllowedError, Hold, Level, UnknownAlarmError
from daqsvc.alarms.status import ClockReading, HandlingRequest

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

    from daqsvc.acquisition.clock import Clock
    from daqsvc.alarms.commands import AlarmCommand
    from daqsvc.alarms.quality import Lacking
    from daqsvc.alarms.rules import Rule
    from daqsvc.alarms.status import AlarmStatus
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.settings.alarms import AlarmHandling

__all__ = ["AlarmManager", "DiagnosisRule", "Identity", "LevelRule"]

MOST_NAMED = 20
"""Alarms that a refusal still lists by name."""


class AlarmManager:
    """Turns diagnoses into alarms, exactly one event per change.

    Besides the alarms of the rules there is one quality alarm per sensor, ``sensor-ok/<sensor>``: It is
    active, with the reason, while a statement about that sensor lacks samples or the sensor is not OK. A
    statement that rests on several sensors cannot blame one of them; its quality alarm is
    ``detector-ok/<detector>``.

    - Not OK suppresses every alarm that rests on the sensor, until a good statement comes.
    - Missing holds every state. It never clears anything. Where a statement states between what bounds its
      values lie all the same, they may raise an alarm.
    - Shelved and out of service cover an alarm. Its state still changes behind the cover, with events.

    Not thread-safe: one task takes the diagnoses of a machine in their order.

    Args:
        identity: whose alarms these are.
        rules: one per alarm.
        clock: for the wall-clock label of events, the time of people's actions and the end of shelving.
        new_occurrence: gives an id that was never used before; a random UUID by default.
        handling: what holds for all alarms.

    Raises:
        ValueError: two rules of the same name, or a name that belongs to quality alarms or the service.
    """

    def __init__(
        self,
        identity: Identity,
        rules: Sequence[Rule],
        clock: Clock,
        new_occurrence: Callable[[], str] = lambda: str(uuid.uuid4()),
        handling: AlarmHandling = CALM,
    ) -> None:
        self.counters = AlarmCounters()
        self._identity = identity
        self._clock = clock
        self._new_occurrence = new_occurrence
        self._handling = handling
        self._expected = Expected(self._handling)
        self._ruled = RuledAlarms()
        self._alarms: dict[str, Alarm] = {}
        self._shown: Counter[AlarmState] = Counter()
        self._shelving_ends = ShelvingEnds()
        self._restarted = True
        self._unlooked = False
        """Whether no diagnosis has come since `resume`: what was doubted before may silence any alarm."""
        self._conditions: set[str] = set()
        self._doubts = SensorHealth()
        self._waiting: dict[str, Diagnosis] = {}
        """By quality alarm, the statement whose reason is still to be published: see `Alarm.waits`."""
        self._start_up = StartUpSignal(self._handling.start_up)
        self._flood = FloodWatch(self._handling)
        self._first_out = FirstOut({rule.alarm: rule.group for rule in rules})
        for rule in rules:
            if rule.alarm in self._alarms:
                raise ValueError(f"two alarms are named {rule.alarm!r}; give each its own name")
            if rule.alarm.startswith(PREFIXES):
                raise ValueError(f"alarm name {rule.alarm!r} is taken by the sensor checks; choose another")
            if rule.alarm in RESERVED:
                raise ValueError(f"alarm name {rule.alarm!r} is taken by the service; choose another")
            self._ruled.add(self._add(rule.alarm, latching=rule.latching), rule)

    @property
    def identity(self) -> Identity:
        """Whose alarms these are."""
        return self._identity

    def knows(self, name: str) -> bool:
        """Whether there is an alarm of that name, or can be."""
        return name in self._alarms or name in self._expected.names

    @property
    def alarms(self) -> Mapping[str, AlarmStatus]:
        """The state of every alarm at any time, by name.

        A quality alarm or a condition of the service appears when it is first raised, or acted on.
        """
        return _Statuses(self._alarms, self._first_out)

    @property
    def shown(self) -> Mapping[AlarmState, int]:
        """How many alarms consumers see in each state but normal by now."""
        return MappingProxyType(self._shown)

    @property
    def conditions(self) -> frozenset[str]:
        """The conditions of the service that were ever raised or acted on, also before a restart."""
        return frozenset(self._conditions)

    @property
    def multiplies(self) -> bool:
        """Whether the machine starts up, and limits are multiplied."""
        return self._start_up.multiplies(self._clock.monotonic_ns())

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
        return self._tell(self._events(diagnosis, self._instant(diagnosis.t_ns)))

    def tick(self) -> list[AlarmEvent]:
        """What time alone brings: shelving ends, a flood ends, a start-up has lasted too long.

        Call it about once a second. Missing data brings nothing: alarms wait for the next good statement.
        """
        return self._tell(self._timed(self._now()))

    def condition(self, name: str, level: Level, sentence: str) -> list[AlarmEvent]:
        """A condition of the service itself is active at ``level``; an event only if that is new.

        Report it again at each evaluation, also when it is normal: until then a restart leaves it as it was.

        Args:
            name: of the condition, e.g. ``"certificate/client"``.
            level: how bad it is.
            sentence: why, in words for a person.

        Raises:
            ValueError: the name belongs to an alarm.
        """
        return self._tell(self._stand(name, level, sentence, self._now()))

    def execute(self, command: AlarmCommand) -> list[AlarmEvent]:
        """Do what a person asks.

        Raises:
            CommandNotAllowedError: there is none, or its state does not allow it; the text states why.
        """
        try:
            alarm = self._named(command.alarm)
            event = self._obeyed(command, alarm)
        except CommandNotAllowedError:
            self.counters.refused += 1
            raise
        self._alarms[alarm.name] = alarm
        self._conditions.update({alarm.name} & self._expected.conditions)
        if command.verb is Verb.SHELVE:
            self._await_end_of_shelving(alarm)
        self.counters.commands += 1
        return self._tell([event])

    def refusal(self, command: AlarmCommand) -> CommandNotAllowedError | None:
        """Why `execute` would refuse a command now; None if it would not. Nothing changes by asking."""
        try:
            self._obeyed(command, self._named(command.alarm).twin())
        except CommandNotAllowedError as refusal:
            return refusal
        return None

    def resume(
        self,
        events: Iterable[AlarmEvent],
        active_detectors: Mapping[str, Sequence[str]],
        conditions: Iterable[str] = (),
        *,
        restarted: bool = True,
    ) -> list[AlarmEvent]:
        """Go on from the states of the alarms when the service ended; before the first diagnosis.

        Every alarm takes over its state, level, occurrence and holds, and holds them until a good diagnosis
        comes, which continues the occurrence or returns it. A suppression holds until whoever asked for
        it states good. Shelving goes on by the wall clock, but not for longer than was left. Delays begin
        again.

        Args:
            events: the last event of each alarm, in the order in which they were published.
            active_detectors: the detectors that will make statements, with the sensors that these rest on.
            conditions: names of what the service will report about itself by `condition`.
            restarted: whether that may have been long ago; False in a replay, where it was just now.

        Returns:
            The events by which alarms return to normal that are not judged any more: the machine file
            no longer has them, or not what a quality alarm is about.
        """
        events = list(events)
        self._restarted = restarted
        self._expected.note(active_detectors, conditions)
        for ruled in self._ruled:
            named = {sensor for d in ruled.rule.detectors for sensor in active_detectors.get(d, ())}
            self._ruled.rest(ruled, frozenset(named) or ruled.sensors)
        self._first_out.resume(event for event in events if event.identity == self._identity)
        withdrawn = [self._withdraw(event) for event in events if not self._resumed(event, active_detectors)]
        self._excuse(events)
        self._unlooked = True
        for ruled in self._ruled:
            if (
                ruled.alarm.is_held(Hold.SUPPRESSED)
                and self._doubts.silences(ruled.rule, ruled.sensors) is None
            ):
                self._doubts.unsettle(ruled.rule)
        return withdrawn

    def remember(self, lacking: Mapping[str, Lacking]) -> None:
        """Have quality alarms return when they would without a break, by the same clock; after `resume`.

        Args:
            lacking: by detector what it had lacked until now.
        """
        self._doubts.remember(lacking)

    def follow(self, before: AlarmManager) -> list[AlarmEvent]:
        """Report of each alarm that stands if its limits are others than they were; after `resume`.

        The message when it was raised names the limit of then, and would mislead whoever reads it now.

        Args:
            before: the alarms of the same machine until now.
        """
        events = []
        for ruled in self._ruled:
            was, alarm = before._ruled.named(ruled.alarm.name), ruled.alarm
            if was is None or alarm.status.own_state is AlarmState.NORMAL:
                continue
            limits = ruled.rule.limits(alarm.units)
            if limits != was.rule.limits(alarm.units):
                events.append(alarm.change_limits(limits, was.alarm.found, self._now()))
        return self._tell(events)

    def withdraw(self, events: Iterable[AlarmEvent]) -> list[AlarmEvent]:
        """Return alarms of any machine to normal that are not judged any more.

        Args:
            events: the last event of each.
        """
        return [self._withdraw(event) for event in events if _stands(event)]

    def expect_conditions(self, conditions: Iterable[str]) -> None:
        """Let people act on these conditions of the service before they are reported."""
        self._expected.note({}, conditions)

    def begin_anew(self, events: Iterable[AlarmEvent], reason: str) -> list[AlarmEvent]:
        """Report every alarm that the journal does not know as normal; after `resume`.

        Args:
            events: what the journal knows, as of `resume`.
            reason: why the journal does not know more.
        """
        known = {event.alarm for event in events if event.identity == self._identity}
        names = [*(ruled.alarm.name for ruled in self._ruled), *sorted(self._expected.names)]
        now = self._now()
        cause = no_statement(self._identity.machine, now)
        return [
            Alarm(self._identity, name, latching=False, new_occurrence=self._new_occurrence).withdraw(
                reason, cause, now
            )
            for name in names
            if name not in known
        ]

    def _tell(self, events: Iterable[AlarmEvent]) -> list[AlarmEvent]:
        """Mark and count events as they come about, and report if they are a flood."""
        marked = [self._marked(event) for event in events]
        now = self._now()
        sentence = self._flood.sentence(now.t_ns, self._advice)
        if sentence is not None:
            level = Level.ALERT if self._flood.flooding else Level.NORMAL
            marked += [self._marked(event) for event in self._stand(ALARM_FLOOD, level, sentence, now)]
            self.counters.floods = self._flood.floods
        return marked

    def _advice(self) -> str:
        """Where a person is to look first in a flood."""
        # One that has returned keeps its mark until it is acknowledged, and would mislead.
        marked = self._first_out.marked()
        first = [name for name in marked if self._alarms[name].status.own_state.is_active]
        return where_to_look(first, self._doubts.unjudged_streams)

    def _marked(self, event: AlarmEvent) -> AlarmEvent:
        self.counters.events += 1
        self.counters.chattering += event.kind is EventKind.CHATTERING
        if event.calls and event.alarm != ALARM_FLOOD:
            self.counters.annunciations += 1
            self._flood.called(self._clock.monotonic_ns())
        self._count(event.from_state, event.to_state)
        return replace(event, first_out=True) if self._first_out.marks(event) else event

    def _count(self, before: AlarmState, now: AlarmState) -> None:
        if before is not AlarmState.NORMAL:
            self._shown[before] -= 1
        if now is not AlarmState.NORMAL:
            self._shown[now] += 1

    def _events(self, diagnosis: Diagnosis, at: ClockReading) -> Iterator[AlarmEvent]:
        self._start_up.note(diagnosis)
        touched = self._doubts.update(diagnosis, self._clock.monotonic_ns())
        yield from self._quality(touched.alarms, diagnosis, at)
        followers = self._ruled.fed_by(diagnosis.detector)
        for ruled in followers:
            # A statement without data changes nothing, not even what an alarm is known to rest on.
            if not ruled.rule.sensors and diagnosis.sensors and diagnosis.quality != "missing":
                self._ruled.rest(ruled, frozenset(diagnosis.sensors))
        yield from self._suppression(touched.sensors, diagnosis, at)
        circumstances = Circumstances(self._start_up.multiplies(at.t_ns), self._doubts.not_ok_sensors)
        for ruled in followers:
            is_judged = diagnosis.quality == "good" or diagnosis.partial
            if not is_judged or ruled.alarm.is_held(Hold.SUPPRESSED):
                ruled.watch.hold(diagnosis)
                ruled.alarm.hold()
                continue
            finding = ruled.watch.find(diagnosis, circumstances)
            if finding is not None:
                yield from ruled.alarm.apply(finding, diagnosis, at)
            elif diagnosis.partial:
                ruled.alarm.hold()

    def _quality(self, names: Iterable[str], diagnosis: Diagnosis, at: ClockReading) -> Iterator[AlarmEvent]:
        """Raise, change or return the quality alarms that the diagnosis is about."""
        for name in names:
            doubts = self._doubts.of(name)
            if name not in self._alarms:
                if not doubts:
                    continue
                self._add(name, latching=False)
            alarm = self._alarms[name]
            alarm.doubts = doubts
            finding = self._doubts.finding(name)
            if alarm.waits(finding, at):
                self._waiting[name] = diagnosis
                continue
            self._waiting.pop(name, None)
            yield from alarm.apply(finding, diagnosis, at)

    def _suppression(
        self, sensors: Collection[str], diagnosis: Diagnosis, at: ClockReading
    ) -> Iterator[AlarmEvent]:
        """Suppress what rests on a sensor that is not OK, and lift that when it is good again.

        Nothing has changed for an alarm that the detector does not feed and that rests on no other sensor.
        """
        touched = self._ruled if self._unlooked else self._ruled.touched(diagnosis.detector, sensors)
        self._unlooked = False
        for ruled in touched:
            reason = self._doubts.silences(ruled.rule, ruled.sensors)
            if (reason is not None) == ruled.alarm.is_held(Hold.SUPPRESSED):
                continue
            if reason is not None:
                yield ruled.alarm.suppress(reason, diagnosis, at)
            else:
                yield ruled.alarm.unsuppress("its sensors are good again", diagnosis, at)

    def _timed(self, now: ClockReading) -> Iterator[AlarmEvent]:
        for name in self._shelving_ends.due(now.t_ns):
            expired = self._alarms[name].expire(now, self._unjudged(name, now))
            if expired is not None:
                yield expired
        for name, diagnosis in tuple(self._waiting.items()):
            yield from self._quality([name], diagnosis, now)
        for name in self._doubts.give_up(now.t_ns):
            yield from self._quality([name], self._unjudged(name, now), now)
        yield from self._stand(TRIP_MULTIPLY, *self._start_up.overrun(now.t_ns), now)

    def _await_end_of_shelving(self, alarm: Alarm) -> None:
        until_ns = alarm.shelved_until_ns
        if until_ns is not None:
            self._shelving_ends.put(alarm.name, until_ns)

    def _stand(self, name: str, level: Level, sentence: str, at: ClockReading) -> list[AlarmEvent]:
        if name in self._alarms and name not in self._conditions:
            raise ValueError(f"condition {name!r} has the name of an alarm; put a / into it")
        if name not in self._alarms:
            if level is Level.NORMAL:
                return []
            self._add(name, latching=False)
            self._conditions.add(name)
        cause = statement(self._identity.machine, name, level, at)
        return self._alarms[name].apply(RuleFinding(level, "", lambda: sentence), cause, at)

    def _obeyed(self, command: AlarmCommand, alarm: Alarm) -> AlarmEvent:
        standing = alarm.status.occurrence
        if command.occurrence is not None and command.occurrence != standing:
            stands = "it is normal" if standing is None else f"now {standing} stands"
            raise CommandNotAllowedError(
                f"cannot {command.verb} {alarm.name}: occurrence {command.occurrence} is over, {stands}"
            )
        now = self._now()
        request, nothing = HandlingRequest(command.by, now, command.reason), self._unjudged(alarm.name, now)
        match command.verb:
            case Verb.ACKNOWLEDGE:
                return alarm.acknowledge(request)
            case Verb.RESET:
                return alarm.reset(request)
            case Verb.SHELVE:
                return alarm.shelve(
                    now.t_ns + shelving_ns(command, self._handling.shelve_at_most_s), request, nothing
                )
            case Verb.UNSHELVE:
                return alarm.unshelve(request, nothing)
            case Verb.BYPASS:
                return alarm.bypass(request, nothing)
            case Verb.UNBYPASS:
                return alarm.unbypass(request, nothing)

    def _unjudged(self, name: str, at: ClockReading) -> Diagnosis:
        is_condition = name in self._conditions or name in self._expected.conditions
        return unjudged(self._identity.machine, name, at, is_condition=is_condition)

    def _named(self, name: str) -> Alarm:
        """The alarm of that name, or a new one if it can come by itself."""
        if name in self._alarms:
            return self._alarms[name]
        if name in self._expected.names:
            return self._made(name, latching=False)
        known = {*self._alarms, *self._expected.names}
        there_are = f"there are: {', '.join(sorted(known)) or 'none'}"
        if close := get_close_matches(name, sorted(known)[:MOST_NAMED], n=1):
            there_are = f"did you mean {close[0]!r}? There are: {', '.join(sorted(known))}"
        if len(known) > MOST_NAMED:
            there_are = f"there are {len(known)} others; daqsvc check lists those of the machine file"
        raise UnknownAlarmError(f"no alarm is named {name!r}; {there_are}")

    def _resumed(self, event: AlarmEvent, active_detectors: Mapping[str, Sequence[str]]) -> bool:
        """Resume the alarm of ``event``; False if it is active and no rule judges it any more."""
        ours, name = event.identity == self._identity, event.alarm
        ruled = self._ruled.named(name)
        if ours and ruled is not None:
            self._resume_ruled(ruled, event)
        elif not _stands(event):
            if name in self._alarms and ours:
                # In a replay, where it was active.
                self._doubts.settle(name)
                self._resume_unruled(event)
            return True
        elif ours and (
            name in self._expected.quality or name.removeprefix("detector-ok/") in active_detectors
        ):
            self._resume_unruled(event)
            doubts = [doubt for doubt in event.doubts if doubt.detector in active_detectors]
            t_ns = self._clock.monotonic_ns()
            self._doubts.resume(doubts, t_ns, event.finding, restarted=self._restarted)
            self._doubts.expect(name, self._expected.quality.get(name, {}), t_ns)
        elif ours and is_condition(event) and (name != ALARM_FLOOD or self._handling.flood_alarms):
            self._resume_unruled(event)
            self._conditions.add(name)
            if name == ALARM_FLOOD and event.own_state.is_active:
                self._flood.resume(self._clock.monotonic_ns())
        else:
            return False
        return True

    def _excuse(self, events: Sequence[AlarmEvent]) -> None:
        """Take back that a sensor was not OK where later events show that this was over.

        After a restart, a detector may state "good" while others have stated nothing yet. That makes no event
        of the quality alarm, nor does a later "not OK" of it: its last event still has the first doubt. The
        alarms that rest on the sensor do have events of this; the last of them counts.
        """
        ours = [event for event in events if event.identity == self._identity]
        place = {event.alarm: number for number, event in enumerate(ours)}
        not_ok = self._doubts.not_ok()
        for name, doubt in not_ok:
            others = [other for _, other in not_ok if other is not doubt]
            for event in reversed(ours[place.get(name, len(ours)) + 1 :]):
                ruled = self._ruled.named(event.alarm)
                if ruled is None or not _bears_on(doubt, ruled, event):
                    continue
                if not ruled.alarm.is_held(Hold.SUPPRESSED):
                    self._doubts.excuse(doubt.detector)
                    break
                if not any(_bears_on(other, ruled, event) for other in others):
                    break

    def _resume_ruled(self, ruled: Ruled, event: AlarmEvent) -> None:
        level = event.to_level if event.own_state.is_active else Level.NORMAL
        self._resume_alarm(ruled.alarm, event, ruled.watch.resume(level, event))

    def _resume_unruled(self, event: AlarmEvent) -> None:
        self._resume_alarm(self._add(event.alarm, latching=False), event, event.finding)

    def _resume_alarm(self, alarm: Alarm, event: AlarmEvent, finding: str) -> None:
        sentence = in_words(event.alarm, event.doubts) if event.doubts else ""
        alarm.resume(event, finding, self._since(event.wall_ns), self._now(), sentence)
        self._count(AlarmState.NORMAL, alarm.status.state)
        self._await_end_of_shelving(alarm)

    def _withdraw(self, event: AlarmEvent) -> AlarmEvent:
        alarm = Alarm(event.identity, event.alarm, latching=False, new_occurrence=self._new_occurrence)
        alarm.resume(event, "", self._since(event.wall_ns), self._now())
        return alarm.withdraw("the machine file no longer has it", event.cause, self._now())

    def _since(self, wall_ns: int) -> ClockReading:
        """A time before the restart, by its wall-clock label: the monotonic clock may have restarted."""
        return ClockReading(self._clock.monotonic_ns() - self._clock.wall_ns() + wall_ns, wall_ns)

    def _add(self, name: str, *, latching: bool) -> Alarm:
        alarm = self._alarms[name] = self._made(name, latching=latching)
        return alarm

    def _made(self, name: str, *, latching: bool) -> Alarm:
        return Alarm(
            self._identity,
            name,
            latching=latching,
            new_occurrence=self._new_occurrence,
            handling=self._handling,
        )

    def _now(self) -> ClockReading:
        return self._instant(self._clock.monotonic_ns())

    def _instant(self, t_ns: int) -> ClockReading:
        """The wall-clock label of a monotonic time."""
        return ClockReading(t_ns, self._clock.wall_ns() - self._clock.monotonic_ns() + t_ns)


def _stands(event: AlarmEvent) -> bool:
    return event.own_state is not AlarmState.NORMAL or bool(event.holds)


def _bears_on(doubt: Doubt, ruled: Ruled, event: AlarmEvent) -> bool:
    """Whether an alarm was suppressed by a doubt, by the sensors that its last event rests on."""
    rested_on = ruled.rule.sensors or event.cause.sensors or ruled.sensors
    blamed = doubt.sensors if len(doubt.sensors) == 1 else ()
    return ruled.rule.spare == 0 and (
        doubt.detector in ruled.rule.detectors or not set(blamed).isdisjoint(rested_on)
    )


class _Statuses(Mapping[str, "AlarmStatus"]):
    """The status of each alarm, made when it is asked for: those that are not read cost nothing."""

    def __init__(self, alarms: Mapping[str, Alarm], first_out: FirstOut) -> None:
        self._alarms = alarms
        self._first_out = first_out

    def __getitem__(self, name: str) -> AlarmStatus:
        return self._alarms[name].status._replace(first_out=self._first_out.is_first(name))

    def __iter__(self) -> Iterator[str]:
        return iter(self._alarms)

    def __len__(self) -> int:
        return len(self._alarms)
