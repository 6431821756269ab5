"""A copy of the write-ahead log that an unclean end has left, until nothing of it is known to be missing.

When it opens the journal, SQLite cuts off what follows a wrong checksum, overwrites it or deletes the
log. What it takes over is in the journal afterwards, so that the log alone must be kept.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from daqsvc.outbox.files import ASIDE_KEPT, NS_PER_MS, read_whole, replace_durably, sync_directory
from daqsvc.outbox.log_rows import rows_in

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.outbox.tables import Row

log = logging.getLogger(__name__)

MOST_BYTES = 64 * 1024 * 1024
"""Of a longer log the beginning is copied; logs of more than a few MiB are not to be expected."""

ASIDE_SUFFIX = "-log"
"""How the names of logs end that were set aside."""


class LogCopy:
    """The copy.

    Args:
        path: the journal.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._log = path.with_name(path.name + "-wal")
        self._copy = path.with_name(path.name + ".log-copy")
        self._contents: list[bytes] = []
        self._was_emptied = False

    @property
    def was_emptied(self) -> bool:
        """Whether the journal had lost all its content but for the log."""
        return self._was_emptied

    @property
    def is_there(self) -> bool:
        """Whether an unclean end has left a log."""
        return bool(self._contents)

    def copy(self) -> None:
        """Copy the log, before SQLite opens the journal; a copy that an earlier start could not use counts.

        Raises:
            OSError: the log cannot be read.
        """
        contents = [_content(self._copy), _content(self._log)]
        # After a try that failed, memory may be all that has it.
        self._contents = list(dict.fromkeys(content for content in (*self._contents, *contents) if content))
        self._was_emptied |= self.is_there and not (self._path.exists() and self._path.stat().st_size)
        if contents[0] or not contents[1]:
            return
        try:
            replace_durably(self._copy, contents[1])
        except OSError as error:
            self._copy.with_name(self._copy.name + ".new").unlink(missing_ok=True)
            log.info("the log of outbox %s is copied to memory only: %s", self._path, error)

    def rows(self) -> dict[int, Row]:
        """The messages in it, by number."""
        return {number: row for content in self._contents for number, row in rows_in(content).items()}

    def keep(self, wall_ns: int) -> Path | None:
        """Set the copy aside, for a person to look at; the oldest of more than `ASIDE_KEPT` are deleted.

        Returns:
            Its name; None if the disk had no room for it.

        Raises:
            OSError: it cannot be renamed.
        """
        self._contents, self._was_emptied = [], False
        if not self._copy.exists():
            return None
        aside = self._path.with_name(f"{self._path.name}.corrupt-{wall_ns // NS_PER_MS}{ASIDE_SUFFIX}")
        self._copy.rename(aside)
        earlier = sorted(self._path.parent.glob(f"{self._path.name}.corrupt-*{ASIDE_SUFFIX}"))
        for old in earlier[:-ASIDE_KEPT]:
            old.unlink(missing_ok=True)
        sync_directory(self._path.parent)
        return aside

    def discard(self) -> None:
        """Nothing of it is missing.

        Raises:
            OSError: it cannot be deleted.
        """
        self._contents, self._was_emptied = [], False
        self._copy.unlink(missing_ok=True)


def _content(path: Path) -> bytes:
    try:
        return read_whole(path, MOST_BYTES)
    except FileNotFoundError:
        return b""
