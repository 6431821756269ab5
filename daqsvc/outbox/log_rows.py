"""The messages in pages of a write-ahead log or a database, whatever SQLite reports of it.

For SQLite a log ends before its first wrong checksum: one flipped bit takes all that was committed behind it.
But messages have their own checksums. So the pages in the log are read one by one, and each message that
is whole counts; so do the pages of a database whose first one, with the tables' definitions, is lost.
Formats: https://www.sqlite.org/fileformat2.html, "The Write-Ahead Log" and "B-tree Pages".
"""

from __future__ import annotations

import struct
from functools import partial
from typing import TYPE_CHECKING, TypeAlias

from daqsvc.outbox.tables import sound_row

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from mmap import mmap

    from daqsvc.outbox.tables import Row

    Salts: TypeAlias = tuple[int, int]
    Frame: TypeAlias = tuple[int, bytes]
    Value: TypeAlias = int | bytes | None

PAGE_BYTES = 4096
"""Page of a file that SQLite makes by default."""

_SIZES = {1 << power for power in range(9, 17)}
_HEADER_BYTES, _FRAME_HEADER_BYTES, _PAGE_HEADER_BYTES = 32, 24, 8
_FIRST_PAGE = b"SQLite format 3"
_TABLE_LEAF = 13
_COLUMNS = 7
_INTEGER_BYTES = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}
_CONSTANTS: dict[int, int | None] = {0: None, 8: 0, 9: 1}
_FIRST_BLOB = 12
_VARINT_BYTES = 9
_LONGEST = 4 * 1024 * 1024
"""Bytes of a message beyond which its length is damage."""


def rows_in(log: bytes) -> dict[int, Row]:
    """The messages in a log, by number, each as it was written last.

    Args:
        log: the file's content; any part of it may be damaged.
    """
    if len(log) < _HEADER_BYTES:
        return {}
    stated = struct.unpack_from(">I", log, 8)[0]
    sizes = {PAGE_BYTES, stated} & _SIZES
    return {row[0]: row for size in sorted(sizes) for row in _rows(log, size)}


def _rows(log: bytes, size: int) -> Iterator[Row]:
    frames = list(_frames(log, size))
    places: dict[int, list[int]] = {}
    for place, (number, _) in enumerate(frames):
        places.setdefault(number, []).append(place)

    def overflow(number: int, near: int) -> bytes:
        """The page of that number; of several copies the one written together with its message."""
        return frames[min(places[number], key=lambda place: abs(place - near))][1]

    for place, (_, page) in enumerate(frames):
        if not page.startswith(_FIRST_PAGE):  # the tables' definitions
            yield from _rows_of(page, partial(overflow, near=place))


def rows_in_pages(content: bytes | mmap) -> Iterator[Row]:
    """The messages in a database, page by page; one may come twice, as it was before and after a change.

    Args:
        content: the file's content; any part of it may be damaged.
    """

    def page(number: int) -> bytes:
        return content[(number - 1) * PAGE_BYTES : number * PAGE_BYTES]

    for number in range(1, len(content) // PAGE_BYTES + 1):
        if content[(number - 1) * PAGE_BYTES] == _TABLE_LEAF:
            yield from _rows_of(page(number), page)


def _rows_of(page: bytes, overflow: Callable[[int], bytes]) -> Iterator[Row]:
    count = min(struct.unpack_from(">H", page, 3)[0], (len(page) - _PAGE_HEADER_BYTES) // 2)
    for start in struct.unpack_from(f">{count}H", page, _PAGE_HEADER_BYTES):
        try:
            row = _row(page, start, overflow)
        except (IndexError, KeyError, ValueError, struct.error):
            continue  # no message, or a damaged one
        if row is not None:
            yield row


def _frames(log: bytes, size: int) -> Iterator[Frame]:
    """Number and content of the pages of this log, not of those that it has begun to overwrite."""
    whole = range(_HEADER_BYTES, len(log) - _FRAME_HEADER_BYTES - size + 1, _FRAME_HEADER_BYTES + size)
    if not whole:
        return
    now: Salts = struct.unpack_from(">II", log, 16)
    first: Salts = struct.unpack_from(">II", log, whole[0] + 8)
    if not _are_alike(now, first):
        now = first  # the header is damaged, or the log has just begun again
    for at in whole:
        if _are_alike(now, struct.unpack_from(">II", log, at + 8)):
            start = at + _FRAME_HEADER_BYTES
            yield struct.unpack_from(">I", log, at)[0], log[start : start + size]


def _are_alike(one: Salts, other: Salts) -> bool:
    """A new log has two new salts; if only one differs, it is damaged."""
    return one[0] == other[0] or one[1] == other[1]


def _row(page: bytes, start: int, overflow: Callable[[int], bytes]) -> Row | None:
    size, at = _varint(page, start)
    number, at = _varint(page, at)
    most = len(page) - 35
    if not 0 < size <= _LONGEST:
        return None
    local = size
    if size > most:
        least = (len(page) - 12) * 32 // 255 - 23
        local = least + (size - least) % (len(page) - 4)
        local = local if local <= most else least
    record = page[at : at + local]
    if size > local:
        following = struct.unpack_from(">I", page, at + local)[0]
        parts = [record]
        missing = size - local
        while missing > 0:
            more = overflow(following)
            if len(more) <= 4:
                return None
            following = struct.unpack_from(">I", more)[0]
            parts.append(more[4 : 4 + missing])
            missing -= len(parts[-1])
        record = b"".join(parts)
    values = _values(record)
    if len(record) < size or len(values) != _COLUMNS:
        return None
    return sound_row((number, *values[1:]), set())


def _values(record: bytes) -> list[Value]:
    header_bytes, at = _varint(record, 0)
    kinds: list[int] = []
    while at < header_bytes and len(kinds) <= _COLUMNS:
        kind, at = _varint(record, at)
        kinds.append(kind)
    values: list[Value] = []
    at = header_bytes
    for kind in kinds:
        if kind in _CONSTANTS:
            values.append(_CONSTANTS[kind])
            continue
        length = _INTEGER_BYTES[kind] if kind < _FIRST_BLOB else (kind - _FIRST_BLOB) // 2
        content = record[at : at + length]
        values.append(int.from_bytes(content, signed=True) if kind < _FIRST_BLOB else content)
        at += length
    return values


def _varint(content: bytes, at: int) -> tuple[int, int]:
    """A number, and where what follows it begins."""
    value = 0
    for index in range(_VARINT_BYTES - 1):
        byte = content[at + index]
        value = value << 7 | byte & 0x7F
        if byte < 0x80:
            return value, at + index + 1
    return value << 8 | content[at + _VARINT_BYTES - 1], at + _VARINT_BYTES
