"""When shelving ends: who is next, however many alarms are shelved."""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

_SLACK = 64
"""Ends that no longer hold and may stay in the heap, besides as many as hold."""


class ShelvingEnds:
    """The ends of shelving, by the monotonic clock, soonest first.

    An alarm that is uncovered before its time may stay in it: whoever asks looks at the alarm itself.
    """

    def __init__(self) -> None:
        self._until_ns: dict[str, int] = {}
        self._heap: list[tuple[int, str]] = []

    def put(self, alarm: str, until_ns: int) -> None:
        """``alarm`` is shelved until ``until_ns``, whatever was said of it before."""
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
