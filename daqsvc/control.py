"""Commands and questions from people on the box: a Unix socket in the store, and the client for it.

A request is one line of JSON, and so is its answer: see `ControlRequest` and `ControlAnswer`; the status is a
`daqsvc.publish.service_status.ServiceStatusPayload`. The socket is ``control.sock`` in the store's
directory, or in systemd's ``$RUNTIME_DIRECTORY`` with a link from there, mode 0600. Only the service's own
user and root may open it, and whoever may open it may handle alarms. Whatever a client sends or leaves
unsent costs the service a counter and a few kilobytes at most, or ten megabytes of one who looks on.
Clients that hang keep no others out: each user has their own connections, and the quietest of them makes way
for the next; so does the one who has looked on for longest.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import socket
import stat
import struct
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, NotRequired, Protocol, TypedDict

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.link import Backoff
from daqsvc.alarms.commands import (
    CommandMessage,
    CommandOutcome,
    DurationS,
    JsonCommand,
    Line,
    Person,
    Reason,
    Verb,
    faults_of,
)
from daqsvc.errors.code import coded, with_code
from daqsvc.errors.command_line import NO_SERVICE, NO_SUCH_MACHINE, NOT_ASKED
from daqsvc.errors.service import CONTROL_SOCKET, PART_FAILED, RELOAD_REFUSED
from daqsvc.notice import notice
from daqsvc.outbox.files import is_possessed, is_read_only
from daqsvc.outbox.reading import JOURNAL_NAME
from daqsvc.publish.looking import Looking
from daqsvc.publish.payloads import SCHEMA_ABOUT

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection, Iterable, Iterator, Sequence
    from pathlib import Path

    from daqsvc.alarms.commands import AlarmCommand, CommandHandler
    from daqsvc.errors.code import Code
    from daqsvc.publish.looking import Look

log = logging.getLogger(__name__)

SOCKET = "control.sock"
MODE = 0o600
LONGEST_PATH = 107
"""Bytes that the address of a Unix socket has room for (sun_path less its end)."""
LONGEST_LINE = 16 * 1024
MOST_CLIENTS = 8
"""Connections of one user at a time."""
PATIENCE_S = 10.0
"""How long a client may take to finish a line, and to take its answer."""
CLOSE_S = 0.2
"""How long the end waits for connections that are being ended."""
LOOK_S = 10.0
"""How often the service looks whether its socket is still there."""
ANSWER_S = 20.0
"""How long the client waits for the service: longer than that waits for its disk."""
STATUS_S = 10.0
"""How long it waits for the status, which waits for nothing but the processor."""
RELOAD_S = 120.0
"""How long it waits for a reload, which may compile kernels."""
LIVE_PIECE_BYTES = 64 * 1024
"""How much is sent to a viewer at a time; the rest follows when that was taken."""
MOST_LOOKING = 6
"""Who may look on at a time, beside the connections for commands."""
SNAPSHOT_S = 90_000.0
"""How long it waits for a snapshot, which is complete some time after it was asked for."""
LONGEST_STATUS = 32 * 1024 * 1024
"""Of 4096 sensors it is some 5 MB."""

_REQUEST: Literal["daqsvc.control/1"] = "daqsvc.control/1"
_QUESTION = b'{"schema": "daqsvc.control/1", "verb": "standing"}'
_STATUS_VERB = b'{"schema": "daqsvc.control/1", "verb": "status"'
STATUS_QUESTION = _STATUS_VERB + b"}"
_RELOADS = {
    b'{"schema": "daqsvc.control/1", "verb": "reload"}': False,
    b'{"schema": "daqsvc.control/1", "verb": "reload", "dry_run": true}': True,
}
"""The questions, and whether nothing is to be changed."""
_SNAPSHOT_VERB = b'{"schema": "daqsvc.control/1", "verb": "snapshot"'
_LIVE_VERB = b'{"schema": "daqsvc.control/1", "verb": "live"'
_QUESTIONS = "'status', 'live', 'reload' or 'snapshot'"
"""Those that the documents report, as a person reads them."""
_ANSWER: Literal["daqsvc.control-answer/1"] = "daqsvc.control-answer/1"


class ControlError(Exception):
    """The control socket cannot be used; the text names it and the remedy."""

    code = NOT_ASKED


class AbsentError(ControlError):
    """No service answers at the control socket of a store, for now."""

    code = NO_SERVICE


class NotAmongThemError(ControlError):
    """The service watches other machines."""

    code = NO_SUCH_MACHINE


class NotRunningError(AbsentError):
    """No service runs on the store."""


class UnreachableError(AbsentError):
    """A service runs on the store, but has no control socket there."""


class ControlRequest(CommandMessage):
    """What a person asks for."""

    model_config = ConfigDict(populate_by_name=True)

    schema_: Literal["daqsvc.control/1"] = Field(alias="schema", description=SCHEMA_ABOUT)
    verb: Annotated[Verb, Field(strict=False)] = Field(description="what is asked")
    alarm: Annotated[Line, Field(min_length=1, max_length=200)] = Field(description="name of the alarm")
    by: Person = Field(description="who asks")
    machine: Annotated[Line, Field(max_length=200)] | None = Field(
        default=None, description="name of the machine; null for the only one that has such an alarm"
    )
    occurrence: Annotated[Line, Field(min_length=1, max_length=100)] | None = Field(
        default=None, description="refuse the command if another activation is present by now"
    )
    duration_s: DurationS | None = Field(default=None, description="how long to shelve; for shelve only")
    reason: Reason = Field(default="", description="why")
    via: Annotated[Line, Field(max_length=200)] = Field(
        default="",
        description="for the audit log: how the person asked a program that passes it on, such as the page",
    )
    denied: Reason = Field(
        default="",
        description="why that program has found that this person may not: it is logged, and refused",
    )


class LiveRequest(JsonCommand):
    """Who has asked for what happens at a machine; the samples of these streams and grids with it."""

    model_config = ConfigDict(populate_by_name=True)

    schema_: Literal["daqsvc.control/1"] = Field(alias="schema", description=SCHEMA_ABOUT)
    verb: Literal["live"] = Field(description="what is asked; it is the second key")
    machine: Annotated[Line, Field(max_length=200)] | None = Field(
        default=None, description="name of the machine; null for the only one"
    )
    streams: Annotated[tuple[Annotated[Line, Field(max_length=200)], ...], Field(strict=False)] = Field(
        default=(), description="streams and grids whose samples are wanted"
    )


class Question(TypedDict):
    """A question without a person; the keys are in this order, and without another space between them.

    Attributes:
        schema: what the object is, and of which version.
        verb: what is asked.
        machine: of `status` and `snapshot`: name of the machine; absent for the only one.
        dry_run: of `reload`: true to change nothing; else it is absent.
    """

    schema: Literal["daqsvc.control/1"]
    verb: Literal["status", "reload", "snapshot", "standing"]
    machine: NotRequired[str]
    dry_run: NotRequired[Literal[True]]


class ControlAnswer(BaseModel):
    """What came of it."""

    model_config = ConfigDict(frozen=True, strict=True, populate_by_name=True)

    schema_: Literal["daqsvc.control-answer/1"] = Field(_ANSWER, alias="schema", description=SCHEMA_ABOUT)
    accepted: bool = Field(description="whether it was carried out")
    reason: str = Field(
        description="why it was refused, or why a restart may undo it; empty if neither",
    )
    code: str | None = Field(default=None, description="code of that reason; null if there is none")
    events: Annotated[tuple[str, ...], Field(strict=False)] = Field(
        default=(), description="ids of the alarm events that followed"
    )
    waiting: int = Field(
        default=0, description="answer to `standing`: alarm events that are in the memory of the service only"
    )


class WhichMachineAnswer(ControlAnswer):
    """The status was asked for of no machine, where there are several, or of one that is not watched."""

    machines: Annotated[tuple[str, ...], Field(strict=False)] = Field(
        description="names of the machines that the service watches"
    )


class ReloadAnswer(ControlAnswer):
    """What a reload has changed, or would."""

    lines: Annotated[tuple[str, ...], Field(strict=False)] = Field(
        description="what is different, or why it was refused, a sentence each"
    )
    files: Annotated[tuple[str, ...], Field(strict=False)] = Field(
        default=(),
        description="machine files and directories that the service was started with, and reads again",
    )


class Reload(Protocol):
    """See `daqsvc.service.Service.reload`."""

    async def __call__(self, *, dry_run: bool = False) -> list[str]:
        """Say what has been changed, or would be.

        Raises:
            ReloadRefusedError: nothing was.
        """
        ...


class SnapshotAnswer(ControlAnswer):
    """Where the snapshot is that was made."""

    path: str = Field(default="", description="file of the snapshot; empty if none was made")


class TakeSnapshot(Protocol):
    """See `daqsvc.service.Service.snapshot`."""

    async def __call__(self, machine: str | None, reason: str) -> str:
        """Make a snapshot of a machine, or of the only one; returns its file.

        Raises:
            SnapshotNotMadeError: it was not made.
        """
        ...


class SnapshotNotMadeError(Exception):
    """No snapshot was made; the text states why.

    Attributes:
        code: of that.
    """

    def __init__(self, why: str, code: Code) -> None:
        super().__init__(why)
        self.code = code


class ReloadRefusedError(Exception):
    """The service goes on as it is.

    Attributes:
        reasons: why, a sentence each, with its code at the end.
    """

    code = RELOAD_REFUSED

    def __init__(self, reasons: list[str]) -> None:
        self.reasons = [with_code(reason, self.code) for reason in reasons]
        super().__init__("; ".join(self.reasons))


class ReloadTooLateError(ReloadRefusedError):
    """The service ends."""

    code = NOT_ASKED

    def __init__(self) -> None:
        super().__init__(["the service ends"])


@dataclass(slots=True)
class ControlCounters:
    """What came over the control socket; every figure only grows.

    Attributes:
        clients: connections taken.
        clients_turned_away: connections of a user of whose others each has a request under way.
        clients_displaced: idle connections ended to make room for a new one of the same user.
        clients_failed: connections ended by a mistake in this program.
        clients_given_up: connections ended because the client was too slow, or went away in mid-line.
        requests: requests that were handed on as commands.
        malformed: lines that were no request: not JSON, of another schema, too long, for another machine.
    """

    clients: int = 0
    clients_turned_away: int = 0
    clients_displaced: int = 0
    clients_failed: int = 0
    clients_given_up: int = 0
    requests: int = 0
    malformed: int = 0


@dataclass(eq=False, slots=True)
class _Client:
    """One connection.

    Attributes:
        uid: whose.
        source: the same in words.
        busy: whether a request of it is being carried out.
        looks: whether it looks on, for as long as it stays.
        task: serves it.
    """

    uid: int
    source: str
    busy: bool = False
    looks: bool = False
    task: asyncio.Task[None] | None = None


class ControlServer:
    """Takes commands on the control socket of a store.

    Args:
        store: the store's directory; the caller holds the store, so that a socket found there is left over.
        machines: names of the machines that the service watches.
        execute: carries a command out.
        waiting: how many alarm events the disk has not got yet.
        runtime: directory for the socket itself, e.g. systemd's ``$RUNTIME_DIRECTORY``; the store then has a
            link to it.
        status: the line of JSON with the state of a machine, or of the only one; for one that is not
            watched, the names of those that are. None if that cannot be asked.
        reload: reads the machine files again, or only shows what would change; a line for each change. None
            if it cannot be asked.
        files: what it reads then.
        snapshot: makes a snapshot. None if that cannot be asked.
        look: begins to send what happens. None if that cannot be asked.
    """

    def __init__(
        self,
        store: Path,
        machines: Collection[str],
        execute: CommandHandler,
        waiting: Callable[[], int] = lambda: 0,
        runtime: Path | None = None,
        status: Callable[[str | None], Awaitable[bytes | tuple[str, ...]]] | None = None,
        reload: Reload | None = None,
        files: Sequence[Path] = (),
        snapshot: TakeSnapshot | None = None,
        look: Look | None = None,
    ) -> None:
        self.path = (runtime or store) / SOCKET
        self._link = None if runtime is None else store / SOCKET
        self.counters = ControlCounters()
        self._machines = machines
        self._execute = execute
        self._waiting = waiting
        self._status = status
        self._reload = reload
        self._files = tuple(f"{file.absolute()}" for file in files)
        self._snapshot = snapshot
        self._look = look
        self._server: asyncio.Server | None = None
        self._inode: int | None = None
        self._refused = ""
        """Why the socket or its link could not be made the last time."""
        self._clients: list[_Client] = []
        """The one that has been quiet for longest first."""

    async def open(self) -> None:
        """Begin to listen.

        Raises:
            ControlError: the path is taken by something else, or cannot be written.
        """
        binding = asyncio.ensure_future(asyncio.to_thread(_bind, self.path, self._link))
        try:
            listening, self._inode = await asyncio.shield(binding)
        except asyncio.CancelledError:
            await asyncio.wait({binding})
            if binding.exception() is None:
                listening, inode = binding.result()
                listening.close()
                _remove(self.path, inode)
            raise
        except ControlError as error:
            self._refused = f"{error}"
            raise
        self._refused = ""
        self._server = await asyncio.start_unix_server(self._welcome, sock=listening, limit=LONGEST_LINE)

    async def serve(self) -> None:
        """Listen until cancelled, and begin again where that fails, or where the socket is removed.

        Each new reason why it fails is logged, but for one that `open` has raised.
        """
        backoff, is_reported = Backoff(), self._server is None
        try:
            while True:
                if self._server is None:
                    known = self._refused
                    try:
                        await self.open()
                    except ControlError as error:
                        if self._refused != known:
                            log.error(  # noqa: TRY400 - the message is enough
                                "no commands on this box until this is corrected: %s",
                                error,
                                extra=coded(CONTROL_SOCKET),
                            )
                        is_reported = True
                        await asyncio.sleep(backoff.next_ns() / NS_PER_S)
                        continue
                    if is_reported:
                        notice(log, "commands are taken at %s now", self.path)
                    backoff.reset()
                await asyncio.sleep(LOOK_S)
                if not await asyncio.to_thread(_is_at, self.path, self._inode):
                    is_reported = True
                    log.warning(
                        "the control socket %s was removed; another one is made",
                        self.path,
                        extra=coded(CONTROL_SOCKET),
                    )
                    await self.close()
                elif self._link is not None and not await asyncio.to_thread(_leads, self._link, self.path):
                    await self._mend_link(self._link)
        finally:
            await self.close()

    async def _mend_link(self, link: Path) -> None:
        """Make the link in the store again, by which people find the socket; log once why that fails."""
        try:
            await asyncio.to_thread(_make_link, link, self.path)
        except (ControlError, OSError) as error:
            why = f"{error}" if isinstance(error, ControlError) else error.strerror or f"{error}"
            if why != self._refused:
                log.error(  # noqa: TRY400  the message is enough
                    "the control socket has no link %s any more, by which commands on this box find it, and "
                    "none can be made: %s; that is tried again every %g s",
                    link,
                    why,
                    LOOK_S,
                    extra=coded(CONTROL_SOCKET),
                )
            self._refused = why
        else:
            self._refused = ""
            log.warning(
                "the link %s to the control socket was removed; it is made again",
                link,
                extra=coded(CONTROL_SOCKET),
            )

    async def close(self) -> None:
        """Stop listening, end every connection at once, and take the socket away."""
        server, self._server = self._server, None
        if server is None:
            return
        server.close()
        ending = {client.task for client in self._clients if client.task is not None}
        for task in ending:
            task.cancel()
        if ending:
            await asyncio.wait(ending, timeout=CLOSE_S)
        try:
            async with asyncio.timeout(CLOSE_S):
                await server.wait_closed()
                await asyncio.to_thread(_remove, self.path, self._inode)
        except TimeoutError:
            log.warning(
                "the control socket %s does not close within %g s and is left behind",
                self.path,
                CLOSE_S,
                extra=coded(CONTROL_SOCKET),
            )
        except OSError as error:
            log.warning(
                "the control socket %s is left behind, where the next start replaces it: %s",
                self.path,
                error.strerror or error,
                extra=coded(CONTROL_SOCKET),
            )

    def _welcome(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            uid, pid = _peer(writer)
        except OSError:  # it has gone again
            self.counters.clients_given_up += 1
            writer.transport.abort()
            return
        if not self._make_room(uid):
            self.counters.clients_turned_away += 1
            writer.transport.abort()
            return
        self.counters.clients += 1
        client = _Client(uid, f"local uid {uid} pid {pid}")
        self._clients.append(client)
        client.task = asyncio.create_task(self._serve(client, reader, writer), name="control client")
        client.task.add_done_callback(lambda _: self._clients.remove(client))

    def _make_room(self, uid: int) -> bool:
        """Whether there is room for one more connection of a user; only that user's others make way."""
        theirs = [one for one in self._clients if one.uid == uid and not (one.looks or _is_ending(one))]
        if len(theirs) < MOST_CLIENTS:
            return True
        return self._displace(client for client in theirs if not client.busy)

    def _make_room_to_look(self, uid: int) -> bool:
        """Whether one more may look on; the one of the same user who has looked for longest makes way."""
        looking = [one for one in self._clients if one.looks and not _is_ending(one)]
        if len(looking) < MOST_LOOKING:
            return True
        return self._displace(client for client in looking if client.uid == uid)

    def _displace(self, clients: Iterable[_Client]) -> bool:
        """End the first of some connections; whether there is one."""
        first = next(iter(clients), None)
        if first is None or first.task is None:
            return False
        self.counters.clients_displaced += 1
        first.task.cancel()
        return True

    async def _serve(
        self, client: _Client, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        try:
            while (line := await _next_line(reader)) is not None:
                client.busy = True
                if self._look is not None and line.startswith(_LIVE_VERB):
                    await self._tell_live(self._look, line, client, reader, writer)
                    return
                answer = await self._answer_to(line, client.source)
                client.busy = False
                self._clients.append(self._clients.pop(self._clients.index(client)))
                writer.write(answer)
                async with asyncio.timeout(PATIENCE_S):
                    await writer.drain()
                if len(line) > LONGEST_LINE:
                    return  # what follows is the rest of it, or of its kind
        except (TimeoutError, ConnectionError, asyncio.IncompleteReadError):
            self.counters.clients_given_up += 1
        except Exception:
            self.counters.clients_failed += 1
            if self.counters.clients_failed == 1:
                log.exception(
                    "the service has failed on what %s asked for, and ends the connection",
                    client.source,
                    extra=coded(PART_FAILED),
                )
        finally:
            if writer.transport.get_write_buffer_size():
                writer.transport.abort()
            else:
                writer.close()

    async def _answer_to(self, line: bytes, source: str) -> bytes:
        """The answer to a question or a command."""
        if self._status is not None and line.startswith(_STATUS_VERB):
            return await self._tell_status(self._status, line)
        if self._reload is not None and line.strip() in _RELOADS:
            reloaded = await _reloaded(self._reload, dry_run=_RELOADS[line.strip()])
            return _json_line(reloaded.model_copy(update={"files": self._files}))
        if self._snapshot is not None and line.startswith(_SNAPSHOT_VERB):
            return _json_line(await _snapshot_answer(self._snapshot, line, source))
        return _json_line(await self._answer(line, source))

    async def _tell_status(
        self, status: Callable[[str | None], Awaitable[bytes | tuple[str, ...]]], line: bytes
    ) -> bytes:
        """The status of the machine that is meant; without one, of the only one that there is."""
        try:
            asked = json.loads(line).get("machine")
        except (ValueError, RecursionError):
            asked = ""
        reply = await status(asked if isinstance(asked, str | None) else "")
        if isinstance(reply, bytes):
            return reply
        self.counters.malformed += asked is not None
        return _json_line(_which_machine(asked, reply))

    async def _tell_live(
        self,
        look: Look,
        line: bytes,
        client: _Client,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
    ) -> None:
        """Tell one who looks on what passes, until it goes or nothing more comes."""
        looking = self._begun_looking(look, line, client)
        if isinstance(looking, ControlAnswer):
            self.counters.malformed += 1
            writer.write(_json_line(looking))
            return
        client.looks = True
        writer.transport.set_write_buffer_limits(high=LIVE_PIECE_BYTES)
        # Whatever the client still states: it is heard only that it goes.
        gone = asyncio.create_task(_until_end(reader), name="one who looks on goes")
        telling: asyncio.Future[bytes] | None = None
        try:
            while not gone.done():
                telling = asyncio.ensure_future(looking.lines())
                await asyncio.wait({telling, gone}, return_when=asyncio.FIRST_COMPLETED)
                if not telling.done() or not (data := telling.result()):
                    return
                for at in range(0, len(data), LIVE_PIECE_BYTES):
                    writer.write(data[at : at + LIVE_PIECE_BYTES])
                    async with asyncio.timeout(PATIENCE_S):
                        await writer.drain()
        finally:
            looking.leave()
            ending = {one for one in (gone, telling) if one is not None}
            for one in ending:
                one.cancel()
            await asyncio.wait(ending)

    def _begun_looking(self, look: Look, line: bytes, client: _Client) -> Looking | ControlAnswer:
        """Begin to look at the machine that a request names, or answer why not."""
        try:
            asked = LiveRequest.read(line)
        except (ValueError, RecursionError) as error:
            fault = faults_of(error, "it")[0] if isinstance(error, ValidationError) else f"{error}"
            return _refused(f"the request is not valid, {fault}"[:500], NOT_ASKED)
        machine = asked.machine
        looking = look(machine, asked.streams)
        if isinstance(looking, Looking):
            if self._make_room_to_look(client.uid):
                return looking
            looking.leave()
            return _refused(f"{MOST_LOOKING} others use live already; close one of them", NOT_ASKED)
        return _which_machine(machine, looking)

    async def _answer(self, line: bytes, source: str) -> ControlAnswer:
        if line.strip() == _QUESTION:
            return ControlAnswer(accepted=True, reason="", waiting=self._waiting())
        try:
            request = parse_request(line, self._machines)
        except RequestError as error:
            self.counters.malformed += 1
            return _refused(f"{error}", error.code)
        self.counters.requests += 1
        command = replace(request.command(request.verb, request.machine), denied=request.denied)
        outcome = await self._execute(command, f"{source} {request.via}".rstrip())
        return ControlAnswer(
            accepted=outcome.accepted, reason=outcome.reason, code=outcome.code, events=outcome.events
        )


def _refused(reason: str, code: Code) -> ControlAnswer:
    return ControlAnswer(accepted=False, reason=reason, code=code.id)


def _which_machine(asked: object, machines: tuple[str, ...]) -> WhichMachineAnswer:
    reason = "name a machine" if asked is None else f"this service does not watch {asked!r:.200}"
    return WhichMachineAnswer(accepted=False, reason=reason, code=NO_SUCH_MACHINE.id, machines=machines)


async def _reloaded(reload: Reload, *, dry_run: bool) -> ReloadAnswer:
    try:
        return ReloadAnswer(accepted=True, reason="", lines=tuple(await reload(dry_run=dry_run)))
    except ReloadRefusedError as refused:
        return ReloadAnswer(
            accepted=False,
            reason="the machine files are refused",
            code=refused.code.id,
            lines=tuple(refused.reasons),
        )


async def _snapshot_answer(snapshot: TakeSnapshot, line: bytes, source: str) -> SnapshotAnswer:
    try:
        machine = json.loads(line).get("machine")
        path = await snapshot(machine if isinstance(machine, str) else None, f"asked for by {source}")
    except (ValueError, RecursionError):
        return SnapshotAnswer(accepted=False, reason="the request is not valid JSON", code=NOT_ASKED.id)
    except SnapshotNotMadeError as refused:
        return SnapshotAnswer(accepted=False, reason=f"{refused}", code=refused.code.id)
    return SnapshotAnswer(accepted=True, reason="", path=path)


class RequestError(ValueError):
    """A line is no request; the text is one sentence that states why."""

    code = NOT_ASKED


class NotWatchedError(RequestError):
    """It is one for another machine."""

    code = NO_SUCH_MACHINE


def parse_request(line: bytes, machines: Collection[str]) -> ControlRequest:
    """The request in a line to the service that watches ``machines``.

    Raises:
        RequestError: it is none; the text is one sentence that states why.
    """
    if len(line) > LONGEST_LINE:
        raise RequestError(f"the request is longer than {LONGEST_LINE} bytes")
    try:
        request = ControlRequest.read(line)
    except ValidationError as error:
        fault = faults_of(error, "it")[0]
        if fault.startswith("verb: must be "):
            fault += f"; or a question exactly as documented: {_QUESTIONS}"
        raise RequestError(f"the request is not valid, {fault}") from None
    except ValueError as error:
        raise RequestError(f"{error}") from None
    if request.machine is not None and request.machine not in machines:
        watched = ", ".join(repr(machine) for machine in machines)
        raise NotWatchedError(f"this service watches {watched}, not {request.machine!r}")
    return request


def request_of(command: AlarmCommand, machine: str | None, via: str = "") -> ControlRequest:
    """The request for a command.

    Args:
        command: what is asked.
        machine: the machine that is meant; None for whichever the service watches.
        via: what the person used who sent it, if another program passes it on; else empty.

    Raises:
        ControlError: it cannot be asked, e.g. because a text is too long.
    """
    try:
        return ControlRequest(
            schema_=_REQUEST,
            verb=command.verb,
            alarm=command.alarm,
            by=command.by,
            machine=machine,
            occurrence=command.occurrence,
            duration_s=command.duration_s,
            reason=command.reason,
            via=via,
            denied=command.denied,
        )
    except ValidationError as error:
        raise ControlError(f"that cannot be asked, {faults_of(error, 'it')[0]}") from None


def events_waiting(store: Path, timeout_s: float = PATIENCE_S) -> int:
    """How many alarm events the service that runs on a store has in memory only; blocks.

    Raises:
        ControlError: there is no service, it is somebody else's, or it does not answer.
    """
    return _outcome(store, _QUESTION + b"\n", timeout_s).waiting


def ask(store: Path, request: ControlRequest, timeout_s: float = ANSWER_S) -> CommandOutcome:
    """Have the service that runs on a store carry a command out; blocks.

    Args:
        store: the store's directory.
        request: what to ask for.
        timeout_s: how long to wait for the answer.

    Raises:
        ControlError: there is no service, it is somebody else's, or it does not answer.
    """
    answer = _outcome(store, _json_line(request), timeout_s)
    return CommandOutcome(
        accepted=answer.accepted, reason=answer.reason, code=answer.code, events=answer.events
    )


def ask_reload(store: Path, *, dry_run: bool = False) -> ReloadAnswer:
    """Have the service that runs on a store read its machine files again; blocks.

    Args:
        store: the store's directory.
        dry_run: only ask what that would change.

    Raises:
        ControlError: there is no service, it is somebody else's, or it does not answer.
    """
    [line] = [line for line, is_dry in _RELOADS.items() if is_dry == dry_run]
    answer = _asked(store, line + b"\n", RELOAD_S, LONGEST_STATUS, "its log shows what it has done")
    try:
        return ReloadAnswer.model_validate_json(answer)
    except ValidationError:
        raise ControlError(
            f"the daqsvc of {store} is of an older version, which cannot reload: restart it"
        ) from None


def ask_snapshot(store: Path, machine: str | None = None) -> SnapshotAnswer:
    """Have the service that runs on a store make a snapshot, and wait until it is complete; blocks.

    Args:
        store: the store's directory.
        machine: of which one; None for the only one.

    Raises:
        ControlError: there is no service, it is somebody else's, or it does not answer.
    """
    named = b"}" if machine is None else b', "machine": ' + json.dumps(machine).encode() + b"}"
    then = "its log shows what it has done"
    answer = _asked(store, _SNAPSHOT_VERB + named + b"\n", SNAPSHOT_S, LONGEST_LINE, then)
    try:
        return SnapshotAnswer.model_validate_json(answer)
    except ValidationError as error:
        raise _unanswered(store, error, then) from None


def ask_status(store: Path, machine: str | None = None, timeout_s: float = STATUS_S) -> list[dict[str, Any]]:
    """The state of everything by the service that runs on a store, as it states; blocks.

    Args:
        store: the store's directory.
        machine: which one is meant; None for all that it watches.
        timeout_s: how long to wait for each answer.

    Returns:
        For each machine a `daqsvc.publish.service_status.ServiceStatusPayload`, by its keys in JSON.

    Raises:
        ControlError: there is no service, it is somebody else's, it does not answer, or does not watch that.
    """
    status = _status_of(store, machine, timeout_s)
    if isinstance(status, dict):
        return [status]
    statuses = [_status_of(store, one, timeout_s) for one in status if machine is None]
    if machine is not None or not statuses:
        raise NotAmongThemError(f"the daqsvc of {store} watches {', '.join(status)}, not {machine}")
    # One that was taken out in between is left out.
    return [one for one in statuses if isinstance(one, dict)]


def _status_of(store: Path, machine: str | None, timeout_s: float) -> dict[str, Any] | tuple[str, ...]:
    """The state of a machine, or which ones there are, if that is none of them.

    Raises:
        ControlError: see `ask_status`.
    """
    then = "its log has the reason"
    named = b"}" if machine is None else b', "machine": ' + json.dumps(machine).encode() + b"}"
    line = _asked(store, _STATUS_VERB + named + b"\n", timeout_s, LONGEST_STATUS, then)
    try:
        answer: dict[str, Any] = json.loads(line)
        schema = answer["schema"]
    except (ValueError, KeyError, TypeError) as error:
        raise _unanswered(store, error, then) from None
    if schema == _ANSWER and answer.get("machines"):
        return tuple(f"{one}" for one in answer["machines"])
    if schema == _ANSWER:
        raise ControlError(
            f"the daqsvc of {store} is of an older version, which does not report its status: restart it"
        )
    return answer


def _outcome(store: Path, line: bytes, timeout_s: float) -> ControlAnswer:
    then = "daqsvc alarms shows whether it was carried out"
    try:
        return ControlAnswer.model_validate_json(_asked(store, line, timeout_s, LONGEST_LINE, then))
    except ValidationError as error:
        raise _unanswered(store, error, then) from None


def _asked(store: Path, line: bytes, timeout_s: float, longest: int, then: str) -> bytes:
    path = store / SOCKET
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.settimeout(timeout_s)
            with _address(path) as address:
                client.connect(address)
            client.sendall(line)
            with client.makefile("rb") as answers:
                answer = answers.readline(longest)
    except (FileNotFoundError, ConnectionRefusedError, NotADirectoryError):
        raise _absence(store) from None
    except PermissionError:
        raise ControlError(
            f"the daqsvc of {store} takes commands from its own user and from root only: try again with sudo"
        ) from None
    except TimeoutError:
        raise ControlError(f"the daqsvc of {store} has not answered within {timeout_s:g} s; {then}") from None
    except OSError as error:
        raise _unanswered(store, error, then) from None
    if not answer:
        raise _unanswered(store, None, then)
    return answer


def _unanswered(store: Path, error: Exception | None, then: str) -> AbsentError:
    detail = "" if error is None else f" ({_in_short(error)})"
    return AbsentError(f"the daqsvc of {store} has closed the connection without an answer{detail}; {then}")


def _absence(store: Path) -> AbsentError:
    """Why no service listens at the control socket of a store."""
    if not is_possessed(store / f"{JOURNAL_NAME}.lock"):
        return NotRunningError(
            f"no daqsvc runs on the store {store}: start it with daqsvc run, or name its store with --store "
            "in place of FILE; one that was started just now needs some seconds"
        )
    if is_read_only(store):
        why = "it cannot make it on a read-only file system: mount it writable again, or ask over MQTT"
    else:
        why = (
            f"it starts or stops, or the socket was removed and is made again within {LOOK_S:g} s: try again "
            "then; the service's log has the reason if it cannot be made"
        )
    return UnreachableError(
        f"the daqsvc of {store} runs, but has no control socket {store / SOCKET} to take commands at: {why}"
    )


async def _next_line(reader: asyncio.StreamReader) -> bytes | None:
    """The next whole line, or more than `LONGEST_LINE` bytes of one that is too long; None at the end.

    Raises:
        TimeoutError: the client is too slow.
        asyncio.IncompleteReadError: it went away in mid-line.
    """
    try:
        async with asyncio.timeout(PATIENCE_S):
            return await reader.readuntil(b"\n")
    except asyncio.LimitOverrunError:
        return b" " * (LONGEST_LINE + 1)
    except asyncio.IncompleteReadError as end:
        if end.partial:
            raise
        return None


async def _until_end(reader: asyncio.StreamReader) -> None:
    """Wait until a client states no more, or has gone."""
    with contextlib.suppress(ConnectionError):
        while await reader.read(LONGEST_LINE):
            pass


def _json_line(message: ControlRequest | ControlAnswer) -> bytes:
    # What a request does not state is left out: a service of an older version knows no such key.
    is_request = isinstance(message, ControlRequest)
    document = message.model_dump(mode="json", by_alias=True, exclude_defaults=is_request)
    return json.dumps(document).encode("ascii") + b"\n"


def _is_ending(client: _Client) -> bool:
    return client.task is not None and client.task.cancelling() > 0


def _peer(writer: asyncio.StreamWriter) -> tuple[int, int]:
    """Who is at the other end, by the word of the kernel: uid and pid.

    Raises:
        OSError: no service any more.
    """
    connection = writer.get_extra_info("socket")
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    pid, uid, _ = struct.unpack("3i", credentials)
    return uid, pid


def _bind(path: Path, link: Path | None) -> tuple[socket.socket, int]:
    """A socket that only this user can open, in place of one that was left over, and its inode; blocks.

    Clients find it at ``link``, if that is given.
    """
    # The mode is set under another name, no longer than its own, and no client can connect before `listen`.
    draft = path.with_name(".control")
    made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
    try:
        _check_free(path)
        draft.unlink(missing_ok=True)
        with _address(draft) as address:
            made.bind(address)
        draft.chmod(MODE)
        draft.rename(path)
        if link is not None:
            _make_link(link, path)
        return made, path.lstat().st_ino
    except OSError as error:
        made.close()
        raise ControlError(
            f"the control socket {path} cannot be made: {error.strerror or error}; "
            "give the service a store that it may write in, on a file system that supports sockets"
        ) from error
    except BaseException:
        made.close()
        raise


def _make_link(link: Path, path: Path) -> None:
    """Have a link lead to the socket, in place of one that was left over; blocks.

    Raises:
        ControlError: something else is in its place.
        OSError: it cannot be made.
    """
    _check_free(link)
    draft = link.with_name(".control")
    draft.unlink(missing_ok=True)
    draft.symlink_to(path)
    draft.rename(link)


def _leads(link: Path, path: Path) -> bool:
    """Whether the link that was made is still there; one that cannot be examined may be."""
    try:
        return link.is_symlink() and link.readlink() == path
    except FileNotFoundError:
        return False
    except OSError:
        return True


def _check_free(path: Path) -> None:
    """Only a socket, or a link to one, may be replaced: it is left over from a service that was killed."""
    if path.exists() and not (path.is_symlink() or stat.S_ISSOCK(path.lstat().st_mode)):
        raise ControlError(
            f"{path} is not a socket, and no control socket can be made there; move it to another place"
        )


def _is_at(path: Path, inode: int | None) -> bool:
    """Whether the socket that was made is still at its path; one that cannot be examined may be."""
    try:
        return path.lstat().st_ino == inode
    except FileNotFoundError:
        return False
    except OSError:
        return True


def _remove(path: Path, inode: int | None) -> None:
    with contextlib.suppress(FileNotFoundError):
        if path.lstat().st_ino == inode:
            path.unlink()


@contextlib.contextmanager
def _address(path: Path) -> Iterator[str]:
    """An address for a socket at ``path``, which may be longer than the address has room for.

    Raises:
        OSError: the directory is not there.
    """
    if len(os.fsencode(path)) <= LONGEST_PATH:
        yield os.fspath(path)
        return
    directory = os.open(path.parent, os.O_PATH | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{directory}/{path.name}"
    finally:
        os.close(directory)


def _in_short(error: Exception) -> str:
    return next(iter(f"{error}".splitlines()), type(error).__name__)
