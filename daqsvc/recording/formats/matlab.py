"""MATLAB files up to version 7. Whether one of level 5 is whole is asked before SciPy reads it.

SciPy trusts the type of each element and the number of a struct's fields: where they are damaged it reads
outside of its memory, which ends the process instead of raising an error. Layout: MathWorks, "MAT-File
Format", level 5.
"""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.errors.recordings import DAMAGED, UNKNOWN_FORMAT
from daqsvc.recording import RecordingError
from daqsvc.recording.contents import (
    STATED_RATE,
    STATED_START,
    Contents,
    check_columns,
    flattened,
    names_of_groups,
)
from daqsvc.recording.streams import ns_of_iso

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.confined.limits import Budget


LEVEL_5 = 1
"""What SciPy calls the format of MATLAB 5 to 7."""


def read_mat(path: Path, budget: Budget) -> Contents:
    """All variables; fields of structs have dotted names."""
    from scipy.io import loadmat  # noqa: PLC0415 - slow to import, and only this format needs it
    from scipy.io.matlab import matfile_version  # noqa: PLC0415

    try:
        level, _ = matfile_version(path)
        if level == LEVEL_5:
            check_mat_structure(path, budget)
        variables = loadmat(path, squeeze_me=True, struct_as_record=False)
    except NotImplementedError:
        raise RecordingError(
            f"{path} is a MATLAB v7.3 file, which cannot be read; save it in MATLAB with save(..., '-v7')",
            UNKNOWN_FORMAT,
        ) from None
    variables = {name: variable for name, variable in variables.items() if not name.startswith("__")}
    streams = {name: one for name, variable in variables.items() if (one := _stream(variable)) is not None}
    entries = {
        entry: values
        for name, variable in variables.items()
        if name not in streams
        for entry, values in flattened(name, variable)
    }
    entries |= _with_start(streams)
    names = names_of_groups([(one.name, name) for one in streams.values() for name in one.channels])
    channels = [(one, name) for one in streams.values() for name in one.channels]
    rates_hz, units, starts_ns = {}, {}, {}
    for entry, (one, name) in zip(names, channels, strict=True):
        entries[entry], rates_hz[entry] = one.channels[name], one.rate_hz
        if one.units[name]:
            units[entry] = one.units[name]
        if (start_ns := ns_of_iso(one.start)) is not None:
            starts_ns[entry] = start_ns
    check_columns(len(entries))
    return Contents(entries, rates_hz=rates_hz, units=units, starts_ns=starts_ns)


class _Stream(NamedTuple):
    """A struct as `daqsvc export` writes it for each stream."""

    name: str
    rate_hz: float
    start: str
    channels: Mapping[str, NDArray[np.generic]]
    units: Mapping[str, str]


def _stream(variable: object) -> _Stream | None:
    """What a struct of `daqsvc export` holds; None of any other variable."""
    if not {"fields", "names", "units", "stream", STATED_RATE} <= set(getattr(variable, "_fieldnames", ())):
        return None
    lists = [np.atleast_1d(getattr(variable, key)).ravel() for key in ("names", "fields", "units")]
    try:
        # Of one channel without a stated unit nothing at all is left.
        names, fields, units = (
            [str(one) if np.size(one) else "" for one in texts] or [""] for texts in lists
        )
        samples = [np.atleast_1d(getattr(variable, field)) for field in fields]
        rate_hz = float(getattr(variable, STATED_RATE))
        start, name = (getattr(variable, key, "") for key in (STATED_START, "stream"))
        channels = dict(zip(names, samples, strict=True))
        of_channels = dict(zip(names, units, strict=True))
    except (AttributeError, TypeError, ValueError):
        return None
    return _Stream(f"{name}", rate_hz, f"{start}" if np.size(start) else "", channels, of_channels)


def _with_start(streams: Mapping[str, _Stream]) -> dict[str, NDArray[np.generic]]:
    starts = sorted(one.start for one in streams.values() if one.start)
    return {STATED_START: np.array(starts[0])} if starts else {}


HEADER_BYTES = 128
BIG_ENDIAN = b"MI"

INT8, INT32, UINT32, MATRIX, COMPRESSED, UTF8 = 1, 5, 6, 14, 15, 16
NUMBERS = frozenset({1, 2, 3, 4, 5, 6, 7, 9, 12, 13})
TEXT = NUMBERS | {16, 17, 18}
NAME = frozenset({INT8, UTF8})
SIZES = frozenset({INT32, UINT32})

CELL, STRUCT, OBJECT, CHAR, SPARSE, FUNCTION, OPAQUE = 1, 2, 3, 4, 5, 16, 17
NUMERIC_CLASSES = range(6, 16)
COMPLEX = 0x800
"""Flag of an array with a second, imaginary, part."""

AFTER_FLAGS: Mapping[int, tuple[frozenset[int], ...]] = {
    CELL: (SIZES, NAME),
    STRUCT: (SIZES, NAME, SIZES, NAME),
    OBJECT: (SIZES, NAME, NAME, SIZES, NAME),
    CHAR: (SIZES, NAME, TEXT),
    SPARSE: (SIZES, NAME, NUMBERS, NUMBERS, NUMBERS),
    FUNCTION: (SIZES, NAME),
    OPAQUE: (NAME, NAME, NAME),
} | dict.fromkeys(NUMERIC_CLASSES, (SIZES, NAME, NUMBERS))
"""Types of the elements of an array after its flags, before the arrays inside of it."""


class _Element(NamedTuple):
    kind: int
    body: memoryview


class _DamageError(ValueError):
    """The structure is not that of a MATLAB file."""


def check_mat_structure(path: Path, budget: Budget) -> None:
    """Follow every element of a file of level 5.

    Args:
        path: the file.
        budget: of the file; what its variables unpack to is counted.

    Raises:
        RecordingError: the file is damaged or cut short.
        TooLargeError: it unpacks to more than it may.
        zlib.error: a compressed variable is damaged.
    """
    content = memoryview(path.read_bytes())
    order = ">" if bytes(content[126:HEADER_BYTES]) == BIG_ENDIAN else "<"
    try:
        for kind, body in _elements(content[HEADER_BYTES:], order):
            variables = [_Element(kind, body)]
            if kind == COMPRESSED:
                variables = list(_elements(memoryview(_unpacked(body, budget)), order))
            for variable in variables:
                _check_array(variable, order)
    except _DamageError as damage:
        raise RecordingError(f"{path} cannot be read: {damage}; copy or save it again", DAMAGED) from None


def _unpacked(body: memoryview, budget: Budget) -> bytes:
    """A compressed variable, no more of it than the file may hold."""
    unpacking = zlib.decompressobj()
    content = unpacking.decompress(body, budget.left_bytes + 1)
    budget.spend(len(content))
    if not unpacking.eof:
        raise _DamageError("a compressed variable is cut short")
    return content


def _elements(content: memoryview, order: str) -> Iterator[_Element]:
    at = 0
    while at < len(content):
        if at + 8 > len(content):
            raise _DamageError("it is cut short")
        kind, size = struct.unpack_from(f"{order}II", content, at)
        if kind >> 16:  # small element: up to four bytes in place of the size
            kind, size, start, step = kind & 0xFFFF, kind >> 16, at + 4, 8
            if size > 4:
                raise _DamageError("the size of an element is damaged")
        else:
            start = at + 8
            step = 8 + size + (-size % 8 if kind != COMPRESSED else 0)
        if start + size > len(content):
            raise _DamageError(
                f"it is cut short or damaged: an element of {size} bytes has {len(content) - start} bytes"
            )
        yield _Element(kind, content[start : start + size])
        at += step


def _check_array(element: _Element, order: str) -> None:
    if element.kind != MATRIX:
        raise _DamageError(f"an element of type {element.kind} stands where an array belongs")
    if not element.body:
        return  # an empty array inside of another
    flags, *parts = _elements(element.body, order)
    if flags.kind != UINT32 or len(flags.body) != 8:
        raise _DamageError("the flags of an array are damaged")
    word = _integers(flags.body, order)[0]
    array_class = word & 0xFF
    expected = AFTER_FLAGS.get(array_class)
    if expected is None:
        raise _DamageError(f"there is no class {array_class} of arrays")
    if word & COMPLEX and array_class in {*NUMERIC_CLASSES, SPARSE}:
        expected += (NUMBERS,)
    own, inside = parts[: len(expected)], parts[len(expected) :]
    if len(own) < len(expected) or any(
        part.kind not in kinds for part, kinds in zip(own, expected, strict=True)
    ):
        raise _DamageError(f"the parts of an array of class {array_class} are damaged")
    if array_class != OPAQUE and (len(own[0].body) < 8 or len(own[0].body) % 4):
        raise _DamageError("the dimensions of an array are damaged")
    count = _arrays_inside(array_class, own, order)
    if len(inside) != count:
        raise _DamageError(f"an array of class {array_class} holds {len(inside)} others instead of {count}")
    for part in inside:
        _check_array(part, order)


def _arrays_inside(array_class: int, own: list[_Element], order: str) -> int:
    """How many arrays a cell, struct or object states that it holds."""
    if array_class in {FUNCTION, OPAQUE}:
        return 1
    if array_class not in {CELL, STRUCT, OBJECT}:
        return 0
    count = 1
    for size in _integers(own[0].body, order):
        count *= size
    if array_class == CELL:
        return count
    name_bytes = _integers(own[-2].body, order)
    if len(name_bytes) != 1 or not name_bytes[0]:
        raise _DamageError("the length of a struct's field names is damaged")
    return int(count * (len(own[-1].body) // name_bytes[0]))


def _integers(body: memoryview, order: str) -> tuple[int, ...]:
    return struct.unpack_from(f"{order}{len(body) // 4}I", body)
