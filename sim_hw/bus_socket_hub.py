"""The hub of a `sim_hw.bus_socket` bus: hands every frame to all clients but its sender, in one order."""

from __future__ import annotations

import atexit
import contextlib
import errno
import fcntl
import os
import selectors
import socket
import struct
import threading
import time
from collections import deque
from dataclasses import dataclass
from enum import IntFlag
from pathlib import Path

import can

from daqsvc.errors.command_line import SIMULATION

CAN_BYTES = 16
FD_BYTES = 72
LONGEST = FD_BYTES

_ID_EXTENDED = 0x8000_0000
_ID_REMOTE = 0x4000_0000
_ID_ERROR = 0x2000_0000
_ID_BITS = 0x1FFF_FFFF
_FD_SWITCHED = 0x01
_FD_ERROR_STATE = 0x02
_FD_FRAME = 0x04
_HEADER = struct.Struct("=IBBBB")

_GREETING = struct.Struct("=7sB")
_GREETED = b"UNIXBUS"
_LOST = struct.Struct("=4sQ")
_LOST_MARK = b"LOST"

_ERROR_CONTROLLER = 0x04
"""Class of an error frame: trouble of the controller (linux/can/error.h, CAN_ERR_CRTL)."""
_ERROR_RX_OVERFLOW = 0x01
"""Its second byte: the receive buffer ran over (CAN_ERR_CRTL_RX_OVERFLOW)."""


class ClientOption(IntFlag):
    """What a client asks of the hub in its greeting."""

    NOTHING = 0
    ECHO = 1
    """To be sent its own frames too."""
    DEAF = 2
    """To be sent no frames at all."""
    CLASSIC = 4
    """To be sent no CAN FD frames, which a classic controller does not understand."""


def is_frame(packet: bytes) -> bool:
    """Whether a packet is a frame, by its length."""
    return len(packet) in {CAN_BYTES, FD_BYTES}


def pack_frame(message: can.Message) -> bytes:
    """A message as the bytes of ``struct can_frame`` or ``struct canfd_frame``."""
    can_id = message.arbitration_id
    can_id |= _ID_EXTENDED if message.is_extended_id else 0
    can_id |= _ID_REMOTE if message.is_remote_frame else 0
    can_id |= _ID_ERROR if message.is_error_frame else 0
    data = b"" if message.is_remote_frame else bytes(message.data)
    if not message.is_fd:
        return _HEADER.pack(can_id, message.dlc, 0, 0, 0) + data.ljust(CAN_BYTES - _HEADER.size, b"\0")
    flags = _FD_FRAME
    flags |= _FD_SWITCHED if message.bitrate_switch else 0
    flags |= _FD_ERROR_STATE if message.error_state_indicator else 0
    return _HEADER.pack(can_id, len(data), flags, 0, 0) + data.ljust(FD_BYTES - _HEADER.size, b"\0")


def unpack_frame(packet: bytes, timestamp_s: float, channel: str) -> can.Message:
    """The message in a packet for which `is_frame` holds.

    Args:
        packet: 16 or 72 bytes. A length field beyond what there is room for is cut to that.
        timestamp_s: when it was sent, seconds since the Unix epoch.
        channel: of the bus it came over.
    """
    can_id, length, flags, _, _ = _HEADER.unpack_from(packet)
    is_fd = len(packet) == FD_BYTES
    length = min(length, len(packet) - _HEADER.size)
    remote = bool(can_id & _ID_REMOTE)
    return can.Message(
        timestamp=timestamp_s,
        arbitration_id=can_id & _ID_BITS,
        is_extended_id=bool(can_id & _ID_EXTENDED),
        is_remote_frame=remote,
        is_error_frame=bool(can_id & _ID_ERROR),
        is_fd=is_fd,
        bitrate_switch=is_fd and bool(flags & _FD_SWITCHED),
        error_state_indicator=is_fd and bool(flags & _FD_ERROR_STATE),
        is_rx=True,
        channel=channel,
        dlc=length,
        data=b"" if remote else packet[_HEADER.size : _HEADER.size + length],
        check=False,
    )


def is_fd_frame(packet: bytes) -> bool:
    """Whether a packet is a CAN FD frame."""
    return len(packet) == FD_BYTES


def pack_greeting(wish: ClientOption) -> bytes:
    """The first packet of a client; the hub answers with the same."""
    return _GREETING.pack(_GREETED, wish)


def unpack_greeting(packet: bytes) -> ClientOption | None:
    """What a client's first packet asks for; None if it is no greeting."""
    if len(packet) != _GREETING.size:
        return None
    mark, wish = _GREETING.unpack(packet)
    return (
        ClientOption(wish & (ClientOption.ECHO | ClientOption.DEAF | ClientOption.CLASSIC))
        if mark == _GREETED
        else None
    )


def pack_lost(frames: int) -> bytes:
    """The notice that so many frames were lost just here."""
    return _LOST.pack(_LOST_MARK, frames)


def unpack_lost(packet: bytes) -> int:
    """How many frames a notice states were lost; 0 if the packet is none."""
    if len(packet) != _LOST.size:
        return 0
    mark, frames = _LOST.unpack(packet)
    return int(frames) if mark == _LOST_MARK else 0


def overflow_message(timestamp_s: float, channel: str) -> can.Message:
    """The error frame with which a CAN controller reports that its receive buffer ran over."""
    return can.Message(
        timestamp=timestamp_s,
        arbitration_id=_ERROR_CONTROLLER,
        is_extended_id=False,
        is_error_frame=True,
        is_rx=True,
        channel=channel,
        data=bytes([0, _ERROR_RX_OVERFLOW, 0, 0, 0, 0, 0, 0]),
        check=False,
    )


QUEUE_FRAMES = 8192
"""Frames that wait in the hub for a client, beside those (some 280) that its socket holds."""
BURST_FRAMES = 64
"""Frames taken from one client before the others have their turn."""
LONGEST_PATH_BYTES = 107
"""Of an address of a Unix socket (``sun_path`` in linux/un.h, less its closing zero)."""
FLUSH_S = 1.0
BACKLOG = 64


class HubError(OSError):
    """A hub cannot be started at a path; states why and what to do."""

    code = SIMULATION


class HubTakenError(HubError):
    """There is a hub at the path already."""


@dataclass(slots=True)
class HubCounters:
    """What went through a hub; every figure only grows.

    Attributes:
        frames: frames that were received from clients.
        delivered: frames handed to a client, or queued for it, once for each such client.
        lost: frames that were lost to a client that did not read them in time, once for each such client.
        malformed: packets that were no frames.
        clients: clients that have ever joined.
    """

    frames: int = 0
    delivered: int = 0
    lost: int = 0
    malformed: int = 0
    clients: int = 0


class _HubClient:
    """One end of the bus, as the hub sees it."""

    def __init__(self, connection: socket.socket, limit: int) -> None:
        self.connection = connection
        self.joined = False
        self.wish = ClientOption.NOTHING
        self.backlog: deque[bytes] = deque()
        self._limit = limit
        self._untold = 0

    def accepts(self, sender: _HubClient, packet: bytes) -> bool:
        """Whether a frame of that sender is for this end."""
        if not self.joined or ClientOption.DEAF in self.wish:
            return False
        if ClientOption.CLASSIC in self.wish and is_fd_frame(packet):
            return False
        return sender is not self or ClientOption.ECHO in self.wish

    def offer(self, packet: bytes) -> bool:
        """Send a packet, or queue it; False if it was lost because the queue is full.

        Raises:
            OSError: the client is gone.
        """
        if not self.backlog and not self._untold and self._sent(packet):
            return True
        if len(self.backlog) >= self._limit:
            self._untold += 1
            return False
        self._queue_notice()
        self.backlog.append(packet)
        return True

    def flush(self) -> None:
        """Send what is queued, as far as the client takes it.

        Raises:
            OSError: the client is gone.
        """
        while self.backlog and self._sent(self.backlog[0]):
            self.backlog.popleft()
        if not self.backlog:
            # A client that has caught up learns its loss at once, not with the next frame.
            self._queue_notice()
            while self.backlog and self._sent(self.backlog[0]):
                self.backlog.popleft()

    def _queue_notice(self) -> None:
        if self._untold:
            self.backlog.append(pack_lost(self._untold))
            self._untold = 0

    def _sent(self, packet: bytes) -> bool:
        try:
            self.connection.send(packet)
        except BlockingIOError:
            return False
        return True


class Hub:
    """A virtual CAN bus at a path; `run` works it, in whatever thread it is called.

    Args:
        path: of the Unix socket that clients connect to.
        queue_frames: frames kept for a client that does not read.
        until_empty: end when the last client has left, rather than only when stopped.

    Raises:
        HubTakenError: there is one already.
        HubError: the socket cannot be made.
    """

    def __init__(
        self, path: str | Path, *, queue_frames: int = QUEUE_FRAMES, until_empty: bool = False
    ) -> None:
        self.path = str(path)
        self.counters = HubCounters()
        self.thread: threading.Thread | None = None
        self._queue_frames = queue_frames
        self._until_empty = until_empty
        self._stopping = threading.Event()
        self._clients: dict[socket.socket, _HubClient] = {}
        check_path(self.path)
        self._lock = _lock(self.path)
        try:
            self._listener = _listener(self.path)
        except OSError as error:
            _unlock(self.path, self._lock)
            raise HubError(
                f"no bus can be made at {self.path}: {error.strerror or error}; "
                "name a path that can be written"
            ) from error
        self._selector = selectors.DefaultSelector()
        self._woken, self._waker = socket.socketpair()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._woken, selectors.EVENT_READ)

    def run(self) -> None:
        """Hand frames on until stopped."""
        try:
            while not self._stopping.is_set():
                for key, events in self._selector.select():
                    self._serve(key.fileobj, events)
                if self._until_empty and self.counters.clients and not self._clients:
                    break
            self._flush()
        finally:
            self._close()

    def start(self) -> None:
        """Run in a separate thread; a process that ends hands on what its hub has taken in."""
        atexit.register(self.stop)
        self.thread = threading.Thread(
            target=self._run_as_thread, name=f"unixbus-hub {self.path}", daemon=True
        )
        self.thread.start()

    def _run_as_thread(self) -> None:
        try:
            self.run()
        finally:
            atexit.unregister(self.stop)

    def stop(self) -> None:
        """Make `run` end, within about a second; from any thread. What is queued is sent before."""
        self._stopping.set()
        with contextlib.suppress(OSError):  # it has ended by itself
            self._waker.send(b"\0")
        if self.thread is not None and self.thread is not threading.current_thread():
            self.thread.join(2 * FLUSH_S)

    def _serve(self, ready: object, events: int) -> None:
        if ready is self._listener:
            self._accept()
        elif isinstance(ready, socket.socket) and (client := self._clients.get(ready)):
            try:
                if events & selectors.EVENT_WRITE:
                    client.flush()
                    self._watch(client)
            except OSError:
                self._leave(client)
                return
            if events & selectors.EVENT_READ:
                self._receive(client)

    def _accept(self) -> None:
        connection, _ = self._listener.accept()
        connection.setblocking(False)
        self._clients[connection] = _HubClient(connection, self._queue_frames)
        self._selector.register(connection, selectors.EVENT_READ)
        self.counters.clients += 1

    def _receive(self, client: _HubClient) -> bool:
        """Take what a client has sent, up to a burst; whether more may be there."""
        for _ in range(BURST_FRAMES):
            try:
                packet = client.connection.recv(LONGEST + 1)
            except BlockingIOError:
                return False
            except ConnectionResetError:
                # It left with frames unread; what it sent before that is still to come.
                continue
            except OSError:
                packet = b""
            if not packet:
                self._leave(client)
                return False
            self._take(client, packet)
        return True

    def _drain(self, client: _HubClient) -> None:
        """Take what a client had sent before its sending was shut off."""
        while True:
            try:
                packet = client.connection.recv(LONGEST + 1)
            except ConnectionResetError:
                continue  # as in `_receive`
            except OSError:
                return
            if not packet:
                return
            self._take(client, packet)

    def _take(self, client: _HubClient, packet: bytes) -> None:
        if not client.joined:
            wish = unpack_greeting(packet)
            if wish is None:
                self.counters.malformed += 1
                self._leave(client)
                return
            client.joined, client.wish = True, wish
            client.offer(pack_greeting(wish))
        elif is_frame(packet):
            for other in list(self._clients.values()):
                if other.accepts(client, packet):
                    self._deliver(other, packet)
            self.counters.frames += 1
        else:
            self.counters.malformed += 1

    def _deliver(self, client: _HubClient, packet: bytes) -> None:
        waited = bool(client.backlog)
        try:
            taken = client.offer(packet)
        except OSError:
            # Its end is seen, and its last frames are taken, when it is read from.
            return
        self.counters.delivered += taken
        self.counters.lost += not taken
        if bool(client.backlog) != waited:
            self._watch(client)

    def _watch(self, client: _HubClient) -> None:
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if client.backlog else 0)
        self._selector.modify(client.connection, events)

    def _leave(self, client: _HubClient) -> None:
        if self._clients.pop(client.connection, None) is not None:
            self._selector.unregister(client.connection)
            client.connection.close()

    def _flush(self) -> None:
        """Send what is queued, for as long as clients read it, and a second at most."""
        # From here on a sender is refused: no frame counts as sent that the bus does not carry.
        for connection in self._clients:
            with contextlib.suppress(OSError):  # its client is gone
                connection.shutdown(socket.SHUT_RD)
        for client in list(self._clients.values()):
            self._drain(client)
        until_s = time.monotonic() + FLUSH_S
        while (late := [c for c in self._clients.values() if c.backlog]) and time.monotonic() < until_s:
            for client in late:
                try:
                    client.flush()
                except OSError:
                    self._leave(client)
            time.sleep(0.001)

    def _close(self) -> None:
        for client in list(self._clients.values()):
            self._leave(client)
        self._selector.close()
        Path(self.path).unlink(missing_ok=True)
        for each in (self._listener, self._woken, self._waker):
            each.close()
        _unlock(self.path, self._lock)


def check_path(path: str) -> None:
    """Refuse a path that no Unix socket can have.

    Raises:
        HubError: it is empty or too long.
    """
    length = len(os.fsencode(path))
    if not 0 < length <= LONGEST_PATH_BYTES:
        raise HubError(
            f"the path {path!r} of a bus has {length} bytes, and a Unix socket's may have 1 to "
            f"{LONGEST_PATH_BYTES}; name a shorter one, e.g. /tmp/can0"
        )


def _listener(path: str) -> socket.socket:
    # Whoever holds the lock is the only hub: a socket that is there was left by one that died.
    if Path(path).exists() and not Path(path).is_socket():
        raise FileExistsError(errno.EEXIST, "there is a file of that name, and it is not a socket")
    Path(path).unlink(missing_ok=True)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        listener.bind(path)
        listener.listen(BACKLOG)
    except OSError:
        listener.close()
        raise
    return listener


def _lock(path: str) -> int:
    """Take the lock that only one hub at a path can have; the kernel frees it when the hub dies."""
    name = Path(f"{path}.lock")
    while True:
        try:
            lock = os.open(name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise HubError(
                f"no bus can be made at {path}: {error.strerror}; "
                "name a path in a directory that is there and can be written"
            ) from error
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Its last holder may have removed it while we waited for it.
            if os.path.samestat(os.fstat(lock), name.stat()):
                return lock
        except BlockingIOError:
            os.close(lock)
            raise HubTakenError(f"there is a bus at {path} already; join it, or name another path") from None
        except FileNotFoundError:
            pass
        os.close(lock)


def _unlock(path: str, lock: int) -> None:
    Path(f"{path}.lock").unlink(missing_ok=True)
    os.close(lock)
