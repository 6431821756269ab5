"""How fast a recording was sampled, and where it lacks samples: as given, stated, or by its time column."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from daqsvc.dsp.quality.rate import SAME_RATE, StampedRate, rate_of_stamps
from daqsvc.errors.recordings import GAPS, RATE_CONTRADICTED, RATE_UNKNOWN
from daqsvc.recording import RecordingError
from daqsvc.recording.contents import RATE_NAMES, last_part

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.recording.contents import Contents

    Floats: TypeAlias = NDArray[np.float64]

LEAST_RATE_HZ = 1.0
MOST_RATE_HZ = 10e6
"""Sampling rates outside of these are mistakes: a rate in kHz, or a period in its place."""

TIME_NAME = re.compile(
    # A capital T alone is a temperature or a torque.
    r"(?:.*[./])?(?:t|(?i:(?:elapsed|relative|absolute|rel\.|abs\.)?[\s_]*(?:time|elapsed|zeit)|(?:date|time|zeit)[\s_-]?(?:stamp|stempel)|"
    r"date|datum|uhrzeit|date[\s_/]*time|datum[\s_/]*(?:uhr)?zeit))(?:[\s_]*[\[(]?(?P<unit>s|sec|seconds|ms|us|µs|μs|ns)[\])]?)?"
)
"""Names that a column of time may have, with its unit or in seconds: ``t``, ``Time [ms]``, ``time_s``."""

PER_SECOND = {"ms": 1e3, "us": 1e6, "µs": 1e6, "μs": 1e6, "ns": 1e9}

_BACKWARDS = "go backwards, row by row"

MOST_STRETCHED = 4
"""A recording is given up whose gaps make it so many times as long."""


@dataclass(frozen=True, slots=True)
class Timing:
    """When the samples of a recording were taken.

    Attributes:
        rate_hz: samples per second.
        source: where that comes from, in words.
        rows: int64 ``[n]``, the place of each sample where some are missing between; None if none are.
        notes: what is wrong with the column of time, in sentences.
    """

    rate_hz: float
    source: str
    rows: NDArray[np.int64] | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _TimeColumn:
    """A column of time, and what it states.

    Attributes:
        name: of the column.
        unit: it was read in, in words.
        unit_is_named: whether the file states that.
        stamps: what its stamps show.
    """

    name: str
    unit: str
    unit_is_named: bool
    stamps: StampedRate

    def notes(self) -> tuple[str, ...]:
        """What is wrong with it, in sentences."""
        backward = self.stamps.backward
        if not backward:
            return ()
        steps = "a step" if backward == 1 else f"{backward:,} steps"
        note = (
            f"time column {self.name!r} goes back in {steps}: the samples are taken in the order of the "
            "file; check the logger's clock and the order of the rows"
        )
        return (note,)

    def agrees(self, hz: float) -> bool:
        """Whether a rate is the column's; one that names no unit may be in ms, us or ns, too."""
        others = () if self.unit_is_named else (1e3, 1e6, 1e9)
        return any(self.stamps.agrees(hz / per) for per in (1.0, *others))


def rate_of_step(step_s: float, digits: int = 12) -> float:
    """Samples per second by the time between two, as a whole number if that has its first ``digits``."""
    if not step_s > 0.0 or not np.isfinite(1.0 / step_s):
        return float("nan")
    rate_hz = 1.0 / step_s
    whole = round(rate_hz)
    return float(whole) if abs(rate_hz - whole) <= 10.0 ** (1 - digits) * rate_hz else rate_hz


def timing_of(
    path: Path,
    contents: Contents,
    length: int,
    given_hz: float | None,
    channels: Collection[str] = (),
) -> Timing:
    """When the samples of channels with ``length`` samples were taken.

    Args:
        path: the file, for messages.
        contents: what it holds.
        length: samples of a channel.
        given_hz: what the user states; it never contradicts what the file states, where that is one thing.
        channels: the channels themselves, by their names in the file.

    Raises:
        RecordingError: the rate is not stated, the file contradicts itself or what is given, most samples are
            missing, or the rate is outside of `LEAST_RATE_HZ` to `MOST_RATE_HZ`.
    """
    stated = _stated(contents, channels)
    column = _time(path, contents, length, channels)
    if given_hz is not None:
        others = "".join(
            f"; {name} of the file is {hz:g} Hz" for name, hz in stated.items() if hz != given_hz
        )
        rate_hz, source = given_hz, f"given{others}"
    elif len(set(stated.values())) == 1:
        name, rate_hz = next(iter(stated.items()))
        source = f"stated as {name}"
    elif not stated and column is not None and column.stamps.is_even:
        rate_hz = column.stamps.rate_hz
        source = f"derived from time column {column.name!r}, read as {column.unit}"
    else:
        statement = (
            f"states several: {stated}"
            if stated
            else f"does not state one{_why_not(contents, length, channels)}"
        )
        raise RecordingError(
            f"the sampling rate of {path} is not known: the file {statement}. Give it with --fs, in Hz",
            RATE_UNKNOWN,
        )
    if not LEAST_RATE_HZ <= rate_hz <= MOST_RATE_HZ:
        raise RecordingError(
            f"the sampling rate of {path} is stated as {rate_hz:g} Hz ({source}); give one from "
            f"{LEAST_RATE_HZ:g} to {MOST_RATE_HZ:,.0f} Hz with --fs",
            RATE_UNKNOWN,
        )
    _refuse_contradictions(path, stated, column, given_hz)
    if column is None:
        return Timing(float(rate_hz), source, notes=_reversed(contents, length, channels))
    return Timing(float(rate_hz), source, column.stamps.rows, column.notes())


def place_at(
    path: Path, contents: Contents, length: int, rate_hz: float, channels: Collection[str] = ()
) -> tuple[NDArray[np.int64] | None, tuple[str, ...]]:
    """Where samples have their places that are taken at a rate, whatever the file states about it.

    Args:
        path: the file, for messages.
        contents: what it holds.
        length: samples of a channel.
        rate_hz: samples per second.
        channels: the channels themselves, by their names in the file.

    Returns:
        As `Timing.rows` and `Timing.notes`. Nothing is reported missing by a column of time that shows
        another rate.

    Raises:
        RecordingError: most samples are missing.
    """
    stated, column = _stated(contents, channels), _time(path, contents, length, channels)
    if other := _other_rates(stated, column, rate_hz):
        note = (
            f"the sampling rate of {path} is {other} by the file and {rate_hz:g} Hz by the machine file, "
            "which is taken: correct the one that is wrong"
        )
        return None, (note,)
    if column is None:
        return None, _reversed(contents, length, channels)
    return column.stamps.rows, column.notes()


def _stated(contents: Contents, channels: Collection[str]) -> dict[str, float]:
    """What the file states outright: for all that it holds, and for the channels."""
    stated = {
        name: value for name, value in contents.scalars().items() if last_part(name).lower() in RATE_NAMES
    }
    own = {name: contents.rates_hz[name] for name in channels if name in contents.rates_hz}
    if len(set(own.values())) == 1:
        own = dict(list(own.items())[:1])
    return stated | {f"rate of {name}": hz for name, hz in own.items()}


def _refuse_contradictions(
    path: Path, stated: Mapping[str, float], column: _TimeColumn | None, given_hz: float | None
) -> None:
    """Refuse a rate that contradicts the file, and a file that contradicts itself.

    Of a file that states several things one that is given chooses.

    Raises:
        RecordingError: they do.
    """
    if given_hz is None:
        if column is not None and any(not column.agrees(hz) for hz in stated.values()):
            raise RecordingError(
                f"the sampling rate of {path} is {_rates(stated, column)} by the file, which contradicts "
                "itself: give it with --fs, or correct the file",
                RATE_CONTRADICTED,
            )
    elif other := _other_rates(stated, column, given_hz):
        raise RecordingError(
            f"the sampling rate of {path} is {other} by the file and {given_hz:g} Hz as given: "
            "leave --fs out, or correct it",
            RATE_CONTRADICTED,
        )


def _other_rates(stated: Mapping[str, float], column: _TimeColumn | None, given_hz: float) -> str:
    """The rates that a file states, in words, if none is the one that is given; else empty."""
    agreed = any(abs(hz / given_hz - 1.0) <= SAME_RATE for hz in stated.values()) or (
        column is not None and column.agrees(given_hz)
    )
    return "" if agreed else _rates(stated, column)


def _rates(stated: Mapping[str, float], column: _TimeColumn | None) -> str:
    statements = [f"{hz:g} Hz ({name})" for name, hz in stated.items()]
    if column is not None:
        statements.append(
            f"{column.stamps.rate_hz:g} Hz (time column {column.name!r}, read as {column.unit})"
        )
    return " and ".join(statements)


def time_column(contents: Contents, length: int) -> str | None:
    """Name of the evenly spaced column of time that goes with channels of ``length`` samples.

    That is the first which holds dates or is named like a time, samples that are missing aside. In a table
    without a header it is the first column if it rises by even steps, which no measured signal does. Steps
    of one are left: they number the samples.
    """
    columns = (_read(contents, name) for name in _candidates(contents, length, ()))
    return next((column.name for column in columns if column is not None and column.stamps.is_even), None)


def _time(path: Path, contents: Contents, length: int, channels: Collection[str]) -> _TimeColumn | None:
    """The column of time: the first even one, else the first that shows the mean rate at least.

    Raises:
        RecordingError: it lacks most of the samples.
    """
    columns = [
        column for name in _candidates(contents, length, channels) if (column := _read(contents, name))
    ]
    column = next((one for one in columns if one.stamps.is_even), columns[0] if columns else None)
    rows = None if column is None else column.stamps.rows
    if column is not None and rows is not None and rows[-1] >= MOST_STRETCHED * length:
        longest = int(np.argmax(np.diff(rows)))
        raise RecordingError(
            f"{path} lacks {rows[-1] + 1 - length:,} of {rows[-1] + 1:,} samples by its time "
            f"column {column.name!r}, the most behind sample {longest + 1:,}; cut the recording there",
            GAPS,
        )
    return column


def _candidates(contents: Contents, length: int, channels: Collection[str]) -> list[str]:
    if own := {contents.times[name] for name in channels if name in contents.times}:
        return [name for name in sorted(own) if len(contents.entries[name]) == length > 2]
    fitting = {
        name: values
        for name, values in contents.entries.items()
        if values.ndim == 1 and len(values) == length > 2 and values.dtype.kind in "iufM"
    }
    of_others = set(contents.times.values())
    names = [
        name
        for name, values in fitting.items()
        if (values.dtype.kind == "M" or _is_named(name)) and name not in of_others
    ]
    if contents.is_table and not contents.has_header and "0" in fitting and len(fitting) > 1:
        first = np.asarray(fitting["0"][:2], np.float64)
        if abs(first[1] - first[0]) != 1.0:
            names.append("0")
    return names


def _is_time(contents: Contents, name: str) -> bool:
    """Whether a column is one of time by the structure of the file, or by its name."""
    return name in contents.times.values() or _is_named(name)


def _is_named(name: str) -> bool:
    return TIME_NAME.fullmatch(name) is not None


def _read(contents: Contents, name: str) -> _TimeColumn | None:
    """What a column states if it is one of time; None if it states nothing."""
    values = contents.entries[name]
    with np.errstate(invalid="ignore"):  # infinities make NaN
        seconds, unit, unit_is_named = _seconds(contents, name)
    stamps = rate_of_stamps(seconds, surely_time=values.dtype.kind == "M" or _is_time(contents, name))
    return None if stamps is None else _TimeColumn(name, unit, unit_is_named, stamps)


def _seconds(contents: Contents, name: str) -> tuple[Floats, str, bool]:
    """Seconds since the first sample, the unit that they were in, and whether the file names it."""
    values = contents.entries[name]
    if values.dtype.kind == "M":
        return (values - values[0]) / np.timedelta64(1, "s"), "dates", True
    named = TIME_NAME.fullmatch(name)
    unit = named["unit"] if named else None
    if values.dtype.kind in "iu":
        values = values.astype(np.int64)  # the differences of unsigned or short ones wrap
    # Nanoseconds since 1970 have more digits than a float64.
    since_first = (values - values[0]).astype(np.float64)
    if unit is None and name not in contents.times.values() and (clock := _clock(values, since_first)):
        return since_first * clock.s_each, clock.words, True
    if unit in PER_SECOND and name not in contents.times.values():
        return since_first / PER_SECOND[unit], unit, True
    return since_first, "seconds", unit is not None or name in contents.times.values()


class _Clock(NamedTuple):
    """A way to count time that its numbers give away.

    Attributes:
        words: what it is called.
        s_each: seconds of each.
        least, most: the numbers of some fifty years.
    """

    words: str
    s_each: float
    least: float
    most: float


_CLOCKS = (
    _Clock("milliseconds since 1970", 1e-3, 3e11, 3e12),
    _Clock("microseconds since 1970", 1e-6, 3e14, 3e15),
    _Clock("nanoseconds since 1970", 1e-9, 3e17, 3e18),
)
_EXCEL = _Clock("days of Excel", 86_400.0, 2e4, 8e4)

_SHORT_STEP_DAYS = 1e-6
"""A twelfth of a second: seconds would be a hundred times as short as any logger's."""


def _clock(values: NDArray[np.generic], since_first: Floats) -> _Clock | None:
    """How a column counts time that does not state it; None if it may be in seconds since any moment."""
    first = float(values[0])
    if _EXCEL.least <= first <= _EXCEL.most:
        known = since_first[np.isfinite(since_first)]
        mean = abs(known[-1] - known[0]) / max(1, len(known) - 1) if len(known) else 0.0
        return _EXCEL if 0.0 < mean < _SHORT_STEP_DAYS else None
    return next((clock for clock in _CLOCKS if clock.least <= first <= clock.most), None)


def _reversed(contents: Contents, length: int, channels: Collection[str]) -> tuple[str, ...]:
    """A note on a column of time that goes backwards from row to row, if there is one."""
    why = _why_not(contents, length, channels)
    if _BACKWARDS not in why:
        return ()
    note = (
        f"{why.removeprefix(', and ')}: the samples are taken in the order of the file; check whether its "
        "rows stand upside down"
    )
    return (note,)


def _why_not(contents: Contents, length: int, channels: Collection[str]) -> str:
    """Why a column that looks like time is of no use."""
    for name in _candidates(contents, length, channels):
        if _is_time(contents, name):
            with np.errstate(invalid="ignore"):
                steps = np.diff(_seconds(contents, name)[0])
            known = steps[np.isfinite(steps)]
            if not len(known):
                return f", and its time column {name!r} has no two times in a row"
            backward = int((known < 0.0).sum())
            if backward == len(known):
                return f", and the times of its column {name!r} {_BACKWARDS}"
            some = f", and {backward:,} of them go back" if backward else ""
            return (
                f", and the steps of its time column {name!r} are uneven "
                f"({np.min(known):.3g} to {np.max(known):.3g} s){some}"
            )
    return ""
