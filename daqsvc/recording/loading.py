"""What is done with a file where it is read: in a separate process, as it may be damaged or hostile.

`daqsvc.recording.recording` calls these there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from daqsvc.confined.limits import ResourceLimits
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.quality.unit import refuse_beyond_any_unit
from daqsvc.errors.recordings import NO_SUCH_CHANNEL, NOT_TOGETHER, TOO_SHORT
from daqsvc.recording import NamesError, RecordingError
from daqsvc.recording.contents import GROUP_TIME, NUMERIC, STATED_START, left_out
from daqsvc.recording.formats import read
from daqsvc.recording.rate import place_at, time_column, timing_of
from daqsvc.recording.streams import FIRST_NS, LAST_NS, NS_PER_S, iso_ns, ns_of_iso

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.recording.contents import Contents

    Floats: TypeAlias = NDArray[np.float64]
    Samples: TypeAlias = NDArray[np.float64] | NDArray[np.float32]


def load(
    path: str,
    channels: Mapping[str, str] | None,
    rate_hz: float | None,
    memory_bytes: int,
    *,
    narrow: bool = False,
) -> tuple[dict[str, Any], tuple[Samples]]:
    """Read channels; arguments as of `daqsvc.recording.recording.load_recording`.

    Returns:
        The fields of a `daqsvc.recording.recording.Recording` but its samples and source; and the samples.

    Raises:
        RecordingError: see there.
    """
    file = Path(path)
    named = bool(channels)
    wanted = list((channels or {}).values())
    contents = read(file, ResourceLimits(memory_bytes), wanted if named else None).holding(wanted)
    shorter: dict[str, int] = {}
    if not channels:
        channels, shorter = _longest(file, contents)
    columns, length = _channels(file, contents, channels)
    in_file = [_variable(contents, variable) for variable in channels.values()]
    timing = timing_of(file, contents, length, rate_hz, in_file)
    about: dict[str, Any] = {
        "names": list(columns),
        "rate_hz": timing.rate_hz,
        "left_out": shorter,
        "rate_source": timing.source,
        "notes": [*contents.notes, *left_out(contents.of_other_rates), *timing.notes],
        "of_other_rates": dict(contents.of_other_rates),
        "scalars": contents.scalars(),
        "texts": contents.texts(),
        "units": {
            name: contents.units[variable]
            for name, variable in zip(columns, in_file, strict=True)
            if variable in contents.units
        },
    }
    begins = _Begins.of(contents, in_file, timing.rate_hz)
    if begins.shifts and FIRST_NS <= begins.latest_ns <= LAST_NS:
        about["texts"][STATED_START] = iso_ns(begins.latest_ns)
    del contents
    samples = begins.aligned(file, _together(columns, length, timing.rows, narrow=narrow))
    if named:  # what was not asked for may be anything, e.g. a time in nanoseconds
        _refuse_impossible(file, list(channels), samples)
    about["nan_count"], about["infinity_count"] = _count_bad(samples)
    return about, (samples,)


def load_all(
    path: str,
    channels: Mapping[str, str] | None,
    rate_hz: float | None,
    memory_bytes: int,
) -> tuple[dict[str, Any], list[Samples]]:
    """Read all channels, those of each rate and length together.

    Args:
        path: the file.
        channels: what some channels are called from now on, and what they are called in the file.
        rate_hz: see `daqsvc.recording.recording.load_recording`.
        memory_bytes: what may be taken.

    Returns:
        ``streams``, for each its ``name`` (empty if the file has none), ``names``, ``units``, ``rate_hz`` and
        ``start_ns`` (None if the file states none); ``notes`` on what is wrong; and the samples of each.

    Raises:
        NamesError: see there.
        RecordingError: see there.
    """
    file = Path(path)
    contents = read(file, ResourceLimits(memory_bytes), list(channels.values()) if channels else None)
    notes = list(contents.notes)
    if unread := contents.unread:
        notes.append(f"left out {', '.join(sorted(unread))}: too large to be read")
        there = {name: values for name, values in contents.entries.items() if name not in unread}
        contents = replace(contents, entries=there)
    called = _called(file, contents, channels or {})
    groups = _groups(file, contents)
    streams: list[dict[str, Any]] = []
    loaded: list[Samples] = []
    for name, members in groups.items():
        columns = {called.get(one, one): contents.entries[one] for one in members}
        length = len(contents.entries[members[0]])
        try:
            timing = timing_of(file, contents, length, rate_hz, members)
        except RecordingError as error:
            if not streams and name == list(groups)[-1]:
                raise
            notes.append(f"left out {', '.join(members)} ({length:,} samples): {error}")
            continue
        notes += timing.notes
        units = [contents.units.get(one, "") for one in members]
        facts = {"name": name, "names": list(columns), "units": units, "rate_hz": timing.rate_hz}
        streams.append({**facts, "start_ns": _start_ns(contents, members, length)})
        loaded.append(_together(columns, length, timing.rows, narrow=True))
    return {"streams": streams, "notes": notes}, loaded


def _called(path: Path, contents: Contents, channels: Mapping[str, str]) -> dict[str, str]:
    """What channels are called from now on, by their names in the file.

    Raises:
        NamesError: a channel would have two names, or one that another has.
        RecordingError: one is not there.
    """
    called: dict[str, str] = {}
    for name, variable in channels.items():
        _channel(path, contents, variable)
        one = _variable(contents, variable)
        if one in called:
            raise NamesError(
                f"{one} of {path} cannot be both {called[one]} and {name}: map it once", NO_SUCH_CHANNEL
            )
        called[one] = name
    there = _lengths(contents)
    for one, name in called.items():
        if name in there and name not in called:
            raise NamesError(
                f"{one} of {path} cannot be called {name}, as another channel of the file is: give it its "
                f"own name, or map that, too: --map {name}={one},OTHER={name}",
                NO_SUCH_CHANNEL,
            )
    return called


def _groups(path: Path, contents: Contents) -> dict[str, list[str]]:
    """Channels that have one time and begin, by the name of their group; the longest group first."""
    lengths = _lengths(contents)
    by_timing: dict[tuple[str, float, int | None, int], list[str]] = {}
    for name, length in lengths.items():
        rate_hz, start_ns = contents.rates_hz.get(name, 0.0), contents.starts_ns.get(name)
        by_timing.setdefault((contents.times.get(name, ""), rate_hz, start_ns, length), []).append(name)
    groups: dict[str, list[str]] = {}
    for (times, rate_hz, _, length), members in sorted(by_timing.items(), key=lambda one: -one[0][3]):
        time = None if times else time_column(contents, length)
        there = [name for name in members if name != time]
        if not there:
            continue
        label = times.removeprefix(GROUP_TIME) if times.startswith(GROUP_TIME) else ""
        label = (
            label or (f"{rate_hz:g}-hz" if rate_hz else f"{length}-samples") if len(by_timing) > 1 else label
        )
        groups[label if label not in groups else f"{label}-{len(groups) + 1}"] = there
    if not groups:
        _longest(path, contents)  # states what there is instead
        raise RecordingError(f"{path} holds no channel; it holds {contents.listing()}", NO_SUCH_CHANNEL)
    return groups


def _start_ns(contents: Contents, members: Sequence[str], length: int) -> int | None:
    """Wall time of the first sample: by a column of dates, or by what the file states of its begin.

    Where it states one for each stream, that of these channels and no other; but for the groups of an MDF
    file that have no time, which begin with the file.
    """
    if contents.starts_ns and (members[0] in contents.starts_ns or not contents.times):
        return contents.starts_ns.get(members[0])
    stated = ns_of_iso(contents.texts().get(STATED_START, ""))
    times = contents.times.get(members[0])
    if times is not None and stated is not None and contents.entries[times].dtype.kind == "f":
        first_s = float(contents.entries[times][0])
        return stated + round(first_s * 1e9) if np.isfinite(first_s) else stated
    dates = [
        values
        for values in contents.entries.values()
        if values.dtype.kind == "M" and values.ndim == 1 and len(values) == length and not np.isnat(values[0])
    ]
    if dates:
        # In two parts, as nanoseconds hold no date of the year 9999.
        second = dates[0][0].astype("datetime64[s]")
        part_ns = (dates[0][0] - second).astype("timedelta64[ns]").astype(np.int64)
        return int(second.astype(np.int64)) * NS_PER_S + int(part_ns)
    return stated


@dataclass(frozen=True, slots=True)
class _Begins:
    """When channels begin that are taken together.

    Attributes:
        shifts: for each channel, samples that it has before the one that begins last; empty if none has any.
        latest_ns: wall time of that begin, ns since the Unix epoch.
    """

    shifts: tuple[int, ...] = ()
    latest_ns: int = 0

    @classmethod
    def of(cls, contents: Contents, in_file: Sequence[str], rate_hz: float) -> _Begins:
        """The begins of channels by their names in the file; those that state none begin with the others."""
        known = {name: contents.starts_ns[name] for name in in_file if name in contents.starts_ns}
        if not known:
            return cls()
        latest_ns = max(known.values())
        shifts = tuple(
            round((latest_ns - known.get(name, latest_ns)) * rate_hz / NS_PER_S) for name in in_file
        )
        return cls(shifts if any(shifts) else (), latest_ns)

    def aligned(self, path: Path, samples: Any) -> Any:
        """Samples ``[n, channels]`` from the last begin on, to where the first channel ends.

        Raises:
            RecordingError: the channels have no time in common.
        """
        if not self.shifts:
            return samples
        length = len(samples) - max(self.shifts)
        if length < 2:
            raise RecordingError(
                f"the channels of {path} were not taken at the same time: one begins after another has "
                "ended; map only channels taken together",
                NOT_TOGETHER,
            )
        for column, shift in enumerate(self.shifts):
            samples[:length, column] = samples[shift : shift + length, column]
        return samples[:length]


def load_streams(
    path: str, streams: Sequence[tuple[Mapping[str, str], float]], memory_bytes: int
) -> tuple[list[Sequence[str]], list[Floats]]:
    """Read the channels of several streams; see `daqsvc.recording.recording.load_streams`.

    Returns:
        Notes on each stream; and its samples.

    Raises:
        RecordingError: see there.
    """
    file = Path(path)
    wanted = [variable for channels, _ in streams for variable in channels.values()]
    whole = read(file, ResourceLimits(memory_bytes), wanted)
    notes: list[Sequence[str]] = []
    loaded: list[Floats] = []
    for channels, rate_hz in streams:
        contents = whole.holding(channels.values())
        columns, length = _channels(file, contents, channels)
        in_file = [_variable(contents, variable) for variable in channels.values()]
        rows, noted = place_at(file, contents, length, rate_hz, in_file)
        samples = _Begins.of(contents, in_file, rate_hz).aligned(file, _together(columns, length, rows))
        _refuse_impossible(file, list(channels), samples)
        notes.append([*contents.notes, *left_out(contents.of_other_rates), *noted])
        loaded.append(samples)
    return notes, loaded


def channels_of(path: str, expected: Sequence[str], memory_bytes: int) -> tuple[dict[str, int], tuple[()]]:
    """See `daqsvc.recording.recording.list_channels`.

    Raises:
        RecordingError: see there.
    """
    file = Path(path)
    contents = read(file, ResourceLimits(memory_bytes), ())
    for name in expected:
        if name in contents.entries or name in contents.elsewhere:
            _channels(file, contents, {name: name})
    return _lengths(contents), ()


def _lengths(contents: Contents) -> dict[str, int]:
    """The samples of each entry that may be a channel."""
    times = set(contents.times.values())
    return {
        name: len(values)
        for name, values in contents.vectors().items()
        if len(values) > 1 and name not in times
    }


def _longest(path: Path, contents: Contents) -> tuple[dict[str, str], dict[str, int]]:
    """Channels as long as the longest under their own names, and the lengths of the others."""
    lengths = _lengths(contents)
    longest = max(lengths.values(), default=0)
    time = time_column(contents, longest)
    channels = {name: name for name, length in lengths.items() if length == longest and name != time}
    if not channels:
        numeric = any(values.dtype.kind in NUMERIC for values in contents.entries.values())
        why, code = "holds no numeric channel", NO_SUCH_CHANNEL
        if time is not None:
            why = f"holds no channel beside its time column {time!r}"
        elif numeric:
            why, code = "is too short: no channel has two samples", TOO_SHORT
        raise RecordingError(f"{path} {why}; it holds {contents.listing()}", code)
    return channels, {name: length for name, length in lengths.items() if length < longest}


def _channels(
    path: Path, contents: Contents, channels: Mapping[str, str]
) -> tuple[dict[str, NDArray[np.generic]], int]:
    """The channels by the names that they are given, and their length."""
    columns = {name: _channel(path, contents, variable) for name, variable in channels.items()}
    return columns, _common_length(path, columns, channels)


def _variable(contents: Contents, variable: str) -> str:
    """The entry that a name means: of a table's columns their numbers do, too."""
    entries = contents.entries
    if (
        contents.is_table
        and variable not in entries
        and variable.isascii()
        and variable.isdecimal()
        and len(variable) < 9
        and int(variable) < len(entries)
    ):
        return list(entries)[int(variable)]
    return variable


def _channel(path: Path, contents: Contents, variable: str) -> NDArray[np.generic]:
    entries = contents.entries
    variable = _variable(contents, variable)
    holds = f"it holds {contents.listing()}"
    if variable not in entries and variable in contents.elsewhere:
        raise RecordingError(f"{variable} of {path} {contents.elsewhere[variable].why}", NO_SUCH_CHANNEL)
    if variable not in entries:
        raise RecordingError(f"{path} has no channel {variable!r}; {holds}", NO_SUCH_CHANNEL)
    values = entries[variable]
    if values.dtype.kind not in NUMERIC:
        raise RecordingError(f"{variable!r} of {path} is not numeric; {holds}", NO_SUCH_CHANNEL)
    if values.ndim != 1 or not len(values):
        what = {0: "a single number", 1: "empty"}.get(values.ndim, f"{values.ndim}-dimensional")
        raise RecordingError(f"{variable!r} of {path} is {what}, not a channel; {holds}", NO_SUCH_CHANNEL)
    return values


def _common_length(
    path: Path, columns: Mapping[str, NDArray[np.generic]], channels: Mapping[str, str]
) -> int:
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        stated = ", ".join(f"{name} ({channels[name]}) {length}" for name, length in lengths.items())
        longest = [name for name, length in lengths.items() if length == max(lengths.values())]
        example = f", such as {' and '.join(longest)}" if len(longest) > 1 else ""
        raise RecordingError(
            f"the channels of {path} have different lengths: {stated}; map only channels taken "
            f"together{example}",
            NOT_TOGETHER,
        )
    length = next(iter(lengths.values()))
    if length < 2:
        raise RecordingError(
            f"{path} is too short: it holds one sample a channel; give a longer recording", TOO_SHORT
        )
    return length


def _together(
    columns: dict[str, NDArray[np.generic]],
    length: int,
    rows: NDArray[np.int64] | None,
    *,
    narrow: bool = False,
) -> Any:
    """The samples ``[n, channels]``; NaN in the rows that no sample has its place in.

    Takes the columns away as it goes, so that they and the samples need not all be held at once.

    Args:
        columns: the channels.
        length: of each.
        rows: the places of the samples; None: one behind the other.
        narrow: float32 where that holds every sample as it is, else float64.
    """
    total = length if rows is None else int(rows[-1]) + 1
    single = narrow and all(np.can_cast(column.dtype, np.float32) for column in columns.values())
    if single and rows is None and len(columns) == 1:
        return next(iter(columns.values())).astype(np.float32, copy=False).reshape(-1, 1)
    samples = np.full((total, len(columns)), np.nan, np.float32 if single else np.float64)
    place: slice | NDArray[np.int64] = slice(None) if rows is None else rows
    for i, name in enumerate(list(columns)):
        with np.errstate(invalid="ignore"):  # signalling NaN
            samples[place, i] = columns.pop(name)
    return samples


def _refuse_impossible(path: Path, names: list[str], samples: Samples) -> None:
    for name, signal in zip(names, samples.T, strict=True):
        try:
            refuse_beyond_any_unit(signal, f"{name} of {path}")
        except UnfitError as error:
            raise RecordingError(f"{error}", error.code) from None


def _count_bad(samples: Samples) -> tuple[int, int]:
    """How many samples are NaN, and how many infinite, counted channel by channel to save memory."""
    nan = sum(int(np.isnan(column).sum()) for column in samples.T)
    return nan, sum(int(np.isinf(column).sum()) for column in samples.T)
