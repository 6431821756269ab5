"""Checksums at the end of frames, of many frames at once.

A CRC is linear over XOR: every byte adds its own part, which depends only on how far it is from the end. So
the CRCs of all frames are parts from a table, combined by XOR along each frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray


class Checksum(Protocol):
    """What can be at the end of a frame."""

    @property
    def size(self) -> int:
        """Bytes that it takes."""

    def of(self, rows: NDArray[np.uint8]) -> NDArray[np.int64]:
        """The checksum of each row: uint8 ``[n, length]`` to int64 ``[n]``."""


@dataclass(frozen=True, slots=True)
class Crc:
    """A CRC, named as in the catalogue of parametrised CRC algorithms (reveng.sourceforge.io).

    Attributes:
        size: bytes, 1 or 2.
        polynomial: without its highest bit; of a reflected CRC with its bits in reverse order.
        initial: value before the first byte.
        reflected: whether the least significant bit of a byte goes first.
    """

    size: int
    polynomial: int
    initial: int = 0
    reflected: bool = False

    def of(self, rows: NDArray[np.uint8]) -> NDArray[np.int64]:
        """The CRC of each row: uint8 ``[n, length]`` to int64 ``[n]``."""
        length = rows.shape[1]
        parts, start = _parts(self, 1 << max(length - 1, 0).bit_length())
        far = np.arange(length - 1, -1, -1)
        crcs: NDArray[np.int64] = np.bitwise_xor.reduce(parts[far, rows], axis=1).astype(np.int64)
        return crcs ^ int(start[length])

    def _behind_zeros(self, crcs: NDArray[np.int64]) -> NDArray[np.int64]:
        """CRCs, int64 of any shape, after one more byte, which is 0."""
        bits = 8 * self.size
        for _ in range(8):
            if self.reflected:
                crcs = crcs >> 1 ^ np.where(crcs & 1, self.polynomial, 0)
            else:
                high = crcs >> (bits - 1) & 1
                crcs = (crcs << 1 & (1 << bits) - 1) ^ np.where(high, self.polynomial, 0)
        return crcs

    def parts_of_bytes(self, length: int) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """What each byte of a frame adds to the CRC.

        Returns:
            uint16 ``[length, 256]``, by the bytes behind it and its value; uint16 ``[length + 1]``, what the
            initial value adds, by the length of the frame.
        """
        crcs = np.arange(256, dtype=np.int64)
        if not self.reflected:
            crcs <<= 8 * self.size - 8
        starts = np.array([self.initial], np.int64)
        parts, start = np.empty((length, 256), np.uint16), np.empty(length + 1, np.uint16)
        start[0] = self.initial
        for far in range(length):
            crcs, starts = self._behind_zeros(crcs), self._behind_zeros(starts)
            parts[far], start[far + 1] = crcs, starts[0]
        return parts, start


@cache
def _parts(crc: Crc, length: int) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    return crc.parts_of_bytes(length)


class _Sum:
    """All bytes added, modulo 256."""

    size = 1

    def of(self, rows: NDArray[np.uint8]) -> NDArray[np.int64]:
        """The sum of each row: uint8 ``[n, length]`` to int64 ``[n]``."""
        sums: NDArray[np.int64] = rows.sum(axis=1, dtype=np.int64) & 0xFF
        return sums


class _Xor:
    """All bytes combined by XOR."""

    size = 1

    def of(self, rows: NDArray[np.uint8]) -> NDArray[np.int64]:
        """The XOR of each row: uint8 ``[n, length]`` to int64 ``[n]``."""
        combined: NDArray[np.int64] = np.bitwise_xor.reduce(rows, axis=1).astype(np.int64)
        return combined


CHECKSUMS: Mapping[str, Checksum] = {
    "ibm-3740": Crc(2, 0x1021, 0xFFFF),
    "xmodem": Crc(2, 0x1021),
    "modbus": Crc(2, 0xA001, 0xFFFF, reflected=True),
    "arc": Crc(2, 0xA001, reflected=True),
    "kermit": Crc(2, 0x8408, reflected=True),
    "crc-8": Crc(1, 0x07),
    "sum-8": _Sum(),
    "xor-8": _Xor(),
}
"""By name; the first two are those that the driver checks."""
