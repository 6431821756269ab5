"""NumPy archives (``numpy.savez``)."""

from __future__ import annotations

import zipfile
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.recording.contents import Contents, flattened
from daqsvc.recording.errors import RecordingError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.lib.npyio import NpzFile
    from numpy.typing import NDArray


def read_npz(path: Path) -> Contents:
    """All arrays; Python objects stay unread, as they could run code."""
    with path.open("rb") as file:
        if not zipfile.is_zipfile(file):
            raise RecordingError(
                f"{path} cannot be read: it is not a zip archive, as numpy.savez writes; "
                "save it anew, or give it the suffix of what it is"
            )
        with np.load(file, allow_pickle=False) as archive:
            return Contents(
                {
                    entry: values
                    for name in archive.files
                    for entry, values in flattened(name, _unless_objects(archive, name))
                }
            )


def _unless_objects(archive: NpzFile, name: str) -> NDArray[np.generic]:
    try:
        return np.asarray(archive[name])
    except ValueError as error:
        if "pickle" not in str(error):
            raise
        return np.empty(0, dtype=object)
