"""NumPy archives (``numpy.savez``)."""

from __future__ import annotations

import zipfile
from typing import TYPE_CHECKING

from daqsvc.confined.archives import load_array
from daqsvc.errors.recordings import DAMAGED, UNKNOWN_FORMAT
from daqsvc.recording import RecordingError
from daqsvc.recording.contents import Contents, check_columns, flattened

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.confined.limits import Budget

ARRAY = ".npy"
"""How the names of members end that are arrays."""
ZIP_BEGIN = b"PK\x03\x04"
"""How archives begin."""


def read_npz(path: Path, budget: Budget) -> Contents:
    """All arrays; Python objects stay unread, as they could run code."""
    with path.open("rb") as file:
        if not zipfile.is_zipfile(file):
            file.seek(0)
            if file.read(len(ZIP_BEGIN)) == ZIP_BEGIN:
                raise RecordingError(
                    f"{path} cannot be read: it is cut short, as the directory at its end is missing; copy "
                    "it again, or give another file",
                    DAMAGED,
                )
            raise RecordingError(
                f"{path} cannot be read: it is not a zip archive, as numpy.savez writes; "
                "save it again, or give it the suffix of what it is",
                UNKNOWN_FORMAT,
            )
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            check_columns(len(members))
            budget.check_declared(sum(member.file_size for member in members))
            return Contents(
                {
                    entry: values
                    for member in members
                    if member.filename.endswith(ARRAY)
                    for entry, values in flattened(
                        member.filename.removesuffix(ARRAY), load_array(archive, member, budget)
                    )
                }
            )
