"""Commands that come over MQTT, and the answers to them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, Field

from daqsvc.alarms.text_validation import printable
from daqsvc.publish.payloads import Stamped

_Line = Annotated[
    str,
    AfterValidator(printable),
    Field(
        json_schema_extra={
            "pattern": r"^[^\x00-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff]*$"
        }
    ),
]
"""Printable text in one line; the pattern is what a schema can say of that."""


class CommandPayload(BaseModel):
    """One command; what is asked, and of which machine, stands in the topic."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    schema_: Literal["daqsvc.command/1"] = Field(alias="schema")
    id: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.:-]{1,64}$")] = Field(
        description="chosen by the sender, new for every command, e.g. a UUID"
    )
    alarm: Annotated[str, Field(pattern=r"^[A-Za-z0-9_./-]{1,200}$")] = Field(description="name of the alarm")
    by: Annotated[_Line, Field(min_length=1, max_length=100)] = Field(description="who asks")
    issued_at: AwareDatetime = Field(description="when, ISO 8601 with the offset from UTC")
    expires_s: Annotated[float, Field(gt=0)] | None = Field(
        default=None, description="how old the command may become, if less than the machine file allows"
    )
    duration_s: Annotated[float, Field(gt=0)] | None = Field(
        default=None, description="how long to shelve; for shelve only"
    )
    occurrence: Annotated[_Line, Field(min_length=1, max_length=64)] | None = Field(
        default=None, description="refuse the command if another activation stands by now"
    )
    reason: Annotated[_Line, Field(max_length=500)] = Field(default="", description="why")


class ResponsePayload(Stamped):
    """What came of a command."""

    schema_: Literal["daqsvc.response/1"] = Field("daqsvc.response/1", alias="schema")
    id: str | None = Field(description="id of the command; null if it could not be read")
    machine: str
    verb: str
    accepted: bool
    reason: str = Field(description="why it was refused; empty if it was not")
    events: tuple[str, ...] = Field(description="ids of the alarm events that followed")
