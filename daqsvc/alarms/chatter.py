"""Chatter: an alarm that comes and goes so often that nobody can read it.

A chattering alarm is neither dropped nor cleared: it stays active, at its worst level, and says so, until
its level has stood still for a while. Its many comings and goings are then one occurrence.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S

if TYPE_CHECKING:
    from daqsvc.alarms.states import Level
    from daqsvc.settings.alarms import AlarmHandling


class ChatterWatch:
    """Counts how often one alarm is raised, by the time of the data.

    Args:
        handling: says how often it may be raised, escalated or recur within which time; once more is chatter,
            until its level has stood still for long enough. Time over which no data came does not count.
    """

    def __init__(self, handling: AlarmHandling) -> None:
        self._raises = handling.chatter_raises
        self._window_ns = round(handling.chatter_window_s * NS_PER_S)
        self._quiet_ns = round(handling.chatter_quiet_s * NS_PER_S)
        self._raised_ns: deque[int] = deque()
        self._level: Level | None = None
        self._known_at_ns: int | None = None
        self._still_ns = 0
        self.chattering = False

    def resume(self, *, chattering: bool) -> None:
        """Go on from before a restart; times begin anew."""
        self.chattering = chattering and self._raises > 0

    def raised(self, t_ns: int) -> bool:
        """Note that the alarm called for a person; True if with that it begins to chatter."""
        if not self._raises:
            return False
        self._raised_ns.append(t_ns)
        while self._raised_ns and t_ns - self._raised_ns[0] > self._window_ns:
            self._raised_ns.popleft()
        while len(self._raised_ns) > self._raises + 1:
            self._raised_ns.popleft()
        if self.chattering or len(self._raised_ns) <= self._raises:
            return False
        self.chattering = True
        self.hold()
        return True

    def quietens(self, level: Level, t_ns: int) -> bool:
        """Take in what level is found while the alarm chatters; True if with that it is quiet.

        Time that runs backwards counts as none.
        """
        if not self.chattering:
            return False
        if level is not self._level:
            self._level, self._still_ns = level, 0
        elif self._known_at_ns is not None:
            self._still_ns += max(t_ns - self._known_at_ns, 0)
        self._known_at_ns = t_ns
        if self._still_ns < self._quiet_ns:
            return False
        self.chattering = False
        self._raised_ns.clear()
        self._level, self._known_at_ns, self._still_ns = None, None, 0
        return True

    def hold(self) -> None:
        """Data are missing: the time until the next ones does not count as quiet."""
        self._known_at_ns = None
