"""Traffic of every kind on a CAN bus, recorded by the driver and read again."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import can
import numpy as np
from support.bus_tables import can_bus, replay_bus
from support.can_standin import frame_bytes
from support.paths import ROOT

from daqsvc.acquisition.clock import DrivenClock, SystemClock
from drivers.base import BusPort, StreamSpec
from drivers.can.batches import ERROR, REMOTE, CanBatch
from drivers.can.dbc import layout_from_dbc
from drivers.can.driver import CanDriver
from drivers.frames import FrameLayout
from drivers.replay.driver import ReplayDriver

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from support.can_standin import StandInBus

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.samples import SampleBlock
    from drivers.can.record_files import Logs

DBC = ROOT / "config" / "devices" / "triaxial-accelerometer.dbc"
ENDINGS = {"blf": ".blf", "asc": ".asc", "candump": ".log"}


def _plain(frame_id: int, length: int, *, extended: bool = False) -> FrameLayout:
    return FrameLayout.plain(
        frame_id=frame_id,
        extended=extended,
        length=length,
        channels=[("x", 16, "signed", 0.5, 0.0)],
        samples_per_frame=(length - 2) // 2,
        counter_byte=0,
        counter_bits=16,
        first_byte=2,
    )


STREAMS = [
    StreamSpec("classic", _plain(0x101, 8), 3000.0),
    StreamSpec("extended", _plain(0x18FF_F102, 8, extended=True), 3000.0),
    StreamSpec("fd", _plain(0x103, 64), 31_000.0),
    StreamSpec(
        "dbc",
        layout_from_dbc(
            DBC,
            "Acceleration",
            counter="Sequence",
            counts="frames",
            channels={axis: [f"Accel{axis.upper()}"] for axis in "xyz"},
        ),
        1000.0,
    ),
]
"""One in classic frames, one in frames with 29-bit ids, one in CAN FD frames, one laid out in a DBC file."""


def traffic(turns: int, seed: int = 5) -> list[bytes]:
    """Frames of all streams in turn; between them strange ones, remote frames and error frames."""
    rng = np.random.default_rng(seed)
    sent: list[bytes] = []
    for turn in range(turns):
        for spec in STREAMS:
            layout = spec.layout
            per_frame = layout.samples_per_frame
            values = rng.integers(-16_000, 16_000, (1, per_frame, len(layout.channels)))
            scale = 0.0005 if spec.name == "dbc" else 0.5
            count = turn if spec.name == "dbc" else turn * per_frame
            payload = layout.encode(np.array([count]), (values * scale).astype(np.float32))[0].tobytes()
            sent.append(frame_bytes(layout.frame_id, payload, extended=layout.extended))
        if turn % 5 == 1:
            sent += [
                frame_bytes(0x7FF, rng.bytes(turn % 9)),
                frame_bytes(0x12, rng.bytes(8), extended=True),
                frame_bytes(0x101, b"", flags=REMOTE),
                frame_bytes(0x103, b"short"),
                frame_bytes(ERROR | 0x004, b"\0\x40\0\0\0\0\0\0"),
                frame_bytes(ERROR | 0x088, bytes(range(8))),
            ]
    return sent


def books(driver: CanDriver | ReplayDriver) -> dict[str, Any]:
    """What came over a bus, frame by frame and sample by sample."""
    counters = driver.counters
    return {
        **{f"frames_{kind}": getattr(counters, f"frames_{kind}") for kind in ("unknown", "remote", "error")},
        "unknown_ids": counters.unknown_ids,
        **{
            name: (
                stream.frames_received,
                stream.samples_received,
                stream.samples_lost,
                stream.frames_wrong_length,
                stream.frames_duplicate,
            )
            for name, (stream, _) in driver.streams.items()
        },
    }


def samples(blocks: list[SampleBlock]) -> dict[str, list[list[float]]]:
    """All samples of each stream."""
    names = {block.stream for block in blocks}
    return {n: np.concatenate([b.samples for b in blocks if b.stream == n]).tolist() for n in names}


def recorded_driver(
    bus: StandInBus,
    record: Mapping[str, Any] | None,
    blocks: list[SampleBlock] | None = None,
    clock: Clock | None = None,
    logs: Logs | None = None,
) -> CanDriver:
    """A driver on a stand-in bus whose frames are recorded."""
    bus_table = can_bus(interface="socketcan", channel="can7", fd=True, record=record)
    deliver = (lambda _: None) if blocks is None else blocks.append
    port = BusPort("can0", STREAMS, clock or SystemClock(), deliver)
    return CanDriver(bus_table, port, open_source=bus.open, logs=logs)


def only_file(folder: Path) -> Path:
    [path] = folder.iterdir()
    return path


async def replayed(path: Path) -> tuple[ReplayDriver, list[SampleBlock]]:
    """A recording played as fast as it goes, to its end."""
    blocks: list[SampleBlock] = []
    bus = replay_bus(file=path, at_end="stop", pace="unpaced")
    driver = ReplayDriver(bus, BusPort("can0", STREAMS, DrivenClock(), blocks.append))
    async with asyncio.timeout(20):
        await driver.run()
    return driver, blocks


def batch(first: int, frames: int, t_ns: int = 1_000_000_000) -> CanBatch:
    """Frames that carry their number, a microsecond apart."""
    number = first + np.arange(frames)
    data = np.zeros((frames, 64), np.uint8)
    data[:, :8] = number.astype("<u8")[:, None].view(np.uint8)
    return CanBatch(
        np.full(frames, 0x101, np.uint32), np.full(frames, 8, np.int64), data, t_ns + 1000 * number
    )


def numbers(*paths: Path) -> list[int]:
    """The numbers in recordings of such frames, read by python-can alone."""
    found: list[int] = []
    for path in paths:
        with can.LogReader(path) as log:
            found += [int.from_bytes(message.data, "little") for message in log]
    return found
