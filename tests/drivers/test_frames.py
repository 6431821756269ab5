"""Frame layouts against independent implementations: struct, cantools, and themselves."""

import binascii
import struct
from pathlib import Path

import cantools.database
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.given_codes import had

from drivers.can.dbc import layout_from_dbc
from drivers.frames import Field, FrameLayout, LayoutError

pytestmark = pytest.mark.property
LIMITS = {"signed": (-(2**15), 2**15 - 1), "unsigned": (0, 2**16 - 1)}


def three_channels(**changes: object) -> FrameLayout:
    arguments: dict[str, object] = {
        "frame_id": 0x101,
        "length": 64,
        "channels": [
            ("x", 16, "signed", 0.5, 0.0),
            ("y", 16, "signed", 0.25, -3.0),
            ("k", 16, "signed", 1, 0),
        ],
        "samples_per_frame": 10,
        "counter_byte": 0,
        "counter_bits": 16,
        "first_byte": 2,
        "crc_byte": 62,
    }
    return FrameLayout.plain(**(arguments | changes))  # type: ignore[arg-type]


@given(
    raw=st.lists(st.lists(st.integers(*LIMITS["signed"]), min_size=30, max_size=30), min_size=1, max_size=5),
    first=st.integers(0, 2**40),
)
def test_plain_layout_is_what_struct_packs(raw: list[list[int]], first: int) -> None:
    layout = three_channels()
    counts = np.array(raw, np.float64).reshape(-1, 10, 3)
    physical = counts * [0.5, 0.25, 1] + [0, -3.0, 0]
    index = first + 10 * np.arange(len(raw), dtype=np.int64)
    payloads = layout.encode(index, physical)
    for row, payload, i in zip(raw, payloads, index, strict=True):
        body = struct.pack("<H30h", int(i) % 2**16, *row)
        assert payload.tobytes() == body + struct.pack(">H", binascii.crc_hqx(body, 0xFFFF))
    decoded = layout.decode(payloads)
    assert decoded.intact.all()
    assert (decoded.counter == index % 2**16).all()
    assert (decoded.samples == physical.astype(np.float32)).all()


@given(
    order=st.sampled_from(["little", "big"]),
    bits=st.sampled_from([8, 16, 24, 32]),
    kind=st.sampled_from(["signed", "unsigned"]),
    counter_bits=st.sampled_from([8, 16, 32]),
    data=st.data(),
)
def test_every_width_and_order_comes_back(order, bits, kind, counter_bits, data) -> None:
    layout = three_channels(
        channels=[("a", bits, kind, 1.0, 0.0)],
        samples_per_frame=3,
        counter_bits=counter_bits,
        first_byte=4,
        byte_order=order,
        counts="frames",
        crc_byte=None,
    )
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if kind == "signed" else (0, 2**bits - 1)
    raw = np.array(data.draw(st.lists(st.integers(low, high), min_size=3, max_size=3)), np.float64)
    frame = data.draw(st.integers(0, 2**50))
    payload = layout.encode(np.array([3 * frame], np.int64), raw.reshape(1, 3, 1))
    expected = [v.to_bytes(bits // 8, order, signed=kind == "signed") for v in raw.astype(int).tolist()]
    assert payload[0, 4 : 4 + 3 * bits // 8].tobytes() == b"".join(expected)
    back = layout.decode(payload)
    assert back.counter[0] == frame % 2**counter_bits
    assert (back.samples.ravel() == raw.astype(np.float32)).all()


@given(flips=st.sets(st.integers(0, 64 * 8 - 1), min_size=1, max_size=3))
def test_up_to_three_flipped_bits_never_pass_the_crc(flips: set[int]) -> None:
    layout = three_channels()
    payload = layout.encode(np.array([1234], np.int64), np.ones((1, 10, 3)))
    bits = np.unpackbits(payload, axis=1)
    bits[0, list(flips)] ^= 1
    assert not layout.decode(np.packbits(bits, axis=1)).intact[0]


@given(
    start=st.integers(0, 63),
    bits=st.integers(1, 40),
    order=st.sampled_from(["little", "big"]),
    signed=st.booleans(),
    payload=st.binary(min_size=8, max_size=8),
)
def test_any_bit_field_reads_as_cantools_does(start, bits, order, signed, payload, tmp_path_factory) -> None:
    field = Field(start, bits, "signed" if signed else "unsigned", order)
    if not all(0 <= p < 64 for p in field.positions):
        return
    path = tmp_path_factory.mktemp("dbc") / "one.dbc"
    path.write_text(dbc(f"SG_ V : {start}|{bits}@{1 if order == 'little' else 0}{'-' if signed else '+'}"))
    expected = cantools.database.load_file(path).get_message_by_name("M").decode(payload)["V"]
    group_layout = FrameLayout(1, False, 8, (), (), np.zeros((0, 0)), np.zeros((0, 0)), field, "frames")
    assert group_layout.decode(np.frombuffer(payload, np.uint8)[None]).counter[0] == expected


def dbc(*signals: str) -> str:
    lines = "\n".join(f' {s} (1,0) [0|0] "" Vector__XXX' for s in signals)
    return f'VERSION ""\n\nBU_:\n\nBO_ 257 M: 8 Vector__XXX\n{lines}\n'


def test_dbc_layout_has_the_messages_signals_as_samples(tmp_path: Path) -> None:
    path = tmp_path / "two.dbc"
    path.write_text(dbc("SG_ Seq : 0|8@1+", "SG_ A0 : 8|16@1-", "SG_ A1 : 31|16@0-"))
    layout = layout_from_dbc(path, "M", counter="Seq", counts="frames", channels={"a": ["A0", "A1"]})
    assert (layout.frame_id, layout.length, layout.samples_per_frame) == (257, 8, 2)
    payload = layout.encode(np.array([2 * 300]), np.array([[[-5.0], [700.0]]]))
    assert payload.tobytes() == bytes([300 % 256]) + struct.pack("<h", -5) + struct.pack(">h", 700) + bytes(3)
    assert layout.decode(payload).samples.ravel().tolist() == [-5.0, 700.0]
    units = {"a": (1000 / 7.87, 10_000 / 7.87)}
    turned = layout_from_dbc(
        path, "M", counter="Seq", counts="frames", channels={"a": ["A0", "A1"]}, units=units
    )
    expected = np.float32(np.array([-5.0, 700.0]) * (1000 / 7.87) + 10_000 / 7.87)
    np.testing.assert_array_equal(turned.decode(payload).samples.ravel(), expected)


def test_dbc_problems_name_the_file_and_what_it_has(tmp_path: Path) -> None:
    path = tmp_path / "two.dbc"
    path.write_text(dbc("SG_ Seq : 0|8@1+"))
    with pytest.raises(LayoutError, match=r"no signal 'A0'; it has \['Seq'\]"):
        layout_from_dbc(path, "M", counter="Seq", counts="frames", channels={"a": ["A0"]})
    with pytest.raises(LayoutError, match="message 'N'") as refused:
        layout_from_dbc(path, "N", counter="Seq", counts="frames", channels={})
    assert refused.value.code.id == "B28"
    had("B28", refused.value)


@pytest.mark.parametrize("value", [20_000.0, float("nan"), float("inf")])
def test_a_value_that_does_not_fit_is_refused_by_name(value: float) -> None:
    with pytest.raises(LayoutError, match=r"channel 'x'.*does not fit"):
        three_channels().encode(np.array([0]), np.full((1, 10, 3), value))


def test_clipping_saturates_as_an_analogue_input_does() -> None:
    payload = three_channels().encode(np.array([0]), np.full((1, 10, 3), 1e9), clip=True)
    assert three_channels().decode(payload).samples[0, 0, 0] == np.float32((2**15 - 1) * 0.5)


@pytest.mark.parametrize(
    "changes", [{"samples_per_frame": 11}, {"crc_byte": 63}, {"crc_byte": 0}, {"first_byte": 1}]
)
def test_a_layout_that_does_not_fit_says_so(changes: dict[str, object]) -> None:
    with pytest.raises(LayoutError, match=r"reaches past|overlaps"):
        three_channels(**changes)


@given(payload=st.binary(min_size=64, max_size=64), bits=st.sampled_from([32, 64]))
def test_any_bytes_decode_as_floats_without_a_word(payload: bytes, bits: int) -> None:
    layout = three_channels(
        channels=[("a", bits, "float", 1e30, 5.0)], samples_per_frame=7, first_byte=4, crc_byte=None
    )
    decoded = layout.decode(np.frombuffer(payload, np.uint8)[None])
    assert decoded.samples.shape == (1, 7, 1)
