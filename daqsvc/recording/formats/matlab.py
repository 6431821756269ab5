"""MATLAB files up to version 7."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.recording.contents import Contents, flattened
from daqsvc.recording.errors import RecordingError

if TYPE_CHECKING:
    from pathlib import Path


def read_mat(path: Path) -> Contents:
    """All variables; fields of structs have dotted names."""
    from scipy.io import loadmat  # noqa: PLC0415 - slow to import, and only this format needs it

    try:
        variables = loadmat(path, squeeze_me=True, struct_as_record=False)
    except NotImplementedError:
        raise RecordingError(
            f"{path} is a MATLAB v7.3 file, which cannot be read; save it in MATLAB with save(..., '-v7')"
        ) from None
    return Contents(
        {
            entry: values
            for name, variable in variables.items()
            if not name.startswith("__")
            for entry, values in flattened(name, variable)
        }
    )
