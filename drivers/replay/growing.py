"""A candump log that another process is writing, as a recording."""

from __future__ import annotations

import io
import os
from typing import TYPE_CHECKING

import numpy as np
from can.io.canutils import CanutilsLogReader

from drivers.replay.can_log import PIECE_FRAMES, recorded_ns
from drivers.replay.files import RecordedLogError
from drivers.replay.lines import LONGEST_LINE, TextLog

if TYPE_CHECKING:
    from pathlib import Path

    import can

    from drivers.frames import DecodedBatch
    from drivers.replay.can_log import Sort

CHUNK_BYTES = 1 << 20


class Place:
    """How far a growing log has been read; outlives its closing, so that nothing is read twice."""

    def __init__(self) -> None:
        self.file: tuple[int, int] | None = None
        self.offset = 0


class GrowingCandump:
    """A candump log that another process is writing, read as it grows; like ``tail -F``.

    Lines that are no frames are counted in ``frames_malformed`` and left out.

    Args:
        path: the file.
        sort: sorts messages with their times to streams.
        place: how far the file has been read before; kept up to date.

    Raises:
        RecordedLogError: the file cannot be opened.
    """

    def __init__(self, path: Path, sort: Sort, place: Place) -> None:
        self._path = path
        self._sort = sort
        self._place = place
        self._pending: list[can.Message] = []
        self._malformed = 0
        self.first_malformed = ""
        self._rest = b""
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise RecordedLogError(f"{path} cannot be opened: {error.strerror}") from error
        status = os.fstat(self._file.fileno())
        if place.file != (status.st_dev, status.st_ino) or place.offset > status.st_size:
            place.file, place.offset = (status.st_dev, status.st_ino), 0
        self._file.seek(place.offset)

    def read(self, span_ns: int) -> DecodedBatch | None:
        """See `RecordedLog.read`; never at the end.

        Raises:
            RecordedLogError: the file has been taken away, replaced or cut short, and what was in it is read.
        """
        if not self._pending:
            self._read_on()
        if not self._pending and not self._malformed:
            self._see_that_it_is_still_there()
        first_ns = recorded_ns(self._pending[0]) if self._pending else 0
        n = next(
            (k for k, m in enumerate(self._pending[:PIECE_FRAMES]) if recorded_ns(m) - first_ns > span_ns),
            min(len(self._pending), PIECE_FRAMES),
        )
        messages, self._pending = self._pending[:n], self._pending[n:]
        decoded = self._sort(messages, np.array([recorded_ns(m) for m in messages], np.int64))
        decoded.note("frames_malformed", self._malformed)
        self._malformed = 0
        return decoded

    def _read_on(self) -> None:
        try:
            chunk = self._file.read(CHUNK_BYTES)
        except OSError as error:
            raise RecordedLogError(f"{self._path} cannot be read: {error.strerror}") from error
        whole, newline, rest = (self._rest + chunk).rpartition(b"\n")
        if not newline and len(rest) > LONGEST_LINE:
            # No line of a log is as long: bound what is held for the end of one.
            whole, rest = rest, b""
        self._rest = rest
        self._place.offset = self._file.tell() - len(rest)
        if whole:
            lines = candump_log(whole.decode("ascii", "replace"))
            self._pending = list(lines)
            self._malformed = lines.malformed
            self.first_malformed = self.first_malformed or lines.first_malformed

    def _see_that_it_is_still_there(self) -> None:
        try:
            status = self._path.stat()
        except OSError as error:
            raise RecordedLogError(f"{self._path} is gone: {error.strerror}") from error
        if (status.st_dev, status.st_ino) != self._place.file:
            raise RecordedLogError(f"{self._path} has been replaced by another file")
        if status.st_size < self._place.offset:
            raise RecordedLogError(f"{self._path} has been cut short")

    def close(self) -> None:
        """See `RecordedLog.close`."""
        self._file.close()


def candump_log(text: str) -> TextLog:
    """The frames in lines of a candump log."""
    return TextLog(io.StringIO(text), CanutilsLogReader)
