"""The formats of recordings, a module each; a file's suffix says which it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.recording.errors import RecordingError
from daqsvc.recording.formats.delimited import read_csv
from daqsvc.recording.formats.matlab import read_mat
from daqsvc.recording.formats.numpy_archive import read_npz
from daqsvc.recording.formats.parquet import read_parquet
from daqsvc.recording.formats.wav import read_wav

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from daqsvc.recording.contents import Contents

READERS: Mapping[str, Callable[[Path], Contents]] = {
    ".npz": read_npz,
    ".mat": read_mat,
    ".csv": read_csv,
    ".csv.gz": read_csv,
    ".wav": read_wav,
    ".parquet": read_parquet,
}


def read(path: Path) -> Contents:
    """Everything in a file.

    Raises:
        RecordingError: the file cannot be read; nothing else, whatever the file is.
    """
    # Asked first, as the readers say it in words of their own.
    if not path.exists():
        raise RecordingError(f"{path} cannot be read: there is no such file; correct the path")
    name = path.name.lower()
    reader = next((reader for suffix, reader in READERS.items() if name.endswith(suffix)), None)
    if reader is None:
        raise RecordingError(f"{path} is not a kind of file that can be read; use {', '.join(READERS)}")
    try:
        return reader(path)
    except RecordingError:
        raise
    except OSError as error:
        told = error.strerror or _one_line(error)
        raise RecordingError(f"{path} cannot be read: {told}; copy it anew, or give another file") from error
    except MemoryError as error:
        raise RecordingError(
            f"{path} cannot be read: it asks for more memory than there is; "
            "unless it is that large it is damaged, and has to be copied or saved anew"
        ) from error
    except Exception as error:
        # On damaged bytes the libraries behind the readers raise almost anything.
        raise RecordingError(
            f"{path} cannot be read: {_one_line(error)}; it may be damaged: copy or save it anew"
        ) from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
