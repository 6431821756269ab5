"""TDMS files, as LabVIEW and other software of NI write them: channels in groups, each with its rate."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.errors.recordings import DAMAGED
from daqsvc.recording import RecordingError
from daqsvc.recording.contents import Contents, check_columns, names_of_groups
from daqsvc.recording.formats.extras import needed
from daqsvc.recording.rate import rate_of_step

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.confined.limits import Budget

STEP = "wf_increment"
START = "wf_start_time"
UNIT = "unit_string"
"""Properties of a waveform channel."""

TAG = b"TDSm"
LEAD = struct.Struct("<4sIIQQ")
"""How a segment begins: tag, contents, version, and the bytes of all that follows and of its metadata."""

UNFINISHED = 2**64 - 1
"""Length of a segment whose writer did not come to an end."""

_ITEM_BYTES = 8


def read_tdms(path: Path, budget: Budget) -> Contents:
    """All channels, scaled as the file states, by their names; the file's properties as scalars and texts."""
    nptdms = needed(path, "nptdms", "nptdms")
    _check_segments(path, budget.file_bytes)
    # Open, as by its name the library would look for an index beside it, which may be of another file.
    with path.open("rb") as file, nptdms.TdmsFile.open(file) as tdms:
        channels = [(group.name, channel) for group in tdms.groups() for channel in group.channels()]
        check_columns(len(channels))
        names = names_of_groups([(group, channel.name) for group, channel in channels])
        budget.check_declared(float(_ITEM_BYTES) * sum(len(channel) for _, channel in channels))
        entries: dict[str, NDArray[np.generic]] = {}
        rates_hz, units = {}, {}
        start: Any = tdms.properties.get("DateTime")
        for name, (_, channel) in zip(names, channels, strict=True):
            entries[name] = _samples(channel, budget)
            properties: Mapping[str, Any] = channel.properties
            if isinstance(properties.get(STEP), float) and properties[STEP] > 0.0:
                rates_hz[name] = rate_of_step(properties[STEP])
            if isinstance(properties.get(UNIT), str):
                units[name] = properties[UNIT]
            start = properties.get(START, start)
    for name, value in tdms.properties.items():
        if isinstance(value, int | float | str):
            entries.setdefault(name, np.array(value))
    if isinstance(start, np.datetime64):
        entries.setdefault("start_time", np.array(f"{start}Z"))
    return Contents(entries, rates_hz=rates_hz, units=units)


def _check_segments(path: Path, file_bytes: int) -> None:
    """See whether the segments are as long as they state, as nptdms takes what is cut short for the whole.

    Raises:
        RecordingError: they are not.
    """
    at = 0
    with path.open("rb") as file:
        while at < file_bytes or not file_bytes:
            file.seek(at)
            head = file.read(LEAD.size)
            if len(head) < LEAD.size or head[:4] != TAG:
                raise RecordingError(
                    f"{path} cannot be read: {head[:4]!r} is at byte {at:,}, where a segment (TDSm) "
                    "belongs; copy or save it again",
                    DAMAGED,
                )
            _, _, _, after, metadata = LEAD.unpack(head)
            at += LEAD.size + after
            if after == UNFINISHED or at > file_bytes or metadata > after:
                raise RecordingError(
                    f"{path} cannot be read: a segment has not the length that it states; it is cut short, "
                    "or was not finished: copy or save it again",
                    DAMAGED,
                )


def _samples(channel: Any, budget: Budget) -> NDArray[np.generic]:
    """The samples; what holds no numbers stays unread."""
    if channel.dtype.kind not in "iufM":
        return np.empty(len(channel) and 1, dtype=object)
    samples = np.asarray(channel.read_data())
    budget.spend(samples.nbytes)
    return samples
