"""Recordings as a source of frames: what all of them have in common, and tables of samples.

A recording is read piece by piece, in a thread; each piece spans a short time, so that it can be played
at the pace at which it was recorded.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.confined.limits import ResourceLimits
from daqsvc.confined.process import ConfinedProcess
from daqsvc.errors.buses import NOT_PLAYABLE
from daqsvc.recording import RecordingError
from daqsvc.recording.recording import load_streams
from drivers.frames import DecodedBatch, DecodedFrames

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from drivers.base import StreamSpec
    from drivers.replay.settings import TableLayout

PIECE_SAMPLES = 65_536
TABLE_COUNTER_BITS = 32


class RecordedLogError(Exception):
    """A recording cannot be read, or no longer; states the file, the reason and the remedy."""

    code = NOT_PLAYABLE


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
    """Samples of any file that `daqsvc.recording` reads; read into memory whole.

    Args:
        path: the file.
        specs: the streams; their layouts are `TableLayout`.
        first_index: where each stream's count of samples goes on, by name; kept up to date.
        limits: what reading the file may take.
        reader: reads it, can be stopped, and is closed then; unless given, one of its own.

    Attributes:
        seamless: whether all streams last as long: played again, it goes on without a step in time.
        notes: what a person should know of how it was read, in sentences.

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
        wanted = [({one.name: one.column for one in spec.layout.columns}, spec.rate_hz) for spec in specs]
        try:
            with reader or ConfinedProcess() as process:
                loaded = load_streams(path, wanted, limits or ResourceLimits(), process)
        except RecordingError as error:
            raise RecordedLogError(f"{error}") from error
        self.notes = dict.fromkeys(note for _, notes in loaded for note in notes)
        self._streams: list[tuple[StreamSpec[TableLayout], NDArray[np.float32]]] = []
        for spec in specs:
            samples, _ = loaded.pop(0)  # so that they and the values need not all be held at once
            values = np.empty(samples.shape, np.float32)
            with np.errstate(over="ignore", invalid="ignore"):
                for i, column in enumerate(spec.layout.columns):
                    values[:, i] = samples[:, i] * column.scale + column.offset
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
        batch = DecodedBatch()
        left = False
        for spec, values in self._streams:
            first, last = (min(round(t * spec.rate_hz / NS_PER_S), len(values)) for t in (self._t_ns, end_ns))
            left = left or last < len(values)
            if last > first:
                batch.frames[spec.name] = self._frames(spec, values, first, last)
        self._t_ns = end_ns
        if batch.frames or left:
            return batch
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


def words(error: BaseException) -> str:
    """What an error reports, or its name if it states nothing."""
    return f"{error}" or type(error).__name__
