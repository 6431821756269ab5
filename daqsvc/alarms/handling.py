"""For how long an alarm may be shelved, and what all alarms count."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from daqsvc.alarms.states import CommandNotAllowedError
from daqsvc.settings.alarms import AlarmHandling

if TYPE_CHECKING:
    from daqsvc.alarms.commands import AlarmCommand

_UNITS = ((86_400, "d"), (3600, "h"), (60, "m"))
CALM: Final = AlarmHandling(chatter_raises=0, flood_alarms=0, shelve_at_most_s=86_400.0)
"""Where nothing is said of it: no alarm chatters, and no number of them is a flood."""

_LONGEST_S = 1e9
"""Longer times are no more of use in days than in seconds."""


def shelving_ns(command: AlarmCommand, longest_s: float) -> int:
    """How long a command shelves, in ns.

    Args:
        command: what is asked.
        longest_s: the longest time that an alarm may be shelved for.

    Raises:
        CommandNotAllowedError: it states no time, or a longer one than is allowed.
    """
    duration_s = command.duration_s
    if duration_s is None or not math.isfinite(duration_s) or not 0 < duration_s <= longest_s:
        stated = "no time" if duration_s is None else in_units(duration_s)
        raise CommandNotAllowedError(
            f"cannot shelve {command.alarm} for {stated}; "
            f"state a time above 0 and up to {in_units(longest_s)}"
        )
    return round(duration_s * 1e9)


def in_units(duration_s: float) -> str:
    """A time as people write it after ``--for``, e.g. ``8h`` or ``1h30m``.

    Args:
        duration_s: the time in s; what is no time, such as a negative one, stays a number of seconds.
    """
    if not 0.0 < duration_s < _LONGEST_S:
        return f"{duration_s:g} s"
    left_s, words = duration_s, ""
    for size_s, unit in _UNITS:
        count, left_s = divmod(left_s, size_s)
        words += f"{count:.0f}{unit}" if count else ""
    return f"{words}{left_s:g}s" if left_s or not words else words


@dataclass(slots=True)
class AlarmCounters:
    """What has happened since the service started.

    Attributes:
        events: all events.
        annunciations: those that call for a person: raised, escalated, recurred.
        chattering: how often an alarm began to chatter.
        floods: how often alarms came faster than a person can attend to.
        commands: what people asked for and got.
        refused: what they asked for and did not get.
    """

    events: int = 0
    annunciations: int = 0
    chattering: int = 0
    floods: int = 0
    commands: int = 0
    refused: int = 0
