"""Commands that come over MQTT, and the answers to them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AwareDatetime, Field

from daqsvc.alarms.commands import CommandMessage, DurationS, Line, Person, Reason
from daqsvc.publish.payloads import Stamped


class CommandPayload(CommandMessage):
    """One command; what is asked, and of which machine, stands in the topic."""

    schema_: Literal["daqsvc.command/1"] = Field(alias="schema")
    id: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.:-]{1,64}$")] = Field(
        description="chosen by the sender, new for every command, e.g. a UUID"
    )
    alarm: Annotated[str, Field(pattern=r"^[A-Za-z0-9_./-]{1,200}$")] = Field(description="name of the alarm")
    by: Person = Field(description="who asks")
    issued_at: AwareDatetime = Field(description="when, ISO 8601 with the offset from UTC")
    expires_s: Annotated[float, Field(gt=0)] | None = Field(
        default=None, description="how old the command may become, if less than the machine file allows"
    )
    duration_s: DurationS | None = Field(default=None, description="how long to shelve; for shelve only")
    occurrence: Annotated[Line, Field(min_length=1, max_length=64)] | None = Field(
        default=None, description="refuse the command if another activation stands by now"
    )
    reason: Reason = Field(default="", description="why")


class ResponsePayload(Stamped):
    """What came of a command."""

    schema_: Literal["daqsvc.response/1"] = Field("daqsvc.response/1", alias="schema")
    id: str | None = Field(description="id of the command; null if it could not be read")
    machine: str
    verb: str
    accepted: bool
    reason: str = Field(description="why it was refused; empty if it was not")
    events: tuple[str, ...] = Field(description="ids of the alarm events that followed")
