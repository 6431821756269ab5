"""What many alarms at once are to a person: floods, and which alarm of a group came first."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarms.states import AlarmState
from daqsvc.rounding import counted

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from daqsvc.alarms.events import AlarmEvent
    from daqsvc.settings.alarms import AlarmHandling


MOST_NAMED = 5
"""Alarms or streams that the message names at most: a sentence with a hundred names is not read."""


class FloodWatch:
    """Counts the alarms that call for a person. A flood is reported; no alarm is dropped.

    Args:
        handling: shows how many alarms may call for a person within which time (ISA-18.2 and EEMUA 191 say 10
            in 10 minutes). One more is a flood, which ends when there are fewer than half as many. Alarms
            about sensors and the service count, too: a person has to attend to each. Covered ones do not.
    """

    def __init__(self, handling: AlarmHandling) -> None:
        self._most = handling.flood_alarms
        self._window_ns = round(handling.flood_window_s * NS_PER_S)
        self._called_ns: deque[int] = deque()
        self.floods = 0
        self.flooding = False

    def resume(self, now_ns: int) -> None:
        """A flood was active before a restart: it lasts until a whole window shows that it is over."""
        if self._most:
            self.flooding = True
            self._called_ns.extend([now_ns] * (self._most + 1))

    def called(self, now_ns: int) -> None:
        """An alarm has called for a person."""
        if self._most:
            self._called_ns.append(now_ns)

    def sentence(self, now_ns: int, advice: Callable[[], str] = str) -> str | None:
        """What has changed by ``now_ns``, in words for a person; None if nothing has.

        Args:
            now_ns: monotonic time.
            advice: where to look first, as `where_to_look` states it; asked for when a flood begins.
        """
        if not self._most:
            return None
        while self._called_ns and now_ns - self._called_ns[0] > self._window_ns:
            self._called_ns.popleft()
        count, minutes = len(self._called_ns), self._window_ns / 60e9
        if not self.flooding and count > self._most:
            self.flooding = True
            self.floods += 1
            return (
                f"{count} alarms within {minutes:g} min are more than a person can attend to (limit "
                f"{self._most}); {advice()}shelve what is known"
            )
        while len(self._called_ns) > self._most + 1:
            # This many show that it is a flood; a longer list of them would only take memory.
            self._called_ns.popleft()
        if self.flooding and 2 * count < self._most:
            self.flooding = False
            return f"only {counted(count, 'alarm')} in the last {minutes:g} min"
        return None


def where_to_look(first_out: Iterable[str], unjudged_streams: Mapping[str, int]) -> str:
    """Where to look first in a flood, as the beginning of a sentence; empty if that is not known.

    Args:
        first_out: the alarms that hold the first-out mark of their group and stand.
        unjudged_streams: streams of which nothing comes that could be judged, with how many sensors rest on
            each: one device that is lost is an alarm for each of them.
    """
    lost = {stream: sensors for stream, sensors in unjudged_streams.items() if sensors > 1}
    first = list(first_out)
    if lost:
        streams = _some([f"stream {stream!r}" for stream in lost])
        then = f"then at {_some(first)} (first out), " if first else ""
        return f"{sum(lost.values())} sensors rest on {streams}: look at bus and device first, {then}"
    return f"look at {_some(first)} first (first out), " if first else ""


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return " and ".join(names[:MOST_NAMED]) + more


_SET_ASIDE = frozenset({AlarmState.SHELVED, AlarmState.OUT_OF_SERVICE})


class FirstOut:
    """Follows the events of all alarms and states which of a group came first, until that is normal again.

    An alarm stands from its raise until it is normal, reset and acknowledged. One that a person has shelved
    or taken out of service does not stand; one that is suppressed by a bad sensor does. While any alarm of a
    group stands, exactly one holds the mark, whatever became of it since.

    Args:
        groups: the group of each alarm that has one.
    """

    def __init__(self, groups: Mapping[str, str]) -> None:
        self._groups = groups
        self._standing: dict[str, set[str]] = {}
        self._first: dict[str, str] = {}

    def resume(self, events: Iterable[AlarmEvent]) -> None:
        """Go on from before a restart.

        Args:
            events: the last event of each alarm, in the order in which they were published: of several
                that claim the mark the latest is right, the others' groups have been normal since.
        """
        for event in events:
            group = self._groups.get(event.alarm)
            if group is None:
                continue
            if _stands(event):
                self._standing.setdefault(group, set()).add(event.alarm)
            if event.first_out:
                self._first[group] = event.alarm
        for group in list(self._first):
            if not self._standing.get(group):
                del self._first[group]

    def marks(self, event: AlarmEvent) -> bool:
        """Take in an event; whether its alarm is the first-out of its group after it."""
        group = self._groups.get(event.alarm)
        if group is None:
            return False
        standing = self._standing.setdefault(group, set())
        if _stands(event):
            standing.add(event.alarm)
            self._first.setdefault(group, event.alarm)
        else:
            standing.discard(event.alarm)
        if not standing:
            self._first.pop(group, None)
        return self.is_first(event.alarm)

    def marked(self) -> Iterator[str]:
        """The alarms that hold the mark of their group, by name; sorted only once somebody looks."""
        yield from sorted(self._first.values())

    def is_first(self, alarm: str) -> bool:
        """Whether ``alarm`` holds the mark of its group."""
        group = self._groups.get(alarm)
        return group is not None and self._first.get(group) == alarm


def _stands(event: AlarmEvent) -> bool:
    return event.own_state is not AlarmState.NORMAL and _SET_ASIDE.isdisjoint(event.holds)
