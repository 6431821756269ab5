"""The errors of recordings."""

from __future__ import annotations


class RecordingError(ValueError):
    """A recording cannot be read, or does not hold what is asked of it."""


class RefusedError(ValueError):
    """A recording cannot be judged; the message names the thing, its value and the remedy."""
