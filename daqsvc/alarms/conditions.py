"""Conditions of the service itself: alarms that no detector feeds, such as a flood of alarms."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from daqsvc.alarms.rules import UNDETERMINED
from daqsvc.alarms.states import Level
from daqsvc.diagnosis.record import Diagnosis

if TYPE_CHECKING:
    from daqsvc.alarms.events import AlarmEvent
    from daqsvc.alarms.status import ClockReading

SERVICE = "service"
"""The "detector" of such conditions."""

ALARM_FLOOD = "alarm-flood"
TRIP_MULTIPLY = "trip-multiply"
RESERVED = frozenset({ALARM_FLOOD, TRIP_MULTIPLY})
"""Names that no alarm of a machine file may have; other conditions have a ``/`` in theirs, which none may."""


class Condition(NamedTuple):
    """How one thing about the service stands.

    Attributes:
        name: of the alarm, with a ``/`` in it.
        level: how bad it is.
        sentence: in words for a person.
    """

    name: str
    level: Level
    sentence: str


def statement(machine: str, condition: str, level: Level, at: ClockReading) -> Diagnosis:
    """The service's statement that ``condition`` is active at ``level``."""
    return _statement(machine, condition, level, at)


def no_statement(machine: str, at: ClockReading) -> Diagnosis:
    """The cause of an alarm that no detector has judged yet."""
    return _statement(machine, UNDETERMINED, Level.NORMAL, at)


def unjudged(machine: str, name: str, at: ClockReading, *, is_condition: bool) -> Diagnosis:
    """The cause of what people do with alarm ``name`` before anybody has judged it.

    For a condition of the service it names that, so that it is known again after a restart.
    """
    return statement(machine, name, Level.NORMAL, at) if is_condition else no_statement(machine, at)


def is_condition(event: AlarmEvent) -> bool:
    """Whether the alarm of ``event`` is a condition of the service."""
    return event.cause.detector == SERVICE and event.cause.decision == event.alarm


def _statement(machine: str, decision: str, level: Level, at: ClockReading) -> Diagnosis:
    return Diagnosis(
        machine=machine,
        detector=SERVICE,
        t_ns=at.t_ns,
        stream="",
        first_index=0,
        end_index=0,
        decision=decision,
        severity=level.label,
        model="service/1",
    )
