"""Whether a recording could not be judged for what it holds, or for how the computer was at that time."""

from __future__ import annotations

import errno
import os
from typing import TYPE_CHECKING

from daqsvc.confined.process import ConfinedError, RaisedThereError

if TYPE_CHECKING:
    from collections.abc import Iterator

_OF_CONTENT = {errno.EINVAL, errno.EOVERFLOW, errno.ERANGE, errno.EDOM, errno.EILSEQ, errno.EFBIG}
"""What the system states about a place that a damaged file names."""
_OWN_FAULTS = ("SIGSEGV", "SIGABRT", "SIGFPE", "SIGILL")
"""Ends of a process that the bytes it reads bring about; any other comes from outside."""
_KILLED = "SIGKILL"
_SYSTEM_ERRORS = tuple(
    f"cannot be read: {reason}"
    for reason in (
        "there is no such file",
        *(os.strerror(code) for code in sorted(errno.errorcode) if code not in _OF_CONTENT),
    )
)
"""Of errors of the system only their words come back from the process that reads."""


def is_passing(error: BaseException) -> bool:
    """Whether another run may get further with the same bytes.

    So it is if there was no more memory, time or room, if the process that reads was killed, or if the system
    could not read.

    Args:
        error: that came of a recording or a machine file.
    """
    return any(_is_passing(one) for one in _chain(error))


def was_killed(error: BaseException) -> bool:
    """Whether the process that reads was killed from outside, as when the computer runs out of memory."""
    return any(isinstance(one, ConfinedError) and _KILLED in one.how for one in _chain(error))


def _is_passing(error: BaseException) -> bool:
    if isinstance(error, ConfinedError):
        return error.reason != "crash" or not any(fault in error.how for fault in _OWN_FAULTS)
    if isinstance(error, RaisedThereError):
        return any(text in error.message for text in _SYSTEM_ERRORS)
    if isinstance(error, OSError):  # of libraries' own kinds, as for a damaged gzip, there is no number
        return error.errno is not None and error.errno not in _OF_CONTENT
    return isinstance(error, MemoryError)


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """An error and what it was raised over, shown or not."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        yield error
        error = error.__cause__ or error.__context__
