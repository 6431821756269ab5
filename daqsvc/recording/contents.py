"""What a file of any format holds, before anybody has chosen channels."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from daqsvc.confined.limits import TooLargeError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

NUMERIC = "iuf"
"""Kinds of dtype that samples may have: integers and floats."""


MOST_LISTED = 50
"""Entries of a file that a message names."""

STATED_RATE, STATED_START, STATED_UNIT = "fs_hz", "start_time", "unit"
"""How files of `daqsvc export` call rate, begin and unit of their samples."""
MEASURED_RATE = "rate_measured_hz"
"""The rate by the clock of the box, which is not the rate that samples are counted by."""
GROUP_TIME = "time of "
"""In front of a group's name, the name of its time."""
WAV_SCHEMA: Literal["daqsvc.wav/1"] = "daqsvc.wav/1"
"""Of the comment in its WAV files."""

LONGEST_NAME = 80
"""Characters of a name in a message."""

LONGEST_TEXT = 1000
"""Characters of a text that are kept."""

MOST_COLUMNS = 4096
"""Channels that a file may have."""


def check_columns(count: int) -> None:
    """See whether a file may have so many channels.

    Raises:
        TooLargeError: it may not.
    """
    if count > MOST_COLUMNS:
        raise TooLargeError(
            f"it has {count:,} columns or variables, and at most {MOST_COLUMNS:,} are read; give the "
            "channels only"
        )


RATE_NAMES = frozenset(
    {"fs", "fs_hz", "sr", "rate_hz", "samplerate", "sample_rate", "sample_rate_hz", "sampling_rate"}
)
"""Names under which a file may state its sampling rate in Hz."""
_STATED_ELSEWHERE = {*RATE_NAMES, STATED_START}


@dataclass(frozen=True, slots=True)
class Elsewhere:
    """A channel that a file holds beside those of its `Contents`, as it was not taken together with them.

    Attributes:
        why: what is reported behind the channel and the file, where it cannot be had together with others.
        read: makes the contents that have it.
    """

    why: str
    read: Callable[[], Contents]


@dataclass(frozen=True, slots=True)
class Contents:
    """Everything in a file by name, in the file's order.

    Attributes:
        entries: arrays; one dimension is a channel, none a scalar or a text.
        is_table: the first entries are columns that may also be called by their number from 0.
        has_header: the file names its columns; without a header their names are their numbers.
        rates_hz: samples per second of single channels, by their names.
        times: for single channels the entry that holds the time of each sample, in seconds or as dates.
        units: of single channels, as the file spells them.
        starts_ns: wall time of the first sample of single channels, ns since the Unix epoch, where the file
            states one for each.
        elsewhere: channels that are not among the entries, by their names.
        notes: what is wrong with the file, in sentences.
        of_other_rates: for channels that are not among the entries why, e.g. "sampled at 10 Hz, ...".
        unread: entries that have their length and zeros for samples, as they are too large and are not
            wanted.
    """

    entries: Mapping[str, NDArray[np.generic]]
    is_table: bool = False
    has_header: bool = True
    rates_hz: Mapping[str, float] = field(default_factory=dict)
    times: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    starts_ns: Mapping[str, int] = field(default_factory=dict)
    elsewhere: Mapping[str, Elsewhere] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    of_other_rates: Mapping[str, str] = field(default_factory=dict)
    unread: frozenset[str] = frozenset()

    def holding(self, names: Iterable[str]) -> Contents:
        """The contents that have all channels of these names, as far as any has; else these."""
        names = list(names)
        there = next((self.elsewhere[one] for one in names if one in self.elsewhere), None)
        if there is None:
            return self
        other = there.read()
        return other if all(one in other.entries for one in names) else self

    def vectors(self) -> dict[str, NDArray[np.generic]]:
        """Numeric entries of one dimension, of any length."""
        return {
            name: values
            for name, values in self.entries.items()
            if values.ndim == 1 and values.dtype.kind in NUMERIC
        }

    def scalars(self) -> dict[str, float]:
        """Single numbers, e.g. a speed or a sampling rate."""
        return {
            name: float(value)
            for name, value in self.entries.items()
            if value.ndim == 0 and value.dtype.kind in NUMERIC
        }

    def texts(self) -> dict[str, str]:
        """Single texts, e.g. a label."""
        return {
            name: str(value)[:LONGEST_TEXT]
            for name, value in self.entries.items()
            if value.ndim == 0 and value.dtype.kind == "U"
        }

    def listing(self) -> str:
        """What the file holds, in words, but for what it states of its rate and begin."""
        lines = [
            _in_words(name, values)
            for name, values in self.entries.items()
            if values.ndim or last_part(name).lower() not in _STATED_ELSEWHERE
        ]
        if len(lines) > MOST_LISTED:
            lines[MOST_LISTED:] = [f"and {len(lines) - MOST_LISTED} more"]
        return ", ".join(lines) or "nothing"


def _in_words(name: str, values: NDArray[np.generic]) -> str:
    if not name.isprintable():
        name = ascii(name)
    if len(name) > LONGEST_NAME:
        name = f"{name[:LONGEST_NAME]}..."
    if values.ndim > 1:
        return f"{name} ({values.ndim}-D)"
    if values.dtype.kind in NUMERIC and values.size and values.ndim:
        return f"{name} ({len(values)})"
    if values.ndim and values.dtype.kind not in NUMERIC:
        return f"{name} (not numeric)"
    return name if values.ndim == 0 else f"{name} (0)"


def left_out(of_other_rates: Mapping[str, str]) -> list[str]:
    """The notes about channels that are not read, in sentences; see `Contents.of_other_rates`."""
    by_reason: dict[str, list[str]] = {}
    for name, why in of_other_rates.items():
        by_reason.setdefault(why, []).append(name)
    return [f"{', '.join(names)} left out: {why}" for why, names in by_reason.items()]


def column_names(headers: Sequence[str]) -> list[str]:
    """A name for each column: its header, or its number if it has none or shares it with one before."""
    first = {header: i for i, header in reversed(list(enumerate(headers)))}
    return [
        header if header and first[header] == i else str(i) if str(i) not in first else f"column {i}"
        for i, header in enumerate(headers)
    ]


def last_part(name: str) -> str:
    """The name of an entry without the groups, folders or structs that it lies in."""
    return re.split(r"[./]", name)[-1]


def names_of_groups(names: Sequence[tuple[str, str]]) -> list[str]:
    """A name for each channel of a file with groups: with the group's before it where several share it.

    Args:
        names: of the group and the channel, for each channel.
    """
    count = Counter(channel for _, channel in names)
    labels = [
        channel if channel and count[channel] == 1 else f"{group}/{channel}" for group, channel in names
    ]
    return column_names(labels)


def flattened(name: str, value: object) -> Iterator[tuple[str, NDArray[np.generic]]]:
    """A variable as entries: structs as dotted names, matrices column by column along their longer side."""
    fields = getattr(value, "_fieldnames", None)
    if fields is not None:
        for field in fields:
            yield from flattened(f"{name}.{field}", getattr(value, field))
        return
    array = np.squeeze(np.asarray(value))
    if array.ndim == 2:
        columns = array.T if array.shape[0] >= array.shape[1] else array
        yield from ((f"{name}[{i}]", column) for i, column in enumerate(columns))
    else:
        yield name, array
