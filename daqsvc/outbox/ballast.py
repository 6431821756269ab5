"""Room on the disk that is held for the hour in which somebody else has filled it."""

from __future__ import annotations

import logging
import os
from typing import TYPE_CHECKING

from daqsvc.outbox.files import create, free_bytes, restrict

if TYPE_CHECKING:
    from pathlib import Path

log = logging.getLogger(__name__)


class Ballast:
    """A file without content that is thrown off when the disk is full.

    A full disk would otherwise hold itself full: to delete what is old, SQLite must first write to its log.

    Args:
        path: the file.
        size: its size in bytes; 0 for none.
        reserve_bytes: what must stay free beside it when it is taken on board.
    """

    def __init__(self, path: Path, size: int, reserve_bytes: int) -> None:
        self._path = path
        self._size = size
        self._reserve_bytes = reserve_bytes

    def allocate(self) -> None:
        """Have it on board, if the disk has room enough; without it, everything works all the same."""
        try:
            restrict(self._path)
            if not self._size or self._path.exists():
                return
            if free_bytes(self._path.parent) < self._reserve_bytes + 2 * self._size:
                return
            with os.fdopen(create(self._path, os.O_WRONLY), "wb") as file:
                os.posix_fallocate(file.fileno(), 0, self._size)
        except OSError as error:
            log.info("outbox ballast %s cannot be taken: %s", self._path, error)
            self.throw_off()

    def throw_off(self) -> bool:
        """Give its room to others; whether there was any."""
        try:
            self._path.unlink()
        except OSError:  # not there, or not to be had: there is no room to give
            return False
        return True
