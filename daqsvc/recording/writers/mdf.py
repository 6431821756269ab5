"""ASAM MDF 4: a channel group for each stream, as logger and test-bench software reads them."""

from __future__ import annotations

import logging
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from daqsvc.recording.streams import RecordedStream

VERSION, SUFFIX = "4.10", ".mf4"
_NS_PER_S = 1_000_000_000


def write_mdf(path: Path, streams: Sequence[RecordedStream], about: Mapping[str, str]) -> list[str]:
    """Write all streams; times are seconds from the begin of the first stream on; a missing sample is NaN.

    Returns:
        That the begin is not stated, which the file must have, or that it is before any that it can have.
    """
    import asammdf  # noqa: PLC0415 - an extra, and only this format needs it

    logging.getLogger("asammdf").disabled = True
    starts = [stream.start_ns for stream in streams if stream.start_ns is not None]
    begin_ns = min(starts, default=0)
    with asammdf.MDF(version=VERSION) as mdf:
        for group, stream in enumerate(streams):
            behind_s = 0.0 if stream.start_ns is None else (stream.start_ns - begin_ns) / _NS_PER_S
            rows = stream.piece_rows()
            for number, piece in enumerate(stream.pieces(rows)):
                first = number * rows
                times = behind_s + np.arange(first, first + len(piece)) / stream.rate_hz
                columns = [np.ascontiguousarray(column) for column in piece.T]
                if number:
                    mdf.extend(group, [(times, None), *((column, None) for column in columns)])
                    continue
                signals = [
                    asammdf.Signal(column, times, unit, name)
                    for column, name, unit in zip(columns, stream.names, stream.units, strict=True)
                ]
                mdf.append(
                    signals,
                    acq_name=stream.name,
                    comment=_comment(stream),
                    common_timebase=True,
                )
        since_1970_ns = max(begin_ns, 0)  # the header counts from there, without a sign
        mdf.start_time = datetime.fromtimestamp(since_1970_ns // _NS_PER_S, UTC)
        mdf.header.abs_time = since_1970_ns  # of which the date above has whole seconds only
        mdf.header.comment = "; ".join(f"{key}: {text}" for key, text in about.items())
        # Of whatever name asammdf makes one that ends in small letters.
        written = mdf.save(path.with_suffix(SUFFIX), overwrite=True)
    written.replace(path)
    if begin_ns < 0:
        return [f"{path.name}: begins in 1970, as no MDF file begins before"]
    return [] if starts else [f"{path.name}: begins in 1970, as the recording does not state when it began"]


def _comment(stream: RecordedStream) -> str:
    measured = "" if stream.measured_hz is None else f", {stream.measured_hz!r} Hz by the clock of the box"
    return f"stream {stream.name}, {stream.rate_hz!r} Hz{measured}"
