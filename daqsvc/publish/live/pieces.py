"""How lines of JSON go over the broker: one compressed stream in numbered pieces, so that a loss is seen.

A piece is ``<feed> <number>``, a line feed, and bytes of a zlib stream (RFC 1950) that is flushed at its end.
The feed's number is that of the request; pieces count from 0.
"""

from __future__ import annotations

import zlib

PIECE_BYTES = 32 * 1024
"""An alarm waits behind one piece at most: on a line of 64 kbit/s for four seconds."""
LONGEST_HEAD = 48
MOST_BYTES = 8 * 1024 * 1024
"""Of lines that come out of one piece."""
FASTEST = 1
"""Samples hardly get smaller by more effort."""


class BrokenFeedError(ValueError):
    """A piece is missing, or is none; the text states it."""


class Packer:
    """Makes pieces of lines.

    Args:
        feed: its number.
    """

    def __init__(self, feed: int) -> None:
        self._feed = feed
        self._number = 0
        self._stream = zlib.compressobj(FASTEST)

    def pack(self, lines: bytes) -> list[bytes]:
        """The pieces that bring these lines."""
        packed = self._stream.compress(lines) + self._stream.flush(zlib.Z_SYNC_FLUSH)
        pieces = []
        for at in range(0, len(packed), PIECE_BYTES):
            pieces.append(b"%d %d\n" % (self._feed, self._number) + packed[at : at + PIECE_BYTES])
            self._number += 1
        return pieces


class Unpacker:
    """Makes lines of pieces.

    Args:
        feed: its number; pieces of other feeds are left out.
    """

    def __init__(self, feed: int) -> None:
        self._feed = feed
        self._number = 0
        self._stream = zlib.decompressobj()

    def take(self, piece: bytes) -> bytes:
        """The bytes of lines that a piece brings; none of one that has come before, or of another feed.

        Raises:
            BrokenFeedError: pieces before it are missing, or it is no piece.
        """
        head, _, packed = piece[:LONGEST_HEAD].partition(b"\n")
        numbers = head.split(b" ")
        if len(numbers) != 2 or not all(one.isdigit() for one in numbers):
            raise BrokenFeedError("what came is no piece of a live feed")
        feed, number = map(int, numbers)
        if feed == self._feed and number == 0 and self._number > 1:
            raise BrokenFeedError("the feed has begun again")  # whoever sends it has lost the connection
        if feed != self._feed or number < self._number:
            return b""
        if number > self._number:
            raise BrokenFeedError(f"{number - self._number} pieces were lost on the way")
        self._number += 1
        packed = piece[len(head) + 1 :]
        try:
            lines = self._stream.decompress(packed, MOST_BYTES)
        except zlib.error as error:
            raise BrokenFeedError(f"a piece cannot be unpacked ({error})") from None
        if self._stream.eof:
            raise BrokenFeedError("the feed has ended by itself")
        if self._stream.unconsumed_tail:
            raise BrokenFeedError(f"a piece has more than {MOST_BYTES} bytes in it")
        return lines
