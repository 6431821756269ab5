"""What reading one file may take, and what of it is believed before it is read."""

from __future__ import annotations

import io
import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path
    from typing import BinaryIO

GIGABYTE = 10**9

MOST_EXPANSION = 200
"""No recording is so many times as large as its file: noise does not compress by more than some 10."""

FREE_BYTES = 64_000_000
"""What any file may expand to, however small it is."""

UNBOUNDED = 1 << 62
"""Content of a file that is played piece by piece, of which only the expansion is bounded."""

_BASE_CPU_S = 60.0
_BYTES_PER_CPU_S = 2e6


class TooLargeError(ValueError):
    """A file holds, or states that it holds, more than may be read; the message states how much."""


def default_memory_bytes() -> int:
    """Half of the machine's memory, at most 4 GB."""
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return min(4 * GIGABYTE, machine // 2)


@dataclass(frozen=True, slots=True)
class ResourceLimits:
    """What reading one file may take.

    Attributes:
        memory_bytes: of the process that reads, beyond what it takes by itself.
    """

    memory_bytes: int = field(default_factory=default_memory_bytes)

    @property
    def content_bytes(self) -> int:
        """The most that a file may hold, unpacked: what is made of it takes as much again."""
        return self.memory_bytes // 2

    def cpu_s(self, file_bytes: int) -> float:
        """Processor time for a file of this size."""
        return _BASE_CPU_S + file_bytes / _BYTES_PER_CPU_S


@dataclass(slots=True)
class Budget:
    """How far one file may expand, and how far it has.

    Attributes:
        file_bytes: size of the file.
        content_bytes: see `ResourceLimits`.
        taken_bytes: what has been unpacked of it.
    """

    file_bytes: int
    content_bytes: int
    taken_bytes: int = 0

    @classmethod
    def of(cls, path: Path, limits: ResourceLimits) -> Budget:
        """The budget of a file.

        Raises:
            OSError: there is no such file.
        """
        return cls(path.stat().st_size, limits.content_bytes)

    @property
    def most_bytes(self) -> int:
        """What the file may hold at most."""
        return min(self.content_bytes, max(FREE_BYTES, MOST_EXPANSION * self.file_bytes))

    @property
    def left_bytes(self) -> int:
        """What more of it may be unpacked."""
        return self.most_bytes - self.taken_bytes

    def spend(self, count: int) -> None:
        """Count bytes that have been unpacked.

        Raises:
            TooLargeError: they are too many.
        """
        self.taken_bytes += count
        if self.taken_bytes > self.most_bytes:
            raise TooLargeError(self._why("unpacks to more than", self.most_bytes))

    def check_declared(self, count: float) -> None:
        """Look at what a file states that it holds, in bytes, before any of it is unpacked.

        Raises:
            TooLargeError: that is too much.
        """
        if self.taken_bytes + count > self.most_bytes:
            raise TooLargeError(self._why("claims to unpack to", self.taken_bytes + count))

    def _why(self, does: str, count: float) -> str:
        what = f"its {_size(self.file_bytes)} {does} {_size(count)}"
        if self.most_bytes == self.content_bytes:
            return (
                f"{what}, and {_size(self.content_bytes)} may be read; allow more memory (--max-memory, "
                "or max_memory_gb of a replayed bus), or cut it into shorter ones"
            )
        return f"{what}, {MOST_EXPANSION} times and more, as no recording does; give one that was measured"


class CountedFile(io.RawIOBase):
    """Counts what is read of a file that is unpacked as it is read.

    Args:
        file: open for binary reading.
        budget: of the file; where it ends reading raises `TooLargeError`.
    """

    def __init__(self, file: BinaryIO, budget: Budget) -> None:
        self._file = file
        self._budget = budget

    def readable(self) -> bool:
        """It is."""
        return True

    def readinto(self, buffer: Any) -> int:
        """See `io.RawIOBase.readinto`."""
        data = self._file.read(len(buffer))
        self._budget.spend(len(data))
        buffer[: len(data)] = data
        return len(data)


def _size(count: float) -> str:
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:,.3g} {unit}"
    return f"{count:.0f} bytes"
