"""Which topics make a broker end the connection: what MQTT 3.1.1 has instead of a refusal.

A broker of MQTT 3.1.1 cannot refuse one message. Some take it and drop it; others end the connection, and
would again with every attempt, while everything else waits. So after such losses one message is sent at a
time: the one that is under way when the connection ends is suspect, and after the second time its topic is
left alone for a while.
"""

from __future__ import annotations

from collections import Counter

CAREFUL_LOSSES = 2
"""After so many losses in a row, with messages under way, one is sent at a time."""

STRIKES = 2
"""A topic that was alone under way so often is left alone."""

FIRST_BAR_S = 300.0
LONGEST_BAR_S = 6 * 3600.0
"""How long it is, at first and at most: each attempt costs a connection."""

REASON = "the broker ends the connection when it is sent: it is not allowed to this client, or too large"


class Suspects:
    """What was under way when connections were lost."""

    def __init__(self) -> None:
        self._losses = 0
        self._strikes: Counter[str] = Counter()
        self._bars: dict[str, tuple[float, float]] = {}
        """By topic, until when it is barred, and for how long the next time."""

    @property
    def careful(self) -> bool:
        """Whether one message is to be sent at a time."""
        return self._losses >= CAREFUL_LOSSES

    def barred(self, now_s: float) -> dict[str, str]:
        """The topics that are left alone, and why."""
        return {topic: REASON for topic, (until_s, _) in self._bars.items() if now_s < until_s}

    def reason(self, topic: str, now_s: float) -> str | None:
        """Why nothing is to be sent on a topic now; None if it may."""
        until_s, _ = self._bars.get(topic, (now_s, 0.0))
        return REASON if now_s < until_s else None

    def lost(self, under_way: tuple[str, ...], now_s: float) -> str | None:
        """A connection has ended; the topic that is barred for it, if any.

        Args:
            under_way: topics of the messages that had no answer yet.
            now_s: time.
        """
        again = [topic for topic in under_way if topic in self._bars]
        if again:
            return self._bar(again[0], now_s)
        if not under_way:
            return None
        self._losses += 1
        if len(under_way) > 1:
            return None
        self._strikes[under_way[0]] += 1
        return self._bar(under_way[0], now_s) if self._strikes[under_way[0]] >= STRIKES else None

    def acknowledged(self, topic: str) -> None:
        """The broker has taken a message."""
        self._strikes.pop(topic, None)
        self._bars.pop(topic, None)

    def settled(self) -> None:
        """A connection has lasted: the next loss is the first of others."""
        self._losses = 0

    def away(self) -> None:
        """The broker cannot be reached: that, and no message, was why connections ended."""
        self._losses = 0
        self._strikes.clear()

    def _bar(self, topic: str, now_s: float) -> str:
        _, for_s = self._bars.get(topic, (0.0, FIRST_BAR_S))
        self._bars[topic] = now_s + for_s, min(2 * for_s, LONGEST_BAR_S)
        self._losses = CAREFUL_LOSSES  # there may be more of them
        self._strikes.clear()
        return topic
