"""Virtual CAN interfaces of the kernel, made and unmade by a test (as root)."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import socket
import struct
import subprocess

_SIOCGIFFLAGS, _SIOCSIFFLAGS = 0x8913, 0x8914
_IFF_UP = 1
CAN_FD_MTU = 72
_serial = itertools.count()


class VcanLink:
    """A CAN FD interface that exists and is up until told otherwise; ``vcan...`` if it need have no name."""

    def __init__(self, name: str = "") -> None:
        self.name = name or f"vcan{os.getpid() % 10_000}x{next(_serial)}"
        self.add()

    def add(self) -> None:
        """Plug the interface in and set it up."""
        _ip("link", "add", "dev", self.name, "mtu", str(CAN_FD_MTU), "type", "vcan")
        self.up()

    def remove(self) -> None:
        """Unplug it."""
        _ip("link", "del", "dev", self.name)

    def up(self) -> None:
        self._set(up=True)

    def down(self) -> None:
        self._set(up=False)

    def close(self) -> None:
        """Leave nothing behind."""
        with contextlib.suppress(subprocess.CalledProcessError):
            self.remove()

    def sender(self, *, send_buffer: int = 1 << 20) -> socket.socket:
        """A raw socket on the interface that receives nothing."""
        sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
        sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, send_buffer)
        sock.bind((self.name,))
        return sock

    def _set(self, *, up: bool) -> None:
        """As ``ip link set NAME up|down``, without a process for it."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
            request = struct.pack("16sh14x", self.name.encode(), 0)
            (flags,) = struct.unpack_from("h", fcntl.ioctl(any_socket, _SIOCGIFFLAGS, request), 16)
            flags = flags | _IFF_UP if up else flags & ~_IFF_UP
            fcntl.ioctl(any_socket, _SIOCSIFFLAGS, struct.pack("16sh14x", self.name.encode(), flags))


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)
