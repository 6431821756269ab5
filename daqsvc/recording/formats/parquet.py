"""Apache Parquet files: a channel a column."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.errors.command_line import EXTRA_MISSING
from daqsvc.recording import RecordingError
from daqsvc.recording.contents import STATED_UNIT, Contents, check_columns, column_names

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.confined.limits import Budget

OF_LIBRARIES = frozenset({"pandas", "ARROW:schema"})
"""Metadata that libraries write for themselves."""

_BATCH_ROWS = 1 << 20
_ITEM_BYTES = 8


def read_parquet(path: Path, budget: Budget) -> Contents:
    """Numeric columns with NaN for null, columns of dates, and the file's key-value metadata."""
    try:
        import pyarrow as pa  # noqa: PLC0415 - an extra, and only this format needs it
        import pyarrow.parquet as pq  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise RecordingError(
            f"{path} is a Parquet file, and reading it needs pyarrow; "
            "install it with: pip install 'daqsvc[parquet]'",
            EXTRA_MISSING,
        ) from error
    # More threads would take more memory, and no file is read by several.
    pa.set_cpu_count(1)
    pa.set_io_thread_count(1)
    with pq.ParquetFile(path, page_checksum_verification=True) as file:
        schema, rows = file.schema_arrow, file.metadata.num_rows
        check_columns(len(schema.names))
        is_read = [_is_read(kind) for kind in schema.types]
        budget.check_declared(_ITEM_BYTES * rows * sum(is_read))
        numbers = [i for i, wanted in enumerate(is_read) if wanted]
        pieces: list[list[Any]] = [[] for _ in numbers]
        wanted = None if len(set(schema.names)) < len(schema.names) else [schema.names[i] for i in numbers]
        for batch in file.iter_batches(_BATCH_ROWS, columns=wanted, use_threads=False):
            columns = batch.columns if wanted is not None else [batch.columns[i] for i in numbers]
            budget.spend(_ITEM_BYTES * len(batch) * len(columns))
            for piece, column in zip(pieces, columns, strict=True):
                piece.append(column)
    pieces.reverse()
    # Taken away one by one, so that a column is held twice and not the table.
    arrays_by_index = {i: _array(pa.chunked_array(pieces.pop(), schema.types[i])) for i in numbers}
    entries = {
        name: arrays_by_index[i] if i in arrays_by_index else np.empty(rows and 1, dtype=object)
        for i, name in enumerate(column_names(schema.names))
    }
    for key, value in (schema.metadata or {}).items():
        name, text = key.decode(), value.decode()
        if name not in OF_LIBRARIES:
            entries.setdefault(name, _scalar(text))
    units = {
        name: unit.decode()
        for name, field in zip(column_names(schema.names), schema, strict=True)
        if (unit := (field.metadata or {}).get(STATED_UNIT.encode()))
    }
    return Contents(entries, is_table=True, units=units)


def _is_read(kind: Any) -> bool:
    """Whether a column of a type is numbers or dates."""
    import pyarrow.types as kinds  # noqa: PLC0415 - see above

    return bool(kinds.is_integer(kind) or kinds.is_floating(kind) or kinds.is_timestamp(kind))


def _array(column: Any) -> NDArray[np.generic]:
    return np.asarray(column.to_numpy())


def _scalar(text: str) -> NDArray[np.generic]:
    try:
        return np.array(float(text))
    except ValueError:
        return np.array(text)
