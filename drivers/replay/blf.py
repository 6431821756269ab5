"""What python-can does not look at in a BLF file: that its end is one, and how large its containers get."""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING, Any

from can.io.blf import (
    LOG_CONTAINER,
    LOG_CONTAINER_STRUCT,
    NO_COMPRESSION,
    OBJ_HEADER_BASE_STRUCT,
    ZLIB_DEFLATE,
)

if TYPE_CHECKING:
    from daqsvc.confined.limits import Budget

LARGEST_OBJECT = 64_000_000
"""Bytes of an object in a file; writers begin a new container after some 100 kB."""

_LONGEST_PADDING = 3


class BlfFile:
    """A BLF file as python-can's reader reads it, piece by piece.

    python-can takes a file that is cut in the middle of an object for whole, and unpacks a container whatever
    it grows to. Here the former is an error, and containers come unpacked, as far as the budget goes.

    Args:
        file: open for binary reading.
        budget: of the file.
    """

    def __init__(self, file: Any, budget: Budget) -> None:
        self.close = file.close
        self._file = file
        self._budget = budget
        self._cut = False
        self._in_container = False

    def read(self, length: int) -> bytes:
        """The next bytes; of a container, what it unpacks to.

        Raises:
            EOFError: the file ends in the middle of an object.
            ValueError: an object is too large.
            zlib.error: a container is damaged.
        """
        if length > LARGEST_OBJECT:
            raise ValueError(f"an object says that it has {length:,} bytes")
        data: bytes = self._file.read(length)
        if length <= _LONGEST_PADDING:
            return data
        if self._cut and not data:
            raise EOFError("it ends in the middle of a container")
        # What there is of the last object may hold frames yet.
        self._cut = 0 < len(data) < length
        if self._in_container:
            self._in_container = False
            return self._unpacked(data)
        self._in_container = _is_header_of_container(data, length)
        return data

    def _unpacked(self, data: bytes) -> bytes:
        if len(data) < LOG_CONTAINER_STRUCT.size:
            return data
        method, size = LOG_CONTAINER_STRUCT.unpack_from(data)
        if method != ZLIB_DEFLATE:
            return data
        unpacked = zlib.decompressobj().decompress(
            data[LOG_CONTAINER_STRUCT.size :], self._budget.left_bytes + 1
        )
        self._budget.spend(len(unpacked))
        return LOG_CONTAINER_STRUCT.pack(NO_COMPRESSION, size) + unpacked


def _is_header_of_container(data: bytes, length: int) -> bool:
    if length != OBJ_HEADER_BASE_STRUCT.size or len(data) < length:
        return False
    try:
        signature, *_, kind = OBJ_HEADER_BASE_STRUCT.unpack(data)
    except struct.error:
        return False
    return bool(signature == b"LOBJ" and kind == LOG_CONTAINER)
