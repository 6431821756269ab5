"""The heap of the process: what is free of it goes back to the operating system."""

from __future__ import annotations

import contextlib
import ctypes
import sys


def give_back() -> None:
    """Release free memory, which the C library keeps for later; takes some milliseconds.

    Worth while around what needs very much for a moment. Where there is no such thing nothing happens.
    """
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError):  # another C library than GNU's
            ctypes.CDLL(None).malloc_trim(0)
