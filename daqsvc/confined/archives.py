"""NumPy archives whose members say how large they are, and may say anything."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib import format as npy

if TYPE_CHECKING:
    import zipfile
    from typing import IO

    from numpy.typing import NDArray

    from daqsvc.confined.limits import Budget

_CHUNK_BYTES = 1 << 20


def load_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo, budget: Budget) -> NDArray[Any]:
    """An array of an archive; one of Python objects, which could run code, comes back empty.

    Args:
        archive: open.
        member: of it.
        budget: of the file; what the array takes is counted.

    Raises:
        ValueError: it is no array, or not as large as it states.
        TooLargeError: it is larger than it may be.
        zipfile.BadZipFile, zlib.error, EOFError: it is damaged.
    """
    with archive.open(member) as file:
        shape, fortran, dtype = _header(file)
        if dtype.hasobject:
            return np.empty(0, dtype=object)
        count = math.prod(shape)
        size = count * dtype.itemsize
        if min(shape, default=0) < 0 or size > member.file_size:
            raise ValueError(f"{member.filename!r} claims to hold {size} bytes in {member.file_size}")
        budget.check_declared(size)
        content = bytearray(size)
        view = memoryview(content)
        at = 0
        while at < size:
            chunk = file.read(min(size - at, _CHUNK_BYTES))
            if not chunk:
                raise EOFError(f"{member.filename!r} ends after {at} of {size} bytes")
            view[at : at + len(chunk)] = chunk
            at += len(chunk)
            budget.spend(len(chunk))
        if file.read(1):
            raise ValueError(f"{member.filename!r} holds more than it claims")
    array = np.frombuffer(content, dtype, count) if size else np.empty(count, dtype)
    return array.reshape(shape, order="F" if fortran else "C")


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    version = npy.read_magic(file)
    if version == (1, 0):
        return npy.read_array_header_1_0(file)
    if version == (2, 0):
        return npy.read_array_header_2_0(file)
    # (3, 0) differs from (2, 0) only in the encoding of field names, which samples have none of.
    raise ValueError(f"arrays of format {version} cannot be read")
