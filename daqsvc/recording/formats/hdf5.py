"""HDF5 files: a data set is a channel, by its path; nothing in the format states which are."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.recording.contents import NUMERIC, RATE_NAMES, Contents, check_columns, flattened, last_part
from daqsvc.recording.formats.extras import needed
from daqsvc.recording.rate import TIME_NAME, rate_of_step

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.confined.limits import Budget

STEPS = frozenset({"dt", "dt_s", "increment", "wf_increment", "sampling_interval", "sample_interval"})
"""Attributes that may state the time between two samples in seconds."""

UNITS = frozenset({"unit", "units", "unit_string"})
"""Attributes that may state the unit."""

_MOST_DIMENSIONS = 2


def read_hdf5(path: Path, budget: Budget, wanted: Collection[str] | None = None) -> Contents:
    """All numeric data sets of one or two dimensions that lie in the file; its own attributes as scalars.

    Args:
        path: the file.
        budget: of it.
        wanted: the channels whose samples are examined; None: all. Where others would take too much, zeros
            represent the largest, which take no memory.
    """
    # Before the library is loaded: no code is loaded to unpack what a file holds.
    os.environ["HDF5_PLUGIN_PRELOAD"] = "::"
    h5py = needed(path, "h5py", "h5py")
    with h5py.File(path, "r") as file:
        return _Tree(h5py, file, budget).read(wanted)


class _Tree:
    """The data sets of an open file.

    Args:
        h5py: the library.
        file: the file.
        budget: of it.
    """

    def __init__(self, h5py: Any, file: Any, budget: Budget) -> None:
        self._h5py = h5py
        self._file = file
        self._budget = budget
        self._sets: dict[str, Any] = {}
        file.visititems(self._visit)

    def _visit(self, name: str, item: Any) -> None:
        # Links to other files are not followed, and neither is what lies in them.
        if isinstance(item, self._h5py.Dataset):
            check_columns(len(self._sets) + 1)
            self._sets[name] = item

    def read(self, wanted: Collection[str] | None) -> Contents:
        """What they hold; see `read_hdf5`."""
        sets = {name: data for name, data in self._sets.items() if _is_read(data)}
        unread = set() if wanted is None else self._too_large(sets, wanted)
        self._budget.check_declared(
            sum(_declared_bytes(data) for name, data in sets.items() if name not in unread)
        )
        entries: dict[str, NDArray[np.generic]] = {}
        rates_hz: dict[str, float] = {}
        times: dict[str, str] = {}
        units: dict[str, str] = {}
        stand_ins: set[str] = set()
        for name, data in self._sets.items():
            if name not in sets:
                entries[name] = np.empty(1, dtype=object)
                continue
            attributes = _attributes(data)
            rate_hz = self._rate_hz(data, attributes)
            time = self._time(name, data)
            unit = next((value for key, value in attributes.items() if key.lower() in UNITS), None)
            if name in unread:
                values = np.broadcast_to(np.zeros((), data.dtype), data.shape)
            else:
                values = data[()]
                self._budget.spend(values.nbytes)
            check_columns(len(entries) + min(values.shape, default=0) * (values.ndim == _MOST_DIMENSIONS))
            for entry, column in _columns(name, values):
                entries[entry] = column
                if name in unread:
                    stand_ins.add(entry)
                if rate_hz is not None:
                    rates_hz[entry] = rate_hz
                if time is not None:
                    times[entry] = time
                if isinstance(unit, str) and column.ndim:
                    units[entry] = unit
        for key, value in _attributes(self._file).items():
            entries.setdefault(key, np.array(value))
        return Contents(entries, rates_hz=rates_hz, times=times, units=units, unread=frozenset(stand_ins))

    def _too_large(self, sets: Mapping[str, Any], wanted: Collection[str]) -> set[str]:
        """The largest of the data sets that are not wanted, so that the others fit in the budget."""
        kept = {
            name
            for name in sets
            if any(one == name or one.startswith((f"{name}[", f"{name}.")) for one in wanted)
        }
        kept |= {time for name in kept if (time := self._time(name, sets[name])) is not None}
        left, unread = self._budget.left_bytes - sum(map(_declared_bytes, sets.values())), set()
        for name in sorted(set(sets) - kept, key=lambda one: -_declared_bytes(sets[one])):
            if left >= 0:
                break
            left += _declared_bytes(sets[name])
            unread.add(name)
        return unread

    def _rate_hz(self, data: Any, own: Mapping[str, float | str]) -> float | None:
        """What a data set, or the groups that it lies in, states of its rate; the root is valid for all."""
        for attributes in (own, *map(_attributes, self._groups(data))):
            for key, value in attributes.items():
                if isinstance(value, float) and key.lower() in RATE_NAMES:
                    return value
                if isinstance(value, float) and key.lower() in STEPS:
                    return rate_of_step(value)
        return None

    def _groups(self, data: Any) -> Iterator[Any]:
        group = data.parent
        while group.name and group.name != "/":
            yield group
            group = group.parent

    def _time(self, name: str, data: Any) -> str | None:
        """The data set of times that goes with one: its dimension scale, or its neighbour."""
        if data.ndim and len(data.dims[0]):
            scale = data.dims[0][0].name.lstrip("/")
            if scale in self._sets and _is_time(self._sets[scale], data):
                return str(scale)
        folder = name.rpartition("/")[0]
        for other, one in self._sets.items():
            beside = other.rpartition("/")[0] == folder and other != name
            named = TIME_NAME.fullmatch(last_part(other))
            if beside and named and named["unit"] in {None, "s", "sec", "seconds"} and _is_time(one, data):
                return other
        return None


def _is_time(scale: Any, data: Any) -> bool:
    return bool(scale.ndim == 1 and scale.dtype.kind in NUMERIC and scale.shape[0] == max(data.shape or (0,)))


def _is_read(data: Any) -> bool:
    """Whether a data set is numbers that lie in this file."""
    kinds = [data.dtype[field].kind for field in data.dtype.names or ()] or [data.dtype.kind]
    text = data.dtype.kind in "SO" and data.ndim == 0
    foreign = data.is_virtual or data.external
    return (
        not foreign and data.ndim <= _MOST_DIMENSIONS and not text and all(kind in NUMERIC for kind in kinds)
    )


def _declared_bytes(data: Any) -> float:
    return float(data.size) * float(data.dtype.itemsize)


def _columns(name: str, values: NDArray[Any]) -> Iterator[tuple[str, NDArray[np.generic]]]:
    """A data set as entries: fields of records have dotted names."""
    if values.dtype.names is None:
        yield from flattened(name, values)
        return
    for field in values.dtype.names:
        column = values[field]
        # A stand-in, whose steps are 0, takes no memory as long as it is not copied.
        yield from flattened(
            f"{name}.{field}", np.ascontiguousarray(column) if any(column.strides) else column
        )


def _attributes(item: Any) -> dict[str, float | str]:
    """Single numbers and texts among the attributes of a group or data set."""
    attributes: dict[str, float | str] = {}
    for key in item.attrs:
        try:
            value = item.attrs[key]
        except (OSError, TypeError, ValueError):  # of a type that NumPy does not know
            continue
        array = np.squeeze(np.asarray(value))
        if array.ndim == 0 and array.dtype.kind in NUMERIC:
            attributes[key] = float(array)
        elif isinstance(value, str | bytes):
            attributes[key] = value if isinstance(value, str) else value.decode("utf-8", "replace")
    return attributes
