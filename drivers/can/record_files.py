"""The files of a CAN recording: what is in them, their names, how large they grow, what is removed.

Frames go in, what is to be appended to a file comes out. ASC and BLF are written by python-can. A candump log
is written here: python-can's writer leaves out what an error frame states and how much a remote frame asks
for, and takes longer.
"""

from __future__ import annotations

import errno
import io
import itertools
import os
import re
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Literal, Protocol

import can
import numpy as np
from can.io.blf import FILE_HEADER_SIZE
from can.util import channel2int

from daqsvc.acquisition.clock import NS_PER_S
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
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from drivers.can.batches import CanBatch


LogFormat = Literal["blf", "asc", "candump"]

ENDINGS: Mapping[LogFormat, str] = {"blf": ".blf", "asc": ".asc", "candump": ".log"}
"""How the files of each format end, which is also how they are told apart when they are read."""

_FD_FLAGS = BIT_RATE_SWITCH | ERROR_PASSIVE_SENDER
_CONTAINER_NS = 1_000_000_000


class LogEncoder(Protocol):
    """A log that is being written."""

    flush_ns: int
    """How long frames may gather before they are taken: a container of BLF has its own price."""

    def add(self, frames: CanBatch, t_us: Sequence[int]) -> None:
        """Add frames, with their times in microseconds since the epoch, which never step back."""
        ...

    def drain(self) -> bytes:
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

    def drain(self) -> bytes:
        """See `LogEncoder.drain`."""
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

    def drain(self) -> bytes:
        """See `LogEncoder.drain`."""
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

    def drain(self) -> bytes:
        """See `LogEncoder.drain`."""
        while self._buffer_size:
            self._flush()
        taken = self._emptied()
        self._size += len(taken)
        return taken

    def head(self) -> bytes:
        """See `LogEncoder.head`: the header states the time that the others count from, and the size."""
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


_STAMP = r"-\d{8}T\d{6}\.\d{6}Z"


class Logs(Protocol):
    """Where a recording goes."""

    log_format: LogFormat
    file_bytes: float
    """A file that is this large is ended, and another one begun."""

    place: Path
    """The description for a person."""

    def next_path(self, wall_ns: int) -> Path:
        """The path of the next file, whose first frame came at ``wall_ns``; makes room for it.

        Raises:
            OSError: the disk refuses.
        """
        ...


class LogFolder:
    """Files named by bus and UTC start, e.g. ``can0-20261121T133215.250000Z.blf``; the oldest make room.

    Only files with such names are removed. The folder must be there: if it were made here, it
    would fill the wrong disk whenever the right one is not mounted.

    Args:
        folder: holds them.
        bus: name of the bus.
        log_format: of new files.
        file_bytes: a file that is this large is ended.
        keep_bytes: what all of them may take, the one that is being written included.
    """

    def __init__(
        self, folder: Path, bus: str, log_format: LogFormat, *, file_bytes: float, keep_bytes: float
    ) -> None:
        self.place = folder
        self.log_format = log_format
        self.file_bytes = file_bytes
        self._bus = bus
        self._keep_bytes = keep_bytes
        endings = "|".join(re.escape(ending) for ending in ENDINGS.values())
        self._ours = re.compile(re.escape(bus) + _STAMP + f"(?:{endings})")

    def next_path(self, wall_ns: int) -> Path:
        """See `Logs.next_path`."""
        if not self.place.is_dir():
            raise OSError(errno.ENOENT, "there is no such folder")
        self._make_room()
        seconds, ns = divmod(wall_ns, NS_PER_S)
        began = datetime.fromtimestamp(seconds, UTC).replace(microsecond=ns // 1000)
        return self.place / f"{self._bus}-{began:%Y%m%dT%H%M%S.%f}Z{ENDINGS[self.log_format]}"

    def _make_room(self) -> None:
        # Their names sort as their times do.
        files = sorted(path for path in self.place.iterdir() if self._ours.fullmatch(path.name))
        sizes = [path.stat().st_size for path in files]
        left = sum(sizes)
        for path, size in zip(files, sizes, strict=True):
            if left + self.file_bytes <= self._keep_bytes:
                break
            path.unlink()
            left -= size


class OneLog:
    """One file of any size; should the disk refuse it for a while, it goes on as ``NAME-2``, and so on.

    Args:
        path: the file; its ending states the format.

    Raises:
        ValueError: the ending is that of no format.
    """

    file_bytes = float("inf")

    def __init__(self, path: Path) -> None:
        formats = {ending: log_format for log_format, ending in ENDINGS.items()}
        if path.suffix.lower() not in formats:
            raise ValueError(f"{path.name} must end in {', '.join(formats)}")
        self.place = path
        self.log_format = formats[path.suffix.lower()]

    def next_path(self, wall_ns: int) -> Path:  # noqa: ARG002 - its name is given
        """See `Logs.next_path`."""
        return next(path for path in self.names() if not path.exists())

    def names(self) -> Iterator[Path]:
        """What the file is called, and the files that go on with it."""
        yield self.place
        for k in itertools.count(2):
            yield self.place.with_stem(f"{self.place.stem}-{k}")


class LogFile:
    """One log on disk. What is flushed is in it whole or, where the disk refuses, not at all.

    Args:
        path: the file, which must not exist yet.
        encoder: the beginning of the log.
        offset_ns: wall time minus monotonic time. It holds for the whole file: a step of the wall clock is
            no step between frames.

    Raises:
        OSError: the disk refuses.
    """

    def __init__(self, path: Path, encoder: LogEncoder, offset_ns: int) -> None:
        self.path = path
        self.size = 0
        self.flush_ns = encoder.flush_ns
        self._encoder = encoder
        self._offset_ns = offset_ns
        self._last_us = 0
        self._file = path.open("xb", buffering=0)

    @property
    def deleted(self) -> bool:
        """Whether somebody has deleted the file."""
        return os.fstat(self._file.fileno()).st_nlink == 0

    def add(self, frames: CanBatch) -> None:
        """Add frames to what is flushed next."""
        t_us = (frames.arrival_ns + self._offset_ns) // 1000
        # Formats that count from their first frame cannot state that one came before it.
        t_us = np.maximum(np.maximum.accumulate(t_us), self._last_us)
        self._last_us = int(t_us[-1])
        self._encoder.add(frames, t_us.tolist())

    def flush(self) -> None:
        """Hand what was added to the operating system.

        Raises:
            OSError: the disk refuses; the file ends where it ended before.
        """
        piece = self._encoder.drain()
        if not piece:
            return
        try:
            self._put(piece, self.size)
            self._put(self._encoder.head(), 0)
        except OSError:
            os.ftruncate(self._file.fileno(), self.size)
            raise
        self.size += len(piece)

    def close(self) -> None:
        """End the file; one that holds nothing is removed.

        Raises:
            OSError: the disk refuses even this; what was flushed stays.
        """
        with self._file:
            if not self.size:
                self.path.unlink(missing_ok=True)
            else:
                self._put(self._encoder.tail(), self.size)

    def _put(self, piece: bytes, at: int) -> None:
        left = memoryview(piece)
        while left:
            written = os.pwrite(self._file.fileno(), left, at)
            at += written
            left = left[written:]
