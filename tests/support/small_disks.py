"""A separate disk that somebody fills, or that takes no more writes."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import struct
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
    """A separate disk, or the test is skipped: mounting is for root."""
    directory.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size},mode=700", "none", str(directory)]
    if subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("this machine lets no test mount a file system")
    try:
        yield SmallDisk(directory)
    finally:
        subprocess.run(["umount", "--lazy", directory], check=True)


_SHUT_DOWN = 0x8004587D
"""EXT4_IOC_SHUTDOWN."""


class FailingDisk:
    """A separate ext4 that can be made to fail as one does whose disk answers with errors.

    Args:
        image: file that holds it.
        directory: where it is mounted.
    """

    def __init__(self, image: Path, directory: Path) -> None:
        self.directory = directory
        self._image = image

    def mount(self) -> None:
        """Mount it; what its journal knows is made good."""
        subprocess.run(["mount", "-o", "loop", self._image, self.directory], check=True)

    def unmount(self) -> None:
        """Have the system forget what is not on it."""
        subprocess.run(["umount", self.directory], check=True)

    def fail(self, how: int) -> None:
        """Take no more writes, and sync nothing.

        Args:
            how: 0 to write everything first, 1 to write what its journal has, 2 to write nothing.
        """
        handle = os.open(self.directory, os.O_RDONLY)
        try:
            fcntl.ioctl(handle, _SHUT_DOWN, struct.pack("I", how))
        finally:
            os.close(handle)


@contextlib.contextmanager
def failing(directory: Path) -> Iterator[FailingDisk]:
    """Such a disk, mounted, or the test is skipped."""
    if shutil.which("mkfs.ext4") is None:
        pytest.skip("there is no mkfs.ext4 (apt-get install e2fsprogs)")
    mount, image = directory / "failing", directory / "image"
    mount.mkdir()
    with image.open("wb") as file:
        file.truncate(24 * 1024 * 1024)
    subprocess.run(["mkfs.ext4", "-q", "-E", "root_owner=0:0", image], check=True)
    disk = FailingDisk(image, mount)
    try:
        disk.mount()
    except subprocess.CalledProcessError:
        pytest.skip("this machine lets no test mount a file system")
    try:
        yield disk
    finally:
        subprocess.run(["umount", "--lazy", mount], check=False, capture_output=True)
