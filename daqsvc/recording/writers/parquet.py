"""Apache Parquet: a column of time and one for each channel, read by pandas, Polars, DuckDB, Spark."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.recording.contents import MEASURED_RATE, STATED_RATE, STATED_START, STATED_UNIT
from daqsvc.recording.writers.gaps import beside_times

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from daqsvc.recording.streams import RecordedStream

GROUP_ROWS, GROUP_VALUES = 1 << 20, 1 << 22
"""Rows of a group, which is held in memory, and its samples times channels."""


def write_parquet(path: Path, streams: Sequence[RecordedStream], about: Mapping[str, str]) -> list[str]:
    """Write one stream.

    The column ``time`` is UTC with nanoseconds, or ``time_s`` from the first sample on where that time is
    not stated. Units are metadata of the columns, the rest of the file; a missing sample is NaN.

    Returns:
        Which channels are called otherwise, as the times have their name, in sentences.
    """
    import numpy as np  # noqa: PLC0415 - with the library that it goes to
    import pyarrow as pa  # noqa: PLC0415 - an extra, and only this format needs it
    import pyarrow.parquet as pq  # noqa: PLC0415

    (stream,) = streams
    metadata = {**about, "stream": stream.name, STATED_RATE: repr(stream.rate_hz)}
    if stream.measured_hz is not None:
        metadata[MEASURED_RATE] = repr(stream.measured_hz)
    if stream.start:
        metadata[STATED_START] = stream.start
    dated = stream.start_ns is not None
    kind = pa.from_numpy_dtype(stream.samples.dtype)
    time = pa.field("time", pa.timestamp("ns", tz="UTC")) if dated else pa.field("time_s", pa.float64())
    names, notes = beside_times(path, stream, time.name)
    fields = [
        pa.field(name, kind, metadata={STATED_UNIT: unit} if unit else None)
        for name, unit in zip(names, stream.units, strict=True)
    ]
    schema = pa.schema([time, *fields], metadata=metadata)
    with pq.ParquetWriter(
        path,
        schema,
        use_dictionary=False,
        column_encoding={"time": "DELTA_BINARY_PACKED"} if dated else None,
        write_page_checksum=True,
    ) as file:
        rows = min(GROUP_ROWS, stream.piece_rows(GROUP_VALUES))
        for number, piece in enumerate(stream.pieces(rows)):
            times_ns = stream.times_ns(number * rows, len(piece))
            times = pa.array(times_ns).cast(time.type) if dated else pa.array(times_ns / 1e9)
            columns = [pa.array(np.ascontiguousarray(column)) for column in piece.T]
            file.write_table(pa.Table.from_arrays([times, *columns], schema=schema), rows)
    return notes
