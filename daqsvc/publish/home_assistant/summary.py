"""How all alarms of a machine stand, in one retained message."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field
from pydantic_core import from_json, to_json

from daqsvc.alarms.states import AlarmState
from daqsvc.diagnosis.record import Severity  # noqa: TC001 - pydantic reads the annotations
from daqsvc.publish.payloads import SCHEMA_ABOUT, JsonPayload, Stamped, stamp_now

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from daqsvc.acquisition.clock import Clock
    from daqsvc.outbox.store import OutboxMessage
    from daqsvc.publish.topics import Topics

_NO_ALARMS = b'"alarms":{}}'
"""How the JSON of a summary without alarms ends."""
_HIDDEN = {AlarmState.SUPPRESSED, AlarmState.SHELVED, AlarmState.OUT_OF_SERVICE}
_GONE = {AlarmState.NORMAL, AlarmState.RETURNED_UNACKNOWLEDGED}


class StandingPayload(JsonPayload):
    """How one alarm stands."""

    problem: Literal["ON", "OFF"] | None = Field(
        description="ON from raising to return or reset; null while the alarm is covered (suppressed, "
        "shelved or out of service), or is not raised and what it rests on is not OK: then it is not known"
    )
    state: AlarmState = Field(description="state of the alarm")
    level: Severity = Field(description="how bad it is")
    occurrence: str | None = Field(description="id of the activation; null if normal")
    time: str | None = Field(description="ISO 8601, UTC, of the latest event; null if there was none yet")
    message: str = Field(description="its latest event in a sentence")


class SummaryPayload(Stamped):
    """Every alarm of a machine as it stands."""

    schema_: Literal["daqsvc.summary/1"] = Field("daqsvc.summary/1", alias="schema", description=SCHEMA_ABOUT)
    machine: str = Field(description="name of the machine")
    alarms: dict[str, StandingPayload] = Field(description="the alarms, by name")


class Summary:
    """The alarms of a machine, as the messages that the broker has acknowledged tell them.

    An event costs what its own alarm costs: of the others the JSON is kept.

    Args:
        machine: name of the machine.
        alarms: those that are normal until something else is reported.
        topics: the box.
        rests_on: by alarm, the alarms about sensors and detectors; while one of them is active, nobody can
            state that there is no problem.
    """

    def __init__(
        self,
        machine: str,
        alarms: Iterable[str],
        topics: Topics,
        rests_on: Mapping[str, Iterable[str]] = MappingProxyType({}),
    ) -> None:
        self._machine = machine
        self._topics = topics
        self._prefix = topics.alarm_prefix(machine)
        self._alarms: dict[str, bytes] = {}
        self._standings: dict[str, dict[str, Any]] = {}
        self._rests_on = {alarm: frozenset(services) for alarm, services in rests_on.items()}
        self._resting: dict[str, list[str]] = {}
        for alarm, services in self._rests_on.items():
            for service in services:
                self._resting.setdefault(service, []).append(alarm)
        self._not_ok: set[str] = set()
        for name in alarms:
            self._put(name, _UNREPORTED)

    def note(self, message: OutboxMessage) -> bool:
        """Take in a message of the outbox; whether it is about an alarm of the machine.

        Raises:
            ValueError: it is on an alarm's topic and no alarm's message.
        """
        if not message.topic.startswith(self._prefix):
            return False
        event = from_json(message.payload)
        try:
            alarm, state = str(event["alarm"]), AlarmState(event["state"])
            standing = {
                "problem": None if state in _HIDDEN else "OFF" if state in _GONE else "ON",
                "state": state.value,
                **{key: event[key] for key in ("level", "occurrence", "time", "message")},
            }
        except (KeyError, TypeError) as error:
            raise ValueError(f"the message on {message.topic} is no alarm's: {error!r}") from error
        self._put(alarm, standing)
        if alarm in self._resting:
            (self._not_ok.discard if state in _GONE else self._not_ok.add)(alarm)
            for resting in self._resting[alarm]:
                if resting in self._standings:
                    self._put(resting, self._standings[resting])
        return True

    def to_json(self, clock: Clock) -> bytes:
        """The states of the alarms now: a `SummaryPayload` as UTF-8 JSON."""
        stamp = stamp_now(self._topics.site, self._topics.box, clock)
        empty = SummaryPayload(**stamp, machine=self._machine, alarms={}).to_json()
        return empty.removesuffix(_NO_ALARMS) + b'"alarms":{' + b",".join(self._alarms.values()) + b"}}"

    def _put(self, name: str, standing: dict[str, Any]) -> None:
        """Keep the state of an alarm, as a `StandingPayload` is written."""
        self._standings[name] = standing
        if standing["problem"] == "OFF" and self._rests_on.get(name, frozenset()) & self._not_ok:
            standing = standing | {"problem": None}
        self._alarms[name] = to_json(name) + b":" + to_json(standing)


_UNREPORTED: dict[str, Any] = StandingPayload(
    problem="OFF", state=AlarmState.NORMAL, level="normal", occurrence=None, time=None, message=""
).model_dump()
