"""The compiled loops over the bytes of a serial port against the libraries that do the same byte by byte."""

from __future__ import annotations

import binascii

import numpy as np
import pytest
from cobs import cobs
from hypothesis import example, given
from hypothesis import strategies as st

from drivers.frames import FrameLayout
from drivers.serial.kernels import crc16, crcs_match, gather, scaled, unstuff

pytestmark = pytest.mark.property
# Runs without a zero around 254 bytes are where the codes of COBS are special.
RUNS = st.lists(
    st.one_of(st.binary(max_size=40), st.integers(250, 260).map(lambda n: b"\x07" * n), st.just(b"\0")),
    max_size=6,
).map(b"".join)


def unstuffed(pieces: list[bytes]) -> list[bytes | None]:
    """What the kernel makes of pieces, none of them empty; None for what is no COBS."""
    buffer = np.frombuffer(b"\0".join(pieces) + b"\0", np.uint8).copy()
    stops = np.flatnonzero(buffer == 0)
    starts = np.concatenate(([0], stops[:-1] + 1))
    lengths = unstuff(buffer, starts, stops)
    return [
        buffer[a + 1 : a + 1 + n].tobytes() if n >= 0 else None
        for a, n in zip(starts.tolist(), lengths.tolist(), strict=True)
    ]


def decoded(piece: bytes) -> bytes | None:
    """The library's answer."""
    try:
        return bytes(cobs.decode(piece))
    except cobs.DecodeError:
        return None


@given(st.lists(RUNS, min_size=1, max_size=5))
def test_what_the_library_stuffs_comes_out_again(bodies: list[bytes]) -> None:
    assert unstuffed([cobs.encode(body) for body in bodies]) == bodies


@given(
    st.lists(
        st.binary(min_size=1, max_size=600).map(lambda b: b.replace(b"\0", b"\1")), min_size=1, max_size=5
    )
)
@example([b"\xff" * 255, b"\xff" * 256, b"\xff" * 510, b"\1", b"\2", b"\xff\1"])
def test_of_anything_at_all_the_kernel_and_the_library_think_the_same(pieces: list[bytes]) -> None:
    assert unstuffed(pieces) == [decoded(piece) for piece in pieces]


@given(before=st.binary(max_size=9), data=st.binary(max_size=100), initial=st.sampled_from([0x0000, 0xFFFF]))
def test_a_crc_is_that_of_the_library(before: bytes, data: bytes, initial: int) -> None:
    buffer = np.frombuffer(before + data + b"\x55", np.uint8).copy()
    crc = crc16(buffer, len(before), len(before) + len(data), initial)
    assert crc == binascii.crc_hqx(data, initial)


@pytest.mark.parametrize("order", ["big", "little"])
@given(
    data=st.lists(st.binary(max_size=40), min_size=1, max_size=5),
    flips=st.lists(st.integers(0, 0xFFFF), min_size=5, max_size=5),
)
def test_only_bodies_that_end_with_their_crc_match(order: str, data: list[bytes], flips: list[int]) -> None:
    sums = [binascii.crc_hqx(body, 0xFFFF) for body in data]
    ends = [(crc ^ flip).to_bytes(2, order) for crc, flip in zip(sums, flips, strict=False)]
    bodies = [body + end for body, end in zip(data, ends, strict=True)]
    lengths = np.array([len(body) for body in bodies])
    buffer = np.frombuffer(b"".join(bodies), np.uint8).copy()
    starts = np.cumsum(lengths) - lengths
    matches = crcs_match(buffer, starts, lengths, 0xFFFF, order == "little")
    assert matches.tolist() == [not flip for flip in flips[: len(data)]]


def test_what_is_too_short_for_a_crc_matches_none() -> None:
    # The CRC of nothing that began with 0 is 0.
    buffer = np.zeros(4, np.uint8)
    assert crcs_match(buffer, np.zeros(4, np.int64), np.array([-1, 0, 1, 2]), 0, False).tolist() == [
        False,
        False,
        False,
        True,
    ]


def test_rows_are_gathered_from_wherever_they_begin() -> None:
    buffer = np.arange(20, dtype=np.uint8)
    assert gather(buffer, np.array([16, 0, 3]), 4).tolist() == [[16, 17, 18, 19], [0, 1, 2, 3], [3, 4, 5, 6]]


@pytest.mark.long
@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize(
    ("bits", "kind"),
    [
        (8, "signed"),
        (16, "unsigned"),
        (16, "signed"),
        (24, "signed"),
        (32, "unsigned"),
        (32, "float"),
        (64, "float"),
    ],
)
@given(data=st.binary(min_size=48, max_size=48))
def test_values_in_units_are_those_of_the_arrays(bits, kind, order, data: bytes) -> None:
    layout = FrameLayout.plain(
        frame_id=0,
        length=24,
        channels=[("x", bits, kind, 0.37, -1.5)],
        samples_per_frame=128 // bits,
        counter_byte=0,
        counter_bits=32,
        first_byte=4,
        byte_order=order,
    )
    payloads = np.frombuffer(data, np.uint8).reshape(2, 24)
    got, want = layout.decode(payloads, scaling=scaled), layout.decode(payloads)
    assert got.counter.tolist() == want.counter.tolist()
    np.testing.assert_array_equal(got.samples, want.samples)
