"""Whether an MDF 4 file is whole is asked before asammdf reads it.

asammdf trusts the sizes that blocks state: where they are damaged it asks for gigabytes, or follows links for
minutes. Layout: ASAM MDF 4.1, "Measurement Data Format".
"""

from __future__ import annotations

import math
import mmap
import struct
from typing import TYPE_CHECKING, NamedTuple

from daqsvc.errors.recordings import DAMAGED
from daqsvc.recording import RecordingError
from daqsvc.recording.contents import MOST_COLUMNS, check_columns

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from daqsvc.confined.limits import Budget

FIRST_AT = 64
"""Where the header block begins."""

HEAD = struct.Struct("<4s4xQQ")
ZIPPED = struct.Struct("<2sBxIQQ")
GROUP = struct.Struct("<QQHH4xII")
CHANNEL = struct.Struct("<BBBBII")
ARRAY = struct.Struct("<BBH")

DATA = frozenset({b"##DT", b"##DV", b"##DI", b"##RD", b"##SD", b"##RV", b"##RI"})
"""Blocks of nothing but bytes, without links."""

LEAST_LINKS = {b"##HD": 6, b"##DG": 4, b"##CG": 6, b"##CN": 8, b"##DL": 1, b"##HL": 1, b"##CC": 4}

IN_RECORDS = frozenset({0, 1, 2, 4, 5})
"""Kinds of channel whose bits lie in the records: not virtual ones."""

FORMULA = 3
"""Kind of a conversion whose text would be evaluated."""


class _Block(NamedTuple):
    kind: bytes
    links: tuple[int, ...]
    body: memoryview


class _DamageError(ValueError):
    """The structure is not that of an MDF file."""


def check_mdf_structure(path: Path, budget: Budget) -> None:
    """Follow every link of a file.

    Args:
        path: the file.
        budget: of the file; what its blocks unpack to is counted.

    Raises:
        RecordingError: the file is damaged or cut short.
        TooLargeError: it unpacks to more than it may, or has too many channels.
    """
    with path.open("rb") as file:
        content = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    try:
        _File(content, budget).check()
    except (_DamageError, struct.error) as damage:
        raise RecordingError(
            f"{path} cannot be read: {damage}; it is damaged or cut short: copy or save it again", DAMAGED
        ) from None


class _File:
    """The blocks of a file.

    Args:
        content: the file.
        budget: of it.
    """

    def __init__(self, content: memoryview, budget: Budget) -> None:
        self._content = content
        self._budget = budget

    def check(self) -> None:
        """See `check_mdf_structure`."""
        seen, ahead = {FIRST_AT}, [FIRST_AT]
        channels = 0
        while ahead:
            block = self._block(ahead.pop())
            channels += block.kind == b"##CN"
            check_columns(channels)
            for link in block.links:
                if link and link not in seen:
                    seen.add(link)
                    ahead.append(link)
            if block.kind == b"##DG":
                self._check_group(block)
            if block.kind == b"##CA":
                _check_array(block)
            if block.kind == b"##DZ":
                self._budget.check_declared(_unpacked_bytes(block))

    def _block(self, at: int, *kinds: bytes) -> _Block:
        """The block at an address, of one of these kinds if any are given."""
        if not FIRST_AT <= at <= len(self._content) - HEAD.size:
            raise _DamageError(f"a link leads to byte {at:,} of {len(self._content):,}")
        kind, size, count = HEAD.unpack_from(self._content, at)
        if kind[:2] != b"##" or (kinds and kind not in kinds):
            raise _DamageError(f"{kind!r} stands where a block belongs")
        if size > len(self._content) - at or HEAD.size + 8 * count > size or count < LEAST_LINKS.get(kind, 0):
            raise _DamageError(f"a block {kind.decode('ascii', 'replace')!r} of {size:,} bytes does not fit")
        links = struct.unpack_from(f"<{count}Q", self._content, at + HEAD.size)
        return _Block(kind, links, self._content[at + HEAD.size + 8 * count : at + size])

    def _chain(self, at: int, kind: bytes, *, by: int = 0) -> Iterator[_Block]:
        """Blocks of which each links to the next."""
        seen = set()
        while at:
            if at in seen:
                raise _DamageError("blocks link to each other in a circle")
            seen.add(at)
            block = self._block(at, kind)
            yield block
            at = block.links[by]

    def _check_group(self, group: _Block) -> None:
        """Whether the records of channel groups are there, and the channels inside of them."""
        have = self._data_bytes(group.links[2])
        identity = group.body[0]
        need = 0
        for one in self._chain(group.links[1], b"##CG"):
            _, cycles, flags, _, record, invalidation = GROUP.unpack_from(one.body)
            if flags & 1:  # samples of variable length, which other channels point to
                need += cycles * identity
                continue
            need += cycles * (identity + record + invalidation)
            self._budget.check_declared(8.0 * cycles)
            for channel in self._chain(one.links[1], b"##CN"):
                kind, _, _, bit, byte, bits = CHANNEL.unpack_from(channel.body)
                if kind in IN_RECORDS and byte + (bit + bits + 7) // 8 > record + invalidation:
                    raise _DamageError("a channel lies outside of its records")
        if need > have:
            raise _DamageError(f"records of {need:,} bytes should be there, and {have:,} bytes are")

    def _data_bytes(self, at: int) -> int:
        """The bytes of records that a link leads to, unpacked."""
        if not at:
            return 0
        block = self._block(at)
        if block.kind == b"##HL":
            return self._data_bytes_of_list(block.links[0])
        if block.kind in {b"##DL", b"##LD"}:
            return self._data_bytes_of_list(at)
        return _data_bytes_of(block)

    def _data_bytes_of_list(self, at: int) -> int:
        total = 0
        kind = self._block(at, b"##DL", b"##LD").kind if at else b"##DL"
        for one in self._chain(at, kind):
            total += sum(_data_bytes_of(self._block(link)) for link in one.links[1:] if link)
        return total


def _data_bytes_of(block: _Block) -> int:
    if block.kind == b"##DZ":
        return _unpacked_bytes(block)
    if block.kind not in DATA:
        raise _DamageError(f"a block {block.kind.decode('ascii', 'replace')!r} stands where samples belong")
    return len(block.body)


def _unpacked_bytes(block: _Block) -> int:
    *_, unpacked, packed = ZIPPED.unpack_from(block.body)
    if packed > len(block.body) - ZIPPED.size:
        raise _DamageError(f"a packed block of {packed:,} bytes has {len(block.body) - ZIPPED.size:,}")
    return int(unpacked)


def _check_array(block: _Block) -> None:
    """Whether an array in each record is of a size that one may have."""
    _, _, dimensions = ARRAY.unpack_from(block.body)
    sizes = struct.unpack_from(f"<{dimensions}Q", block.body, 16)
    if math.prod(sizes) > MOST_COLUMNS:
        raise _DamageError("an array in each record is too large")
