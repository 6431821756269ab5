"""Where the page gets what it shows: the service on this box, over its control socket.

A machine is listened to while somebody looks at it. Samples are asked for of the streams that are looked at.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
import logging
import time
from typing import TYPE_CHECKING, Any

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.link import Backoff
from daqsvc.alarms.commands import CommandOutcome
from daqsvc.control import (
    SOCKET,
    STATUS_QUESTION,
    AbsentError,
    ControlError,
    NotRunningError,
    ask,
    request_of,
)
from daqsvc.history.file import NAME as HISTORY
from daqsvc.live_feed import SCHEMA
from daqsvc.outbox.messages import OutboxError
from daqsvc.outbox.reading import read_journal
from daqsvc.page.box_snapshots import AT, BoxSnapshots
from daqsvc.page.machine_live import MachineLive
from daqsvc.page.recorded import refused_of_the_past

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable, Iterator
    from pathlib import Path

    from daqsvc.alarms.commands import AlarmCommand
    from daqsvc.page.box_snapshots import KeptSnapshot
    from daqsvc.page.recorded import Playing

    Document = dict[str, Any]

log = logging.getLogger(__name__)

LONGEST_LINE = 64 * 1024 * 1024
NOT_OURS = (ValueError, LookupError, TypeError)
"""What comes of an answer that is not as it is known here."""
ALARM_SCHEMA = "daqsvc.alarm/"
MOST_LOOKED_AT = 20_000
"""Messages of the journal that are looked through for the events of one alarm."""
LINGER_S = 5.0
"""How long a machine is still listened to when nobody looks any more."""


class Listening:
    """Listens to one machine of a service, and keeps what it tells.

    Args:
        store: the store of the service.
        machine: its name.
    """

    def __init__(self, store: Path, machine: str) -> None:
        self.machine = machine
        self.live: MachineLive | None = None
        """What was told; None before the service has answered for the first time."""
        self.why_not = "the service has not answered yet"
        """Why nothing is told by now; empty if something is."""
        self.heard_s = time.monotonic()
        """When the service said something last."""
        self._path = store / SOCKET
        self._history = store / HISTORY
        self._wanted: dict[object, frozenset[str]] = {}
        self._streams: frozenset[str] = frozenset()
        self._anew = asyncio.Event()
        self._has_begun = asyncio.Event()

    async def first(self, timeout_s: float) -> MachineLive | None:
        """The machine, as soon as the service has told of it; None if it does not in time."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self._has_begun.wait()
        return self.live

    @contextlib.contextmanager
    def wanting(self, streams: Iterable[str]) -> Iterator[None]:
        """Have the samples of streams come meanwhile."""
        who = object()
        self._wanted[who] = frozenset(streams)
        self._ask_anew()
        try:
            yield
        finally:
            del self._wanted[who]
            self._ask_anew()

    def _ask_anew(self) -> None:
        wanted = frozenset().union(*self._wanted.values())
        # What is wanted no more goes on coming until something else is: it costs less than asking anew.
        if wanted - self._streams or (self._streams and not wanted):
            self._anew.set()

    async def run(self) -> None:
        """Listen until cancelled; again and again where that fails."""
        backoff = Backoff()
        while True:
            self._anew.clear()
            self._streams = frozenset().union(*self._wanted.values())
            try:
                await self._listen(backoff)
            except (OSError, asyncio.IncompleteReadError, *NOT_OURS) as error:
                self.why_not = _in_words(error)
                if isinstance(error, NOT_OURS):
                    self._has_begun.set()  # it has answered: nobody need wait for what it refuses
            if not self._anew.is_set():
                await asyncio.sleep(backoff.next_ns() / NS_PER_S)

    async def _listen(self, backoff: Backoff) -> None:
        reader, writer = await asyncio.open_unix_connection(self._path, limit=LONGEST_LINE)
        try:
            asked = {"machine": self.machine, "streams": sorted(self._streams)}
            question = f'{{"schema": "daqsvc.control/1", "verb": "live", {json.dumps(asked)[1:]}\n'
            writer.write(question.encode())
            about = json.loads(await reader.readuntil())
            if about.get("schema") != SCHEMA:
                raise ValueError(str(about.get("reason", "it answers in a way that is not known here")))
            self._begin(about)
            backoff.reset()
            waiting = asyncio.create_task(self._anew.wait(), name="other streams are wanted")
            try:
                while not waiting.done():
                    reading = asyncio.ensure_future(reader.readuntil())
                    try:
                        await asyncio.wait({reading, waiting}, return_when=asyncio.FIRST_COMPLETED)
                    finally:
                        if not reading.done():
                            reading.cancel()
                        await asyncio.wait({reading})
                    if reading.cancelled():
                        return
                    self._take(json.loads(reading.result()))
            finally:
                waiting.cancel()
        finally:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()

    def _begin(self, about: Document) -> None:
        before = self.live
        self.live = MachineLive(about)
        self.live.history = self._history
        if before is not None and before.about["streams"] == about["streams"]:
            self.live.go_on_from(before)
        self.why_not = ""
        self.heard_s = time.monotonic()
        self._has_begun.set()

    def _take(self, line: Document) -> None:
        if self.live is not None:
            self.live.hear(line)
        self.heard_s = time.monotonic()


class BoxSource:
    """The machines of the service that runs on a store.

    Args:
        store: its directory.
    """

    def __init__(self, store: Path) -> None:
        self._store = store
        self._snapshots = BoxSnapshots(store)
        self._listening: dict[str, tuple[Listening, asyncio.Task[None]]] = {}
        self._looking: dict[str, int] = {}

    async def statuses(self) -> list[Document]:
        """How each machine stands that the service watches: `daqsvc.publish.service_status`.

        Raises:
            OSError: it does not answer.
            ValueError: it answers something else.
        """
        async with _connected(self._store / SOCKET) as (reader, writer):

            async def answer(question: bytes) -> Document:
                writer.write(question + b"\n")
                told: Document = json.loads(await reader.readuntil())
                return told

            try:
                first = await answer(STATUS_QUESTION)
                if "machines" not in first:
                    return [first]
                # Of several it has to be said which one is meant: the answer names them.
                return [
                    await answer(STATUS_QUESTION[:-1] + f', "machine": {json.dumps(name)}}}'.encode())
                    for name in first["machines"]
                ]
            except asyncio.IncompleteReadError as error:
                raise ValueError("the service has not answered") from error

    @contextlib.asynccontextmanager
    async def looking(self, machine: str) -> AsyncIterator[Listening | Playing]:
        """Listen to a machine meanwhile, together with all others who look at it; or play a snapshot of it.

        Raises:
            KeyError: there is no such snapshot.
            NoPictureError: it cannot be shown.
        """
        if AT in machine:
            async with self._snapshots.looking(machine) as playing:
                yield playing
            return
        if machine not in self._listening:
            listening = Listening(self._store, machine)
            task = asyncio.create_task(listening.run(), name=f"listen to {machine}")
            self._listening[machine] = listening, task
        self._looking[machine] = self._looking.get(machine, 0) + 1
        try:
            yield self._listening[machine][0]
        finally:
            self._looking[machine] -= 1
            asyncio.get_running_loop().call_later(LINGER_S, self._perhaps_end, machine)

    def _perhaps_end(self, machine: str) -> None:
        if not self._looking.get(machine) and machine in self._listening:
            self._listening.pop(machine)[1].cancel()

    async def snapshots(self, machine: str) -> list[KeptSnapshot]:
        """See `daqsvc.page.sources.MachineSource.snapshots`."""
        return await asyncio.to_thread(self._snapshots.kept, machine.partition(AT)[0])

    async def journal(self, machine: str, alarm: str, most: int) -> list[Document]:
        """See `daqsvc.page.sources.MachineSource.journal`; of a snapshot what was played."""
        if AT in machine:
            async with self._snapshots.looking(machine) as playing:
                return playing.journal(alarm, most)
        return await asyncio.to_thread(_journal, self._store, machine, alarm, most)

    async def handle(self, machine: str, command: AlarmCommand, denied: str, via: str) -> CommandOutcome:
        """See `daqsvc.page.sources.MachineSource.handle`."""
        if AT in machine:
            return refused_of_the_past(machine)
        try:
            request = request_of(dataclasses.replace(command, denied=denied), machine, via)
            return await asyncio.to_thread(ask, self._store, request)
        except NotRunningError:
            reason = "no daqsvc runs on this box: start it with daqsvc run"
        except AbsentError:
            reason = "the service does not answer now: look at its log, and try again"
        except ControlError as error:
            reason = f"{error}"
        return CommandOutcome(accepted=False, reason=reason)

    async def close(self) -> None:
        """Listen no more."""
        await self._snapshots.close()
        tasks = {task for _, task in self._listening.values()}
        self._listening.clear()
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)


def _journal(store: Path, machine: str, alarm: str, most: int) -> list[Document]:
    """See `BoxSource.journal`; blocks.

    Raises:
        OSError: the journal cannot be read.
    """
    asked = 4 * most
    while True:
        try:
            view = read_journal(store, history=asked)
        except OutboxError as error:
            raise OSError(f"{error}") from error
        events = [json.loads(entry.payload) for entry in reversed(view.history)]
        chosen = [
            event
            for event in events
            if str(event.get("schema", "")).startswith(ALARM_SCHEMA)
            and event["machine"] == machine
            and alarm in {"", event["alarm"]}
        ]
        # Messages of other kinds, machines and alarms may lie between.
        if len(chosen) >= most or len(events) + view.damaged < asked or asked >= MOST_LOOKED_AT:
            return chosen[:most]
        asked *= 4


@contextlib.asynccontextmanager
async def _connected(path: Path) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    reader, writer = await asyncio.open_unix_connection(path, limit=LONGEST_LINE)
    try:
        yield reader, writer
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()


def _in_words(error: Exception) -> str:
    if isinstance(error, FileNotFoundError | ConnectionRefusedError):
        return "no daqsvc runs on the store"
    if isinstance(error, PermissionError):
        return "the page may not ask the service: run it as the service's user"
    if isinstance(error, asyncio.IncompleteReadError):
        return "the service has ended the connection"
    return f"{error}" or type(error).__name__
