"""How fast a recording was sampled: as given, as the file states it, or out of its time column."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from daqsvc.recording.channels import LEAST_RATE_HZ, MOST_RATE_HZ
from daqsvc.recording.errors import RecordingError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.recording.contents import Contents

    Floats: TypeAlias = NDArray[np.float64]

RATE_NAMES = frozenset(
    {"fs", "fs_hz", "sr", "rate_hz", "samplerate", "sample_rate", "sample_rate_hz", "sampling_rate"}
)
"""Names under which a file may state its sampling rate in Hz."""

TIME_NAME = re.compile(
    # A capital T alone is a temperature or a torque.
    r"(?:.*\.)?(?:t|(?i:time|elapsed))(?:[\s_]*[\[(]?(?P<unit>s|sec|seconds|ms|us|µs|μs|ns)[\])]?)?"
)
"""Names that a column of time may have, with its unit or in seconds: ``t``, ``Time [ms]``, ``time_s``."""

PER_SECOND = {"ms": 1e3, "us": 1e6, "µs": 1e6, "μs": 1e6, "ns": 1e9}

SAME_RATE = 0.005
"""Rates that differ by less are the same, rounded."""

MOST_UNEVEN = 0.5
"""Steps of an even column of time are within this fraction of their median (rounded times do that)."""


def rate_of(path: Path, contents: Contents, length: int, given_hz: float | None) -> tuple[float, str]:
    """Samples per second of channels with ``length`` samples, and where the number comes from.

    Args:
        path: the file, for messages.
        contents: what it holds.
        length: samples of a channel.
        given_hz: what the user says; outranks a column of time, but never contradicts a rate that is stated.

    Raises:
        RecordingError: nobody says it, the file contradicts itself or what is given, or the rate is outside
            of `LEAST_RATE_HZ` to `MOST_RATE_HZ`.
    """
    stated = {
        name: value
        for name, value in contents.scalars().items()
        if name.rpartition(".")[2].lower() in RATE_NAMES
    }
    if given_hz is not None:
        others = "".join(
            f"; {name} of the file says {hz:g} Hz" for name, hz in stated.items() if hz != given_hz
        )
        rate_hz, source = given_hz, f"given{others}"
    elif len(set(stated.values())) == 1:
        name, rate_hz = next(iter(stated.items()))
        source = f"stated as {name}"
    elif not stated and (time := time_column(contents, length)) is not None:
        seconds, unit = _seconds(time, contents.entries[time])
        rate_hz = float((length - 1) / (seconds[-1] - seconds[0]))
        source = f"derived from time column {time!r}, read as {unit}"
    else:
        told = f"states several: {stated}" if stated else f"does not state one{_why_not(contents, length)}"
        raise RecordingError(
            f"the sampling rate of {path} is not known: the file {told}. Give it with --fs, in Hz"
        )
    if not LEAST_RATE_HZ <= rate_hz <= MOST_RATE_HZ:
        raise RecordingError(
            f"the sampling rate of {path} is said to be {rate_hz:g} Hz ({source}); give one from "
            f"{LEAST_RATE_HZ:g} to {MOST_RATE_HZ:,.0f} Hz with --fs"
        )
    if given_hz is not None:
        _refuse_other(path, stated, given_hz)
    return float(rate_hz), source


def _refuse_other(path: Path, stated: Mapping[str, float], given_hz: float) -> None:
    """Refuse a given rate that no statement of the file is near to.

    Raises:
        RecordingError: none is.
    """
    if not stated or any(abs(hz / given_hz - 1.0) <= SAME_RATE for hz in stated.values()):
        return
    said = " and ".join(f"{hz:g} Hz ({name})" for name, hz in stated.items())
    raise RecordingError(
        f"the sampling rate of {path} is {said} by the file and {given_hz:g} Hz as given: leave --fs out, or "
        "correct it"
    )


def time_column(contents: Contents, length: int) -> str | None:
    """Name of the evenly spaced column of time that goes with channels of ``length`` samples.

    That is the first which holds dates or is named like a time; in a table without a header it is the
    first column if it rises by even steps, which no measured signal does. Steps of one are left: they
    number the samples.
    """
    return next((name for name in _candidates(contents, length) if _is_even(contents, name)), None)


def _candidates(contents: Contents, length: int) -> list[str]:
    fitting = {
        name: values
        for name, values in contents.entries.items()
        if values.ndim == 1 and len(values) == length > 2 and values.dtype.kind in "iufM"
    }
    found = [
        name for name, values in fitting.items() if values.dtype.kind == "M" or TIME_NAME.fullmatch(name)
    ]
    if contents.is_table and not contents.has_header and "0" in fitting and len(fitting) > 1:
        first = np.asarray(fitting["0"], np.float64)
        if abs(first[1] - first[0]) != 1.0:
            found.append("0")
    return found


def _is_even(contents: Contents, name: str) -> bool:
    steps = _steps(contents, name)
    if not np.isfinite(steps).all():
        return False
    median = float(np.median(steps))
    return bool(median > 0 and np.all(np.abs(steps - median) <= MOST_UNEVEN * median))


def _steps(contents: Contents, name: str) -> Floats:
    with np.errstate(invalid="ignore"):  # infinities make NaN
        return np.diff(_seconds(name, contents.entries[name])[0])


def _seconds(name: str, values: NDArray[np.generic]) -> tuple[Floats, str]:
    """Seconds since the first sample, and the unit that they were in."""
    if values.dtype.kind == "M":
        return (values - values[0]) / np.timedelta64(1, "s"), "dates"
    named = TIME_NAME.fullmatch(name)
    unit = (named["unit"] if named else None) or "s"
    # Nanoseconds since 1970 have more digits than a float64.
    since_first = (values - values[0]).astype(np.float64)
    return since_first / PER_SECOND.get(unit, 1.0), unit if unit in PER_SECOND else "seconds"


def _why_not(contents: Contents, length: int) -> str:
    """Why a column that looks like time is of no use."""
    for name in _candidates(contents, length):
        if TIME_NAME.fullmatch(name):
            steps = _steps(contents, name)
            return (
                f", and the steps of its time column {name!r} are uneven "
                f"({np.min(steps):.3g} to {np.max(steps):.3g} s)"
            )
    return ""
