"""Parts of the serial framings against published vectors, and what they do in their special cases."""

from __future__ import annotations

import logging
import re
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.bus_tables import line_layout

from drivers.frames import FrameLayout, LayoutError
from drivers.serial.binary import BodyCodec, CobsFraming, SyncFraming
from drivers.serial.lines import LATEST_S, DeviceTime, LineCodec, LineFraming

if TYPE_CHECKING:
    from drivers.serial.settings import LineLayout


def layout(length: int = 4, frame_id: int = 0) -> FrameLayout:
    return FrameLayout.plain(
        frame_id=frame_id,
        length=length,
        channels=[("x", 8, "unsigned", 1.0, 0.0)],
        samples_per_frame=length - 1,
        counter_byte=0,
        counter_bits=8,
        first_byte=1,
    )


def line(**changes) -> LineLayout:
    return line_layout(**({"columns": ("seq", "x"), "channels": ("x",), "counter": "seq"} | changes))


# The check values of the catalogue of parametrised CRC algorithms: the CRC of "123456789".
@pytest.mark.parametrize(
    ("crc", "order", "tail"),
    [
        ("ibm-3740", "big", "29b1"),
        ("ibm-3740", "little", "b129"),
        ("xmodem", "big", "31c3"),
        ("xmodem", "little", "c331"),
        ("none", "big", ""),
    ],
)
def test_bodies_end_with_the_crc_that_was_asked_for(crc, order, tail):
    codec = BodyCodec({"a": layout(9)}, crc=crc, crc_order=order)
    samples = np.frombuffer(b"23456789", np.uint8).astype(float).reshape(1, 8, 1)
    (body,) = codec.encode("a", np.array([0x31]) * 1, samples)
    assert body == b"123456789" + bytes.fromhex(tail)
    spoilt = body[:-1] + bytes([body[-1] ^ 1])
    buffer = np.frombuffer(body + spoilt, np.uint8).copy()
    intact = codec.intact(buffer, np.array([0, len(body)]), np.array([len(body)] * 2))
    assert intact.tolist() == [True, not tail]


def test_cobs_as_it_is_published():
    # Cheshire and Baker 1999, and a run of 254 bytes without a zero.
    codec = BodyCodec({"a": layout(4)}, crc="none")
    samples = np.array([[[0x22], [0x00], [0x33]]], float)
    (frame,) = CobsFraming(codec).encode("a", np.array([0x11]), samples)
    assert frame == bytes.fromhex("03 11 22 02 33 00")
    long = BodyCodec({"a": layout(300)}, crc="none")
    (frame,) = CobsFraming(long).encode("a", np.array([1]), np.full((1, 299, 1), 7.0))
    assert frame[0] == 0xFF
    assert len(frame) == 303


def test_the_end_of_a_frame_that_began_before_the_port_was_opened_is_no_fault():
    framing = CobsFraming(BodyCodec({"a": layout()}))
    frames = framing.encode("a", np.arange(3) * 3, np.full((3, 3, 1), 5.0))
    found = framing.cut(frames[0][3:] + frames[1] + frames[2])
    assert (found.notes["frames_malformed"], found.notes["resyncs"], found.notes["bytes_garbage"]) == (
        0,
        0,
        len(frames[0]) - 3,
    )
    assert found.frames["a"].counter.tolist() == [3, 6]
    assert found.frames["a"].arrival_ns.tolist() == [len(frames[0]) - 3 + len(frames[0]) * k for k in (1, 2)]


def test_frames_of_unknown_streams_and_of_the_wrong_length_are_told_apart():
    known = BodyCodec({"a": layout(4, 1)}, ids=True)
    wider = CobsFraming(BodyCodec({"a": layout(6, 1), "b": layout(4, 0x2A)}, ids=True))
    framing = CobsFraming(known)
    index = np.array([0])
    found = framing.cut(
        wider.encode("a", index, np.ones((1, 5, 1)))[0]
        + wider.encode("b", index, np.ones((1, 3, 1)))[0]
        + framing.encode("a", index, np.ones((1, 3, 1)))[0]
    )
    assert found.unknown == {"0x2a": 1}
    assert found.wrong_length == {"a": (1, 9)}
    assert (found.notes["frames_malformed"], len(found.frames["a"].arrival_ns)) == (0, 1)


def test_a_frame_with_a_bad_crc_is_handed_on_as_corrupt():
    framing = SyncFraming(BodyCodec({"a": layout()}), b"\xaa")
    frames = framing.encode("a", np.arange(3) * 3, np.full((3, 3, 1), 5.0))
    spoilt = bytearray(b"".join(frames))
    spoilt[len(frames[0]) + 3] ^= 4
    found = framing.cut(bytes(spoilt))
    assert found.frames["a"].intact.tolist() == [True, False, True]
    assert (found.notes["bytes_garbage"], found.notes["resyncs"]) == (0, 0)


@pytest.mark.parametrize("crc", ["ibm-3740", "none"])
@pytest.mark.parametrize("stray", [b"\0", b"\r\n", b"\xaa"])
@pytest.mark.parametrize("chunk", [1, 7, 1000])
def test_bytes_behind_every_frame_cost_no_frame_and_are_told_once(crc, stray, chunk):
    framing = SyncFraming(BodyCodec({"a": layout()}, crc=crc), b"\xaa\x55")
    frames = framing.encode("a", np.arange(20) * 3, np.full((20, 3, 1), 5.0))
    data = b"".join(frame + stray for frame in frames)
    batches = [framing.cut(data[at : at + chunk]) for at in range(0, len(data), chunk)]
    counted = [batch.frames["a"] for batch in batches if batch.frames]
    assert all(found.intact.all() for found in counted)
    counters = np.concatenate([found.counter for found in counted]).tolist()
    # Without a CRC the last frame waits for the sync word of the next one.
    assert counters == list(range(0, 60, 3))[: 20 if crc != "none" else 19]
    assert sum(batch.notes["bytes_garbage"] for batch in batches) == (len(counters) - 1) * len(stray)
    (told,) = [batch for batch in batches if batch.malformed]
    many = "1 byte" if len(stray) == 1 else "2 bytes"
    assert told.malformed == f"the first are between two whole frames, {many}: {stray.hex(' ')}"
    assert "no frame is lost" in told.remedy


def test_where_no_frame_comes_at_all_the_first_bytes_and_the_settings_to_compare_are_stated():
    """Nothing is malformed before the first frame: with a wrong sync word all bytes are garbage."""
    sent = SyncFraming(BodyCodec({"a": layout(6)}, crc="none"), b"\xaa\x55")
    data = b"".join(sent.encode("a", np.arange(20) * 5, np.full((20, 5, 1), 5.0)))
    other = SyncFraming(BodyCodec({"a": layout(6)}, crc="none"), b"\x55\xaa").cut(data)
    assert other.notes["frames_malformed"] == 0
    assert other.notes["bytes_garbage"] > 100
    shown = r"1\d\d bytes: aa 55 00 05 05 05 05 05 aa 55 05 05 05 05 05 05 \.\.\."
    assert re.fullmatch(rf"the sync word 55aa is not in {shown}", other.malformed)
    assert "sync_word" in other.remedy
    longer = SyncFraming(BodyCodec({"a": layout(7)}, crc="none"), b"\xaa\x55").cut(data)
    assert re.fullmatch(
        rf"the sync word aa55 is in {shown.replace(':', ', but no other one 7 bytes behind it:')}",
        longer.malformed,
    )
    assert "payload_length" in longer.remedy
    checked = SyncFraming(BodyCodec({"a": layout(6)}), b"\xaa\x55").cut(data)
    assert "but no frame with a good CRC 8 bytes behind it: aa 55 00" in checked.malformed


def test_the_first_bytes_are_shown_also_of_many_that_are_no_frame():
    framing = SyncFraming(BodyCodec({"a": layout()}, crc="none"), b"\xaa\x55")
    frames = framing.encode("a", np.arange(20) * 3, np.full((20, 3, 1), 5.0))
    found = framing.cut(b"".join(frames[:10]) + bytes(range(1, 31)) + b"".join(frames[10:]))
    assert found.notes["frames_malformed"] == 1
    assert found.malformed == "the first of them: 01 02 03 04 05 06 07 08 09 0a 0b 0c 0d 0e 0f 10 ..."


def test_bytes_put_into_two_neighbours_do_not_make_later_ones_intact():
    framing = SyncFraming(BodyCodec({"a": layout()}, crc="none"), b"\xaa\x55")
    frames = framing.encode("a", np.arange(80) * 3, np.full((80, 3, 1), 5.0))
    for k in (10, 11, 50, 60, 70):
        frames[k] = frames[k][:4] + b"\x77" + frames[k][4:]
    found = framing.cut(b"".join(frames)).frames["a"]
    assert not {50 * 3, 60 * 3, 70 * 3} & {*found.counter[found.intact].tolist()}


def test_a_byte_put_into_one_frame_without_a_crc_still_spoils_it():
    framing = SyncFraming(BodyCodec({"a": layout()}, crc="none"), b"\xaa\x55")
    frames = framing.encode("a", np.arange(5) * 3, np.full((5, 3, 1), 5.0))
    frames[1] = frames[1][:4] + b"\x07" + frames[1][4:]
    found = framing.cut(b"".join(frames)).frames["a"]
    assert found.counter[found.intact].tolist() == [0, 6, 9]


def test_without_a_crc_a_sync_word_must_follow():
    framing = SyncFraming(BodyCodec({"a": layout()}, crc="none"), b"\xaa\x55")
    frames = framing.encode("a", np.arange(4) * 3, np.full((4, 3, 1), 5.0))
    assert not framing.cut(frames[0]).frames
    assert framing.cut(frames[1]).frames["a"].counter.tolist() == [0]
    # A frame that lost a byte takes none of the next one's.
    found = framing.cut(frames[2][:-1] + frames[3] + frames[0])
    counters = found.frames["a"]
    assert counters.counter[counters.intact].tolist() == [3, 9]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: BodyCodec({"a": layout(), "b": layout()}), "without stream ids"),
        (lambda: BodyCodec({"a": layout(4, 7), "b": layout(4, 7)}, ids=True), "share id 7"),
        (lambda: BodyCodec({"a": layout(4, 256)}, ids=True), "is no byte"),
        (lambda: SyncFraming(BodyCodec({"a": layout()}), b""), "sync word is empty"),
        (lambda: LineCodec(line(counter=None)), "needs a counter or a time"),
        (lambda: LineCodec(line(time="x")), "not both"),
        (lambda: LineCodec(line(no_counter=True)), "not both"),
        (lambda: LineCodec(line(columns=("seq", "y"))), "column 'x' is there 0 times"),
        (lambda: LineFraming({"a": line(), "b": line()}, {}), "cannot be told apart"),
        (
            lambda: LineFraming({"a": line(prefix="a"), "b": line(prefix="b", separator=";")}, {}),
            "different separators",
        ),
    ],
)
def test_what_cannot_work_is_refused(make, message):
    with pytest.raises(LayoutError, match=message):
        make()


def test_a_sentence_of_a_gps_receiver_is_a_line():
    columns = ("lat", "ns", "lon", "ew", "utc", "status")
    gll = line(columns=columns, channels=("lat", "lon"), counter="utc", prefix="$GPGLL")
    framing = LineFraming({"a": gll}, {"a": 1.0}, "xor")
    found = framing.cut(b"$GPGLL,5300.97914,N,00259.98174,E,125926,A*28\r\n")
    decoded = found.frames["a"]
    assert decoded.counter.tolist() == [125926]
    np.testing.assert_allclose(decoded.samples[0, 0], [5300.97914, 259.98174], rtol=1e-7)
    assert decoded.intact.all()
    found = framing.cut(b"$GPGLL,5300.97914,N,00259.98174,E,125927,A*28\r\n")
    assert not found.frames["a"].intact.any()


@pytest.mark.parametrize(
    ("spoilt", "said", "remedy"),
    [
        (
            b"1,2,3,4,5,6,7",
            '"1,2,3,4,5,6,7": 7 columns, the file lists 3 (seq, x, y)',
            "list 4 columns more in line",
        ),
        (b"1,2", '"1,2": 2 columns, the file lists 3 (seq, x, y)', "remove the 1 column that the device"),
        (b"1;2;3", '"1;2;3": 1 column, the file lists 3', 'or correct separator = ","'),
        (b"1,abc,2", "column x is 'abc', no number", "leave x out of channels of the layout"),
        (b",1,2", "column seq is '', no number", "names in line in the order"),
        (b"1.5,1,2", "counter seq is 1.5, no whole number from 0 up", "write time in place of counter"),
        (b"-3,1,2", "counter seq is -3, no whole number from 0 up", "write time in place of counter"),
        (
            b"4294967296,1,2",
            "counter seq is 4294967296, by its bits in the file 4294967295 at most",
            "correct bits",
        ),
        (b"\xfe\x01\x80", '"\\xfe\x01\\x80": no text, as at another baud rate or parity', "compare baud"),
        (b"7," * 100 + b"7", "..." + '": 101 columns', "list 98 columns more"),
    ],
)
def test_a_line_that_is_none_is_quoted_with_what_is_wrong(spoilt, said, remedy):
    columns = line_layout(("seq", "x", "y"), ("x", "y"), counter="seq")
    framing = LineFraming({"a": columns}, {"a": 100.0})
    framing.cut(b"half a line\n")
    found = framing.cut(b"0,1,2\n" + spoilt + b"\n1,1,2\n")
    assert found.notes["frames_malformed"] == 1
    assert said in found.malformed
    assert remedy in found.remedy
    again = framing.cut(spoilt + b"\n")
    assert (again.notes["frames_malformed"], again.malformed) == (1, ""), "once"


@pytest.mark.parametrize(
    ("text", "said", "remedy"),
    [
        (b"0.48 in/s", "column x is '0.48 in/s', without 'mm/s' at its end", "unit of its sensor"),
        (b"12.3", "column x is '12.3', without 'mm/s' at its end", "remove suffix of the channel"),
        (b"what mm/s", "column x is 'what mm/s', no number", "leave x out of channels of the layout"),
    ],
)
def test_a_value_in_another_unit_is_no_sample_and_is_told(text, said, remedy):
    columns = line_layout(("seq", "x"), [{"name": "x", "suffix": "mm/s"}], counter="seq")
    framing = LineFraming({"a": columns}, {"a": 100.0})
    framing.cut(b"half a line\n")
    found = framing.cut(b"0,12.2 mm/s\n1," + text + b"\n2,12.4mm/s \n3,-- mm/s\n4,\n")
    assert found.frames["a"].counter.tolist() == [0, 2, 3, 4]
    np.testing.assert_array_equal(
        found.frames["a"].samples[:, 0, 0], np.float32([12.2, 12.4, np.nan, np.nan])
    )
    assert found.notes["frames_malformed"] == 1
    assert said in found.malformed
    assert remedy in found.remedy


@pytest.mark.parametrize(
    ("text", "shown", "keys"),
    [
        (b"1,45.1 degC", "column x is '45.1 degC'", 'suffix = "degC" in the channel x'),
        (b"1,45.1 \xb0C", "column x is '45.1 °C'", 'suffix = "°C" in the channel x'),
        ("1,T=45.1°C".encode(), "column x is 'T=45.1°C'", 'prefix = "T=" and suffix = "°C" in the channel x'),
        (b"n=1,45.1", "column seq is 'n=1'", 'prefix = "n=" in counter'),
    ],
)
def test_the_keys_are_named_for_a_number_with_a_name_or_a_unit(text, shown, keys):
    columns = line_layout(("seq", "x"), ["x"], counter="seq")
    framing = LineFraming({"a": columns}, {"a": 100.0})
    framing.cut(b"half a line\n")
    found = framing.cut(text + b"\n")
    assert f"{shown}, no number" in found.malformed
    assert found.remedy == f"write {keys} of the layout"


def test_a_number_without_the_text_in_front_of_it_is_no_sample_and_is_told():
    columns = line_layout(("seq", "x"), [{"name": "x", "prefix": "V="}], counter="seq")
    framing = LineFraming({"a": columns}, {"a": 100.0})
    framing.cut(b"half a line\n")
    found = framing.cut(b"0,V=1.5\n1,U=2.5\n2, V= 3.5\n3,V=---\n4,\n")
    assert found.frames["a"].counter.tolist() == [0, 2, 3, 4]
    np.testing.assert_array_equal(found.frames["a"].samples[:, 0, 0], np.float32([1.5, 3.5, np.nan, np.nan]))
    assert "column x is 'U=2.5', without 'V=' in front of the number" in found.malformed
    assert found.remedy == "correct prefix of the channel x"


def test_lines_of_padded_columns_are_read_and_others_described():
    columns = line_layout(("seq", "x", "y"), ("x", "y"), counter="seq", separator=" ", prefix="A")
    framing = LineFraming({"a": columns}, {"a": 100.0})
    framing.cut(b"half a line\n")
    found = framing.cut(b"   A    7   -0.250    1.500\n  B    7    1.000\n")
    assert found.frames["a"].counter.tolist() == [7]
    assert found.frames["a"].samples[0, 0].tolist() == [-0.25, 1.5]
    assert found.unknown == {"B": 1}
    found = framing.cut(b"   A    8   -0.250\n")
    assert "2 columns, the file lists 3 (seq, x, y)" in found.malformed
    assert "no stream" in LineFraming({"a": columns}, {"a": 100.0})._why_no_frame(b"    ").why


def test_the_other_decimal_mark_is_named():
    for mark, other, text in ((".", ",", b"1;0,5"), (",", ".", b"1;0.5")):
        columns = line_layout(("seq", "x"), ("x",), counter="seq", separator=";", decimal=mark)
        framing = LineFraming({"a": columns}, {"a": 100.0})
        framing.cut(b"half a line\n")
        found = framing.cut(text + b"\n")
        assert f"column x is '{text[2:].decode()}', no number" in found.malformed
        assert found.remedy == f'write decimal = "{other}" in the layout'


@pytest.mark.parametrize(
    ("piece", "said"),
    [
        (b"1,z*00", "checksum 00, its text makes 67"),
        (b"1,z*\xb70", "checksum \xb70, its text makes 67"),
        (b"1,z", "no checksum behind a *"),
    ],
)
def test_a_checksum_is_quoted_with_what_it_would_be(piece, said):
    # What can be read is a frame, if a corrupt one.
    framing = LineFraming({"a": line_layout(("seq", "x"), ("x",), counter="seq")}, {"a": 100.0}, "xor")
    found = framing.cut(b"x\n" + piece + b"\n")
    assert found.notes["frames_malformed"] == 1
    assert said in found.malformed


def test_a_binary_piece_that_is_no_frame_is_shown_in_hexadecimal():
    framing = CobsFraming(BodyCodec({"a": layout()}))
    framing.cut(b"\x00")
    found = framing.cut(bytes(range(1, 40)) + b"\x00")
    assert found.malformed.startswith("the first has 39 bytes: 01 02 03 04")
    assert found.malformed.endswith("10 ...")


def test_records_with_another_delimiter_are_lines_too():
    # As a telephone's logger wrote them: three averages, three accelerations in m/s^2, ms.
    layout = line_layout(("ax", "ay", "az", "x", "y", "z", "t"), ("x", "y", "z"), time="t")
    framing = LineFraming({"a": layout}, {"a": 30.0}, delimiter=b";")
    text = (
        b"999,999,999,999,999,999,999;-0.4999469,0.038457453,9.345161,-0.4999469,0.15382981,9.460533,0.0;"
        b"-0.4999469,0.038457453,9.345161,-0.9229789,-0.038457453,9.768193,33.5;"
        b"-0.4999469,0.038457453,9.345161,-0.6537767,-0.34611708,9.268247,100.6633;"
    )
    decoded = framing.cut(text).frames["a"]
    assert decoded.counter.tolist() == [0, 1, 3]
    np.testing.assert_allclose(
        decoded.samples[:, 0],
        [
            [-0.4999469, 0.15382981, 9.460533],
            [-0.9229789, -0.038457453, 9.768193],
            [-0.6537767, -0.34611708, 9.268247],
        ],
        rtol=1e-6,
    )


@pytest.mark.parametrize(
    "bad",
    [
        b"5,err",
        b"5,1_0",
        b"5",
        b"5,1,2",
        b"5.0,1",
        b"-1,1",
        b"65536,1",
        b"x,1",
        b"\xff,\xfe",
        b",",
    ],
)
def test_what_is_no_sample_is_left_out_and_its_neighbours_are_not(bad):
    framing = LineFraming({"a": line(bits=16)}, {"a": 1.0})
    framing.cut(b"0,0\n")
    found = framing.cut(b"6,1.5\n" + bad + b"\n\n7, -2e0\r\n")
    assert found.frames["a"].counter.tolist() == [6, 7]
    assert found.frames["a"].samples[:, 0, 0].tolist() == [1.5, -2.0]
    assert (found.notes["frames_malformed"], found.notes["resyncs"], found.notes["bytes_garbage"]) == (
        1,
        1,
        len(bad) + 1,
    )


def test_the_first_line_without_a_checksum_may_lack_a_digit():
    framing = LineFraming({"a": line()}, {"a": 1.0})
    found = framing.cut(b"7,1\n18,1\n")
    assert found.frames["a"].counter.tolist() == [18]
    assert found.notes["frames_malformed"] == 0


@pytest.mark.parametrize("rate_error", [-0.003, 0.0, 0.003])
def test_a_device_whose_rate_is_off_gains_and_loses_no_sample(rate_error):
    # 1 kHz nominal, stamps rounded to 0.25 ms, jitter of 0.03 ms (standard deviation).
    n = 20_000
    taken = np.arange(n) * 1e-3 * (1 + rate_error) + np.random.default_rng(1).normal(0, 3e-5, n)
    stamps = np.round(taken / 0.25e-3) * 0.25e-3
    kept = np.delete(np.arange(n), [5000, 5001, 5002, 9000])
    counts = DeviceTime(1000.0).count(stamps[kept])
    assert (counts == kept).all()


def test_time_that_goes_back_is_a_restart():
    assert DeviceTime(100.0).count(np.array([5.00, 5.01, 5.02, 0.0, 0.01])).tolist() == [0, 1, 2, 0, 1]
    assert DeviceTime(1e7).count(np.array([0.0, LATEST_S])).tolist() == [0, int(LATEST_S * 1e7) % 2**32]


@pytest.mark.parametrize("rate_error", [-0.01, 0.0, 0.01])
@pytest.mark.parametrize("grain_s", [0.016777, 0.033554, 0.1])
def test_lines_that_share_a_stamp_are_samples_each(grain_s, rate_error):
    taken_s = np.arange(20_000) * 0.01 * (1 + rate_error)
    stamps = np.floor(taken_s / grain_s) * grain_s
    assert (DeviceTime(100.0).count(stamps) == np.arange(20_000)).all()
    there = np.delete(np.arange(20_000), np.arange(7000, 7050))
    counts = DeviceTime(100.0).count(stamps[there])
    assert (np.diff(counts) >= 1).all()
    # What is missing is told to within the grain.
    assert abs(counts[-1] - 19_999) <= 1 + grain_s / 0.01
    assert counts[8000] - counts[6000] > 2040 - grain_s / 0.01


def test_a_single_lost_line_does_not_show_in_stamps_that_lines_share():
    """The check of the machine file warns of it."""
    stamps = np.floor(np.arange(20_000) / 2.0) / 1e3
    one_lost = np.delete(stamps, np.arange(1000, 20_000, 500))
    assert DeviceTime(2000.0).count(one_lost)[-1] == len(one_lost) - 1
    ten_lost = np.delete(stamps, np.arange(1000, 1010))
    assert DeviceTime(2000.0).count(ten_lost)[-1] in {20_000 - 1, 20_000 - 2}


SHARING = [(2000.0, 1e-3), (1700.0, 1e-3), (3333.0, 1e-3), (100.0, 0.016777), (100.0, 0.1), (10_000.0, 1e-3)]
"""Lines a second, and how coarse their stamps are."""
MANY = 40_000


def shared_stamps(rate_hz, grain_s, *, rate_error=0.0, jitter=0.0):
    rng = np.random.default_rng(1)
    taken_s = rng.uniform(0.0, 1.0) + np.arange(MANY) / rate_hz * (1.0 + rate_error)
    late_s = rng.exponential(jitter / rate_hz, MANY) if jitter else 0.0
    return np.floor(np.maximum.accumulate(taken_s + late_s) / grain_s) * grain_s


def losing(name):
    lines, rng = np.arange(MANY), np.random.default_rng(2)
    return {
        "each tenth": lines % 10 != 3,
        "3 of 30": lines % 30 >= 3,
        "3 % by chance": rng.uniform(size=MANY) >= 0.03,
        "10 % by chance": rng.uniform(size=MANY) >= 0.1,
    }[name]


@pytest.mark.parametrize("name", ["each tenth", "3 of 30", "3 % by chance", "10 % by chance"])
@pytest.mark.parametrize(("rate_hz", "grain_s"), SHARING)
def test_lines_that_are_lost_again_and_again_are_counted_where_lines_share_a_stamp(rate_hz, grain_s, name):
    there = losing(name)
    counts = DeviceTime(rate_hz).count(shared_stamps(rate_hz, grain_s)[there])
    lost = int((~there).sum())
    counted = int(counts[-1]) + 1 - len(counts)
    # It takes some hundred lines to know that it is no drift.
    assert abs(counted - lost) <= 0.05 * lost + 1.0 + grain_s * rate_hz


@pytest.mark.parametrize("rate_error", [-0.01, 0.004, 0.01])
@pytest.mark.parametrize(("rate_hz", "grain_s"), SHARING)
def test_a_device_whose_rate_is_off_loses_no_line_that_shares_a_stamp(rate_hz, grain_s, rate_error):
    counts = DeviceTime(rate_hz).count(shared_stamps(rate_hz, grain_s, rate_error=rate_error))
    assert int(counts[-1]) + 1 - MANY <= 1.0 + grain_s * rate_hz


@pytest.mark.parametrize(("rate_hz", "grain_s"), SHARING)
def test_lines_that_are_late_at_times_are_no_lost_ones(rate_hz, grain_s):
    counts = DeviceTime(rate_hz).count(shared_stamps(rate_hz, grain_s, jitter=0.2))
    # A fifth of a period in the mean: few are late by more than a period, again and again none.
    assert int(counts[-1]) + 1 - MANY <= 1e-4 * MANY + grain_s * rate_hz
    # Half a period in the mean, which some of them exceed by far: 0.4 % are taken for lost ones at most.
    counts = DeviceTime(rate_hz).count(shared_stamps(rate_hz, grain_s, jitter=0.5))
    assert int(counts[-1]) + 1 - MANY <= 0.004 * MANY


def test_lines_hardly_slower_than_their_stamps_are_taken_for_lost_at_times():
    """The check of the machine file warns of it; below it, none are."""
    counted = {
        rate_hz: int(DeviceTime(rate_hz).count(np.floor(np.arange(MANY) / rate_hz * 1e3 + 1e-9) / 1e3)[-1])
        + 1
        for rate_hz in (900.0, 970.0, 1000.0)
    }
    assert counted[900.0] == counted[1000.0] == MANY
    assert MANY < counted[970.0] < 1.02 * MANY


def test_overtaken_lines_go_back_to_their_places():
    stamps = np.arange(100) * 0.01
    order = np.arange(100)
    order[[20, 21]] = 21, 20
    order[[40, 41, 42, 43]] = 43, 41, 40, 42
    assert (DeviceTime(100.0, reorder_window_ns=20_000_000).count(stamps[order]) == order).all()


@pytest.mark.parametrize("damaged_s", [0.05, 50.0, 5000.0])
def test_one_damaged_stamp_moves_no_other(damaged_s):
    stamps = 10.0 + np.arange(100) * 0.01
    stamps[50] = damaged_s
    counts = DeviceTime(100.0).count(stamps)
    others = np.delete(np.arange(100), 50)
    assert (counts[others] == others).all()
    assert abs(counts[50] - 50) > 40


def test_a_corrupt_stamp_moves_no_other():
    stamped = line(columns=("t", "x"), counter=None, time="t", unit="s")
    framing = LineFraming({"a": stamped}, {"a": 10.0}, "xor")
    good = framing.encode("a", np.arange(5), np.ones((5, 1, 1)))
    spoilt = good[2].replace(b"0.2", b"9.2")
    decoded = framing.cut(good[0] + good[1] + spoilt + good[3] + good[4]).frames["a"]
    assert decoded.intact.tolist() == [True, True, False, True, True]
    assert decoded.counter[decoded.intact].tolist() == [0, 1, 3, 4]


def test_nothing_is_logged_by_a_framing(caplog):
    with caplog.at_level(logging.DEBUG):
        LineFraming({"a": line()}, {"a": 1.0}).cut(b"garbage\n" * 10)
    assert not caplog.records


def test_lines_with_neither_counter_nor_time_are_read_as_they_come():
    framing = LineFraming(
        {"a": line(columns=("x",), counter=None, no_counter=True, channels=({"name": "x", "suffix": "C"},))},
        {"a": 10.0},
    )
    found = framing.cut(b"1.5C\n2.5C\n-C\n123456789012345678901234567890C\nhot\n3.5C\n").frames["a"]
    assert found.counter.tolist() == [0] * 4
    read = np.float32([2.5, np.nan, 123456789012345678901234567890, 3.5])
    np.testing.assert_array_equal(found.samples[:, 0, 0], read)
    written = framing.encode("a", np.arange(2), np.array([[[1.0]], [[2.0]]]))
    assert written == [b"1.000000C\r\n", b"2.000000C\r\n"]


@pytest.mark.parametrize("table", ["utf-8", "latin-1"])
def test_a_prefix_may_have_letters_beyond_ascii(table: str):
    columns = [
        line_layout(("seq", "x"), ("x",), counter="seq", separator=";", decimal=",", prefix=prefix)
        for prefix in ("Lüfter", "Lüfter 1")
    ]
    framing = LineFraming({"a": columns[0], "b": columns[1]}, {"a": 100.0, "b": 100.0})
    framing.cut("half a line\n".encode(table))
    found = framing.cut("Lüfter;1;0,5\nLüfter 1;2;1,5\nKühler;3;2,5\n\xfc\xff\xfe;4;1\n".encode(table))
    assert found.frames["a"].counter.tolist() == [1]
    assert found.frames["a"].samples[0, 0].tolist() == [0.5]
    assert found.frames["b"].counter.tolist() == [2]
    assert found.unknown == {"Kühler": 1}
    assert "first line is" in found.malformed
    sent = framing.encode("a", np.array([7]), np.array([[[0.25]]]))
    assert framing.cut(b"".join(sent)).frames["a"].counter.tolist() == [7]


@pytest.mark.parametrize(("mark", "text"), [(",", "7278;1.475;1,71"), (".", "7278;1,475;1.71")])
def test_no_other_decimal_mark_is_named_where_a_column_needs_this_one(mark: str, text: str):
    columns = line_layout(("seq", "n", "x"), ("n", "x"), counter="seq", separator=";", decimal=mark)
    framing = LineFraming({"a": columns}, {"a": 100.0})
    framing.cut(b"half a line\n")
    found = framing.cut(f"{text}\n".encode())
    assert "column n is" in found.malformed
    assert "one decimal mark, and none between thousands; or leave n out of channels" in found.remedy
