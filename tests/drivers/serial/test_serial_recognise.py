"""What a stream of bytes is, and that a wrong baud rate does not look like the right one."""

from __future__ import annotations

import binascii
import struct
from functools import reduce
from operator import xor
from typing import TYPE_CHECKING

import numpy as np
import pytest
from cobs import cobs
from hypothesis import given, settings
from hypothesis import strategies as st
from support.examples import examples
from support.uart_waves import sampled, wave

from drivers.serial import recognise
from drivers.serial.checksums import CHECKSUMS
from drivers.serial.recognise import CONCLUSIVE, recognised
from drivers.serial.recognise_frames import BinaryFrames
from drivers.serial.recognise_lines import TextLines, text_lines
from drivers.serial.sniff import BAUDS, TRY_BYTES

if TYPE_CHECKING:
    from collections.abc import Callable

pytestmark = pytest.mark.property


def numbers(seed: int, frames: int, channels: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 700, (frames, channels)).round(2)


def lines(
    seed: int, *, frames: int = 80, channels: int = 3, separator: str = ",", end: str = "\r\n"
) -> bytes:
    return "".join(
        separator.join([f"{k}", *(f"{value:.2f}" for value in row)]) + end
        for k, row in enumerate(numbers(seed, frames, channels))
    ).encode()


def payloads(seed: int, *, frames: int = 80, channels: int = 3) -> list[bytes]:
    rows = numbers(seed, frames, channels).astype(np.int16)
    return [struct.pack("<H", k) + row.astype("<i2").tobytes() for k, row in enumerate(rows)]


def checksum(name: str, payload: bytes, order: str = "big") -> bytes:
    what = CHECKSUMS[name]
    number = int(what.of(np.frombuffer(payload, np.uint8)[None])[0])
    return number.to_bytes(what.size, "big" if order == "big" else "little")


def behind_sync(seed: int, *, channels: int = 3, crc: str = "ibm-3740", order: str = "big") -> bytes:
    return b"".join(
        b"\xa5\x5a" + payload + checksum(crc, payload, order) for payload in payloads(seed, channels=channels)
    )


def in_cobs(seed: int, *, channels: int = 3) -> bytes:
    return b"".join(
        cobs.encode(payload + binascii.crc_hqx(payload, 0xFFFF).to_bytes(2, "big")) + b"\0"
        for payload in payloads(seed, channels=channels)
    )


SENT: dict[str, Callable[[int], bytes]] = {"lines": lines, "sync": behind_sync, "cobs": in_cobs}


def scores(data: bytes, baud: int, gap_bits: int) -> dict[int, float]:
    levels = wave(data, gap_bits=gap_bits, gap_every=12)
    found = {}
    for rate in BAUDS:
        heard = sampled(levels, baud / rate)
        cut = heard.data[:TRY_BYTES]
        share = len(cut) / max(1, len(heard.data))
        found[rate] = recognised(cut, round(heard.framing_errors * share)).score
    return found


@pytest.mark.long
@settings(max_examples=examples(45), deadline=None)
@given(
    kind=st.sampled_from(sorted(SENT)),
    baud=st.sampled_from(BAUDS),
    seed=st.integers(0, 10_000),
    gap_bits=st.sampled_from([0, 3, 40]),
    begin=st.integers(0, 30),
)
def test_the_rate_of_the_sender_is_the_best_of_all(
    kind: str, baud: int, seed: int, gap_bits: int, begin: int
) -> None:
    found = scores(SENT[kind](seed)[begin:], baud, gap_bits)
    best = max(found, key=lambda rate: found[rate])
    assert best == baud, found
    assert found[best] >= 0.9, found
    assert max(score for rate, score in found.items() if rate != baud) < 0.8, found


@pytest.mark.long
@settings(max_examples=examples(45), deadline=None)
@given(
    kind=st.sampled_from(sorted(SENT)),
    baud=st.sampled_from(BAUDS),
    seed=st.integers(0, 10_000),
    gap_bits=st.sampled_from([0, 3, 40]),
)
def test_the_bytes_alone_tell_the_rate_where_the_port_counts_no_errors(
    kind: str, baud: int, seed: int, gap_bits: int
) -> None:
    levels = wave(SENT[kind](seed), gap_bits=gap_bits, gap_every=12)
    found = {rate: recognised(sampled(levels, baud / rate).data[:TRY_BYTES]).score for rate in BAUDS}
    assert max(found, key=lambda rate: found[rate]) == baud, found


@pytest.mark.long
@settings(max_examples=examples(60), deadline=None)
@given(
    channels=st.integers(1, 9),
    separator=st.sampled_from([",", ";", "\t", " "]),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
    begin=st.integers(0, 10),
    seed=st.integers(0, 1000),
)
def test_columns_of_lines_are_counted(channels: int, separator: str, end: str, begin: int, seed: int) -> None:
    data = lines(seed, frames=40, channels=channels, separator=separator, end=end)
    what = recognised(data[begin:]).what
    assert isinstance(what, TextLines)
    assert (what.separator, len(what.columns)) == (separator, channels + 1)
    assert what.delimiter == ("\r" if end == "\r" else "\n")
    assert all(column.numeric for column in what.columns)
    assert what.columns[0].step == 1
    assert not what.header
    assert not what.damaged


def test_a_header_a_prefix_texts_and_a_checksum_are_seen() -> None:
    named = recognised(
        b"t_ms,x,y,state\n" + b"".join(b"%d,%d.5,-3,ok\n" % (7 * k, k % 5) for k in range(30))
    ).what
    assert isinstance(named, TextLines)
    assert named.header
    assert [column.name for column in named.columns] == ["t_ms", "x", "y", "state"]
    assert [column.numeric for column in named.columns] == [True, True, True, False]
    assert (named.columns[1].least, named.columns[1].most) == (0.5, 4.5)

    def nmea(number: int) -> bytes:
        text = b"ACC,%d,%d" % (number, number * number)
        return b"$%b*%02X\r\n" % (text, reduce(xor, text))

    sent = b"".join(map(nmea, range(30)))
    framed = recognised(sent).what
    assert isinstance(framed, TextLines)
    assert (framed.prefix, framed.checksum, len(framed.columns)) == ("$ACC", "xor", 2)
    spoilt = recognised(sent.replace(b"*", b"*F").replace(b"\r", b"")[:-2]).what
    assert isinstance(spoilt, TextLines)
    assert spoilt.checksum != "xor"


def test_text_that_is_certain_is_not_searched_for_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search takes seconds where a port sends fast."""
    searched: list[int] = []
    monkeypatch.setattr(recognise, "sync_frames", lambda data: searched.append(len(data)))
    assert isinstance(recognised(b"".join(b"%d,%d.5\n" % (n, n % 7) for n in range(200))).what, TextLines)
    assert not searched
    recognised(bytes(range(256)) * 4)
    assert searched == [1024]


def test_a_line_with_another_number_of_columns_is_counted() -> None:
    what = recognised(b"".join(b"%d,1,2\n" % k if k != 5 else b"5,1\n" for k in range(20))).what
    assert isinstance(what, TextLines)
    assert (len(what.columns), what.damaged) == (3, ["5,1"])


@pytest.mark.long
@settings(max_examples=examples(40), deadline=None)
@given(
    crc=st.sampled_from([name for name, what in CHECKSUMS.items() if what.size == 2]),
    order=st.sampled_from(["big", "little"]),
    channels=st.integers(1, 12),
    begin=st.integers(0, 40),
    seed=st.integers(0, 1000),
)
def test_sync_word_length_and_check_of_frames_are_found(
    crc: str, order: str, channels: int, begin: int, seed: int
) -> None:
    found = recognised(behind_sync(seed, channels=channels, crc=crc, order=order)[begin:])
    what = found.what
    assert isinstance(what, BinaryFrames)
    assert (what.sync, what.length) == (b"\xa5\x5a", 2 + 2 + 2 * channels + 2)
    assert (what.crc, what.crc_order, what.crc_from) == (crc, order, 2)
    assert found.score == 1.0
    assert what.counter is not None
    assert (what.counter.byte, what.counter.step) == (0, 1)
    assert what.payload_length == 2 + 2 * channels


@pytest.mark.parametrize("crc", ["crc-8", "sum-8", "xor-8"])
def test_checks_of_one_byte_are_found(crc: str) -> None:
    what = recognised(behind_sync(3, channels=4, crc=crc)).what
    assert isinstance(what, BinaryFrames)
    assert (what.sync, what.crc, what.payload_length) == (b"\xa5\x5a", crc, 10)


def test_frames_without_a_check_are_found_and_are_less_sure() -> None:
    data = b"".join(b"\xa5\x5a" + payload for payload in payloads(1, channels=4))
    found = recognised(data[3:])
    assert isinstance(found.what, BinaryFrames)
    assert (found.what.sync, found.what.length, found.what.crc) == (b"\xa5\x5a", 12, "")
    assert 0.5 < found.score < 0.9


@pytest.mark.long
@settings(max_examples=examples(30), deadline=None)
@given(channels=st.integers(1, 12), begin=st.integers(0, 40), seed=st.integers(0, 1000))
def test_cobs_frames_are_found(channels: int, begin: int, seed: int) -> None:
    what = recognised(in_cobs(seed, channels=channels)[begin:]).what
    assert isinstance(what, BinaryFrames)
    assert (what.framing, what.length, what.crc) == ("cobs", 2 + 2 * channels + 2, "ibm-3740")
    assert what.counter is not None


@pytest.mark.parametrize("parity", ["even", "odd"])
def test_seven_bits_with_parity_are_told_from_the_bytes(parity: str) -> None:
    levels = wave(lines(5), data_bits=7, parity=parity)
    found = recognised(sampled(levels, 1.0).data)
    assert found.parity == parity
    assert isinstance(found.what, TextLines)
    assert len(found.what.columns) == 4
    assert recognised(lines(5)).parity is None


def test_eight_bits_with_parity_show_as_missing_stop_bits_until_it_is_expected() -> None:
    levels = wave(lines(5), parity="even")
    blind, right = sampled(levels, 1.0), sampled(levels, 1.0, parity_bit=True)
    assert blind.framing_errors > 0
    assert (
        recognised(blind.data, blind.framing_errors).score
        < recognised(right.data, right.framing_errors).score
    )
    assert recognised(right.data, right.framing_errors).score >= 0.9


@settings(max_examples=examples(60), deadline=None)
@given(data=st.binary(max_size=600))
def test_nothing_is_too_strange(data: bytes) -> None:
    assert 0.0 <= recognised(data).score <= 1.0


def damaged(rng: np.random.Generator, sent: bytes) -> bytes:
    """The same with one bit of one byte the other way round."""
    at = int(rng.integers(len(sent)))
    return sent[:at] + bytes([sent[at] ^ 1 << int(rng.integers(8))]) + sent[at + 1 :]


@pytest.mark.long
@settings(max_examples=examples(60), deadline=None)
@given(
    crc=st.sampled_from(["ibm-3740", "xmodem", "modbus"]),
    channels=st.integers(2, 8),
    bad_percent=st.integers(0, 20),
    stray_every=st.integers(8, 30),
    stray=st.integers(1, 9),
    seed=st.integers(0, 1000),
)
def test_frames_are_found_with_a_fifth_of_them_damaged_and_stray_bytes_behind_an_eighth(
    crc: str, channels: int, bad_percent: int, stray_every: int, stray: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    sent, hurt = b"", 0
    for k, payload in enumerate(payloads(seed, frames=150, channels=channels)):
        frame = b"\xa5\x5a" + payload + checksum(crc, payload)
        if rng.random() * 100 < bad_percent:
            frame, hurt = damaged(rng, frame), hurt + 1
        sent += frame + (rng.bytes(stray) if k % stray_every == 0 else b"")
    found = recognised(sent)
    what = found.what
    assert isinstance(what, BinaryFrames)
    assert (what.sync, what.length, what.crc) == (b"\xa5\x5a", 6 + 2 * channels, crc)
    assert found.score >= 0.9
    assert found.sure
    assert len(what.frames) == 150 - hurt
    # Of those whose sync word is damaged nothing is seen.
    assert 0 <= hurt - what.damaged <= max(4, hurt // 2)
    assert what.counter is not None
    assert (what.counter.byte, what.counter.step) == (0, 1)
    between = np.ceil(150 / stray_every) * stray
    assert what.bytes_per_frame == pytest.approx(what.length + between / 150, rel=0.06)


@pytest.mark.long
@settings(max_examples=examples(60), deadline=None)
@given(
    bad_percent=st.integers(0, 10),
    separator=st.sampled_from([",", ";", "\t"]),
    seed=st.integers(0, 1000),
)
def test_columns_are_those_of_most_lines_with_a_tenth_of_them_damaged(
    bad_percent: int, separator: str, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    good = lines(seed, frames=300, separator=separator, end="\n").splitlines(keepends=True)
    bad = {}
    for k in np.flatnonzero(rng.random(300) * 100 < bad_percent).tolist():
        bad[k] = (b"ERR sensor timeout\n", b"\x80\xff" + good[k][2:], good[k][:-5] + b"\n", b"1\n")[k % 4]
    # A line that lost its end may be one of shorter numbers.
    bad = {k: line for k, line in bad.items() if line.count(separator.encode()) != 3 or b"\xff" in line}
    sent = b"".join(bad.get(k, line) for k, line in enumerate(good))
    found = recognised(sent)
    what = found.what
    assert isinstance(what, TextLines)
    assert (what.separator, what.decimal, len(what.columns)) == (separator, ".", 4)
    assert all(column.numeric for column in what.columns)
    assert what.columns[0].step == 1
    assert [column.step for column in what.columns[1:]] == [0, 0, 0]
    # The first line may lack a part, and is left out.
    assert len(what.damaged) == len(bad.keys() - {0})
    assert found.sure


def test_what_counts_to_four_again_and_again_counts_no_lines() -> None:
    what = recognised(b"".join(b"%d,%d\n" % (k % 5, 7 * k % 11) for k in range(200))).what
    assert isinstance(what, TextLines)
    assert [column.step for column in what.columns] == [0, 0]
    wraps = recognised(b"".join(b"%d,%d\n" % (k % 256, 7 * k % 11) for k in range(2000))).what
    assert isinstance(wraps, TextLines)
    assert [column.step for column in wraps.columns] == [1, 0]
    assert [column.turns_at for column in wraps.columns] == [0, 0]


@pytest.mark.parametrize(
    ("begin", "turns", "bits"),
    [(200, 256, 8), (65_500, 65_536, 16), (65_500, 2**32, 0), (200, 2**32, 0), (3, 2**32, 0)],
)
@pytest.mark.parametrize("lost", [0, 3])
def test_the_width_of_a_counter_is_known_once_it_has_begun_again(
    begin: int, turns: int, bits: int, lost: int
) -> None:
    counts = [(begin + k) % turns for k in range(120) if not 36 <= k < 36 + lost]
    what = recognised(b"".join(b"%d,%d\n" % (count, 7 * k % 11) for k, count in enumerate(counts))).what
    assert isinstance(what, TextLines)
    assert [(column.step, column.bits) for column in what.columns] == [(1, bits), (0, 0)]


def test_a_damaged_digit_of_a_counter_is_no_turn_of_it() -> None:
    counts = [65_500 + k for k in range(120)]
    counts[30] = 0
    what = recognised(b"".join(b"%d,%d\n" % (count, 7 * k % 11) for k, count in enumerate(counts))).what
    assert isinstance(what, TextLines)
    assert what.columns[0].bits == 0


@pytest.mark.parametrize("turns_at", [100, 1000, 10_000])
@pytest.mark.parametrize("lost", [0, 3])
def test_a_count_that_begins_again_at_a_power_of_ten_is_seen(turns_at: int, lost: int) -> None:
    """Also where the lines at the turn are lost; a damaged digit is no turn."""
    counts = [turns_at - 60 + k for k in range(120) if not 60 <= k < 60 + lost]
    texts = [b"%d" % (count % turns_at) for count in counts]
    turned = recognised(b"".join(b"%s,%d\n" % (text, 7 * k % 11) for k, text in enumerate(texts))).what
    assert isinstance(turned, TextLines)
    assert [column.turns_at for column in turned.columns] == [turns_at, 0]
    texts[:] = [b"%d" % (4 * turns_at + 5 * turns_at // 10 + k) for k in range(120)]
    texts[40] = b"%d" % (int(texts[40]) - turns_at)
    damaged = recognised(b"".join(b"%s,%d\n" % (text, 7 * k % 11) for k, text in enumerate(texts))).what
    assert isinstance(damaged, TextLines)
    assert [column.turns_at for column in damaged.columns] == [0, 0]


@settings(max_examples=examples(40), deadline=None)
@given(
    channels=st.integers(1, 6),
    width=st.integers(6, 14),
    decimal=st.sampled_from([".", ","]),
    begin=st.integers(0, 30),
    seed=st.integers(0, 1000),
)
def test_columns_padded_with_blanks_are_counted(
    channels: int, width: int, decimal: str, begin: int, seed: int
) -> None:
    plain = lines(seed, frames=60, channels=channels, end="\n").decode().splitlines()
    padded = [" ".join(field.rjust(width) for field in line.split(",")) for line in plain]
    data = "\n".join(padded).replace(".", decimal).encode()
    found = recognised(data[begin:])
    assert found.score >= CONCLUSIVE
    what = found.what
    assert isinstance(what, TextLines)
    assert (what.separator, what.decimal, len(what.columns)) == (" ", decimal, channels + 1)
    assert all(column.numeric for column in what.columns)
    assert what.columns[0].step == 1
    assert not what.header
    assert not what.damaged


def test_a_header_over_padded_columns_names_them() -> None:
    rows = "".join(f"{k:8d} {k % 7 / 4:8.3f}\n" for k in range(20))
    what = recognised(b"\n     seq        x\n" + rows.encode()).what
    assert isinstance(what, TextLines)
    assert what.header
    assert [column.name for column in what.columns] == ["seq", "x"]


@settings(max_examples=examples(40), deadline=None)
@given(
    channels=st.integers(1, 6),
    separator=st.sampled_from([";", "\t", "|", " "]),
    seed=st.integers(0, 1000),
)
def test_decimal_commas_are_told_from_separators(channels: int, separator: str, seed: int) -> None:
    data = lines(seed, frames=40, channels=channels, separator=separator).replace(b".", b",")
    what = recognised(data[3:]).what
    assert isinstance(what, TextLines)
    assert (what.separator, what.decimal, len(what.columns)) == (separator, ",", channels + 1)
    assert all(column.numeric for column in what.columns)
    assert what.columns[0].step == 1
    assert what.columns[1].most == pytest.approx(numbers(seed, 40, channels)[1:, 0].max())


@settings(max_examples=examples(60), deadline=None)
@given(seed=st.integers(0, 100_000), size=st.integers(30, 4000))
def test_noise_is_never_taken_for_sure(seed: int, size: int) -> None:
    assert not recognised(np.random.default_rng(seed).bytes(size)).sure


def test_what_may_be_chance_is_not_sure() -> None:
    rng = np.random.default_rng(2)
    found = recognised(b"".join(b"\xaa" + rng.bytes(11) for _ in range(60)))
    assert isinstance(found.what, BinaryFrames)
    assert (found.what.sync, found.what.length) == (b"\xaa", 12)
    assert not found.sure


def test_noise_and_silence_are_nothing() -> None:
    noise = np.random.default_rng(0).integers(0, 256, 4000, np.uint8).tobytes()
    for data in (noise, bytes(4000), b"\xff" * 4000, b"U" * 4000, b""):
        found = recognised(data)
        assert found.what is None
        assert found.score < 0.5


UNITS = {
    "units behind a counter": ("{k},{v:.1f} mm/s,{t:.1f}C", ["", "mm/s", "C"]),
    "units only, with blanks behind commas": ("{v:.1f} mm/s, {t:.1f} %", ["mm/s", "%"]),
    "exponents": ("{k};{v:.1f} m/s^2;{t:.1f} m/s2;{t:.0f} 1/min", ["", "m/s^2", "m/s2", "1/min"]),
    "blanks between columns": ("{k} {v:.1f}g {t:.1f}degC", ["", "g", "degC"]),
    "a value that stands still": ("{k},45.1C,45 C", ["", "C", "C"]),
    "absent values": ("{k},{a} mm/s,{t:.1f} C", ["", "mm/s", "C"]),
    "hexadecimal numbers and versions": ("{k},0x{k:02X},3A,v1.2,1.2rc1,{v:.1f}", ["", *[None] * 4, ""]),
}


@pytest.mark.parametrize("decimal", [".", ","])
@pytest.mark.parametrize("header", [False, True])
@pytest.mark.parametrize(("form", "units"), UNITS.values(), ids=UNITS)
def test_units_behind_numbers_are_found(
    form: str, units: list[str | None], decimal: str, *, header: bool
) -> None:
    if decimal == "," and "," in form:
        form = form.replace(", ", ",").replace(",", ";")
    rows = [
        form.format(k=k, v=12 + k % 7 / 10, t=45 + k % 5 / 10, a="--" if k % 9 == 0 else k % 6)
        for k in range(60)
    ]
    rows = [row.replace(".", decimal) for row in rows]
    separator = next(mark for mark in ("," if decimal == "." else ";", ";", " ") if mark in rows[0])
    names = [f"n{k}" for k in range(len(units))] if header else [f"c{k + 1}" for k in range(len(units))]
    rows = [separator.join(names), *rows] if header else rows
    what = text_lines("".join(f"{row}\r\n" for row in rows).encode())
    assert what is not None
    assert (what.separator, what.header, list(what.damaged)) == (separator, header, [])
    assert [column.name for column in what.columns] == names
    assert [column.unit if column.numeric else None for column in what.columns] == units


def test_lines_in_another_unit_are_damaged() -> None:
    rows = [f"{k},{k % 7}.5 {'in/s' if k > 55 else 'mm/s'}" for k in range(60)]
    what = text_lines("".join(f"{row}\n" for row in rows).encode())
    assert what is not None
    assert (what.columns[1].unit, what.columns[1].most) == ("mm/s", 6.5)
    assert list(what.damaged) == rows[56:]


@pytest.mark.parametrize(("unit", "grows"), [("ms", True), ("mm/s", False)])
def test_what_grows_with_a_unit_behind_it_is_no_counter_and_a_time_if_the_unit_is_of_one(
    unit: str, *, grows: bool
) -> None:
    what = text_lines("".join(f"{10 * k} {unit},{k % 7}.5\n" for k in range(60)).encode())
    assert what is not None
    assert (what.columns[0].unit, what.columns[0].step, what.columns[0].grows) == (unit, 0.0, grows)


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_lines_with_letters_of_units_beyond_ascii_are_text(encoding: str) -> None:
    rows = [f"{20 + k % 7 / 10:.1f}°C,{k % 5}.25 µm,{k % 3}.5 m/s²" for k in range(60)]
    found = recognised("".join(f"{row}\r\n" for row in rows).encode(encoding))
    assert isinstance(found.what, TextLines)
    assert found.score >= CONCLUSIVE
    assert [column.unit for column in found.what.columns] == ["°C", "µm", "m/s²"]
    assert not found.what.damaged


@pytest.mark.parametrize("separator", [" ", ",", ", ", ";"])
@pytest.mark.parametrize("sign", ["=", ":"])
def test_names_in_front_of_numbers_are_those_of_the_columns(separator: str, sign: str) -> None:
    rows = [
        separator.join(
            (
                f"n{sign}{k}",
                f"Temp{sign}{20 + k % 7 / 10:.1f}C",
                f"V_1{sign}{'---' if k % 4 else k % 3}",
                "ok",
            )
        )
        for k in range(40)
    ]
    what = text_lines("".join(f"{row}\n" for row in rows).encode())
    assert what is not None
    assert (what.separator, what.header, list(what.damaged)) == (separator[0], False, [])
    assert [column.name for column in what.columns] == ["n", "Temp", "V_1", "c4"]
    assert [column.prefix for column in what.columns] == [f"n{sign}", f"Temp{sign}", f"V_1{sign}", ""]
    assert [column.unit for column in what.columns] == ["", "C", "", ""]
    assert what.columns[0].step == 1


MESSAGES = {
    "values alone, a message first": (["ERR 12"], "{v:.1f}", 1),
    "a message of two words first": (["E 7"], "{k} {v:.1f}", 2),
    "messages of words": (["sensor lost", "x"], "{k} {v:.1f}", 2),
    "words behind the prefix": (["$ERR,12,3"], "$ACC,{k},{v:.1f}", 2),
    "messages with the separator": (["ERR,12"], "{k},{v:.1f}", 2),
    "units": (["ERR 12", "WARN 3.5 C"], "{v:.1f} C", 2),
}


@pytest.mark.parametrize("first", [0, 7])
@pytest.mark.parametrize(("messages", "form", "columns"), MESSAGES.values(), ids=MESSAGES)
def test_messages_between_lines_name_no_column_and_are_no_columns(
    messages: list[str], form: str, columns: int, first: int
) -> None:
    rows = [
        messages[k % len(messages)] if k % 15 == first else form.format(k=k, v=12 + k % 7 / 10)
        for k in range(60)
    ]
    what = text_lines("".join(f"{row}\r\n" for row in ["", *rows]).encode())
    assert what is not None
    assert (what.header, list(what.others), len(what.columns)) == (False, [], columns)
    assert list(what.damaged) == rows[first::15]
    assert [column.name for column in what.columns] == [f"c{k + 1}" for k in range(columns)]


def test_a_header_that_comes_again_and_one_that_begins_like_a_message_are_headers() -> None:
    rows = [f"{k},{k % 7}.5" for k in range(40)]
    for header in ("fault,x", "t,x"):
        what = text_lines("\n".join([header, *rows[:20], header, *rows[20:], ""]).encode())
        assert what is not None
        assert (what.header, list(what.damaged)) == (True, [header])


@pytest.mark.parametrize("text", ["---", "NaN", "OL", "", "n/a", "-inf"])
@pytest.mark.parametrize("unit", ["", " mm/s"])
@pytest.mark.parametrize("each", [4, 2])
def test_a_column_without_a_value_in_some_lines_is_a_column_of_numbers(
    text: str, unit: str, each: int
) -> None:
    rows = [f"{k},{text}" if k % each else f"{k},{k % 7}.5{unit}" for k in range(40)]
    what = text_lines("".join(f"{row}\n" for row in rows).encode())
    assert what is not None
    column = what.columns[1]
    assert (column.numeric, column.unit, column.absent_text) == (True, unit.strip(), text)
    assert column.absent == sum(k % each > 0 for k in range(1, 40))
    assert not what.damaged


WORDS = ["gestört", "läuft", "Lüfter", "Öltemp", "arrêt", "démarré", "déjà", "prędkość", "łożysko", "℃", "§"]
UNITS = [" °C", " µm", " μm", " Ω", " kΩ", " ℃", "‰", "", ""]


@settings(max_examples=examples(25), deadline=None)
@given(
    words=st.lists(st.sampled_from(WORDS), min_size=1, max_size=2),
    units=st.tuples(st.sampled_from(UNITS), st.sampled_from(UNITS)),
    minus=st.sampled_from(["", "-", "\N{MINUS SIGN}"]),
    table=st.sampled_from(["utf-8", "latin-1", "cp1252", "cp437"]),
    begin=st.integers(0, 20),
    seed=st.integers(0, 100),
)
def test_text_in_any_language_is_text(
    words: list[str], units: tuple[str, str], minus: str, table: str, begin: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    text = "".join(
        f"{number};{1.8 + rng.random() / 5:.2f}{units[0]};{minus}{58 + rng.random():.1f}{units[1]};"
        f"{';'.join(words)}\r\n".replace(".", ",")
        for number in range(60)
    )
    try:
        data = text.encode(table)
    except UnicodeEncodeError:
        data = text.encode()
    found = recognised(data[begin:])
    assert isinstance(found.what, TextLines)
    assert found.score >= CONCLUSIVE
    assert len(found.what.columns) == 3 + len(words)
    assert not found.what.damaged
    assert found.what.columns[0].step == 1
    assert found.what.columns[1].numeric


@settings(max_examples=examples(25), deadline=None)
@given(
    framing=st.sampled_from(["sync", "cobs", "unchecked", "noise"]),
    sync=st.binary(min_size=1, max_size=4).filter(lambda word: word.strip(b"\0\xff") != b""),
    crc=st.sampled_from(["ibm-3740", "xmodem", "modbus", "sum-8"]),
    channels=st.integers(1, 12),
    spread=st.sampled_from([20, 700, 9000]),
    begin=st.integers(0, 30),
    seed=st.integers(0, 10_000),
)
def test_no_binary_frame_is_text(
    framing: str, sync: bytes, crc: str, channels: int, spread: int, begin: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    rows = rng.normal(0, spread, (60, channels)).clip(-32_000, 32_000).astype("<i2")
    sent = [struct.pack("<H", number) + row.tobytes() for number, row in enumerate(rows)]
    data = {
        "sync": lambda: b"".join(sync + one + checksum(crc, one) for one in sent),
        "cobs": lambda: b"".join(cobs.encode(one + checksum(crc, one)) + b"\0" for one in sent),
        "unchecked": lambda: b"".join(sync + one for one in sent),
        "noise": lambda: rng.bytes(1000),
    }[framing]()
    found = recognised(data[begin:])
    assert not isinstance(found.what, TextLines)
    assert found.printable < 0.9


@pytest.mark.parametrize("table", ["utf-8", "latin-1"])
def test_kinds_of_lines_may_begin_with_words_of_any_language(table: str) -> None:
    text = "".join(
        f"Lüfter;{number};{number % 7},5\r\nKühler;{number};{number % 5},5\r\n" for number in range(30)
    )
    what = recognised(text.encode(table)).what
    assert isinstance(what, TextLines)
    assert {kind.prefix for kind in what.kinds} == {"Lüfter", "Kühler"}
    named = "".join(f"{number} Öltemp={58 + number % 3},5 v={number % 7},5\r\n" for number in range(30))
    what = recognised(named.encode(table)).what
    assert isinstance(what, TextLines)
    assert [column.name for column in what.columns] == ["c1", "Öltemp", "v"]
