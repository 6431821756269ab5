"""Numbers that are never used twice, whatever happens to the journal's file.

Consumers drop a message whose number they have seen, so a number that is used twice loses an alarm. The
journal itself knows its highest number, but it can forget: a new file takes the place of a corrupt one. A
write-ahead log with a flipped bit ends, for SQLite, before that bit; a disk that lies about its cache loses
in a power cut what it had confirmed. So two side files of one line each state, apart from the database:

- the *ceiling*, ahead of every number in use and durable before one is used;
- the highest number *used* and the *first* one of this run, without a sync: a lower bound after a crash;
- which *boot* of the system that was, and in which *place*: a copy of the store is in another one;
- whether the run has *ended* properly, or the broker may be *ahead* of the journal: messages went out while
  the disk took none.

They are written one after the other, in place, so that a torn or a damaged one never leaves none, and a full
disk stops neither. A disk that takes no writes at all stops both: then numbers may be given up to
`UNRECORDED` above the ceiling, for messages in memory.

Every run begins above all of these and above the wall clock in ms, also one that can write nothing. A run
uses far fewer than a thousand numbers a second, so the next one begins above it without any trace on the
disk. After an end that was not a proper one some more are skipped if the clock is not ahead of them. A
run begins far ahead when a side file is damaged or missing.
"""

from __future__ import annotations

import logging
import os
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.errors.code import coded
from daqsvc.errors.service import DISK_REFUSES, JOURNAL_DAMAGED
from daqsvc.outbox.files import NS_PER_MS, is_full, overwrite_durably, read_whole, replace_durably, restrict

if TYPE_CHECKING:
    from typing import BinaryIO

log = logging.getLogger(__name__)

STEP = 1024
"""How far the ceiling is ahead: one sync of the side files for so many numbers."""

LEAP = 10_000_000
"""How far numbers jump where it is not known any more what was used: hours of the worst flood of alarms."""

UNRECORDED = 10_000_000
"""Numbers above the ceiling that may be given while no side file can be written. A run whose wall clock is so
far behind that it is not set skips them after an end that was not a proper one, used or not."""

MARGIN = 10_000
"""Numbers that a run may be ahead of the wall clock with none of them recorded: so many come in a burst."""

UNKNOWN_BOOT = "-"

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_DIGITS = 20
_LONGEST = 1024


@dataclass(frozen=True, slots=True)
class _Told:
    """What a side file states; see the top of this module."""

    ceiling: int
    used: int
    first: int
    boot: str
    place: str
    ended: bool
    ahead: bool = False

    def line(self) -> bytes:
        """As it is written; of one length for one boot and place, so that it can be written in place."""
        figures = " ".join(f"{number:0{_DIGITS}d}" for number in (self.ceiling, self.used, self.first))
        how = "ended" if self.ended else "ahead" if self.ahead else "going"
        text = f"{figures} {self.boot} {self.place} {how}".encode()
        return b"%b %08x\n" % (text, zlib.crc32(text))


_NOTHING = _Told(0, 0, 0, "", "", ended=True)


class SequenceMark:
    """The side files.

    Args:
        path: where the first one is; its twin is beside it.
    """

    def __init__(self, path: Path) -> None:
        self._sides = (_Side(path), _Side(path.with_name(path.name + ".twin")))
        self._mark = _NOTHING
        self._here = _NOTHING
        self._damaged = False
        self._ended = False
        self._is_unsure = False
        self._is_copy = False
        self._has_begun = False
        self._first = 0
        self._noted = True

    def read(self, place: str) -> None:
        """Read what the side files state; without one, nothing is known.

        Args:
            place: where the store is by now, see `place_of`.
        """
        self.close()
        self._here = replace(_NOTHING, boot=boot_id(), place=place)
        sides = [side.read() for side in self._sides]
        sound = [mark for mark in sides if mark is not None]
        # An earlier version wrote the first one alone, and stated nothing of the place.
        is_earlier = [mark is not None and not mark.place for mark in sides] == [True, False]
        self._damaged = 0 < len(sound) < len(sides) and not is_earlier
        self._damaged |= any(
            side.is_there and mark is None for side, mark in zip(self._sides, sides, strict=True)
        )
        if self._damaged:
            log.warning(
                "outbox mark %s or its twin is damaged or missing: sequence numbers jump ahead",
                self._sides[0].path,
                extra=coded(JOURNAL_DAMAGED),
            )
        newest = max(sound, key=lambda mark: (mark.ceiling, mark.used), default=_NOTHING)
        self._mark = replace(
            newest,
            used=max((mark.used for mark in sound), default=0),
            ended=newest.ended and all(mark.ceiling == newest.ceiling for mark in sound),
            ahead=any(mark.ahead for mark in sound),
        )
        self._ended = not self._damaged and (self._mark.ended or self._mark.boot != self._here.boot)
        self._is_unsure = bool(self._mark.ceiling) and not self._mark.ended
        self._is_copy = bool(self._mark.place) and self._mark.place != place
        self._has_begun = False

    @property
    def ended(self) -> bool:
        """Whether the run that wrote last came to a proper end, or this system has booted since."""
        return self._ended

    @property
    def is_ahead(self) -> bool:
        """Whether the broker may have received what the journal does not have."""
        return self._mark.ahead

    @property
    def is_damaged(self) -> bool:
        """Whether a side file is damaged or missing, as far as that can be known."""
        return self._damaged

    @property
    def used(self) -> int:
        """The highest number that is known to have been used."""
        return self._mark.used

    def first_free(self, stored: int | None, wall_ns: int) -> int:
        """The number to go on with.

        Args:
            stored: the highest number that the journal knows; None for a new file.
            wall_ns: the wall clock, ns since the Unix epoch.
        """
        known = max(stored or 0, self._mark.ceiling, self._mark.used)
        wall_ms = wall_ns // NS_PER_MS
        if self._damaged or (stored is not None and not self._mark.ceiling):
            return max(known, wall_ms) + LEAP + 1
        if stored is not None and self._has_begun:
            return known + 1
        if _is_unset(wall_ms, known):
            known += UNRECORDED if self._is_unsure or self._is_copy else 0
        elif self._is_unsure:
            known += 2 * MARGIN  # twice: a run that could not be recorded may have begun above the first
        return max(known, wall_ms) + 1

    def first_unread(self, wall_ns: int, *, is_new: bool) -> int:
        """The number to begin with while the journal cannot be read, above whatever that may hold.

        Args:
            wall_ns: the wall clock, ns since the Unix epoch.
            is_new: whether there is no journal yet.
        """
        known = max(self._mark.ceiling, self._mark.used)
        wall_ms = wall_ns // NS_PER_MS
        if self._damaged or not (known or is_new):
            return max(known, wall_ms) + LEAP + 1
        if _is_unset(wall_ms, known):
            known += UNRECORDED
        elif self._is_unsure:
            known += MARGIN
        return max(known, wall_ms) + 1

    def vanished(self, stored: int | None) -> int:
        """How many messages the journal knew and does not know any more, at least.

        Args:
            stored: the highest number that it knows; None for a new file.
        """
        if not self._mark.used:
            return 0
        return max(self._mark.used - max(stored or 0, self._mark.first - 1), 0)

    def begin(self, first: int, waiting: int | None = None) -> None:
        """All numbers below ``first`` are taken for used; durable with the next `advance`.

        Args:
            first: the number to go on with.
            waiting: the first number of those that wait in memory; None if none do.
        """
        self._first = first if waiting is None else min(first, waiting)
        self._is_unsure = self._is_copy = False
        self._has_begun = True
        here = self._here
        ceiling = max(self._mark.ceiling, first - 1)
        self._mark = replace(self._mark, ceiling=ceiling, boot=here.boot, place=here.place, ended=False)

    def can_be_used(self, number: int) -> bool:
        """Whether ``number`` may have been given, as far as the side files show."""
        return not self._mark.ceiling or self._damaged or 0 <= number <= self._mark.ceiling

    def advance(self, last: int) -> None:
        """Have the ceiling above ``last`` before that number is used.

        Raises:
            OSError: neither side file can be written; no number may be used.
        """
        if last >= self._mark.ceiling or not any(side.is_open for side in self._sides):
            self._write(replace(self._mark, ceiling=max(last + STEP, self._mark.ceiling)))

    def give(self, last: int) -> None:
        """Have numbers up to ``last`` for messages in memory, on a disk that takes no writes, too.

        Raises:
            OSError: neither side file can be written, and the numbers above the ceiling are used up.
        """
        try:
            self.advance(last)
        except OSError:
            if last > self._mark.ceiling + UNRECORDED:
                raise

    def drift(self, *, ahead: bool) -> None:
        """Write, durably if the disk takes it, whether the broker may be ahead of the journal."""
        if ahead == self._mark.ahead:
            return
        self._mark = replace(self._mark, ahead=ahead)
        try:
            self._write(self._mark)
        except OSError as error:
            log.warning(
                "outbox mark %s cannot be written: %s; if the service is killed before it can, the broker "
                "may go on showing states that the journal does not know",
                self._sides[0].path,
                error,
                extra=coded(DISK_REFUSES),
            )

    def note(self, used: int) -> None:
        """Write down that numbers up to ``used`` are in the journal.

        Raises:
            OSError: the disk takes no writes any more; what it confirmed last may be lost, too.
        """
        first = self._first if self._mark.used < self._first else self._mark.first
        mark = replace(self._mark, used=used, first=first)
        errors: list[OSError] = []
        for side in self._sides:
            try:
                side.note(mark.line())
            except OSError as error:
                errors.append(error)
        if len(errors) == len(self._sides) and not is_full(errors[0]):
            raise errors[0]
        if errors and self._noted:
            log.warning(
                "outbox mark %s cannot be written: %s",
                self._sides[0].path,
                errors[0],
                extra=coded(DISK_REFUSES),
            )
        self._noted = not errors
        self._mark = mark

    def settle(self, last: int) -> None:
        """Write to disk that ``last`` is the highest number in use, as it stays for now.

        Raises:
            OSError: a side file cannot be written; the next run goes on above the ceiling.
        """
        self._write(replace(self._mark, ceiling=last, ended=True), both=True)

    def close(self) -> None:
        """Close the side files as they are."""
        for side in self._sides:
            side.close()

    def _write(self, mark: _Told, *, both: bool = False) -> None:
        """Write the side files; one of them at least, or ``both``."""
        errors: list[OSError] = []
        for side in self._sides:
            try:
                side.write(mark.line())
            except OSError as error:
                errors.append(error)
        if errors and (both or len(errors) == len(self._sides)):
            raise errors[0]
        for failure in errors:
            log.warning(
                "one of the outbox marks %s cannot be written: %s",
                self._sides[0].path,
                failure,
                extra=coded(DISK_REFUSES),
            )
        self._mark = mark


def _is_unset(wall_ms: int, known: int) -> bool:
    """Whether the wall clock is so far behind the numbers that it cannot be used to check them."""
    return wall_ms <= known - UNRECORDED


class _Side:
    """One side file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.is_there = False
        self._file: int | None = None
        self._size = 0

    @property
    def is_open(self) -> bool:
        return self._file is not None

    def read(self) -> _Told | None:
        """What it states; None if it is not there or damaged."""
        self._size, self.is_there = 0, False
        restrict(self.path)
        try:
            line = read_whole(self.path, _LONGEST)
        except FileNotFoundError:
            return None
        except OSError as error:
            log.warning("outbox mark %s cannot be read: %s", self.path, error, extra=coded(DISK_REFUSES))
            line = b""
        self._size, self.is_there = len(line), True
        return _understood(line)

    def write(self, line: bytes) -> None:
        """Have it hold ``line``, durably."""
        if self._file is not None and not os.fstat(self._file).st_nlink:
            self.close()  # somebody has deleted it
        if self._file is None and self._size == len(line):
            self._file = _opened(self.path)
        if self._file is not None:
            overwrite_durably(self._file, line)
            return
        replace_durably(self.path, line)
        self._file = _opened(self.path)
        self._size = len(line)

    def note(self, line: bytes) -> None:
        """Write ``line`` into the file; the disk has it sooner or later."""
        if self._file is not None:
            os.pwrite(self._file, line, 0)

    def close(self) -> None:
        """Close the file as it is."""
        if self._file is not None:
            file, self._file = self._file, None
            try:
                os.close(file)
            except OSError as error:
                log.warning(
                    "outbox mark %s cannot be closed: %s", self.path, error, extra=coded(DISK_REFUSES)
                )


def _opened(path: Path) -> int | None:
    try:
        return os.open(path, os.O_WRONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except FileNotFoundError:
        return None


def _understood(line: bytes) -> _Told | None:
    fields = line.split()
    if len(fields) not in {4, 7} or _hexadecimal(fields[-1]) != zlib.crc32(line[: line.rfind(b" ")]):
        return None
    try:
        words = [word.decode("ascii") for word in fields[:-1]]
        if (
            len(words) == 3
        ):  # of an earlier version, which had ended properly if it used all up to its ceiling
            ceiling, used = int(words[0]), int(words[1])
            return _Told(ceiling, used, 0, words[2], "", ended=ceiling == used)
        ceiling, used, first = (int(word) for word in words[:3])
    except ValueError:
        return None
    boot, place, how = words[3:]
    return _Told(ceiling, used, first, boot, place, ended=how == "ended", ahead=how == "ahead")


def _hexadecimal(text: bytes) -> int | None:
    """The number that ``text`` is, if any."""
    try:
        return int(text, 16)
    except ValueError:
        return None


def boot_id() -> str:
    """Which boot of the system this is; `UNKNOWN_BOOT` where it does not state it."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip() or UNKNOWN_BOOT
    except OSError:
        return UNKNOWN_BOOT


def place_of(lock: BinaryIO) -> str:
    """What only this store has, and no copy: the lock file's inode and the time when that was last changed.

    The lock file is never written. No program can copy the time, so that a copy, also one that is put back
    in the place of the original, has another.
    """
    status = os.fstat(lock.fileno())
    return f"{status.st_ino:016x}-{status.st_ctime_ns:016x}"
