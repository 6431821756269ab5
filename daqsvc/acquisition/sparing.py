"""How often what comes and goes may say so in the log."""

from __future__ import annotations

import time
from collections import deque

from daqsvc.acquisition.clock import NS_PER_S

SAID_AT_MOST, SAID_WITHIN_NS = 3, 60 * NS_PER_S

OFTEN = "; it comes and goes, which is said three times a minute at most"
"""To be added to what is said for the third time."""


class Sparing:
    """Lets a trouble be said three times a minute at most, and its end only if the trouble was said."""

    def __init__(self) -> None:
        self._said_ns: deque[int] = deque(maxlen=SAID_AT_MOST)
        self._standing = False

    @property
    def often(self) -> bool:
        """Whether nothing more is said for now."""
        return len(self._said_ns) == SAID_AT_MOST

    def may_say(self) -> bool:
        """Whether the trouble that there is now is to be said; if so, it counts as said.

        To be asked again while it lasts: what could not be said at first can be later.
        """
        if self._standing:
            return False
        # Real time, whatever the service's clock is: this is about how much goes into the log.
        now_ns = time.monotonic_ns()
        if self.often and now_ns - self._said_ns[0] < SAID_WITHIN_NS:
            return False
        while self._said_ns and now_ns - self._said_ns[0] >= SAID_WITHIN_NS:
            self._said_ns.popleft()
        self._said_ns.append(now_ns)
        self._standing = True
        return True

    def may_take_back(self) -> bool:
        """Whether the end of the trouble is to be said: once, if the trouble was."""
        was, self._standing = self._standing, False
        return was
