"""Chatter: an alarm that comes and goes so often that nobody can read it.

A chattering alarm is neither dropped nor cleared: it stays active, at its worst level, and says so, until
its level has stood still for a while. Its many comings and goings are then one occurrence.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from daqsvc.alarms.states import Level


@dataclass(frozen=True, slots=True)
class ChatterLimit:
    """From when on an alarm chatters.

    Attributes:
        raises: how often it may be raised, escalated or recur within ``window_ns``; once more is chatter.
        window_ns: the time that these are counted over.
        quiet_ns: how long its level must stand still before it no longer chatters. Time over which no data
            came does not count.

    Raises:
        ValueError: no raise is allowed, or a time is not positive.
    """

    raises: int
    window_ns: int
    quiet_ns: int

    def __post_init__(self) -> None:
        if self.raises < 1:
            raise ValueError(f"chatter begins after {self.raises} raises; allow at least 1")
        if self.window_ns <= 0 or self.quiet_ns <= 0:
            raise ValueError(
                f"chatter is counted over {self.window_ns} ns and ends after {self.quiet_ns} ns; "
                "both must be positive"
            )


class ChatterWatch:
    """Counts how often one alarm is raised, by the time of the data.

    Args:
        limit: from when on it chatters; None never.
    """

    def __init__(self, limit: ChatterLimit | None) -> None:
        self._limit = limit
        self._raised_ns: deque[int] = deque()
        self._level: Level | None = None
        self._known_at_ns: int | None = None
        self._still_ns = 0
        self.chattering = False

    def resume(self, *, chattering: bool) -> None:
        """Go on from before a restart; times begin anew."""
        self.chattering = chattering and self._limit is not None

    def raised(self, t_ns: int) -> bool:
        """Note that the alarm called for a person; True if with that it begins to chatter."""
        if self._limit is None:
            return False
        self._raised_ns.append(t_ns)
        while self._raised_ns and t_ns - self._raised_ns[0] > self._limit.window_ns:
            self._raised_ns.popleft()
        while len(self._raised_ns) > self._limit.raises + 1:
            self._raised_ns.popleft()
        if self.chattering or len(self._raised_ns) <= self._limit.raises:
            return False
        self.chattering = True
        self.hold()
        return True

    def quietens(self, level: Level, t_ns: int) -> bool:
        """Take in what level is found while the alarm chatters; True if with that it is quiet.

        Time that runs backwards counts as none.
        """
        if self._limit is None or not self.chattering:
            return False
        if level is not self._level:
            self._level, self._still_ns = level, 0
        elif self._known_at_ns is not None:
            self._still_ns += max(t_ns - self._known_at_ns, 0)
        self._known_at_ns = t_ns
        if self._still_ns < self._limit.quiet_ns:
            return False
        self.chattering = False
        self._raised_ns.clear()
        self._level, self._known_at_ns, self._still_ns = None, None, 0
        return True

    def hold(self) -> None:
        """Data are missing: the time until the next ones does not count as quiet."""
        self._known_at_ns = None
