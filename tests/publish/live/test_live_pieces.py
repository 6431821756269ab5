"""Pieces of a live feed: what goes in comes out, whatever is cut, and a loss is seen."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daqsvc.publish.live.pieces import PIECE_BYTES, BrokenFeedError, Packer, Unpacker


@given(st.lists(st.binary(max_size=200_000), max_size=6), st.integers(0, 10**15 - 1))
def test_lines_come_out_as_they_went_in(lines: list[bytes], feed: int) -> None:
    packer, unpacker = Packer(feed), Unpacker(feed)
    pieces = [packer.pack(one) for one in lines]
    assert all(len(piece) <= PIECE_BYTES + 40 for made in pieces for piece in made)
    for sent, made in zip(lines, pieces, strict=True):
        got = b"".join(unpacker.take(piece) + unpacker.take(piece) for piece in made)
        assert got == sent, "a piece that comes twice counts once"


def test_a_lost_piece_is_seen_and_others_are_left_out() -> None:
    packer, unpacker = Packer(7), Unpacker(7)
    first, second, third = (packer.pack(text)[0] for text in (b"one\n", b"two\n", b"three\n"))
    assert unpacker.take(first) == b"one\n"
    assert unpacker.take(Packer(6).pack(b"of before\n")[0]) == b""
    with pytest.raises(BrokenFeedError, match=re.escape("1 pieces were lost")):
        unpacker.take(third)
    assert unpacker.take(second) == b"two\n"


def test_a_feed_that_begins_anew_under_its_number_is_seen() -> None:
    packer, unpacker = Packer(7), Unpacker(7)
    for text in (b"one\n", b"two\n"):
        unpacker.take(packer.pack(text)[0])
    with pytest.raises(BrokenFeedError, match="begun again"):
        unpacker.take(Packer(7).pack(b"one\n")[0])


@pytest.mark.parametrize("piece", [b"", b"7\n", b"7 0", b"7 x\n", b"-7 0\nx", b"7 0\nno zlib", b"\xff" * 100])
def test_what_is_no_piece_is_refused(piece: bytes) -> None:
    unpacker = Unpacker(7)
    if piece == b"7 0":
        assert unpacker.take(piece) == b""
        return
    with pytest.raises(BrokenFeedError):
        unpacker.take(piece)


def test_a_piece_that_swells_without_end_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("daqsvc.publish.live.pieces.MOST_BYTES", 1000)
    with pytest.raises(BrokenFeedError, match="more than 1000 bytes"):
        Unpacker(1).take(Packer(1).pack(bytes(100_000))[0])
