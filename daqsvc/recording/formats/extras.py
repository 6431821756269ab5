"""The libraries that read some formats: extras, which not every installation has."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from daqsvc.errors.command_line import EXTRA_MISSING
from daqsvc.recording import RecordingError

if TYPE_CHECKING:
    from pathlib import Path


def needed(path: Path, library: str, package: str) -> Any:
    """Import the library that a file needs: here, as it is slow to import, and only its format needs it.

    Args:
        path: the file, for the message.
        library: the module.
        package: what brings it.

    Raises:
        RecordingError: it is not installed.
    """
    try:
        return importlib.import_module(library)
    except ModuleNotFoundError as error:
        if error.name != library.partition(".")[0]:
            raise
        raise RecordingError(
            f"{path} needs {package}; install it with: pip install 'daqsvc[formats]'", EXTRA_MISSING
        ) from error
