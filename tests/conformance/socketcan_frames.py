"""What the two SocketCAN transports share: the device, but for how a frame is put on the wire."""

from __future__ import annotations

import socket
from abc import abstractmethod
from typing import TYPE_CHECKING

import numpy as np
from conformance.faulty_device import FaultyDevice
from conformance.transport import STREAM
from conformance.virtual_can_transport import PER_FRAME, layout
from support.can_standin import frame_bytes

from drivers.base import BusPort, StreamSpec
from drivers.can.socketcan import SO_TIMESTAMPNS

if TYPE_CHECKING:
    from collections.abc import Callable

    from conformance.transport import Time
    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import SampleBlock
    from drivers.base import StartPolicy
    from drivers.can.socketcan import SocketCan

RATE_HZ = 1000.0


class SocketDevice(FaultyDevice):
    """Makes ``struct canfd_frame`` of samples."""

    def __init__(self) -> None:
        super().__init__(PER_FRAME)
        self._layout = layout()

    @abstractmethod
    def put_frame(self, frame: bytes) -> bool:
        """Put a frame on the wire; tells whether the wire has taken it. Made by the transport."""

    def put(self, first_index: int, samples: NDArray[np.float32], *, corrupt: bool) -> bool:
        data = bytearray(self._layout.encode(np.array([first_index], np.int64), samples[None])[0].tobytes())
        if corrupt:
            data[20] ^= 0x10
        return self.put_frame(frame_bytes(self._layout.frame_id, bytes(data)))


def stamp_when_read(reader: SocketCan) -> None:
    """Arrivals by the test's clock: the kernel's own stamps know nothing of simulated time."""
    reader._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 0)


def port_on(time: Time, deliver: Callable[[SampleBlock], None], start: StartPolicy) -> BusPort:
    """What the driver under test is given beside its table."""
    spec = StreamSpec(STREAM, layout(), RATE_HZ, 30_000_000)
    return BusPort("can0", [spec], time.clock, deliver, start)
