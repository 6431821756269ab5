"""Checksums of many frames at once are those of the catalogue, and of a loop over bits."""

from __future__ import annotations

import binascii

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.examples import examples

from drivers.serial.checksums import CHECKSUMS

CHECK_VALUES = {
    "ibm-3740": 0x29B1,
    "xmodem": 0x31C3,
    "modbus": 0x4B37,
    "arc": 0xBB3D,
    "kermit": 0x2189,
    "crc-8": 0xF4,
    "sum-8": 0xDD,
    "xor-8": 0x31,
}
"""Of the digits 1 to 9, from the catalogue of parametrised CRC algorithms (reveng.sourceforge.io)."""


def rows(*frames: bytes) -> np.ndarray:
    return np.array([list(frame) for frame in frames], np.uint8)


@pytest.mark.parametrize("name", CHECKSUMS)
def test_the_check_value_is_that_of_the_catalogue(name: str) -> None:
    assert CHECKSUMS[name].of(rows(b"123456789")).tolist() == [CHECK_VALUES[name]]


@settings(max_examples=examples(50), deadline=None)
@given(length=st.integers(0, 300), count=st.integers(0, 4), seed=st.integers(0, 1000))
def test_each_row_has_the_checksum_of_its_own_bytes(length: int, count: int, seed: int) -> None:
    frames = np.random.default_rng(seed).integers(0, 256, (count, length), np.uint8)
    for name, initial in (("ibm-3740", 0xFFFF), ("xmodem", 0)):
        assert CHECKSUMS[name].of(frames).tolist() == [
            binascii.crc_hqx(bytes(row), initial) for row in frames
        ]


@settings(max_examples=examples(50), deadline=None)
@given(frame=st.binary(min_size=1, max_size=80), name=st.sampled_from(["modbus", "arc", "xmodem", "crc-8"]))
def test_a_frame_with_its_crc_behind_it_has_a_crc_of_0(frame: bytes, name: str) -> None:
    what = CHECKSUMS[name]
    order = "little" if name in {"modbus", "arc"} else "big"
    end = int(what.of(rows(frame))[0]).to_bytes(what.size, order)
    assert what.of(rows(frame + end)).tolist() == [0]
