"""Snapshots of the recorder in place of a service: each is played in real time, again and again."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import re
import time
from datetime import datetime
from typing import TYPE_CHECKING, Any

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.samples import SampleBlock
from daqsvc.alarms.commands import CommandOutcome
from daqsvc.errors.command_line import COMMAND_REFUSED
from daqsvc.errors.recordings import NOT_REPLAYABLE
from daqsvc.page.machine_live import MachineLive
from daqsvc.page.text import standing
from daqsvc.snapshots.contents import ALARMS, DIAGNOSES, MACHINE_JSON, STANDING

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable, Iterator, Mapping

    from daqsvc.alarms.commands import AlarmCommand
    from daqsvc.snapshots.contents import Entry, Snapshot

    Document = dict[str, Any]

KEYS = {DIAGNOSES: "statement", ALARMS: "alarm", STANDING: "standing"}
"""By topic of a snapshot, the key of `daqsvc.live_feed`."""
STEP_S = 0.5
NAME = re.compile(r"(?P<date>\d{8})T(?P<time>\d{6})\.(?P<us>\d{6})Z-(?P<kind>[a-z-]+)")
"""Of the file of a snapshot: when its cause came, and why it was made."""
PAUSE_S = 3.0
"""Between the end and the next begin."""


class NoPictureError(Exception):
    """A snapshot that cannot be shown; the text states why."""

    code = NOT_REPLAYABLE


class Playing:
    """One snapshot that is played; as `daqsvc.page.listening.Listening`.

    Args:
        snapshot: as read.
        name: what it is called.

    Raises:
        NoPictureError: it lacks what is needed.
    """

    why_not = ""

    def __init__(self, snapshot: Snapshot, name: str) -> None:
        self._snapshot = snapshot
        self._name = name
        self._pass = 0
        self.heard_s = time.monotonic()
        try:
            self._values = json.loads(snapshot.files[MACHINE_JSON])
            self._begin_ns = int(snapshot.about["begin_ns"])
            self._cause = "; ".join(map(str, snapshot.about.get("causes", ())))
            self._cause_s = self._cause_in_name_s()
            self.live = self._begun()
        except (LookupError, TypeError, ValueError) as error:
            raise NoPictureError(
                f"the snapshot {name} has no machine file that the page can use ({type(error).__name__}); "
                "show one that this version has made"
            ) from None

    def _cause_in_name_s(self) -> float | None:
        """How long after its begin the cause came, by the name of the file; None without a time in it."""
        about = self._snapshot.about
        if (named := NAME.search(self._name)) is None:
            return None
        date, clock = named["date"], named["time"]
        cause = datetime.strptime(f"{date}{clock}{named['us']}+0000", "%Y%m%d%H%M%S%f%z")
        begin_wall_ns = self._begin_ns + int(about["wall_ns_at_0"])
        cause_s = cause.timestamp() - begin_wall_ns / NS_PER_S
        return cause_s if cause_s >= 0.0 else None

    async def first(self, _timeout_s: float) -> MachineLive:
        """See `daqsvc.page.listening.Listening.first`."""
        return self.live

    @contextlib.contextmanager
    def wanting(self, _streams: Iterable[str]) -> Iterator[None]:
        """All of its streams are there."""
        yield

    async def run(self) -> None:
        """Play it until cancelled."""
        while True:
            begun_s = time.monotonic()
            for entry in self._snapshot.entries:
                await self._wait_until(begun_s + (entry.at_ns - self._begin_ns) / NS_PER_S, begun_s)
                self._hear(entry)
            ended_s = time.monotonic()
            await self._wait_until(ended_s + PAUSE_S, begun_s, ended_s)
            self.live = self._begun()

    def journal(self, alarm: str, most: int) -> list[Document]:
        """What was played of the events of an alarm, or of all (""), the newest first."""
        events = [*self.live.journal][::-1]
        return [one for one in events if alarm in {"", one["alarm"]}][:most]

    def _begun(self) -> MachineLive:
        self._pass += 1
        about = {**self._snapshot.about, "machine": self._name, "values": self._values, "statements": []}
        return MachineLive({**about, "begun_ns": self._pass})

    def _hear(self, entry: Entry) -> None:
        if isinstance(entry.what, SampleBlock):
            self.live.place(entry.what)
        elif entry.what.topic in KEYS:
            self.live.hear({KEYS[entry.what.topic]: entry.what.document})

    async def _wait_until(self, due_s: float, begun_s: float, ended_s: float = math.inf) -> None:
        while (now_s := time.monotonic()) < due_s:
            self.heard_s = now_s
            self.live.note = self._moment(min(now_s, ended_s) - begun_s)
            await asyncio.sleep(min(due_s - now_s, STEP_S))
        self.heard_s = time.monotonic()

    def _moment(self, played_s: float) -> str:
        """Which moment is shown: how long before its cause, or after it."""
        if self._cause_s is None:
            return f"snapshot, {played_s:.0f} s after its begin"
        away_s = played_s - self._cause_s
        return f"snapshot, {abs(away_s):.0f} s {'before' if away_s < 0 else 'after'} its cause: {self._cause}"


def refused_of_the_past(machine: str) -> CommandOutcome:
    """What comes of a command to an alarm of a snapshot."""
    return CommandOutcome(
        accepted=False,
        reason=f"{machine} is a snapshot: its alarms are of the past",
        code=COMMAND_REFUSED.id,
    )


class SnapshotSource:
    """Snapshots as `daqsvc.page.source.BoxSource` has machines.

    Args:
        snapshots: by what they are called.

    Raises:
        NoPictureError: one lacks what is needed.
    """

    def __init__(self, snapshots: Mapping[str, Snapshot]) -> None:
        self._playing = {name: Playing(one, name) for name, one in snapshots.items()}
        self._tasks: list[asyncio.Task[None]] = []

    async def statuses(self) -> list[Document]:
        """See `daqsvc.page.source.BoxSource.statuses`."""
        self._play()
        return [
            {"machine": name, "alarms": {"standing": standing(one.live)}}
            for name, one in self._playing.items()
        ]

    @contextlib.asynccontextmanager
    async def looking(self, machine: str) -> AsyncIterator[Playing]:
        """See `daqsvc.page.source.BoxSource.looking`.

        Raises:
            KeyError: there is no such snapshot.
        """
        self._play()
        yield self._playing[machine]

    async def journal(self, machine: str, alarm: str, most: int) -> list[Document]:
        """See `daqsvc.page.sources.MachineSource.journal`: what was played."""
        return self._playing[machine].journal(alarm, most)

    async def snapshots(self, machine: str) -> list[Any]:
        """See `daqsvc.page.sources.MachineSource.snapshots`: it is one."""
        del machine
        return []

    async def handle(self, machine: str, command: AlarmCommand, denied: str, via: str) -> CommandOutcome:
        """See `daqsvc.page.sources.MachineSource.handle`: nothing is done."""
        del command, denied, via
        return refused_of_the_past(machine)

    async def close(self) -> None:
        """Play no more."""
        for task in self._tasks:
            task.cancel()
        if self._tasks:
            await asyncio.wait(self._tasks)

    def _play(self) -> None:
        if not self._tasks:
            self._tasks = [asyncio.create_task(one.run(), name="snapshot") for one in self._playing.values()]
