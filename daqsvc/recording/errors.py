"""The error of recordings."""

from __future__ import annotations


class RecordingError(ValueError):
    """A recording cannot be read, or does not hold what is asked of it."""
