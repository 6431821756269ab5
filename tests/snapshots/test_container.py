"""The container of snapshots: what is written is read, by others too, cut or damaged as it may be."""

from __future__ import annotations

import errno
import io
import json
import math
from dataclasses import replace
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
import pytest
from support.examples import examples

from daqsvc.acquisition.samples import Quality, SampleBlock
from daqsvc.confined.limits import ResourceLimits
from daqsvc.confined.process import ConfinedProcess
from daqsvc.recording import RecordingError
from daqsvc.recording.recording import load_recording
from daqsvc.snapshots.contents import ABOUT, ALARMS, SCHEMA, STANDING, Entry, Noted
from daqsvc.snapshots.mcap import MAGIC, Attachment, Damage, McapError
from daqsvc.snapshots.reading import SnapshotError, entries_of, read_snapshot
from daqsvc.snapshots.writing import CHUNK_BYTES, SnapshotWriter

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from typing_extensions import Buffer

    from daqsvc.snapshots.contents import Document

RATE_HZ = 1000.0
ROWS = 50
ABOUT_IT: Document = {
    "schema": SCHEMA,
    "begin_ns": 1000,
    "machine": "rig",
    "streams": {"shaft": {"rate_hz": RATE_HZ, "channels": ["x", "y"], "units": ["um", "um"]}},
}
FILES = {"machine.toml": b'site = "lab"\n', "files/rig.dbc": bytes(range(256))}


@pytest.fixture(scope="module")
def process() -> Iterator[ConfinedProcess]:
    """Reads the snapshots of all these tests, as it is not begun in no time."""
    with ConfinedProcess() as one:
        yield one


def block(number: int, rows: int = ROWS) -> SampleBlock:
    rng = np.random.default_rng(number)
    return SampleBlock(
        "shaft",
        number * rows,
        rng.standard_normal((rows, 2)).astype(np.float32),
        10**9 + number * rows * 10**6,
        1e6 + number / 7,
        lost_before=number % 3,
        quality=Quality.AFTER_LOSS if number % 3 else Quality.GOOD,
        t_error_ns=math.inf if number == 1 else 1234.5,
        pause_before=7 if number == 2 else None,
    )


def entries(blocks: int) -> list[Entry]:
    happened = [Entry(1000 + number, block(number)) for number in range(blocks)]
    happened.insert(1, Entry(1001, Noted(STANDING, {"stream": "shaft", "doubt": "", "proven": True})))
    happened.append(Entry(2000, Noted(ALARMS, {"alarm": "rotor-fault", "level": "danger"})))
    return happened


def write(path: Path, blocks: int, turns: int = 1) -> list[int]:
    """Write a snapshot in so many turns; returns how long it was after each."""
    writer = SnapshotWriter(path, ABOUT_IT, FILES, wall_ns=10**18)
    sizes = [writer.size]
    happened = entries(blocks)
    for turn in range(turns):
        writer.write(happened[turn * len(happened) // turns : (turn + 1) * len(happened) // turns])
        sizes.append(writer.size)
    writer.finish()
    assert writer.size == path.stat().st_size
    return sizes


def same(one: Entry, other: Entry) -> bool:
    if isinstance(one.what, SampleBlock) and isinstance(other.what, SampleBlock):
        mine, theirs = one.what, other.what
        return (
            one.at_ns == other.at_ns
            and mine.samples.tobytes() == theirs.samples.tobytes()
            and all(
                getattr(mine, name) == getattr(theirs, name)
                for name in SampleBlock.__slots__
                if name != "samples"
            )
        )
    return one == other


def test_everything_that_is_written_is_read(tmp_path: Path, process: ConfinedProcess) -> None:
    path = tmp_path / "one.mcap"
    write(path, blocks=5, turns=3)
    snapshot = read_snapshot(path, ResourceLimits(), process)
    assert snapshot.notes == ()
    assert snapshot.files == FILES
    assert snapshot.about == ABOUT_IT
    assert len(snapshot.entries) == 7
    assert all(map(same, snapshot.entries, entries(5)))


def test_a_cut_at_any_byte_takes_only_the_chunk_that_it_is_in(tmp_path: Path) -> None:
    path = tmp_path / "one.mcap"
    sizes = write(path, blocks=4, turns=6)
    data = path.read_bytes()
    happened = entries(4)
    whole = [0, 1, 2, 3, 4, 5, 6]  # a turn each
    for length in range(sizes[1], len(data)):
        damage = Damage()
        read = [one for one in entries_of(memoryview(data[:length]), damage) if isinstance(one, Entry)]
        there = max(number for number, size in zip(whole, sizes, strict=True) if size <= length)
        assert len(read) == 1 + there, length  # the first one is what it is about
        assert all(map(same, read[1:], happened))
        # Of the end only what finds the way is cut, not what was recorded.
        assert damage.ends_early or there == 6


def test_every_flipped_bit_is_either_harmless_or_known(tmp_path: Path) -> None:
    path = tmp_path / "one.mcap"
    write(path, blocks=3, turns=5)
    data = path.read_bytes()
    happened = entries(3)
    rng = np.random.default_rng(3)
    for at in rng.choice(len(data), examples(500), replace=False):
        flipped = bytearray(data)
        flipped[at] ^= 1 << int(rng.integers(8))
        damage = Damage()
        try:
            read = [one for one in entries_of(memoryview(flipped), damage) if isinstance(one, Entry)]
        except McapError:
            continue
        for one in read:
            if not (isinstance(one.what, Noted) and one.what.topic == ABOUT):
                assert any(same(one, other) for other in happened), at
        assert len(read) == 1 + len(happened) or damage.ends_early or damage.damaged_chunks, at


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"MCAP",
        b"\x00" * 4096,
        MAGIC,
        MAGIC + b"\x06" + b"\xff" * 8,
        MAGIC + b"\x05\x04\x00\x00\x00\x00\x00\x00\x00\x01\x02\x03\x04",
        MAGIC + b"\x04" + (2**63).to_bytes(8, "little"),
    ],
)
def test_what_is_no_snapshot_is_refused_in_a_sentence(
    data: bytes, tmp_path: Path, process: ConfinedProcess
) -> None:
    path = tmp_path / "odd.mcap"
    path.write_bytes(data)
    with pytest.raises(SnapshotError) as caught:
        read_snapshot(path, ResourceLimits(), process)
    assert str(path) in f"{caught.value}"
    assert "\n" not in f"{caught.value}"


def test_long_streams_lie_in_chunks_of_bounded_size(tmp_path: Path) -> None:
    path = tmp_path / "long.mcap"
    writer = SnapshotWriter(path, ABOUT_IT, {}, wall_ns=0)
    before = writer.size
    writer.write(Entry(number, block(number, rows=5000)) for number in range(20))
    writer.abandon()
    data = path.read_bytes()
    assert len(data) - before > 2 * CHUNK_BYTES
    damage = Damage()
    read = list(entries_of(memoryview(data[: len(data) - CHUNK_BYTES // 2]), damage))
    assert damage.ends_early
    assert len(read) >= 20 - 2 * CHUNK_BYTES // (5000 * 8)


class HalfTaken(io.BytesIO):
    """A file on a disk that takes half of what comes, and no more."""

    def __init__(self, file: BinaryIO) -> None:
        super().__init__()
        self.file = file

    def write(self, data: Buffer) -> int:
        self.file.write(bytes(data)[: len(bytes(data)) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")


def test_what_was_taken_is_finished_as_if_nothing_had_followed(tmp_path: Path) -> None:
    writer = SnapshotWriter(tmp_path / "one.mcap", ABOUT_IT, FILES, wall_ns=10**18)
    happened = entries(4)
    writer.write(happened[:4])
    writer._mcap._file = HalfTaken(writer._file)
    with pytest.raises(OSError, match="No space left"):
        writer.write(happened[4:])
    writer.finish_what_was_taken()
    other = SnapshotWriter(tmp_path / "other.mcap", ABOUT_IT, FILES, wall_ns=10**18)
    other.write(happened[:4])
    other.finish()
    assert writer.path.read_bytes() == other.path.read_bytes()
    assert writer.size == other.size


def test_of_what_was_never_taken_nothing_is_finished(tmp_path: Path) -> None:
    writer = SnapshotWriter(tmp_path / "one.mcap", ABOUT_IT, FILES, wall_ns=10**18)
    writer._mcap._file = HalfTaken(writer._file)
    with pytest.raises(OSError, match="No space left"):
        writer.write(entries(4))
    with pytest.raises(OSError, match="nothing of it was written"):
        writer.finish_what_was_taken()


def test_other_tools_read_it(tmp_path: Path) -> None:
    """The reference implementation of the format, with all CRCs checked."""
    reader = pytest.importorskip("mcap.reader")
    path = tmp_path / "one.mcap"
    write(path, blocks=3)
    made = reader.make_reader(io.BytesIO(path.read_bytes()), validate_crcs=True)
    summary = made.get_summary()
    assert summary.statistics.message_count == 6
    assert summary.statistics.attachment_count == 2
    topics = [channel.topic for _, channel, _ in made.iter_messages()]
    assert topics.count("/samples/shaft") == 3
    [(schema, channel, _)] = list(made.iter_messages(topics=["/alarms"]))
    assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
    assert {one.name: one.data for one in made.iter_attachments()} == FILES
    [(_, _, first)] = list(made.iter_messages(topics=[ABOUT]))
    assert json.loads(first.data)["machine"] == "rig"


def test_sensors_are_channels_of_a_recording(tmp_path: Path) -> None:
    path = tmp_path / "one.mcap"
    about = {**ABOUT_IT, "streams": {"shaft": {**ABOUT_IT["streams"]["shaft"], "sensors": ["probe-x", ""]}}}
    writer = SnapshotWriter(path, about, {}, wall_ns=0)
    writer.write([Entry(1, block(0)), Entry(2, replace(block(1), first_index=ROWS + 3, lost_before=3))])
    writer.finish()
    recording = load_recording(path)
    assert (recording.names, recording.rate_hz) == (("probe-x", "y"), RATE_HZ)
    assert recording.samples.shape == (2 * ROWS + 3, 2)
    assert np.isnan(recording.samples[ROWS : ROWS + 3]).all()
    assert (recording.samples[ROWS + 3 :] == block(1).samples).all()
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(RecordingError, match="was cut before any sample was written in it"):
        load_recording(path)


def test_others_see_the_samples_as_numbers(tmp_path: Path) -> None:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    from daqsvc.snapshots.mcap import read
    from daqsvc.snapshots.writing import samples_schema

    path = tmp_path / "one.mcap"
    write(path, blocks=1)
    files = descriptor_pb2.FileDescriptorSet.FromString(samples_schema().data)
    pool = descriptor_pool.DescriptorPool()
    for one in files.file:
        pool.Add(one)
    made = message_factory.GetMessageClass(pool.FindMessageTypeByName("daqsvc.SampleBlock"))
    [found] = [
        one
        for one in read(memoryview(path.read_bytes()), Damage())
        if not isinstance(one, Attachment) and one.topic == "/samples/shaft"
    ]
    message = made.FromString(bytes(found.data))
    assert list(message.samples) == [float(value) for value in block(0).samples.ravel()]
    assert message.channels == 2
