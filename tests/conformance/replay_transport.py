"""A candump log that somebody is writing, followed by the replay driver."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
from conformance.faulty_device import FaultyDevice
from conformance.transport import STREAM, SimulatedTime
from conformance.virtual_can_transport import PER_FRAME, layout
from support.bus_tables import replay_bus

from drivers.base import BusPort, StreamSpec
from drivers.replay.driver import POLL_NS, ReplayDriver

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conformance.transport import Ability
    from numpy.typing import NDArray

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.samples import SampleBlock
    from drivers.base import StartPolicy
    from drivers.frames import FrameLayout


LOOK_NS = POLL_NS // 10


class LogDevice(FaultyDevice):
    """Logs frames as ``candump -L`` does; its file is taken away and a new one begun."""

    def __init__(self, path: Path, clock: Clock, frames: FrameLayout) -> None:
        super().__init__(frames.samples_per_frame)
        self._path = path
        self._clock = clock
        self._layout = frames
        self._old = (path.with_name(f"rotated-{k}.log") for k in itertools.count())
        path.touch()

    def put(self, first_index: int, samples: NDArray[np.float32], *, corrupt: bool) -> bool:
        data = bytearray(self._layout.encode(np.array([first_index], np.int64), samples[None])[0].tobytes())
        if corrupt:
            data[20] ^= 0x10
        microseconds = self._clock.monotonic_ns() // 1000
        stamp = f"({microseconds // 1_000_000}.{microseconds % 1_000_000:06d})"
        with self._path.open("a") as file:
            file.write(f"{stamp} can0 101##1{data.hex().upper()}\n")
        return True

    def go_away(self) -> None:
        super().go_away()
        # Kept, as a log rotation does: a file that takes the inode of one that is deleted is no new file.
        self._path.rename(next(self._old))

    def come_back(self) -> None:
        super().come_back()
        self._path.touch()

    def begin_a_file(self) -> None:
        if self.present and self._path.stat().st_size:
            self.go_away()
            self.come_back()


class GrowingLog:
    """See `conformance.transport.Transport`."""

    name = "file replay"
    rate_hz = 1000.0
    samples_per_frame = PER_FRAME
    counter_modulus = 2**32
    jitter_ns = 2000
    latency_ns = POLL_NS + 2 * LOOK_NS
    poll_ns = LOOK_NS
    overflow_frames = 1
    cannot: dict[Ability, str] = {"overflow": "a file keeps what is written to it until it is read"}  # noqa: RUF012

    def __init__(self, folder: Path) -> None:
        self._path = folder / "can0.log"
        self.time = SimulatedTime()

    async def start(self) -> None:
        self.device = LogDevice(self._path, self.time.clock, layout())

    async def stop(self) -> None:
        pass

    def driver(self, deliver: Callable[[SampleBlock], None], *, start: StartPolicy = "retry") -> ReplayDriver:
        # A new reader would read the file from its beginning.
        self.device.begin_a_file()
        bus = replay_bus(file=self._path, at_end="wait")
        spec = StreamSpec(STREAM, layout(), self.rate_hz, 30_000_000)
        return ReplayDriver(bus, BusPort("replay", [spec], self.time.clock, deliver, start))


TRANSPORTS = {GrowingLog.name: GrowingLog}
