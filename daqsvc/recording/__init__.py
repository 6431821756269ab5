"""Measured recordings: named channels of samples, out of the files that laboratories and loggers write."""


class RecordingError(ValueError):
    """A recording cannot be read, or does not hold what is asked of it."""


class NamesError(RecordingError):
    """Channels cannot be called so; says why, and what to do."""
