"""Alarm floods: more alarms than a person can attend to. They are told of and counted; nothing is dropped."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterable

    from daqsvc.settings.alarms import AlarmHandling

MOST_FIRST_OUT = 5
"""Alarms that stood first in their groups and are named: nobody reads a sentence that names a hundred."""


class FloodWatch:
    """Counts what calls for a person, by the monotonic clock.

    Args:
        handling: says how many alarms may call for a person within which time (ISA-18.2 and EEMUA 191 say 10
            in 10 minutes); one more is a flood, which ends when there are fewer than half as many.
    """

    def __init__(self, handling: AlarmHandling) -> None:
        self._most = handling.flood_alarms
        self._window_ns = round(handling.flood_window_s * NS_PER_S)
        self._called_ns: deque[int] = deque()
        self.floods = 0
        self.flooding = False

    def resume(self, now_ns: int) -> None:
        """A flood stood before a restart: it lasts until a whole window shows that it is over."""
        if self._most:
            self.flooding = True
            self._called_ns.extend([now_ns] * (self._most + 1))

    def called(self, now_ns: int) -> None:
        """An alarm has called for a person."""
        if self._most:
            self._called_ns.append(now_ns)

    def sentence(self, now_ns: int, first_out: Iterable[str] = ()) -> str | None:
        """What has changed by ``now_ns``, in words for a person; None if nothing has.

        Args:
            now_ns: monotonic time.
            first_out: the alarms that hold the first-out mark of their group, if any does.
        """
        if not self._most:
            return None
        while self._called_ns and now_ns - self._called_ns[0] > self._window_ns:
            self._called_ns.popleft()
        count, minutes = len(self._called_ns), self._window_ns / 60e9
        if not self.flooding and count > self._most:
            self.flooding = True
            self.floods += 1
            first = list(first_out)
            more = f" and {len(first) - MOST_FIRST_OUT} more" if len(first) > MOST_FIRST_OUT else ""
            named = " and ".join(first[:MOST_FIRST_OUT])
            begin = f"look at {named}{more} first (first out), " if first else ""
            return (
                f"{count} alarms within {minutes:g} min are more than a person can attend to (limit "
                f"{self._most}); {begin}shelve what is known"
            )
        while len(self._called_ns) > self._most + 1:
            # So many say that it is a flood; a longer list of them would only take memory.
            self._called_ns.popleft()
        if self.flooding and 2 * count < self._most:
            self.flooding = False
            return f"only {count} alarms in the last {minutes:g} min"
        return None
