"""Memory that only the start of the service needs, or a reload, given back when it is over; and few heaps.

Kernels are loaded by the compiler, the largest library of all by far, which nothing calls afterwards. Its
code lies in a file, of which the pages that were read stay mapped until the host runs short of memory.
"""

from __future__ import annotations

import contextlib
import ctypes
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc import heap

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

_MADV_DONTNEED = 4
"""Linux numbers it so (asm-generic/mman-common.h)."""
_M_ARENA_MAX, _HEAPS = -8, 2
"""The C library numbers it so (malloc.h)."""
_MAPPING = re.compile(r"([0-9a-f]+)-([0-9a-f]+) (\S{4}) \S+ \S+ [1-9]\d* +(/.*\.so[.\d]*)$")
_CHANGED = ("Anonymous:", "Swap:")
_ANY = re.compile(r"[0-9a-f]+-[0-9a-f]+ ")


def share_heaps() -> None:
    """Have all threads share two heaps; call before any is begun.

    Else the C library makes one after the other, eight for each core, as blocking calls have their own
    threads. In each a MB or two stay of what is free again, so that a service would grow for long.
    """
    with contextlib.suppress(AttributeError):  # another C library than GNU's
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, _HEAPS)


def give_back() -> None:
    """Release the pages of libraries that have not been changed, and of free memory of the heap; blocks.

    Pages that are needed are mapped again when they are, without reading the file as long as the host has it
    in memory. Where the kernel has no such thing nothing happens.
    """
    if sys.platform != "linux":
        return
    libc = ctypes.CDLL(None)
    with contextlib.suppress(OSError):
        for first, length in unchanged(Path("/proc/self/smaps").read_text(errors="replace").splitlines()):
            libc.madvise(ctypes.c_void_p(first), ctypes.c_size_t(length), _MADV_DONTNEED)
    heap.give_back()


def unchanged(smaps: Iterable[str]) -> Iterator[tuple[int, int]]:
    """Address and length of the parts of shared libraries that are read or run, and were not written to.

    Other files are left alone: they may be unmapped meanwhile, and something else be there. What the loader
    has written to and then protected is no longer what the file holds, in memory or swapped out.

    Args:
        smaps: lines of ``/proc/PID/smaps`` (proc(5)).
    """
    part: tuple[int, int] | None = None
    for line in smaps:
        if _ANY.match(line):
            if part is not None:
                yield part
            mapping = _MAPPING.match(line)
            part = None
            if mapping is not None and "w" not in mapping[3]:
                first = int(mapping[1], 16)
                part = (first, int(mapping[2], 16) - first)
        elif line.startswith(_CHANGED) and line.split()[1] != "0":
            part = None
    if part is not None:
        yield part
