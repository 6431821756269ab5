"""Recordings as a source of frames: what all of them have in common, and tables of samples.

A recording is read piece by piece, in a thread; each piece spans a short time, so that it can be played
at the pace at which it was recorded.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.confined.limits import ResourceLimits
from drivers.frames import DecodedBatch, DecodedFrames
from drivers.replay.table import TableError, read_columns

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.confined.process import ConfinedProcess
    from drivers.base import StreamSpec
    from drivers.replay.settings import TableLayout

PIECE_SAMPLES = 65_536
TABLE_COUNTER_BITS = 32
MOST_NAMED = 50
"""Columns that a message names."""


class RecordedLogError(Exception):
    """A recording cannot be read, or no longer; says the file, the reason and the remedy."""


class RecordedLog(Protocol):
    """An open recording; all calls come from one thread at a time."""

    @property
    def first_malformed(self) -> str:
        """The first line that was no frame, as a person should hear of it; empty while all are frames."""
        ...

    def read(self, span_ns: int) -> DecodedBatch | None:
        """The next piece: what was recorded within ``span_ns``, its arrivals in time of the recording.

        Returns:
            None at the end; an empty piece if there may be more later.

        Raises:
            RecordedLogError: the rest cannot be read.
        """
        ...

    def close(self) -> None:
        """Close the file."""
        ...


class SampleTable:
    """Samples in an NPZ file (an array per column) or a CSV file with a header; read into memory whole.

    Args:
        path: the file.
        specs: the streams; their layouts are `TableLayout`.
        first_index: where each stream's count of samples goes on, by name; kept up to date.
        limits: what reading the file may take.
        reader: reads it, and can be told to stop; unless given, one of its own.

    Attributes:
        seamless: whether all streams last as long: played again, it goes on without a step in time.

    Raises:
        RecordedLogError: the file cannot be read, a column is missing, or columns differ in length.
    """

    first_malformed = ""

    def __init__(
        self,
        path: Path,
        specs: Sequence[StreamSpec[TableLayout]],
        first_index: dict[str, int],
        limits: ResourceLimits | None = None,
        reader: ConfinedProcess | None = None,
    ) -> None:
        self._first_index = first_index
        wanted = [column.column for spec in specs for column in spec.layout.columns]
        table = _table(path, wanted, limits or ResourceLimits(), reader)
        self._streams: list[tuple[StreamSpec[TableLayout], NDArray[np.float32]]] = []
        for spec in specs:
            named = spec.layout.columns
            columns = [table[column.column] for column in named]
            if len({column.shape for column in columns}) > 1 or columns[0].ndim != 1:
                shapes = {n.column: list(c.shape) for n, c in zip(named, columns, strict=True)}
                raise RecordedLogError(
                    f"{path}: the columns of stream {spec.name!r} have the shapes {shapes}; "
                    "they must have one dimension and one length"
                )
            values = np.empty((len(columns[0]), len(columns)), np.float32)
            with np.errstate(over="ignore", invalid="ignore"):
                for i, column in enumerate(columns):
                    values[:, i] = column * named[i].scale + named[i].offset
            self._streams.append((spec, values))
        self._t_ns = 0
        self.seamless = len({len(values) / spec.rate_hz for spec, values in self._streams}) == 1

    def read(self, span_ns: int) -> DecodedBatch | None:
        """See `RecordedLog.read`; the recording begins at time 0."""
        rates = [spec.rate_hz for spec, _ in self._streams]
        # A short span may hold no sample of a slow stream, but must hold some of another.
        span_ns = max(span_ns, round(2 * NS_PER_S / max(rates)))
        span_ns = min(span_ns, round(PIECE_SAMPLES * NS_PER_S / max(rates)))
        end_ns = self._t_ns + span_ns
        found = DecodedBatch()
        left = False
        for spec, values in self._streams:
            first, last = (min(round(t * spec.rate_hz / NS_PER_S), len(values)) for t in (self._t_ns, end_ns))
            left = left or last < len(values)
            if last > first:
                found.frames[spec.name] = self._frames(spec, values, first, last)
        self._t_ns = end_ns
        if found.frames or left:
            return found
        for spec, values in self._streams:
            self._first_index[spec.name] = self._first_index.get(spec.name, 0) + len(values)
        return None

    def _frames(
        self, spec: StreamSpec[TableLayout], values: NDArray[np.float32], first: int, last: int
    ) -> DecodedFrames:
        row = np.arange(first, last)
        counter = (row + self._first_index.get(spec.name, 0)) % 2**TABLE_COUNTER_BITS
        t_ns = np.rint(row * (NS_PER_S / spec.rate_hz)).astype(np.int64)
        intact = np.ones(len(row), np.bool_)
        return DecodedFrames(counter, values[first:last, None, :], intact, t_ns)

    def close(self) -> None:
        """See `RecordedLog.close`."""
        self._streams = []


Kind = Literal["CAN log", "table"]


def kind_of(path: Path) -> Kind:
    """What a recording is, by its ending: ``.npz`` and ``.csv`` are tables, anything else a CAN log."""
    return "table" if path.suffix.lower() in {".npz", ".csv"} else "CAN log"


def words(error: BaseException) -> str:
    """What an error says, or its name if it says nothing."""
    return f"{error}" or type(error).__name__


def _table(
    path: Path, wanted: Sequence[str], limits: ResourceLimits, reader: ConfinedProcess | None
) -> dict[str, NDArray[np.float64]]:
    try:
        there, found = read_columns(path, wanted, limits, reader)
    except TableError as error:
        raise RecordedLogError(
            f"{path} cannot be read as a table of samples: {words(error)}; give an NPZ file with an array "
            "per column, or a CSV file of numbers with the columns' names in its first line"
        ) from error
    if missing := [name for name in wanted if name not in found]:
        shown = ", ".join(there[:MOST_NAMED]) + (
            f" and {len(there) - MOST_NAMED} more" * (len(there) > MOST_NAMED)
        )
        raise RecordedLogError(f"{path} has no column {missing[0]!r}; it has {shown}")
    return found
