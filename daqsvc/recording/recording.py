"""Recordings: channels of a file, taken together at a fixed rate."""

from __future__ import annotations

import fnmatch
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from daqsvc.confined.limits import ResourceLimits
from daqsvc.confined.process import ConfinedError, RaisedThereError, shared
from daqsvc.errors.recordings import DAMAGED, NO_SUCH_CHANNEL, TOO_LARGE
from daqsvc.errors.table import CODES
from daqsvc.recording import NamesError, RecordingError
from daqsvc.recording.formats import find
from daqsvc.recording.streams import RecordedStream

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from daqsvc.confined.process import ConfinedProcess, WorkResult

    Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Recording:
    """Samples of one or more channels, taken together at a fixed rate.

    Attributes:
        names: of the channels.
        samples: float64 ``[n, channels]``, in the units of the file; float32 where that was asked for.
        rate_hz: samples per second.
        source: the file.
        nan_count: how many of the samples are NaN.
        infinity_count: how many are infinite.
        left_out: channels of another length that were not asked for by name, with their lengths.
        rate_source: where ``rate_hz`` comes from, in words: given, stated by the file, or derived from
            a column of time.
        scalars: the single numbers of the file, e.g. ``{"RPM": 1797.0}``.
        texts: its single texts, e.g. ``{"label": "healthy"}``.
        notes: what a person should know of how it was read, in sentences.
        units: of the channels that the file names one of, as it spells them.
        of_other_rates: for channels that were taken at another rate why they are not read, which notes state.
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
    notes: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    of_other_rates: Mapping[str, str] = field(default_factory=dict)


class _ReadingLimits:
    """How recordings are read by this process."""

    limits = ResourceLimits()


def set_limits(limits: ResourceLimits) -> None:
    """State what reading one recording may take, from now on.

    Args:
        limits: of the process that reads them.
    """
    _ReadingLimits.limits = limits


def set_memory(memory_bytes: int | None) -> None:
    """What ``--max-memory`` states; None leaves it as it is."""
    if memory_bytes is not None:
        set_limits(ResourceLimits(memory_bytes))


def get_limits() -> ResourceLimits:
    """What reading one recording may take."""
    return _ReadingLimits.limits


def load_recording(
    path: Path | str,
    channels: Mapping[str, str] | None = None,
    rate_hz: float | None = None,
    *,
    narrow: bool = False,
) -> Recording:
    """Read channels from a file of one of the kinds of `formats.READERS`.

    In the file a channel is named by its variable (``X105_DE_time``), the field of a struct
    (``bearing.gs``) or a column of a matrix (``data[2]``). In a table it is named by its header or its
    number from 0. In a WAV file it is named by its number from 0, in an HDF5 file by the path of the data
    set (``run/accel``).

    The file is read in a separate process, within the limits of `set_limits`: what is damaged or hostile
    costs that process at most. Samples that are missing by a column of time are NaN.

    Integer samples of WAV files are scaled so that full scale is 1; all others stay as they are.

    Args:
        path: the file.
        channels: what each channel is called from now on, and what it is called in the file. Unless
            given: every channel in the file that is as long as the longest one, under its own name; a
            column of time is none.
        rate_hz: samples per second. Unless given: what the file states under one of `rate.RATE_NAMES`, or
            else what follows from a column of time, even steps provided (`rate.time_column`). A rate that
            contradicts what the file states is refused.
        narrow: for who looks at the samples piece by piece: they stay in float32 where that holds each as it
            is in the file, and in a file if they are many (`daqsvc.confined.spilled`). Who asks for it
            calculates with them in float64 all the same.

    Raises:
        RecordingError: the file cannot be read within the limits. Or a channel is not there, not numeric,
            empty, or has impossible values. Or the channels have different lengths, or the rate is not known,
            contradicted, or outside of `rate.LEAST_RATE_HZ` to `rate.MOST_RATE_HZ`.
    """
    path = Path(path)
    about, (samples,) = _there(
        "load",
        path,
        {
            "channels": None if channels is None else dict(channels),
            "rate_hz": rate_hz,
            "narrow": narrow,
        },
        spill=narrow,
    )
    about["names"], about["notes"] = tuple(about["names"]), tuple(about["notes"])
    return Recording(samples=samples, source=path, **about)


def load_all(
    path: Path | str, channels: Mapping[str, str] | None = None, rate_hz: float | None = None
) -> tuple[list[RecordedStream], list[str]]:
    """Read all channels of a file, at each rate that it has.

    Args:
        path: the file, see `load_recording`.
        channels: what some channels are called from now on, and what they are called in the file; others keep
            their names.
        rate_hz: see `load_recording`.

    Returns:
        The streams, the longest first, large ones in files instead of in memory; and notes as in `Recording`.
        A stream that the file does not name has its name.

    Raises:
        NamesError: two channels would have one name, or one of them two.
        RecordingError: see `load_recording`.
    """
    path = Path(path)
    about, samples = _there(
        "load_all",
        path,
        {"channels": None if channels is None else dict(channels), "rate_hz": rate_hz},
        spill=True,
    )
    streams = [
        RecordedStream(
            name=one["name"] or path.name.partition(".")[0],
            rate_hz=one["rate_hz"],
            names=tuple(one["names"]),
            units=tuple(one["units"]),
            samples=taken,
            start_ns=one["start_ns"],
        )
        for one, taken in zip(about["streams"], samples, strict=True)
    ]
    return streams, about["notes"]


def load_streams(
    path: Path,
    streams: Sequence[tuple[Mapping[str, str], float]],
    limits: ResourceLimits,
    reader: ConfinedProcess,
) -> list[tuple[Floats, Sequence[str]]]:
    """Read the channels of several streams out of one file, each at a rate that is known.

    Args:
        path: the file, see `load_recording`.
        streams: for each stream its channels, see `load_recording`, and its samples per second. Streams may
            last for different times, the channels of one may not.
        limits: what reading the file may take.
        reader: the process that reads it; it is left as it is.

    Returns:
        For each stream its samples, float64 ``[n, channels]`` in the units of the file, and notes as in
        `Recording`. Samples that are missing by a column of time are NaN. Where the file states another rate
        a note states it.

    Raises:
        RecordingError: see `load_recording`; but for the rate.
    """
    notes, samples = _there("load_streams", path, {"streams": list(streams)}, limits, reader)
    return list(zip(samples, notes, strict=True))


def list_channels(path: Path | str, expected: Sequence[str] = ()) -> dict[str, int]:
    """What can be loaded from a file: the number of samples of each numeric channel, by name.

    Args:
        path: the file.
        expected: names that are channels if the file has them.

    Raises:
        RecordingError: the file cannot be read, or has one that is expected, and it is no channel.
    """
    lengths: dict[str, int] = _there("channels_of", Path(path), {"expected": list(expected)}).document
    return lengths


def load_matching(
    path: Path | str, channels: Mapping[str, str], rate_hz: float | None = None, *, narrow: bool = False
) -> Recording:
    """The same; a channel that the file does not have may be a pattern, or what one of its names ends with.

    Raises:
        RecordingError: see `load_recording` and `matching`.
    """
    try:
        return load_recording(path, channels, rate_hz, narrow=narrow)
    except RecordingError:
        there = list_channels(path)
        paths = {name: matching(path, variable, there) for name, variable in channels.items()}
        if paths == channels:
            raise
    return load_recording(path, paths, rate_hz, narrow=narrow)


def matching(path: Path | str, variable: str, there: Iterable[str]) -> str:
    """The channel of a file that a name means, or a pattern, or what only one of the names there ends with.

    Sets of recordings often number their variables: ``DE_time`` is ``X105_DE_time`` in one file and
    ``X106_DE_time`` in the next.

    Args:
        path: the file.
        variable: what is meant.
        there: the channels of the file.

    Returns:
        The channel; ``variable`` itself if there is none.

    Raises:
        RecordingError: several may be meant.
    """
    matches = [one for one in there if one.endswith(variable) or fnmatch.fnmatchcase(one, variable)]
    if not matches or variable in matches:
        return variable
    if len(matches) > 1:
        raise RecordingError(
            f"{path} has several channels that may be {variable!r}: {', '.join(matches)}; name one of them",
            NO_SUCH_CHANNEL,
        )
    return matches[0]


def stop_reading() -> None:
    """End the process that reads recordings; the next recording begins another."""
    shared.close()


def _there(
    function: str,
    path: Path,
    arguments: Mapping[str, Any],
    limits: ResourceLimits | None = None,
    reader: ConfinedProcess = shared,
    *,
    spill: bool = False,
) -> WorkResult:
    """Call a function of `daqsvc.recording.loading` about a file in the process that reads.

    Raises:
        RecordingError: the file cannot be read.
    """
    _, file_bytes = find(path)
    limits = limits or get_limits()
    try:
        return reader.call(
            f"daqsvc.recording.loading:{function}",
            {"path": str(path), "memory_bytes": limits.memory_bytes, **arguments},
            memory_bytes=limits.memory_bytes,
            cpu_s=limits.cpu_s(file_bytes),
            spill=spill,
        )
    except RaisedThereError as error:
        for known in (RecordingError, NamesError):
            if error.kind == known.__name__:
                raise known(error.message, CODES.get(error.code, DAMAGED)) from None
        raise RecordingError(
            f"{path} cannot be read: {error}; it may be damaged: copy or save it again", DAMAGED
        ) from None
    except ConfinedError as error:
        remedy = "it is damaged: copy or save it again"
        if error.reason != "crash":
            remedy = f"if it is not that large, it is damaged: {remedy.partition(': ')[2]}"
        if error.reason == "memory":
            remedy = (
                f"allow more (--max-memory, or max_memory_gb of a replayed bus; it is "
                f"{limits.memory_bytes / 1e9:.3g} GB), or {remedy}"
            )
        raise RecordingError(f"{path} cannot be read: {error.how}; {remedy}", TOO_LARGE) from None
