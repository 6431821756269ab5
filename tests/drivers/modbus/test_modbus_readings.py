"""What registers can mean: against the driver's own decoding, and what is taken for a quantity."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.examples import examples

from drivers.modbus.readings import ORDERS, arranged, chosen, readings
from drivers.modbus.registers import byte_places
from drivers.modbus.settings import RegisterChannel

pytestmark = pytest.mark.property


def registers(raw: bytes, order: str, at: int = 0) -> dict[int, int]:
    """Registers that hold a number, as a device of this order has them."""
    words = [raw[k : k + 2] for k in range(0, len(raw), 2)]
    words = words[::-1] if order in {"CDAB", "DCBA"} else words
    kind = "little" if order in {"BADC", "DCBA"} else "big"
    return {at + k: int.from_bytes(word, kind) for k, word in enumerate(words)}


@settings(max_examples=examples(60), deadline=None)
@given(words=st.lists(st.integers(0, 65_535), min_size=4, max_size=4), order=st.sampled_from(ORDERS))
@pytest.mark.parametrize(("kind", "count"), [("float32", 2), ("int32", 2), ("uint32", 2), ("float64", 4)])
def test_a_number_is_read_as_the_driver_reads_it(kind: str, count: int, words: list[int], order: str) -> None:
    channel = RegisterChannel.model_validate({"name": "x", "address": 0, "type": kind, "order": order})
    raw = np.frombuffer(b"".join(word.to_bytes(2, "big") for word in words[:count]), np.uint8)
    theirs = raw[byte_places(channel)].tobytes()
    assert arranged(words[:count], order) == theirs
    found = {(one.type, one.order): one.value for one in readings(dict(enumerate(words)), {}, 0)}
    code = {"float32": ">f", "int32": ">i", "uint32": ">I", "float64": ">d"}[kind]
    assert found[kind, order] == pytest.approx(float(struct.unpack(code, theirs)[0]), nan_ok=True)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("seed", range(5))
def test_floats_that_move_smoothly_are_found_with_their_order(order: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = 10 ** rng.uniform(-2, 5, 12)
    first, second = {}, {}
    for k, value in enumerate(values):
        first |= registers(struct.pack(">f", value), order, 2 * k)
        second |= registers(struct.pack(">f", value * rng.uniform(0.99, 1.01)), order, 2 * k)
    found = {one.address: one for one in chosen(first, second) if (one.type, one.order) == ("float32", order)}
    right = [k for k in range(len(values)) if 2 * k in found]
    assert len(right) >= 9
    for k in right:
        assert found[2 * k].value == pytest.approx(values[k], rel=1e-6)


def test_a_setting_of_few_digits_is_a_float_though_it_does_not_move() -> None:
    first = registers(struct.pack(">f", 42.5), "CDAB", 10)
    [one] = chosen(first, first)
    assert (one.address, one.type, one.order, one.value) == (10, "float32", "CDAB", 42.5)


def test_bits_that_jump_and_zeros_are_no_floats() -> None:
    rng = np.random.default_rng(1)
    first = {k: int(value) for k, value in enumerate(rng.integers(0, 65_536, 100))}
    second = {k: int(value) for k, value in enumerate(rng.integers(0, 65_536, 100))}
    assert len(chosen(first, second)) < 15
    nothing = dict.fromkeys(range(20), 0)
    assert chosen(nothing, nothing) == []


def test_a_count_of_32_bits_is_found_once_its_upper_register_carries() -> None:
    assert chosen({0: 7, 1: 1480}, {0: 7, 1: 1482}) == []
    first = registers((1_245_180).to_bytes(4, "big"), "ABCD")
    second = registers((1_245_190).to_bytes(4, "big"), "ABCD")
    assert [(one.type, one.order, one.value) for one in chosen(first, second)] == [
        ("int32", "ABCD", 1_245_180)
    ]
