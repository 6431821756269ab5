"""CAN buses that are none.

`StandInBus` has the kernel's bytes and system calls over a pair of Unix sockets; `FaultyBus` is a python-can
interface whose failures are up to the test: ``interface = "faulty"``.
"""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
from typing import TYPE_CHECKING, Any

import can

from drivers.can.batches import EXTENDED
from drivers.can.socketcan import CLASSIC_BYTES, FD_BYTES, SocketCan

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from drivers.base import BusPort
    from drivers.can.batches import FrameDemultiplexer


def frame_bytes(
    frame_id: int, payload: bytes, *, extended: bool = False, fd: bool | None = None, flags: int = 0
) -> bytes:
    """A ``struct can_frame`` or ``canfd_frame``, packed by hand."""
    size = FD_BYTES if (len(payload) > 8 if fd is None else fd) else CLASSIC_BYTES
    word = frame_id | flags | (EXTENDED if extended else 0)
    return (word.to_bytes(4, "little") + bytes([len(payload), 0, 0, 0]) + payload).ljust(size, b"\0")


def frames_bytes(frame_id: int, payloads: NDArray[np.uint8], *, extended: bool = False) -> list[bytes]:
    """`frame_bytes` of many payloads ``[n, length]``."""
    return [frame_bytes(frame_id, row.tobytes(), extended=extended) for row in payloads]


class StandInBus:
    """The wire: whoever opens it gets one end, tests send at the other."""

    def __init__(self, kind: int = socket.SOCK_SEQPACKET) -> None:
        self.kind = kind
        self.present = True
        self.opened = 0
        self._ours: socket.socket | None = None
        self._lock = threading.Lock()

    def open(self, port: BusPort, sorter: FrameDemultiplexer) -> SocketCan:
        """For ``CanDriver(port, open_source=bus.open)``."""
        with self._lock:
            if not self.present:
                raise OSError(19, "No such device")
            ours, theirs = socket.socketpair(socket.AF_UNIX, self.kind)
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
            ours.setblocking(False)
            if self._ours is not None:
                self._ours.close()
            self._ours = ours
            self.opened += 1
        try:
            return SocketCan(theirs, port.clock)
        except BaseException:
            theirs.close()
            raise

    def send(self, frames: Sequence[bytes]) -> int:
        """Put frames on the wire; returns how many it took."""
        with self._lock:
            if self._ours is None:
                return 0
            for k, frame in enumerate(frames):
                try:
                    self._ours.send(frame)
                except OSError:
                    return k
            return len(frames)

    def unplug(self) -> None:
        with self._lock:
            self.present = False
            if self._ours is not None:
                self._ours.close()
                self._ours = None

    def plug_in(self) -> None:
        with self._lock:
            self.present = True

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self.unplug()


class FaultyBus(can.BusABC):
    """Receives what a test puts into `FaultyBus.inbox`; an exception in there is raised by `recv`."""

    inbox: queue.Queue[can.Message | BaseException]
    open_errors: list[BaseException]
    opened = 0
    closed = 0
    dead = False

    @classmethod
    def renew(cls) -> None:
        cls.inbox = queue.Queue()
        cls.open_errors = []
        cls.opened = cls.closed = 0
        cls.dead = False

    def __init__(self, channel: Any = None, **options: Any) -> None:
        if self.open_errors:
            raise self.open_errors.pop(0)
        super().__init__(channel=channel)
        type(self).opened += 1
        self.channel_info = "faulty"
        self._can_protocol = can.CanProtocol.CAN_FD

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            item = self.inbox.get(timeout=timeout) if timeout else self.inbox.get_nowait()
        except queue.Empty:
            return None, False
        if isinstance(item, BaseException):
            raise item
        return item, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError

    @property  # type: ignore[misc]  # nobody sets it
    def state(self) -> can.BusState:
        return can.BusState.ERROR if self.dead else can.BusState.ACTIVE

    def shutdown(self) -> None:
        type(self).closed += 1
        super().shutdown()


can.interfaces.BACKENDS["faulty"] = ("support.can_standin", "FaultyBus")
# python-can froze the names when it was imported.
can.util.VALID_INTERFACES = frozenset(can.interfaces.BACKENDS)  # type: ignore[attr-defined]
