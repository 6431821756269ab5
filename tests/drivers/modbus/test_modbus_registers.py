"""Registers: every order of words and bytes against `struct`, there and back, and the plan of requests."""

from __future__ import annotations

import itertools
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.examples import examples
from support.modbus_layouts import register

from drivers.frames import LayoutError
from drivers.modbus.registers import RegisterRecord, RegisterRun, RunLimits, plan_runs

pytestmark = pytest.mark.property
FORMATS = {
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
ORDERS = ("ABCD", "CDAB", "BADC", "DCBA")


def reordered(big_endian: bytes, order: str) -> bytes:
    """The bytes of a number as the device sends them: an independent reading of the four letters."""
    words = [big_endian[k : k + 2] for k in range(0, len(big_endian), 2)]
    if order in ("CDAB", "DCBA"):
        words.reverse()
    if order in ("BADC", "DCBA"):
        words = [word[::-1] for word in words]
    return b"".join(words)


@pytest.mark.parametrize("order", ORDERS)
def test_the_letters_are_the_places_of_the_bytes_of_a_32_bit_number(order):
    record = RegisterRecord((register("x", 0, "uint32", order),), (RegisterRun(0, 2),))
    on_wire = dict(zip("ABCD", b"\x12\x34\x56\x78", strict=True))
    raw = np.frombuffer(bytes(on_wire[letter] for letter in order), np.uint8)
    assert record.decode(raw[None])[0, 0] == np.float32(0x12345678)


@st.composite
def number(draw):
    kind = draw(st.sampled_from(sorted(FORMATS)))
    if kind == "float32":
        value = draw(st.floats(width=32, allow_nan=False, allow_infinity=False))
    elif kind == "float64":
        value = draw(st.floats(-1e30, 1e30))
    else:
        info = np.iinfo(kind)
        value = draw(st.integers(int(info.min), int(info.max)))
    return kind, draw(st.sampled_from(ORDERS)), value


@given(st.lists(number(), min_size=1, max_size=12), st.integers(1, 4))
def test_any_mix_decodes_as_struct_packs_it(numbers, rows):
    fields, raw, expected = [], b"", []
    for k, (kind, order, value) in enumerate(numbers):
        packed = struct.pack(f">{FORMATS[kind]}", value)
        fields.append(register(f"c{k}", 100 + len(raw) // 2, kind, order))
        raw += reordered(packed, order)
        expected.append(np.float32(struct.unpack(f">{FORMATS[kind]}", packed)[0]))
    record = RegisterRecord(tuple(fields), (RegisterRun(100, len(raw) // 2),))
    data = np.frombuffer(raw * rows, np.uint8).reshape(rows, -1)
    np.testing.assert_array_equal(record.decode(data), np.tile(expected, (rows, 1)))


@given(
    st.lists(st.tuples(st.sampled_from(sorted(FORMATS)), st.sampled_from(ORDERS)), min_size=1, max_size=10)
)
def test_what_is_encoded_decodes_to_the_same(kinds):
    fields, place = [], 0
    for k, (kind, order) in enumerate(kinds):
        fields.append(register(f"c{k}", place, kind, order, scale=0.5, offset=-3.0))
        place += fields[-1].registers + k % 2  # a hole behind every second one
    record = RegisterRecord(tuple(fields), (RegisterRun(0, place),))
    # Halves that every type holds: unsigned ones nothing below the offset.
    samples = np.linspace(-3.0, 2000.0, 5 * len(fields)).reshape(5, -1).round()
    np.testing.assert_array_equal(record.decode(record.encode(samples)), samples.astype(np.float32))


@given(st.integers(0, 2**16 - 1), st.integers(0, 15), st.integers(1, 16))
def test_bits_of_a_register_share_it(word, lowest, width):
    width = min(width, 16 - lowest)
    fields = (register("part", 7, "uint16", bits=(lowest, width)), register("all", 7, "uint16"))
    record = RegisterRecord(fields, (RegisterRun(7, 1),))
    raw = np.frombuffer(word.to_bytes(2, "big"), np.uint8)[None]
    assert record.decode(raw).tolist() == [[(word >> lowest) & (2**width - 1), word]]


@pytest.mark.parametrize(
    ("kind", "order", "marks", "sent"),
    [
        ("int16", "ABCD", (0x7FFF,), [32_767, 32_766]),
        ("int16", "BADC", (0x7FFF, 0x8000), [-32_768, -1]),  # the bits of the manual, of a number with sign
        ("int16", "ABCD", (-32_768,), [-32_768, 32_767]),
        ("uint16", "ABCD", (0xFFFF,), [65_535, 32_767]),
        ("uint32", "CDAB", (0xFFFF_FFFF,), [2**32 - 1, 2**31 - 1]),
        ("uint64", "ABCD", (-1,), [2**64 - 1, 2**64 - 2]),  # TOML has no number so large
        ("int64", "DCBA", (2**63 - 1,), [2**63 - 1, 2**63 - 2]),  # as floats the two are the same
        ("float32", "CDAB", (-9999,), [-9999.0, -9998.5]),
    ],
)
def test_a_mark_for_no_value_is_absent_and_its_neighbour_is_not(kind, order, marks, sent):
    channel = register("x", 0, kind, order, scale=0.5, offset=3.0, no_value=marks)
    beside = register("y", 4, "int16")
    record = RegisterRecord((channel, beside), (RegisterRun(0, 5),))
    rows = []
    for value in sent:
        raw = reordered(struct.pack(f">{FORMATS[kind]}", value), order)
        rows.append(raw.ljust(8, b"\0") + b"\x7f\xff")
    samples = record.decode(np.frombuffer(b"".join(rows), np.uint8).reshape(len(sent), -1))
    assert np.isnan(samples[:, 0]).tolist() == [True, False]
    assert samples[:, 1].tolist() == [32_767.0, 32_767.0]


def test_a_mark_in_bits_of_a_register_is_that_of_the_bits():
    part = register("part", 0, "uint16", bits=(4, 8), no_value=(0xFF,))
    record = RegisterRecord((part,), (RegisterRun(0, 1),))
    samples = record.decode(np.frombuffer(b"\x0f\xf0\x0f\xe0", np.uint8).reshape(2, 2))
    assert np.isnan(samples[:, 0]).tolist() == [True, False]


def test_no_value_is_encoded_by_the_first_mark():
    record = RegisterRecord(
        (register("x", 0, "int16", scale=0.1, no_value=(0x8000, 0x7FFF)),), (RegisterRun(0, 1),)
    )
    assert record.encode(np.array([[np.nan]])).tobytes() == b"\x80\x00"


@pytest.mark.parametrize("clip", [False, True])
@pytest.mark.parametrize(
    ("kind", "mark", "sent"), [("uint64", -1, b"\xff" * 8), ("int64", 2**63 - 1, b"\x7f" + b"\xff" * 7)]
)
def test_a_mark_of_64_bits_is_encoded_to_its_last_digit(kind, mark, sent, clip):
    record = RegisterRecord((register("x", 0, kind, no_value=(mark,)),), (RegisterRun(0, 4),))
    assert record.encode(np.array([[np.nan], [1.0]]), clip=clip)[0].tobytes() == sent


def test_parts_of_one_register_are_put_together():
    fields = (
        register("low", 0, "uint16", bits=(0, 4)),
        register("high", 0, "uint16", bits=(12, 4)),
    )
    record = RegisterRecord(fields, (RegisterRun(0, 1),))
    assert record.encode(np.array([[5.0, 10.0]])).tobytes() == b"\xa0\x05"


@pytest.mark.parametrize(
    ("kind", "value"), [("int16", 32768.0), ("uint16", -1.0), ("int64", 2.0**63), ("float32", 1e39)]
)
def test_what_does_not_fit_is_refused_or_clipped(kind, value):
    record = RegisterRecord((register("x", 0, kind),), (RegisterRun(0, 4),))
    with pytest.raises(LayoutError, match=f"channel 'x': .* does not fit {kind}"):
        record.encode(np.array([[value]]))
    assert abs(record.decode(record.encode(np.array([[value]]), clip=True))[0, 0]) <= abs(np.float64(value))
    with pytest.raises(LayoutError, match="nan does not fit"):
        record.encode(np.array([[np.nan]]), clip=True)


def test_a_field_outside_the_runs_is_refused():
    with pytest.raises(LayoutError, match=r"channel 'x': registers 4 to 5 are not among .*\(0 to 4\)"):
        RegisterRecord((register("x", 4, "int32"),), (RegisterRun(0, 5),))


@pytest.mark.parametrize("bits", [(0, 17), (-1, 2), (3, 0)])
def test_bits_that_the_number_has_not_are_refused(bits):
    with pytest.raises(LayoutError, match="are no part of uint16"):
        RegisterRecord((register("x", 0, "uint16").model_copy(update={"bits": bits}),), (RegisterRun(0, 1),))


@st.composite
def wish(draw):
    """Wanted fields and forbidden ranges that do not contradict each other, and limits."""
    widths = st.sampled_from([1, 1, 1, 2, 4])
    wanted = draw(st.lists(st.builds(RegisterRun, st.integers(0, 300), widths), min_size=1, max_size=40))
    taken = {a for run in wanted for a in range(run.address, run.end)}
    banned = draw(st.lists(st.builds(RegisterRun, st.integers(0, 310), st.integers(1, 6)), max_size=6))
    forbidden = [run for run in banned if not taken & set(range(run.address, run.end))]
    return wanted, forbidden, draw(st.integers(0, 20)), draw(st.integers(60, 125))


@settings(max_examples=examples(300))
@given(wish())
def test_a_plan_reads_what_is_wanted_once_and_nothing_forbidden(given_wish):
    wanted, forbidden, max_gap, max_count = given_wish
    try:
        runs = plan_runs(wanted, RunLimits(max_gap, max_count, tuple(forbidden)))
    except LayoutError as error:  # a long chain of numbers that share registers
        assert "belong together" in str(error)  # noqa: PT017
        return
    read = [address for run in runs for address in range(run.address, run.end)]
    assert len(read) == len(set(read)), "a register is read twice"
    needed = {address for run in wanted for address in range(run.address, run.end)}
    assert needed <= set(read)
    assert not set(read) & {address for run in forbidden for address in range(run.address, run.end)}
    assert all(1 <= run.count <= max_count for run in runs)
    for run in runs:
        inside = sorted(needed & set(range(run.address, run.end)))
        assert (inside[0], inside[-1]) == (run.address, run.end - 1), "a request begins or ends with nothing"
        gaps = [after - before - 1 for before, after in itertools.pairwise(inside)]
        assert max(gaps, default=0) <= max_gap
    for field in wanted:
        assert any(run.address <= field.address and field.end <= run.end for run in runs), "a number is cut"
    for one, other in itertools.pairwise(runs):
        gap = RegisterRun(one.end, other.address - one.end)
        barred = any(max(gap.address, f.address) < min(gap.end, f.end) for f in forbidden)
        assert gap.count > max_gap or barred or other.end - one.address > max_count, "these belong in one"


def test_a_forbidden_register_that_is_wanted_is_refused():
    with pytest.raises(LayoutError, match="registers 5 to 6 are wanted, but 6 to 9 are forbidden"):
        plan_runs([RegisterRun(5, 2)], RunLimits(forbidden=(RegisterRun(6, 4),)))
