"""CAN logs of every format that python-can reads, as recordings.

What python-can does not look at in a BLF file is seen here: that its end is one, and how large its
containers get.
"""

from __future__ import annotations

import gzip
import io
import struct
import zlib
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Final, cast

import can
import numpy as np
from can.io import MESSAGE_READERS, ASCReader, BLFReader, SqliteReader
from can.io.blf import (
    LOG_CONTAINER,
    LOG_CONTAINER_STRUCT,
    NO_COMPRESSION,
    OBJ_HEADER_BASE_STRUCT,
    ZLIB_DEFLATE,
)
from can.io.generic import BinaryIOMessageReader, TextIOMessageReader

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.confined.limits import UNBOUNDED, Budget, CountedFile
from drivers.replay.files import RecordedLogError, words
from drivers.replay.lines import TextLog, whole

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path
    from typing import BinaryIO

    from can.io.generic import MessageReader
    from numpy.typing import NDArray

    from drivers.frames import DecodedBatch

    Sort = Callable[[list[can.Message], NDArray[np.int64]], DecodedBatch]


PIECE_FRAMES = 512
STEP_BACK_NS = 2 * NS_PER_S
"""Logs of several interfaces may step back a little; more than that is a leap in time."""

_CHANNELS_FROM_0: Final = (ASCReader, BLFReader)
"""Readers that give the channels that a file calls 1, 2, ... as 0, 1, ..."""


class CanLog:
    """A finished CAN log: ASC, BLF, candump or TRC by its ending, gzipped or not, or a plugin's.

    The channel of a message is what the file calls it, as text; None where the file names none.

    Args:
        path: the file.
        sort: sorts messages with their times to streams.

    Raises:
        RecordedLogError: the file cannot be opened, or is of no format that can be played.
    """

    def __init__(self, path: Path, sort: Sort) -> None:
        self._path = path
        self._sort = sort
        self._frames = 0
        self._malformed = 0
        self._text: TextLog | None = None
        self._files = ExitStack()
        try:
            self._messages = self._open()
        except Exception as error:
            self._files.close()
            raise RecordedLogError(
                f"{path} cannot be read as a CAN log: {words(error)}; give a file of a format that "
                "python-can reads, with its usual ending (.asc, .blf, .log, .trc; .gz behind it if zipped)"
            ) from error
        self._ahead: can.Message | None = None
        self._damage: RecordedLogError | None = None

    @property
    def first_malformed(self) -> str:
        """See `drivers.replay.files.RecordedLog.first_malformed`."""
        if self._text is None or not self._text.malformed:
            return ""
        return f"line {self._text.first_malformed_at}, {self._text.first_malformed}"

    def _open(self) -> Iterator[can.Message]:
        if not self._path.is_file():
            raise ValueError(
                "it is no file but a folder, pipe or device"
                if self._path.exists()
                else "there is no such file"
            )
        zipped = self._path.suffix.lower() == ".gz"
        reader = MESSAGE_READERS.get((self._path.with_suffix("") if zipped else self._path).suffix.lower())
        if reader is SqliteReader:
            raise ValueError("a data base cannot be played, can_logconvert of python-can makes a BLF of it")
        self._first_channel = int(reader in _CHANNELS_FROM_0)
        if reader is not None and issubclass(reader, TextIOMessageReader):
            # Whatever the bytes are, they are text: what is no frame is counted, and no reason to end.
            text = io.TextIOWrapper(self._open_bytes(zipped=zipped), encoding="utf-8", errors="replace")
            self._text = TextLog(text, reader)
            return iter(self._text)
        opened: MessageReader
        if reader is not None and issubclass(reader, BinaryIOMessageReader):
            # Given only a path, python-can leaves a file open that it cannot make sense of.
            file = self._open_bytes(zipped=zipped)
            if reader is BLFReader:
                file = BlfFile(file, Budget(self._path.stat().st_size, UNBOUNDED))
            opened = reader(cast("BinaryIO", file))
        else:
            opened = can.LogReader(self._path)  # of a plugin, or of nothing at all
        self._files.callback(opened.stop)
        return iter(opened)

    def _open_bytes(self, *, zipped: bool) -> Any:
        if zipped:
            unpacked = self._files.enter_context(gzip.GzipFile(self._path))
            budget = Budget(self._path.stat().st_size, UNBOUNDED)
            return io.BufferedReader(CountedFile(cast("BinaryIO", unpacked), budget))
        return self._files.enter_context(self._path.open("rb"))

    def read(self, span_ns: int) -> DecodedBatch | None:
        """See `drivers.replay.files.RecordedLog.read`."""
        messages: list[can.Message] = []
        t_ns: list[int] = []
        while len(messages) < PIECE_FRAMES and self._damage is None:
            try:
                message = self._ahead or self._next()
            except RecordedLogError as error:
                self._damage = error  # for the next read, after what came before it
                break
            self._ahead = None
            if message is None:
                break
            at_ns = recorded_ns(message)
            if t_ns and (at_ns - t_ns[0] > span_ns or at_ns < t_ns[-1] - STEP_BACK_NS):
                self._ahead = message
                break
            messages.append(message)
            t_ns.append(at_ns)
        malformed = 0 if self._text is None else self._text.malformed
        if not messages and malformed == self._malformed:
            if self._damage is not None:
                raise self._damage
            return None
        decoded = self._sort(messages, np.array(t_ns, np.int64))
        decoded.note("frames_malformed", malformed - self._malformed)
        self._malformed = malformed
        return decoded

    def _next(self) -> can.Message | None:
        try:
            message = next(self._messages, None)
            if message is None:
                return None
            whole(message)
        except Exception as error:
            if not self._frames:
                raise RecordedLogError(
                    f"{self._path} is damaged from its first frame on: {words(error)}; none can be read"
                ) from error
            raise RecordedLogError(
                f"{self._path} is damaged behind frame {self._frames}: {words(error)}; "
                "the frames before that have been played"
            ) from error
        self._frames += 1
        if message.channel is not None:
            channel = message.channel
            message.channel = str(channel + self._first_channel if isinstance(channel, int) else channel)
        return message

    def close(self) -> None:
        """See `drivers.replay.files.RecordedLog.close`."""
        self._files.close()


def recorded_ns(message: can.Message) -> int:
    """When a message was recorded, to the microsecond that logs are written to."""
    return round(message.timestamp * 1e6) * 1000


LARGEST_OBJECT = 64_000_000
"""Bytes of an object in a file; writers begin a new container after some 100 kB."""

_LONGEST_PADDING = 3


class BlfFile:
    """A BLF file as python-can's reader reads it, piece by piece.

    python-can takes a file that is cut in the middle of an object for whole, and unpacks a container whatever
    it grows to. Here the former is an error, and containers come unpacked, as far as the budget goes.

    Args:
        file: open for binary reading.
        budget: of the file.
    """

    def __init__(self, file: Any, budget: Budget) -> None:
        self.close = file.close
        self._file = file
        self._budget = budget
        self._cut = False
        self._in_container = False

    def read(self, length: int) -> bytes:
        """The next bytes; of a container, what it unpacks to.

        Raises:
            EOFError: the file ends in the middle of an object.
            ValueError: an object is too large.
            zlib.error: a container is damaged.
        """
        if length > LARGEST_OBJECT:
            raise ValueError(f"an object claims to have {length:,} bytes")
        data: bytes = self._file.read(length)
        if length <= _LONGEST_PADDING:
            return data
        if self._cut and not data:
            raise EOFError("it ends in the middle of a container")
        # What there is of the last object may hold frames yet.
        self._cut = 0 < len(data) < length
        if self._in_container:
            self._in_container = False
            return self._unpacked(data)
        self._in_container = _is_header_of_container(data, length)
        return data

    def _unpacked(self, data: bytes) -> bytes:
        if len(data) < LOG_CONTAINER_STRUCT.size:
            return data
        method, size = LOG_CONTAINER_STRUCT.unpack_from(data)
        if method != ZLIB_DEFLATE:
            return data
        unpacked = zlib.decompressobj().decompress(
            data[LOG_CONTAINER_STRUCT.size :], self._budget.left_bytes + 1
        )
        self._budget.spend(len(unpacked))
        return LOG_CONTAINER_STRUCT.pack(NO_COMPRESSION, size) + unpacked


def _is_header_of_container(data: bytes, length: int) -> bool:
    if length != OBJ_HEADER_BASE_STRUCT.size or len(data) < length:
        return False
    try:
        signature, *_, kind = OBJ_HEADER_BASE_STRUCT.unpack(data)
    except struct.error:
        return False
    return bool(signature == b"LOBJ" and kind == LOG_CONTAINER)
