"""Numbers that are never used twice, whatever happens to the journal's file.

Consumers drop a message whose number they have seen, so a number that is used twice loses an alarm. The
journal itself knows its highest number, but it can forget: a new file takes the place of a corrupt one; a
write-ahead log with a flipped bit ends, for SQLite, before that bit; a disk that lies about its cache loses
in a power cut what it had confirmed. So a side file of one line tells, apart from the database:

- the *ceiling*, ahead of every number in use and durable before one is used;
- the highest number *used*, without a sync: exact after a crash of the program, not after one of the system;
- which *boot* of the system that was.

Numbers go on without a gap after a proper end and after kill -9. They jump to the ceiling after a power cut
and to the wall clock in ms, far above what was counted up from an earlier start, for a new file.
"""

from __future__ import annotations

import logging
import os
import zlib
from pathlib import Path

from daqsvc.outbox.files import NS_PER_MS, replace_durably

log = logging.getLogger(__name__)

STEP = 1024
"""How far the ceiling is ahead: one sync of the side file for so many numbers."""

UNKNOWN_BOOT = "-"

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_DIGITS = 20


class SequenceMark:
    """The side file.

    Args:
        path: where it is.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._ceiling = 0
        self._used = 0
        self._boot = ""
        self._this_boot = ""
        self._file: int | None = None
        self._noted = True

    def read(self) -> None:
        """Read what the side file tells; without one, nothing is known.

        Raises:
            OSError: it cannot be read.
        """
        self.close()
        self._ceiling, self._used, self._boot = 0, 0, ""
        self._this_boot = boot_id()
        try:
            line = self._path.read_bytes()
        except FileNotFoundError:
            return
        told = line.split()
        if len(told) != 4 or _hexadecimal(told[3]) != zlib.crc32(line[: line.rindex(b" ")]):
            log.warning(
                "outbox mark %s is damaged; sequence numbers go on from the wall clock, or from the journal "
                "if that is ahead",
                self._path,
            )
            return
        self._ceiling, self._used, self._boot = int(told[0]), int(told[1]), told[2].decode("ascii")

    def first_free(self, stored: int | None, wall_ns: int) -> int:
        """The number to go on with.

        Args:
            stored: the highest number that the journal knows; None for a new file.
            wall_ns: the wall clock, ns since the Unix epoch.
        """
        started = wall_ns // NS_PER_MS
        if stored is None or not self._ceiling:
            # Without a mark nobody knows what the journal may have forgotten: only the clock has gone on.
            return max(stored or 0, self._ceiling, started) + 1
        return max(stored, self._used if self._is_exact() else self._ceiling) + 1

    def vanished(self, stored: int | None) -> int:
        """How many numbers were used that the journal does not know, as far as that can be told."""
        if not self._is_exact():
            return 0
        # A new file's numbers start at the wall clock: how many of the old one are gone cannot be told.
        return max(self._used - stored, 0) if stored is not None else 0

    def begin(self, last: int) -> None:
        """Take all numbers up to ``last`` for used; durable with the next `advance`."""
        self._used = max(self._used, last)

    def can_be_used(self, number: int) -> bool:
        """Whether ``number`` may have been given, as far as the side file tells."""
        return not self._ceiling or 0 <= number <= self._ceiling

    def advance(self, last: int) -> None:
        """Have the ceiling above ``last`` before that number is used.

        Raises:
            OSError: the side file cannot be written; no number may be used.
        """
        if last >= self._ceiling or self._file is None:
            self._write(max(last + STEP, self._ceiling), self._used)

    def note(self, used: int) -> None:
        """Tell that numbers up to ``used`` are in the journal."""
        self._used = used
        if self._file is None:
            return
        try:
            os.pwrite(self._file, self._line(), 0)
        except OSError as error:
            # The message is on disk. Only the watch over a journal that forgets is poorer by this.
            if self._noted:
                log.warning("outbox mark %s cannot be written: %s", self._path, error)
            self._noted = False
        else:
            self._noted = True

    def settle(self, last: int) -> None:
        """Tell, durably, that ``last`` is the highest number in use and will stay so for now.

        Raises:
            OSError: the side file cannot be written.
        """
        self._write(last, last)

    def close(self) -> None:
        """Close the side file as it is."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _is_exact(self) -> bool:
        properly_ended = self._used == self._ceiling
        return properly_ended or self._boot == self._this_boot != UNKNOWN_BOOT

    def _write(self, ceiling: int, used: int) -> None:
        before = self._ceiling, self._used, self._boot
        self._ceiling, self._used, self._boot = ceiling, used, self._this_boot
        try:
            replace_durably(self._path, self._line())
        except OSError:
            self._ceiling, self._used, self._boot = before
            raise
        self.close()
        self._file = os.open(self._path, os.O_WRONLY | os.O_CLOEXEC)

    def _line(self) -> bytes:
        """The content of the side file; of one length for one boot, so that it can be written in place."""
        told = f"{self._ceiling:0{_DIGITS}d} {self._used:0{_DIGITS}d} {self._boot}".encode()
        return b"%b %08x\n" % (told, zlib.crc32(told))


def _hexadecimal(text: bytes) -> int | None:
    """The number that ``text`` is, if any."""
    try:
        return int(text, 16)
    except ValueError:
        return None


def boot_id() -> str:
    """Which boot of the system this is; `UNKNOWN_BOOT` where it does not tell."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip() or UNKNOWN_BOOT
    except OSError:
        return UNKNOWN_BOOT
