"""A snapshot is judged again by the rings, detectors and alarms of the service.

The buses are replaced, and the hands that give samples to detectors: these give the windows that were given
then. So every detector computes the same numbers from the same samples in the same portions. It begins with
what it remembered then, if the snapshot has that, else again. That nothing came is heard as it was stated
then, and at that time: no sample shows when.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from hashlib import sha256
from typing import TYPE_CHECKING, NoReturn

from pydantic_core import to_json

from daqsvc import __version__
from daqsvc.acquisition.clock import NS_PER_S, DrivenClock, iso_utc
from daqsvc.acquisition.ring import RingClosed, RingError, RingReader
from daqsvc.acquisition.samples import SampleBlock, Window
from daqsvc.acquisition.standing import StreamState
from daqsvc.alarms.conditions import SERVICE
from daqsvc.alarms.events import Identity
from daqsvc.alarms.make import alarm_rule
from daqsvc.alarms.manager import AlarmManager
from daqsvc.alarms.quality import Lacking
from daqsvc.diagnosis.memory import DetectorMemory, MemoryNotFittingError, put
from daqsvc.diagnosis.pipeline import THREADS, KernelThreads, kernel_failed
from daqsvc.diagnosis.statements import silence_statements
from daqsvc.errors.recordings import NOT_REPLAYABLE
from daqsvc.machine_facts import files_named, machine_values, with_paths
from daqsvc.machine_watch import MachineWatch
from daqsvc.publish.payloads import (
    alarm_document,
    alarm_event,
    recorded_statement,
    statement_document,
)
from daqsvc.settings.load import machine_file_of
from daqsvc.settings.problems import AssemblyError, MachineFileError
from daqsvc.snapshots.contents import ALARMS, DIAGNOSES, FILES, MACHINE_JSON, STANDING, STATES, STORE, WINDOWS
from daqsvc.supervision import Supervisor

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
    from pathlib import Path

    from daqsvc.acquisition.ring import SampleRing
    from daqsvc.alarms.events import AlarmEvent
    from daqsvc.diagnosis.detector import Detector
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.settings import MachineFile
    from daqsvc.snapshots.contents import Document, Noted, Snapshot

STEP_NS = NS_PER_S // 4
"""The clock goes on in steps of this length, so that alarms see in time what time alone brings."""
LONGEST_GAP_NS = 3600 * NS_PER_S
"""Between two entries of a snapshot: what is longer is damage."""
ALARM_TICK_NS = NS_PER_S
_LONGEST_REASON = 200
_NOT_REMEMBERED = "the snapshot does not have what it remembered"
_LISTED = 5
"""Names that are listed one by one."""
_TURNS = 4
"""Of the event loop, after which whoever woke has done what there was to do."""
_NOT_OURS = (KeyError, ValueError, TypeError, AttributeError, RecursionError, OverflowError)
"""What comes of a document that this program has not written."""
_NOT_COMPARED = ("time", "wall_ns", "id", "sequence", "occurrence", "code", "found_message")
"""Of an alarm event: its label of wall time, what is new each time, and what earlier versions lacked."""


class ReplayError(Exception):
    """A snapshot that cannot be replayed; the text is to be read after its name."""

    code = NOT_REPLAYABLE


@dataclass(slots=True)
class Comparison:
    """What was stated then, compared with what is stated now.

    Attributes:
        equal: stated then and now, to the last bit.
        changed: stated then and not now.
        added: stated now and not then.
        later: stated now of samples of which the file has no statement any more, as it ended.
    """

    equal: int = 0
    later: int = 0
    changed: list[Document] = field(default_factory=list)
    added: list[Document] = field(default_factory=list)


@dataclass(slots=True)
class Replayed:
    """What came of a replay.

    Attributes:
        causes: why the snapshot was made, in words.
        statements: of the detectors, in order.
        alarms: events of alarms, in order.
        again: the detectors that began again, and why.
        notes: what a person should know of the snapshot, in sentences.
        said: the statements compared with those of the snapshot.
        alarmed: the same for the events of alarms, but for people's.
    """

    causes: list[str] = field(default_factory=list)
    statements: list[Diagnosis] = field(default_factory=list)
    alarms: list[AlarmEvent] = field(default_factory=list)
    anew: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    said: Comparison = field(default_factory=Comparison)
    alarmed: Comparison = field(default_factory=Comparison)

    @property
    def is_equal(self) -> bool:
        """Whether all that was stated then is stated now, and nothing else; not if nothing was compared."""
        return self.is_compared and not (
            self.said.changed or self.said.added or self.alarmed.changed or self.alarmed.added
        )

    @property
    def is_compared(self) -> bool:
        """Whether there was anything to compare."""
        return any(one.equal or one.changed or one.added for one in (self.said, self.alarmed))


class GivenWindows(RingReader):
    """Hands a detector the windows that it is given, and no others."""

    def __init__(self, ring: SampleRing) -> None:
        super().__init__(ring)
        self._windows: asyncio.Queue[Window | None] = asyncio.Queue()
        self.asks = asyncio.Event()
        """Whether the detector has done with the last one."""

    def give(self, window: Window | None) -> None:
        """Hand it on; None if no more will come."""
        self.asks.clear()
        self._windows.put_nowait(window)

    async def read(self, block: int, most_blocks: int) -> Window:
        """See `RingReader.read`."""
        del block, most_blocks
        self.asks.set()
        window = await self._windows.get()
        if window is None:
            raise RingClosed(f"the snapshot of {self.ring.stream!r} has ended")
        return window


def machine_of(snapshot: Snapshot, directory: Path) -> MachineFile:
    """The machine file of a snapshot; the files that it names are laid into a directory.

    Args:
        snapshot: as read.
        directory: empty.

    Raises:
        ReplayError: it has none, or none that can be used.
    """
    laid: dict[str, str] = {}
    lacking: list[str] = []

    def here(path: str) -> str:
        if path not in laid:
            lacking.append(path)
        return laid.get(path, path)

    try:
        for path, data in _files(snapshot).items():
            # Wherever it was then: here it lies among the others.
            laid[path] = f"{len(laid)}-{path.rpartition('/')[2]}"
            (directory / laid[path]).write_bytes(data)
        values = with_paths(json.loads(snapshot.files[MACHINE_JSON]), here)
        return machine_file_of(values, directory / MACHINE_JSON)
    except MachineFileError as error:
        problem = error.problems[0]
        if any(f"{directory / path}" in problem.message for path in lacking):
            raise ReplayError(
                f"does not have {_listed(lacking)}, which could not be read when it was written: "
                "name the machine file behind it, in a folder that has this file"
            ) from None
        raise ReplayError(f"has a machine file that cannot be used here: {problem.message}") from None
    except (*_NOT_OURS, OSError):
        raise ReplayError("has no machine file that can be used: name one behind it") from None


def _files(snapshot: Snapshot) -> dict[str, bytes]:
    """By path as the machine file has it, the content of each file that it names."""
    files = snapshot.files
    return {name.removeprefix(FILES): data for name, data in files.items() if name.startswith(FILES)}


def _why_anew(snapshot: Snapshot, machine: MachineFile) -> str:
    """Why no detector can go on with what it remembered; empty if it can.

    A machine file is the same, wherever it lies, if its values are, and what is in the files that it names.
    """
    version = snapshot.about["version"]
    if version != __version__:
        return f"the snapshot is of daqsvc {version!s:.60}, and this is {__version__}"
    then, now = json.loads(snapshot.files.get(MACHINE_JSON, b"{}")), machine_values(machine)
    files = files_named(now, machine.path.parent)
    if _with_contents(then, _files(snapshot)) == _with_contents(now, files):
        return ""
    return "the machine file, or a file that it names, is not the one in the snapshot"


def _with_contents(values: Document, files: Mapping[str, bytes]) -> Document:
    """The values of a machine file, with what is in each file that it names in place of its path."""
    return with_paths(values, lambda path: sha256(files[path]).hexdigest() if path in files else path)


class Pace:
    """How fast a replay goes.

    Args:
        speed: time of the snapshot over real time.
        now_s: a clock, s.
        sleep: waits, s.
    """

    def __init__(
        self,
        speed: float,
        now_s: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        self._speed, self._now_s, self._sleep = speed, now_s, sleep
        self._begun_s: float | None = None

    async def __call__(self, into_ns: int) -> None:
        """Wait until it is time for what came so long after the begin."""
        now_s = self._now_s()
        if self._begun_s is None:
            self._begun_s = now_s
        left_s = self._begun_s + into_ns / NS_PER_S / self._speed - now_s
        if left_s > 0.0:
            await self._sleep(left_s)


class Replay:
    """One replay of a snapshot.

    Args:
        snapshot: as read.
        machine: the machine file to judge by.
        directory: for what detectors keep.
        pace: how fast it goes; None for as fast as it can.
        heard: called with each alarm event when it comes about.

    Raises:
        ReplayError: the snapshot is none that can be replayed.
        AssemblyError: the detectors cannot be made.
    """

    def __init__(
        self,
        snapshot: Snapshot,
        machine: MachineFile,
        directory: Path,
        pace: Pace | None = None,
        heard: Callable[[AlarmEvent], None] = lambda _event: None,
    ) -> None:
        self._snapshot = snapshot
        self._pace = pace
        self._heard = heard
        self._directory = directory
        self._result = Replayed(notes=list(snapshot.notes))
        self._since: dict[str, int] = {}
        """By detector, the index from which on it judges."""
        about = snapshot.about
        try:
            self._machine = named = self._under_its_name(machine.model_copy(update={"recorder": None}))
            self._result.causes = [one for one in about.get("causes", ()) if isinstance(one, str)]
            self._begin_ns, self._wall_ns = int(about["begin_ns"]), int(about["wall_ns_at_0"])
            iso_utc(self._begin_ns + self._wall_ns)  # there is such a time
            self._standings = {n: StreamState(**one) for n, one in dict(about["standings"]).items()}
            before = [alarm_event(json.dumps(one).encode()) for one in about["alarms"]]
            lacking = {name: Lacking.of(one) for name, one in dict(about.get("lacking", {})).items()}
            changed_ns = about.get("changed_ns")
            if changed_ns is not None and int(changed_ns) > self._begin_ns:
                self._result.notes.append(
                    f"other limits came into force at {iso_utc(int(changed_ns) + self._wall_ns)}: what was "
                    "before is judged by them too, and may differ from what was reported then"
                )
            self._from_start = set(about["streams"] if about["from_start"] else ())
            self._from_start |= set(about.get("streams_from_start", ()))
            self._why_anew = _why_anew(snapshot, named)
        except _NOT_OURS as error:
            _refuse(error)
        self._is_same = not self._why_anew
        self._memories = self._stored_memories() if self._is_same else {}
        self._clock = DrivenClock(self._begin_ns, self._begin_ns + self._wall_ns)
        self._supervisor = Supervisor()
        self._readers: dict[str, GivenWindows] = {}
        self._watch = self._made()
        self._see_who_judges()
        value_names = named.value_names
        self._alarms = AlarmManager(
            Identity(named.site, named.box, named.machine.name),
            [alarm_rule(alarm, value_names) for alarm in named.alarms],
            self._clock,
            handling=named.alarm_handling,
        )
        self._before, self._lacking = before, lacking
        self._names = {
            name: detector.name
            for detector in self._watch.pipeline.detectors
            for name in _names(detector, self._begin_ns)
        }
        """By detector of a statement, the one that makes it."""
        self._earlier = self._earlier_statements()
        self._ticked_ns = self._begin_ns

    def _under_its_name(self, machine: MachineFile) -> MachineFile:
        """The machine file by the names of the snapshot: they are no physics, but statements have them."""
        about = self._snapshot.about
        own = {"site": machine.site, "box": machine.box, "machine": machine.machine.name}
        then = {key: str(about.get(key, name)) for key, name in own.items()}
        if then == own:
            return machine
        self._result.notes.append(
            f"judged as {'/'.join(then.values())}, as it was then: the machine file is of "
            f"{'/'.join(own.values())}"
        )
        named = machine.machine.model_copy(update={"name": then["machine"]})
        return machine.model_copy(update={**then, "machine": named})

    def _see_who_judges(self) -> None:
        """See that the detectors of the machine file have something to judge.

        Raises:
            ReplayError: there is nothing for any of them.
        """
        try:
            recorded = {
                str(entry.what.document["detector"])
                for entry in self._snapshot.entries
                if not isinstance(entry.what, SampleBlock) and entry.what.topic == WINDOWS
            }
        except _NOT_OURS as error:
            _refuse(error)
        streams = {detector.name: detector.stream for detector in self._watch.pipeline.detectors}
        then = self._snapshot.about["streams"]
        if then and not set(streams.values()) & set(then):
            raise ReplayError(
                f"has samples of {_listed(then)}, and the detectors of {self._machine.path} judge "
                f"{_listed(streams.values()) or 'nothing'}: give a machine file of this machine"
            )
        if recorded and not recorded & streams.keys():
            raise ReplayError(
                f"has samples for the detectors {_listed(recorded)}, of which {self._machine.path} has none, "
                f"but {_listed(streams) or 'no detector'}: give a machine file of this machine"
            )
        if recorded and (idle := streams.keys() - recorded):
            self._result.notes.append(
                f"{_listed(idle)} not judged: the snapshot does not state which samples they were given"
            )

    async def run(self) -> Replayed:
        """Replay it.

        Raises:
            ReplayError: it is damaged.
        """
        watch, pipeline = self._watch, self._watch.pipeline
        await pipeline.warm()
        self._alarms.resume(self._before, watch.active_detectors(), restarted=False)
        self._alarms.remember(self._lacking)
        for stream, standing in self._standings.items():
            if stream in watch.standings:
                watch.stand(stream, standing)
        running = asyncio.create_task(pipeline.run(), name="replayed pipeline")
        try:
            for reader in self._readers.values():
                await reader.asks.wait()
            for entry in self._snapshot.entries:
                if self._pace is not None:
                    self._see_gap(entry.at_ns)
                    await self._pace(entry.at_ns - self._begin_ns)
                await self._go_on_to(entry.at_ns)
                if isinstance(entry.what, SampleBlock):
                    self._write(entry.what)
                else:
                    await self._note(entry.what)
            for reader in self._readers.values():
                reader.give(None)
            watch.close()
            self._clock.advance_to(self._clock.monotonic_ns() + NS_PER_S)
            await running
        finally:
            running.cancel()
            await asyncio.wait({running})
        self._compare()
        return self._result

    def _made(self) -> MachineWatch:
        """The rings and detectors, which remember what they can."""
        while True:
            watch = MachineWatch(
                self._machine,
                self._directory,
                self._clock,
                self._report,
                self._supervisor,
                lambda _bus: "",
                lambda _stream: "",
                KernelThreads(THREADS, kernel_failed(self._supervisor)),
                GivenWindows,
                listens=False,
            )
            misfit = self._remind(watch)
            if not misfit:
                return watch
            del self._memories[misfit]  # it may remember half of it now

    def _remind(self, watch: MachineWatch) -> str:
        """Have detectors remember; returns the one that cannot, else nothing."""
        self._readers.clear()
        self._since.clear()
        for detector in watch.pipeline.detectors:
            reader = watch.pipeline.readers[detector.name]
            assert isinstance(reader, GivenWindows)  # noqa: S101 - for the type checker
            self._readers[detector.name] = reader
            if detector.name in self._memories:
                end_index, memory = self._memories[detector.name]
                try:
                    put(detector, memory)
                except MemoryNotFittingError as error:
                    self._result.notes.append(f"{detector.name} cannot remember what it did: {error}")
                    return detector.name
                self._since[detector.name] = end_index
                self._result.anew.pop(detector.name, None)
            elif not (detector.stream in self._from_start and self._is_same):
                self._result.anew[detector.name] = self._why_anew or _NOT_REMEMBERED
        return ""

    def _stored_memories(self) -> dict[str, tuple[int, DetectorMemory]]:
        memories: dict[str, tuple[int, DetectorMemory]] = {}
        for entry in self._snapshot.entries:
            if not isinstance(entry.what, SampleBlock) and entry.what.topic == STATES:
                document = entry.what.document
                try:
                    memories[str(document["detector"])] = (
                        int(document["end_index"]),
                        DetectorMemory.of(document),
                    )
                except (*_NOT_OURS, MemoryNotFittingError) as error:
                    _refuse(error)
        return memories

    def _see_gap(self, at_ns: int) -> None:
        if at_ns - self._clock.monotonic_ns() > LONGEST_GAP_NS:
            raise ReplayError("is damaged: its time leaps by more than an hour")

    async def _go_on_to(self, at_ns: int) -> None:
        """Let time pass."""
        clock = self._clock
        self._see_gap(at_ns)
        while (now_ns := clock.monotonic_ns()) < at_ns:
            due_ns = self._ticked_ns + STEP_NS
            clock.advance_to(min(at_ns, max(due_ns, now_ns)))
            if clock.monotonic_ns() < due_ns:
                return
            self._ticked_ns = due_ns
            for _ in range(_TURNS):
                await asyncio.sleep(0)
            if (due_ns - self._begin_ns) % ALARM_TICK_NS < STEP_NS:
                self._take(self._alarms.tick())

    def _write(self, block: SampleBlock) -> None:
        """Samples come, of a stream or of a grid: grids are as they were made then."""
        ring = self._watch.rings.get(block.stream)
        if ring is None:
            return
        try:
            ring.write(block)
        except ValueError as error:
            raise ReplayError(f"is damaged: {error}") from None

    async def _note(self, noted: Noted) -> None:
        document = noted.document
        try:
            if noted.topic == STANDING and document["stream"] in self._watch.standings:
                values = {key: value for key, value in document.items() if key != "stream"}
                self._watch.stand(document["stream"], StreamState(**values))
            elif noted.topic in (DIAGNOSES, ALARMS):
                self._follow(noted)
            elif noted.topic == WINDOWS and document["detector"] in self._readers:
                await self._give(document["detector"], document)
        except _NOT_OURS as error:
            _refuse(error)

    def _earlier_statements(self) -> dict[str, deque[Noted]]:
        """By detector that remembers, what was stated by samples that it had judged by the begin, in order.

        It may have come late, when the detector had got further samples already.
        """
        earlier: dict[str, deque[Noted]] = {name: deque() for name in self._since}
        for entry in self._snapshot.entries:
            if not isinstance(entry.what, SampleBlock) and (name := self._earlier_by(entry.what)) in earlier:
                earlier[name].append(entry.what)
        return earlier

    def _earlier_by(self, noted: Noted) -> str:
        """The detector that has stated something by samples that it had judged by the begin; else nothing."""
        document = noted.document
        statement = document.get("cause") if noted.topic == ALARMS else document
        if noted.topic not in (ALARMS, DIAGNOSES) or not isinstance(statement, dict) or document.get("by"):
            return ""
        name = self._names.get(str(statement.get("detector")), "")
        return "" if _is_silence(statement) or self._is_replayed(statement) else name

    def _follow(self, noted: Noted) -> None:
        """Have the alarms follow what was stated then, if it is not stated again."""
        document = noted.document
        earlier = self._earlier.get(self._earlier_by(noted))
        if earlier is not None:
            if not earlier or earlier[0] is not noted:
                return  # it has been heard before the first window of its detector
            earlier.popleft()
        if noted.topic == DIAGNOSES:
            if document["detector"] in self._names:
                self._hear(document)
        elif not document.get("by") and self._is_earlier(document):
            self._go_on_from(alarm_event(json.dumps(document).encode()))

    def _hear(self, statement: Document) -> None:
        """Have the alarms hear what was stated then, if it is not stated again."""
        is_silence = _is_silence(statement)
        if is_silence:
            self._see_silence(statement)
        elif self._is_replayed(statement) or not self._is_same:
            return
        diagnosis = recorded_statement(statement)
        events = self._alarms.take(diagnosis)
        if is_silence:
            self._result.statements.append(diagnosis)
            self._take(events)

    def _see_silence(self, statement: Document) -> None:
        """Have the pipeline know since when a stream is silent."""
        if statement["sensors"]:  # those of a detector that has failed name none
            stream = self._readers[self._names[statement["detector"]]].ring.stream
            self._watch.pipeline.fell_silent(stream, int(statement["monotonic_ns"]))

    def _go_on_from(self, event: AlarmEvent) -> None:
        """Have an alarm stand as it did then, where what was heard is not enough for it to."""
        stands = self._alarms.alarms.get(event.alarm)
        if stands is None or (stands.state, stands.level) != (event.to_state, event.to_level):
            self._alarms.resume([event], self._watch.active_detectors(), restarted=False)

    async def _give(self, detector: str, document: Document) -> None:
        """Have a detector process what it processed then."""
        earlier = self._earlier.get(detector, ())
        while earlier:
            self._follow(earlier[0])
        reader = self._readers[detector]
        first, count = int(document["first_index"]), int(document["count"])
        if first < self._since.get(detector, first):
            return
        ring = reader.ring
        try:
            samples = ring.read(first, count)
        except RingError:
            # It began before the snapshot.
            self._result.anew.setdefault(detector, "its first samples are not in the snapshot")
            return
        last = first + count - 1
        self._since.setdefault(detector, first)
        reader.give(
            Window(
                first,
                samples,
                ring.time_of(last),
                ring.period_at(last),
                int(document["skipped"]),
                bool(document["snapshot"]),
                tuple(map(int, document["breaks"])),
            )
        )
        await reader.asks.wait()

    def _report(self, diagnosis: Diagnosis) -> None:
        if diagnosis.quality == "missing" and diagnosis.end_index == diagnosis.first_index:
            return  # it is used when it was stated
        self._result.statements.append(diagnosis)
        self._take(self._alarms.take(diagnosis))

    def _take(self, events: Sequence[AlarmEvent]) -> None:
        self._result.alarms += events
        for event in events:
            self._heard(event)

    def _recorded_results(self) -> tuple[list[Document], list[Document]]:
        """The statements and alarm events of then that are to come again now."""
        statements: list[Document] = []
        alarmed: list[Document] = []
        others: dict[str, Counter[str]] = {DIAGNOSES: Counter(), ALARMS: Counter()}
        """By topic and detector, what is of no detector of the machine file."""
        for entry in self._snapshot.entries:
            if isinstance(entry.what, SampleBlock) or entry.what.topic not in others:
                continue
            topic, document = entry.what.topic, entry.what.document
            if topic == DIAGNOSES:
                if self._is_replayed(document) or self._is_heard(document):
                    statements.append(document)
                elif document.get("detector") not in self._names:
                    others[topic][str(document.get("detector"))] += 1
            elif self._is_judged(document):
                if not (document.get("by") or self._is_earlier(document)):
                    alarmed.append(document)
            elif not document.get("by"):
                others[topic][_judge(document)] += 1
        self._tell_of_others(others)
        return statements, alarmed

    def _tell_of_others(self, others: dict[str, Counter[str]]) -> None:
        if of_service := others[ALARMS].pop(SERVICE, 0):
            self._result.notes.append(f"alarm events of the service itself are not compared: {of_service}")
        for topic, words in ((DIAGNOSES, "statements"), (ALARMS, "alarm events")):
            if counts := others[topic]:
                self._result.notes.append(
                    f"{words} of detectors that the machine file does not have are not judged again: "
                    f"{counts.total()} ({_listed(counts)})"
                )

    def _compare(self) -> None:
        """Compare what was stated then with what is stated now."""
        statements, alarmed = self._recorded_results()
        _hold(self._result.said, statements, [statement_document(one) for one in self._result.statements])
        # What follows of statements that came after the end of the file came after it, too.
        ends = _ends(statements)
        of_later = [one for one in self._result.said.added if _end_of(one) > ends.get(one["detector"], -1)]
        later = {_comparable(one) for one in of_later}
        self._result.said.added = [one for one in self._result.said.added if _comparable(one) not in later]
        self._result.said.later = len(of_later)
        of_data = [
            event
            for event in self._result.alarms
            if not event.by and _comparable(statement_document(event.cause)) not in later
        ]
        alarmed_now = filter(self._is_judged, map(alarm_document, of_data))
        _hold(self._result.alarmed, alarmed, list(alarmed_now))

    def _is_replayed(self, document: Document) -> bool:
        """Whether a statement of then rests on samples that were judged again."""
        try:
            since = self._since.get(self._names[document["detector"]])
            return since is not None and document["window"]["end_index"] > since
        except (KeyError, TypeError):
            return False

    def _is_heard(self, statement: Document) -> bool:
        return statement.get("detector") in self._names and _is_silence(statement)

    def _is_judged(self, alarm: Document) -> bool:
        """Whether an alarm event of then follows from what a detector has stated."""
        cause = alarm.get("cause")
        return isinstance(cause, dict) and cause.get("detector") in self._names

    def _is_earlier(self, alarm: Document) -> bool:
        """Whether an alarm event of then follows of samples that its detector had judged by the begin."""
        cause = alarm["cause"] if self._is_judged(alarm) else None
        return cause is not None and not _is_silence(cause) and not self._is_replayed(cause)


def _judge(alarm: Document) -> str:
    """The detector of whose statement an alarm event of then follows."""
    cause = alarm.get("cause")
    return str(cause.get("detector", SERVICE)) if isinstance(cause, dict) else SERVICE


def _listed(names: Iterable[str]) -> str:
    some = sorted({*names})
    more = ", ..." if len(some) > _LISTED else ""
    return ", ".join(f"{name:.60}" for name in some[:_LISTED]) + more


def _names(detector: Detector, t_ns: int) -> set[str]:
    return {detector.name, *(one.detector for one in silence_statements(detector, 0.0, t_ns))}


def _is_silence(statement: Document) -> bool:
    """Whether a statement states that nothing came: it rests on no samples."""
    window = statement.get("window")
    return (
        isinstance(window, dict)
        and statement.get("quality") == "missing"
        and window.get("first_index") == window.get("end_index")
    )


def _end_of(statement: Document) -> int:
    """The index behind the samples that a statement rests on."""
    window = statement.get("window")
    end: int = window["end_index"] if isinstance(window, dict) else -1
    return end


def _ends(statements: list[Document]) -> dict[str, int]:
    """How far each detector had come by the end of the file."""
    ends: dict[str, int] = {}
    for one in statements:
        ends[one["detector"]] = max(ends.get(one["detector"], -1), _end_of(one))
    return ends


def _hold(comparison: Comparison, then: list[Document], now: list[Document]) -> None:
    texts_now = [_comparable(one) for one in now]
    texts_then = [_comparable(one) for one in then]
    left = Counter(texts_now)
    for text, document in zip(texts_then, then, strict=True):
        if left[text]:
            left[text] -= 1
            comparison.equal += 1
        else:
            comparison.changed.append(document)
    for text, document in zip(texts_now, now, strict=True):
        if left[text]:
            left[text] -= 1
            comparison.added.append(document)


def _comparable(document: Document) -> str:
    """The same text for what is the same to the last bit."""
    content = json.loads(to_json(document, inf_nan_mode="null"))
    return json.dumps({key: one for key, one in content.items() if key not in _NOT_COMPARED}, sort_keys=True)


def _refuse(error: Exception) -> NoReturn:
    words = " ".join(f"{error}".split())[:_LONGEST_REASON]
    raise ReplayError(f"holds what is none of daqsvc's ({type(error).__name__}: {words})") from None


async def replay(
    snapshot: Snapshot,
    machine: MachineFile | None,
    directory: Path,
    pace: Pace | None = None,
    heard: Callable[[AlarmEvent], None] = lambda _event: None,
) -> Replayed:
    """Judge a snapshot again.

    Args:
        snapshot: as read.
        machine: the machine file to judge by; None for that of the snapshot.
        directory: empty; for files.
        pace: how fast it goes; None for as fast as it can.
        heard: called with each alarm event when it comes about.

    Raises:
        ReplayError: it cannot be replayed.
    """
    for part in ("files", "store"):
        (directory / part).mkdir()
    for name, data in snapshot.files.items():
        if name.startswith(STORE):
            (directory / "store" / name.rpartition("/")[2]).write_bytes(data)
    try:
        judged_by = machine or machine_of(snapshot, directory / "files")
        return await Replay(snapshot, judged_by, directory / "store", pace, heard).run()
    except AssemblyError as error:
        raise ReplayError(f"has detectors that cannot be made here: {error}") from None
