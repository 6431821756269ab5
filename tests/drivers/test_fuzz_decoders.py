"""Whatever bytes come, no decoder raises, and each finds its feet again. A hundred thousand cases."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import struct
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.bus_tables import can_bus, line_layout, replay_bus, serial_bus, table_layout
from support.examples import examples
from support.fuzz_bytes import mutated
from support.modbus_layouts import register

from daqsvc.acquisition.assembler import StreamAssembler
from daqsvc.acquisition.clock import DrivenClock
from drivers.base import BusPort, StreamSpec
from drivers.can.adapter import batch_of
from drivers.can.batches import ERROR, EXTENDED, REMOTE, CanBatch, FrameDemultiplexer
from drivers.can.driver import CanDriver
from drivers.frames import Field, FrameLayout
from drivers.modbus.registers import RegisterRecord, plan_runs, run_of
from drivers.modbus.replies import MAX_TCP_BYTES, ExpectedReply, judge_rtu, judge_tcp, register_bytes
from drivers.replay.driver import ReplayDriver
from drivers.replay.growing import candump_log
from drivers.serial.driver import framing_of

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from daqsvc.acquisition.samples import SampleBlock

pytestmark = pytest.mark.property
PROMISED = 100_000


def frame_layout(**changes: Any) -> FrameLayout:
    given: dict[str, Any] = {
        "frame_id": 0x101,
        "length": 32,
        "channels": [("x", 16, "signed", 0.5, 1.0), ("y", 32, "float", 1.0, 0.0)],
        "samples_per_frame": 4,
        "counter_byte": 0,
        "counter_bits": 16,
        "first_byte": 2,
        "crc_byte": 30,
    }
    return FrameLayout.plain(**(given | changes))


BITWISE = FrameLayout(
    frame_id=0x102,
    extended=True,
    length=8,
    channels=("a", "b"),
    fields=((Field(13, 7, "signed"), Field(30, 11, "unsigned", "big")),),
    scale=np.full((1, 2), 0.1),
    offset=np.zeros((1, 2)),
    counter=Field(0, 8),
    counts="frames",
)


UNCOUNTED = frame_layout(
    extended=True,
    any_priority=True,
    channels=[("x", 16, "unsigned", 0.01, -320.0), ("y", 32, "float", 1.0, 0.0)],
    counter_byte=None,
    counts="frames",
    valid_raw={"y": (-100.0, 100.0)},
)
"""A message of SAE J1939: no counter, and raw values that are no measurements."""


def assembler_of(layout: Any, blocks: list[SampleBlock]) -> StreamAssembler:
    return StreamAssembler(
        "s",
        1000.0,
        counter_bits=layout.counter_bits if isinstance(layout, FrameLayout) else layout.counter.bits,
        samples_per_frame=layout.samples_per_frame,
        counts_per_frame=layout.counts_per_frame if isinstance(layout, FrameLayout) else 1,
        deliver=blocks.append,
    )


def in_order(blocks: list[SampleBlock]) -> None:
    """What is delivered never overlaps, whatever the counters were."""
    for before, block in pairwise(blocks):
        assert block.first_index == before.end_index + block.lost_before


def can_payloads(rng: np.random.Generator) -> int:
    """Payloads of the right length, all the way to blocks."""
    n = 500
    layouts = [frame_layout(), frame_layout(counter_bits=8, first_byte=1), BITWISE, UNCOUNTED]
    layout = layouts[int(rng.integers(len(layouts)))]
    counters = np.cumsum(rng.choice([0, 1, 1, 1, 1, 2, -1, 50], n)) * layout.samples_per_frame
    samples = rng.integers(-3, 4, (n, layout.samples_per_frame, 2)).astype(float)
    sound = layout.encode(np.abs(counters), samples, clip=True)
    spoilt = rng.random(sound.shape) < rng.choice([0, 0.001, 0.05, 1])
    payloads = np.where(spoilt, rng.integers(0, 256, sound.shape), sound).astype(np.uint8)
    decoded = layout.decode(payloads)
    assert decoded.samples.shape == (n, layout.samples_per_frame, 2)
    blocks: list[SampleBlock] = []
    assembler = assembler_of(layout, blocks)
    arrival_ns = np.cumsum(rng.choice([0, 1_000_000, 4_000_000, 10**10], n, p=[0.3, 0.3, 0.39, 0.01]))
    for part in np.array_split(np.arange(n), 5):
        assembler.accept(decoded.counter[part], decoded.samples[part], decoded.intact[part], arrival_ns[part])
    assembler.flush()
    in_order(blocks)
    return n


def can_frames(rng: np.random.Generator) -> int:
    """Frames of every kind, id and length; each is counted somewhere."""
    n = 500
    specs = [StreamSpec("s", frame_layout(), 1000.0), StreamSpec("b", BITWISE, 1000.0)]
    ids = rng.choice(np.array([0x101, 0x102, 0, 0x7FF, 0x1FFF_FFFF], np.uint32), n)
    ids |= rng.choice(np.array([0, 0, EXTENDED, REMOTE, ERROR, EXTENDED | ERROR], np.uint32), n)
    lengths = rng.choice([0, 1, 8, 8, 32, 32, 64], n)
    data = rng.integers(0, 256, (n, 64)).astype(np.uint8)
    batch = CanBatch(ids, lengths, data, np.arange(n))
    found = FrameDemultiplexer(specs).sort(batch, int(rng.choice([0x1FFF_FFFF, 0x40, 0])))
    decoded = sum(len(frames.arrival_ns) for frames in found.frames.values())
    wrong = sum(count for count, _ in found.wrong_length.values())
    notes = found.notes
    elsewhere = sum(notes.get(f"frames_{kind}", 0) for kind in ("error", "remote", "unknown"))
    assert decoded + wrong + elsewhere == n
    return n


def register_values(rng: np.random.Generator) -> int:
    """Registers with any bits in them."""
    kinds = ["int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"]
    address, fields = 0, []
    for k, kind in enumerate(rng.permutation(kinds)):
        order = str(rng.choice(["ABCD", "CDAB", "BADC", "DCBA"]))
        fields.append(register(f"c{k}", address, kind, order))
        address += fields[-1].registers
    record = RegisterRecord(tuple(fields), plan_runs(map(run_of, fields)))
    raw = rng.integers(0, 256, (500, 2 * record.registers)).astype(np.uint8)
    raw[rng.random(500) < 0.2] = 0xFF
    assert record.decode(raw).shape == (500, len(fields))
    return len(raw)


def modbus_replies(rng: np.random.Generator) -> int:
    """What stands on a Modbus line after a request; judging it always gets on."""
    n = 300
    for _ in range(n):
        function = int(rng.choice([3, 4, 16, 24]))
        registers = int(rng.integers(1, 40))
        body = {
            16: struct.pack(">BHH", 16, 0, registers),
            24: struct.pack(">BHH", 24, 2 + 2 * registers, registers) + rng.bytes(2 * registers),
        }.get(function, struct.pack(">BB", function, 2 * registers) + rng.bytes(2 * registers))
        expected = ExpectedReply(
            7, function, 2 * registers if function in {3, 4} else None, transaction=int(rng.integers(3))
        )
        tcp = mutated(rng, struct.pack(">HHHB", expected.transaction, 0, 1 + len(body), 7) + body)
        rtu = mutated(rng, b"\x07" + body + _crc(b"\x07" + body).to_bytes(2, "big"))
        for data, judge in (
            (tcp, lambda d, e=expected: judge_tcp(d, e)),
            (tcp, lambda d: judge_tcp(d, None)),
            (rtu, lambda d, e=expected: judge_rtu(d, e, _crc)),
        ):
            _judge_to_the_end(data, judge)
    return 3 * n


def _judge_to_the_end(data: bytes, judge: Callable[[bytes], Any]) -> None:
    while True:
        verdict = judge(data)
        assert 0 <= verdict.used <= len(data)
        if verdict.pdu is not None:
            register_bytes(verdict.pdu)
        if not verdict.used:
            assert len(data) < MAX_TCP_BYTES, "it waits for more than a frame can hold"
            return
        data = data[verdict.used :]


def _crc(data: bytes) -> int:
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc >> 8 | (crc & 0xFF) << 8


LINES = line_layout(("seq", "x", "y"), ("x", "y"), counter="seq")
SERIAL: dict[str, tuple[dict[str, Any], Any]] = {
    "COBS": ({"framing": "cobs"}, frame_layout(crc_byte=None, length=26)),
    "sync word": ({"framing": "sync", "sync_word": "a55a"}, frame_layout(crc_byte=None, length=26)),
    "lines": ({"framing": "lines", "checksum": "crc16"}, LINES),
    "bare lines": ({"framing": "lines"}, LINES),
}


def serial_stream(kind: str) -> Callable[[np.random.Generator], int]:
    """Frames in a stream of bytes with anything between and within them, in chunks of any length."""

    def fuzz(rng: np.random.Generator) -> int:
        options, layout = SERIAL[kind]
        spec = StreamSpec("s", layout, 1000.0)
        framing = framing_of(serial_bus(port="/dev/null", **options), [spec])
        n = 300
        per_frame = layout.samples_per_frame
        index = per_frame * np.arange(n + 3)
        sound = framing.encode("s", index, np.round(rng.normal(0, 9, (n + 3, per_frame, 2))))
        stream = b"".join(mutated(rng, frame) for frame in sound[:n])
        blocks: list[SampleBlock] = []
        assembler = assembler_of(layout, blocks)
        at = 0
        while at < len(stream):
            chunk = stream[at : at + int(rng.integers(1, 400))]
            at += len(chunk)
            _accept(assembler, framing.cut(chunk), at, len(chunk))
        # Sound again: at the latest the frame behind the first sound one is found.
        found = [framing.cut(frame) for frame in sound[n:]]
        for part in found:
            _accept(assembler, part, at, 10**6)
        last = found[-1].frames["s"]
        assert last.intact[-1]
        counts, bits = (layout.counts_per_frame, layout.counter_bits) if per_frame > 1 else (1, 32)
        assert last.counter[-1] == (n + 2) * counts % 2**bits
        assembler.flush()
        in_order(blocks)
        return n

    return fuzz


def _accept(assembler: StreamAssembler, found: Any, at: int, length: int) -> None:
    for frames in found.frames.values():
        assert (frames.arrival_ns <= length).all()
        assembler.accept(*frames._replace(arrival_ns=np.full(len(frames.counter), at * 30_000)))


def candump_lines(rng: np.random.Generator) -> int:
    """Lines of a log that somebody has edited, and frames of python-can with anything in them."""
    n = 500
    lines = [
        b"(%d.%06d) can0 %03X##1%s" % (k // 250, k % 250 * 4000, 0x101, rng.bytes(32).hex().encode())
        for k in range(n)
    ]
    text = b"\n".join(mutated(rng, line) for line in lines).decode("ascii", "replace")
    log = candump_log(text)
    messages = list(log)
    assert len(messages) + log.malformed > 0
    batch = batch_of(messages, [0] * len(messages))
    FrameDemultiplexer([StreamSpec("s", frame_layout(), 1000.0)]).sort(batch, 0)
    return n


FUZZERS: dict[str, tuple[Callable[[np.random.Generator], int], int]] = {
    "CAN payloads": (can_payloads, 60_000),
    "CAN frames": (can_frames, 60_000),
    "registers": (register_values, 20_000),
    "Modbus replies": (modbus_replies, 18_000),
    **{f"serial {kind}": (serial_stream(kind), 9000) for kind in SERIAL},
    "candump lines": (candump_lines, 10_000),
}


@pytest.fixture(autouse=True)
def _quiet(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.CRITICAL)


@pytest.mark.parametrize("name", FUZZERS)
def test_no_bytes_break_a_decoder(name: str) -> None:
    fuzz, promised = FUZZERS[name]
    cases = 0

    @settings(max_examples=max(1, promised // fuzz(np.random.default_rng(0))))
    @given(seed=st.integers(0, 2**32 - 1))
    def each(seed: int) -> None:
        nonlocal cases
        cases += fuzz(np.random.default_rng(seed))

    each()
    assert cases >= promised


def test_there_are_as_many_cases_as_promised() -> None:
    assert sum(promised for _, promised in FUZZERS.values()) >= PROMISED


FRAMES_IN_A_FILE = 40
FILES = 12


@pytest.mark.long
@pytest.mark.parametrize("ending", [".log", ".asc", ".blf", ".trc", ".npz", ".csv"])
@settings(max_examples=examples(12))
@given(seed=st.integers(0, 2**32 - 1))
def test_a_recording_with_any_bytes_in_it_ends_in_words(
    tmp_path_factory: pytest.TempPathFactory, ending: str, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("files")
    sound = _sound_file(folder / f"sound{ending}", rng)
    for k in range(FILES):
        spoilt = folder / f"spoilt{k}{ending}"
        spoilt.write_bytes(mutated(rng, mutated(rng, sound)))
        asyncio.run(_play(spoilt))


def _sound_file(path: Path, rng: np.random.Generator) -> bytes:
    if path.suffix == ".npz":
        np.savez(path, x=rng.normal(size=50), y=rng.normal(size=50))
    elif path.suffix == ".csv":
        np.savetxt(path, rng.normal(size=(50, 2)), delimiter=",", header="x,y", comments="")
    else:
        with can.Logger(path) as logger:
            for k in range(FRAMES_IN_A_FILE):
                logger.on_message_received(
                    can.Message(
                        timestamp=1.6e9 + k / 250,
                        arbitration_id=0x101,
                        is_extended_id=False,
                        is_fd=path.suffix != ".trc",
                        data=rng.bytes(8 if path.suffix == ".trc" else 32),
                        channel=1,
                    )
                )
    return path.read_bytes()


async def _play(path: Path) -> None:
    table = path.suffix in {".npz", ".csv"}
    columns = table_layout(("x", "x", 1.0, 0.0), ("y", "y", 1.0, 0.0))
    layout: Any = columns if table else frame_layout()
    port = BusPort("tape", [StreamSpec("s", layout, 250.0)], DrivenClock(), lambda _: None)
    driver = ReplayDriver(replay_bus(file=path, at_end="stop", pace="unpaced"), port)
    task = asyncio.create_task(driver.run())
    # It ends by itself, or has said why it cannot go on and waits for better times.
    while not driver.link.reason:
        await asyncio.sleep(0.0005)
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    assert driver.link.state == "down"
    assert driver.counters.reader_failures == 0, "an error came where nobody had foreseen it"


async def test_a_driver_outlives_whatever_is_on_its_bus() -> None:
    rng = np.random.default_rng(3)
    blocks: list[SampleBlock] = []
    clock = DrivenClock()
    bus_table = can_bus(interface="virtual", channel="fuzz", fd=True)
    layout = frame_layout()
    driver = CanDriver(bus_table, BusPort("can0", [StreamSpec("s", layout, 1000.0)], clock, blocks.append))
    task = asyncio.create_task(driver.run())
    with can.Bus(interface="virtual", channel="fuzz", protocol=can.CanProtocol.CAN_FD) as bus:
        async with asyncio.timeout(60):
            while driver.link.state != "up":
                await asyncio.sleep(0.001)
            for _ in range(3000):
                bus.send(_any_message(rng))
            # Error frames among them have put it off the bus; what is sound is found again.
            k = 0
            while not blocks:
                k += 1
                clock.advance_to(clock.monotonic_ns() + 4_000_000)
                data = layout.encode(np.array([4 * k]), np.ones((1, 4, 2)))[0].tobytes()
                bus.send(can.Message(arbitration_id=0x101, is_extended_id=False, is_fd=True, data=data))
                await asyncio.sleep(0.001)
    assert not task.done()
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    assert (blocks[-1].samples == 1).all()
    assert driver.counters.frames_error > 0
    assert driver.counters.frames_unknown > 0
    assert driver.counters.reader_failures == 0


def _any_message(rng: np.random.Generator) -> can.Message:
    kind = rng.integers(8)
    return can.Message(
        arbitration_id=int(rng.choice([0x101, 0x7FF])),
        is_extended_id=bool(kind == 1),
        is_remote_frame=bool(kind == 2),
        is_error_frame=bool(kind == 3),
        is_fd=True,
        data=b"" if kind == 2 else rng.bytes(int(rng.choice([0, 8, 32, 32, 64]))),
    )
