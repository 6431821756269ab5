"""The state of an alarm, since when, and what is asked of people."""

from __future__ import annotations

from typing import NamedTuple

from daqsvc.alarms.states import AlarmState, Level


class ClockReading(NamedTuple):
    """When something happened, by both clocks."""

    t_ns: int
    wall_ns: int


class HandlingRequest(NamedTuple):
    """Who asks for something, when, and why."""

    by: str
    at: ClockReading
    reason: str = ""


class AlarmStatus(NamedTuple):
    """The state of an alarm, for a view.

    Attributes:
        state: what consumers see.
        level: how bad; of a latching or chattering alarm the worst since it was raised.
        occurrence: id of the activation; None while the alarm is normal.
        since: when something last changed; None if nothing ever has.
        message: the last event's sentence.
        own_state: the state without its holds.
        holds: what covers it, strongest first.
        shelved_until_ns: end of shelving by the monotonic clock; None if not shelved.
        chattering: whether its returns are held back.
        first_out: whether it was the first of its group.
        found: the sentence that stated what was found last; empty if that is not known.
    """

    state: AlarmState
    level: Level
    occurrence: str | None
    since: ClockReading | None
    message: str
    own_state: AlarmState = AlarmState.NORMAL
    holds: tuple[AlarmState, ...] = ()
    shelved_until_ns: int | None = None
    chattering: bool = False
    first_out: bool = False
    found: str = ""

    @property
    def summary(self) -> str:
        """What was found last, and what has been done about it since."""
        if not self.found or self.found == self.message:
            return self.message
        return f"{self.found}; {self.message}"
