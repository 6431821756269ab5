"""The audit log: who asked the alarms for what, when, from where, and what came of it.

It is one file, ``audit.jsonl``, with one JSON object a line. Every command leaves two lines of the same
``id``: one with the outcome ``asked``, on disk before anything is done, and one with what came of it. An
``asked`` that nothing follows is a command under way when the service died: whether it was carried out, the
alarm's history tells.

No line is ever changed. The file is opened afresh for each line, so it may be renamed at any time, as
logrotate does. Once it is large it becomes ``audit-000001.jsonl`` and so on by itself, and when all of them
exceed a quota the oldest is deleted. Commands that are refused in a flood are counted in one line a minute
(`Refusals`), so that nobody who is refused can push out what was carried out.
"""

from __future__ import annotations

import asyncio
import errno
import json
import math
import os
import re
import stat
import uuid
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NotRequired, TypedDict

from daqsvc.acquisition.clock import NS_PER_S, iso_utc
from daqsvc.alarms.commands import AlarmCommand

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock
    from daqsvc.alarms.commands import CommandOutcome, SnapshotRequest

SCHEMA: Literal["daqsvc.audit/1"] = "daqsvc.audit/1"
MODE = 0o600
"""As of the other files of a store: whoever else is to read it, is let by ``chmod g+r``."""
QUOTA_BYTES = 32 * 1024 * 1024
PARTS = 8
"""Files that make up the quota: the one that is written is at most one part of it."""
REFUSED_IN_FULL = 30
REFUSED_EVERY_NS = 30 * NS_PER_S
"""Refused commands that are logged one by one; one more is allowed each time this period passes."""
SOURCES = 5
"""Sources that a count of refused commands names; the rest are the others."""
OTHERS = "others"


class AuditLine(TypedDict):
    """One line of the audit log, `audit.jsonl` in the store; a command has two of the same `id`.

    Attributes:
        schema: what the line is, and of which version.
        id: the same in both lines of a command; nothing else has it.
        time: when the line was written, ISO 8601, UTC.
        wall_ns: the same by the wall clock, ns since the Unix epoch.
        monotonic_ns: the same by the monotonic clock of the box, ns.
        outcome: `asked` at first, then `accepted` or `refused`; `refused_many` counts a flood.
        source: where the command came from, e.g. the user and the process.
        by: the person, by the name that was given.
        verb: what was asked for.
        machine: name of the machine, if the command has named one.
        alarm: name of the alarm; absent for a snapshot.
        occurrence: id of the activation that was meant; null for whichever there is. Absent for a snapshot.
        duration_s: how long it is to last, in s; words for what is no number. Absent for a snapshot.
        reason: why, in the words of the person.
        answer: the reason of a refusal, or what else was answered; of `refused_many` the last answer.
        events: ids of the alarm events that came of it.
        path: file of the snapshot that was made.
        count: of `refused_many`: how many commands were refused.
        since: of `refused_many`: when the first of them came, ISO 8601, UTC.
        sources: of `refused_many`: how many came from where.
        verbs: of `refused_many`: how many asked for what.
    """

    schema: Literal["daqsvc.audit/1"]
    id: str
    time: str
    wall_ns: int
    monotonic_ns: int
    outcome: Literal["asked", "accepted", "refused", "refused_many"]
    source: NotRequired[str]
    by: NotRequired[str]
    verb: NotRequired[str]
    machine: NotRequired[str]
    alarm: NotRequired[str]
    occurrence: NotRequired[str | None]
    duration_s: NotRequired[float | str | None]
    reason: NotRequired[str]
    answer: NotRequired[str]
    events: NotRequired[list[str]]
    path: NotRequired[str]
    count: NotRequired[int]
    since: NotRequired[str]
    sources: NotRequired[dict[str, int]]
    verbs: NotRequired[dict[str, int]]


class AuditError(Exception):
    """The audit log cannot be written; the text names the file and the remedy."""


class AuditLog:
    """Appends to the audit log, one writer at a time.

    Args:
        path: the file; it is created when it is needed, its directory must be there.
        clock: for the time of each line.
        quota_bytes: what it may take of the disk, with its older parts.
    """

    def __init__(self, path: Path, clock: Clock, quota_bytes: int = QUOTA_BYTES) -> None:
        self.path = path
        self._clock = clock
        self._quota_bytes = quota_bytes
        self._one_at_a_time = asyncio.Lock()

    async def asked(self, command: AlarmCommand | SnapshotRequest, source: str) -> str:
        """Write down that a command has come, before it is carried out.

        Args:
            command: what is asked for.
            source: where it came from, e.g. ``"local uid 1000 pid 4711"`` or ``"mqtt <topic>"``.

        Returns:
            The id by which `answered` refers to it.

        Raises:
            AuditError: the line is not on disk; the command must not be carried out.
        """
        entry = str(uuid.uuid4())
        await self._append(self._line(entry, "asked", command, source))
        return entry

    async def answered(
        self, entry: str, command: AlarmCommand | SnapshotRequest, source: str, outcome: CommandOutcome
    ) -> None:
        """Write down what came of a command.

        Args:
            entry: from `asked`.
            command: what was asked for.
            source: where it came from.
            outcome: what came of it.

        Raises:
            AuditError: the line is not on disk.
        """
        what: Literal["accepted", "refused"] = "accepted" if outcome.accepted else "refused"
        line = self._line(entry, what, command, source)
        line["answer"], line["events"] = outcome.reason, list(outcome.events)
        if outcome.path:
            line["path"] = outcome.path
        await self._append(line)

    async def refused(self, refusals: Refusals) -> None:
        """Write down how many commands were refused without a line of their own, if any, and forget them.

        Args:
            refusals: they; kept if the line cannot be written.

        Raises:
            AuditError: the line is not on disk.
        """
        refused = refusals.drain()
        if refused is None:
            return
        try:
            line = self._stamp(str(uuid.uuid4()), "refused_many")
            refused.add_to(line)
            await self._append(line)
        except AuditError:
            refusals.put_back(refused)
            raise

    def _stamp(
        self, entry: str, outcome: Literal["asked", "accepted", "refused", "refused_many"]
    ) -> AuditLine:
        wall_ns = self._clock.wall_ns()
        return {
            "schema": SCHEMA,
            "id": entry,
            "time": iso_utc(wall_ns),
            "wall_ns": wall_ns,
            "monotonic_ns": self._clock.monotonic_ns(),
            "outcome": outcome,
        }

    def _line(
        self,
        entry: str,
        outcome: Literal["asked", "accepted", "refused"],
        command: AlarmCommand | SnapshotRequest,
        source: str,
    ) -> AuditLine:
        line = self._stamp(entry, outcome)
        line["source"], line["by"], line["verb"] = source, command.by, command.verb.value
        if command.machine is not None:
            line["machine"] = command.machine
        if isinstance(command, AlarmCommand):
            line["alarm"], line["occurrence"] = command.alarm, command.occurrence
            line["duration_s"] = _in_json(command.duration_s)
        line["reason"] = command.reason
        return line

    async def _append(self, line: AuditLine) -> None:
        # ASCII only: no name or reason can smuggle a line separator in.
        text = json.dumps(line, allow_nan=False) + "\n"
        try:
            async with self._one_at_a_time:
                await asyncio.to_thread(_write, self.path, text.encode("ascii"), self._quota_bytes)
        except OSError as error:
            raise AuditError(
                f"the audit log {self.path} cannot be written: {error.strerror or error}; "
                "no command is carried out unless it can be logged: make room or correct its permissions"
            ) from error


@dataclass(slots=True)
class RefusedMany:
    """Refused commands that have no their own lines.

    Attributes:
        since_ns: when the first of them came, wall clock, ns since the Unix epoch.
        count: how many they are.
        sources: how many came from where; of more than `SOURCES` sources the rest are `OTHERS`.
        verbs: how many asked for what.
        answer: the answer to the last of them.
    """

    since_ns: int
    count: int = 0
    sources: Counter[str] = field(default_factory=Counter)
    verbs: Counter[str] = field(default_factory=Counter)
    answer: str = ""

    def add_to(self, line: AuditLine) -> None:
        """Write them into a line of the log."""
        line["count"], line["since"] = self.count, iso_utc(self.since_ns)
        line["sources"], line["verbs"] = dict(self.sources), dict(self.verbs)
        line["answer"] = self.answer


class Refusals:
    """Commands that were refused in a flood of them, counted rather than written down one by one.

    Args:
        clock: for how fast they come.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._left = REFUSED_IN_FULL
        self._earned_ns = clock.monotonic_ns()
        self._many: RefusedMany | None = None

    @property
    def flooding(self) -> bool:
        """Whether the next refused command is only counted."""
        earned, rest_ns = divmod(self._clock.monotonic_ns() - self._earned_ns, REFUSED_EVERY_NS)
        self._earned_ns = self._clock.monotonic_ns() - rest_ns
        self._left = min(self._left + earned, REFUSED_IN_FULL)
        return self._left <= 0

    def written(self) -> None:
        """One was recorded in full."""
        self._left -= 1

    def count(self, command: AlarmCommand | SnapshotRequest, source: str, reason: str) -> None:
        """One was refused for ``reason`` without being written down."""
        many = self._many = self._many or RefusedMany(self._clock.wall_ns())
        known = source in many.sources or len(many.sources) < SOURCES
        many.count += 1
        many.sources[source if known else OTHERS] += 1
        many.verbs[command.verb.value] += 1
        many.answer = reason

    def drain(self) -> RefusedMany | None:
        """What has been counted since the last time; None if nothing was."""
        many, self._many = self._many, None
        return many

    def put_back(self, earlier: RefusedMany) -> None:
        """What was taken has not been written: it belongs to the next time."""
        if (later := self._many) is not None:
            earlier.count += later.count
            for source, count in later.sources.items():
                known = source in earlier.sources or len(earlier.sources) < SOURCES
                earlier.sources[source if known else OTHERS] += count
            earlier.verbs += later.verbs
            earlier.answer = later.answer
        self._many = earlier


def _in_json(number: float | None) -> float | str | None:
    """A number; what JSON has no number for in words, because it has been asked for all the same."""
    return number if number is None or math.isfinite(number) else f"{number}"


def _write(path: Path, line: bytes, quota_bytes: int) -> None:
    """Append a line durably, and put the file aside before if it is one part of the quota; blocks.

    Raises:
        OSError: the line is not on disk as a whole.
    """
    try:
        full = path.stat(follow_symlinks=False).st_size + len(line) > quota_bytes // PARTS
    except FileNotFoundError:
        full = False
    if full:
        put_aside(path, quota_bytes)
    _append_durably(path, line)


def put_aside(path: Path, quota_bytes: int) -> None:
    """Make the file ``path`` the newest of its older parts, and delete the oldest beyond the quota; blocks.

    Wherever this is interrupted, every line is in one file, and the next time goes on. The newest part stays
    even if it exceeds the quota by itself: a log that was never parted is not to vanish at once.

    Raises:
        OSError: the file cannot be renamed, or an older part not be deleted.
    """
    parts = older_parts(path)
    newest = 1 + max(parts, default=0)
    parts[newest] = path.with_name(f"{path.stem}-{newest:06d}{path.suffix}")
    path.rename(parts[newest])
    _sync_directory(path.parent)
    total = sum(part.stat().st_size for part in parts.values())
    for number in sorted(parts)[:-1]:
        if total <= quota_bytes - quota_bytes // PARTS:
            return
        total -= parts[number].stat().st_size
        parts[number].unlink()


def older_parts(path: Path) -> dict[int, Path]:
    """The older parts of the log ``path`` by their numbers; the highest is the newest."""
    named = re.compile(rf"{re.escape(path.stem)}-([0-9]{{6,}}){re.escape(path.suffix)}")
    matches = ((named.fullmatch(one.name), one) for one in path.parent.iterdir())
    return {int(match[1]): one for match, one in matches if match is not None}


def _append_durably(path: Path, line: bytes) -> None:
    """Append a line and wait until it is on disk; blocks.

    What a full disk or a power cut has left of an earlier line stays, with its line ended: one line that is
    no JSON, and never half of another one.

    Raises:
        OSError: the line is not on disk as a whole.
    """
    created = not path.exists()
    flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    try:
        descriptor = os.open(path, flags, MODE)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise OSError(error.errno, "it is a symbolic link, which is not followed") from error
        raise
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "it is no regular file")
        size = os.fstat(descriptor).st_size
        if size and os.pread(descriptor, 1, size - 1) != b"\n":
            line = b"\n" + line
        while line:
            line = line[os.write(descriptor, line) :]
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    if created:
        _sync_directory(path.parent)


def _sync_directory(directory: Path) -> None:
    """Have the name of a new file survive a power cut, too."""
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
