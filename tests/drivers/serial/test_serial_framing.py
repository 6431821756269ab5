"""Framings of serial ports: any cut, any garbage, any spoilt byte; nothing wrong is ever delivered."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.bus_tables import line_layout

from drivers.frames import FrameLayout
from drivers.serial.binary import BodyCodec, CobsFraming, SyncFraming
from drivers.serial.lines import LineFraming

if TYPE_CHECKING:
    from drivers.frames import DecodedBatch
    from drivers.serial.framing import Framing
    from drivers.serial.settings import LineLayout

pytestmark = pytest.mark.property
FRAMES = 12
SYNC = b"\xa5\x5a"


def packed(stream_id: int, per_frame: int) -> FrameLayout:
    return FrameLayout.plain(
        frame_id=stream_id,
        length=2 + 2 * per_frame,
        channels=[("x", 16, "signed", 1.0, 0.0)],
        samples_per_frame=per_frame,
        counter_byte=0,
        counter_bits=16,
        first_byte=2,
    )


def text(prefix: str) -> LineLayout:
    return line_layout(("seq", "x", "spare"), ("x",), counter="seq", bits=16, prefix=prefix)


BINARY = {"a": packed(1, 3), "b": packed(0xA5, 7)}
TEXT = {"a": text("$A"), "b": text("$B")}
KINDS = {
    "cobs": (lambda: CobsFraming(BodyCodec(BINARY, ids=True)), BINARY),
    "sync": (lambda: SyncFraming(BodyCodec(BINARY, ids=True, crc_order="little"), SYNC), BINARY),
    "lines": (lambda: LineFraming(TEXT, {"a": 1.0, "b": 1.0}, "crc16"), TEXT),
}
STREAMS = [st.sampled_from("ab")] * FRAMES


def in_kind(test):
    return pytest.mark.parametrize("kind", KINDS)(test)


def make(kind: str, order: tuple[str, ...]) -> tuple[Framing, list[bytes]]:
    """A framing, and frames for it whose samples are their number, but for the sync word here and there."""
    build, layouts = KINDS[kind]
    framing = build()
    frames = []
    for k, stream in enumerate(order):
        samples = np.full((1, layouts[stream].samples_per_frame, 1), float(k))
        if k % 3 == 0:
            samples[0, -1, 0] = 0x5AA5
        frames += framing.encode(stream, np.array([k * samples.shape[1]]), samples)
    return framing, frames


def numbers(found: list[DecodedBatch], kind: str) -> list[int]:
    """Numbers of the intact frames."""
    got = []
    for part in found:
        for stream, frames in part.frames.items():
            per_frame = KINDS[kind][1][stream].samples_per_frame
            good = frames.intact
            number = frames.counter[good] // per_frame
            samples = frames.samples[good][:, :, 0]
            assert (samples[:, :-1] == number[:, None]).all()
            assert (samples[:, -1] == np.where(number % 3, number, 0x5AA5)).all()
            got += number.tolist()
    return sorted(got)


def cut_up(framing: Framing, data: bytes, places: list[int]) -> list[DecodedBatch]:
    edges = [0, *sorted(place % (len(data) + 1) for place in places), len(data)]
    return [framing.cut(data[a:b]) for a, b in pairwise(edges)]


@in_kind
@given(order=st.tuples(*STREAMS), places=st.lists(st.integers(0, 10_000)))
def test_wherever_the_bytes_are_cut_every_frame_is_found(kind: str, order, places) -> None:
    framing, frames = make(kind, order)
    found = cut_up(framing, b"".join(frames), places)
    assert numbers(found, kind) == list(range(FRAMES))
    assert (
        sum(
            part.notes["bytes_garbage"] + part.notes["frames_malformed"] + part.notes["resyncs"]
            for part in found
        )
        == 0
    )


@in_kind
@given(
    order=st.tuples(*STREAMS),
    garbage=st.one_of(
        st.binary(min_size=1, max_size=200),
        st.text("\xa5\x5a\0\n,*$A1", min_size=1, max_size=60).map(lambda t: t.encode("latin-1")),
    ),
    at=st.integers(0, 10_000),
    places=st.lists(st.integers(0, 10_000)),
)
def test_garbage_costs_the_frame_it_hits_and_one_more_at_most(kind: str, order, garbage, at, places) -> None:
    framing, frames = make(kind, order)
    clean = b"".join(frames)
    at %= len(clean)
    data = clean[:at] + garbage + clean[at:]
    ends = np.cumsum([len(frame) for frame in frames]).tolist()
    hit = next(k for k, end in enumerate(ends) if at < end)
    # A sync framing takes the place of the frame after the last one for granted only when it has seen it.
    found = cut_up(framing, data, places)
    got = numbers(found, kind)
    missing = set(range(FRAMES)) - set(got)
    assert len(got) == len(set(got))
    assert missing <= {hit, hit + 1, FRAMES - 1}
    assert len(missing) <= 2
    assert hit >= FRAMES - 3 or FRAMES - 1 not in missing


@in_kind
@given(order=st.tuples(*STREAMS), at=st.integers(0, 10_000), flip=st.integers(1, 255))
def test_a_spoilt_byte_costs_the_frame_it_is_in_and_one_more_at_most(kind: str, order, at, flip) -> None:
    framing, frames = make(kind, order)
    data = bytearray(b"".join(frames))
    at %= len(data)
    data[at] ^= flip
    ends = np.cumsum([len(frame) for frame in frames]).tolist()
    hit = next(k for k, end in enumerate(ends) if at < end)
    missing = set(range(FRAMES)) - set(numbers([framing.cut(bytes(data))], kind))
    # A line ends in two bytes, the first of which is not needed.
    assert missing <= {hit, hit + 1}


@in_kind
@given(order=st.tuples(*STREAMS), at=st.integers(0, 10_000), length=st.integers(1, 60))
def test_missing_bytes_cost_the_frames_they_are_from_and_one_more_at_most(kind, order, at, length) -> None:
    framing, frames = make(kind, order)
    clean = b"".join(frames)
    at %= len(clean)
    ends = np.cumsum([len(frame) for frame in frames]).tolist()
    first = next(k for k, end in enumerate(ends) if at < end)
    last = next((k for k, end in enumerate(ends) if at + length <= end), FRAMES - 1)
    missing = set(range(FRAMES)) - set(numbers([framing.cut(clean[:at] + clean[at + length :])], kind))
    assert missing <= set(range(first, last + 2))


@in_kind
@given(chunks=st.lists(st.binary(max_size=400), max_size=20))
def test_nothing_at_all_makes_a_framing_raise_or_grow(kind: str, chunks) -> None:
    framing = KINDS[kind][0]()
    read = sum(map(len, chunks))
    found = [framing.cut(chunk) for chunk in chunks]
    assert sum(part.notes["bytes_garbage"] for part in found) <= read
    for part in found:
        for frames in part.frames.values():
            assert len(frames.arrival_ns) == len(frames.counter) == len(frames.samples)
            assert (np.diff(frames.arrival_ns) > 0).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("filler", [b"\xa5", b"\x07", b"1", SYNC + b"\x01"])
def test_garbage_without_end_is_counted_and_not_kept(kind: str, filler: bytes) -> None:
    framing, frames = make(kind, ("a",) * FRAMES)
    framing.cut(b"".join(frames))
    counted = sum(framing.cut(filler * 1000).notes["bytes_garbage"] for _ in range(50))
    counted += framing.cut(b"\r\n\0").notes["bytes_garbage"]
    assert counted > 50 * 1000 * len(filler) - 4000
    found = [framing.cut(b"\r\n\0"), framing.cut(b"".join(frames))]
    assert len(numbers(found, kind)) >= FRAMES - 1
    assert sum(part.notes["resyncs"] for part in found) == 1


@pytest.mark.parametrize(
    ("kind", "sent", "shown", "remedy"),
    [
        (
            "lines",
            b"1,2.5\r",
            'no line feed, which ends a line, in 1024 bytes, which begin with "1,2.5',
            "\\r",
        ),
        ("lines", b"\xff", "no line feed, which ends a line", ""),
        ("cobs", b"\x07", "no 0x00, which ends a frame", ""),
    ],
)
def test_bytes_in_which_no_frame_ends_are_told_once_with_what_to_write(
    kind: str, sent: bytes, shown: str, remedy: str
) -> None:
    framing, _ = make(kind, ("a",))
    found = [framing.cut(sent * 500) for _ in range(20)]
    told = [(one.malformed, one.remedy) for one in found if one.malformed]
    assert len(told) == 1
    assert shown in told[0][0]
    assert (f'write delimiter = "{remedy}"' in told[0][1]) == bool(remedy)
    assert sum(one.notes["frames_malformed"] for one in found) == 1
