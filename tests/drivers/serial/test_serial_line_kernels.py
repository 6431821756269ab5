"""Numbers, checksums and time stamps in lines of text, against what Python itself makes of them."""

from __future__ import annotations

import binascii
import functools
import operator
import re

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from support.bus_tables import line_layout

from drivers.serial.framing import Pieces
from drivers.serial.line_kernels import check_lines
from drivers.serial.lines import DeviceTime, LineCodec
from drivers.serial.settings import LineLayout

pytestmark = pytest.mark.property
NUMBERS = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
    st.floats(-1e6, 1e6).map(lambda x: f"{x:.6f}"),
    st.integers(-(10**20), 10**20).map(str),
    st.integers(0, 2**40).map(str),
    st.text("0123456789+-.eE ", max_size=12),
    st.text("0123456789.", min_size=1, max_size=30),
)


def pieces(lines: list[bytes]) -> Pieces:
    """Lines as they are cut out of what a port brings."""
    buffer = np.frombuffer(b"\n".join(lines) + b"\n", np.uint8).copy()
    stops = np.cumsum([len(line) + 1 for line in lines]) - 1
    starts = np.concatenate(([0], stops[:-1] + 1))
    return Pieces(buffer, starts, stops, stops + 1)


def codec(**changes) -> LineCodec:
    """A counter or a time, a value, and a column that nobody asked for between them."""
    given = {"columns": ("seq", "spare", "x"), "channels": ("x",), "counter": "seq"}
    return LineCodec(line_layout(**(given | changes)))


def number(text: str, kind: type) -> float | None:
    """What Python makes of a field; None if it is no number, or one that no device means."""
    try:
        return kind(text) if not set(text) - set("0123456789+-.eE ") else None
    except ValueError:
        return None


def value(text: str) -> float | None:
    """The same, but NaN of what states that there is no value."""
    return np.nan if re.fullmatch(f" *(-*|{WORDS}) *", text, re.IGNORECASE) else number(text, float)


WORDS = r"nan|na|n/a|null|none|ol|ovl|[+-]?inf"
ABSENT = st.sampled_from(["", " ", "-", "----", " -- ", "nan", "NaN", "OL", "n/a", "-inf"])


@given(
    st.lists(st.tuples(NUMBERS, st.sampled_from(["", "?", "1.5"]), NUMBERS | ABSENT), min_size=1, max_size=8)
)
@example([("1", "", " 1. "), ("1", "", ".5e+01"), ("1", "", "."), ("1", "", "1e"), ("1", "", "1 2")])
@example([("1", "", text) for text in ("", "----", "nan", "na", "- -", "nann", "x", "OL ", "N/A", "n\x0fa")])
@example([("1", "", "9007199254740993"), ("1", "", "1e23"), ("1", "", "1e999"), ("1", "", "-0")])
@example([(counter, "", "1") for counter in (" 7 ", "+7", "-0", "7.", "7e0", "", "9" * 30)])
def test_numbers_are_those_of_python_to_the_last_bit(rows: list[tuple[str, str, str]]) -> None:
    stream = codec(channels=[{"name": "x", "scale": 0.1, "offset": -3.0}])
    lines = stream.read(pieces([",".join(row).encode() for row in rows]))
    counters, values = [number(row[0], int) for row in rows], [value(row[2]) for row in rows]
    good = [
        counter is not None and 0 <= counter < 2**32 and value is not None
        for counter, value in zip(counters, values, strict=True)
    ]
    assert lines.mine.all()
    assert lines.good.tolist() == good
    assert lines.places.tolist() == [counter for counter, ok in zip(counters, good, strict=True) if ok]
    with np.errstate(over="ignore"):
        want = np.array([value for value, ok in zip(values, good, strict=True) if ok], float) * 0.1 - 3.0
        np.testing.assert_array_equal(lines.samples[:, 0, 0], want.astype(np.float32))


@given(
    st.lists(
        st.tuples(
            st.integers(0, 99), st.floats(-1e6, 1e6), st.sampled_from(["nan", "--", "9007199254740993"])
        ),
        min_size=1,
        max_size=8,
    ),
    st.integers(1, 12),
    st.sampled_from(["", "   "]),
    st.sampled_from([None, "A"]),
)
def test_columns_padded_with_blanks_are_those_with_commas(
    rows: list[tuple[int, float, str]], width: int, end: str, prefix: str | None
) -> None:
    begin = [] if prefix is None else [prefix]
    texts = [[*begin, f"{counter}", f"{value:.3f}", last] for counter, value, last in rows]
    changes = {"channels": ("spare", "x"), "prefix": prefix}
    want = codec(**changes).read(pieces([",".join(text).encode() for text in texts]))
    padded = [" ".join(field.rjust(width) for field in text) + end for text in texts]
    got = codec(separator=" ", **changes).read(pieces([line.encode() for line in padded]))
    assert want.good.all()
    for one, other in zip(want, got, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_column_more_or_less_between_blanks_is_no_line() -> None:
    lines = codec(separator=" ").read(pieces([b"  1   2", b"  1   2   3", b" 1  2  3  4 ", b"   ", b""]))
    assert lines.good.tolist() == [False, True, False, False, False]


@given(st.lists(NUMBERS, min_size=1, max_size=8))
def test_times_are_those_of_python_to_the_last_bit(stamps: list[str]) -> None:
    stream = codec(counter=None, time="seq", unit="ms")
    lines = stream.read(pieces([f"{stamp},,1".encode() for stamp in stamps]))
    read = [number(stamp, float) for stamp in stamps]
    assert lines.places.tolist() == [ms / 1e3 for ms in read if ms is not None and abs(ms / 1e3) <= 1e12]


@given(st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=8))
@example([("1", "9007199254740993.5"), ("1", "1e999"), ("1", ",5"), ("1", "1.5"), ("1", "1,234.5")])
def test_decimal_commas_are_read_as_points_are(rows: list[tuple[str, str]]) -> None:
    points, commas = codec(separator=";"), codec(separator=";", decimal=",")
    # A comma in place of each point, and the other way round.
    swap = str.maketrans(".,", ",.")
    texts = [f"{counter};;{value}" for counter, value in rows]
    want = points.read(pieces([text.encode() for text in texts]))
    got = commas.read(pieces([text.translate(swap).encode() for text in texts]))
    assert got.good.tolist() == want.good.tolist()
    np.testing.assert_array_equal(got.places, want.places)
    np.testing.assert_array_equal(got.samples, want.samples)


@given(
    st.lists(
        st.tuples(
            NUMBERS | ABSENT, st.sampled_from(["", " ", "  "]), st.sampled_from(["mm/s", "C", "E", ""])
        ),
        min_size=1,
        max_size=8,
    ),
    st.sampled_from(["mm/s", "C", "E"]),
)
@example(
    [("12.5", " ", "mm/s"), ("12.5", "", "in/s"), ("-- ", "", "mm/s"), ("9007199254740993", "", "mm/s")],
    "mm/s",
)
@example([("1e5", "", "E"), ("1E", "", "E"), ("", "", "E"), ("nan", " ", ""), ("7", " ", "E ")], "E")
def test_a_number_is_read_with_the_text_behind_it_and_with_no_other(
    rows: list[tuple[str, str, str]], suffix: str
) -> None:
    stream = codec(channels=[{"name": "x", "suffix": suffix}])
    fields = ["".join(row) for row in rows]
    lines = stream.read(pieces([f"1,,{field}".encode() for field in fields]))
    values: list[float | None] = []
    for field in fields:
        bare = field.rstrip(" ")
        other = np.nan if value(field) is not None and np.isnan(value(field)) else None
        values.append(value(bare.removesuffix(suffix)) if bare.endswith(suffix) else other)
    assert lines.good.tolist() == [one is not None for one in values]
    with np.errstate(over="ignore"):
        want = np.array([one for one in values if one is not None], float).astype(np.float32)
    np.testing.assert_array_equal(lines.samples[:, 0, 0], want)


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["", " "]),
            st.sampled_from(["V=", "E", "W=", "", "µ:"]),
            NUMBERS | ABSENT,
            st.sampled_from(["", " "]),
            st.sampled_from(["°C", "C", "E", ""]),
        ),
        min_size=1,
        max_size=8,
    ),
    st.sampled_from(["V=", "E", "µ:"]),
    st.sampled_from([None, "°C", "E"]),
    st.sampled_from(["utf-8", "latin-1"]),
)
@example([("", "V=", "", "", ""), ("", "", "--", "", ""), ("", "V=", "--", "", "°C")], "V=", "°C", "utf-8")
@example([("", "V=", "9007199254740993", " ", "°C"), (" ", "V=", "1e5", "", "")], "V=", "°C", "latin-1")
def test_a_number_is_read_between_two_texts_and_not_without_them(
    rows: list[tuple[str, ...]], prefix: str, suffix: str | None, encoding: str
) -> None:
    channel = {"name": "x", "prefix": prefix} | ({} if suffix is None else {"suffix": suffix})
    fields = ["".join(row) for row in rows]
    lines = codec(channels=[channel]).read(pieces([f"1,,{field}".encode(encoding) for field in fields]))
    values: list[float | None] = []
    for field in fields:
        bare = field.lstrip(" ")
        is_whole = bare.startswith(prefix)
        bare = bare.removeprefix(prefix) if is_whole else field
        if is_whole and suffix is not None:
            is_whole = bare.rstrip(" ").endswith(suffix)
            bare = bare.rstrip(" ").removesuffix(suffix)
        one = value(bare)
        values.append(one if is_whole or (one is not None and np.isnan(one)) else None)
    assert lines.good.tolist() == [one is not None for one in values]
    with np.errstate(over="ignore"):
        want = np.array([one for one in values if one is not None], float).astype(np.float32)
    np.testing.assert_array_equal(lines.samples[:, 0, 0], want)


def test_counter_and_time_have_texts_around_them_too() -> None:
    layout = {"line": ("n", "x"), "channels": [{"name": "x", "prefix": "x:"}]}
    for place, text, good in (
        ({"counter": {"column": "n", "prefix": "n=", "suffix": "#"}}, b"n=17#", b"17"),
        ({"time": {"column": "n", "unit": "ms", "prefix": "t=", "suffix": "ms"}}, b"t=17000ms", b"t=17000s"),
    ):
        stream = LineCodec(LineLayout.model_validate({**layout, **place}))
        lines = stream.read(pieces([text + b",x:1.5", good + b",x:1.5", b"--,x:1.5"]))
        assert (lines.good.tolist(), lines.places.tolist()) == ([True, False, False], [17.0])
        written = stream.write(17, np.array([-0.5]))
        assert stream.read(pieces([written])).samples.ravel().tolist() == [-0.5]


def test_what_is_written_with_a_text_behind_it_is_read_again() -> None:
    stream = codec(separator=";", decimal=",", channels=[{"name": "x", "suffix": "m/s^2"}])
    text = stream.write(17, np.array([-0.5]))
    assert text == b"17;0,000000;-0,500000m/s^2"
    lines = stream.read(pieces([text]))
    assert (lines.places.tolist(), lines.samples.ravel().tolist()) == ([17.0], [-0.5])


def test_a_point_is_no_decimal_comma_nor_a_comma_a_point() -> None:
    cut = pieces([b"1;;0,249", b"2;;0.249", b"3;;249"])
    for mark, good in ((",", [True, False, True]), (".", [False, True, True])):
        lines = codec(separator=";", decimal=mark).read(cut)
        assert lines.good.tolist() == good
        np.testing.assert_array_equal(lines.samples[:, 0, 0], np.float32([0.249, 249]))


def test_what_is_written_with_decimal_commas_is_read_again() -> None:
    stream = codec(separator=";", decimal=",", counter=None, time="seq")
    text = stream.write(1.25, np.array([-0.5]))
    assert text == b"1250,0000;0,000000;-0,500000"
    lines = stream.read(pieces([text]))
    assert (lines.places.tolist(), lines.samples.ravel().tolist()) == ([1.25], [-0.5])


@given(st.lists(st.text("ab,1", max_size=8), min_size=1, max_size=8))
def test_a_line_belongs_to_the_stream_that_its_first_field_names(texts: list[str]) -> None:
    lines = codec(prefix="a").read(pieces([text.encode() for text in texts]))
    assert lines.mine.tolist() == [text.split(",")[0] == "a" for text in texts]
    assert lines.good.tolist() == [
        text.split(",")[0] == "a"
        and len(text.split(",")) == 4
        and number(text.split(",")[1], int) is not None
        and value(text.split(",")[3]) is not None
        for text in texts
    ]


@pytest.mark.parametrize("digits", [2, 4])
@given(
    data=st.lists(st.tuples(st.text("$!*aF0", max_size=9), st.sampled_from(["", "*", "x", "0"])), max_size=6)
)
def test_checksums_are_those_of_the_library(digits: int, data: list[tuple[str, str]]) -> None:
    texts, lines = [], []
    for k, (text, tail) in enumerate(data):
        body = text.encode()[text[:1] in {"$", "!"} :]
        right = binascii.crc_hqx(body, 0xFFFF) if digits == 4 else functools.reduce(operator.xor, body, 0)
        given = b"%0*x" % (digits, right)
        texts.append(text.encode())
        lines.append(text.encode() + b"*" + (given.upper() if k % 2 else given) + tail.encode())
    cut = pieces([*lines, b"no star"])
    ends, intact = check_lines(cut.buffer, cut.starts, cut.stops, digits)
    assert intact.tolist() == [not tail for _, tail in data] + [False]
    for k in np.flatnonzero(intact):
        assert cut.buffer[cut.starts[k] : ends[k]].tobytes() == texts[k]
    assert ends[-1] == cut.starts[-1]


@given(st.lists(st.floats(0.0, 1e4), max_size=30), st.floats(0.1, 1e5))
def test_counts_do_not_depend_on_how_stamps_come_in(stamps: list[float], rate_hz: float) -> None:
    times_s = np.array(stamps)
    apart = DeviceTime(rate_hz)
    counts = [int(apart.count(times_s[k : k + 1])[0]) for k in range(len(stamps))]
    assert DeviceTime(rate_hz).count(times_s).tolist() == counts


def test_a_value_that_is_absent_costs_no_other_of_its_line() -> None:
    stream = codec(columns=("seq", "x", "y"), channels=("x", "y"))
    # The second is left to Python for its many digits.
    lines = stream.read(pieces([b"1,----,2.5", b"2,,0.30000000000000000001", b"----,1,2"]))
    assert lines.good.tolist() == [True, True, False]
    np.testing.assert_array_equal(lines.samples[:, 0], np.float32([[np.nan, 2.5], [np.nan, 0.3]]))
