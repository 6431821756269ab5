"""What a person may ask of an alarm or a machine, how that is written, and what comes of it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Protocol, TypeAlias

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

if TYPE_CHECKING:
    from typing import Self

    from pydantic_core import ErrorDetails


class Verb(StrEnum):
    """What is asked."""

    ACKNOWLEDGE = "acknowledge"
    """Somebody has seen it."""
    RESET = "reset"
    """Return a latched alarm to normal whose condition has gone."""
    SHELVE = "shelve"
    """Cover it for a stated time."""
    UNSHELVE = "unshelve"
    """Uncover it before that time is over."""
    BYPASS = "bypass"
    """Take it out of service until somebody puts it back."""
    UNBYPASS = "unbypass"
    """Put it back into service."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmCommand:
    """One wish about one alarm.

    Attributes:
        verb: what is asked.
        alarm: name of the alarm, e.g. ``"rotor-fault"``.
        by: who asks.
        duration_s: how long to shelve, in seconds; None for every other verb.
        occurrence: the activation that is meant; if another is active by now, the command is refused.
            None means whichever stands.
        reason: why, in the person's words; it is in the event and in the audit log.
        machine: whose alarm; None for the one machine that has an alarm of that name.
        denied: why the person may not ask for it, if that is known: then it is logged, and refused.
    """

    verb: Verb
    alarm: str
    by: str
    duration_s: float | None = None
    occurrence: str | None = None
    reason: str = ""
    machine: str | None = None
    denied: str = ""


class MachineVerb(StrEnum):
    """What is asked of a machine as a whole."""

    SNAPSHOT = "snapshot"
    """Write down what it does now."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SnapshotRequest:
    """One wish for a snapshot.

    Attributes:
        machine: of which machine.
        by: who asks.
        reason: why, in the person's words; it is in the snapshot and in the audit log.
        verb: what is asked.
    """

    machine: str
    by: str
    reason: str = ""
    verb: MachineVerb = MachineVerb.SNAPSHOT


def printable(text: str) -> str:
    """Text that changes nothing in a terminal, nor the order of the letters around it.

    Control characters (C0 and C1), line and paragraph separators and what turns the direction of writing are
    none (Unicode categories Other and Separator, but for the space).

    Raises:
        ValueError: it is something else.
    """
    if not text.isprintable():
        raise ValueError("must be printable, in one line")
    return text


Line: TypeAlias = Annotated[
    str,
    AfterValidator(printable),
    Field(
        json_schema_extra={
            "pattern": r"^[^\x00-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff]*$"
        }
    ),
]
"""Printable text in one line; the pattern is what a schema can state of that."""
Person: TypeAlias = Annotated[Line, Field(min_length=1, max_length=100)]
Reason: TypeAlias = Annotated[Line, Field(max_length=500)]
DurationS: TypeAlias = Annotated[float, Field(gt=0)]


class JsonCommand(BaseModel):
    """A command as JSON."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @classmethod
    def read(cls, raw: bytes) -> Self:
        """The command in JSON without deep nesting.

        Raises:
            ValidationError: it is none.
            ValueError: a key is there twice: it is not known which one is meant.
        """
        message = cls.model_validate_json(raw)
        json.loads(raw, object_pairs_hook=_once)
        return message


class CommandMessage(JsonCommand):
    """A command to an alarm: what all ways in have in common. The keys in their order are each way's."""

    if TYPE_CHECKING:
        alarm: str
        by: str
        duration_s: float | None
        occurrence: str | None
        reason: str

    def command(self, verb: Verb, machine: str | None = None) -> AlarmCommand:
        """What it asks for by ``verb``, of a machine if it states of which."""
        return AlarmCommand(
            verb=verb,
            alarm=self.alarm,
            by=self.by,
            duration_s=self.duration_s,
            occurrence=self.occurrence,
            reason=self.reason,
            machine=machine,
        )


def faults_of(error: ValidationError, whole: str) -> list[str]:
    """What is wrong with a command, each with its key.

    Args:
        error: what `JsonCommand` states.
        whole: what the command as a whole is called.
    """
    return [
        f"{'.'.join(map(str, fault['loc'])) or whole}: {_words(fault)}"
        for fault in error.errors(include_url=False)
    ]


_WORDS = {
    "missing": "is missing",
    "extra_forbidden": "there is no such key",
    "json_invalid": "is no JSON: {error}",
    "json_type": "is no JSON",
    "model_type": "must be a JSON object",
    "string_type": "must be a text",
    "too_short": "must not be empty",
    "too_long": "must have {max_length} characters at most",
    "string_pattern_mismatch": "must match {pattern}",
    "float_type": "must be a number",
    "finite_number": "must be a finite number",
    "greater_than": "must be above {gt:g}",
    "literal_error": "must be {expected}",
    "enum": "must be {expected}",
    "timezone_aware": "must have an offset from UTC, e.g. 2026-01-31T12:00:00Z",
    "datetime_type": "must be a time, e.g. 2026-01-31T12:00:00Z",
    "datetime_parsing": "must be a time, e.g. 2026-01-31T12:00:00Z",
    "datetime_from_date_parsing": "must be a time, e.g. 2026-01-31T12:00:00Z",
    "datetime_object_invalid": "must be a time, e.g. 2026-01-31T12:00:00Z",
}
"""What is wrong, by the type of the error."""


def _words(fault: ErrorDetails) -> str:
    if fault["type"] in _WORDS:
        return _WORDS[fault["type"]].format(**fault.get("ctx", {}))
    # What checks of our own find pydantic marks by their exception.
    return fault["msg"].removeprefix("Value error, ")


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandOutcome:
    """What came of a command.

    Attributes:
        accepted: whether it was carried out.
        reason: why it was refused; if it was accepted, empty, or why a restart may undo it.
        code: the id of the code of that reason; None if there is none.
        events: ids of the alarm events that followed (`AlarmPayload.id`).
        path: file of the snapshot that was made, on the box.
    """

    accepted: bool
    reason: str = ""
    code: str | None = None
    events: tuple[str, ...] = ()
    path: str = ""


class CommandHandler(Protocol):
    """Carries out commands for a way in (MQTT, the control socket) that has authorised them."""

    async def __call__(self, command: AlarmCommand, source: str) -> CommandOutcome:
        """Carry out ``command``; a refusal is an outcome, not an exception.

        Args:
            command: what is asked.
            source: the way it came, for the audit log, e.g. ``"mqtt"``.
        """
        ...


class SnapshotHandler(Protocol):
    """Has snapshots made for a way in that has authorised them."""

    async def __call__(self, command: SnapshotRequest, source: str) -> CommandOutcome:
        """Have one made, and wait until it is complete; a refusal is an outcome, not an exception.

        Args:
            command: what is asked.
            source: the way it came, for the audit log.
        """
        ...


def _once(pairs: list[tuple[str, object]]) -> dict[str, object]:
    made = dict(pairs)
    if len(made) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in made if keys.count(key) > 1)
        raise ValueError(f"key {twice!a} is there twice; write it once")
    return made
