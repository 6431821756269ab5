"""Ids of commands, on disk before the command is obeyed, so that none is obeyed twice.

A broker that has not seen our acknowledgement sends a command again, after a restart of the service too.
Each id is a line of a small file, with a checksum; the file is written anew when it has grown to twice what
is needed.
"""

from __future__ import annotations

import os
import threading
import zlib
from collections import OrderedDict
from typing import TYPE_CHECKING, Literal

from daqsvc.outbox.files import MODE, replace_durably, restrict, sync_directory

if TYPE_CHECKING:
    from pathlib import Path

REMEMBERED = 4096
"""Ids that can be remembered."""

_READ_AT_MOST = 4 * 1024 * 1024
"""Far more than twice so many lines have; of a longer file the end counts."""


class CommandIds:
    """The ids of the commands that have come, and until when each could still be obeyed.

    Thread-safe: commands may come by several ways at a time.

    Args:
        path: the file; its directory is there.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._until_ns: OrderedDict[tuple[str, str], int] = OrderedDict()
        self._lines: int | None = None
        self._one_at_a_time = threading.Lock()

    def remember(
        self, machine: str, identifier: str, *, until_ns: int, now_ns: int
    ) -> Literal["new", "known", "full"]:
        """Take in an id; on disk when this returns ``"new"``. Blocks.

        Args:
            machine: whom the command is for; without blanks.
            identifier: the command's id; without blanks.
            until_ns: when it will be too old to be obeyed, wall clock.
            now_ns: wall clock.

        Returns:
            Whether it is new, has come before, or cannot be taken in because too many may still come again.

        Raises:
            OSError: the file cannot be read or written; the id is not taken in.
        """
        with self._one_at_a_time:
            return self._remember(machine, identifier, until_ns, now_ns)

    def _remember(
        self, machine: str, identifier: str, until_ns: int, now_ns: int
    ) -> Literal["new", "known", "full"]:
        if self._lines is None:
            self._read()
        key = machine, identifier
        if self._until_ns.get(key, now_ns) > now_ns:
            return "known"
        if len(self._until_ns) >= REMEMBERED and not self._forget(now_ns):
            return "full"
        self._append(_line(key, until_ns))
        self._until_ns[key] = until_ns
        self._until_ns.move_to_end(key)
        if (self._lines or 0) > 2 * REMEMBERED:
            self._rewrite()
        return "new"

    def _forget(self, now_ns: int) -> bool:
        """Forget what is too old by now; whether there was any."""
        old = [key for key, until_ns in self._until_ns.items() if until_ns <= now_ns]
        for key in old:
            del self._until_ns[key]
        return bool(old)

    def _read(self) -> None:
        try:
            handle = os.open(self._path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        except FileNotFoundError:
            self._lines = 0
            return
        with os.fdopen(handle, "rb") as file:
            file.seek(max(os.fstat(handle).st_size - _READ_AT_MOST, 0))
            lines = file.read(_READ_AT_MOST).split(b"\n")
        self._until_ns.clear()
        for line in lines:
            found = _parsed(line)
            if found is not None:
                key, until_ns = found
                self._until_ns[key] = until_ns
                self._until_ns.move_to_end(key)
        while len(self._until_ns) > REMEMBERED:
            self._until_ns.popitem(last=False)
        self._lines = len(lines)

    def _append(self, line: bytes) -> None:
        is_new = self._lines == 0
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
        handle = os.open(self._path, flags, MODE)
        try:
            # A line that a full disk has cut ends where the next one begins.
            written = os.write(handle, b"\n" + line)
            if written < len(line) + 1:
                raise OSError(f"{self._path} takes no more: the disk is full")
            os.fsync(handle)
        finally:
            os.close(handle)
        if is_new:
            restrict(self._path)
            sync_directory(self._path.parent)
        self._lines = (self._lines or 0) + 1

    def _rewrite(self) -> None:
        replace_durably(self._path, b"\n".join(_line(key, until) for key, until in self._until_ns.items()))
        self._lines = len(self._until_ns)


def _line(key: tuple[str, str], until_ns: int) -> bytes:
    text = f"{until_ns} {key[0]} {key[1]}".encode()
    return b"%b %08x" % (text, zlib.crc32(text))


def _parsed(line: bytes) -> tuple[tuple[str, str], int] | None:
    """What a line says; None if it is cut or damaged."""
    text, _, told = line.rpartition(b" ")
    parts = text.split(b" ")
    if len(parts) != 3 or told != b"%08x" % zlib.crc32(text):
        return None
    return (parts[1].decode(), parts[2].decode()), int(parts[0])
