"""What people ask of alarms and machines, one after the other: logged, carried out, answered.

A command is in the audit log before it is carried out, and its events are on disk before it is answered. They
go there as all events of alarms do (`daqsvc.alarm_service`).
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarms.commands import CommandOutcome
from daqsvc.alarms.states import CommandNotAllowedError, UnknownAlarmError, UnknownMachineError
from daqsvc.audit import AuditError, AuditLog, Refusals
from daqsvc.control import SnapshotNotMadeError
from daqsvc.errors.code import coded
from daqsvc.errors.command_line import COMMAND_REFUSED, NOT_ASKED
from daqsvc.errors.service import DISK_REFUSES, JOURNAL_BEHIND

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from daqsvc.acquisition.clock import Clock
    from daqsvc.alarms.commands import AlarmCommand, SnapshotRequest
    from daqsvc.alarms.events import AlarmEvent
    from daqsvc.alarms.manager import AlarmManager
    from daqsvc.control import TakeSnapshot
    from daqsvc.errors.code import Code

logger = logging.getLogger(__name__)

COMMIT_S = 5.0
"""How long an answer waits for the disk before it states that the disk has not got it yet."""
MOST_COMMANDS = 64
"""Commands that may wait at a time; further ones are refused."""
MOST_SNAPSHOTS = 6
"""That others may have made of one machine in `SNAPSHOTS_NS`: files of older ones go for newer ones."""
SNAPSHOTS_NS = 600 * NS_PER_S
STOPPING = "the service is stopping; ask again when it runs"


@dataclass(slots=True)
class CommandCounters:
    """What became of people's commands, from wherever they came; every figure only grows.

    Attributes:
        accepted: carried out.
        refused: refused, for whatever reason.
        unwritten: of those refused, because the audit log could not be written.
        unanswered_in_log: carried out or refused, but the audit log could not take the outcome.
    """

    accepted: int = 0
    refused: int = 0
    unwritten: int = 0
    unanswered_in_log: int = 0


class CommandExecutor:
    """Carries out commands, from wherever they come.

    Args:
        managers: the alarms of each machine that is watched, as it is at any time.
        own: the alarms of the service itself.
        audit: the log of commands.
        clock: the service's clock.
        post: sends an event on its way to the disk; its number comes when it is there.
        id_of: the id of the event that has a number.
        watch: keeps what is under way until it is done.
        snapshot: makes snapshots of machines. None if nobody may ask for one.

    Attributes:
        counters: what became of the commands.
    """

    def __init__(
        self,
        managers: Mapping[str, AlarmManager],
        own: Callable[[], AlarmManager],
        audit: AuditLog,
        clock: Clock,
        *,
        post: Callable[[AlarmEvent], asyncio.Future[int]],
        id_of: Callable[[int], str],
        watch: Callable[[asyncio.Future[Any]], None],
        snapshot: TakeSnapshot | None,
    ) -> None:
        self.counters = CommandCounters()
        self._managers = managers
        self._own = own
        self._audit = audit
        self._refusals = Refusals(clock)
        self._clock = clock
        self._post = post
        self._id_of = id_of
        self._watch = watch
        self._snapshot = snapshot
        self._snapshots: dict[str, deque[int]] = {}
        """By machine, when others had some made recently, monotonic."""
        self._one_at_a_time = asyncio.Lock()
        self._commands_waiting = 0
        self._stopping = False

    def stop(self) -> None:
        """Take no more commands; the one that is being carried out goes on."""
        self._stopping = True

    async def execute(self, command: AlarmCommand, source: str) -> CommandOutcome:
        """Carry out a person's command, one after the other: recorded, carried out, committed, answered.

        A command that has begun is carried out to its end, even if its answer is not waited for any more.

        Args:
            command: what is asked; whoever calls has made sure that it may be asked.
            source: the way it came, for the audit log.

        Returns:
            What came of it; if it was carried out, its events are on disk.
        """
        if self._stopping:
            return self._refuse(STOPPING, NOT_ASKED)
        if self._commands_waiting >= MOST_COMMANDS:
            return self._refuse(
                f"{MOST_COMMANDS} commands wait for the disk already; ask again later", NOT_ASKED
            )
        self._commands_waiting += 1
        work = asyncio.create_task(self._carry_out(command, source), name=f"command {command.verb}")
        self._watch(work)
        return await asyncio.shield(work)

    async def take_snapshot(self, command: SnapshotRequest, source: str) -> CommandOutcome:
        """Have a snapshot made for a person: written down, made, answered once it is complete.

        Commands to alarms do not wait for it.

        Args:
            command: what is asked; whoever calls has made sure that it may be asked.
            source: the way it came, for the audit log.
        """
        if self._stopping:
            return self._refuse(STOPPING, NOT_ASKED)
        now_ns = self._clock.monotonic_ns()
        lately = self._snapshots.setdefault(command.machine, deque(maxlen=MOST_SNAPSHOTS))
        if len(lately) == MOST_SNAPSHOTS and now_ns - lately[0] < SNAPSHOTS_NS:
            # Nor is that written down: it may be a flood.
            refusal = (
                f"{MOST_SNAPSHOTS} snapshots of {command.machine} were asked for within "
                f"{SNAPSHOTS_NS // NS_PER_S} s; ask again later, or at the box"
            )
            self._refusals.count(command, source, refusal)
            return self._refuse(refusal, NOT_ASKED)
        lately.append(now_ns)
        work = asyncio.create_task(self._made_snapshot(command, source), name="command snapshot")
        self._watch(work)
        return await asyncio.shield(work)

    async def tell_refused(self) -> None:
        """Write down how many commands were refused in a flood of them."""
        try:
            await self._audit.refused(self._refusals)
        except AuditError as error:
            logger.error(  # noqa: TRY400 - the message is enough
                "refused commands that were counted are not in the log yet: %s",
                error,
                extra=coded(DISK_REFUSES),
            )

    async def _carry_out(self, command: AlarmCommand, source: str) -> CommandOutcome:
        try:
            async with self._one_at_a_time:
                if self._stopping:
                    return self._refuse(STOPPING, NOT_ASKED)
                refusal = self._refused(command) if self._refusals.flooding else None
                if refusal is not None:
                    self._refusals.count(command, source, refusal.reason)
                    return refusal
                entry = await self._audit.asked(command, source)
                outcome = await self._outcome(command)
                if not outcome.accepted:
                    self._refusals.written()
                await self._write_down(entry, command, source, outcome)
                return outcome
        except AuditError as error:
            logger.error(  # noqa: TRY400 - the message is enough
                "a command to %s %s was refused: %s",
                command.verb,
                command.alarm,
                error,
                extra=coded(DISK_REFUSES),
            )
            self.counters.unwritten += 1
            return self._refuse(f"{error}", DISK_REFUSES)
        finally:
            self._commands_waiting -= 1

    async def _made_snapshot(self, command: SnapshotRequest, source: str) -> CommandOutcome:
        try:
            if self._refusals.flooding:
                # What has not been recorded is not done, and a flood is not recorded.
                refusal = (
                    "too many commands were refused in a short time; try again in a minute, or at the box"
                )
                self._refusals.count(command, source, refusal)
                return self._refuse(refusal, NOT_ASKED)
            entry = await self._audit.asked(command, source)
            outcome = await self._snapshot_outcome(command, source)
            if not outcome.accepted:
                self._refusals.written()
            await self._write_down(entry, command, source, outcome)
        except AuditError as error:
            logger.error(  # noqa: TRY400 - the message is enough
                "a snapshot of %s was refused: %s", command.machine, error, extra=coded(DISK_REFUSES)
            )
            self.counters.unwritten += 1
            return self._refuse(f"{error}", DISK_REFUSES)
        else:
            return outcome

    async def _snapshot_outcome(self, command: SnapshotRequest, source: str) -> CommandOutcome:
        if self._snapshot is None:
            return self._refuse("this service makes no snapshots", COMMAND_REFUSED)
        why = f": {command.reason}" if command.reason else ""
        try:
            path = await self._snapshot(command.machine, f"asked for by {command.by} ({source}){why}")
        except SnapshotNotMadeError as refused:
            return self._refuse(f"{refused}", refused.code)
        self.counters.accepted += 1
        return CommandOutcome(accepted=True, path=path)

    def _manager_of(self, command: AlarmCommand) -> AlarmManager:
        """The alarms that a command is about.

        Raises:
            CommandNotAllowedError: there is no such machine, or several have an alarm of that name.
        """
        if command.machine is not None:
            if (manager := self._managers.get(command.machine)) is not None:
                return manager
            there_are = ", ".join(sorted(self._managers))
            raise UnknownMachineError(f"no machine is named {command.machine!r}; there are: {there_are}")
        having = [one for one in self._managers.values() if one.knows(command.alarm)]
        if len(having) > 1:
            names = ", ".join(one.identity.machine for one in having)
            raise UnknownAlarmError(
                f"{names} each have an alarm {command.alarm!r}: name the machine as well (--machine)"
            )
        return having[0] if having else self._own()

    def _refused(self, command: AlarmCommand) -> CommandOutcome | None:
        """What comes of a command that would be refused now; None if it would not."""
        if command.denied:
            return self._refuse(command.denied, COMMAND_REFUSED)
        try:
            refusal = self._manager_of(command).refusal(command)
        except CommandNotAllowedError as error:
            refusal = error
        return None if refusal is None else self._refuse(f"{refusal}", refusal.code)

    async def _outcome(self, command: AlarmCommand) -> CommandOutcome:
        if command.denied:
            return self._refuse(command.denied, COMMAND_REFUSED)
        try:
            events = self._manager_of(command).execute(command)
        except CommandNotAllowedError as refusal:
            return self._refuse(f"{refusal}", refusal.code)
        self.counters.accepted += 1
        committed = [self._post(event) for event in events]
        if committed:
            await asyncio.wait(committed, timeout=COMMIT_S)
        reason = _not_on_disk(committed)
        return CommandOutcome(
            accepted=True,
            reason=reason,
            code=JOURNAL_BEHIND.id if reason else None,
            events=tuple(self._id_of(number) for number in _sequences(committed)),
        )

    async def _write_down(
        self, entry: str, command: AlarmCommand | SnapshotRequest, source: str, outcome: CommandOutcome
    ) -> None:
        """Write down what came of a command: too late to take it back if that fails."""
        try:
            await self._audit.answered(entry, command, source, outcome)
        except AuditError as error:
            self.counters.unanswered_in_log += 1
            logger.error(  # noqa: TRY400 - the message is enough
                "the result of command %s is not in the log: %s", entry, error, extra=coded(DISK_REFUSES)
            )

    def _refuse(self, reason: str, code: Code) -> CommandOutcome:
        self.counters.refused += 1
        return CommandOutcome(accepted=False, reason=reason, code=code.id)


def _sequences(committed: Sequence[asyncio.Future[int]]) -> list[int]:
    return [one.result() for one in committed if one.done() and one.exception() is None]


def _not_on_disk(committed: Sequence[asyncio.Future[int]]) -> str:
    """Why what was done may be undone by a restart; empty if it cannot."""
    if all(one.done() and one.exception() is None for one in committed):
        return ""
    errors = [f"{one.exception()}" for one in committed if one.done() and one.exception() is not None]
    return "done, but the journal cannot be written yet, and a restart now would undo it: " + (
        "; ".join(errors) or "the event waits in memory; the alarm store/journal has the remedy"
    )
