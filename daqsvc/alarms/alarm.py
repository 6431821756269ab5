"""One alarm: its state, its holds, and the event that every change of them is."""

from __future__ import annotations

import copy
from collections import deque
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.standing import wording_of
from daqsvc.alarms.events import ANNUNCIATIONS, AlarmEvent, Doubt, EventKind
from daqsvc.alarms.handling import CALM
from daqsvc.alarms.states import (
    AlarmState,
    CommandNotAllowedError,
    Hold,
    Level,
    Stimulus,
    shown,
    strongest_first,
    transition,
)
from daqsvc.alarms.status import AlarmStatus, HandlingRequest

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from daqsvc.alarms.events import Identity
    from daqsvc.alarms.rules import RuleFinding
    from daqsvc.alarms.status import ClockReading
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.settings.alarms import AlarmHandling


class ChatterWatch:
    """Counts how often one alarm is raised, by the time of the data.

    A chattering alarm, which nobody can read, is neither dropped nor cleared: it stays active, at its worst
    level, and states it, until its level has not changed for a while. Its many comings and goings are then
    one occurrence.

    Args:
        handling: how often it may be raised, escalated or recur within which time; once more is chatter,
            until its level has not changed for long enough. Time over which no data came does not count.
    """

    def __init__(self, handling: AlarmHandling) -> None:
        self._raises = handling.chatter_raises
        self._window_ns = round(handling.chatter_window_s * NS_PER_S)
        self._quiet_ns = round(handling.chatter_quiet_s * NS_PER_S)
        self._raised_ns: deque[int] = deque()
        self._level: Level | None = None
        self._known_at_ns: int | None = None
        self._still_ns = 0
        self.chattering = False

    def resume(self, *, chattering: bool) -> None:
        """Resume after a restart; the times start again."""
        self.chattering = chattering and self._raises > 0

    def raised(self, t_ns: int) -> bool:
        """Note that the alarm called for a person; True if with that it begins to chatter."""
        if not self._raises:
            return False
        self._raised_ns.append(t_ns)
        while self._raised_ns and t_ns - self._raised_ns[0] > self._window_ns:
            self._raised_ns.popleft()
        while len(self._raised_ns) > self._raises + 1:
            self._raised_ns.popleft()
        if self.chattering or len(self._raised_ns) <= self._raises:
            return False
        self.chattering = True
        self.hold()
        return True

    def quietens(self, level: Level, t_ns: int) -> bool:
        """Take in what level is found while the alarm chatters; True if with that it is quiet.

        Time that runs backwards counts as none.
        """
        if not self.chattering:
            return False
        if level is not self._level:
            self._level, self._still_ns = level, 0
        elif self._known_at_ns is not None:
            self._still_ns += max(t_ns - self._known_at_ns, 0)
        self._known_at_ns = t_ns
        if self._still_ns < self._quiet_ns:
            return False
        self.chattering = False
        self._raised_ns.clear()
        self._level, self._known_at_ns, self._still_ns = None, None, 0
        return True

    def hold(self) -> None:
        """Data are missing: the time until the next ones does not count as quiet."""
        self._known_at_ns = None


CHANGES_NS = 5 * NS_PER_S
"""A doubt about a sensor may have another reason each time: that makes an event no more often than this."""

LIMITS_NOW = "; since then its limits are "
"""What follows in a message on what was found by earlier limits."""

FINDINGS = frozenset(
    {
        EventKind.RAISED,
        EventKind.ESCALATED,
        EventKind.LOWERED,
        EventKind.CHANGED,
        EventKind.RECURRED,
        EventKind.LATCHED,
        EventKind.RETURNED,
    }
)
"""Events whose message states what is found."""


class Alarm:
    """The memory of one alarm. Every method that changes something returns the events that report it.

    Args:
        identity: whose alarm it is.
        name: name of the alarm.
        latching: whether it outlives its condition until it is reset.
        new_occurrence: gives an id that was never used before.
        handling: states from when on it chatters.
    """

    def __init__(
        self,
        identity: Identity,
        name: str,
        *,
        latching: bool,
        new_occurrence: Callable[[], str],
        handling: AlarmHandling = CALM,
    ) -> None:
        self.name = name
        self.doubts: tuple[Doubt, ...] = ()
        self._reported_doubts: tuple[Doubt, ...] = ()
        self._seen_doubts: tuple[Doubt, ...] = ()
        """Those of the last event, or of a change since that a person could not tell from it."""
        self._last_message = ""
        """The message that published the present finding; empty if it is not known."""
        self._identity = identity
        self._latching = latching
        self._new_occurrence = new_occurrence
        self._chatter = ChatterWatch(handling)
        self._state = AlarmState.NORMAL
        self._level = Level.NORMAL
        self._finding = ""
        self._holds: set[Hold] = set()
        self._shelved_until_ns: int | None = None
        self._occurrence: str | None = None
        self._cause: Diagnosis | None = None
        self._since: ClockReading | None = None
        self._message = ""
        self._changed_ns: int | None = None

    @property
    def status(self) -> AlarmStatus:
        """The state of the alarm, without first-out."""
        return AlarmStatus(
            self._shown,
            self._level,
            self._occurrence,
            self._since,
            self._message,
            self._state,
            strongest_first(self._holds),
            self._shelved_until_ns,
            self._chatter.chattering,
            found=self._last_message,
        )

    def twin(self) -> Alarm:
        """Another that stands as this one, to see what a command would come to."""
        made = copy.copy(self)
        made._holds = set(self._holds)  # noqa: SLF001  its own
        return made

    @property
    def _shown(self) -> AlarmState:
        return shown(self._state, self._holds)

    @property
    def shelved_until_ns(self) -> int | None:
        """End of shelving by the monotonic clock; None if it is not shelved."""
        return self._shelved_until_ns

    def is_held(self, hold: Hold) -> bool:
        """Whether ``hold`` covers the state."""
        return bool(self._holds) and hold in self._holds

    def resume(
        self, event: AlarmEvent, finding: str, since: ClockReading, now: ClockReading, sentence: str = ""
    ) -> None:
        """Stand as the last event before a restart stated.

        Args:
            event: that event.
            finding: `RuleFinding.identity` of what was active; empty if not known.
            since: when it was, by the clocks as they are now.
            now: the time now. Shelving goes on by the wall clock, which may have been set since: what was
                left of it at ``event`` is never exceeded.
            sentence: what was active, in words, where ``event`` does not have it; empty if not known.
        """
        self._state, self._level = event.own_state, event.to_level
        self._holds = {Hold(state) for state in event.holds}
        if event.shelved_until_wall_ns is not None:
            left_ns = event.shelved_until_wall_ns - max(event.wall_ns, now.wall_ns)
            self._shelved_until_ns = now.t_ns + max(left_ns, 0)
        self._occurrence = None if self._state is AlarmState.NORMAL else event.occurrence
        self._finding, self._cause = finding, event.cause
        self.doubts = self._reported_doubts = self._seen_doubts = event.doubts
        if event.kind in FINDINGS:
            self._last_message = event.message
        elif event.found:
            self._last_message = event.found
        elif sentence:
            self._last_message = self._saying(event.to_level, sentence)
        self._chatter.resume(chattering=event.chattering)
        self._since, self._message = since, event.message

    @property
    def found(self) -> str:
        """The message that states what is found by now; empty if that is not known."""
        return self._last_message

    @property
    def units(self) -> Mapping[str, str]:
        """Of the measures of its cause that have one."""
        return {} if self._cause is None else self._cause.units

    def change_limits(self, limits: str, earlier: str, at: ClockReading) -> AlarmEvent:
        """Report that other limits hold from now on; the next good diagnosis is judged by them.

        Args:
            limits: in words.
            earlier: the finding by the earlier ones, as `found`; empty if that is not known.
            at: now.
        """
        assert self._cause is not None  # noqa: S101 - one that stands has a cause
        earlier = (earlier or self._last_message).partition(LIMITS_NOW)[0]
        earlier = earlier or f"{self.name} is {self._state.in_words}"
        self._last_message = f"{earlier}{LIMITS_NOW}{limits}"
        return self._event(EventKind.CHANGED, self._cause, HandlingRequest("", at), self._last_message)

    def withdraw(self, reason: str, cause: Diagnosis, at: ClockReading) -> AlarmEvent:
        """Return to normal, from any state, because no rule judges the alarm any more."""
        before = self._shown
        self._holds, self._shelved_until_ns, self.doubts = set(), None, ()
        self._chatter.resume(chattering=False)
        message = f"{self.name} returned to normal: {reason}"
        return self._change(
            EventKind.RETURNED,
            AlarmState.NORMAL,
            Level.NORMAL,
            cause,
            HandlingRequest("", at),
            message,
            before,
        )

    def apply(self, finding: RuleFinding, cause: Diagnosis, at: ClockReading) -> list[AlarmEvent]:
        """Take in what the rule finds; no event if that is nothing new."""
        events: list[AlarmEvent] = []
        if self._chatter.chattering:
            if self._chatter.quietens(finding.level, at.t_ns):
                message = f"{self.name} is quiet again: {finding.sentence}"
                events.append(self._event(EventKind.QUIET, cause, HandlingRequest("", at), message))
            elif finding.level < self._level:
                return self._held_back(finding, cause, at)
        event = self._return_event(finding, cause, at) or self._worsening_event(finding, cause, at)
        if event is None:
            return events
        events.append(event)
        if event.kind in ANNUNCIATIONS and self._chatter.raised(at.t_ns):
            message = f"{self.name} chatters: its returns are held back until it is quiet"
            events.append(self._event(EventKind.CHATTERING, cause, HandlingRequest("", at), message))
        return events

    def waits(self, finding: RuleFinding, at: ClockReading) -> bool:
        """Whether a finding of a quality alarm has nothing new but its reason, and the last is too recent.

        Then apply it again later: the reason at that time is published.
        """
        return (
            self._state.is_active
            and finding.level == self._level
            and self._is_news(finding)
            and [doubt[:3] for doubt in self.doubts] == [doubt[:3] for doubt in self._seen_doubts]
            and self._changed_ns is not None
            and 0 <= at.t_ns - self._changed_ns < CHANGES_NS
        )

    def _is_news(self, finding: RuleFinding) -> bool:
        """Whether something else is found at the same level."""
        if finding.identity != self._finding:
            return True
        return finding.differs_by_words and wording_of(finding.sentence) not in wording_of(self._last_message)

    def _held_back(self, finding: RuleFinding, cause: Diagnosis, at: ClockReading) -> list[AlarmEvent]:
        """A return while the alarm chatters; after a restart somebody must know who still doubts a sensor."""
        not_ok, reported_not_ok = (
            {d.detector for d in those if d.not_ok} for those in (self.doubts, self._reported_doubts)
        )
        # The next good statement after a restart also states that no detector lacks samples any more.
        if not_ok == reported_not_ok:
            return []
        # A sensor that flickers must not be an event each time; that it was not OK is on the safe side.
        if (
            not_ok < reported_not_ok
            and self._changed_ns is not None
            and 0 <= at.t_ns - self._changed_ns < CHANGES_NS
        ):
            return []
        self._finding = finding.identity
        message = f"{self.name} {self._level.label} until it is quiet: {finding.sentence}"
        self._last_message = message
        return [self._event(EventKind.CHANGED, cause, HandlingRequest("", at), message)]

    def hold(self) -> None:
        """Data are missing: everything stays, and no time counts."""
        self._chatter.hold()

    def _return_event(self, finding: RuleFinding, cause: Diagnosis, at: ClockReading) -> AlarmEvent | None:
        if finding.level is not Level.NORMAL or not self._state.is_active:
            return None
        state = transition(self._state, Stimulus.CLEAR, latching=self._latching)
        if state.is_latched:
            message = f"{self.name} latched at {self._level.label}: {finding.sentence}"
            self._last_message = message
            return self._change(
                EventKind.LATCHED, state, self._level, cause, HandlingRequest("", at), message
            )
        message = self._last_message = f"{self.name} returned to normal: {finding.sentence}"
        return self._change(EventKind.RETURNED, state, Level.NORMAL, cause, HandlingRequest("", at), message)

    def _worsening_event(self, finding: RuleFinding, cause: Diagnosis, at: ClockReading) -> AlarmEvent | None:
        kind, level = self._worsening(finding)
        if kind is None:
            return None
        message = self._saying(level, finding.sentence)
        if kind is EventKind.CHANGED and message == self._last_message:
            # No person would see a difference from the last message; what is found goes with the next event.
            self._finding, self._seen_doubts = finding.identity, self.doubts
            return None
        self._last_message = message
        if kind is EventKind.RAISED:
            self._occurrence = self._new_occurrence()
        self._finding = finding.identity
        stimulus = Stimulus.ESCALATE if kind is EventKind.ESCALATED else Stimulus.RAISE
        state = transition(self._state, stimulus, latching=self._latching)
        return self._change(kind, state, level, cause, HandlingRequest("", at), message)

    def _saying(self, level: Level, sentence: str) -> str:
        """The message of a finding that is not normal."""
        return f"{self.name} {level.label}: {sentence}"

    def _worsening(self, finding: RuleFinding) -> tuple[EventKind | None, Level]:
        """What a finding that is not normal means here, and the level that it leads to."""
        if finding.level is Level.NORMAL:
            return None, self._level
        level = max(self._level, finding.level) if self._latching else finding.level
        if self._state.is_latched:
            return EventKind.RECURRED, level
        if not self._state.is_active:
            return EventKind.RAISED, level
        if level > self._level:
            return EventKind.ESCALATED, level
        if level < self._level:
            return EventKind.LOWERED, level
        return (EventKind.CHANGED if self._is_news(finding) else None), level

    def suppress(self, reason: str, cause: Diagnosis, at: ClockReading) -> AlarmEvent:
        """Cover the state because a sensor is not OK."""
        before = self._cover(Hold.SUPPRESSED)
        self.hold()
        message = f"{self.name} suppressed: {reason}"
        return self._event(EventKind.SUPPRESSED, cause, HandlingRequest("", at), message, before)

    def unsuppress(self, reason: str, cause: Diagnosis, at: ClockReading) -> AlarmEvent:
        """Show the state again that was covered."""
        before = self._uncover(Hold.SUPPRESSED)
        message = f"{self.name} unsuppressed: {reason}"
        return self._event(EventKind.UNSUPPRESSED, cause, HandlingRequest("", at), message, before)

    def shelve(self, until_ns: int, request: HandlingRequest, nothing: Diagnosis) -> AlarmEvent:
        """Cover the state until ``until_ns`` by the monotonic clock, or change that time.

        Args:
            until_ns: when it uncovers itself.
            request: who asks.
            nothing: the cause if the alarm has never been judged.
        """
        before = self._cover(Hold.SHELVED)
        self._shelved_until_ns = until_ns
        message = f"{self.name} shelved{_signed(request, f' for {_lasting(until_ns - request.at.t_ns)}')}"
        return self._event(EventKind.SHELVED, self._cause or nothing, request, message, before)

    def unshelve(self, request: HandlingRequest, nothing: Diagnosis) -> AlarmEvent:
        """Show the state again before the shelving is over.

        Raises:
            CommandNotAllowedError: it is not shelved.
        """
        self._expect(Hold.SHELVED, "unshelve")
        before = self._uncover(Hold.SHELVED)
        message = f"{self.name} unshelved{_signed(request)}"
        return self._event(EventKind.UNSHELVED, self._cause or nothing, request, message, before)

    def expire(self, at: ClockReading, nothing: Diagnosis) -> AlarmEvent | None:
        """Show the state again if the shelving is over."""
        if self._shelved_until_ns is None or at.t_ns < self._shelved_until_ns:
            return None
        before = self._uncover(Hold.SHELVED)
        message = f"{self.name} unshelved: its time is over"
        return self._event(
            EventKind.UNSHELVED, self._cause or nothing, HandlingRequest("", at), message, before
        )

    def bypass(self, request: HandlingRequest, nothing: Diagnosis) -> AlarmEvent:
        """Cover the state until somebody puts the alarm back into service.

        Raises:
            CommandNotAllowedError: it is out of service already.
        """
        if self.is_held(Hold.OUT_OF_SERVICE):
            raise CommandNotAllowedError(f"cannot bypass {self.name}: it is out of service already")
        before = self._cover(Hold.OUT_OF_SERVICE)
        message = f"{self.name} taken out of service{_signed(request)}"
        return self._event(EventKind.BYPASSED, self._cause or nothing, request, message, before)

    def unbypass(self, request: HandlingRequest, nothing: Diagnosis) -> AlarmEvent:
        """Put the alarm back into service.

        Raises:
            CommandNotAllowedError: it is in service.
        """
        self._expect(Hold.OUT_OF_SERVICE, "unbypass")
        before = self._uncover(Hold.OUT_OF_SERVICE)
        message = f"{self.name} put back into service{_signed(request)}"
        return self._event(EventKind.UNBYPASSED, self._cause or nothing, request, message, before)

    def acknowledge(self, request: HandlingRequest) -> AlarmEvent:
        """A person has seen it.

        Raises:
            CommandNotAllowedError: there is nothing to acknowledge, or the alarm is held.
        """
        return self._execute(Stimulus.ACKNOWLEDGE, EventKind.ACKNOWLEDGED, request)

    def reset(self, request: HandlingRequest) -> AlarmEvent:
        """A person resets a latched alarm.

        Raises:
            CommandNotAllowedError: its condition stands, there is nothing to reset, or the alarm is held.
        """
        return self._execute(Stimulus.RESET, EventKind.RESET, request)

    def _execute(self, stimulus: Stimulus, kind: EventKind, request: HandlingRequest) -> AlarmEvent:
        cause = self._cause
        if self._holds or cause is None:
            reason = f"it is {self._shown.in_words}" if self._holds else "it has never been raised"
            raise CommandNotAllowedError(f"cannot {stimulus.value} {self.name}: {reason}")
        try:
            state = transition(self._state, stimulus, latching=self._latching)
        except CommandNotAllowedError as refusal:
            raise CommandNotAllowedError(f"cannot {stimulus.value} {self.name}: {refusal}") from None
        level = Level.NORMAL if kind is EventKind.RESET else self._level
        message = f"{self.name} {kind.value}{_signed(request)}"
        return self._change(kind, state, level, cause, request, message)

    def _expect(self, hold: Hold, verb: str) -> None:
        if not self.is_held(hold):
            raise CommandNotAllowedError(f"cannot {verb} {self.name}: it is not {hold.value.in_words}")

    def _cover(self, hold: Hold) -> AlarmState:
        """Lay ``hold`` over the state; what was seen before."""
        before = self._shown
        self._holds.add(hold)
        return before

    def _uncover(self, hold: Hold) -> AlarmState:
        before = self._shown
        self._holds.discard(hold)
        if hold is Hold.SHELVED:
            self._shelved_until_ns = None
        return before

    def _change(
        self,
        kind: EventKind,
        state: AlarmState,
        level: Level,
        cause: Diagnosis,
        request: HandlingRequest,
        message: str,
        before: AlarmState | None = None,
    ) -> AlarmEvent:
        """Move to ``state`` and ``level``, and report it."""
        before, level_before, occurrence = before or self._shown, self._level, self._occurrence
        self._state, self._level, self._cause = state, level, cause
        if state is AlarmState.NORMAL:
            self._occurrence, self._finding = None, ""
        return self._event(kind, cause, request, message, before, level_before, occurrence)

    def _event(
        self,
        kind: EventKind,
        cause: Diagnosis,
        request: HandlingRequest,
        message: str,
        before: AlarmState | None = None,
        level_before: Level | None = None,
        occurrence: str | None = None,
    ) -> AlarmEvent:
        """The event of a change that has been made; what is not stated before was as it is now."""
        at = request.at
        if kind is EventKind.CHANGED:
            self._changed_ns = at.t_ns
        self._since, self._message = at, message
        self._reported_doubts = self._seen_doubts = self.doubts
        until_ns = self._shelved_until_ns
        return AlarmEvent(
            identity=self._identity,
            alarm=self.name,
            occurrence=occurrence or self._occurrence,
            kind=kind,
            from_state=before or self._shown,
            to_state=self._shown,
            from_level=self._level if level_before is None else level_before,
            to_level=self._level,
            t_ns=at.t_ns,
            wall_ns=at.wall_ns,
            cause=cause,
            message=message,
            by=request.by,
            reason=request.reason,
            holds=strongest_first(self._holds),
            covered=self._state if self._holds else None,
            shelved_until_wall_ns=None if until_ns is None else at.wall_ns + until_ns - at.t_ns,
            chattering=self._chatter.chattering,
            finding=self._finding,
            doubts=self.doubts,
            found="" if kind in FINDINGS else self._last_message,
        )


def _signed(request: HandlingRequest, lasting: str = "") -> str:
    """Who asked, for how long, and why, as the end of a sentence."""
    by = f" by {request.by}" if request.by else ""
    return by + lasting + (f": {request.reason}" if request.reason else "")


def _lasting(duration_ns: int) -> str:
    """A duration for a person, in its largest unit."""
    seconds = duration_ns / 1e9
    size, unit = next((s, u) for s, u in ((3600.0, "h"), (60.0, "min"), (0.0, "s")) if seconds >= s)
    return f"{seconds / (size or 1.0):.4g} {unit}"
