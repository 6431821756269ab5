"""An output that appends alarm events and changed diagnoses to a file, one line of JSON each."""

import asyncio
import json
from pathlib import Path
from typing import Annotated

from pydantic import Field

from daqsvc.api import Diagnosis, MachineFile, Output, OutputPlugin, OutputPort, Section, Text


class EventFile(Section):
    """The table [event_file]."""

    path: Annotated[Text, Field(description="the file", examples=["events.jsonl"])]


class EventFileOutput(Output):
    """Goes on, also after a restart, with the event after the last one in the file."""

    def __init__(self, path: Path, port: OutputPort) -> None:
        self._path, self._outbox, self._pending, self._lines = path, port.outbox, list[str](), 0

    def report(self, diagnosis: Diagnosis) -> None:
        """Keep what a detector has changed its mind about."""
        if diagnosis.changed:
            self._pending.append(json.dumps({"detector": diagnosis.detector, "decision": diagnosis.decision}))

    async def run(self) -> None:
        """Append what is new, at least once a second."""
        written = await asyncio.to_thread(self._last_event)
        while True:
            try:
                async with asyncio.timeout(1.0):
                    events = await self._outbox.next_following(written, 100)
            except TimeoutError:
                events = []
            pending = self._pending[:]
            await asyncio.to_thread(self._append, [*pending, *(event.payload.decode() for event in events)])
            del self._pending[: len(pending)]
            written = max([written, *(event.sequence for event in events)])

    def figures(self) -> dict[str, int]:
        """How many lines this run has written."""
        return {"lines": self._lines}

    def _append(self, lines: list[str]) -> None:
        with self._path.open("a", encoding="utf-8") as file:
            file.writelines(f"{line}\n" for line in lines)
        self._lines += len(lines)

    def _last_event(self) -> int:
        lines = self._path.read_text("utf-8").splitlines() if self._path.exists() else []
        return max((json.loads(line).get("sequence", 0) for line in lines), default=0)


class EventFilePlugin(OutputPlugin[EventFile]):
    """Alarm events and changed diagnoses, in a file."""

    settings, about, status_key = EventFile, "alarm events in a file", "event_file"

    def build(self, machine: MachineFile, settings: EventFile, port: OutputPort) -> Output:
        """The output."""
        return EventFileOutput(machine.resolve(Path(settings.path)), port)
