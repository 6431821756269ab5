"""The SocketCAN reader where the kernel has no CAN: the same bytes and system calls over Unix sockets."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from conformance.socketcan_frames import RATE_HZ, SocketDevice, port_on, stamp_when_read
from conformance.transport import SimulatedTime
from conformance.virtual_can_transport import PER_FRAME
from support.bus_tables import can_bus
from support.can_standin import StandInBus

from drivers.can.driver import CanDriver

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from daqsvc.acquisition.samples import SampleBlock
    from drivers.base import BusPort, StartPolicy
    from drivers.can.batches import FrameDemultiplexer
    from drivers.can.socketcan import SocketCan


class _Device(SocketDevice):
    def __init__(self, bus: StandInBus) -> None:
        super().__init__()
        self._bus = bus

    def put_frame(self, frame: bytes) -> bool:
        return self._bus.send([frame]) == 1

    def go_away(self) -> None:
        super().go_away()
        self._bus.unplug()

    def come_back(self) -> None:
        super().come_back()
        self._bus.plug_in()


class StandInSocketCan:
    """See `conformance.transport.Transport`."""

    name = "SocketCAN stand-in"
    rate_hz = RATE_HZ
    samples_per_frame = PER_FRAME
    counter_modulus = 2**32
    jitter_ns = 1000
    latency_ns = 0
    poll_ns = 0
    overflow_frames = 80_000
    cannot = {}  # noqa: RUF012

    def __init__(self, _folder: Path) -> None:
        self.time = SimulatedTime()
        self._bus = StandInBus()

    async def start(self) -> None:
        self.device = _Device(self._bus)

    async def stop(self) -> None:
        self._bus.unplug()

    def driver(self, deliver: Callable[[SampleBlock], None], *, start: StartPolicy = "retry") -> CanDriver:
        def open_end(port: BusPort, sorter: FrameDemultiplexer) -> SocketCan:
            reader = self._bus.open(port, sorter)
            stamp_when_read(reader)
            return reader

        bus = can_bus(interface="socketcan", channel="stand-in", fd=True, record=self.record())
        return CanDriver(bus, port_on(self.time, deliver, start), open_source=open_end)

    def record(self) -> dict[str, Any] | None:
        return None


class RecordedStandInSocketCan(StandInSocketCan):
    """The same while it is recorded, which nobody above the driver may notice."""

    name = "recorded SocketCAN stand-in"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._folder = folder

    def record(self) -> dict[str, Any]:
        return {"folder": self._folder, "format": "candump", "file_mb": 1, "keep_mb": 2}


TRANSPORTS = {made.name: made for made in (StandInSocketCan, RecordedStandInSocketCan)}
