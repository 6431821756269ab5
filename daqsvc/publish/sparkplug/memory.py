"""What an edge node must remember over restarts: the number of its session, and what hosts have received."""

from __future__ import annotations

import json
import logging
from typing import TYPE_CHECKING

from daqsvc.errors.code import coded
from daqsvc.errors.outputs import OUTPUT_STATE
from daqsvc.outbox.files import replace_durably
from daqsvc.publish.sparkplug.node import NUMBERS

if TYPE_CHECKING:
    from pathlib import Path

log = logging.getLogger(__name__)


class Memory:
    """Two numbers in a file; every method blocks on the disk.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.bd_seq = 0
        """Number of the next session, 0 to 255."""
        self.cursor: int | None = None
        """The last message of the outbox that a broker has taken; None if there has been no session."""
        self._failed = False

    def load(self) -> None:
        """Read the file; one that is absent or cannot be read begins again, which is logged."""
        try:
            self.bd_seq, self.cursor = _understood(self._path.read_bytes())
        except FileNotFoundError:
            return
        except (OSError, ValueError, KeyError, TypeError) as error:
            log.warning(
                "Sparkplug memory %s cannot be read (%s): the session's number begins again, and alarms of "
                "the time before are not sent to Sparkplug hosts; it is replaced at the next connection",
                self._path,
                error,
                extra=coded(OUTPUT_STATE),
            )

    def begin_session(self, cursor: int) -> None:
        """The broker has accepted a session with `bd_seq`: the next one gets another number.

        Args:
            cursor: where to begin in the outbox if nothing was sent yet.
        """
        self.cursor = cursor if self.cursor is None else self.cursor
        self._save((self.bd_seq + 1) % NUMBERS, self.cursor)

    def advance(self, cursor: int) -> None:
        """A broker has taken everything up to here."""
        self._save(self.bd_seq, cursor)

    def _save(self, bd_seq: int, cursor: int | None) -> None:
        """Keep both; on a disk that takes no writes in memory only, for alarms must go out even so."""
        self.bd_seq, self.cursor = bd_seq, cursor
        try:
            replace_durably(self._path, json.dumps({"bd_seq": bd_seq, "cursor": cursor}).encode())
        except OSError as error:
            if not self._failed:
                log.warning(
                    "Sparkplug memory %s cannot be written: %s; a restart before it can sends alarms again",
                    self._path,
                    error,
                    extra=coded(OUTPUT_STATE),
                )
            self._failed = True
        else:
            self._failed = False


def _understood(raw: bytes) -> tuple[int, int | None]:
    numbers = json.loads(raw)
    bd_seq, cursor = numbers["bd_seq"], numbers["cursor"]
    if not (isinstance(bd_seq, int) and 0 <= bd_seq < NUMBERS and isinstance(cursor, int | None)):
        raise ValueError(f"bd_seq {bd_seq!r} and cursor {cursor!r}")
    return bd_seq, cursor
