"""Arrays that lie in a file instead of in memory: a long recording is read piece by piece."""

from __future__ import annotations

import mmap
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

LEAST_BYTES = 32_000_000
"""Smaller arrays are not worth a file."""

_CHUNK_BYTES = 1 << 20


def spilled(
    kind: np.dtype[Any], shape: tuple[int, ...], fill: Callable[[memoryview], object]
) -> NDArray[Any]:
    """An array in a file without a name, which goes with it.

    Args:
        kind: of its items.
        shape: of it.
        fill: fills a piece of it, called for one after the other.

    Raises:
        OSError: there is no place for it.
    """
    left = kind.itemsize * int(np.prod(shape))
    piece = memoryview(bytearray(min(left, _CHUNK_BYTES)))
    with TemporaryFile(prefix="daqsvc-") as file:
        while left:
            part = piece[: min(left, len(piece))]
            fill(part)
            file.write(part)
            left -= len(part)
        file.flush()
        # The map is a map of the file as long as it lives, which is as long as the array.
        content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    return np.frombuffer(content, kind).reshape(shape)


def let_go(array: NDArray[Any]) -> None:
    """Take what has been examined of a spilled array out of memory again; any other stays as it is."""
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, memoryview):
        base = base.obj
    if isinstance(base, mmap.mmap):
        base.madvise(mmap.MADV_DONTNEED)
