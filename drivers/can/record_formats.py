"""CAN logs as bytes, piece by piece: frames go in, what is to be appended to a file comes out.

ASC and BLF are written by python-can. A candump log is written here: python-can's writer leaves out what an
error frame says and how much a remote frame asks for, and takes longer.
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Literal, Protocol

import can
from can.io.blf import FILE_HEADER_SIZE
from can.util import channel2int

from drivers.can.adapter import messages_of
from drivers.can.batches import (
    BIT_RATE_SWITCH,
    ERROR,
    ERROR_PASSIVE_SENDER,
    EXTENDED,
    EXTENDED_ID,
    REMOTE,
    STANDARD_ID,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from drivers.can.batches import CanBatch

LogFormat = Literal["blf", "asc", "candump"]

ENDINGS: Mapping[LogFormat, str] = {"blf": ".blf", "asc": ".asc", "candump": ".log"}
"""How the files of each format end, which is also how they are told apart when they are read."""

_FD_FLAGS = BIT_RATE_SWITCH | ERROR_PASSIVE_SENDER
_CONTAINER_NS = 1_000_000_000


class LogEncoder(Protocol):
    """A log that is being written."""

    flush_ns: int
    """How long frames may gather before they are taken: a container of BLF has a price of its own."""

    def add(self, frames: CanBatch, t_us: Sequence[int]) -> None:
        """Add frames, with their times in microseconds since the epoch, which never step back."""
        ...

    def take(self) -> bytes:
        """What is to be appended to the file for all that was added."""
        ...

    def head(self) -> bytes:
        """What the file is to begin with once that is appended; nothing if its beginning stays as it is."""
        ...

    def tail(self) -> bytes:
        """What ends the file when nothing more comes; readers do without it, too."""
        ...


class CandumpEncoder:
    """Lines as ``candump -l`` writes them.

    Args:
        interface: name of the interface in each line; without spaces.
    """

    flush_ns = 0

    def __init__(self, interface: str) -> None:
        self._interface = interface
        self._lines: list[str] = []

    def add(self, frames: CanBatch, t_us: Sequence[int]) -> None:
        """See `LogEncoder.add`."""
        n = len(t_us)
        fd_flags = [0] * n if frames.fd_flags is None else frames.fd_flags.tolist()
        digits, width = frames.data.tobytes().hex().upper(), 2 * frames.data.shape[1]
        for k, (frame_id, length, fd, t) in enumerate(
            zip(frames.ids.tolist(), frames.lengths.tolist(), fd_flags, t_us, strict=True)
        ):
            payload = digits[k * width : k * width + 2 * length]
            if frame_id & (ERROR | REMOTE | EXTENDED) or fd:
                if frame_id & ERROR:
                    name = f"{frame_id & (ERROR | EXTENDED_ID):08X}"
                elif frame_id & EXTENDED:
                    name = f"{frame_id & EXTENDED_ID:08X}"
                else:
                    name = f"{frame_id & STANDARD_ID:03X}"
                if frame_id & REMOTE:
                    payload = f"R{length:X}" if length else "R"
                elif fd:
                    payload = f"#{fd & _FD_FLAGS:X}{payload}"
            else:
                name = f"{frame_id:03X}"
            seconds, us = divmod(t, 1_000_000)
            self._lines.append(f"({seconds:010d}.{us:06d}) {self._interface} {name}#{payload}\n")

    def take(self) -> bytes:
        """See `LogEncoder.take`."""
        lines, self._lines = self._lines, []
        return "".join(lines).encode()

    def head(self) -> bytes:
        """See `LogEncoder.head`."""
        return b""

    def tail(self) -> bytes:
        """See `LogEncoder.tail`."""
        return b""


class AscEncoder:
    """Lines as Vector's tools write them, by python-can.

    Args:
        number: number of the channel, from 1 on.
    """

    flush_ns = 0

    def __init__(self, number: int) -> None:
        self._text = io.StringIO()
        self._writer = can.ASCWriter(self._text, channel=number)

    def add(self, frames: CanBatch, t_us: Sequence[int]) -> None:
        """See `LogEncoder.add`."""
        for message in messages_of(frames, t_us):
            self._writer.on_message_received(message)

    def take(self) -> bytes:
        """See `LogEncoder.take`."""
        text = self._text.getvalue()
        self._text.seek(0)
        self._text.truncate()
        return text.encode()

    def head(self) -> bytes:
        """See `LogEncoder.head`."""
        return b""

    def tail(self) -> bytes:
        """See `LogEncoder.tail`."""
        return b"End TriggerBlock\n"


class BlfEncoder(can.BLFWriter):
    """Containers of Vector's binary log, by python-can, each whole in itself.

    Args:
        number: number of the channel, from 1 on.
    """

    flush_ns = _CONTAINER_NS

    def __init__(self, number: int) -> None:
        self._bytes = io.BytesIO()
        super().__init__(self._bytes, channel=number)
        self._size = 0

    def add(self, frames: CanBatch, t_us: Sequence[int]) -> None:
        """See `LogEncoder.add`."""
        for message in messages_of(frames, t_us):
            self.on_message_received(message)

    def take(self) -> bytes:
        """See `LogEncoder.take`."""
        while self._buffer_size:
            self._flush()
        taken = self._emptied()
        self._size += len(taken)
        return taken

    def head(self) -> bytes:
        """See `LogEncoder.head`: the header tells the time that the others count from, and the size."""
        self._write_header(self._size)
        return self._emptied()[:FILE_HEADER_SIZE]

    def tail(self) -> bytes:
        """See `LogEncoder.tail`."""
        return b""

    def _emptied(self) -> bytes:
        taken = self._bytes.getvalue()
        self._bytes.seek(0)
        self._bytes.truncate()
        return taken


def encoder_for(log_format: LogFormat, interface: str) -> LogEncoder:
    """The beginning of a log.

    Args:
        log_format: which one.
        interface: what the interface is called, e.g. ``can0``; where logs number interfaces, this is 1.
    """
    if log_format == "candump":
        return CandumpEncoder(interface)
    number = (channel2int(interface) or 0) + 1
    return BlfEncoder(number) if log_format == "blf" else AscEncoder(number)
