"""Universal files of data set 58, ASCII or binary: one function at a nodal degree of freedom in each."""

from __future__ import annotations

import mmap
import re
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.errors.recordings import DAMAGED, TOO_SHORT
from daqsvc.recording import RecordingError
from daqsvc.recording.contents import STATED_RATE, STATED_START, Contents, check_columns, column_names
from daqsvc.recording.formats.extras import needed
from daqsvc.recording.rate import rate_of_step
from daqsvc.recording.streams import ns_of_iso

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.confined.limits import Budget

FUNCTION = 58
"""Number of the data set."""

TIME_RESPONSES = frozenset({0, 1})
"""Kinds of function that a recording is made of: general or unknown, and time response."""

TIME = frozenset({0, 1, 17})
"""What its abscissa may be: unknown, general, or time."""

DIRECTIONS = {0: "", 1: "+X", 2: "+Y", 3: "+Z", 4: "+RX", 5: "+RY", 6: "+RZ"} | {
    -1: "-X",
    -2: "-Y",
    -3: "-Z",
    -4: "-RX",
    -5: "-RY",
    -6: "-RZ",
}

_STEP_DIGITS = 6
"""Of the time between two samples in an ASCII file: E13.5."""

EXACT = re.compile(rf"(?:{STATED_START} = (\S+), )?{STATED_RATE} = ([\d.e+-]+)")
"""What `daqsvc export` states in the fourth header line: begin and rate with all their digits."""

_MARK = re.compile(rb"    -1(?=[\r\n]| {74}|\Z)")
"""The line that begins a data set, and the one that ends it, as pyuff finds them."""

_EXPANSION = 2
"""A number of four bytes becomes one of eight."""


def read_uff(path: Path, budget: Budget) -> Contents:
    """Time responses by the first line of their headers, or by node and direction."""
    pyuff = needed(path, "pyuff", "pyuff")
    budget.check_declared(_EXPANSION * budget.file_bytes)
    _check_ends(path)
    file = pyuff.UFF(str(path))
    numbers = [i for i, kind in enumerate(file.get_set_types()) if int(kind) == FUNCTION]
    if not numbers:
        raise RecordingError(
            f"{path} holds no function; save the time signals in it as data sets 58", TOO_SHORT
        )
    check_columns(len(numbers))
    entries: dict[str, NDArray[np.generic]] = {}
    rates_hz, times, units, starts_ns = {}, {}, {}, {}
    sets: list[Mapping[str, Any]] = [_without_abscissa(file.read_sets(i)) for i in numbers]
    names = _names(sets)
    for name, one in zip(names, sets, strict=True):
        samples = np.asarray(one["data"])
        if not _is_recording(one) or samples.dtype.kind not in "iuf":
            entries[name] = np.empty(1, dtype=object)
            continue
        if len(samples) != one["num_pts"]:
            raise RecordingError(
                f"{path} cannot be read: {name!r} should have {one['num_pts']} samples and has "
                f"{len(samples)}; copy or save it again",
                DAMAGED,
            )
        entries[name] = samples
        if int(one["abscissa_spacing"]) == 1:
            rates_hz[name] = _rate(one)
        else:
            times[name] = f"abscissa of {name}"
            entries[times[name]] = np.asarray(one["x"])
        if unit := _text(one.get("ordinate_axis_units_lab")):
            units[name] = unit
        own = EXACT.fullmatch(_text(one.get("id4")))
        if own and (start_ns := ns_of_iso(own[1] or "")) is not None:
            starts_ns[name] = start_ns
    exact = EXACT.fullmatch(_text(sets[0].get("id4")))
    if start := (exact and exact[1]) or _text(sets[0].get("id3")):
        entries.setdefault(STATED_START, np.array(start))
    return Contents(entries, rates_hz=rates_hz, times=times, units=units, starts_ns=starts_ns)


def _check_ends(path: Path) -> None:
    """See whether each data set ends, as pyuff leaves out the one that does not.

    Raises:
        RecordingError: one does not.
    """
    with path.open("rb") as file:
        if not file.seek(0, 2):
            return
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            marks = sum(1 for _ in _MARK.finditer(content))
    if marks % 2:
        raise RecordingError(
            f"{path} cannot be read: data set {marks // 2 + 1} of it begins and does not end; it is cut: "
            "copy or save it again",
            DAMAGED,
        )


def _without_abscissa(one: dict[str, Any]) -> dict[str, Any]:
    """Without the column of even steps, which is not needed."""
    if int(one["abscissa_spacing"]) == 1:
        one.pop("x", None)
    return one


def _rate(one: Mapping[str, Any]) -> float:
    """Samples per second by the abscissa, or what is stated of them elsewhere where that agrees with it."""
    rate_hz = rate_of_step(float(one["abscissa_inc"]), _STEP_DIGITS)
    exact = EXACT.fullmatch(_text(one.get("id4")))
    try:
        stated_hz = float(exact[2]) if exact else rate_hz
    except ValueError:
        return rate_hz
    return stated_hz if abs(stated_hz / rate_hz - 1.0) < 10.0 ** (1 - _STEP_DIGITS) else rate_hz


def _is_recording(one: Mapping[str, Any]) -> bool:
    return int(one["func_type"]) in TIME_RESPONSES and int(one["abscissa_spec_data_type"]) in TIME


def _names(sets: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = [_text(one.get("id1")) for one in sets]
    if all(lines) and len(set(lines)) == len(lines):
        return column_names(lines)
    places = [f"{int(one['rsp_node'])}{_direction(int(one['rsp_dir']))}" for one in sets]
    return column_names(places)


def _direction(number: int) -> str:
    return DIRECTIONS.get(number, f":{number}")


def _text(value: Any) -> str:
    text = str(value or "").strip()
    return "" if text.upper() == "NONE" else text
