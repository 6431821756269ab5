"""What is noted of the frames on a CAN bus, however they are cut into batches; values against cantools."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cantools.database
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.examples import examples
from support.paths import ROOT

from drivers.can.batches import BIT_RATE_SWITCH, ERROR, EXTENDED, FD, REMOTE, CanBatch
from drivers.can.checks import frame_time
from drivers.can.dbc import messages_of
from drivers.can.dbc_traffic import DbcTraffic
from drivers.can.errors import ALL_CLASSES, BUS_ERROR
from drivers.can.traffic import Traffic
from drivers.frames import LayoutError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

pytestmark = pytest.mark.property
TRIAXIAL = ROOT / "config" / "devices" / "triaxial-accelerometer.dbc"

PAGED = """VERSION ""
BU_: N
BO_ 2566844416 Paged: 8 N
 SG_ Page M : 0|4@1+ (1,0) [0|0] "" N
 SG_ Level m0 : 8|12@1- (0.25,-3) [0|0] "g" N
 SG_ Pressure m1 : 23|13@0+ (2,1000) [0|0] "bar" N
 SG_ State : 56|2@1+ (1,0) [0|3] "" N
BO_ 100 Absent: 8 N
 SG_ Nothing : 0|8@1+ (1,0) [0|0] "" N
VAL_ 2566844416 State 0 "off" 1 "on" ;
"""


def batch(
    frames: Sequence[tuple[int, bytes]], times_ns: Sequence[int] | None = None, fd: int = 0
) -> CanBatch:
    n = len(frames)
    # Bytes past the payload hold anything.
    data = np.frombuffer(b"".join(payload.ljust(64, b"\xa5") for _, payload in frames), np.uint8)
    return CanBatch(
        np.array([frame_id for frame_id, _ in frames], np.uint32),
        np.array([len(payload) for _, payload in frames], np.int64),
        data.reshape(n, 64),
        np.arange(n, dtype=np.int64) if times_ns is None else np.array(times_ns, np.int64),
        fd_flags=np.full(n, fd, np.uint8) if fd else None,
    )


def noted(batches: Sequence[CanBatch]) -> Traffic:
    traffic = Traffic()
    for one in batches:
        traffic.take(one, ALL_CLASSES)
    return traffic


@settings(max_examples=examples(60), deadline=None)
@given(
    payloads=st.lists(st.binary(min_size=0, max_size=8), min_size=1, max_size=30),
    gaps=st.lists(st.integers(0, 10**8), min_size=30, max_size=30),
    cut=st.integers(0, 30),
)
def test_periods_and_bytes_that_change_do_not_depend_on_batches(
    payloads: list[bytes], gaps: list[int], cut: int
) -> None:
    times = np.cumsum(gaps)[: len(payloads)]
    frames = [(0x101, payload) for payload in payloads]
    parts = [slice(0, cut), slice(cut, None)]
    traffic = noted([batch(frames[part], times[part]) for part in parts if frames[part]])
    [one] = traffic.ids.values()
    assert one.frames == len(payloads)
    assert one.lengths == sorted({len(payload) for payload in payloads})
    assert one.last == payloads[-1]
    whole = [payload.ljust(8, b"\0") for payload in payloads]
    assert one.changed_bytes == [k for k in range(8) if len({payload[k] for payload in whole}) > 1]
    between_s = np.diff(times) / 1e9
    if len(between_s):
        assert one.period_s == pytest.approx(between_s.mean(), abs=1e-12)
        assert (one.shortest_s, one.longest_s) == pytest.approx((between_s.min(), between_s.max()))
    if len(between_s) > 1:
        assert one.period_std_s == pytest.approx(between_s.std(ddof=1), abs=1e-9)


@settings(max_examples=examples(60), deadline=None)
@given(
    place=st.integers(0, 5),
    width=st.sampled_from([1, 2]),
    order=st.sampled_from(["little", "big"]),
    step=st.integers(1, 200),
    start=st.integers(0, 65_535),
    cut=st.integers(1, 599),
)
def test_a_counter_is_found_where_it_is(
    place: int, width: int, order: str, step: int, start: int, cut: int
) -> None:
    rng = np.random.default_rng(0)
    frames = []
    for k in range(600):
        payload = bytearray(rng.integers(0, 256, 8, np.uint8).tobytes())
        count = (start + k * step) % 256**width
        payload[place : place + width] = count.to_bytes(width, "little" if order == "little" else "big")
        frames.append((0x101, bytes(payload)))
    [one] = noted([batch(frames[:cut]), batch(frames[cut:])]).ids.values()
    assert one.counter is not None
    assert (one.counter.byte, one.counter.bits, one.counter.step) == (place, 8 * width, step)
    assert width == 1 or one.counter.order == order


def test_bytes_without_order_or_without_change_are_no_counter() -> None:
    rng = np.random.default_rng(0)
    frames = [(1, rng.integers(0, 256, 7, np.uint8).tobytes() + b"\7") for _ in range(100)]
    frames[50:] = [(2, bytes([k])) for k in range(8)]  # too few to be sure
    traffic = noted([batch(frames)])
    assert [one.counter for one in traffic.ids.values()] == [None, None]


def test_kinds_of_frames_are_kept_apart() -> None:
    traffic = noted(
        [
            batch([(0x123, b"ab"), (0x123 | EXTENDED, b"c"), (0x123 | REMOTE, b"12345678")]),
            batch([(0x123, bytes(12)), (ERROR | BUS_ERROR, bytes(8))], [10, 11], fd=FD | BIT_RATE_SWITCH),
        ]
    )
    kinds = {one.frame_id: (one.kind, one.lengths, one.frames) for one in traffic.ids.values()}
    assert kinds == {
        0x123: ("11 bit, classic and FD", [2, 12], 2),
        0x123 | EXTENDED: ("29 bit", [1], 1),
        0x123 | REMOTE: ("11 bit, remote", [8], 1),
    }
    assert (traffic.frames, traffic.error_frames, traffic.fd) == (4, 1, True)
    assert traffic.errors.counts == {"bus_errors": 1}
    assert traffic.ids[0x123].rate_hz is not None
    assert traffic.ids[0x123 | EXTENDED].rate_hz is None


def test_the_load_is_the_time_of_all_frames() -> None:
    traffic = noted(
        [
            batch([(1, bytes(8)), (1, bytes(2)), (2 | EXTENDED, bytes(3)), (3 | REMOTE, bytes(8))]),
            batch([(4, bytes(64))], fd=FD | BIT_RATE_SWITCH),
            batch([(4, bytes(8))], fd=FD),
        ]
    )
    rates = {"bitrate": 500_000}
    wanted = [
        frame_time(8, extended=False, **rates),
        frame_time(2, extended=False, **rates),
        frame_time(3, extended=True, **rates),
        frame_time(0, extended=False, **rates),
        frame_time(64, extended=False, data_bitrate=2_000_000, **rates),
        frame_time(8, extended=False, fd=True, **rates),
    ]
    load = traffic.load(2.0, 500_000, 2_000_000)
    assert load.least_s == pytest.approx(sum(time.least_s for time in wanted) / 2)
    assert load.most_s == pytest.approx(sum(time.most_s for time in wanted) / 2)
    # With 17 CRC bits, the stuff count and fixed stuff bits such a frame is longer than a classic one.
    assert wanted[5].least_s > wanted[0].least_s


@settings(max_examples=examples(60), deadline=None)
@given(payloads=st.lists(st.binary(min_size=8, max_size=8), min_size=1, max_size=20), cut=st.integers(0, 20))
def test_values_are_those_of_cantools(payloads: list[bytes], cut: int) -> None:
    dbc = DbcTraffic(messages_of(TRIAXIAL))
    frames = [(513, payload) for payload in payloads]
    for part in (frames[:cut], frames[cut:]):
        if part:
            dbc.take(batch(part))
    [message] = dbc.heard
    theirs = cantools.database.load_file(TRIAXIAL).get_message_by_name("Acceleration")
    decoded = [theirs.decode(payload) for payload in payloads]
    assert {signal.name for signal in message.signals} == set(decoded[0])
    for signal in message.signals:
        values = [float(one[signal.name]) for one in decoded]
        assert (signal.last, signal.least, signal.most) == pytest.approx(
            (values[-1], min(values), max(values))
        )


def test_pages_of_a_multiplexer_are_told_apart_and_what_is_missing_is_named(tmp_path: Path) -> None:
    path = tmp_path / "paged.dbc"
    path.write_text(PAGED)
    dbc = DbcTraffic(messages_of(path))
    frame_id = (2566844416 & 0x1FFF_FFFF) | EXTENDED
    level = bytes([0x00, 0x10, 0, 0, 0, 0, 0, 1])
    other = bytes([0x02, 0xFF, 0xFF, 0, 0, 0, 0, 0])
    dbc.take(batch([(frame_id, level), (frame_id, other), (frame_id, b"short"), (0x64 | REMOTE, bytes(8))]))
    [message] = dbc.heard
    signals = {signal.name: signal for signal in message.signals}
    assert signals["Level"].frames == 1
    assert signals["Level"].last == 0.25 * 16 - 3
    assert signals["Pressure"].frames == 0
    assert math.isnan(signals["Pressure"].last)
    assert (signals["Page"].least, signals["Page"].most) == (0, 2)
    assert (signals["State"].last, signals["State"].choice) == (0.0, "off")
    assert (message.frames, message.short) == (3, 1)
    assert [one.name for one in dbc.missing] == ["Absent"]


def test_a_signal_that_counts_is_recognised_and_one_that_does_not_is_not() -> None:
    def counting(frames: list[tuple[int, bytes]]) -> list[str]:
        dbc = DbcTraffic(messages_of(TRIAXIAL))
        dbc.take(batch(frames[:100]))
        dbc.take(batch(frames[100:]))
        return [signal.name for signal in dbc.heard[0].signals if signal.counts]

    frames = [(513, bytes([k % 256, 1, 2, 3, 4, 5, 6, 0])) for k in range(300)]
    assert counting(frames) == ["Sequence"]
    assert counting([*frames[:150], *frames[151:]]) == ["Sequence"], "one was lost while it was listened"
    assert counting([frame for k, frame in enumerate(frames) if k % 60 != 7]) == []
    assert counting([(513, bytes([k % 200, 1, 2, 3, 4, 5, 6, 0])) for k in range(300)]) == []


def test_a_priority_of_j1939_does_not_matter(tmp_path: Path) -> None:
    path = tmp_path / "j1939.dbc"
    path.write_text(
        'VERSION ""\nBU_: N\nBO_ 2566844416 Speed: 8 N\n SG_ Rpm : 0|16@1+ (0.125,0) [0|0] "rpm" N\n'
        'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'
        'BA_DEF_DEF_ "VFrameFormat" "J1939PG";\nBA_ "VFrameFormat" BO_ 2566844416 3;\n'
    )
    dbc = DbcTraffic(messages_of(path))
    own = (2566844416 & 0x1FFF_FFFF) | EXTENDED
    frames = [(own, (800).to_bytes(2, "little").ljust(8, b"\xff")), (own ^ 0x0400_0000, b"\xff" * 8)]
    dbc.take(batch(frames))
    [message] = dbc.heard
    [speed] = message.signals
    assert (message.frames, len(message.ids)) == (2, 2)
    assert (speed.frames, speed.last) == (1, 100.0)  # 0xffff says that there is none


def test_what_is_no_dbc_file_is_refused_with_a_remedy(tmp_path: Path) -> None:
    with pytest.raises(LayoutError, match=r"there is no file .*Remedy: correct the path"):
        messages_of(tmp_path / "absent.dbc")
    (tmp_path / "bad.dbc").write_text("BO_ nonsense")
    with pytest.raises(LayoutError, match="cannot be read as a DBC file"):
        messages_of(tmp_path / "bad.dbc")


MESSAGE = 'BU_: A\nBO_ 1 M: 8 A\n SG_ X : 0|12@1+ (1,0) [0|0] "" A\n SG_ Y : 12|12@1+ (1,0) [0|0] "" A\n'


@pytest.mark.parametrize(
    ("text", "statement", "remedy"),
    [
        ("", "is empty", "copy it again"),
        ('name = "fan"\n', "is no DBC file: no line begins with BO_, as messages do", "give the DBC file"),
        (
            MESSAGE.replace("12|12", "8|12"),
            "cannot be read as a DBC file: The signals Y and X are overlapping in message M.",
            "correct start bit, length or byte order of these signals",
        ),
        (MESSAGE.replace("12|12", "60|12"), "does not fit in message M.", "correct start bit, length"),
        (
            MESSAGE.replace("X :", "X"),
            'cannot be read as a DBC file: Invalid syntax at line 3, column 8: " SG_ X 0|12@1+',
            "correct that line",
        ),
    ],
)
def test_a_dbc_file_that_cannot_be_read_has_a_remedy_for_its_fault(
    tmp_path: Path, text: str, statement: str, remedy: str
) -> None:
    (tmp_path / "bad.dbc").write_text(text)
    with pytest.raises(LayoutError) as raised:
        messages_of(tmp_path / "bad.dbc")
    assert statement in f"{raised.value}"
    assert f"Remedy: {remedy}" in f"{raised.value}"
