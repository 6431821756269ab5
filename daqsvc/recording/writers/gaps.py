"""What files have no way to state: missing samples, infinite ones, and two columns of one name."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.recording.streams import unique
from daqsvc.rounding import counted

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.recording.streams import RecordedStream


def filled(samples: NDArray[np.floating], kind: type[np.floating]) -> tuple[NDArray[np.floating], int]:
    """A copy with 0 in place of what is no finite number, or none of that kind.

    Returns:
        The copy; and how many of these values were no missing samples but infinite, or too large.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # float64 may be beyond float32; signalling NaN
        copy = np.array(samples, kind, order="C")
    bad = ~np.isfinite(copy)
    infinite = int(bad.sum() - np.isnan(samples).sum())
    copy[bad] = 0.0
    return copy, infinite


def notes_on_gaps(
    path: Path, streams: Sequence[RecordedStream], format_name: str, infinite: Sequence[int]
) -> list[str]:
    """The notes about values that are filled, a sentence for each stream and reason.

    Args:
        path: the file.
        streams: in it.
        format_name: of the file.
        infinite: for each stream, how many values `filled` replaced that were not missing.
    """
    notes = []
    for stream, count in zip(streams, infinite, strict=True):
        if missing := stream.missing():
            notes.append(
                f"{path.name}: stream {stream.name} lacks {counted(missing, 'sample')}, 0 in the file, as a "
                f"{format_name} file has no gaps"
            )
        if count:
            notes.append(
                f"{path.name}: stream {stream.name} has 0 in place of {counted(count, 'value')} that cannot "
                f"be written, as a {format_name} file holds finite numbers only"
            )
    return notes


def beside_times(path: Path, stream: RecordedStream, times: str) -> tuple[list[str], list[str]]:
    """Names of a stream's channels in a table whose times have a column of their own.

    Args:
        path: the file.
        stream: in it.
        times: what that column is called.

    Returns:
        The names; and what of them is not as it was, in sentences.
    """
    names = unique(stream.names, (times,))
    return names, [
        f"{path.name}: channel {old} of stream {stream.name} is the column {new}, as {times} is the time of "
        "each sample"
        for old, new in zip(stream.names, names, strict=True)
        if old != new
    ]
