"""The formats of recordings, a module each; a file's suffix states which it is."""

from __future__ import annotations

import stat
from typing import TYPE_CHECKING

from daqsvc.confined.limits import Budget, TooLargeError
from daqsvc.errors.recordings import DAMAGED, NEEDS_MACHINE_FILE, NOT_FOUND, TOO_LARGE, UNKNOWN_FORMAT
from daqsvc.recording import RecordingError
from daqsvc.recording.formats.delimited import read_csv
from daqsvc.recording.formats.hdf5 import read_hdf5
from daqsvc.recording.formats.matlab import read_mat
from daqsvc.recording.formats.mdf import read_mdf
from daqsvc.recording.formats.numpy_archive import read_npz
from daqsvc.recording.formats.parquet import read_parquet
from daqsvc.recording.formats.snapshot import read_snapshot_channels
from daqsvc.recording.formats.tdms import read_tdms
from daqsvc.recording.formats.uff import read_uff
from daqsvc.recording.formats.wav import read_wav

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping
    from pathlib import Path

    from daqsvc.confined.limits import ResourceLimits
    from daqsvc.recording.contents import Contents

READERS: Mapping[str, Callable[[Path, Budget], Contents]] = {
    ".npz": read_npz,
    ".mat": read_mat,
    ".csv": read_csv,
    ".csv.gz": read_csv,
    ".wav": read_wav,
    ".parquet": read_parquet,
    ".tdms": read_tdms,
    ".mf4": read_mdf,
    ".uff": read_uff,
    ".unv": read_uff,
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".mcap": read_snapshot_channels,
}


CAN_LOGS = (".blf", ".asc", ".log", ".trc")
"""How the names of CAN logs end; ``.gz`` may follow."""

_LONGEST_REASON = 300


def named_as_table(path: Path) -> bool:
    """Whether a file is one that `read` reads, by its name."""
    return path.name.lower().endswith(tuple(READERS))


def named_as_can_log(path: Path) -> bool:
    """Whether a file is a CAN log by its name."""
    return path.name.lower().removesuffix(".gz").endswith(CAN_LOGS)


def find(path: Path) -> tuple[Callable[[Path, Budget], Contents], int]:
    """The reader of a file, and its size in bytes.

    Raises:
        RecordingError: there is no such file, or none that can be read.
    """
    # Asked first, as the readers report it in their own words.
    try:
        status = path.stat()
    except FileNotFoundError:
        raise RecordingError(
            f"{path} cannot be read: there is no such file; correct the path", NOT_FOUND
        ) from None
    except (OSError, ValueError) as error:
        raise RecordingError(
            f"{path!s:.200} cannot be read: {_one_line(error)}; correct the path", NOT_FOUND
        ) from None
    name = path.name.lower()
    reader = next((reader for suffix, reader in READERS.items() if name.endswith(suffix)), None)
    if reader is None and named_as_can_log(path):
        raise RecordingError(
            f"{path} is a CAN log, which only the layouts of a machine file make sense of: name that first",
            NEEDS_MACHINE_FILE,
        )
    if reader is None:
        raise RecordingError(
            f"{path} is not a kind of file that can be read; use {', '.join(READERS)}", UNKNOWN_FORMAT
        )
    if not stat.S_ISREG(status.st_mode):
        raise RecordingError(
            f"{path} cannot be read: it is no file but a folder, pipe or device; give a file", NOT_FOUND
        )
    return reader, status.st_size


def read(path: Path, limits: ResourceLimits, wanted: Collection[str] | None = None) -> Contents:
    """Everything in a file.

    Args:
        path: the file.
        limits: of reading it.
        wanted: the channels whose samples are examined; None: all. Of others, where they are too large,
            some formats state the length only.

    Raises:
        RecordingError: the file cannot be read.
        MemoryError: it asks for more than there is; nothing else, whatever the file is.
    """
    reader, _ = find(path)
    try:
        budget = Budget.of(path, limits)
        return read_hdf5(path, budget, wanted) if reader is read_hdf5 else reader(path, budget)
    except (RecordingError, MemoryError):
        raise
    except TooLargeError as error:
        raise RecordingError(f"{path} is too large: {error}", TOO_LARGE) from None
    except OSError as error:
        reason = error.strerror or _one_line(error)
        raise RecordingError(
            f"{path} cannot be read: {reason}; copy it again, or give another file", NOT_FOUND
        ) from error
    except RecursionError as error:
        raise RecordingError(
            f"{path} cannot be read: what it holds is nested too deep; save the channels themselves", DAMAGED
        ) from error
    except Exception as error:
        # On damaged bytes the libraries behind the readers raise almost anything.
        raise RecordingError(
            f"{path} cannot be read: {_one_line(error)}; it may be damaged: copy or save it again", DAMAGED
        ) from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:_LONGEST_REASON] or type(error).__name__
