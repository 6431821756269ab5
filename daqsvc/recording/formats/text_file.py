"""The lines of a text file that may be packed, in one of several encodings, and larger than it looks."""

from __future__ import annotations

import gzip
import io
import struct
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, cast

from daqsvc.confined.limits import CountedFile
from daqsvc.recording.errors import RecordingError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from typing import BinaryIO

    from daqsvc.confined.limits import Budget

_BYTE_ORDER_MARKS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}

_BUFFER_BYTES = 1 << 18
_GZIP_TRAILER_BYTES = 8


class TextFile:
    """A text file in UTF-16 (if a byte order mark says so), UTF-8, or else Latin-1.

    Args:
        path: the file; gzipped if it ends in ``.gz``.
        budget: of the file; each reading of it may take as much.
    """

    def __init__(self, path: Path, budget: Budget) -> None:
        self._path = path
        self._budget = budget
        self._zipped = path.name.lower().endswith(".gz")
        with self._open() as file:
            mark = file.read(2)
            if self._zipped and _declared_bytes(path) > budget.most_bytes:
                # Said at the end of the file, which is anything where that is cut off: so count.
                counted = CountedFile(file, replace(budget))
                while counted.read(_BUFFER_BYTES):
                    pass
        self._encoding = _BYTE_ORDER_MARKS.get(mark, "utf-8-sig")

    @property
    def may_be_latin_1(self) -> bool:
        """Whether another encoding can be tried where this one fails."""
        return self._encoding == "utf-8-sig"

    def take_for_latin_1(self) -> None:
        """Try that."""
        self._encoding = "latin-1"

    def lines(self) -> Iterator[str]:
        r"""Its lines, with ``\n`` at their ends.

        Raises:
            UnicodeDecodeError: it is not in UTF-8.
            RecordingError: it is not in UTF-16 though it says so.
            TooLargeError: it unpacks to too much.
        """
        with self._open() as file:
            counted = io.BufferedReader(CountedFile(file, replace(self._budget)), _BUFFER_BYTES)
            with io.TextIOWrapper(counted, self._encoding) as text:
                try:
                    yield from text
                except UnicodeError as error:
                    if self.may_be_latin_1:
                        raise
                    raise RecordingError(
                        f"{self._path} cannot be read: it is no text in UTF-16, as its first two bytes say "
                        f"({error}); save it as CSV in UTF-8"
                    ) from None

    @contextmanager
    def _open(self) -> Iterator[BinaryIO]:
        with self._path.open("rb") as raw:
            if self._zipped:
                with gzip.open(raw) as file:
                    yield cast("BinaryIO", file)
            else:
                yield raw


def _declared_bytes(path: Path) -> int:
    """What a gzip file says at its end that it unpacks to."""
    with path.open("rb") as file:
        size = file.seek(0, io.SEEK_END)
        if size <= _GZIP_TRAILER_BYTES:
            return 0
        file.seek(-4, io.SEEK_END)
        return int(struct.unpack("<I", file.read(4))[0])
