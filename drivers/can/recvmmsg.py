"""Many datagrams by one system call, into NumPy memory.

A raw CAN socket gives one frame per ``recv(2)``, and a Python call per frame is what a busy bus cannot
afford. ``recvmmsg(2)`` fills a whole array of frames at once; the time stamps and the count of dropped
frames that the kernel sends along lie in arrays beside it and are read without a loop.

The memory layout is that of 64-bit Linux (``struct mmsghdr``, ``struct cmsghdr``).
"""

from __future__ import annotations

import ctypes
import errno
import os
import sys
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

SO_TIMESTAMPNS = 35
SO_TIMESTAMPING = 37
SO_RXQ_OVFL = 40
SOL_SOCKET = 1
"""Linux numbers them so (asm-generic/socket.h); a control message has the option's number as its type."""

_MSG_DONTWAIT = 0x40
_MOST_PER_CALL = 1024
"""``UIO_MAXIOV`` (linux/uio.h)."""
_CONTROL_BYTES = 128
_NS_PER_S = 1_000_000_000

# A control message is a header of 16 bytes and its value, padded to 8.
_AFTER_STAMP = 16 + 16
_AFTER_HARDWARE_STAMP = _AFTER_STAMP + 16 + 48


# struct iovec, and struct mmsghdr with the struct msghdr that it begins with, on 64-bit Linux.
_IOVEC = np.dtype([("base", np.uint64), ("length", np.uint64)])
_MMSGHDR = np.dtype(
    {
        "names": ["iov", "iov_length", "control", "control_length", "size"],
        "formats": [np.uint64, np.uint64, np.uint64, np.uint64, np.uint32],
        "offsets": [16, 24, 32, 40, 56],
        "itemsize": 64,
    }
)


class Stamps(NamedTuple):
    """What the kernel says about received datagrams.

    Attributes:
        software_ns: int64 ``[n]``, when the kernel took each in, on CLOCK_REALTIME; 0 where it does not say.
        hardware_ns: int64 ``[n]``, when the controller took each in, on a clock of its own; 0 where it does
            not say.
        dropped: how many datagrams the kernel had dropped on this socket before the last one, modulo 2^32;
            None if it does not say, which means none as long as it never said.
    """

    software_ns: NDArray[np.int64]
    hardware_ns: NDArray[np.int64]
    dropped: int | None


class DatagramBuffer:
    """Room for datagrams, filled by one system call for every 1024 of them.

    Args:
        count: most datagrams at a time.
        size: bytes of room for each.
    """

    def __init__(self, count: int, size: int) -> None:
        self.datagrams = np.zeros((count, size), np.uint8)
        self._control = np.zeros((count, _CONTROL_BYTES), np.uint8)
        rows = np.arange(count, dtype=np.uint64)
        self._iovecs = np.zeros(count, _IOVEC)
        self._iovecs["base"] = self.datagrams.ctypes.data + rows * np.uint64(size)
        self._iovecs["length"] = size
        self._headers = np.zeros(count, _MMSGHDR)
        self._headers["iov"] = self._iovecs.ctypes.data + rows * np.uint64(_IOVEC.itemsize)
        self._headers["iov_length"] = 1
        self._headers["control"] = self._control.ctypes.data + rows * np.uint64(_CONTROL_BYTES)
        self._headers["control_length"] = _CONTROL_BYTES
        self._address = self._headers.ctypes.data
        self._sizes: NDArray[np.uint32] = self._headers["size"]
        self._control_lengths: NDArray[np.uint64] = self._headers["control_length"]
        self._count = count
        self._used = 0
        # Not the exception: with its traceback it would hold this buffer until the next garbage collection.
        self._failed_with = 0
        self._recvmmsg = _recvmmsg()

    @property
    def sizes(self) -> NDArray[np.uint32]:
        """uint32 ``[n]``, bytes of each datagram that the last `receive` took."""
        return self._sizes[: self._used]

    def receive(self, descriptor: int) -> int:
        """Take what a socket holds, as far as there is room, without waiting.

        Args:
            descriptor: the socket's file descriptor.

        Returns:
            How many datagrams were taken.

        Raises:
            OSError: what the socket reports; whatever came before it has been handed over.
        """
        if self._failed_with:
            code, self._failed_with = self._failed_with, 0
            raise OSError(code, os.strerror(code))
        self._control_lengths[: self._used] = _CONTROL_BYTES  # the kernel overwrites what it used
        self._used = 0
        while self._used < self._count:
            room = min(self._count - self._used, _MOST_PER_CALL)
            at = self._address + self._used * _MMSGHDR.itemsize
            taken: int = self._recvmmsg(descriptor, at, room, _MSG_DONTWAIT, None)
            if taken >= 0:
                self._used += taken
                if taken < room:
                    break
                continue
            code = ctypes.get_errno()
            if code in {errno.EAGAIN, errno.EWOULDBLOCK}:
                break
            if code != errno.EINTR:
                if not self._used:
                    raise OSError(code, os.strerror(code))
                self._failed_with = code
                break
        return self._used

    def stamps(self) -> Stamps:
        """What the kernel said about the datagrams of the last `receive`.

        The socket may ask for ``SO_TIMESTAMPNS``, with that ``SO_TIMESTAMPING`` for hardware stamps only, and
        ``SO_RXQ_OVFL``; they come in this order (``__sock_recv_timestamp``, ``sock_recv_drops``).
        """
        lengths = self._control_lengths[: self._used]
        stamped = self._is(0, SO_TIMESTAMPNS, lengths)
        software = np.where(stamped, self._time(16), 0)
        hardware = np.zeros(self._used, np.int64)
        longest = int(lengths.max(initial=0))
        if longest >= _AFTER_HARDWARE_STAMP:
            hardware_stamped = self._is(_AFTER_STAMP, SO_TIMESTAMPING, lengths) & stamped
            # Three times: by software, a retired one, and as the hardware gave it.
            hardware = np.where(hardware_stamped, self._time(_AFTER_STAMP + 16 + 32), 0)
        dropped: int | None = None
        for offset in (0, _AFTER_STAMP, _AFTER_HARDWARE_STAMP):
            if longest < offset + 20:
                break
            # The figure grows from datagram to datagram: the last one that carries it says it all.
            telling = np.flatnonzero(self._is(offset, SO_RXQ_OVFL, lengths))
            if len(telling):
                value = int(self._control[telling[-1], offset + 16 : offset + 20].view(np.uint32)[0])
                dropped = value if dropped is None else max(value, dropped)
        return Stamps(software, hardware, dropped)

    def _is(self, offset: int, kind: int, lengths: NDArray[np.uint64]) -> NDArray[np.bool_]:
        """Where a control message of this kind lies at this place."""
        header = self._control[: self._used, offset + 8 : offset + 16].view(np.int32)
        matches: NDArray[np.bool_] = (
            (lengths >= offset + 20) & (header[:, 0] == SOL_SOCKET) & (header[:, 1] == kind)
        )
        return matches

    def _time(self, offset: int) -> NDArray[np.int64]:
        """The ``struct timespec`` at this place, in ns."""
        pair = self._control[: self._used, offset : offset + 16].view(np.int64)
        ns: NDArray[np.int64] = pair[:, 0] * _NS_PER_S + pair[:, 1]
        return ns


def _recvmmsg() -> ctypes._NamedFuncPointer:
    """The C library's ``recvmmsg``; it lets other threads run while it works.

    Raises:
        OSError: this is no 64-bit Linux.
    """
    if not sys.platform.startswith("linux") or ctypes.sizeof(ctypes.c_void_p) != 8:
        raise OSError(errno.ENOSYS, "CAN frames can be read in batches on 64-bit Linux only")
    call = ctypes.CDLL(None, use_errno=True).recvmmsg
    call.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p)
    call.restype = ctypes.c_int
    return call
