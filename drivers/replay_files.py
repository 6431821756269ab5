"""Recordings as a source of frames: CAN logs of every format that python-can reads, and tables of samples.

A recording is read piece by piece, in a thread; each piece spans a short time, so that it can be played
at the pace at which it was recorded.
"""

from __future__ import annotations

import gzip
import io
import os
import re
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, Protocol

import can
import numpy as np
from can.io import MESSAGE_READERS
from can.io.canutils import CanutilsLogReader
from can.io.generic import BinaryIOMessageReader, TextIOMessageReader

from daqsvc.acquisition.clock import NS_PER_S
from drivers.can_batches import Sorted, StreamFrames
from drivers.can_errors import BUS_ERROR
from drivers.frames import Decoded

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from can.io.generic import MessageReader
    from numpy.typing import NDArray

    from drivers.base import StreamSpec

    Sort = Callable[[list[can.Message], NDArray[np.int64]], Sorted]

PIECE_FRAMES = 2048
PIECE_SAMPLES = 65_536
CHUNK_BYTES = 1 << 20
LONGEST_LINE = 4096
TABLE_COUNTER_BITS = 32


class RecordingError(Exception):
    """A recording cannot be read, or no longer; says the file, the reason and the remedy."""


class Recording(Protocol):
    """An open recording; all calls come from one thread at a time."""

    def read(self, span_ns: int) -> Sorted | None:
        """The next piece: what was recorded within ``span_ns``, its arrivals in time of the recording.

        Returns:
            None at the end; an empty piece if there may be more later.

        Raises:
            RecordingError: the rest cannot be read.
        """
        ...

    def close(self) -> None:
        """Close the file."""
        ...


@dataclass(frozen=True)
class ColumnLayout:
    """Samples as columns of a table.

    Attributes:
        channels: names of the channels, in the order of a sample.
        columns: name of each channel's column: of the CSV file's header, or of an array of the NPZ file.
        scale: physical value of one unit of the column, float64 ``[channels]``.
        offset: physical value of the column's zero, same shape.
    """

    channels: tuple[str, ...]
    columns: tuple[str, ...]
    scale: NDArray[np.float64]
    offset: NDArray[np.float64]

    def in_units(self, conversion: Mapping[str, tuple[float, float]]) -> ColumnLayout:
        """The same columns with each channel's value ``v`` turned into ``gain * v + shift``.

        Args:
            conversion: ``(gain, shift)`` by channel name; channels not named stay as they are.
        """
        pairs = [conversion.get(name, (1.0, 0.0)) for name in self.channels]
        gain = np.array([g for g, _ in pairs])
        shift = np.array([s for _, s in pairs])
        return replace(self, scale=self.scale * gain, offset=self.offset * gain + shift)


class CanLog:
    """A finished CAN log: ASC, BLF, candump, TRC, CSV or SQLite by its ending, gzipped or not.

    Args:
        path: the file.
        sort: sorts messages with their times to streams.

    Raises:
        RecordingError: the file cannot be opened, or is of no format that python-can reads.
    """

    def __init__(self, path: Path, sort: Sort) -> None:
        self._path = path
        self._sort = sort
        self._frames = 0
        self._files = ExitStack()
        try:
            self._reader = self._open()
        except Exception as error:
            self._files.close()
            raise RecordingError(
                f"{path} cannot be read as a CAN log: {words(error)}; give a file of a format that "
                "python-can reads, with its usual ending (.asc, .blf, .log, .trc; .gz behind it if zipped)"
            ) from error
        self._messages: Iterator[can.Message] = iter(self._reader)
        self._ahead: can.Message | None = None
        self._damage: RecordingError | None = None

    def _open(self) -> MessageReader:
        # Given only a path, python-can leaves a file open that it cannot make sense of.
        zipped = self._path.suffix.lower() == ".gz"
        reader = MESSAGE_READERS.get((self._path.with_suffix("") if zipped else self._path).suffix.lower())
        if reader is None or not issubclass(reader, TextIOMessageReader | BinaryIOMessageReader):
            return can.LogReader(self._path)  # of a plugin, a data base, or nothing at all
        mode: Literal["rt", "rb"] = "rt" if issubclass(reader, TextIOMessageReader) else "rb"
        opened = gzip.open(self._path, mode) if zipped else self._path.open(mode)  # noqa: SIM115 - by `_files`
        file: Any = self._files.enter_context(opened)
        if reader is CanutilsLogReader:
            file = _Candump(file)
        return reader(file)

    def read(self, span_ns: int) -> Sorted | None:
        """See `Recording.read`."""
        messages: list[can.Message] = []
        t_ns: list[int] = []
        while len(messages) < PIECE_FRAMES and self._damage is None:
            try:
                message = self._ahead or self._next()
            except RecordingError as error:
                self._damage = error  # for the next read, after what came before it
                break
            self._ahead = None
            if message is None:
                break
            at_ns = recorded_ns(message)
            if t_ns and at_ns - t_ns[0] > span_ns:
                self._ahead = message
                break
            messages.append(message)
            t_ns.append(at_ns)
        if self._damage is not None and not messages:
            raise self._damage
        return self._sort(messages, np.array(t_ns, np.int64)) if messages else None

    def _next(self) -> can.Message | None:
        try:
            message = next(self._messages, None)
            if message is None:
                return None
            _finite(message)
        except Exception as error:
            raise RecordingError(
                f"{self._path} is damaged behind frame {self._frames}: {words(error)}; "
                "the frames before that have been played"
            ) from error
        self._frames += 1
        return message

    def close(self) -> None:
        """See `Recording.close`."""
        with self._files:
            self._reader.stop()


class Place:
    """How far a growing log has been read; outlives its closing, so that nothing is read twice."""

    def __init__(self) -> None:
        self.file: tuple[int, int] | None = None
        self.offset = 0


class GrowingCandump:
    """A candump log that another process is writing, read as it grows; like ``tail -F``.

    Lines that are no frames are counted in ``frames_malformed`` and left out.

    Args:
        path: the file.
        sort: sorts messages with their times to streams.
        place: how far the file has been read before; kept up to date.

    Raises:
        RecordingError: the file cannot be opened.
    """

    def __init__(self, path: Path, sort: Sort, place: Place) -> None:
        self._path = path
        self._sort = sort
        self._place = place
        self._pending: list[can.Message] = []
        self._malformed = 0
        self._rest = b""
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise RecordingError(f"{path} cannot be opened: {error.strerror}") from error
        status = os.fstat(self._file.fileno())
        if place.file != (status.st_dev, status.st_ino) or place.offset > status.st_size:
            place.file, place.offset = (status.st_dev, status.st_ino), 0
        self._file.seek(place.offset)

    def read(self, span_ns: int) -> Sorted | None:
        """See `Recording.read`; never at the end.

        Raises:
            RecordingError: the file has been taken away, replaced or cut short, and what was in it is read.
        """
        if not self._pending:
            self._read_on()
        if not self._pending and not self._malformed:
            self._see_that_it_is_still_there()
        first_ns = recorded_ns(self._pending[0]) if self._pending else 0
        n = next(
            (k for k, m in enumerate(self._pending[:PIECE_FRAMES]) if recorded_ns(m) - first_ns > span_ns),
            min(len(self._pending), PIECE_FRAMES),
        )
        messages, self._pending = self._pending[:n], self._pending[n:]
        found = self._sort(messages, np.array([recorded_ns(m) for m in messages], np.int64))
        found.note("frames_malformed", self._malformed)
        self._malformed = 0
        return found

    def _read_on(self) -> None:
        try:
            chunk = self._file.read(CHUNK_BYTES)
        except OSError as error:
            raise RecordingError(f"{self._path} cannot be read: {error.strerror}") from error
        whole, newline, rest = (self._rest + chunk).rpartition(b"\n")
        if not newline and len(rest) > LONGEST_LINE:
            # No line of a log is as long: bound what is held for the end of one.
            whole, rest = rest, b""
        self._rest = rest
        self._place.offset = self._file.tell() - len(rest)
        if whole:
            self._pending, self._malformed = candump_messages(whole.decode("ascii", "replace"))

    def _see_that_it_is_still_there(self) -> None:
        try:
            status = self._path.stat()
        except OSError as error:
            raise RecordingError(f"{self._path} is gone: {error.strerror}") from error
        if (status.st_dev, status.st_ino) != self._place.file:
            raise RecordingError(f"{self._path} has been replaced by another file")
        if status.st_size < self._place.offset:
            raise RecordingError(f"{self._path} has been cut short")

    def close(self) -> None:
        """See `Recording.close`."""
        self._file.close()


class SampleTable:
    """Samples in an NPZ file (an array per column) or a CSV file with a header; read into memory whole.

    Args:
        path: the file.
        specs: the streams; their layouts are `ColumnLayout`.
        first_index: where each stream's count of samples goes on, by name; kept up to date.

    Raises:
        RecordingError: the file cannot be read, a column is missing, or columns differ in length.
    """

    def __init__(
        self, path: Path, specs: Sequence[StreamSpec[ColumnLayout]], first_index: dict[str, int]
    ) -> None:
        self._first_index = first_index
        wanted = [column for spec in specs for column in spec.layout.columns]
        table = _table(path, wanted)
        self._streams: list[tuple[StreamSpec[ColumnLayout], NDArray[np.float32]]] = []
        for spec in specs:
            columns = [table[name] for name in spec.layout.columns]
            if len({column.shape for column in columns}) > 1 or columns[0].ndim != 1:
                shapes = {n: list(c.shape) for n, c in zip(spec.layout.columns, columns, strict=True)}
                raise RecordingError(
                    f"{path}: the columns of stream {spec.name!r} have the shapes {shapes}; "
                    "they must have one dimension and one length"
                )
            with np.errstate(over="ignore", invalid="ignore"):
                values = np.stack(columns, axis=1) * spec.layout.scale + spec.layout.offset
                self._streams.append((spec, values.astype(np.float32)))
        self._t_ns = 0

    def read(self, span_ns: int) -> Sorted | None:
        """See `Recording.read`; the recording begins at time 0."""
        rates = [spec.rate_hz for spec, _ in self._streams]
        # A short span may hold no sample of a slow stream, but must hold some of another.
        span_ns = max(span_ns, round(2 * NS_PER_S / max(rates)))
        span_ns = min(span_ns, round(PIECE_SAMPLES * NS_PER_S / max(rates)))
        end_ns = self._t_ns + span_ns
        found = Sorted()
        left = False
        for spec, values in self._streams:
            first, last = (min(round(t * spec.rate_hz / NS_PER_S), len(values)) for t in (self._t_ns, end_ns))
            left = left or last < len(values)
            if last > first:
                found.frames.append(self._frames(spec, values, first, last))
        self._t_ns = end_ns
        if found.frames or left:
            return found
        for spec, values in self._streams:
            self._first_index[spec.name] = self._first_index.get(spec.name, 0) + len(values)
        return None

    def _frames(
        self, spec: StreamSpec[ColumnLayout], values: NDArray[np.float32], first: int, last: int
    ) -> StreamFrames:
        row = np.arange(first, last)
        counter = (row + self._first_index.get(spec.name, 0)) % 2**TABLE_COUNTER_BITS
        t_ns = np.rint(row * (NS_PER_S / spec.rate_hz)).astype(np.int64)
        intact = np.ones(len(row), np.bool_)
        return StreamFrames(spec.name, Decoded(counter, values[first:last, None, :], intact), t_ns)

    def close(self) -> None:
        """See `Recording.close`."""
        self._streams = []


Kind = Literal["CAN log", "table"]


def kind_of(path: Path) -> Kind:
    """What a recording is, by its ending: ``.npz`` and ``.csv`` are tables, anything else a CAN log."""
    return "table" if path.suffix.lower() in {".npz", ".csv"} else "CAN log"


def candump_messages(text: str) -> tuple[list[can.Message], int]:
    """The frames in lines of a candump log, and how many lines are none."""
    messages: list[can.Message] = []
    malformed = 0
    lines: Any = _Candump(io.StringIO(text))
    while True:
        try:
            # A reader that has given up on a line goes on with the next one.
            messages.extend(_finite(message) for message in CanutilsLogReader(lines))
        except Exception:  # noqa: BLE001 - python-can checks nothing: a bad line fails wherever it does
            malformed += 1
        else:
            return messages, malformed


class _Candump:
    """Lines of a candump log in which python-can knows every error frame as one, not only bus errors."""

    _ERROR_FRAME = re.compile(r" ([2367ABEF][0-9A-F]{7})#", re.IGNORECASE)

    def __init__(self, lines: io.TextIOBase) -> None:
        self._lines = lines
        self.close = lines.close

    def __iter__(self) -> Iterator[str]:
        return (self._ERROR_FRAME.sub(self._as_bus_error, line, count=1) for line in self._lines)

    @staticmethod
    def _as_bus_error(found: re.Match[str]) -> str:
        return f" {int(found[1], 16) | BUS_ERROR:08X}#"


def _finite(message: can.Message) -> can.Message:
    if not abs(message.timestamp) < 1e10:
        raise ValueError(f"time stamp {message.timestamp}")
    if len(message.data) > 64:
        raise ValueError(f"{len(message.data)} bytes of data")
    return message


def recorded_ns(message: can.Message) -> int:
    """When a message was recorded, to the microsecond that logs are written to."""
    return round(message.timestamp * 1e6) * 1000


def words(error: BaseException) -> str:
    """What an error says, or its name if it says nothing."""
    return f"{error}" or type(error).__name__


def _table(path: Path, wanted: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    try:
        if path.suffix.lower() == ".npz":
            with path.open("rb") as packed, np.load(packed, allow_pickle=False) as arrays:
                there = list(arrays.files)
                found = {name: np.asarray(arrays[name], np.float64) for name in wanted if name in there}
        else:
            with path.open(encoding="utf-8") as file:
                there = [name.strip().strip('"') for name in file.readline().split(",")]
                rows = np.loadtxt(file, delimiter=",", ndmin=2)
            found = {name: rows[:, there.index(name)] for name in wanted if name in there}
    except Exception as error:
        raise RecordingError(
            f"{path} cannot be read as a table of samples: {words(error)}; give an NPZ file with an array "
            "per column, or a CSV file of numbers with the columns' names in its first line"
        ) from error
    if missing := [name for name in wanted if name not in found]:
        raise RecordingError(f"{path} has no column {missing[0]!r}; it has {', '.join(there)}")
    return found
