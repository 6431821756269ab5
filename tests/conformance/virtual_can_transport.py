"""CAN FD over python-can's virtual bus, with a plug that a test can pull."""

from __future__ import annotations

import itertools
from collections import Counter
from typing import TYPE_CHECKING, Any, ClassVar

import can
import numpy as np
from can.interfaces.virtual import VirtualBus
from conformance.faulty_device import FaultyDevice
from conformance.transport import CHANNELS, STREAM, SimulatedTime
from support.bus_tables import can_bus

from drivers.base import BusPort, StreamSpec
from drivers.can.driver import CanDriver
from drivers.frames import FrameLayout

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import SampleBlock
    from drivers.base import StartPolicy

PER_FRAME = 10
RECEIVE_QUEUE = 1024
_serial = itertools.count()


class PluggedBus(VirtualBus):
    """python-can's virtual bus, as interface ``"plugged"``: lost once its channel has been unplugged."""

    # Shared by all buses, like the cables of a rack.
    unplugged: ClassVar[set[Any]] = set()
    pulls: ClassVar[Counter[Any]] = Counter()

    @classmethod
    def unplug(cls, channel: Any) -> None:
        cls.unplugged.add(channel)
        cls.pulls[channel] += 1

    @classmethod
    def plug_in(cls, channel: Any) -> None:
        cls.unplugged.discard(channel)

    def __init__(self, channel: Any = None, **options: Any) -> None:
        if channel in self.unplugged:
            raise can.CanInitializationError(f"{channel} is unplugged")
        super().__init__(channel, **options)
        self._pulls = self.pulls[channel]

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        # A cable that is back, however soon, does not bring an open interface back.
        if self.pulls[self.channel_id] != self._pulls:
            raise can.CanOperationError("Network is down", 100)
        return super()._recv_internal(min(timeout, 0.002) if timeout else timeout)


can.interfaces.BACKENDS["plugged"] = ("conformance.virtual_can_transport", "PluggedBus")
# python-can froze the names when it was imported.
can.util.VALID_INTERFACES = frozenset(can.interfaces.BACKENDS)


def layout() -> FrameLayout:
    return FrameLayout.plain(
        frame_id=0x101,
        length=48,
        channels=[(name, 16, "signed", 1.0, 0.0) for name in CHANNELS],
        samples_per_frame=PER_FRAME,
        counter_byte=0,
        counter_bits=32,
        first_byte=4,
        crc_byte=46,
    )


class CanDevice(FaultyDevice):
    """Sends frames of a layout on a channel of the virtual bus.

    Args:
        channel: of the bus.
        frames: how it lays them out, with a CRC.
    """

    def __init__(self, channel: str, frames: FrameLayout) -> None:
        super().__init__(frames.samples_per_frame)
        self._layout = frames
        self._channel = channel
        self.bus = can.Bus(interface="virtual", channel=channel, protocol=can.CanProtocol.CAN_FD)

    def put(self, first_index: int, samples: NDArray[np.float32], *, corrupt: bool) -> bool:
        data = bytearray(self._layout.encode(np.array([first_index], np.int64), samples[None])[0].tobytes())
        if corrupt:
            data[20] ^= 0x10
        message = can.Message(arbitration_id=0x101, is_extended_id=False, is_fd=True, data=data)
        try:
            self.bus.send(message, timeout=0)
        except can.CanOperationError:  # the receive queue of the interface is full
            return False
        return len(self.bus.channel) > 1

    def go_away(self) -> None:
        super().go_away()
        PluggedBus.unplug(self._channel)

    def come_back(self) -> None:
        super().come_back()
        PluggedBus.plug_in(self._channel)

    def close(self) -> None:
        self.come_back()
        self.bus.shutdown()


class VirtualCan:
    """See `conformance.transport.Transport`."""

    name = "virtual CAN"
    rate_hz = 1000.0
    samples_per_frame = PER_FRAME
    counter_modulus = 2**32
    jitter_ns = 1000
    latency_ns = 0
    poll_ns = 0
    overflow_frames = 80_000
    cannot = {}  # noqa: RUF012

    def __init__(self, _folder: Path) -> None:
        self.channel = f"conformance-{next(_serial)}"
        self.time = SimulatedTime()

    async def start(self) -> None:
        self.device = CanDevice(self.channel, layout())

    async def stop(self) -> None:
        self.device.close()

    def driver(self, deliver: Callable[[SampleBlock], None], *, start: StartPolicy = "retry") -> CanDriver:
        bus = can_bus(
            interface="plugged",
            channel=self.channel,
            fd=True,
            options={"rx_queue_size": RECEIVE_QUEUE, "protocol": can.CanProtocol.CAN_FD},
        )
        spec = StreamSpec(STREAM, layout(), self.rate_hz, 30_000_000)
        return CanDriver(bus, BusPort("can0", [spec], self.time.clock, deliver, start))


TRANSPORTS = {VirtualCan.name: VirtualCan}
