"""SocketCAN read in batches: kernel time stamps, kernel filters, every dropped frame counted.

python-can takes one frame per call, gives the receive buffer no size and cannot count what the kernel
drops (python-can#474, #1881), so on Linux the raw socket is read here. Options of the bus, beside those
of every CAN bus:

- ``receive_buffer_bytes``: how much the kernel holds while frames are not read. It allows itself twice that,
  and a frame takes some 768 bytes of it.
- ``filter``: whether the kernel passes on only frames that some stream has (and error frames). It saves
  the work for all others, which are then not seen and hence not counted as unknown. Left out, it does so
  unless the bus is recorded.

Bit rates are the interface's, set with ``ip link``, and not a matter of this module.
"""

from __future__ import annotations

import ctypes
import errno
import logging
import os
import select
import socket
import struct
import sys
import time
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from drivers.can.batches import BIT_RATE_SWITCH, ERROR_PASSIVE_SENDER, FD, LONGEST, CanBatch
from drivers.can.errors import ALL_CLASSES
from drivers.can.kernel_time import KernelTime

if TYPE_CHECKING:
    import threading
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.acquisition.clock import Clock
    from drivers.can.batches import IdMatch
    from drivers.can.settings import CanBus


logger = logging.getLogger(__name__)

BATCH_FRAMES = 4096
GATHER_S = 0.1
"""How long frames that the kernel stamps gather between two reads: one turn of each part serves them all."""
UNSTAMPED_GATHER_S = 0.005
"""Those that it does not stamp are taken to come when they are read."""
FULLEST_BUS_HZ = 30_000
"""Frames a second: more than a bus carries, of frames without data and with CAN FD."""
FRAME_HELD_BYTES = 768
"""What a frame takes of the receive buffer, with what the kernel notes of it."""
RECEIVE_BUFFER_BYTES = 4 << 20
"""Doubled by the kernel: some 10 900 frames, more than a second of a full bus of 1 Mbit/s."""

CLASSIC_BYTES = 16
FD_BYTES = 72
"""``sizeof(struct can_frame)`` and ``sizeof(struct canfd_frame)``; both begin with id, length, flags."""

_HEADER_BYTES = 8
_FD_FLAGS = np.uint8(BIT_RATE_SWITCH | ERROR_PASSIVE_SENDER)
_SO_RCVBUFFORCE = 33
_SO_MEMINFO = 55
_RX_HARDWARE_RAW = 1 << 2 | 1 << 6
"""``SOF_TIMESTAMPING_RX_HARDWARE | SOF_TIMESTAMPING_RAW_HARDWARE`` (linux/net_tstamp.h)."""

_CAN_RAW_ERR_FILTER = 2
_MOST_FILTERS = 512
"""``CAN_RAW_FILTER_MAX`` (linux/can/raw.h)."""


class SocketCan:
    """One socket that yields CAN frames: a raw CAN socket, or a stand-in that carries the same bytes.

    Args:
        sock: a bound socket, one ``can_frame`` or ``canfd_frame`` per datagram; it is closed with this.
        clock: clock of the arrival times.
        receive_buffer_bytes: how much the kernel holds while frames are not read.

    Raises:
        OSError: this is no Linux, or the socket takes no time stamps.
    """

    error_classes = ALL_CLASSES
    recovers = True

    def __init__(
        self, sock: socket.socket, clock: Clock, *, receive_buffer_bytes: int = RECEIVE_BUFFER_BYTES
    ) -> None:
        self._socket = sock
        self._clock = clock
        self._time = KernelTime(clock)
        self._buffer = DatagramBuffer(BATCH_FRAMES, FD_BYTES)
        self._dropped = 0
        self._failed_with = 0
        self._gather_s = UNSTAMPED_GATHER_S
        sock.setblocking(False)
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        sock.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPING, _RX_HARDWARE_RAW)
        _make_room(sock, receive_buffer_bytes)
        self._half_bytes = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2
        # Not select(2): it knows no file descriptors past 1023.
        self._poll = select.poll()
        self._poll.register(sock, select.POLLIN)

    def read(self, timeout_s: float) -> CanBatch:
        """See `drivers.can.batches.CanSource.read`.

        Raises:
            OSError: the interface is down (ENETDOWN) or gone (ENODEV), or the other end of a stand-in is.
        """
        asked_ns = self._clock.monotonic_ns()
        count = self._receive()
        if not count and not self._failed_with and self._poll.poll(1e3 * timeout_s):
            asked_ns = self._clock.monotonic_ns()
            count = self._receive()
        if not count and self._failed_with:
            raise OSError(self._failed_with, os.strerror(self._failed_with))
        stamps = self._buffer.stamps()
        if count:
            self._gather_s = GATHER_S if stamps.software_ns.all() else UNSTAMPED_GATHER_S
        drained = count < BATCH_FRAMES
        arrival_ns = self._time.monotonic(stamps.software_ns, stamps.hardware_ns, drained=drained)
        overrun = self._overrun(stamps.dropped if count else dropped_frames(self._socket))
        sizes = self._buffer.sizes
        rows = self._buffer.datagrams[:count]
        malformed = 0
        is_fd = sizes == FD_BYTES
        if not (is_fd.all() or (whole := is_fd | (sizes == CLASSIC_BYTES)).all()):
            if (sizes == 0).any():
                raise OSError(errno.ENOTCONN, "the other end has closed the socket")
            malformed = int((~whole).sum())
            rows, sizes, is_fd, arrival_ns = rows[whole], sizes[whole], is_fd[whole], arrival_ns[whole]
        return CanBatch(
            ids=np.ascontiguousarray(rows[:, :4]).view(np.uint32)[:, 0],
            lengths=np.minimum(rows[:, 4].astype(np.int64), sizes.astype(np.int64) - _HEADER_BYTES),
            data=rows[:, _HEADER_BYTES : _HEADER_BYTES + LONGEST],
            arrival_ns=arrival_ns,
            overrun=overrun,
            malformed=malformed,
            drained_ns=asked_ns if drained else None,
            # Not every kernel sets the flag that states FD; the size states it in any.
            fd_flags=np.where(is_fd, rows[:, 5] & _FD_FLAGS | FD, 0) if is_fd.any() else None,
        )

    def gather(self, stopping: threading.Event) -> None:
        """See `drivers.can.batches.CanSource.gather`; ends when half of the receive buffer is full.

        A buffer that the fullest bus fills sooner is examined in between.
        """
        look_s = self._half_bytes / FRAME_HELD_BYTES / FULLEST_BUS_HZ
        until_s = time.monotonic() + self._gather_s
        while (left_s := until_s - time.monotonic()) > 0.0:
            if stopping.wait(min(left_s, look_s)) or _held_bytes(self._socket) > self._half_bytes:
                return

    def close(self) -> None:
        """See `drivers.can.batches.CanSource.close`."""
        self._socket.close()

    def _overrun(self, dropped: int | None) -> int:
        """Frames dropped since this was last asked, of the kernel's count modulo 2^32."""
        if dropped is None:
            return 0
        newly = (dropped - self._dropped) % 2**32
        if newly >= 2**31:  # a frame that was queued before the count was last read
            return 0
        self._dropped = dropped
        return newly

    def _receive(self) -> int:
        """Take frames; an error of the socket is kept until what was queued before it has been taken."""
        try:
            return self._buffer.receive(self._socket.fileno())
        except OSError as error:
            self._failed_with = error.errno or errno.EIO
            return self._buffer.receive(self._socket.fileno())


def open_socketcan(
    bus: CanBus, matches: Sequence[IdMatch], clock: Clock, *, recorded: bool = False
) -> SocketCan:
    """Open a CAN interface of the Linux kernel.

    Args:
        bus: its table in the machine file.
        matches: ids that some stream has.
        clock: clock of the arrival times.
        recorded: whether the bus is recorded: what is read of it then does not depend on what the streams
            are, unless its table states it.

    Raises:
        OSError: the kernel has no CAN, or the interface is absent or down.
    """
    if bus.options:
        raise OSError(
            errno.EINVAL,
            f"options {sorted(bus.options)} mean nothing to SocketCAN; remove them, "
            "set the interface up with `ip link` instead",
        )
    sock = _raw_socket()
    try:
        if bus.fd or recorded:
            sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        sock.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, ALL_CLASSES)
        filtered = not recorded if bus.filter is None else bus.filter
        if filtered and len(matches) <= _MOST_FILTERS:
            filters = b"".join(struct.pack("=II", match.id, match.mask) for match in matches)
            sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)
        source = SocketCan(sock, clock, receive_buffer_bytes=bus.receive_buffer_bytes)
        sock.bind((bus.channel,))
        _raise_first_error(sock, bus.channel)
    except BaseException:
        sock.close()
        raise
    return source


def dropped_frames(sock: socket.socket) -> int:
    """Frames that the kernel has dropped on a socket so far, modulo 2^32.

    A frame that is received states how many were dropped before it; this states it when none follows.
    """
    return _memory_of(sock)[8]


def _held_bytes(sock: socket.socket) -> int:
    """What of the receive buffer is taken."""
    return _memory_of(sock)[0]


def _memory_of(sock: socket.socket) -> tuple[int, ...]:
    """``SK_MEMINFO_RMEM_ALLOC`` to ``SK_MEMINFO_DROPS`` (linux/sock_diag.h)."""
    return struct.unpack("=9I", sock.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 36))


def _raw_socket() -> socket.socket:
    family = getattr(socket, "AF_CAN", None)
    if family is None:
        raise OSError(errno.EAFNOSUPPORT, "this Python was built without SocketCAN")
    try:
        return socket.socket(family, socket.SOCK_RAW, socket.CAN_RAW)
    except OSError as error:
        if error.errno in {errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT}:
            raise OSError(
                error.errno, "this kernel has no SocketCAN; `modprobe can-raw`, or use another interface"
            ) from error
        raise


def _raise_first_error(sock: socket.socket, channel: str) -> None:
    """A socket binds to an interface that is down, too, and has this as its first error."""
    code = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
    if code == errno.ENETDOWN:
        raise OSError(code, f"interface {channel} is down; set it up with `ip link set {channel} up`")
    if code:
        raise OSError(code, os.strerror(code))


def _make_room(sock: socket.socket, wanted: int) -> None:
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, wanted)
    except PermissionError:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, wanted)
    got = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // 2
    if got < wanted:
        logger.info(
            "the kernel gives a receive buffer of %d bytes instead of %d; allow more by "
            "`sysctl net.core.rmem_max=%d`, or grant CAP_NET_ADMIN",
            got,
            wanted,
            wanted,
        )


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


_STAMP_ALONE = int(np.array([SOL_SOCKET, SO_TIMESTAMPNS], np.int32).view(np.int64)[0])
"""Level and type of a control message that is a stamp, as one number."""

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
    """What the kernel reports about received datagrams.

    Attributes:
        software_ns: int64 ``[n]``, when the kernel took each in, on CLOCK_REALTIME; 0 if not stated.
        hardware_ns: int64 ``[n]``, when the controller took each in, on its own clock; 0 if not
            stated.
        dropped: how many datagrams the kernel had dropped on this socket before the last one, modulo 2^32;
            None if it does not state it, which means none as long as it never did.
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
        self._kinds: NDArray[np.int64] = self._control[:, 8:16].view(np.int64)[:, 0]
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
        """What the kernel reported about the datagrams of the last `receive`.

        The socket may ask for ``SO_TIMESTAMPNS``, with that ``SO_TIMESTAMPING`` for hardware stamps only, and
        ``SO_RXQ_OVFL``; they come in this order (``__sock_recv_timestamp``, ``sock_recv_drops``).
        """
        lengths = self._control_lengths[: self._used]
        if (lengths == _AFTER_STAMP).all() and (self._kinds[: self._used] == _STAMP_ALONE).all():
            # So nearly every batch is: what it reports lies in one place, and what it does not say nowhere.
            return Stamps(self._time(16), np.zeros(self._used, np.int64), None)
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
            # The figure grows from datagram to datagram: the last one that carries it states it all.
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
