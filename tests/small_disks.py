"""A disk of its own that somebody fills, or that takes no more writes."""

from __future__ import annotations

import contextlib
import os
import subprocess
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


class SmallDisk:
    """A tmpfs.

    Args:
        directory: where it is mounted.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._other = directory / "somebody-else"

    def fill(self, leave: int = 0) -> None:
        """Fill it with something of somebody else's but for so many bytes."""
        with self._other.open("wb", buffering=0) as file, contextlib.suppress(OSError):
            while True:
                disk = os.statvfs(self.directory)
                if disk.f_bavail * disk.f_frsize <= leave:
                    return
                file.write(bytes(4096))

    def free(self) -> None:
        """Give the room back."""
        self._other.unlink()

    def refuse_writes(self) -> None:
        """Take no writes from now on."""
        subprocess.run(["mount", "-o", "remount,ro", self.directory], check=True)

    def take_writes(self) -> None:
        """Take them again."""
        subprocess.run(["mount", "-o", "remount,rw", self.directory], check=True)


@contextlib.contextmanager
def mounted(directory: Path, size: str) -> Iterator[SmallDisk]:
    """A disk of its own, or the test is skipped: mounting is for root."""
    directory.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size},mode=700", "none", str(directory)]
    if subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("this machine lets no test mount a file system")
    try:
        yield SmallDisk(directory)
    finally:
        subprocess.run(["umount", "--lazy", directory], check=True)
