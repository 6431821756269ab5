"""A disk that fills: a small tmpfs where it may be mounted, else a limit on the size of files."""

from __future__ import annotations

import asyncio
import contextlib
import resource
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

SIZE_MB = 8
UNLIMITED = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)


class Disk(Protocol):
    """Where the journal is."""

    def fill(self, pid: int) -> None:
        """Leave the process no room to write more."""
        ...

    def free(self, pid: int) -> None:
        """Give the room back."""
        ...


class SmallDisk:
    """A tmpfs; what fills it is a file of nothing."""

    def __init__(self, mount: Path) -> None:
        self._ballast = mount / "ballast"

    def fill(self, pid: int) -> None:
        with self._ballast.open("ab", buffering=0) as ballast, contextlib.suppress(OSError):
            while True:
                ballast.write(bytes(4096))

    def free(self, pid: int) -> None:
        self._ballast.unlink(missing_ok=True)


class LimitedFiles:
    """No file of the process may grow beyond what the largest one of the store is now."""

    def __init__(self, store: Path) -> None:
        self._store = store

    def fill(self, pid: int) -> None:
        largest = max((path.stat().st_size for path in self._store.rglob("*") if path.is_file()), default=0)
        with contextlib.suppress(ProcessLookupError):
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (max(largest, 65536), resource.RLIM_INFINITY))

    def free(self, pid: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            resource.prlimit(pid, resource.RLIMIT_FSIZE, UNLIMITED)


@contextlib.asynccontextmanager
async def small_disk(mount: Path, size_mb: int = SIZE_MB) -> AsyncIterator[Disk]:
    """Mount a small disk at ``mount`` if this process may, else limit what is written there."""
    await asyncio.to_thread(mount.mkdir)
    if await _run("mount", "-t", "tmpfs", "-o", f"size={size_mb}m", "tmpfs", str(mount)):
        try:
            yield SmallDisk(mount)
        finally:
            await _run("umount", "--lazy", str(mount))
    else:
        yield LimitedFiles(mount)


async def _run(*command: str) -> bool:
    """Whether the command exists and works."""
    try:
        process = await asyncio.create_subprocess_exec(
            *command, stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL
        )
    except FileNotFoundError:
        return False
    return await process.wait() == 0
