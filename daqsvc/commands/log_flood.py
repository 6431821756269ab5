"""A limit for whatever is logged again and again: by the message, and by the thing it is about."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import logging
    from collections.abc import Callable, Hashable

MOST, WITHIN_S = 20, 60.0
"""Lines of one cause within so long."""
LAST = f" (further lines like this are left out for {WITHIN_S:g} s)"
MOST_CAUSES = 1000
"""Causes that are remembered; beyond that the one that has begun first is forgotten."""


@dataclass(slots=True)
class _Window:
    since_s: float
    written: int = 0
    left_out: int = 0


class LogFlood:
    """Lets 20 lines a minute of each cause into the log, and states that there were more.

    What goes and comes back states it sparingly by itself; this is for unexpected floods. The cause is
    the text of the line before its figures are filled in, with the first of them: mostly the name of a thing.

    Args:
        now_s: monotonic clock, in s.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._lock = threading.Lock()
        self._windows: dict[Hashable, _Window] = {}

    def addition(self, record: logging.LogRecord) -> str | None:
        """What to add to a line, often nothing; None if it is not to be written. From any thread."""
        first = f"{record.args[0]}" if isinstance(record.args, tuple) and record.args else ""
        cause = (record.name, record.levelno, f"{record.msg}", first)
        now_s = self._now_s()
        with self._lock:
            window = self._windows.get(cause)
            if window is None or now_s - window.since_s >= WITHIN_S:
                left_out = 0 if window is None else window.left_out
                self._windows.pop(cause, None)
                if len(self._windows) >= MOST_CAUSES:
                    del self._windows[next(iter(self._windows))]
                self._windows[cause] = _Window(now_s, written=1)
                return f" ({left_out} lines like this were left out)" if left_out else ""
            if window.written >= MOST:
                window.left_out += 1
                return None
            window.written += 1
            return LAST if window.written == MOST else ""
