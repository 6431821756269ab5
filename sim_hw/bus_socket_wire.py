"""What goes over the sockets of a `sim_hw.bus_socket` bus: frames as Linux SocketCAN lays them out.

A packet of 16 bytes is a ``struct can_frame``, one of 72 a ``struct canfd_frame`` (linux/can.h). Packets of
other lengths are between a hub and its clients: the greeting, and the notice of frames that were lost.
"""

from __future__ import annotations

import struct
from enum import IntFlag

import can

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
    """How many frames a notice says were lost; 0 if the packet is none."""
    if len(packet) != _LOST.size:
        return 0
    mark, frames = _LOST.unpack(packet)
    return int(frames) if mark == _LOST_MARK else 0


def overflow_message(timestamp_s: float, channel: str) -> can.Message:
    """The error frame with which a CAN controller tells that its receive buffer ran over."""
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
