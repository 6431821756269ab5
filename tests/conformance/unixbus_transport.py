"""CAN FD over the virtual bus between processes; a test that pulls the plug ends the bus's hub."""

from __future__ import annotations

import itertools
import time
from typing import TYPE_CHECKING

import can
import numpy as np
from conformance.faulty_device import FaultyDevice
from conformance.transport import STREAM, SimulatedTime
from conformance.virtual_can_transport import PER_FRAME, layout
from support.bus_tables import can_bus

from drivers.base import BusPort, StreamSpec
from drivers.can.driver import CanDriver
from sim_hw.bus_socket import UnixBus
from sim_hw.bus_socket_hub import Hub

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import SampleBlock
    from drivers.base import StartPolicy

QUEUE_FRAMES = 1024
_serial = itertools.count()


class _Device(FaultyDevice):
    """A node, with the bus's hub in its hands: what has reached the wire, the hub knows."""

    def __init__(self, path: str) -> None:
        self._gone = self._unusable = 0
        super().__init__(PER_FRAME)
        self._layout = layout()
        self._path = path
        self.plug_in()

    @property
    def frames_on_wire(self) -> int:
        return self._gone + self._delivered()

    @frames_on_wire.setter
    def frames_on_wire(self, frames: int) -> None:
        assert not frames, "the hub counts"

    @property
    def samples_on_wire(self) -> int:
        return PER_FRAME * (self.frames_on_wire - self._unusable)

    @samples_on_wire.setter
    def samples_on_wire(self, samples: int) -> None:
        assert not samples, "the hub counts"

    def _delivered(self) -> int:
        """Frames that went to the driver since the bus was plugged in."""
        if self._hub is None:
            return 0
        while self._hub.counters.frames < self._put_in:
            time.sleep(0.0001)
        return self._hub.counters.delivered

    def plug_in(self) -> None:
        self._put_in = 0
        self._hub: Hub | None = Hub(self._path, queue_frames=QUEUE_FRAMES)
        self._hub.start()
        self._bus = UnixBus(self._path, fd=True, hub="join")

    def unplug(self) -> None:
        if self._hub is not None:
            self._gone += self._delivered()
            self._bus.shutdown()
            self._hub.stop()
            self._hub = None

    def _put(self, index: int, samples: NDArray[np.float32]) -> None:
        copies = 2 if self._duplicating else 1
        for copy in range(copies):
            self.put(index, samples, corrupt=self._corrupting and not copy)
        self._unusable += self._corrupting + copies - 1
        self._corrupting = self._duplicating = False

    def put(self, first_index: int, samples: NDArray[np.float32], *, corrupt: bool) -> bool:
        data = bytearray(self._layout.encode(np.array([first_index], np.int64), samples[None])[0].tobytes())
        if corrupt:
            data[20] ^= 0x10
        self._bus.send(can.Message(arbitration_id=0x101, is_extended_id=False, is_fd=True, data=data))
        self._put_in += 1
        return True

    def go_away(self) -> None:
        super().go_away()
        self.unplug()

    def come_back(self) -> None:
        super().come_back()
        if self._hub is None:
            self.plug_in()


class UnixSocketCan:
    """See `conformance.transport.Transport`."""

    name = "unixbus"
    rate_hz = 1000.0
    samples_per_frame = PER_FRAME
    counter_modulus = 2**32
    jitter_ns = 1000
    latency_ns = 0
    poll_ns = 0
    overflow_frames = 80_000
    cannot = {}  # noqa: RUF012

    def __init__(self, folder: Path) -> None:
        self._path = str(folder / f"can{next(_serial)}")
        self.time = SimulatedTime()

    async def start(self) -> None:
        self.device = _Device(self._path)

    async def stop(self) -> None:
        self.device.unplug()

    def driver(self, deliver: Callable[[SampleBlock], None], *, start: StartPolicy = "retry") -> CanDriver:
        bus = can_bus(interface="unixbus", channel=self._path, fd=True, options={"hub": "join"})
        spec = StreamSpec(STREAM, layout(), self.rate_hz, 30_000_000)
        return CanDriver(bus, BusPort("can0", [spec], self.time.clock, deliver, start))


TRANSPORTS = {UnixSocketCan.name: UnixSocketCan}
