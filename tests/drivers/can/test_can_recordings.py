"""CAN logs of real vehicles: every signal of every frame against cantools, and nothing left out."""

from __future__ import annotations

import gzip
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cantools.database.can
import numpy as np
import pytest
from support.examples import first_of

from daqsvc.acquisition.clock import DrivenClock
from daqsvc.settings import parse_machine_file
from drivers.base import StreamSpec
from drivers.can.adapter import batch_of
from drivers.can.batches import FrameDemultiplexer
from drivers.can.dbc import layout_from_dbc
from drivers.make import bus_drivers
from drivers.replay.can_log import CanLog
from drivers.replay.driver import ReplayCounters

if TYPE_CHECKING:
    import can
    from cantools.database.can import Message
    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import SampleBlock
    from daqsvc.settings.models import MachineFile
    from drivers.frames import DecodedBatch, FrameLayout

pytestmark = [pytest.mark.integration, pytest.mark.data]

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


def played(log: Path, specs: list[StreamSpec[FrameLayout]]) -> list[DecodedBatch]:
    """The log as the replay driver reads it, piece by piece."""
    sorter = FrameDemultiplexer(specs)

    def sort(messages: list[can.Message], t_ns: NDArray[np.int64]) -> DecodedBatch:
        return sorter.sort(batch_of(messages, t_ns.tolist()), 0)

    recording = CanLog(log, sort)
    try:
        return list(iter(lambda: recording.read(LONG_NS), None))
    finally:
        recording.close()


@pytest.mark.long
@pytest.mark.parametrize("recording", first_of(*RECORDINGS))
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
        parts = [piece.frames[message.name] for piece in pieces if message.name in piece.frames]
        payloads = [payload for name, payload in written if name == frame_id]
        first, *rest = (signal.name for signal in message.signals)
        counts = np.concatenate([part.counter for part in parts])
        raw: list[Any] = [message.decode(p, decode_choices=False, scaling=False) for p in payloads]
        physical: list[Any] = [message.decode(p, decode_choices=False) for p in payloads]
        assert counts.tolist() == [row[first] for row in raw]
        if rest:
            values = np.concatenate([part.samples[:, 0] for part in parts])
            expected = np.array([[row[name] for name in rest] for row in physical], np.float64)
            np.testing.assert_allclose(values, expected, rtol=2e-7, atol=1e-12)


def test_the_imu_feels_gravity_and_nothing_else(data: Path) -> None:
    """The device lay still: what its axes feel adds up to 1 g, within the bias of a cheap sensor."""
    log_path, dbc_path, _ = RECORDINGS["gnss-imu"]
    axes = {axis: [f"Acceleration{axis.upper()}"] for axis in "xyz"}
    layout = layout_from_dbc(data / dbc_path, "gnss_imu", counter="ImuValid", counts="frames", channels=axes)
    pieces = played(data / log_path, [StreamSpec("imu", layout, 100.0)])
    felt = np.concatenate([part.samples[:, 0] for piece in pieces for part in piece.frames.values()])
    assert np.linalg.norm(felt.mean(axis=0)) == pytest.approx(9.81, abs=1.0)
    assert felt.std(axis=0).max() < 0.5


CHANNELS = {"formula-student": "can0", "gnss-imu": "can1"}
SENSORS = {
    "formula-student": 'type = "trend"\nstream = "ID_D0"\nchannel = "STEER_ANGLE"\nunit = "deg"',
    "gnss-imu": 'type = "accelerometer"\nstream = "gnss_imu"\nchannel = "AccelerationX"\nunit = "m/s2"',
}


def machine_of(
    recording: str, data: Path, messages: list[Message], rates_hz: dict[str, float]
) -> MachineFile:
    """A machine file that plays a log, a stream for every message of its DBC file."""
    log, dbc, _ = RECORDINGS[recording]
    streams = [
        f"""[streams.{message.name}]
bus = "car"
rate_hz = {rates_hz[message.name]}
layout = {{ dbc = "{data / dbc}", message = "{message.name}", no_counter = true, channels = [{
            ", ".join(f'{{ name = "{s.name}", signals = ["{s.name}"] }}' for s in message.signals)
        }] }}
"""
        for message in messages
    ]
    text = f"""schema_version = 1
site = "lab"
box = "edge-1"
[machine]
name = "{recording}"
speed_rpm = 1500.0
[buses.car]
driver = "replay"
file = "{data / log}"
channel = "{CHANNELS[recording]}"
pace = "unpaced"
{"".join(streams)}
[[sensors]]
name = "one"
{SENSORS[recording]}
"""
    return parse_machine_file(text, Path(f"/m/{recording}.toml"))


@pytest.mark.parametrize("recording", first_of(*RECORDINGS))
async def test_the_service_plays_the_log_of_a_vehicle_frame_by_frame(data: Path, recording: str) -> None:
    """Neither log has a counter: every frame is delivered, in its order, as what cantools reads of it."""
    log_path, dbc_path, frames = RECORDINGS[recording]
    database = cantools.database.can.Database()
    database.add_dbc_file(str(data / dbc_path))
    with gzip.open(data / log_path, "rt") as lines:
        words = [line.split() for line in lines]
    sent: dict[str, list[tuple[float, bytes]]] = {}
    for stamp, channel, frame in words:
        frame_id, payload = frame.split("#")
        if channel == CHANNELS[recording]:
            sent.setdefault(frame_id, []).append((float(stamp[1:-1]), bytes.fromhex(payload)))
    messages = [message for message in database.messages if f"{message.frame_id:03X}" in sent]
    t_s = {m.name: [t for t, _ in sent[f"{m.frame_id:03X}"]] for m in messages}
    rates_hz = {name: round(1.0 / float(np.median(np.diff(t))), 2) for name, t in t_s.items()}
    blocks: list[SampleBlock] = []
    [driver] = bus_drivers(machine_of(recording, data, messages, rates_hz), DrivenClock(), blocks.append)

    await driver.run()

    assert driver.link.reason == "end of file"
    assert isinstance(driver.counters, ReplayCounters)
    assert driver.counters.frames_other_channel == frames - sum(map(len, sent.values()))
    for message in messages:
        counters, _ = driver.streams[message.name]
        written = sent[f"{message.frame_id:03X}"]
        assert (counters.frames_received, counters.samples_received) == (len(written), len(written))
        assert (counters.frames_rejected, counters.frames_duplicate, counters.frames_late) == (0, 0, 0)
        mine = [block for block in blocks if block.stream == message.name]
        values = np.concatenate([block.samples for block in mine])
        physical: list[Any] = [message.decode(payload, decode_choices=False) for _, payload in written]
        expected = np.array([[row[s.name] for s in message.signals] for row in physical], np.float64)
        np.testing.assert_allclose(values, expected, rtol=2e-7, atol=1e-12)
        index = np.concatenate([np.arange(block.first_index, block.end_index) for block in mine])
        assert (np.diff(index) >= 1).all()
        assert index[-1] - index[0] + 1 == counters.samples_received + counters.samples_lost
