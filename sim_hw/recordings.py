"""Measured recordings: named channels of samples out of MATLAB, CSV and NumPy files."""

from __future__ import annotations

import gzip
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.lib.npyio import NpzFile
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]

RATE_NAMES = frozenset(
    {"fs", "fs_hz", "sr", "rate_hz", "samplerate", "sample_rate", "sample_rate_hz", "sampling_rate"}
)
"""Names under which a file may state its sampling rate in Hz."""

DELIMITERS = ("\t", ";", "|", ",", " ")
"""Between the columns of a CSV file, tried in this order (a comma may also be a decimal point)."""

SNIFFED_LINES = 20

LEAST_RATE_HZ = 1.0
MOST_RATE_HZ = 10e6
"""Sampling rates outside of these are mistakes: a rate in kHz, or a period in its place."""

DAMAGED = (
    OSError,
    EOFError,
    ValueError,
    TypeError,
    LookupError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What the readers of these formats raise on damaged files."""


class RecordingError(ValueError):
    """A recording cannot be read, or does not hold what is asked of it."""


@dataclass(frozen=True, slots=True)
class Recording:
    """Samples of one or more channels, taken together at a fixed rate.

    Attributes:
        names: of the channels.
        samples: float64 ``[n, channels]``, in the units of the file.
        rate_hz: samples per second.
        source: the file.
        nan_count: how many of the samples are NaN.
        infinity_count: how many are infinite.
        left_out: channels of another length that were not asked for by name, with their lengths.
    """

    names: tuple[str, ...]
    samples: Floats
    rate_hz: float
    source: Path
    nan_count: int
    infinity_count: int = 0
    left_out: Mapping[str, int] = field(default_factory=dict)


def load_recording(
    path: Path | str, channels: Mapping[str, str] | None = None, rate_hz: float | None = None
) -> Recording:
    """Read channels from a ``.mat`` (up to v7), ``.csv``, ``.csv.gz`` or ``.npz`` file.

    In the file a channel is named by its variable (``X105_DE_time``), the field of a struct
    (``bearing.gs``), a column of a matrix (``data[2]``), or the header or number from 0 of a CSV column.

    Args:
        path: the file.
        channels: what each channel is called from now on, and what it is called in the file. Unless
            given: every channel in the file that is as long as the longest one, under its own name.
        rate_hz: samples per second. Unless given: what the file says under one of `RATE_NAMES`.

    Raises:
        RecordingError: the file cannot be read, a channel is not there, not numeric or empty, the
            channels have different lengths, or the rate is not known or outside of `LEAST_RATE_HZ` to
            `MOST_RATE_HZ`.
    """
    path = Path(path)
    found = _read(path)
    left_out: dict[str, int] = {}
    if not channels:
        lengths = {name: len(values) for name, values in _vectors(found).items()}
        longest = max(lengths.values(), default=0)
        channels = {name: name for name, length in lengths.items() if length == longest and length > 1}
        left_out = {name: length for name, length in lengths.items() if 1 < length < longest}
        if not channels:
            raise RecordingError(f"{path} {_nothing_to_play(found)}; it holds {_listing(found)}")
    columns = {name: _channel(path, found, variable) for name, variable in channels.items()}
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        stated = ", ".join(f"{name} ({channels[name]}) {length}" for name, length in lengths.items())
        raise RecordingError(
            f"the channels of {path} have different lengths: {stated}; map only channels taken together"
        )
    if any(length < 2 for length in lengths.values()):
        raise RecordingError(f"{path} is too short: it holds one sample a channel; give a longer recording")
    rate_hz = _stated_rate(path, found) if rate_hz is None else rate_hz
    if not LEAST_RATE_HZ <= rate_hz <= MOST_RATE_HZ:
        raise RecordingError(
            f"the sampling rate of {path} is said to be {rate_hz:g} Hz; give one from {LEAST_RATE_HZ:g} to "
            f"{MOST_RATE_HZ:,.0f} Hz with --fs"
        )
    samples = np.column_stack(list(columns.values()))
    nans, infinities = int(np.isnan(samples).sum()), int(np.isinf(samples).sum())
    return Recording(tuple(columns), samples, float(rate_hz), path, nans, infinities, left_out)


def list_channels(path: Path | str) -> dict[str, int]:
    """What can be loaded from a file: the number of samples of each numeric channel, by name.

    Raises:
        RecordingError: the file cannot be read.
    """
    vectors = _vectors(_read(Path(path)))
    return {name: len(values) for name, values in vectors.items() if len(values) > 1}


def _read(path: Path) -> dict[str, NDArray[np.generic]]:
    """Everything in a file, as arrays of at most one dimension by name."""
    # Asked first, as the readers say it in words of their own.
    if not path.exists():
        raise RecordingError(f"{path} cannot be read: there is no such file; correct the path")
    name = path.name.lower()
    readers = {".mat": _read_mat, ".npz": _read_npz, ".csv": _read_csv, ".csv.gz": _read_csv}
    reader = next((reader for suffix, reader in readers.items() if name.endswith(suffix)), None)
    if reader is None:
        raise RecordingError(f"{path} is not a kind of file that can be played; use {', '.join(readers)}")
    try:
        return dict(reader(path))
    except RecordingError:
        raise
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror or error}") from error
    except DAMAGED as error:
        raise RecordingError(f"{path} cannot be read: {error}") from error


def _read_mat(path: Path) -> Iterator[tuple[str, NDArray[np.generic]]]:
    from scipy.io import loadmat  # noqa: PLC0415 - slow to import, and only this format needs it
    from scipy.io.matlab import MatReadError  # noqa: PLC0415

    try:
        variables = loadmat(path, squeeze_me=True, struct_as_record=False)
    except MatReadError as error:
        raise RecordingError(f"{path} cannot be read: {error}") from error
    except NotImplementedError:
        raise RecordingError(
            f"{path} is a MATLAB v7.3 file, which cannot be read; save it in MATLAB with save(..., '-v7')"
        ) from None
    for name, value in variables.items():
        if not name.startswith("__"):
            yield from _flattened(name, value)


def _read_npz(path: Path) -> Iterator[tuple[str, NDArray[np.generic]]]:
    with path.open("rb") as file:
        if not zipfile.is_zipfile(file):
            raise RecordingError(
                f"{path} cannot be read: it is not a zip archive, as numpy.savez writes; "
                "save it anew, or give it the suffix of what it is"
            )
        with np.load(file, allow_pickle=False) as archive:
            for name in archive.files:
                yield from _flattened(name, _unless_objects(archive, name))


def _unless_objects(archive: NpzFile, name: str) -> NDArray[np.generic]:
    """An array of the archive; Python objects stay unread, they could run code."""
    try:
        return np.asarray(archive[name])
    except ValueError as error:
        if "pickle" not in str(error):
            raise
        return np.empty(0, dtype=object)


def _flattened(name: str, value: object) -> Iterator[tuple[str, NDArray[np.generic]]]:
    """Structs as dotted names, matrices column by column along their longer side."""
    fields = getattr(value, "_fieldnames", None)
    if fields is not None:
        for field in fields:
            yield from _flattened(f"{name}.{field}", getattr(value, field))
        return
    array = np.squeeze(np.asarray(value))
    if array.ndim <= 1:
        yield name, array
    elif array.ndim == 2:
        columns = array.T if array.shape[0] >= array.shape[1] else array
        yield from ((f"{name}[{i}]", column) for i, column in enumerate(columns))


def _read_csv(path: Path) -> Iterator[tuple[str, NDArray[np.generic]]]:
    opener = gzip.open if path.name.lower().endswith(".gz") else open
    with opener(path, "rt", encoding="utf-8-sig") as file:
        numbered = [(i, line) for i, line in enumerate(file, 1) if line.strip() and line[0] != "#"]
    if not numbered:
        raise RecordingError(f"{path} is empty")
    delimiter, decimal_comma = _sniff([line for _, line in numbered[:SNIFFED_LINES]])
    if decimal_comma:
        numbered = [numbered[0], *((i, line.replace(",", ".")) for i, line in numbered[1:])]
    width = len(_split(numbered[min(len(numbered) - 1, SNIFFED_LINES - 1)][1], delimiter))
    first = _split(numbered[0][1], delimiter)[:width]
    numeric_first = [_is_number(cell, decimal_comma=decimal_comma) for cell in first]
    if len(numbered) == 1:
        has_header = not any(numeric_first)
    else:
        second = _split(numbered[1][1], delimiter)
        has_header = any(
            _is_number(later) and not number for number, later in zip(numeric_first, second, strict=False)
        )
    numbers = [str(i) for i in range(width)]
    names = first + numbers[len(first) :] if has_header else numbers
    if has_header:
        numbered = numbered[1:]
    elif decimal_comma:
        numbered[0] = (numbered[0][0], numbered[0][1].replace(",", "."))
    if not numbered:
        raise RecordingError(f"{path} has a header but no samples")

    model = _split(numbered[0][1], delimiter)[:width]
    numeric = [i for i, cell in enumerate(model) if _is_number(cell) or not cell]
    table = _parse(path, numbered, delimiter, numeric, width)
    for i, name in enumerate(names):
        # Of several columns under one header only the first has its name; the others have numbers.
        unique = name if names.index(name) == i else str(i)
        yield unique, table[:, numeric.index(i)] if i in numeric else np.array(model[i : i + 1])


def _sniff(lines: Sequence[str]) -> tuple[str | None, bool]:
    """Delimiter of the columns (None where there is only one), and whether commas are decimal points."""
    for delimiter in DELIMITERS:
        rows = [_split(line, delimiter) for line in lines]
        # The first line may be longer: some loggers append totals to it.
        if len(rows[-1]) < 2 or len({len(row) for row in rows[1:]}) > 1:
            continue
        decimal_comma = delimiter != "," and any(
            "," in cell and _is_number(cell, decimal_comma=True) for cell in rows[-1]
        )
        if any(_is_number(cell, decimal_comma=decimal_comma) for cell in rows[-1]):
            return delimiter, decimal_comma
    return None, False


def _split(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return [line.strip().strip('"')]
    cells = line.split() if delimiter == " " else line.rstrip("\r\n").split(delimiter)
    return [cell.strip().strip('"') for cell in cells]


def _is_number(cell: str, *, decimal_comma: bool = False) -> bool:
    try:
        float(cell.replace(",", ".") if decimal_comma else cell)
    except ValueError:
        return False
    return True


def _parse(
    path: Path, numbered: Sequence[tuple[int, str]], delimiter: str | None, columns: Sequence[int], width: int
) -> Floats:
    """Numbers float64 ``[n, len(columns)]``; an empty cell is NaN."""
    if not columns:
        return np.empty((len(numbered), 0))
    try:
        return np.loadtxt(
            [line for _, line in numbered],
            delimiter=None if delimiter == " " else delimiter,
            usecols=columns,
            comments=None,
            ndmin=2,
        )
    except ValueError:
        # Slower, but it takes empty cells and can say which cell is wrong.
        return np.array(
            [_parse_line(path, i, _split(line, delimiter), columns, width) for i, line in numbered]
        )


def _parse_line(path: Path, number: int, cells: list[str], columns: Sequence[int], width: int) -> list[float]:
    if len(cells) < width:
        raise RecordingError(f"{path}:{number} has {len(cells)} columns where the others have {width}")
    for i in columns:
        if cells[i] and not _is_number(cells[i]):
            raise RecordingError(
                f"{path}:{number} column {i}: {cells[i]!r} is not a number; correct the file"
            )
    return [float(cells[i]) if cells[i] else float("nan") for i in columns]


def _vectors(found: Mapping[str, NDArray[np.generic]]) -> dict[str, NDArray[np.generic]]:
    return {name: values for name, values in found.items() if values.ndim == 1 and values.dtype.kind in "iuf"}


def _nothing_to_play(found: Mapping[str, NDArray[np.generic]]) -> str:
    """Why no channel of a file can be played."""
    numeric = [values for values in found.values() if values.dtype.kind in "iuf"]
    return "is too short: no channel has two samples" if numeric else "holds no numeric channel"


def _channel(path: Path, found: Mapping[str, NDArray[np.generic]], variable: str) -> Floats:
    is_csv = path.name.lower().endswith((".csv", ".csv.gz"))
    if is_csv and variable not in found and variable.isdecimal() and int(variable) < len(found):
        variable = list(found)[int(variable)]
    if variable not in found:
        raise RecordingError(f"{path} has no channel {variable!r}; it holds {_listing(found)}")
    values = found[variable]
    if values.dtype.kind not in "iuf":
        raise RecordingError(f"{variable!r} of {path} is not numeric; it holds {_listing(found)}")
    if values.ndim != 1 or not len(values):
        what = "a single number" if values.ndim == 0 else "empty"
        raise RecordingError(f"{variable!r} of {path} is {what}, not a channel; it holds {_listing(found)}")
    return values.astype(np.float64)


def _stated_rate(path: Path, found: Mapping[str, NDArray[np.generic]]) -> float:
    stated = {
        name: float(value)
        for name, value in found.items()
        if name.rpartition(".")[2].lower() in RATE_NAMES and value.ndim == 0 and value.dtype.kind in "iuf"
    }
    if len(set(stated.values())) != 1:
        told = f"states several: {stated}" if stated else "does not state one"
        raise RecordingError(
            f"the sampling rate of {path} is not known: the file {told}. Give it with --fs, in Hz"
        )
    return next(iter(stated.values()))


def _listing(found: Mapping[str, NDArray[np.generic]]) -> str:
    """What a file holds, in words."""
    vectors = _vectors(found)
    told = [
        f"{name} ({len(values)})"
        if name in vectors
        else name
        if values.ndim == 0
        else f"{name} (not numeric)"
        for name, values in found.items()
    ]
    return ", ".join(told) or "nothing"
