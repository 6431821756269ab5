"""Mistakes of this program that must not cost the connection: said once, and counted."""

from __future__ import annotations

import logging
import traceback
from typing import Final

log = logging.getLogger(__name__)

MOST_CAUSES: Final = 32
"""Causes that are remembered as said; after these nothing more is said, only counted."""


class Faults:
    """What went wrong that nobody has thought of.

    Attributes:
        count: how often.
    """

    def __init__(self) -> None:
        self.count = 0
        self._said: set[tuple[str, str]] = set()

    def note(self, what: str, error: Exception) -> None:
        """Count an error, and say each cause once, in one line that names where it came from.

        Args:
            what: what could not be done, and what follows.
            error: the reason.
        """
        self.count += 1
        frames = traceback.extract_tb(error.__traceback__)
        where = f"{frames[-1].filename.rpartition('/')[2]}:{frames[-1].lineno}" if frames else "?"
        cause = (what, f"{type(error).__name__} at {where}")
        if cause in self._said or len(self._said) >= MOST_CAUSES:
            return
        self._said.add(cause)
        log.error("%s: %s (%.200s); please report this", what, cause[1], ascii(str(error)))
