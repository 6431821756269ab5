"""Shelving: for how long, and which ends next; what holds where nothing is stated; what all alarms count."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from daqsvc.alarms.states import CommandNotAllowedError
from daqsvc.settings.alarms import AlarmHandling

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.alarms.commands import AlarmCommand

CALM: Final = AlarmHandling(chatter_raises=0, flood_alarms=0, shelve_at_most_s=86_400.0)
"""Where nothing is stated of it: no alarm chatters, and no number of them is a flood."""

_UNITS = ((86_400, "d"), (3600, "h"), (60, "m"))
_LONGEST_S = 1e9
"""Longer times are no more of use in days than in seconds."""
_SLACK = 64
"""Ends of shelving that no longer hold and may stay in the heap, besides as many as hold."""


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


class ShelvingEnds:
    """The ends of shelving, by the monotonic clock, soonest first.

    An alarm that is uncovered before its time may stay in it: the caller looks at the alarm itself.
    """

    def __init__(self) -> None:
        self._until_ns: dict[str, int] = {}
        self._heap: list[tuple[int, str]] = []

    def put(self, alarm: str, until_ns: int) -> None:
        """``alarm`` is shelved until ``until_ns``, whatever was stated of it before."""
        self._until_ns[alarm] = until_ns
        heapq.heappush(self._heap, (until_ns, alarm))
        if len(self._heap) > 2 * len(self._until_ns) + _SLACK:
            # Somebody shelves the same alarms again and again.
            self._heap = [(until_ns, name) for name, until_ns in self._until_ns.items()]
            heapq.heapify(self._heap)

    def due(self, now_ns: int) -> Iterator[str]:
        """The alarms whose time is over by ``now_ns``, each once."""
        while self._heap and self._heap[0][0] <= now_ns:
            until_ns, alarm = heapq.heappop(self._heap)
            if self._until_ns.get(alarm) == until_ns:
                del self._until_ns[alarm]
                yield alarm


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
        annunciations: those that call for a person: raised, escalated, recurred, or no longer covered and
            not acknowledged. A covered alarm calls for nobody.
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
