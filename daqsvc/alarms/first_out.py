"""First-out: which alarm of a group came first, kept until the group is normal again.

An alarm stands from its raise until it is normal, reset and acknowledged. One that a person has shelved or
taken out of service does not stand; one that is suppressed by a bad sensor does. While any alarm of a group
stands, exactly one holds the mark, whatever became of it since.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.alarms.states import AlarmState

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from daqsvc.alarms.events import AlarmEvent

_SET_ASIDE = frozenset({AlarmState.SHELVED, AlarmState.OUT_OF_SERVICE})


class FirstOut:
    """Follows the events of all alarms and says which of them is first-out.

    Args:
        groups: the group of each alarm that has one.
    """

    def __init__(self, groups: Mapping[str, str]) -> None:
        self._groups = groups
        self._standing: dict[str, set[str]] = {}
        self._first: dict[str, str] = {}

    def resume(self, told: Iterable[AlarmEvent]) -> None:
        """Go on from before a restart.

        Args:
            told: the last event of each alarm, in the order in which they were told: of several that claim
                the mark the latest is right, the others' groups have been normal since.
        """
        for event in told:
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
