"""CSV: what cannot be a column is in lines that begin with ``#``; one header, then a row for each sample."""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.recording.contents import MEASURED_RATE, STATED_RATE, STATED_START
from daqsvc.recording.writers.gaps import beside_times

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.recording.streams import RecordedStream, Samples

PIECE_CELLS = 1 << 18
"""Samples times channels that are text in memory at once."""
SINGLE_DIGITS, DOUBLE_DIGITS = 9, 17
"""Digits that a float32 and a float64 can be got back from, bit by bit."""


def write_csv(path: Path, streams: Sequence[RecordedStream], about: Mapping[str, str]) -> list[str]:
    """Write one stream: UTF-8, commas, decimal points; a missing sample is ``nan``.

    Returns:
        Which channels are called otherwise, as the times have their name, in sentences.
    """
    (stream,) = streams
    dated = stream.start_ns is not None
    times = "time" if dated else "time_s"
    names, notes = beside_times(path, stream, times)
    with path.open("w", encoding="utf-8", newline="") as file:
        header = {**about, "stream": stream.name, STATED_RATE: f"{stream.rate_hz!r}"}
        if stream.measured_hz is not None:
            header[MEASURED_RATE] = f"{stream.measured_hz!r}"
        if stream.start:
            header[STATED_START] = stream.start
        for key, text in header.items():
            file.write(f"# {key} = {' '.join(text.split())}\n")
        for name, unit in zip(names, stream.units, strict=True):
            if unit:
                file.write(f"# unit of {' '.join(name.split())} = {unit}\n")
        csv.writer(file, lineterminator="\n").writerow([times, *names])
        digits = SINGLE_DIGITS if stream.samples.dtype == np.float32 else DOUBLE_DIGITS
        row = ",".join(["%s", *[f"%.{digits}g"] * len(names)]) + "\n"
        rows = stream.piece_rows(PIECE_CELLS)
        for number, piece in enumerate(stream.pieces(rows)):
            times_ns = stream.times_ns(number * rows, len(piece))
            file.write(_rows(row, _written(times_ns) if dated else (times_ns / 1e9).astype(str), piece))
    return notes


def _written(times_ns: NDArray[np.int64]) -> NDArray[np.str_]:
    return np.char.add(np.datetime_as_string(times_ns.astype("datetime64[ns]")), "Z")


def _rows(row: str, times: NDArray[np.str_], piece: Samples) -> str:
    """All rows by one formatting, as one for each would take several times as long."""
    cells = np.empty((len(piece), 1 + piece.shape[1]), object)
    cells[:, 0], cells[:, 1:] = times, piece
    return (row * len(piece)) % tuple(cells.ravel().tolist())
