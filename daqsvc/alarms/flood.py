"""Alarm floods: more alarms than a person can attend to. They are told of and counted; nothing is dropped."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

MOST_FIRST_OUT = 5
"""Alarms that stood first in their groups and are named: nobody reads a sentence that names a hundred."""


@dataclass(frozen=True, slots=True)
class FloodLimit:
    """From when on a machine's alarms are a flood (ISA-18.2 and EEMUA 191 say more than 10 in 10 minutes).

    Attributes:
        events: how many alarms may call for a person within ``window_ns``; one more is a flood, which ends
            when there are fewer than half as many.
        window_ns: the time that they are counted over.

    Raises:
        ValueError: no event is allowed, or the time is not positive.
    """

    events: int = 10
    window_ns: int = 600_000_000_000

    def __post_init__(self) -> None:
        if self.events < 1 or self.window_ns <= 0:
            raise ValueError(
                f"a flood of more than {self.events} alarms in {self.window_ns} ns cannot be told; "
                "allow at least 1, over a positive time"
            )


class FloodWatch:
    """Counts what calls for a person, by the monotonic clock.

    Args:
        limit: from when on it is a flood; None never.
    """

    def __init__(self, limit: FloodLimit | None) -> None:
        self._limit = limit
        self._called_ns: deque[int] = deque()
        self.floods = 0
        self.flooding = False

    def resume(self, now_ns: int) -> None:
        """A flood stood before a restart: it lasts until a whole window shows that it is over."""
        if self._limit is not None:
            self.flooding = True
            self._called_ns.extend([now_ns] * (self._limit.events + 1))

    def called(self, now_ns: int) -> None:
        """An alarm has called for a person."""
        if self._limit is not None:
            self._called_ns.append(now_ns)

    def sentence(self, now_ns: int, first_out: Iterable[str] = ()) -> str | None:
        """What has changed by ``now_ns``, in words for a person; None if nothing has.

        Args:
            now_ns: monotonic time.
            first_out: the alarms that hold the first-out mark of their group, if any does.
        """
        limit = self._limit
        if limit is None:
            return None
        while self._called_ns and now_ns - self._called_ns[0] > limit.window_ns:
            self._called_ns.popleft()
        count, minutes = len(self._called_ns), limit.window_ns / 60e9
        if not self.flooding and count > limit.events:
            self.flooding = True
            self.floods += 1
            first = list(first_out)
            more = f" and {len(first) - MOST_FIRST_OUT} more" if len(first) > MOST_FIRST_OUT else ""
            named = " and ".join(first[:MOST_FIRST_OUT])
            begin = f"look at {named}{more} first (first out), " if first else ""
            return (
                f"{count} alarms within {minutes:g} min are more than a person can attend to (limit "
                f"{limit.events}); {begin}shelve what is known"
            )
        while len(self._called_ns) > limit.events + 1:
            # So many say that it is a flood; a longer list of them would only take memory.
            self._called_ns.popleft()
        if self.flooding and 2 * count < limit.events:
            self.flooding = False
            return f"only {count} alarms in the last {minutes:g} min"
        return None
