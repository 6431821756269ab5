"""ASAM MDF 4 files, as loggers of vehicles and test benches write them: groups of channels over one time."""

from __future__ import annotations

import logging
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.errors.recordings import DAMAGED, UNKNOWN_FORMAT
from daqsvc.recording import RecordingError
from daqsvc.recording.contents import GROUP_TIME, STATED_START, Contents, check_columns, names_of_groups
from daqsvc.recording.formats.extras import needed
from daqsvc.recording.formats.mdf_structure import FORMULA, check_mdf_structure
from daqsvc.recording.streams import ns_of_iso

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.confined.limits import Budget

FINISHED = b"MDF     4."
UNFINISHED = b"UnFinMF "
"""How files begin."""

_TIME = 1
"""Kind of a master channel that holds seconds, and not angles or distances."""

_ITEM_BYTES = 8
_NS_PER_S = 1_000_000_000


def read_mdf(path: Path, budget: Budget) -> Contents:
    """All numeric channels in physical units, NaN where they are invalid; their times are entries, too."""
    with path.open("rb") as file:
        magic = file.read(len(FINISHED))
    if magic.startswith(UNFINISHED):
        raise RecordingError(
            f"{path} cannot be read: the logger has not finished it; finish it with the logger's software",
            DAMAGED,
        )
    if magic != FINISHED:
        raise RecordingError(
            f"{path} is not an MDF 4 file: it begins with {magic!r}; save it as MDF 4, or give it the suffix "
            "of what it is",
            UNKNOWN_FORMAT,
        )
    asammdf = needed(path, "asammdf", "asammdf")
    check_mdf_structure(path, budget)
    logging.getLogger("asammdf").disabled = True
    with asammdf.MDF(path, process_bus_logging=False) as mdf:
        return _Groups(mdf, budget).read()


class _Groups:
    """The channel groups of an open file.

    Args:
        mdf: the file.
        budget: of it.
    """

    def __init__(self, mdf: Any, budget: Budget) -> None:
        self._mdf = mdf
        self._budget = budget
        groups = list(mdf.groups)
        self._channels = [
            (g, i, channel)
            for g, group in enumerate(groups)
            for i, channel in enumerate(group.channels)
            if i != mdf.masters_db.get(g)
        ]
        check_columns(len(self._channels))
        counts = [max(0, int(group.channel_group.cycles_nr)) for group in groups]
        items = sum(counts[g] for g, _, _ in self._channels) + sum(counts)
        budget.check_declared(float(_ITEM_BYTES) * items)
        self._labels = [
            (group.channel_group.acq_name or f"group {g}").strip() for g, group in enumerate(groups)
        ]

    def read(self) -> Contents:
        """What they hold."""
        names = names_of_groups([(self._labels[g], channel.name) for g, _, channel in self._channels])
        entries: dict[str, NDArray[np.generic]] = {}
        times: dict[str, str] = {}
        units: dict[str, str] = {}
        for name, (g, i, channel) in zip(names, self._channels, strict=True):
            # A formula of the file's would be evaluated.
            formula = channel.conversion is not None and channel.conversion.conversion_type == FORMULA
            entries[name] = np.empty(1, dtype=object) if formula else self._samples(g, i)
            if channel.unit:
                units[name] = channel.unit
        for g, label in enumerate(self._labels):
            mine = [name for name, (group, _, _) in zip(names, self._channels, strict=True) if group == g]
            master = self._mdf.masters_db.get(g)
            if not mine or master is None:
                continue
            if self._mdf.groups[g].channels[master].sync_type == _TIME:
                time = f"{GROUP_TIME}{label}"
                time = time if time not in entries else f"{GROUP_TIME}group {g}"
                entries[time] = np.asarray(self._mdf.get_master(g), np.float64)
                times |= dict.fromkeys(mine, time)
        start = self._start()
        entries.setdefault(STATED_START, np.array(start))
        starts_ns = {}
        if (start_ns := ns_of_iso(start)) is not None:
            firsts_s = {time: float(entries[time][0]) for time in times.values() if len(entries[time])}
            known_ns = {
                time: start_ns + round(s * _NS_PER_S) for time, s in firsts_s.items() if np.isfinite(s)
            }
            starts_ns = {name: known_ns.get(time, start_ns) for name, time in times.items()}
        return Contents(entries, times=times, units=units, starts_ns=starts_ns)

    def _start(self) -> str:
        """When the recording began, with the nanoseconds that a date of Python's has not."""
        start, abs_ns = self._mdf.header.start_time, int(self._mdf.header.abs_time)
        whole = datetime(1970, 1, 1, tzinfo=start.tzinfo or UTC) + timedelta(seconds=abs_ns // _NS_PER_S)
        if start.tzinfo is not None:
            whole += start.utcoffset()
        zone = start.isoformat()[len("2026-01-31T12:00:00") :].lstrip(".0123456789")
        return f"{whole:%Y-%m-%dT%H:%M:%S}.{abs_ns % _NS_PER_S:09d}{zone}"

    def _samples(self, group: int, index: int) -> NDArray[np.generic]:
        samples, invalid = self._mdf.get(
            group=group, index=index, samples_only=True, ignore_invalidation_bits=True
        )
        if samples.dtype.kind not in "iuf" or samples.ndim != 1:
            return np.empty(len(samples) and 1, dtype=object)
        self._budget.spend(samples.nbytes)
        if invalid is not None and np.any(invalid):
            samples = samples.astype(np.float64)
            samples[np.asarray(invalid, np.bool_)] = np.nan
        return np.asarray(samples)
