"""Recordings: channels of a file, taken together at a fixed rate."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from daqsvc.recording.contents import NUMERIC
from daqsvc.recording.errors import RecordingError
from daqsvc.recording.formats import read
from daqsvc.recording.rate import rate_of, time_column

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from daqsvc.recording.contents import Contents

    Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Recording:
    """Samples of one or more channels, taken together at a fixed rate.

    Attributes:
        names: of the channels.
        samples: float64 ``[n, channels]``, in the units of the file.
        rate_hz: samples per second.
        source: the file.
        nan_count: how many of the samples are NaN.
        infinity_count: how many are infinite.
        left_out: channels of another length that were not asked for by name, with their lengths.
        rate_source: where ``rate_hz`` comes from, in words: given, stated by the file, or derived from
            a column of time.
        scalars: the single numbers of the file, e.g. ``{"RPM": 1797.0}``.
        texts: its single texts, e.g. ``{"label": "healthy"}``.
    """

    names: tuple[str, ...]
    samples: Floats
    rate_hz: float
    source: Path
    nan_count: int
    infinity_count: int = 0
    left_out: Mapping[str, int] = field(default_factory=dict)
    rate_source: str = "given"
    scalars: Mapping[str, float] = field(default_factory=dict)
    texts: Mapping[str, str] = field(default_factory=dict)


def load_recording(
    path: Path | str, channels: Mapping[str, str] | None = None, rate_hz: float | None = None
) -> Recording:
    """Read channels from an ``.npz``, ``.mat`` (up to v7), ``.csv[.gz]``, ``.wav`` or ``.parquet`` file.

    In the file a channel is named by its variable (``X105_DE_time``), the field of a struct
    (``bearing.gs``), a column of a matrix (``data[2]``), the header or number from 0 of a table's column,
    or the number from 0 of a WAV file's channel.

    Integer samples of WAV files are scaled so that full scale is 1; all others stay as they are.

    Args:
        path: the file.
        channels: what each channel is called from now on, and what it is called in the file. Unless
            given: every channel in the file that is as long as the longest one, under its own name; a
            column of time is none.
        rate_hz: samples per second. Unless given: what the file says under one of `rate.RATE_NAMES`, or
            else what follows from a column of time, even steps provided (`rate.time_column`).

    Raises:
        RecordingError: the file cannot be read, a channel is not there, not numeric or empty, the
            channels have different lengths, or the rate is not known or outside of
            `channels.LEAST_RATE_HZ` to `channels.MOST_RATE_HZ`.
    """
    path = Path(path)
    contents = read(path)
    left_out: dict[str, int] = {}
    if not channels:
        channels, left_out = _longest(path, contents)
    columns = {name: _channel(path, contents, variable) for name, variable in channels.items()}
    length = _common_length(path, columns, channels)
    rate_hz, rate_source = rate_of(path, contents, length, rate_hz)
    samples = np.column_stack(list(columns.values()))
    return Recording(
        names=tuple(columns),
        samples=samples,
        rate_hz=rate_hz,
        source=path,
        nan_count=int(np.isnan(samples).sum()),
        infinity_count=int(np.isinf(samples).sum()),
        left_out=left_out,
        rate_source=rate_source,
        scalars=contents.scalars(),
        texts=contents.texts(),
    )


def list_channels(path: Path | str) -> dict[str, int]:
    """What can be loaded from a file: the number of samples of each numeric channel, by name.

    Raises:
        RecordingError: the file cannot be read.
    """
    vectors = read(Path(path)).vectors()
    return {name: len(values) for name, values in vectors.items() if len(values) > 1}


def _longest(path: Path, contents: Contents) -> tuple[dict[str, str], dict[str, int]]:
    """Channels as long as the longest under their own names, and the lengths of the others."""
    lengths = {name: len(values) for name, values in contents.vectors().items() if len(values) > 1}
    longest = max(lengths.values(), default=0)
    time = time_column(contents, longest)
    channels = {name: name for name, length in lengths.items() if length == longest and name != time}
    if not channels:
        numeric = any(values.dtype.kind in NUMERIC for values in contents.entries.values())
        why = "is too short: no channel has two samples" if numeric else "holds no numeric channel"
        if time is not None:
            why = f"holds no channel beside its time column {time!r}"
        raise RecordingError(f"{path} {why}; it holds {contents.listing()}")
    return channels, {name: length for name, length in lengths.items() if length < longest}


def _channel(path: Path, contents: Contents, variable: str) -> Floats:
    entries = contents.entries
    if (
        contents.is_table
        and variable not in entries
        and variable.isascii()
        and variable.isdecimal()
        and int(variable) < len(entries)
    ):
        variable = list(entries)[int(variable)]
    holds = f"it holds {contents.listing()}"
    if variable not in entries:
        raise RecordingError(f"{path} has no channel {variable!r}; {holds}")
    values = entries[variable]
    if values.dtype.kind not in NUMERIC:
        raise RecordingError(f"{variable!r} of {path} is not numeric; {holds}")
    if values.ndim != 1 or not len(values):
        what = {0: "a single number", 1: "empty"}.get(values.ndim, f"{values.ndim}-dimensional")
        raise RecordingError(f"{variable!r} of {path} is {what}, not a channel; {holds}")
    with np.errstate(invalid="ignore"):  # signalling NaN
        return values.astype(np.float64)


def _common_length(path: Path, columns: Mapping[str, Floats], channels: Mapping[str, str]) -> int:
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        stated = ", ".join(f"{name} ({channels[name]}) {length}" for name, length in lengths.items())
        raise RecordingError(
            f"the channels of {path} have different lengths: {stated}; map only channels taken together"
        )
    length = next(iter(lengths.values()))
    if length < 2:
        raise RecordingError(f"{path} is too short: it holds one sample a channel; give a longer recording")
    return length
