"""What an alarm reports: one immutable event per change, with its cause."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, NamedTuple

from daqsvc.alarms.states import AlarmState

if TYPE_CHECKING:
    from daqsvc.alarms.states import Level
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.dsp.quality import Quality


@dataclass(frozen=True, slots=True)
class Identity:
    """Whose alarms these are: topic-safe names of the site, the box and the machine."""

    site: str
    box: str
    machine: str


class EventKind(StrEnum):
    """Why an event was sent."""

    RAISED = "raised"
    """A new occurrence begins."""
    ESCALATED = "escalated"
    """The level of a standing occurrence has risen; it wants to be acknowledged again."""
    LOWERED = "lowered"
    """The level has fallen, but not to normal."""
    CHANGED = "changed"
    """The cause is known better, or has become another, at the same level; or the limits are others."""
    RETURNED = "returned"
    """The condition has gone."""
    LATCHED = "latched"
    """The condition has gone; the alarm waits to be reset."""
    RECURRED = "recurred"
    """The condition has come back before a latched alarm was reset."""
    ACKNOWLEDGED = "acknowledged"
    RESET = "reset"
    SUPPRESSED = "suppressed"
    """A sensor that the alarm rests on is not OK: the alarm is suppressed."""
    UNSUPPRESSED = "unsuppressed"
    """Its sensors are good again: the alarm goes on from where it was."""
    SHELVED = "shelved"
    """A person has covered it for a stated time, or changed that time."""
    UNSHELVED = "unshelved"
    """That time is over, or a person has uncovered it."""
    BYPASSED = "bypassed"
    """A person has taken it out of service."""
    UNBYPASSED = "unbypassed"
    """A person has put it back into service."""
    CHATTERING = "chattering"
    """It becomes active and returns so often that its returns are held back until it is quiet."""
    QUIET = "quiet"
    """It no longer chatters."""


ANNUNCIATIONS = frozenset({EventKind.RAISED, EventKind.ESCALATED, EventKind.RECURRED})
"""Events by which an alarm calls for a person, unless something covers it: what chatter is counted by."""
_UNCOVERED = frozenset({EventKind.UNSHELVED, EventKind.UNBYPASSED, EventKind.UNSUPPRESSED})


class Doubt(NamedTuple):
    """What one detector has against a sensor, until it states good.

    Attributes:
        detector: name of the detector.
        quality: what it stated last, ``"missing"`` or ``"not_ok"``.
        not_ok: whether it has stated "not OK"; missing samples since then do not take that back.
        reason: why, in words for a person.
        sensors: the sensors that its statement rests on.
    """

    detector: str
    quality: Quality
    not_ok: bool
    reason: str
    sensors: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class AlarmEvent:
    """One change of one alarm.

    Attributes:
        identity: whose alarm it is.
        alarm: name of the alarm, e.g. ``"rotor-fault"`` or ``"sensor-ok/probe-x"``.
        occurrence: id of the activation that this belongs to, never used again, also not after a
            restart; None if the alarm was normal before and after.
        kind: why the event was sent.
        from_state: what consumers saw before.
        to_state: what they see now.
        from_level: level before; while an alarm latches, the worst level since it was raised.
        to_level: level now.
        t_ns: monotonic time of what caused the event: of the data, or of a person's action.
        wall_ns: wall-clock label of that instant, ns since the Unix epoch, UTC.
        cause: the diagnosis behind the event; for a person's action the last one that mattered.
        message: one sentence for a person.
        by: the person who asked for it; empty if the data or time did it.
        reason: why, in that person's words.
        holds: what covers the alarm after the event, strongest first.
        covered: the alarm's own state under these; None if nothing covers it.
        shelved_until_wall_ns: wall-clock label of the end of shelving, as it looks now; None if not shelved.
        first_out: whether this alarm was the first of its group to stand since the group was normal.
        chattering: whether its returns are held back because it becomes active and returns too often.
        finding: what is found, where a level can have several causes (`Finding.identity`).
        doubts: of a quality alarm, what counts against the sensor.
        found: the message of the last event that stated what is found; empty if this one's message does,
            or if it is not known.

    The last event of an alarm holds all that a restart needs to know about it.
    """

    identity: Identity
    alarm: str
    occurrence: str | None
    kind: EventKind
    from_state: AlarmState
    to_state: AlarmState
    from_level: Level
    to_level: Level
    t_ns: int
    wall_ns: int
    cause: Diagnosis
    message: str
    by: str = ""
    reason: str = ""
    holds: tuple[AlarmState, ...] = ()
    covered: AlarmState | None = None
    shelved_until_wall_ns: int | None = None
    first_out: bool = False
    chattering: bool = False
    finding: str = ""
    doubts: tuple[Doubt, ...] = ()
    found: str = ""

    @property
    def calls(self) -> bool:
        """Whether the alarm calls for a person by it, as ISA-18.2 counts annunciations.

        A covered alarm does not: it is neither seen nor heard. When its cover ends, it does if it is
        active and nobody has acknowledged it.
        """
        if self.kind in _UNCOVERED:
            return self.to_state is AlarmState.ACTIVE_UNACKNOWLEDGED
        return self.kind in ANNUNCIATIONS and not self.holds

    @property
    def own_state(self) -> AlarmState:
        """The alarm's own state after the event, also under a hold."""
        return self.to_state if self.covered is None else self.covered
