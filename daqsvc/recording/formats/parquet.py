"""Apache Parquet files: a channel a column."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.recording.contents import Contents, column_names
from daqsvc.recording.errors import RecordingError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

OF_LIBRARIES = frozenset({"pandas", "ARROW:schema"})
"""Metadata that libraries write for themselves."""


def read_parquet(path: Path) -> Contents:
    """Numeric columns with NaN for null, columns of dates, and the file's key-value metadata."""
    try:
        import pyarrow.parquet as pq  # noqa: PLC0415 - an extra, and only this format needs it
    except ModuleNotFoundError as error:
        raise RecordingError(
            f"{path} is a Parquet file, and reading it needs pyarrow; "
            "install it with: pip install 'daqsvc[parquet]'"
        ) from error
    with pq.ParquetFile(path, page_checksum_verification=True) as file:
        metadata = file.schema_arrow.metadata or {}
        table = file.read()
    entries = {
        name: _array(column)
        for name, column in zip(column_names(table.column_names), table.columns, strict=True)
    }
    for key, value in metadata.items():
        name, text = key.decode(), value.decode()
        if name not in OF_LIBRARIES:
            entries.setdefault(name, _scalar(text))
    return Contents(entries, is_table=True)


def _array(column: Any) -> NDArray[np.generic]:
    import pyarrow.types as kinds  # noqa: PLC0415 - see above

    kind = column.type
    if kinds.is_integer(kind) or kinds.is_floating(kind) or kinds.is_timestamp(kind):
        return np.asarray(column.to_numpy())
    return np.empty(len(column), dtype=object)


def _scalar(text: str) -> NDArray[np.generic]:
    try:
        return np.array(float(text))
    except ValueError:
        return np.array(text)
