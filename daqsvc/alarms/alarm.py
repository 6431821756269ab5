"""One alarm: its state, its holds, and the event that every change of them is."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from daqsvc.alarms.events import AlarmEvent, EventKind
from daqsvc.alarms.states import AlarmState, Hold, Level, RefusedError, Stimulus, shown, transition

if TYPE_CHECKING:
    from collections.abc import Callable

    from daqsvc.alarms.events import Identity
    from daqsvc.alarms.rules import Finding
    from daqsvc.diagnosis.record import Diagnosis


class Instant(NamedTuple):
    """When something happened, by both clocks."""

    t_ns: int
    wall_ns: int


class AlarmStatus(NamedTuple):
    """How an alarm stands, for a view.

    Attributes:
        state: what consumers see.
        level: how bad; of a latching alarm the worst since it was raised.
        occurrence: id of the activation; None while the alarm is normal.
        since: when the state or level last changed; None if they never have.
        message: the last event's sentence.
    """

    state: AlarmState
    level: Level
    occurrence: str | None
    since: Instant | None
    message: str


class Alarm:
    """The memory of one alarm. Every method that changes something returns the event that says so.

    Args:
        identity: whose alarm it is.
        name: name of the alarm.
        latching: whether it outlives its condition until it is reset.
        new_occurrence: gives an id that was never used before.
    """

    def __init__(
        self, identity: Identity, name: str, *, latching: bool, new_occurrence: Callable[[], str]
    ) -> None:
        self.name = name
        self._identity = identity
        self._latching = latching
        self._new_occurrence = new_occurrence
        self._state = AlarmState.NORMAL
        self._level = Level.NORMAL
        self._found = ""
        self._holds: set[Hold] = set()
        self._occurrence: str | None = None
        self._cause: Diagnosis | None = None
        self._since: Instant | None = None
        self._message = ""

    @property
    def status(self) -> AlarmStatus:
        """How the alarm stands."""
        return AlarmStatus(self._shown, self._level, self._occurrence, self._since, self._message)

    @property
    def _shown(self) -> AlarmState:
        return shown(self._state, self._holds)

    def is_held(self, hold: Hold) -> bool:
        """Whether ``hold`` covers the state."""
        return hold in self._holds

    def resume(self, told: AlarmEvent, found: str, since: Instant) -> None:
        """Stand as the last event before a restart said.

        Args:
            told: that event.
            found: `Finding.identity` of what stood; empty if nobody knows.
            since: when it was, by the clocks as they are now.
        """
        self._state, self._level = told.own_state, told.to_level
        self._holds = {Hold.SUPPRESSED} if told.to_state is AlarmState.SUPPRESSED else set()
        self._occurrence = None if self._state is AlarmState.NORMAL else told.occurrence
        self._found, self._cause = found, told.cause
        self._since, self._message = since, told.message

    def withdraw(self, reason: str, cause: Diagnosis, at: Instant) -> AlarmEvent:
        """Return to normal, from whatever state, because nobody will judge the alarm any more."""
        before = self._shown
        self._holds = set()
        message = f"{self.name} returned to normal: {reason}"
        returned = self._change(EventKind.RETURNED, AlarmState.NORMAL, Level.NORMAL, cause, at, message)
        return replace(returned, from_state=before)

    def apply(self, finding: Finding, cause: Diagnosis, at: Instant) -> AlarmEvent | None:
        """Take in what the rule finds; None if that is nothing new."""
        if finding.level is Level.NORMAL:
            if not self._state.is_active:
                return None
            state = transition(self._state, Stimulus.CLEAR, latching=self._latching)
            if state.is_latched:
                message = f"{self.name} latched at {self._level.label}: {finding.sentence}"
                return self._change(EventKind.LATCHED, state, self._level, cause, at, message)
            message = f"{self.name} returned to normal: {finding.sentence}"
            return self._change(EventKind.RETURNED, state, Level.NORMAL, cause, at, message)

        kind, level = self._worsening(finding)
        if kind is None:
            return None
        if kind is EventKind.RAISED:
            self._occurrence = self._new_occurrence()
        self._found = finding.identity
        stimulus = Stimulus.ESCALATE if kind is EventKind.ESCALATED else Stimulus.RAISE
        state = transition(self._state, stimulus, latching=self._latching)
        message = f"{self.name} {level.label}: {finding.sentence}"
        return self._change(kind, state, level, cause, at, message)

    def _worsening(self, finding: Finding) -> tuple[EventKind | None, Level]:
        """What a finding that is not normal means here, and the level that it leads to."""
        level = max(self._level, finding.level) if self._latching else finding.level
        if self._state.is_latched:
            return EventKind.RECURRED, level
        if not self._state.is_active:
            return EventKind.RAISED, level
        if level > self._level:
            return EventKind.ESCALATED, level
        if level < self._level:
            return EventKind.LOWERED, level
        return (EventKind.CHANGED if finding.identity != self._found else None), level

    def suppress(self, reason: str, cause: Diagnosis, at: Instant) -> AlarmEvent:
        """Cover the state because a sensor is not OK."""
        return self._cover(EventKind.SUPPRESSED, {Hold.SUPPRESSED}, reason, cause, at)

    def unsuppress(self, reason: str, cause: Diagnosis, at: Instant) -> AlarmEvent:
        """Show the state again that was covered."""
        return self._cover(EventKind.UNSUPPRESSED, set(), reason, cause, at)

    def _cover(
        self, kind: EventKind, suppression: set[Hold], reason: str, cause: Diagnosis, at: Instant
    ) -> AlarmEvent:
        before = self._shown
        self._holds = (self._holds - {Hold.SUPPRESSED}) | suppression
        message = f"{self.name} {kind.value}: {reason}"
        return self._event(kind, before, self._level, self._occurrence, cause, at, message)

    def acknowledge(self, at: Instant, by: str) -> AlarmEvent:
        """A person has seen it.

        Raises:
            RefusedError: there is nothing to acknowledge, or the alarm is held.
        """
        return self._obey(Stimulus.ACKNOWLEDGE, EventKind.ACKNOWLEDGED, at, by)

    def reset(self, at: Instant, by: str) -> AlarmEvent:
        """A person lets go of a latched alarm.

        Raises:
            RefusedError: its condition stands, there is nothing to reset, or the alarm is held.
        """
        return self._obey(Stimulus.RESET, EventKind.RESET, at, by)

    def _obey(self, stimulus: Stimulus, kind: EventKind, at: Instant, by: str) -> AlarmEvent:
        cause = self._cause
        if self._holds or cause is None:
            reason = f"it is {self._shown.value}" if self._holds else "it has never been raised"
            raise RefusedError(f"cannot {stimulus.value} {self.name}: {reason}")
        try:
            state = transition(self._state, stimulus, latching=self._latching)
        except RefusedError as refusal:
            raise RefusedError(f"cannot {stimulus.value} {self.name}: {refusal}") from None
        level = Level.NORMAL if kind is EventKind.RESET else self._level
        message = f"{self.name} {kind.value}" + (f" by {by}" if by else "")
        return self._change(kind, state, level, cause, at, message, by)

    def _change(
        self,
        kind: EventKind,
        state: AlarmState,
        level: Level,
        cause: Diagnosis,
        at: Instant,
        message: str,
        by: str = "",
    ) -> AlarmEvent:
        before, level_before, occurrence = self._shown, self._level, self._occurrence
        self._state, self._level, self._cause = state, level, cause
        if state is AlarmState.NORMAL:
            self._occurrence = None
        return self._event(kind, before, level_before, occurrence, cause, at, message, by)

    def _event(
        self,
        kind: EventKind,
        before: AlarmState,
        level_before: Level,
        occurrence: str | None,
        cause: Diagnosis,
        at: Instant,
        message: str,
        by: str = "",
    ) -> AlarmEvent:
        self._since, self._message = at, message
        return AlarmEvent(
            identity=self._identity,
            alarm=self.name,
            occurrence=occurrence,
            kind=kind,
            from_state=before,
            to_state=self._shown,
            from_level=level_before,
            to_level=self._level,
            t_ns=at.t_ns,
            wall_ns=at.wall_ns,
            cause=cause,
            message=message,
            by=by,
        )
