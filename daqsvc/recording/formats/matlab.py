"""MATLAB files up to version 7."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.recording.contents import Contents, check_columns, flattened
from daqsvc.recording.errors import RecordingError
from daqsvc.recording.formats.mat_structure import check_mat_structure

if TYPE_CHECKING:
    from pathlib import Path

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
            f"{path} is a MATLAB v7.3 file, which cannot be read; save it in MATLAB with save(..., '-v7')"
        ) from None
    entries = {
        entry: values
        for name, variable in variables.items()
        if not name.startswith("__")
        for entry, values in flattened(name, variable)
    }
    check_columns(len(entries))
    return Contents(entries)
