"""The worked example of the documentation, a third party's driver, on a TCP connection of this machine."""

from __future__ import annotations

import fcntl
import importlib.util
import socket
import struct
import sys
import termios
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from conformance.faulty_device import FaultyDevice
from conformance.transport import STREAM, SimulatedTime
from conformance.virtual_can_transport import PER_FRAME, layout

from drivers.base import BusPort, Driver, StreamSpec

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import ModuleType

    from conformance.transport import Ability
    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import SampleBlock
    from drivers.base import StartPolicy
    from drivers.frames import FrameLayout

EXAMPLE = Path(__file__).parents[2] / "docs" / "example_driver" / "tcp_frames.py"
SEND_BUFFER = 65_536
MOST_QUEUED = 8192


def example() -> ModuleType:
    """The example's module, as it would be imported once it is installed."""
    if "tcp_frames" not in sys.modules:
        spec = importlib.util.spec_from_file_location("tcp_frames", EXAMPLE)
        assert spec is not None
        assert spec.loader is not None
        sys.modules["tcp_frames"] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules["tcp_frames"])
    return sys.modules["tcp_frames"]


class LoggerDevice(FaultyDevice):
    """A logger that serves one client, and drops what that client does not take."""

    def __init__(self, frames: FrameLayout) -> None:
        super().__init__(frames.samples_per_frame)
        self._layout = frames
        self._client: socket.socket | None = None
        self.tcp_port = 0
        self._listen()

    def _listen(self) -> None:
        self._server = socket.create_server(("127.0.0.1", self.tcp_port))
        self._server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SEND_BUFFER)
        self._server.setblocking(False)
        self.tcp_port = self._server.getsockname()[1]

    def _accept(self) -> None:
        """Serve whoever has come last."""
        while True:
            try:
                client, _ = self._server.accept()
            except BlockingIOError:
                return
            self._let_go()
            client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            client.setblocking(False)
            self._client = client

    def _let_go(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def put(self, first_index: int, samples: NDArray[np.float32], *, corrupt: bool) -> bool:
        self._accept()
        if self._client is None:
            return False
        data = bytearray(self._layout.encode(np.array([first_index], np.int64), samples[None])[0].tobytes())
        if corrupt:
            data[20] ^= 0x10
        try:
            queued = struct.unpack("i", fcntl.ioctl(self._client, termios.TIOCOUTQ, bytes(4)))[0]
            if queued > MOST_QUEUED:
                return False
            # With so much room in its buffer the kernel takes a frame whole.
            assert self._client.send(data) == len(data)
        except OSError:
            self._let_go()
            return False
        return True

    def go_away(self) -> None:
        super().go_away()
        self._accept()
        self._let_go()
        self._server.close()

    def come_back(self) -> None:
        super().come_back()
        self._listen()

    def close(self) -> None:
        self._let_go()
        self._server.close()


class ExampleLogger:
    """See `conformance.transport.Transport`."""

    name = "example of the docs"
    rate_hz = 1000.0
    samples_per_frame = PER_FRAME
    counter_modulus = 2**32
    jitter_ns = 1000
    latency_ns = 0
    poll_ns = 0
    overflow_frames = 100_000
    cannot: dict[Ability, str] = {}  # noqa: RUF012

    def __init__(self, _folder: Path) -> None:
        self.time = SimulatedTime()

    async def start(self) -> None:
        self.device = LoggerDevice(layout())

    async def stop(self) -> None:
        self.device.close()

    def driver(self, deliver: Callable[[SampleBlock], None], *, start: StartPolicy = "retry") -> Driver:
        module = example()
        bus = module.LoggerBus(driver="tcp-frames", host="127.0.0.1", tcp_port=self.device.tcp_port)
        spec = StreamSpec(STREAM, layout(), self.rate_hz, 30_000_000)
        port = BusPort("logger", [spec], self.time.clock, deliver, start)
        made: Driver = module.LoggerPlugin().build(bus, port)
        return made


TRANSPORTS = {ExampleLogger.name: ExampleLogger}
