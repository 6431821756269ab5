"""Missing samples in files that have no way to say so."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.recording.streams import RecordedStream


def filled(samples: NDArray[np.floating], kind: type[np.floating]) -> NDArray[np.floating]:
    """A copy with 0 in place of what is no finite number."""
    copy = np.array(samples, kind, order="C")
    copy[~np.isfinite(copy)] = 0.0
    return copy


def notes_on_gaps(path: Path, streams: Sequence[RecordedStream], format_name: str) -> list[str]:
    """What to say of gaps that are filled, a sentence for each stream with some."""
    return [
        f"{path.name}: {missing:,} samples of stream {stream.name} are missing and 0 there, as a "
        f"{format_name} file has no gaps"
        for stream in streams
        if (missing := stream.missing())
    ]
