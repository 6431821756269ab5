"""Ids of commands, on disk before the command is carried out, so that none is carried out twice.

A broker that has not seen our acknowledgement sends a command again, after a restart of the service too.
Each id is a line of a small file, with a checksum; the file is written again when it has grown to twice what
is needed. It is there before the journal of a new store is, with one line at least. So beside a journal a
file that is missing, empty or has a damaged line has lost ids, and commands that were issued before the start
are refused.
"""

from __future__ import annotations

import logging
import os
import threading
import zlib
from collections import OrderedDict
from typing import TYPE_CHECKING, Literal

from daqsvc.errors.code import coded
from daqsvc.errors.service import DISK_REFUSES, NOT_REMEMBERED
from daqsvc.outbox.files import NEW_MODE, may_pass, replace_durably

if TYPE_CHECKING:
    from pathlib import Path

REMEMBERED = 4096
"""Ids that can be remembered."""

_READ_AT_MOST = 4 * 1024 * 1024
"""Far more than twice so many lines have; of a longer file the end counts."""

_HEAD = ("-", "-")
"""What the first line names, so that a file without an id is not an empty one."""

log = logging.getLogger(__name__)


class CommandIds:
    """The ids of the commands that have come, and until when each could still be carried out.

    Thread-safe: commands may come by several ways at a time.

    Args:
        path: the file; its directory is there.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._until_ns: OrderedDict[tuple[str, str], int] = OrderedDict()
        self._lines: int | None = None
        self._lost_until_ns = 0
        self._one_at_a_time = threading.Lock()

    def open(self, begun_ns: int, *, is_new: bool) -> bool:
        """Read the file at the start of the service. Blocks.

        If ids that were there are gone, it is not known which commands have come: all that were issued before
        this start are refused, see `is_from_before`.

        Args:
            begun_ns: the start, wall clock.
            is_new: whether the store is new, so that there need not be a file.

        Returns:
            Whether ids that were there are gone.
        """
        with self._one_at_a_time:
            try:
                is_whole = self._read()
                if is_whole is None and is_new:
                    self._rewrite()
            except OSError as error:
                log.warning(
                    "the ids of commands in %s cannot be read or written: %s",
                    self._path,
                    error,
                    extra=coded(NOT_REMEMBERED),
                )
                is_whole = None
            lost = not is_whole and not (is_whole is None and is_new)
            if not lost:
                return False
            self._lost_until_ns = begun_ns
            log.error(
                "the list of commands that have come, %s, is missing or damaged: commands that were issued "
                "before this start are refused, as they may have been carried out already",
                self._path,
                extra=coded(NOT_REMEMBERED),
            )
            try:
                self._rewrite()
            except OSError as error:
                log.warning(
                    "the ids of commands in %s cannot be written: %s",
                    self._path,
                    error,
                    extra=coded(DISK_REFUSES),
                )
            return True

    def begin(self) -> None:
        """Make the file of a new store on disk, before its journal: else it would seem lost. Blocks.

        Raises:
            OSError: the disk is full or takes no writes; what will not pass by itself is only logged.
        """
        with self._one_at_a_time:
            if os.path.lexists(self._path):
                return
            try:
                self._rewrite()
            except OSError as error:
                if may_pass(error):
                    raise
                log.warning(
                    "the ids of commands in %s cannot be written: %s",
                    self._path,
                    error,
                    extra=coded(DISK_REFUSES),
                )

    def is_from_before(self, issued_ns: int) -> bool:
        """Whether a command of that time may have come before, with its id lost; wall clock."""
        return issued_ns <= self._lost_until_ns

    def remember(
        self, machine: str, identifier: str, *, until_ns: int, now_ns: int
    ) -> Literal["new", "known", "full"]:
        """Take in an id; on disk when this returns ``"new"``. Blocks.

        Args:
            machine: whom the command is for; without blanks.
            identifier: the command's id; without blanks.
            until_ns: when it will be too old to be carried out, wall clock.
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
        if self._lines is None and self._read() is None:
            self._rewrite()  # at once or not at all: a full disk must not leave it empty
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

    def _read(self) -> bool | None:
        """Read the file; whether it holds all that was written to it, None if it is not there."""
        try:
            handle = os.open(self._path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        except FileNotFoundError:
            return None
        with os.fdopen(handle, "rb") as file:
            file.seek(max(os.fstat(handle).st_size - _READ_AT_MOST, 0))
            lines = file.read(_READ_AT_MOST).split(b"\n")
        self._until_ns.clear()
        is_whole = any(lines)
        for line in lines:
            parsed = _parsed(line)
            if parsed is None:
                is_whole &= not line
            elif parsed[0] != _HEAD:
                key, until_ns = parsed
                self._until_ns[key] = until_ns
                self._until_ns.move_to_end(key)
        while len(self._until_ns) > REMEMBERED:
            self._until_ns.popitem(last=False)
        self._lines = len(lines)
        return is_whole

    def _append(self, line: bytes) -> None:
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
        handle = os.open(self._path, flags, NEW_MODE)
        try:
            # A line that a full disk has cut ends where the next one begins.
            written = os.write(handle, b"\n" + line)
            if written < len(line) + 1:
                raise OSError(f"{self._path} takes no more: the disk is full")
            os.fsync(handle)
        finally:
            os.close(handle)
        self._lines = (self._lines or 0) + 1

    def _rewrite(self) -> None:
        lines = [_line(_HEAD, 0), *(_line(key, until) for key, until in self._until_ns.items())]
        replace_durably(self._path, b"\n".join(lines))
        self._lines = len(lines)


def _line(key: tuple[str, str], until_ns: int) -> bytes:
    text = f"{until_ns} {key[0]} {key[1]}".encode()
    return b"%b %08x" % (text, zlib.crc32(text))


def _parsed(line: bytes) -> tuple[tuple[str, str], int] | None:
    """What a line states; None if it is cut or damaged."""
    text, _, check = line.rpartition(b" ")
    parts = text.split(b" ")
    if len(parts) != 3 or check != b"%08x" % zlib.crc32(text):
        return None
    return (parts[1].decode(), parts[2].decode()), int(parts[0])
