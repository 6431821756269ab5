"""Messages of DBC files against cantools, signal by signal, whatever the payload."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cantools.database.can
import numpy as np
import pytest
from cantools.database.errors import DecodeError
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.examples import examples
from support.paths import ROOT

from drivers.base import StreamSpec
from drivers.can.batches import CanBatch, FrameDemultiplexer
from drivers.can.dbc import layout_from_dbc, selecting_values
from drivers.can.dbc import messages_of as database_messages
from drivers.frames import LayoutError

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.property
DEVICES = ROOT / "config" / "devices"

PAGED = """VERSION ""
BU_: N
BO_ 2566844416 Paged: 12 N
 SG_ Count : 0|8@1+ (1,0) [0|0] "" N
 SG_ Page M : 11|4@0+ (1,0) [0|0] "" N
 SG_ LittleSigned m0 : 16|12@1- (0.25,-3) [0|0] "g" N
 SG_ BigUnsigned m1 : 23|13@0+ (2,1000) [0|0] "" N
 SG_ BigFloat m2 : 23|32@0- (1,0) [0|0] "" N
 SG_ BigSigned m3 : 40|17@0- (-0.5,7) [0|0] "" N
 SG_ Double m5 : 32|64@1- (1,0) [0|0] "" N
 SG_ Deeper m4M : 16|3@1+ (1,0) [0|0] "" N
 SG_ Nested m6 : 24|8@1- (1,0) [0|0] "" N
 SG_ Ranged m0 : 32|8@1+ (1,0) [0|0] "" N
SIG_VALTYPE_ 2566844416 BigFloat : 1;
SIG_VALTYPE_ 2566844416 Double : 2;
SG_MUL_VAL_ 2566844416 LittleSigned Page 0-0;
SG_MUL_VAL_ 2566844416 BigUnsigned Page 1-1;
SG_MUL_VAL_ 2566844416 BigFloat Page 2-2;
SG_MUL_VAL_ 2566844416 BigSigned Page 3-3;
SG_MUL_VAL_ 2566844416 Double Page 5-5;
SG_MUL_VAL_ 2566844416 Deeper Page 4-4;
SG_MUL_VAL_ 2566844416 Nested Deeper 6-7;
SG_MUL_VAL_ 2566844416 Ranged Page 0-0, 8-10;
"""


def messages_of(path: Path) -> list[Any]:
    database = cantools.database.can.Database()
    database.add_dbc_file(str(path))
    return list(database.messages)


def check_every_signal(path: Path, message: Any, payload: bytes) -> None:
    """Each signal by itself, in the place of a sample, is there and worth what cantools says, or is not."""
    try:
        there = message.decode(payload, decode_choices=False)
    except DecodeError:  # a value of the multiplexer without a page
        there = {}
    raw = np.frombuffer(payload, np.uint8)[None]
    plain = {signal.name for signal in message.signals if signal.multiplexer_ids is None}
    for signal in message.signals:
        counter = next(
            (
                s.name
                for s in message.signals
                if s.multiplexer_ids is None and s.name != signal.name and not s.is_multiplexer
            ),
            None,
        )
        if counter is None or signal.is_multiplexer:
            continue
        layout = layout_from_dbc(
            path, message.name, counter=counter, counts="frames", channels={"it": [signal.name]}
        )
        if not there:
            assert bool(layout.selects(raw)[0]) == (signal.name in plain)
            continue
        assert bool(layout.selects(raw)[0]) == (signal.name in there)
        if signal.name in there:
            expected = np.float64(there[signal.name])
            with np.errstate(over="ignore"):
                np.testing.assert_allclose(
                    layout.decode(raw).samples[0, 0, 0], np.float32(expected), rtol=3e-7, atol=1e-30
                )


@pytest.fixture(scope="module")
def paged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("dbc") / "paged.dbc"
    path.write_text(PAGED)
    return path


@settings(max_examples=examples(60))
@given(page=st.integers(0, 15), payload=st.binary(min_size=12, max_size=12))
@example(page=4, payload=bytes([0, 0, 6, 0x85, *range(8)]))
@example(page=2, payload=bytes([0, 0, 0x7F, 0xC0, *range(8)]))
def test_every_page_of_a_multiplexed_message(paged: Path, page: int, payload: bytes) -> None:
    (message,) = messages_of(paged)
    check_every_signal(paged, message, bytes([payload[0], page, *payload[2:]]))


@settings(max_examples=examples(20))
@given(st.data())
def test_every_message_of_the_device_files(draw: st.DataObject) -> None:
    for path in sorted(DEVICES.glob("*.dbc")):
        for message in messages_of(path):
            check_every_signal(
                path, message, draw.draw(st.binary(min_size=message.length, max_size=message.length))
            )


@pytest.mark.data
def test_every_message_of_the_recordings(data: Path) -> None:
    rng = np.random.default_rng(0)
    for path in sorted((data / "can").rglob("*.dbc")):
        for message in messages_of(path):
            for _ in range(5):
                check_every_signal(path, message, rng.bytes(message.length))


def test_pages_go_to_their_streams_and_are_encoded_as_they_are_read(paged: Path) -> None:
    layouts = {
        name: layout_from_dbc(paged, "Paged", counter="Count", counts="frames", channels={"it": [name]})
        for name in ("LittleSigned", "Nested")
    }
    sent = [
        layouts["LittleSigned"].encode(np.array([0]), np.array([[[-100.0]]]))[0],
        layouts["Nested"].encode(np.array([1]), np.array([[[-5.0]]]))[0],
        np.frombuffer(bytes([2, 3, *range(10)]), np.uint8),
        np.frombuffer(bytes([3, 4, 5, *range(9)]), np.uint8),
    ]
    (message,) = messages_of(paged)
    assert message.decode(sent[0].tobytes())["LittleSigned"] == -100.0
    assert message.decode(sent[1].tobytes())["Nested"] == -5
    data = np.zeros((4, 64), np.uint8)
    data[:, :12] = sent
    sorter = FrameDemultiplexer([StreamSpec(name, layout, 100.0) for name, layout in layouts.items()])
    ids = np.full(4, 2566844416, np.uint32)
    found = sorter.sort(CanBatch(ids, np.full(4, 12), data, np.arange(4)), 0)
    got = {name: part.samples.ravel().tolist() for name, part in found.frames.items()}
    assert got == {"LittleSigned": [-100.0], "Nested": [-5.0]}
    assert found.notes["frames_unknown"] == 2
    pages = {"0x18fef000 (29 bit), Page 3": 1, "0x18fef000 (29 bit), Page 4, Deeper 5": 1}
    assert found.unknown == pages
    assert found.pages_of == {page: ["LittleSigned", "Nested"] for page in pages}


def test_signals_of_different_pages_are_no_stream(paged: Path) -> None:
    with pytest.raises(LayoutError, match=r"on different pages.*make a stream for each page"):
        layout_from_dbc(
            paged, "Paged", counter="Count", counts="frames", channels={"a": ["BigFloat"], "b": ["Nested"]}
        )
    (message,) = messages_of(paged)
    signals = {signal.name: signal for signal in message.signals}
    assert selecting_values(signals, ["Nested"]) == {"Deeper": {6, 7}, "Page": {4}}


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8", "utf-8-sig"])
def test_units_are_read_as_the_file_was_saved(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "units.dbc"
    path.write_bytes(
        'VERSION ""\n\nBU_: A\n\nBO_ 256 Temp: 8 A\n SG_ T : 0|16@1- (0.1,0) [-40|150] "°C" A\n'.encode(
            encoding
        )
    )
    [message] = database_messages(path)
    assert [signal.unit for signal in message.signals] == ["°C"]
