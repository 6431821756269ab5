"""Columns of a table of samples, read in a process of its own, as the file may be damaged or hostile."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.confined.archives import load_array
from daqsvc.confined.limits import Budget, ResourceLimits, TooLargeError
from daqsvc.confined.process import ConfinedError, ConfinedProcess, RaisedThereError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

ARRAY = ".npy"
"""How the members of an NPZ file are called that are arrays."""

MOST_COLUMNS = 4096

COLUMNS = "drivers.replay.table:columns"
"""What is called in the other process."""


class TableError(Exception):
    """A table cannot be read; says why."""


def no_file(path: Path) -> str:
    """Why something that is no regular file cannot be read."""
    return "it is no file but a folder, pipe or device" if path.exists() else "there is no such file"


def read_columns(
    path: Path, wanted: Sequence[str], limits: ResourceLimits, reader: ConfinedProcess | None = None
) -> tuple[Sequence[str], dict[str, NDArray[np.float64]]]:
    """The names of all columns of an NPZ or CSV file, and those that are wanted and there.

    Args:
        path: the file.
        wanted: names of columns.
        limits: what reading it may take.
        reader: reads it, and is closed then; unless given, one of its own.

    Raises:
        TableError: it cannot be read within the limits.
    """
    arguments = {"path": str(path), "wanted": list(wanted), "memory_bytes": limits.memory_bytes}
    with reader or ConfinedProcess() as process:
        try:
            (there, found), arrays = process.call(
                COLUMNS,
                arguments,
                memory_bytes=limits.memory_bytes,
                cpu_s=limits.cpu_s(path.stat().st_size),
            )
        except RaisedThereError as error:
            raise TableError(error.message or error.kind) from None
        except (ConfinedError, OSError) as error:
            raise TableError(f"{error}") from None
    return there, dict(zip(found, arrays, strict=True))


def columns(
    path: str, wanted: Sequence[str], memory_bytes: int
) -> tuple[tuple[list[str], list[str]], list[NDArray[np.float64]]]:
    """See `read_columns`; called in the other process.

    Raises:
        ValueError: the file is no table, or too large.
        OSError: it cannot be read.
    """
    file = Path(path)
    if not file.is_file():
        raise ValueError(no_file(file))
    budget = Budget.of(file, ResourceLimits(memory_bytes))
    if file.suffix.lower() == ".npz":
        there, found = _of_archive(file, wanted, budget)
    else:
        there, found = _of_text(file, wanted)
    return (there, list(found)), list(found.values())


def _of_archive(
    file: Path, wanted: Sequence[str], budget: Budget
) -> tuple[list[str], dict[str, NDArray[np.float64]]]:
    with zipfile.ZipFile(file) as archive:
        arrays = {m.filename.removesuffix(ARRAY): m for m in archive.infolist() if m.filename.endswith(ARRAY)}
        _check_count(len(arrays))
        chosen = {name: arrays[name] for name in dict.fromkeys(wanted) if name in arrays}
        budget.check_declared(sum(member.file_size for member in chosen.values()))
        found = {
            name: np.asarray(load_array(archive, member, budget), np.float64)
            for name, member in chosen.items()
        }
    return list(arrays), found


def _of_text(file: Path, wanted: Sequence[str]) -> tuple[list[str], dict[str, NDArray[np.float64]]]:
    with file.open(encoding="utf-8") as text:
        there = [name.strip().strip('"') for name in text.readline().split(",")]
        _check_count(len(there))
        chosen = [name for name in dict.fromkeys(wanted) if name in there]
        places = [there.index(name) for name in chosen]
        rows = np.loadtxt(text, delimiter=",", ndmin=2, usecols=places or None)
    return there, {name: rows[:, i] for i, name in enumerate(chosen)}


def _check_count(count: int) -> None:
    if count > MOST_COLUMNS:
        raise TooLargeError(f"it has {count:,} columns, and at most {MOST_COLUMNS:,} are read")
