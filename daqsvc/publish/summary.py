"""How all alarms of a machine stand, in one retained message."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import BaseModel, Field

from daqsvc.alarms.states import AlarmState
from daqsvc.diagnosis.record import Severity  # noqa: TC001 - pydantic reads the annotations
from daqsvc.publish.payloads import Payload, Stamped, stamp_now

if TYPE_CHECKING:
    from collections.abc import Iterable

    from daqsvc.acquisition.clock import Clock
    from daqsvc.outbox.store import OutboxMessage
    from daqsvc.publish.topics import Topics

_HIDDEN = {AlarmState.SUPPRESSED, AlarmState.SHELVED, AlarmState.OUT_OF_SERVICE}
_GONE = {AlarmState.NORMAL, AlarmState.RETURNED_UNACKNOWLEDGED}


class StandingPayload(Payload):
    """How one alarm stands."""

    problem: Literal["ON", "OFF"] | None = Field(
        description="ON from raising to return or reset; null while the alarm is covered: suppressed, "
        "shelved or out of service"
    )
    state: AlarmState
    level: Severity
    occurrence: str | None = Field(description="id of the activation; null if normal")
    time: str | None = Field(description="ISO 8601, UTC, of the latest event; null if there was none yet")
    message: str


class SummaryPayload(Stamped):
    """Every alarm of a machine as it stands."""

    schema_: Literal["daqsvc.summary/1"] = Field("daqsvc.summary/1", alias="schema")
    machine: str
    alarms: dict[str, StandingPayload]


class _Told(BaseModel):
    """What is read of an alarm's message."""

    alarm: str
    state: AlarmState
    level: Severity
    occurrence: str | None
    time: str
    message: str


class Summary:
    """The alarms of a machine, as the messages that the broker has acknowledged tell them.

    Args:
        machine: name of the machine.
        alarms: those that are normal until something else is said.
        topics: the box.
    """

    def __init__(self, machine: str, alarms: Iterable[str], topics: Topics) -> None:
        self._machine = machine
        self._topics = topics
        self._alarms = {name: _untold() for name in alarms}

    def note(self, message: OutboxMessage) -> bool:
        """Take in a message of the outbox; whether it has told something of an alarm of the machine.

        Raises:
            ValueError: it is on an alarm's topic and no alarm's message.
        """
        if not message.topic.startswith(self._topics.alarm_prefix(self._machine)):
            return False
        told = _Told.model_validate_json(message.payload)
        problem: Literal["ON", "OFF"] = "OFF" if told.state in _GONE else "ON"
        self._alarms[told.alarm] = StandingPayload(
            problem=None if told.state in _HIDDEN else problem,
            state=told.state,
            level=told.level,
            occurrence=told.occurrence,
            time=told.time,
            message=told.message,
        )
        return True

    def payload(self, clock: Clock) -> SummaryPayload:
        """How the alarms stand now."""
        stamp = stamp_now(self._topics.site, self._topics.box, clock)
        return SummaryPayload(**stamp, machine=self._machine, alarms=dict(self._alarms))


def _untold() -> StandingPayload:
    return StandingPayload(
        problem="OFF", state=AlarmState.NORMAL, level="normal", occurrence=None, time=None, message=""
    )
