"""A serial cable without a UART: a pseudo-terminal behind a path that outlives being re-plugged."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import termios
import tty
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path
    from types import TracebackType
    from typing import Self


class PseudoTerminal:
    """The device's end of a serial cable; whoever opens ``path`` has the other end.

    A pseudo-terminal passes bytes at memory speed whatever its baud rate, has no parity and no modem lines.
    Unplugging it takes the unread bytes along, as a USB adapter does, and removes ``path``; plugging it in
    makes a new device behind the same path.

    Args:
        path: of the symbolic link to the port, as udev makes them below ``/dev/serial/by-id``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._fd: int | None = None
        self._unsent = b""
        self.plug()

    @property
    def plugged(self) -> bool:
        """Whether the cable is there."""
        return self._fd is not None

    @property
    def fd(self) -> int:
        """File descriptor of the device's end.

        Raises:
            OSError: the cable is unplugged.
        """
        if self._fd is None:
            raise OSError(errno.ENODEV, f"{self.path} is unplugged; plug it in before using it")
        return self._fd

    def plug(self) -> None:
        """Plug the cable in; nothing happens if it is."""
        if self._fd is not None:
            return
        device, port = os.openpty()
        tty.setraw(port, termios.TCSANOW)
        os.set_blocking(device, False)
        temporary = self.path.with_name(f"{self.path.name}.new")
        temporary.unlink(missing_ok=True)
        temporary.symlink_to(os.ttyname(port))
        temporary.replace(self.path)
        # Nobody holds the port open on our side: when the reader closes it, it is closed.
        os.close(port)
        self._fd, self._unsent = device, b""

    def unplug(self) -> None:
        """Pull the cable out; nothing happens if it is out."""
        if self._fd is None:
            return
        self.path.unlink(missing_ok=True)
        os.close(self._fd)
        self._fd = None

    @property
    def pending(self) -> bool:
        """Whether a part of a frame still waits for room; `flush` sends it."""
        return bool(self._unsent)

    @property
    def listening(self) -> bool:
        """Whether somebody has the other end open."""
        if self._fd is None:
            return False
        poll = select.poll()
        poll.register(self._fd, 0)
        return not any(events & select.POLLHUP for _, events in poll.poll(0))

    def send(self, frame: bytes) -> bool:
        """Put one frame on the wire. One that finds room in part is finished by the next calls.

        Returns:
            False if nobody listens, or the other end has not read enough for the frame to find room.
        """
        if not self.listening:
            self._unsent = b""
            return False
        if not self.flush():
            return False
        self._unsent = frame
        self.flush()
        if len(self._unsent) == len(frame):
            self._unsent = b""
            return False
        return True

    def flush(self) -> bool:
        """Send what is left of a frame that found room in part; returns whether nothing is left."""
        with contextlib.suppress(BlockingIOError):
            while self._unsent:
                self._unsent = self._unsent[os.write(self.fd, self._unsent) :]
        return not self._unsent

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.unplug()
