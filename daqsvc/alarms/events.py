"""What an alarm tells the world: one immutable event per change, with its cause."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from daqsvc.alarms.states import AlarmState, Level
    from daqsvc.diagnosis.record import Diagnosis


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
    """The cause is known better, or has become another, at the same level."""
    RETURNED = "returned"
    """The condition has gone."""
    LATCHED = "latched"
    """The condition has gone; the alarm waits to be reset."""
    RECURRED = "recurred"
    """The condition has come back before a latched alarm was reset."""
    ACKNOWLEDGED = "acknowledged"
    RESET = "reset"
    SUPPRESSED = "suppressed"
    """A sensor that the alarm rests on is not OK: the alarm cannot speak."""
    UNSUPPRESSED = "unsuppressed"
    """Its sensors are good again: the alarm goes on from where it was."""


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
        by: who acknowledged or reset; empty if the data did it.
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

    @property
    def own_state(self) -> AlarmState:
        """The alarm's own state after the event: under a suppression, the one that it covers.

        While an alarm is suppressed nothing moves it, so the event before a suppression tells the rest.
        """
        return self.from_state if self.kind is EventKind.SUPPRESSED else self.to_state
