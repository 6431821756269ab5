"""What a person may ask of an alarm, and what comes of it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol


class Verb(StrEnum):
    """What is asked."""

    ACKNOWLEDGE = "acknowledge"
    """Somebody has seen it."""
    RESET = "reset"
    """Let go of a latched alarm whose condition has gone."""
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
        occurrence: the activation that is meant; if another one stands by now, the command is refused.
            None means whichever stands.
        reason: why, in the person's words; it stands in the event and in the audit log.
    """

    verb: Verb
    alarm: str
    by: str
    duration_s: float | None = None
    occurrence: str | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandOutcome:
    """What came of a command.

    Attributes:
        accepted: whether it was carried out.
        reason: why it was refused; empty if it was not.
        events: ids of the alarm events that followed (`AlarmPayload.id`).
    """

    accepted: bool
    reason: str = ""
    events: tuple[str, ...] = ()


class CommandHandler(Protocol):
    """Carries out commands for a way in (MQTT, the control socket) that has authorised them."""

    async def __call__(self, command: AlarmCommand, source: str) -> CommandOutcome:
        """Carry out ``command``; a refusal is an outcome, not an exception.

        Args:
            command: what is asked.
            source: the way it came, for the audit log, e.g. ``"mqtt"``.
        """
        ...
