"""CAN FD over vcan interfaces of the kernel; a test that pulls the plug sets the interface down."""

from __future__ import annotations

from typing import TYPE_CHECKING

from conformance.socketcan_frames import RATE_HZ, SocketDevice, port_on, stamp_when_read
from conformance.transport import SimulatedTime
from conformance.virtual_can_transport import PER_FRAME
from support.bus_tables import can_bus
from support.vcan_links import VcanLink

from drivers.can.driver import CanDriver
from drivers.can.socketcan import dropped_frames, open_socketcan

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import SampleBlock
    from drivers.base import BusPort, StartPolicy
    from drivers.can.batches import FrameDemultiplexer
    from drivers.can.socketcan import SocketCan

NEEDS = "DAQSVC_HIL"
RECEIVE_BUFFER_BYTES = 256 << 10


class _Device(SocketDevice):
    """A peer on the interface; it asks the kernel what the driver's socket missed, and pulls the plug."""

    def __init__(self, link: VcanLink) -> None:
        self._frames_put = self._samples_put = 0
        self._dropped_before = 0
        self._readers: list[SocketCan] = []
        super().__init__()
        self._link = link
        self._sender = link.sender()

    def watch(self, reader: SocketCan) -> None:
        """Follow a reader until it is closed."""
        self._readers.append(reader)
        close = reader.close

        def closing() -> None:
            self._dropped_before += dropped_frames(reader._socket)
            self._readers.remove(reader)
            close()

        reader.close = closing  # type: ignore[method-assign]

    @property
    def _dropped(self) -> int:
        return self._dropped_before + sum(dropped_frames(r._socket) for r in self._readers)

    @property
    def frames_on_wire(self) -> int:
        return self._frames_put - self._dropped

    @frames_on_wire.setter
    def frames_on_wire(self, frames: int) -> None:
        assert not frames, "counted as they are put in"

    @property
    def samples_on_wire(self) -> int:
        return self._samples_put - PER_FRAME * self._dropped

    @samples_on_wire.setter
    def samples_on_wire(self, samples: int) -> None:
        assert not samples, "counted as they are put in"

    def _put(self, index: int, samples: NDArray[np.float32]) -> None:
        first = self.put(index, samples, corrupt=self._corrupting)
        second = self._duplicating and self.put(index, samples, corrupt=False)
        self._frames_put += first + second
        self._samples_put += len(samples) * (first and not self._corrupting)
        self._corrupting = self._duplicating = False

    def put_frame(self, frame: bytes) -> bool:
        try:
            self._sender.send(frame)
        except OSError:
            return False
        return bool(self._readers)

    def go_away(self) -> None:
        super().go_away()
        self._link.down()

    def come_back(self) -> None:
        super().come_back()
        self._link.up()
        self._sender.close()  # its first error is that the interface was down
        self._sender = self._link.sender()

    def stop(self) -> None:
        self._sender.close()
        self._link.close()


class Vcan:
    """See `conformance.transport.Transport`."""

    name = "SocketCAN vcan"
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

    async def start(self) -> None:
        self._link = VcanLink()
        self.device = _Device(self._link)

    async def stop(self) -> None:
        self.device.stop()

    def driver(self, deliver: Callable[[SampleBlock], None], *, start: StartPolicy = "retry") -> CanDriver:
        def open_watched(port: BusPort, sorter: FrameDemultiplexer) -> SocketCan:
            reader = open_socketcan(bus, sorter.matches, port.clock)
            stamp_when_read(reader)
            self.device.watch(reader)
            return reader

        size = {"receive_buffer_bytes": RECEIVE_BUFFER_BYTES}
        bus = can_bus(interface="socketcan", channel=self._link.name, fd=True, **size)
        return CanDriver(bus, port_on(self.time, deliver, start), open_source=open_watched)


TRANSPORTS = {Vcan.name: Vcan}
