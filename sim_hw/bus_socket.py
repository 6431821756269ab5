"""A virtual CAN bus between processes: an interface of python-can over a Unix socket.

    can.Bus(interface="unixbus", channel="/tmp/can0", fd=True)

Needs no kernel support, no privileges and no network. The bus lives in a hub; whoever comes first starts
one in a separate process, unless one runs already (``python -m sim_hw.bus_socket /tmp/can0``). When the hub
ends the bus is lost for all, as when an interface goes down, and whoever opens it next starts it again.

Like Linux' vcan it has no bit rate and no arbitration. Unlike vcan it reports every frame that a slow reader
loses: by an error frame where they are missing, and by their number in `UnixBus.frames_lost`.
"""

from __future__ import annotations

import contextlib
import errno
import json
import select
import signal
import socket
import struct
import sys
import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Literal, TypedDict

import can

from daqsvc.commands.arguments import ArgumentParser
from daqsvc.commands.complaint import complain
from sim_hw.bus_socket_hub import (
    LONGEST,
    QUEUE_FRAMES,
    ClientOption,
    Hub,
    HubError,
    HubTakenError,
    check_path,
    is_frame,
    overflow_message,
    pack_frame,
    pack_greeting,
    unpack_frame,
    unpack_greeting,
    unpack_lost,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

OPEN_S = 5.0
_RETRY_S = 0.01
_SO_TIMESTAMPNS = 35
"""asm-generic/socket.h; the socket module does not name it."""
_STAMP = struct.Struct("=qq")
_STAMP_SPACE = socket.CMSG_SPACE(_STAMP.size)


class UnixBus(can.BusABC):
    """One end of the bus.

    Args:
        channel: path of the bus's socket.
        can_filters: as python-can has them; applied here, after a frame has arrived.
        fd: whether this end sends and receives CAN FD frames; like a classic controller one without
            is not shown them.
        receive: whether it wants frames at all; for an end that only sends, none wait in the hub.
        receive_own_messages: whether its own frames come back to it.
        hub: ``"start"`` starts the bus if there is none, ``"join"`` fails then.
        bitrate: without effect: the bus has none.
        data_bitrate: without effect.
        queue_frames: frames that a bus started here keeps for each client that does not read.
        **unknown: options that there are not.

    Raises:
        can.CanInitializationError: the bus cannot be joined or started, or an option is unknown.
    """

    def __init__(
        self,
        channel: str,
        can_filters: can.typechecking.CanFilters | None = None,
        *,
        fd: bool = False,
        receive: bool = True,
        receive_own_messages: bool = False,
        hub: Literal["start", "join"] = "start",
        bitrate: int | None = None,  # noqa: ARG002 - machine files for hardware name it
        data_bitrate: int | None = None,  # noqa: ARG002
        queue_frames: int = QUEUE_FRAMES,
        **unknown: object,
    ) -> None:
        self._is_shutdown = True
        if unknown:
            raise can.CanInitializationError(
                f"a unixbus has no option {', '.join(map(repr, unknown))}; there are fd, hub, "
                "queue_frames, receive and receive_own_messages"
            )
        if hub not in {"start", "join"}:
            raise can.CanInitializationError(f'hub = {hub!r} of a unixbus must be "start" or "join"')
        self.channel = str(channel)
        self.channel_info = f"unixbus {self.channel}"
        self.frames_lost = 0
        """Frames that were lost because this end did not read them in time."""
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        self._fd = fd
        wish = ClientOption.ECHO if receive_own_messages else ClientOption.NOTHING
        wish |= ClientOption.NOTHING if receive else ClientOption.DEAF
        wish |= ClientOption.NOTHING if fd else ClientOption.CLASSIC
        self._socket = _join(self.channel, wish, queue_frames if hub == "start" else None)
        self._poll = select.poll()
        self._poll.register(self._socket, select.POLLIN)
        super().__init__(channel, can_filters)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        until_s = None if timeout is None else time.monotonic() + timeout
        while True:
            try:
                packet, ancillary, _, _ = self._socket.recvmsg(LONGEST, _STAMP_SPACE)
            except BlockingIOError:
                left_s = None if until_s is None else until_s - time.monotonic()
                if left_s is not None and left_s <= 0:
                    return None, False
                self._poll.poll(None if left_s is None else 1000 * left_s)
                continue
            except ConnectionResetError:
                continue  # the hub died with frames unread; those it sent are still to come
            except OSError as error:
                raise self._lost(error) from error
            if not packet:
                raise self._lost(None)
            message = self._message(packet, _stamp_s(ancillary))
            if message is not None:
                return message, False

    def _message(self, packet: bytes, timestamp_s: float) -> can.Message | None:
        if is_frame(packet):
            return unpack_frame(packet, timestamp_s, self.channel)
        lost = unpack_lost(packet)
        self.frames_lost += lost
        return overflow_message(timestamp_s, self.channel) if lost else None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Put a frame on the bus.

        Args:
            msg: the frame.
            timeout: seconds to wait for room in the socket; None to wait for as long as it takes.

        Raises:
            can.CanOperationError: the bus is lost, there was no room in time (``error_code`` is
                ``errno.ENOBUFS``), or a CAN FD frame was given to an end without ``fd``.
        """
        if msg.is_fd and not self._fd:
            raise can.CanOperationError(
                f"{self.channel_info} was opened without fd, and frame {msg.arbitration_id:#x} is a "
                "CAN FD frame; open it with fd = true",
                errno.EINVAL,
            )
        packet = pack_frame(msg)
        until_s = None if timeout is None else time.monotonic() + timeout
        while True:
            try:
                self._socket.send(packet)
            except BlockingIOError:
                left_s = None if until_s is None else until_s - time.monotonic()
                if left_s is not None and left_s <= 0:
                    raise can.CanOperationError(
                        f"{self.channel_info} has no room for another frame: its hub does not keep up",
                        errno.ENOBUFS,
                    ) from None
                room = select.poll()
                room.register(self._socket, select.POLLOUT)
                room.poll(None if left_s is None else 1000 * left_s)
            except OSError as error:
                raise self._lost(error) from error
            else:
                return

    def fileno(self) -> int:
        """The socket, readable when a frame is there; -1 once the bus is shut down."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Leave the bus; a `recv` that waits in another thread ends with `can.CanOperationError`."""
        super().shutdown()
        with contextlib.suppress(OSError):  # it is lost already
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _lost(self, error: OSError | None) -> can.CanOperationError:
        why = "was left" if self._socket.fileno() < 0 or self._is_shutdown else "is gone: its hub ended"
        return can.CanOperationError(
            f"{self.channel_info} {why}", errno.ENETDOWN if error is None else error.errno
        )


def _stamp_s(ancillary: Sequence[tuple[int, int, bytes]]) -> float:
    """When the packet was sent, by the kernel."""
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(data) == _STAMP.size:
            seconds, ns = _STAMP.unpack(data)
            return float(seconds + 1e-9 * ns)
    return time.time()


def _join(path: str, wish: ClientOption, queue_frames: int | None) -> socket.socket:
    """A connection to the hub at ``path``, which is started if there is none, given ``queue_frames``."""
    until_s = time.monotonic() + OPEN_S
    try:
        check_path(path)
        while True:
            if (connection := _greeted(path, wish)) is not None:
                return connection
            if queue_frames is None:
                raise HubError(
                    f"there is no bus at {path}; start it (daqsvc sim --bus {path}), or leave out "
                    'hub = "join"'
                )
            if time.monotonic() > until_s:
                raise HubError(
                    f"the bus at {path} has not answered for {OPEN_S:g} s; is its process stopped?"
                )
            try:
                hub = Hub(path, queue_frames=queue_frames, until_empty=True)
            except HubTakenError:
                time.sleep(_RETRY_S)  # it is about to answer, or about to end
            else:
                hub.start()
    except OSError as error:
        raise can.CanInitializationError(str(error)) from error


def _greeted(path: str, wish: ClientOption) -> socket.socket | None:
    """A connection that the hub has answered on, so that no later frame is missed; None without a hub."""
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        connection.settimeout(OPEN_S)
        connection.connect(path)
        connection.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        connection.send(pack_greeting(wish))
        if unpack_greeting(connection.recv(LONGEST)) is not None:
            connection.setblocking(False)
            return connection
    except TimeoutError:
        connection.close()
        raise _no_answer(path) from None
    except (FileNotFoundError, ConnectionError):
        pass
    except OSError:
        connection.close()
        raise
    connection.close()
    return None


def _no_answer(path: str) -> HubError:
    return HubError(f"the bus at {path} has not answered for {OPEN_S:g} s; is its process stopped?")


def main(arguments: Sequence[str] | None = None) -> int:
    """``python -m sim_hw.bus_socket PATH``: run a bus until SIGTERM or Ctrl-C; then print its counters."""
    parser = ArgumentParser(prog="sim_hw.bus_socket", description="Run a virtual CAN bus.")
    parser.add_argument("path", metavar="PATH", help="of its socket: the channel of interface unixbus")
    parser.add_argument(
        "--queue-frames", type=int, default=QUEUE_FRAMES, help=f"kept for a slow reader ({QUEUE_FRAMES})"
    )
    parsed = parser.parse_args(arguments)
    return run_hub(parsed.path, parsed.queue_frames)


class BusAddress(TypedDict):
    """What a virtual bus has carried, with `--bus`.

    Attributes:
        bus: its address.
    """

    bus: str


def run_hub(path: str, queue_frames: int = QUEUE_FRAMES) -> int:
    """Run a bus in this process until SIGTERM or SIGINT; then print its counters as JSON. The exit code."""
    try:
        hub = Hub(path, queue_frames=queue_frames)
    except HubError as error:
        return complain("daqsvc sim", error, error.code)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: hub.stop())
    print(f"bus {path} is up", file=sys.stderr, flush=True)  # noqa: T201
    hub.run()
    address: BusAddress = {"bus": path}
    print(json.dumps({**address, **asdict(hub.counters)}), flush=True)  # noqa: T201 - this is the output
    return 0


if __name__ == "__main__":
    sys.exit(main())
