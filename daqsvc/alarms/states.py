"""Alarm states after ISA-18.2 / IEC 62682 and the one function that moves between them.

An alarm has its own state (`AlarmState.NORMAL` to `AlarmState.LATCHED_ACKNOWLEDGED`), moved by
its condition and by people. It may in addition be held (`Hold`): suppressed because a sensor is not
OK, shelved, or out of service. As in OPC UA Part 9 a hold covers the state without forgetting it: when
it is lifted, a latched alarm is still latched and an unacknowledged one still waits to be acknowledged.
"""

from __future__ import annotations

from enum import Enum, IntEnum, StrEnum
from types import MappingProxyType
from typing import TYPE_CHECKING

from daqsvc.errors.command_line import COMMAND_REFUSED, NO_SUCH_ALARM, NO_SUCH_MACHINE

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from daqsvc.diagnosis.record import Severity


class Level(IntEnum):
    """How bad a condition is; comparable."""

    NORMAL = 0
    ALERT = 1
    DANGER = 2

    @property
    def label(self) -> Severity:
        """The name in payloads and messages."""
        return _LABELS[self]

    @classmethod
    def of(cls, severity: Severity) -> Level:
        """The level of a `Diagnosis.severity`."""
        return cls[severity.upper()]


_LABELS: dict[Level, Severity] = {
    Level.NORMAL: "normal",
    Level.ALERT: "alert",
    Level.DANGER: "danger",
}


class AlarmState(StrEnum):
    """What a consumer learns about an alarm."""

    NORMAL = "normal"
    ACTIVE_UNACKNOWLEDGED = "active_unacknowledged"
    ACTIVE_ACKNOWLEDGED = "active_acknowledged"
    RETURNED_UNACKNOWLEDGED = "returned_unacknowledged"
    """The condition has gone before anybody acknowledged it."""
    LATCHED_UNACKNOWLEDGED = "latched_unacknowledged"
    """The condition has gone, but the alarm latches until it is reset."""
    LATCHED_ACKNOWLEDGED = "latched_acknowledged"
    SHELVED = "shelved"
    SUPPRESSED = "suppressed"
    """A sensor that the alarm rests on is not OK."""
    OUT_OF_SERVICE = "out_of_service"

    @property
    def in_words(self) -> str:
        """The name in a sentence."""
        return self.value.replace("_", " ")

    @property
    def is_active(self) -> bool:
        """Whether the condition stands."""
        return self in _ACTIVE

    @property
    def is_latched(self) -> bool:
        """Whether the alarm outlives its condition until it is reset."""
        return self in _LATCHED


_ACTIVE = frozenset({AlarmState.ACTIVE_UNACKNOWLEDGED, AlarmState.ACTIVE_ACKNOWLEDGED})
_LATCHED = frozenset({AlarmState.LATCHED_UNACKNOWLEDGED, AlarmState.LATCHED_ACKNOWLEDGED})


class Hold(Enum):
    """What can cover the state of an alarm; the strongest one is shown."""

    SHELVED = AlarmState.SHELVED
    SUPPRESSED = AlarmState.SUPPRESSED
    OUT_OF_SERVICE = AlarmState.OUT_OF_SERVICE


HOLDS = frozenset(hold.value for hold in Hold)
"""The states that are covers and not an alarm's own."""

_STRONGEST_FIRST = (Hold.OUT_OF_SERVICE, Hold.SUPPRESSED, Hold.SHELVED)


class Stimulus(StrEnum):
    """What moves an alarm."""

    RAISE = "raise"
    """The condition has come, or has come back."""
    ESCALATE = "escalate"
    """The condition has become worse: what was acknowledged was something else."""
    CLEAR = "clear"
    """The condition has gone."""
    ACKNOWLEDGE = "acknowledge"
    RESET = "reset"


class CommandNotAllowedError(Exception):
    """A person asked for something that the alarm's state does not allow; the text is the reason."""

    code = COMMAND_REFUSED


class UnknownAlarmError(CommandNotAllowedError):
    """There is no alarm of that name, or there are several."""

    code = NO_SUCH_ALARM


class UnknownMachineError(CommandNotAllowedError):
    """There is no machine of that name."""

    code = NO_SUCH_MACHINE


_Moves = dict[tuple[AlarmState, Stimulus], AlarmState]

_MOVES: _Moves = {
    (AlarmState.NORMAL, Stimulus.RAISE): AlarmState.ACTIVE_UNACKNOWLEDGED,
    (AlarmState.ACTIVE_ACKNOWLEDGED, Stimulus.ESCALATE): AlarmState.ACTIVE_UNACKNOWLEDGED,
    (AlarmState.ACTIVE_UNACKNOWLEDGED, Stimulus.ACKNOWLEDGE): AlarmState.ACTIVE_ACKNOWLEDGED,
    (AlarmState.ACTIVE_UNACKNOWLEDGED, Stimulus.CLEAR): AlarmState.RETURNED_UNACKNOWLEDGED,
    (AlarmState.ACTIVE_ACKNOWLEDGED, Stimulus.CLEAR): AlarmState.NORMAL,
    (AlarmState.RETURNED_UNACKNOWLEDGED, Stimulus.RAISE): AlarmState.ACTIVE_UNACKNOWLEDGED,
    (AlarmState.RETURNED_UNACKNOWLEDGED, Stimulus.ACKNOWLEDGE): AlarmState.NORMAL,
    (AlarmState.LATCHED_UNACKNOWLEDGED, Stimulus.RAISE): AlarmState.ACTIVE_UNACKNOWLEDGED,
    (AlarmState.LATCHED_UNACKNOWLEDGED, Stimulus.ACKNOWLEDGE): AlarmState.LATCHED_ACKNOWLEDGED,
    (AlarmState.LATCHED_UNACKNOWLEDGED, Stimulus.RESET): AlarmState.RETURNED_UNACKNOWLEDGED,
    (AlarmState.LATCHED_ACKNOWLEDGED, Stimulus.RAISE): AlarmState.ACTIVE_UNACKNOWLEDGED,
    (AlarmState.LATCHED_ACKNOWLEDGED, Stimulus.RESET): AlarmState.NORMAL,
}

_LATCHING_MOVES: _Moves = _MOVES | {
    (AlarmState.ACTIVE_UNACKNOWLEDGED, Stimulus.CLEAR): AlarmState.LATCHED_UNACKNOWLEDGED,
    (AlarmState.ACTIVE_ACKNOWLEDGED, Stimulus.CLEAR): AlarmState.LATCHED_ACKNOWLEDGED,
}


def moves(*, latching: bool) -> Mapping[tuple[AlarmState, Stimulus], AlarmState]:
    """Every move of an alarm's own state; whatever is not in it moves nothing."""
    return MappingProxyType(_LATCHING_MOVES if latching else _MOVES)


def transition(state: AlarmState, stimulus: Stimulus, *, latching: bool) -> AlarmState:
    """The state after a stimulus.

    What the data reports never fails: a condition that stands already, or has gone already, moves nothing.

    Args:
        state: the alarm's own state, not one of the holds.
        stimulus: what happened.
        latching: whether the alarm outlives its condition until it is reset.

    Raises:
        CommandNotAllowedError: a person's acknowledgement or reset that the state does not allow.
    """
    after = moves(latching=latching).get((state, stimulus))
    if after is not None:
        return after
    if stimulus is Stimulus.ACKNOWLEDGE:
        raise CommandNotAllowedError(f"there is nothing to acknowledge: it is {state.in_words}")
    if stimulus is Stimulus.RESET:
        if state.is_active:
            raise CommandNotAllowedError("its condition is still present; remove the cause, then reset")
        raise CommandNotAllowedError(f"there is nothing to reset: it is {state.in_words}")
    return state


def strongest_first(holds: Collection[Hold]) -> tuple[AlarmState, ...]:
    """The states that ``holds`` show, the one that consumers see first."""
    return tuple(hold.value for hold in _STRONGEST_FIRST if hold in holds) if holds else ()


def shown(state: AlarmState, holds: Collection[Hold]) -> AlarmState:
    """The state that consumers see: the strongest hold, or the alarm's own state if none covers it."""
    return next(iter(strongest_first(holds)), state) if holds else state
