"""Measured recordings: named channels of samples, out of the files that laboratories and loggers write."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from daqsvc.errors.code import Code


class RecordingError(ValueError):
    """A recording cannot be read, or does not hold what is asked of it.

    Args:
        message: names the file, what is wrong with it, and the remedy.
        code: of the kind of fault.
    """

    def __init__(self, message: str, code: Code) -> None:
        super().__init__(message)
        self.code = code


class NamesError(RecordingError):
    """Channels cannot be called so; states why, and what to do."""
