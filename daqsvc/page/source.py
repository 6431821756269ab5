"""Where the page gets what it shows: the service on this box, over its control socket.

A machine is listened to while somebody views it. Samples are asked for of the streams that are shown.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
from functools import partial
from typing import TYPE_CHECKING, Any

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
from daqsvc.outbox.messages import OutboxError
from daqsvc.outbox.reading import read_journal
from daqsvc.page.box_snapshots import AT, BoxSnapshots
from daqsvc.page.listening import Listening, Listenings
from daqsvc.page.recorded import refused_of_the_past

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from daqsvc.acquisition.link import Backoff
    from daqsvc.alarms.commands import AlarmCommand
    from daqsvc.page.box_snapshots import KeptSnapshot
    from daqsvc.page.sources import Heard

    Document = dict[str, Any]

LONGEST_LINE = 64 * 1024 * 1024
ALARM_SCHEMA = "daqsvc.alarm/"
MOST_LOOKED_AT = 20_000
"""Messages of the journal that are looked through for the events of one alarm."""
LINGER_S = 60.0
"""How long a machine is still listened to after the last viewer has gone, without samples. So a view
that is opened next does not begin with nothing."""


class BoxListening(Listening):
    """Listens to one machine of a service.

    Args:
        store: the store of the service.
        machine: its name.
    """

    def __init__(self, store: Path, machine: str) -> None:
        super().__init__(machine, store / HISTORY)
        self._path = store / SOCKET

    def in_words(self, error: Exception) -> str:
        """See `Listening.in_words`."""
        if isinstance(error, FileNotFoundError | ConnectionRefusedError):
            return "no daqsvc runs on the store"
        if isinstance(error, PermissionError):
            return "the page may not ask the service: run it as the service's user"
        if isinstance(error, asyncio.IncompleteReadError):
            return "the service has ended the connection"
        return super().in_words(error)

    async def listen(self, backoff: Backoff) -> None:
        """See `Listening.listen`."""
        reader, writer = await asyncio.open_unix_connection(self._path, limit=LONGEST_LINE)
        try:
            asked = {"machine": self.machine, "streams": sorted(self.streams)}
            question = f'{{"schema": "daqsvc.control/1", "verb": "live", {json.dumps(asked)[1:]}\n'
            writer.write(question.encode())
            self.begin(json.loads(await reader.readuntil()))
            backoff.reset()
            waiting = asyncio.create_task(self.anew.wait(), name="other streams are wanted")
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
                    self.take(json.loads(reading.result()))
            finally:
                waiting.cancel()
        finally:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()


class BoxSource:
    """The machines of the service that runs on a store.

    Args:
        store: its directory.
    """

    def __init__(self, store: Path) -> None:
        self._store = store
        self._snapshots = BoxSnapshots(store)
        self._listenings = Listenings(LINGER_S)

    async def statuses(self) -> list[Document]:
        """The state of each machine that the service watches: `daqsvc.publish.service_status`.

        Raises:
            OSError: it does not answer.
            ValueError: it answers something else.
        """
        async with _connected(self._store / SOCKET) as (reader, writer):

            async def answer(question: bytes) -> Document:
                writer.write(question + b"\n")
                reply: Document = json.loads(await reader.readuntil())
                return reply

            try:
                first = await answer(STATUS_QUESTION)
                if "machines" not in first:
                    return [first]
                # If there are several, the question has to name one: the answer lists them.
                return [
                    await answer(STATUS_QUESTION[:-1] + f', "machine": {json.dumps(name)}}}'.encode())
                    for name in first["machines"]
                ]
            except asyncio.IncompleteReadError as error:
                raise ValueError("the service has not answered") from error

    @contextlib.asynccontextmanager
    async def looking(self, machine: str) -> AsyncIterator[Heard]:
        """Listen to a machine meanwhile, together with all others who look at it; or play a snapshot of it.

        Raises:
            KeyError: there is no such snapshot.
            NoPictureError: it cannot be shown.
        """
        if AT in machine:
            async with self._snapshots.looking(machine) as playing:
                yield playing
            return
        with self._listenings.looking(machine, partial(BoxListening, self._store, machine)) as listening:
            yield listening

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
        except NotRunningError as error:
            code, reason = error.code, "no daqsvc runs on this box: start it with daqsvc run"
        except AbsentError as error:
            code, reason = error.code, "the service does not answer now: look at its log, and try again"
        except ControlError as error:
            code, reason = error.code, f"{error}"
        return CommandOutcome(accepted=False, reason=reason, code=code.id)

    async def close(self) -> None:
        """Listen no more."""
        await self._snapshots.close()
        await self._listenings.close()


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
