"""The audit log: who asked the alarms for what, when, from where, and what came of it.

It is one file, ``audit.jsonl``, with one JSON object a line. Every command leaves two lines of the same
``id``: one with the outcome ``asked``, on disk before anything is done, and one with what came of it. An
``asked`` that nothing follows is a command under way when the service died: whether it was obeyed, the
alarm's history tells.

Nothing is ever changed or taken away. The file is opened afresh for each line, so it may be renamed at any
time, as logrotate does.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import uuid
from typing import TYPE_CHECKING, Any, Literal

from daqsvc.acquisition.clock import iso_utc

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock
    from daqsvc.alarms.commands import AlarmCommand, CommandOutcome

SCHEMA = "daqsvc.audit/1"
MODE = 0o640
"""Whoever reads the machine's logs may read this one; nobody but the service writes it."""


class AuditError(Exception):
    """The audit log cannot be written; the text names the file and the remedy."""


class AuditLog:
    """Appends to the audit log, one writer at a time.

    Args:
        path: the file; it is created when it is needed, its directory must be there.
        clock: for the time of each line.
    """

    def __init__(self, path: Path, clock: Clock) -> None:
        self.path = path
        self._clock = clock

    async def asked(self, command: AlarmCommand, source: str) -> str:
        """Write down that a command has come, before it is obeyed.

        Args:
            command: what is asked for.
            source: where it came from, e.g. ``"local uid 1000 pid 4711"`` or ``"mqtt <topic>"``.

        Returns:
            The id by which `answered` refers to it.

        Raises:
            AuditError: the line is not on disk; the command must not be obeyed.
        """
        entry = str(uuid.uuid4())
        await self._append(self._line(entry, "asked", command, source))
        return entry

    async def answered(self, entry: str, command: AlarmCommand, source: str, outcome: CommandOutcome) -> None:
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
        await self._append(line | {"answer": outcome.reason, "events": list(outcome.events)})

    def _line(
        self,
        entry: str,
        outcome: Literal["asked", "accepted", "refused"],
        command: AlarmCommand,
        source: str,
    ) -> dict[str, Any]:
        wall_ns = self._clock.wall_ns()
        return {
            "schema": SCHEMA,
            "id": entry,
            "time": iso_utc(wall_ns),
            "wall_ns": wall_ns,
            "monotonic_ns": self._clock.monotonic_ns(),
            "outcome": outcome,
            "source": source,
            "by": command.by,
            "verb": command.verb.value,
            "alarm": command.alarm,
            "occurrence": command.occurrence,
            "duration_s": _in_json(command.duration_s),
            "reason": command.reason,
        }

    async def _append(self, line: dict[str, Any]) -> None:
        # ASCII only: no name or reason can smuggle a line separator in.
        text = json.dumps(line, allow_nan=False) + "\n"
        try:
            await asyncio.to_thread(_append_durably, self.path, text.encode("ascii"))
        except OSError as error:
            raise AuditError(
                f"the audit log {self.path} cannot be written: {error.strerror or error}; "
                "no command is obeyed unless it can be written down: make room or correct its permissions"
            ) from error


def _in_json(number: float | None) -> float | str | None:
    """A number; what JSON has no number for in words, because it has been asked for all the same."""
    return number if number is None or math.isfinite(number) else f"{number}"


def _append_durably(path: Path, line: bytes) -> None:
    """Append a line and wait until it is on disk; blocks.

    What a full disk or a power cut has left of an earlier line stays, with its line ended: one line that is
    no JSON, and never half of another one.

    Raises:
        OSError: the line is not on disk as a whole.
    """
    created = not path.exists()
    descriptor = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, MODE)
    try:
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
