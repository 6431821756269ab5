"""CAN logs of real vehicles: every signal of every frame against cantools, and nothing left out."""

from __future__ import annotations

import gzip
from collections import Counter
from typing import TYPE_CHECKING, Any

import cantools.database.can
import numpy as np
import pytest

from drivers.base import StreamSpec
from drivers.can_adapter import batch_of
from drivers.can_batches import FrameSorter
from drivers.dbc import layout_from_dbc
from drivers.replay_can import CanLog

if TYPE_CHECKING:
    from pathlib import Path

    import can
    from cantools.database.can import Message
    from numpy.typing import NDArray

    from drivers.can_batches import Sorted
    from drivers.frames import FrameLayout

pytestmark = pytest.mark.data

RECORDINGS = {
    "formula-student": (
        "can/motec_candump/can_sample.log.gz",
        "can/motec_candump/sample_can_spec.dbc",
        82_558,
    ),
    "gnss-imu": (
        "can/derived/css_94C49784_imu100hz_static.log.gz",
        "can/css_electronics/other/matlab-basics/dbc_files/canmod-gps.dbc",
        84_730,
    ),
}
LONG_NS = 60 * 1_000_000_000


def frames_of(log: Path) -> list[tuple[str, bytes]]:
    """Identifier as it is written and payload of each line, read without any library."""
    with gzip.open(log, "rt") as lines:
        written = [line.split()[2].split("#") for line in lines]
    return [(frame_id, bytes.fromhex(payload)) for frame_id, payload in written]


def layout_of(dbc: Path, message: Message) -> FrameLayout:
    """All signals of a message: the first one in the place of the counter, which neither log has."""
    first, *rest = (signal.name for signal in message.signals)
    channels = {name: [name] for name in rest}
    return layout_from_dbc(dbc, message.name, counter=first, counts="frames", channels=channels)


def played(log: Path, specs: list[StreamSpec[FrameLayout]]) -> list[Sorted]:
    """The log as the replay driver reads it, piece by piece."""
    sorter = FrameSorter(specs)

    def sort(messages: list[can.Message], t_ns: NDArray[np.int64]) -> Sorted:
        return sorter.sort(batch_of(messages, t_ns.tolist()), 0)

    recording = CanLog(log, sort)
    try:
        return list(iter(lambda: recording.read(LONG_NS), None))
    finally:
        recording.close()


@pytest.mark.parametrize("recording", RECORDINGS)
def test_every_signal_of_every_frame_is_what_cantools_reads(data: Path, recording: str) -> None:
    log_path, dbc_path, frames = RECORDINGS[recording]
    database = cantools.database.can.Database()
    database.add_dbc_file(str(data / dbc_path))
    messages = {f"{message.frame_id:03X}": message for message in database.messages}
    written = frames_of(data / log_path)
    assert len(written) == frames
    specs = [
        StreamSpec(message.name, layout_of(data / dbc_path, message), 100.0) for message in messages.values()
    ]

    pieces = played(data / log_path, specs)

    assert sum(piece.data_frames for piece in pieces) == frames
    ids = Counter(frame_id for frame_id, _ in written)
    assert sum(piece.notes.get("frames_unknown", 0) for piece in pieces) == frames - sum(
        ids[frame_id] for frame_id in messages
    )
    assert not any(piece.wrong_length for piece in pieces)
    for frame_id, message in messages.items():
        parts = [part for piece in pieces for part in piece.frames if part.stream == message.name]
        payloads = [payload for name, payload in written if name == frame_id]
        first, *rest = (signal.name for signal in message.signals)
        counts = np.concatenate([part.decoded.counter for part in parts])
        raw: list[Any] = [message.decode(p, decode_choices=False, scaling=False) for p in payloads]
        physical: list[Any] = [message.decode(p, decode_choices=False) for p in payloads]
        assert counts.tolist() == [row[first] for row in raw]
        if rest:
            values = np.concatenate([part.decoded.samples[:, 0] for part in parts])
            expected = np.array([[row[name] for name in rest] for row in physical], np.float64)
            np.testing.assert_allclose(values, expected, rtol=2e-7, atol=1e-12)


def test_the_imu_feels_gravity_and_nothing_else(data: Path) -> None:
    """The device lay still: what its axes feel adds up to 1 g, within the bias of a cheap sensor."""
    log_path, dbc_path, _ = RECORDINGS["gnss-imu"]
    axes = {axis: [f"Acceleration{axis.upper()}"] for axis in "xyz"}
    layout = layout_from_dbc(data / dbc_path, "gnss_imu", counter="ImuValid", counts="frames", channels=axes)
    pieces = played(data / log_path, [StreamSpec("imu", layout, 100.0)])
    felt = np.concatenate([part.decoded.samples[:, 0] for piece in pieces for part in piece.frames])
    assert np.linalg.norm(felt.mean(axis=0)) == pytest.approx(9.81, abs=1.0)
    assert felt.std(axis=0).max() < 0.5
