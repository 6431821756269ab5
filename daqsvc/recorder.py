"""The recorder of a machine: recent samples and statements, and snapshots of it on the disk.

The event loop only puts references to what passes into a history; a thread writes them when there is a cause.
A disk that is full, slow or gone costs the snapshot and nothing else.
"""

from __future__ import annotations

import asyncio
import contextlib
import copy
import json
import logging
import math
from collections import deque
from dataclasses import asdict, dataclass, field
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    NamedTuple,
    NotRequired,
    TypeAlias,
    TypedDict,
    get_args,
)

from daqsvc import __version__
from daqsvc.acquisition.clock import NS_PER_S, iso_utc
from daqsvc.acquisition.samples import SampleBlock
from daqsvc.acquisition.standing import StreamState
from daqsvc.alarms.conditions import is_condition
from daqsvc.alarms.events import ANNUNCIATIONS, AlarmEvent, Identity
from daqsvc.alarms.quality import Lacking, SensorHealth
from daqsvc.diagnosis.memory import MemoryNotTakenError, taken_memory
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.errors.code import coded
from daqsvc.errors.command_line import NOT_ASKED
from daqsvc.errors.service import SNAPSHOT_LOST
from daqsvc.machine_facts import StreamFacts, fault_names, files_named, machine_values, stream_facts
from daqsvc.notice import notice
from daqsvc.publish.payloads import alarm_document, statement_document
from daqsvc.settings.registry import configured
from daqsvc.settings.speed_signals import RPM, speed_signals
from daqsvc.snapshots.contents import (
    ALARMS,
    CAUSES,
    DIAGNOSES,
    FILES,
    MACHINE_JSON,
    MACHINE_TOML,
    SCHEMA,
    STANDING,
    STATES,
    STORE,
    WINDOWS,
    Entry,
    Noted,
)
from daqsvc.snapshots.folder import SnapshotFolder
from daqsvc.snapshots.speed_steps import SpeedSteps

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.samples import Window
    from daqsvc.diagnosis.detector import Detector
    from daqsvc.diagnosis.memory import DetectorMemory
    from daqsvc.settings.models import MachineFile
    from daqsvc.settings.recorder import Recorder as RecorderTable
    from daqsvc.snapshots.writing import SnapshotWriter
    from daqsvc.supervision import Supervisor

log = logging.getLogger(__name__)

Kind = Literal["alarm", "asked", "speed", "scheduled", "continuous"]
"""Why a file is written, the weightiest first."""

TURN_NS = NS_PER_S // 4
"""How often what has come is handed to the thread that writes."""
SPARE_NS = NS_PER_S
"""What the history holds beyond what a snapshot begins with: a cause is seen a turn late."""
MOST_WAITING_BYTES = 64_000_000
"""Samples that wait for a disk that is slow, at most, beside those that the history holds anyway."""
MOST_WAITING = 50_000
"""Items of every kind that wait for it, at most."""
SCHEDULED = "scheduled"
MOST_CAUSES = 100
"""Of one snapshot that are recorded."""
MEMORY_EVERY_NS = 5 * NS_PER_S
"""How often detectors are asked what they remember."""
MOST_MEMORY_BYTES = 16_000_000
"""What is kept of what one detector remembered, at most; the newest is kept however large it is."""
MOST_ASKED = 16
"""People who wait for a snapshot at a time."""
PATIENCE_NS = 5 * NS_PER_S
"""How much longer a snapshot lasts, at most, for detectors to state what they find in its samples."""
HOLD_NS = 2 * MEMORY_EVERY_NS + SPARE_NS
"""How long the change to the next file waits for detectors to hand over what they remember."""
AGAIN_NS = 10 * NS_PER_S
"""After so long continuous recording is tried again where the disk has refused it."""
CONTINUOUS_SHARE = 0.25
"""Of the size of all, that one file of a continuous recording may have: there are several then."""
SNAPSHOT_SHARE = 0.5
"""Of the size of all, that any other file may have."""
ROOM_SHARE = 0.05
"""Of the size of all, after which it is seen to that what is there is not more."""
END_S = 0.25
"""What the end of the service leaves for the last of a snapshot."""


ENDS = "nothing more is recorded: the service ends, or goes on by another machine file"
"""What people who wait for a snapshot get then."""


class SnapshotAbout(TypedDict):
    """The message of `/about`, the first one: of which machine the file is, and the states at its begin.

    Attributes:
        at_ns: the begin, by the monotonic clock of the box, ns.
        schema: what the file is, and of which version.
        version: version of daqsvc.
        site: name of the site.
        box: name of the box.
        machine: name of the machine.
        begin_ns: the begin, by the monotonic clock of the box, ns.
        begin: the begin, ISO 8601, UTC.
        wall_ns_at_0: time by the wall clock at 0 of the monotonic clock, ns since the Unix epoch.
        from_start: whether nothing came before the begin.
        streams_from_start: streams and grids of which nothing came before the begin.
        changed_ns: when the machine file in force was read, by the monotonic clock of the box, ns.
        remembered: by detector up to which sample its state at the begin has gone.
        streams: what is known of each stream and grid.
        faults: by detector and decision the fault that it means.
        standings: how each stream stands.
        alarms: the last event of each alarm.
        lacking: by detector what it had lacked in the last seconds.
        causes: the first cause of the file, in words.
    """

    at_ns: NotRequired[int]
    schema: Literal["daqsvc.snapshot/1"]
    version: str
    site: str
    box: str
    machine: str
    begin_ns: int
    begin: str
    wall_ns_at_0: int
    from_start: bool
    streams_from_start: list[str]
    changed_ns: int | None
    remembered: dict[str, int]
    streams: dict[str, StreamFacts]
    faults: dict[str, dict[str, str]]
    standings: dict[str, Annotated[dict[str, Any], StreamState]]
    alarms: list[Annotated[dict[str, Any], "daqsvc.alarm/1"]]
    lacking: dict[str, Annotated[dict[str, Any], Lacking]]
    causes: list[str]


class SnapshotCause(TypedDict):
    """A message of `/causes`: a further cause of the file.

    Attributes:
        at_ns: when it came, by the monotonic clock of the box, ns.
        kind: what kind of cause it is.
        cause: the cause in words.
    """

    at_ns: NotRequired[int]
    kind: Kind
    cause: str


class SnapshotWindow(TypedDict):
    """A message of `/windows`: samples were handed to a detector.

    Attributes:
        at_ns: when, by the monotonic clock of the box, ns.
        detector: name of the detector.
        first_index: number of the first sample.
        count: how many samples there were.
        skipped: samples before these that the detector has not had, as it was too slow.
        snapshot: whether the samples are the newest, and others before them were left out on purpose.
        breaks: numbers of the samples before which some are missing.
    """

    at_ns: NotRequired[int]
    detector: str
    first_index: int
    count: int
    skipped: int
    snapshot: bool
    breaks: list[int]


class SnapshotStanding(TypedDict):
    """A message of `/standing`: a stream stands otherwise.

    Attributes:
        at_ns: when, by the monotonic clock of the box, ns.
        stream: name of the stream.
        doubt: why nothing can be judged by its samples; empty if there is no evidence against them.
        proven: whether its rate seems to be the nominal one, or could not be found out in time.
        silent: whether the doubt is that nothing comes at all, since another doubt was active.
    """

    at_ns: NotRequired[int]
    stream: str
    doubt: str
    proven: bool
    silent: bool


class SnapshotState(TypedDict):
    """A message of `/states`: the state of a detector at the begin of the file, which only daqsvc reads.

    Attributes:
        at_ns: when, by the monotonic clock of the box, ns.
        detector: name of the detector.
        end_index: number of the first sample that it had not had yet.
        tree: what it remembered.
        arrays: the arrays in that: type, shape, and the values as base64.
    """

    at_ns: NotRequired[int]
    detector: str
    end_index: int
    tree: Any
    arrays: list[list[Any]]


class SnapshotRefusedError(Exception):
    """A snapshot that was asked for is not made; the text states why."""

    code = NOT_ASKED


class SnapshotLostError(SnapshotRefusedError):
    """A snapshot was begun, and the disk has not taken it."""

    code = SNAPSHOT_LOST


@dataclass(slots=True)
class RecorderCounters:
    """What the recorder has done; every figure only grows.

    Attributes:
        snapshots: written to their end.
        snapshots_failed: begun or due, and not written to their end.
        bytes_written: in snapshots.
        blocks_dropped: blocks that a snapshot lacks, as the disk was too slow.
        memories_not_taken: how often a detector remembered too much for a snapshot to begin with.
        write_failures: how often the disk refused something.
    """

    snapshots: int = 0
    snapshots_failed: int = 0
    bytes_written: int = 0
    blocks_dropped: int = 0
    memories_not_taken: int = 0
    write_failures: int = 0


class _Read(NamedTuple):
    """Samples were handed to a detector."""

    detector: str
    window: SnapshotWindow


class _Stands(NamedTuple):
    """A stream stands otherwise than before."""

    stream: str
    standing: StreamState


class _Remembered(NamedTuple):
    """What a detector remembered when it had processed everything before an index."""

    at_ns: int
    detector: str
    stream: str
    end_index: int
    memory: DetectorMemory


class _Caused(NamedTuple):
    """There was a further cause for a file that is being written."""

    kind: Kind
    words: str


_Happened: TypeAlias = "SampleBlock | Diagnosis | AlarmEvent | _Read | _Stands | _Remembered | _Caused"


class _Item(NamedTuple):
    """Something that has happened, as the event loop saw it."""

    at_ns: int
    what: _Happened


@dataclass(frozen=True, slots=True)
class _Again:
    """That a file goes on which was over.

    Attributes:
        kind: why it was written till then.
        until_ns: its end till then.
        causes: when they came for which it goes on, and what they are; the newest.
    """

    kind: Kind
    until_ns: int
    causes: deque[tuple[int, _Caused]] = field(default_factory=lambda: deque(maxlen=MOST_CAUSES))


@dataclass(slots=True)
class _Open:
    """A file that is being written.

    Attributes:
        kind: why; of several causes the weightiest.
        cause_ns: when there was cause to begin it.
        begin_ns: its begin.
        until_ns: its end, as it looks now.
        machine: the machine file that was in force.
        about: its first message.
        waiting: what is to be written to it.
        causes: how many there are so far.
        came_bytes: the samples among that, but for those that the history had.
        asked: who waits for it.
        writing: what a thread is writing now; its file, if that is complete then.
        writer: its file; None before that is open.
        last: what was handed out last of what the history had.
        written_ns: until when the disk has taken all of it.
        again: that it was over once; None if it never was.
    """

    kind: Kind
    cause_ns: int
    begin_ns: int
    until_ns: int
    machine: MachineFile
    about: SnapshotAbout
    waiting: list[_Item]
    causes: int = 1
    came_bytes: int = 0
    _held: int = field(init=False)
    asked: list[asyncio.Future[Path]] = field(default_factory=list)
    writing: asyncio.Future[Path | None] | None = None
    writer: SnapshotWriter | None = None
    last: _Item | None = None
    written_ns: int = 0
    again: _Again | None = None

    def __post_init__(self) -> None:
        self._held = len(self.waiting)

    def take_in(self, item: _Item, size_bytes: int) -> bool:
        """Have it hold something that has just come; whether there is room."""
        too_many_samples = size_bytes and self.came_bytes + size_bytes > MOST_WAITING_BYTES
        if too_many_samples or len(self.waiting) >= MOST_WAITING + self._held:
            return False
        self.waiting.append(item)
        self.came_bytes += size_bytes
        return True

    def hand_out(self, end: int | None = None) -> list[_Item]:
        """What waits, as far as an end; nothing waits then."""
        taken, self.waiting = self.waiting[:end], []
        self.came_bytes = self._held = 0
        # Causes, and what detectors remembered, are in no history: nothing would be found behind them.
        happened = (item for item in reversed(taken) if not isinstance(item.what, _Caused | _Remembered))
        self.last = next(happened, self.last)
        return taken

    def go_on(self, missed: list[_Item], until_ns: int) -> None:
        """Have it last longer when it was over; what it has missed meanwhile is in the history anyway."""
        self.again = _Again(self.kind, self.until_ns)
        self.waiting, self.until_ns, self._held = missed, until_ns, len(missed)

    def answer(self, outcome: Path | SnapshotRefusedError) -> None:
        """Tell those who wait for it what has come of it."""
        for one in self.asked:
            if one.done():
                continue
            if isinstance(outcome, SnapshotRefusedError):
                one.set_exception(outcome)
            else:
                one.set_result(outcome)
        self.asked.clear()


@dataclass(slots=True)
class _Kept:
    """The states before the oldest item of the history.

    Attributes:
        alarms: by alarm, its newest event.
        standings: by stream.
        health: what detectors have against their sensors.
        streams: those of which samples have been forgotten.
        since_begin: whether nothing has been forgotten yet.
    """

    alarms: dict[str, AlarmEvent] = field(default_factory=dict)
    standings: dict[str, StreamState] = field(default_factory=dict)
    health: SensorHealth = field(default_factory=SensorHealth)
    streams: set[str] = field(default_factory=set)
    since_begin: bool = True


class MachineRecorder:
    """Records one machine. All methods belong to the event loop.

    Args:
        machine: the machine file.
        settings: its table ``[recorder]``.
        store: directory of the machine's part of the store.
        clock: the service's clock.
        supervisor: of the machine; gets each kind of trouble once.
        is_judging: whether a detector has samples that it has not evaluated yet.

    Attributes:
        counters: what it has done.
        folder: where the snapshots are; for the thread that writes.
        is_writing: whether a thread writes what has come.
    """

    def __init__(
        self,
        machine: MachineFile,
        settings: RecorderTable,
        store: Path,
        clock: Clock,
        supervisor: Supervisor,
        is_judging: Callable[[], bool] = lambda: False,
    ) -> None:
        self.counters = RecorderCounters()
        self._is_judging = is_judging
        self.folder = SnapshotFolder(store, settings.max_mb, settings.keep_days, settings.reserve_mb)
        self.is_writing = False
        self._machine = machine
        self._identity = Identity(machine.site, machine.box, machine.machine.name)
        self._settings = settings
        self._store = store
        self._clock = clock
        self._supervisor = supervisor
        self._before_ns = round(settings.before_s * NS_PER_S)
        self._after_ns = round(settings.after_s * NS_PER_S)
        # A cause and the next one fit into one, however short they are to be.
        least_ns = self._before_ns + 2 * self._after_ns
        self._longest_ns = max(round(settings.longest_s * NS_PER_S), least_ns)
        self._history: deque[_Item] = deque()
        self._kept = _Kept()
        self._trimmed_ns = 0
        self._changed_ns: int | None = None
        """When the machine file came into force, if another one was before."""
        self._open: _Open | None = None
        """The snapshot that further causes make longer."""
        self._ending: list[_Open] = []
        """Snapshots that are as long as they may be, and wait for detectors."""
        self._lingering: list[_Open] = []
        """Snapshots that are over but not closed: what reaches back into the newest one goes on in it."""
        self._continuous: _Open | None = None
        """The file of the continuous recording."""
        self._finishing: list[_Open] = []
        """Files that get nothing more, and are being closed."""
        self._is_over = False
        self._continuous_from_ns = 0
        self._steps: dict[tuple[str, str], SpeedSteps] = {}
        """By detector and the name of its statistic: shafts of one machine may turn at several speeds."""
        self._speeds = {} if settings.every_rpm is None else speed_signals(machine)
        self._unswept_bytes = 0
        self._due_ns: int | None = None
        self._is_well = True
        self._memories: dict[str, deque[_Remembered]] = {}
        """Of each detector, the newest last; its thread adds to them."""
        self._memories_kept = 3 + self._before_ns // MEMORY_EVERY_NS
        self._memory_wanted_ns = 0
        """What was remembered earlier is too old, however young it is."""

    def change_machine(self, machine: MachineFile) -> None:
        """Go on by a machine file in which nothing but alarms and setpoints is different.

        A file holds one machine file: those that are being written end now.
        """
        now_ns = self._clock.monotonic_ns()
        self._machine, self._changed_ns = machine, now_ns
        before, self._open = self._open, None
        if before is not None and before.until_ns > now_ns:
            self._open = self._begun(before.kind, "other limits", now_ns - self._before_ns, before.until_ns)
            self._open.asked, before.asked = before.asked, []
        if before is not None:
            self._ending.append(before)
        for one in self._lingering:
            one.last = None  # nothing goes on in it
        for one in (*self._ending, *([self._continuous] if self._continuous else [])):
            one.until_ns = min(one.until_ns, now_ns)

    def take_over(self, events: Iterable[AlarmEvent]) -> None:
        """Take in the states of alarms from before the recorder was made."""
        now_ns = self._clock.monotonic_ns()
        for event in events:
            self._kept.alarms.setdefault(event.alarm, event)
            self._kept.health.resume(event.doubts, now_ns, event.finding)

    def processed(self, detector: Detector, window: Window) -> None:
        """A detector has processed a window; on the thread that it computes in."""
        now_ns = self._clock.monotonic_ns()
        memories = self._memories.get(detector.name)
        last_ns = memories[-1].at_ns if memories else -MEMORY_EVERY_NS
        if now_ns - last_ns < MEMORY_EVERY_NS and last_ns >= self._memory_wanted_ns:
            return
        try:
            memory = taken_memory(detector)
        except MemoryNotTakenError:
            self.counters.memories_not_taken += 1
            return
        end_index = window.first_index + len(window.samples)
        newest = _Remembered(now_ns, detector.name, detector.stream, end_index, memory)
        if memories is None:
            # Whoever finds it finds something in it: that is another thread.
            self._memories[detector.name] = deque([newest], maxlen=self._memories_kept)
            return
        memories.append(newest)
        while len(memories) > 1 and sum(one.memory.nbytes for one in memories) > MOST_MEMORY_BYTES:
            memories.popleft()

    def block(self, block: SampleBlock) -> None:
        """Samples have come, of a stream or of a grid."""
        self._note(block, block.samples.nbytes)

    def stand(self, stream: str, standing: StreamState) -> None:
        """A stream stands otherwise."""
        self._note(_Stands(stream, standing))

    def read(self, detector: str, window: Window) -> None:
        """Samples were handed to a detector."""
        entry: SnapshotWindow = {
            "detector": detector,
            "first_index": window.first_index,
            "count": len(window.samples),
            "skipped": window.skipped,
            "snapshot": window.snapshot,
            "breaks": list(window.breaks),
        }
        self._note(_Read(detector, entry))

    def diagnosis(self, diagnosis: Diagnosis) -> None:
        """A detector has made a statement."""
        self._note(diagnosis)
        for name in self._speeds.get(diagnosis.detector, ()):
            if diagnosis.units.get(name) == RPM:
                self._see_speed(diagnosis.detector, name, diagnosis.statistics.get(name, math.nan))

    def alarm(self, event: AlarmEvent) -> None:
        """An alarm has changed: one that calls for a person is a cause."""
        self._note(event)
        if event.kind in ANNUNCIATIONS and not is_condition(event):
            self._cause("alarm", f"{event.alarm}: {event.kind.value}")

    async def snapshot(self, reason: str) -> Path:
        """Make a snapshot now; returns when it is complete.

        Args:
            reason: who has asked, in words.

        Raises:
            SnapshotRefusedError: it was not made.
        """
        if self._is_over:
            raise SnapshotRefusedError(ENDS)
        if sum(len(one.asked) for one in (*self._written(), *self._finishing)) >= MOST_ASKED:
            raise SnapshotRefusedError(f"{MOST_ASKED} others wait for a snapshot already; ask again later")
        asked: asyncio.Future[Path] = asyncio.get_running_loop().create_future()
        self._cause("asked", reason).asked.append(asked)
        return await asked

    async def run(self) -> None:
        """Write what there is cause to write, until cancelled."""
        self._is_over = False
        try:
            while True:
                await self._clock.sleep_ns(TURN_NS)
                self.is_writing = True
                await self._turn()
                self.is_writing = False
        finally:
            self.is_writing = False
            await self._end()

    def figures(self) -> dict[str, int]:
        """What it has done, and how much waits for the disk."""
        written = self._written()
        return {
            **asdict(self.counters),
            "snapshots_deleted": self.folder.deleted,
            "recording": int(bool(written)),
            "waiting_bytes": sum(one.came_bytes for one in written),
        }

    def _note(self, what: _Happened, size_bytes: int = 0) -> None:
        item = _Item(self._clock.monotonic_ns(), what)
        self._history.append(item)
        if item.at_ns - self._trimmed_ns >= TURN_NS:
            # Here, for what writes may wait for the disk.
            self._trim(item.at_ns)
        for one in self._written():
            if not one.take_in(item, size_bytes):
                self.counters.blocks_dropped += 1

    def _written(self) -> list[_Open]:
        """The files that get what happens."""
        return [*self._ending, *(one for one in (self._open, self._continuous) if one is not None)]

    def _see_speed(self, detector: str, name: str, speed_rpm: float) -> None:
        every_rpm = self._settings.every_rpm
        if every_rpm is not None:
            steps = self._steps.setdefault((detector, name), SpeedSteps(every_rpm))
            if steps.is_new(speed_rpm):
                self._cause("speed", f"{detector}: speed {speed_rpm:.4g} rpm")

    def _cause(self, kind: Kind, words: str) -> _Open:
        """Begin a snapshot, or let the one that is open, or has just ended, last longer."""
        now_ns = self._clock.monotonic_ns()
        until_ns = now_ns + self._after_ns
        one = self._open
        if one is not None and not self._has_room(one, until_ns):
            one.until_ns = min(one.until_ns, now_ns)
            self._ending.append(one)
            one = self._open = None
        if one is None:
            one = self._open = self._overlapped(now_ns - self._before_ns, until_ns)
        if one is None:
            one = self._open = self._begun(kind, words, now_ns - self._before_ns, until_ns)
            return one
        one.until_ns = max(one.until_ns, until_ns)
        self._add_cause(one, kind, words)
        return one

    def _schedule(self, due_ns: int, now_ns: int) -> None:
        """Begin a snapshot; one that is open does not last longer for it, as nothing has happened.

        It reaches back from when it was due, not from the turn after: so it joins the one before.
        """
        if self._open is not None and self._open.until_ns <= now_ns:
            # It is over, and may wait for detectors: the next one is not to fail for that.
            self._ending.append(self._open)
            self._open = None
        if self._open is not None:
            self._add_cause(self._open, "scheduled", SCHEDULED)
        else:
            begin_ns, until_ns = due_ns - self._before_ns, now_ns + self._after_ns
            self._open = self._begun("scheduled", SCHEDULED, begin_ns, until_ns)

    def _add_cause(self, one: _Open, kind: Kind, words: str) -> None:
        one.kind = _weightiest(kind, one.kind)
        now_ns, cause = self._clock.monotonic_ns(), _Caused(kind, words)
        if one.again is not None:
            one.again.causes.append((now_ns, cause))
        if one.causes < MOST_CAUSES:
            one.causes += 1
            one.take_in(_Item(now_ns, cause), 0)

    def _has_room(self, one: _Open, until_ns: int) -> bool:
        return until_ns <= one.cause_ns - self._before_ns + self._longest_ns

    def _overlapped(self, begin_ns: int, until_ns: int) -> _Open | None:
        """The snapshot that has just ended, if another one would begin with something that it has.

        It goes on then, with all that has happened since.
        """
        if not self._lingering:
            return None
        one = self._lingering[-1]
        history = list(self._history)
        end = next((k + 1 for k in reversed(range(len(history))) if history[k] is one.last), 0)
        first, _ = self._begin(history, begin_ns)
        if first >= end or not self._has_room(one, until_ns) or self._is_too_large(one, SNAPSHOT_SHARE):
            return None
        self._lingering.remove(one)
        one.go_on(history[end:], until_ns)
        return one

    def _is_near(self, one: _Open, now_ns: int) -> bool:
        """Whether a further cause may still have a snapshot go on that has ended."""
        if one.last is None or self._open is not None:
            return False
        return now_ns - one.last.at_ns <= self._before_ns + MEMORY_EVERY_NS + SPARE_NS

    def _begun(self, kind: Kind, words: str, begin_ns: int, until_ns: int) -> _Open:
        """A file that reaches back to a time, or a little further."""
        now_ns = self._clock.monotonic_ns()
        history = list(self._history)
        first, memories = self._begin(history, begin_ns)
        return self._made(kind, words, history, first, memories, (now_ns, until_ns))

    def _made(
        self,
        kind: Kind,
        words: str,
        history: Sequence[_Item],
        first: int,
        memories: Sequence[_Remembered],
        cause_until_ns: tuple[int, int],
    ) -> _Open:
        """A file that begins with an item of the history."""
        cause_ns, until_ns = cause_until_ns
        begin_ns = history[first].at_ns if first < len(history) else self._clock.monotonic_ns()
        about = self._about(history[:first], begin_ns, memories, words)
        waiting = [*(_Item(begin_ns, one) for one in memories), *history[first:]]
        return _Open(kind, cause_ns, begin_ns, until_ns, self._machine, about, waiting)

    def _begin(self, history: Sequence[_Item], begin_ns: int) -> tuple[int, list[_Remembered]]:
        """Where a snapshot begins that reaches back to a time, and what detectors remembered there.

        It begins as much earlier as the last moment at which they were asked; or, where the first samples of
        a stream are still there, with these: whoever judges them remembers nothing then.
        """
        if self._kept.since_begin:
            return 0, []
        firsts = [next((k for k, one in enumerate(history) if one.at_ns >= begin_ns), len(history))]
        known = set(self._kept.streams)
        for number, item in enumerate(history):
            if isinstance(item.what, SampleBlock) and item.what.stream not in known:
                known.add(item.what.stream)
                firsts.append(number)
        chosen: list[_Remembered] = []
        for memories in [*self._memories.values()]:
            there = [one for one in [*memories] if one.at_ns <= begin_ns]
            first = _first_after(history, there[-1]) if there else None
            if first is not None:
                firsts.append(first)
                chosen.append(there[-1])
        return min(firsts), chosen

    def _trim(self, now_ns: int) -> None:
        """Forget what no snapshot would begin with any more, but for the states of alarms and streams."""
        self._trimmed_ns = now_ns
        oldest_ns = now_ns - self._before_ns - MEMORY_EVERY_NS - SPARE_NS
        if self._continuous is not None and self._continuous.waiting:
            # The next file may begin with that, unless a disk hangs.
            oldest_ns = min(oldest_ns, max(self._continuous.waiting[0].at_ns, oldest_ns - 2 * HOLD_NS))
        history, kept = self._history, self._kept
        while history and history[0].at_ns < oldest_ns:
            item = history.popleft()
            what = item.what
            kept.since_begin = False
            if isinstance(what, AlarmEvent):
                kept.alarms[what.alarm] = what
            elif isinstance(what, _Stands):
                kept.standings[what.stream] = what.standing
            elif isinstance(what, Diagnosis):
                kept.health.update(what, item.at_ns)
            elif isinstance(what, SampleBlock):
                kept.streams.add(what.stream)

    async def _turn(self) -> None:
        now_ns = self._clock.monotonic_ns()
        self._trim(now_ns)
        every_s = self._settings.every_s
        if every_s is not None and (self._due_ns is None or now_ns >= self._due_ns):
            if self._due_ns is not None:
                self._schedule(self._due_ns, now_ns)
            self._due_ns = now_ns + round(every_s * NS_PER_S)
        for snapshot in [one for one in self._lingering if not self._is_near(one, now_ns)]:
            self._lingering.remove(snapshot)
            await self._write_on(snapshot, [], is_over=True)
        for snapshot in [*self._ending, *([self._open] if self._open else [])]:
            late_ns = now_ns - snapshot.until_ns
            is_over = late_ns >= 0 and (late_ns >= PATIENCE_NS or not self._is_judging())
            items = snapshot.hand_out()
            if is_over and snapshot is self._open:
                # What is a cause while it is being closed begins another one.
                self._open = None
                if not snapshot.asked and snapshot.last is not None:
                    # Who has asked waits for the whole file; this one is not waited for.
                    self._lingering.append(snapshot)
                    is_over = False
            elif is_over:
                self._ending.remove(snapshot)
            elif self._is_too_large(snapshot, SNAPSHOT_SHARE):
                snapshot.until_ns = min(snapshot.until_ns, now_ns)
            await self._write_on(snapshot, items, is_over=is_over)
        if self._settings.continuous:
            await self._continue(self._clock.monotonic_ns())

    async def _continue(self, now_ns: int) -> None:
        """Write on what is recorded continuously, and begin the next file in time."""
        one, length_ns = self._continuous, round(self._settings.continuous_s * NS_PER_S)
        if one is None:
            if now_ns < self._continuous_from_ns:
                return
            one = self._continuous = self._begun("continuous", "continuous", now_ns, now_ns + length_ns)
        if self._is_too_large(one, CONTINUOUS_SHARE):
            one.until_ns = min(one.until_ns, now_ns)
        if now_ns < one.until_ns:
            await self._write_on(one, one.hand_out(), is_over=False)
            return
        self._memory_wanted_ns = one.until_ns
        if (next_begin := self._next_begin(one, now_ns)) is None:
            return
        end, memories = next_begin
        history = list(self._history)
        begin = one.waiting[end] if end < len(one.waiting) else None
        first = next((k for k, item in enumerate(history) if item is begin), len(history))
        if begin is not None and first == len(history):
            # A disk has hung for so long that the history has it no more.
            end, memories = len(one.waiting), []
        times = history[first].at_ns if first < len(history) else now_ns, now_ns + length_ns
        following = self._made("continuous", "continuous", history, first, memories, times)
        self._continuous = following
        await self._write_on(one, one.hand_out(end), is_over=True)

    def _next_begin(self, one: _Open, now_ns: int) -> tuple[int, list[_Remembered]] | None:
        """With which of the items that wait the next file begins, and what detectors remember there.

        It begins where each detector goes on with samples that it has not judged, so that no sample need be
        in both files. None while it is worth waiting for that.
        """
        firsts: list[int] = []
        chosen: list[_Remembered] = []
        is_complete = True
        for memories in [*self._memories.values()]:
            newest = memories[-1]
            first = _first_after(one.waiting, newest)
            # Nothing has come for it since: then it remembers what it did, however long ago that was.
            is_silent = first == len(one.waiting)
            if first is None or not (is_silent or newest.at_ns >= one.until_ns):
                is_complete = False
            else:
                firsts.append(first)
                chosen.append(newest)
        if not is_complete and now_ns - one.until_ns < HOLD_NS:
            return None
        return min(firsts, default=len(one.waiting)), chosen

    def _is_too_large(self, one: _Open, share: float) -> bool:
        return one.writer is not None and one.writer.size > share * self.folder.most_bytes

    async def _write_on(self, snapshot: _Open, items: list[_Item], *, is_over: bool) -> None:
        if is_over:
            self._finishing.append(snapshot)
        handed_ns = self._clock.monotonic_ns()
        # A thread goes on when it is not waited for any more: the end of the service must know of it.
        snapshot.writing = asyncio.ensure_future(
            asyncio.to_thread(self._write, snapshot, items, is_over=is_over)
        )
        try:
            path = await asyncio.shield(snapshot.writing)
        except (OSError, ValueError) as error:
            snapshot.writing = None
            await self._give_up(snapshot, error)
            return
        snapshot.writing, snapshot.written_ns = None, handed_ns
        if path is None:
            return
        self._finishing.remove(snapshot)
        self.counters.snapshots += 1
        if not self._is_well:
            self._is_well = True
            notice(log, "snapshots of %s are written again", self._identity.machine)
        snapshot.answer(path)

    async def _give_up(self, snapshot: _Open, error: Exception) -> None:
        """The disk takes no more of a snapshot: what it has got stays, and the service goes on.

        What had been over before it went on is not to be lost by that, nor is the cause for which it did.
        """
        self.counters.write_failures += 1
        if snapshot is self._continuous:
            self._continuous = None
            self._continuous_from_ns = self._clock.monotonic_ns() + AGAIN_NS
        if snapshot is self._open:
            self._open = None
        for those in (self._ending, self._lingering, self._finishing):
            if snapshot in those:
                those.remove(snapshot)
        is_begun = self._begin_again(snapshot)
        path = await self._finished_anyway(snapshot)
        if path is None:
            self.counters.snapshots_failed += 1
        else:
            self.counters.snapshots += 1
        outcome = "lost" if path is None else "ended" + (", and another one begun" if is_begun else "")
        if self._is_well:
            self._is_well = False
            log.error(
                "a snapshot of %s is %s: %s",
                self._identity.machine,
                outcome,
                _in_words(error),
                extra=coded(SNAPSHOT_LOST),
            )
        snapshot.answer(path or SnapshotLostError(f"the snapshot is lost: {_in_words(error)}"))
        if path is None and snapshot.writer is not None:
            with contextlib.suppress(OSError):
                await asyncio.to_thread(snapshot.writer.abandon)

    def _begin_again(self, snapshot: _Open) -> bool:
        """Begin another file for causes of which one that went on has not all; whether there are any."""
        again = snapshot.again
        if again is None or snapshot.machine is not self._machine:
            # Where other limits came into force, another one has begun anyway.
            return False
        whole_ns = snapshot.written_ns - self._after_ns
        missed = [one for one in again.causes if one[0] > whole_ns]
        if not missed:
            return False
        whole = (cause.kind for at_ns, cause in again.causes if at_ns <= whole_ns)
        snapshot.kind = _weightiest(again.kind, *whole)
        (at_ns, first), *later = missed
        # What is older may not be in the history any more; it is in the file that ends.
        oldest_ns = self._clock.monotonic_ns() - 2 * TURN_NS
        begin_ns = max(at_ns, oldest_ns) - self._before_ns
        one = self._begun(first.kind, first.words, begin_ns, snapshot.until_ns)
        one.cause_ns, one.causes = at_ns, len(missed)
        one.kind = _weightiest(*(cause.kind for _, cause in missed))
        one.waiting = sorted([*one.waiting, *(_Item(*cause) for cause in later)], key=lambda item: item.at_ns)
        one.asked, snapshot.asked = snapshot.asked, []
        if self._open is None:
            self._open = one
        else:
            self._ending.append(one)
        return True

    async def _finished_anyway(self, snapshot: _Open) -> Path | None:
        """Close a file that the disk has refused, if all is in it for which it was written at first."""
        again = snapshot.again
        if snapshot.writer is None or again is None or snapshot.written_ns < again.until_ns:
            return None
        self._finishing.append(snapshot)
        snapshot.writing = writing = asyncio.ensure_future(asyncio.to_thread(self._finish_anyway, snapshot))
        path = None
        with contextlib.suppress(OSError, ValueError):
            path = await asyncio.shield(writing)
        snapshot.writing = None
        self._finishing.remove(snapshot)
        return path

    async def _end(self) -> None:
        """No more is written: bring what is under way to its end, if the disk is quick."""
        self._is_over = True
        ending = [*self._finishing, *self._lingering, *self._written()]
        self._open = self._continuous = None
        self._ending.clear()
        self._lingering.clear()
        self._finishing.clear()
        await asyncio.gather(*(self._end_of(one) for one in ending))

    async def _end_of(self, snapshot: _Open) -> None:
        path = None
        try:
            with contextlib.suppress(OSError, ValueError, TimeoutError):
                async with asyncio.timeout(END_S):
                    # One thread writes to a file at a time; what it has been given already comes first.
                    path = None if snapshot.writing is None else await asyncio.shield(snapshot.writing)
                    if path is None:
                        items = snapshot.hand_out()
                        path = await asyncio.to_thread(self._write, snapshot, items, is_over=True)
                    self.counters.snapshots += 1
        finally:
            snapshot.answer(path or SnapshotRefusedError(ENDS))

    def _about(
        self, before: Sequence[_Item], begin_ns: int, memories: Iterable[_Remembered], cause: str
    ) -> SnapshotAbout:
        """The first message of a snapshot: of which machine it is, and the states when it began."""
        wall_ns = self._clock.wall_ns() - self._clock.monotonic_ns()
        alarms, standings = dict(self._kept.alarms), dict(self._kept.standings)
        known = self._kept.streams | {one.what.stream for one in before if isinstance(one.what, SampleBlock)}
        streams, health = dict(stream_facts(self._machine)), copy.deepcopy(self._kept.health)
        for item in before:
            if isinstance(item.what, AlarmEvent):
                alarms[item.what.alarm] = item.what
            elif isinstance(item.what, _Stands):
                standings[item.what.stream] = item.what.standing
            elif isinstance(item.what, Diagnosis):
                health.update(item.what, item.at_ns)
        return {
            "schema": SCHEMA,
            "version": __version__,
            "site": self._identity.site,
            "box": self._identity.box,
            "machine": self._identity.machine,
            "begin_ns": begin_ns,
            "begin": iso_utc(begin_ns + wall_ns),
            "wall_ns_at_0": wall_ns,
            "from_start": self._kept.since_begin and not before,
            "streams_from_start": [name for name in streams if name not in known],
            "changed_ns": self._changed_ns,
            "remembered": {one.detector: one.end_index for one in memories},
            "streams": streams,
            "faults": fault_names(self._machine),
            "standings": {name: one._asdict() for name, one in standings.items()},
            "alarms": [alarm_document(event) for event in alarms.values()],
            "lacking": {name: one._asdict() for name, one in health.lacking().items()},
            "causes": [cause],
        }

    def _write(self, snapshot: _Open, items: Iterable[_Item], *, is_over: bool) -> Path | None:
        """Write what has happened, and the end of the file if it is over; blocks.

        Returns:
            The file, if that is complete.

        Raises:
            OSError: the disk does not take it.
        """
        if snapshot.writer is None:
            snapshot.writer = self._open_file(snapshot)
        self._put(snapshot.writer, items)
        return self._finish(snapshot) if is_over else None

    def _open_file(self, snapshot: _Open) -> SnapshotWriter:
        """Make the file; blocks.

        Raises:
            OSError: it cannot be made.
        """
        files = self._files(snapshot.machine)
        writer = self.folder.new(snapshot.kind, snapshot.cause_ns, snapshot.about, files)
        self._make_room({writer.path.name})
        return writer

    def _files(self, machine: MachineFile) -> dict[str, bytes]:
        """What a replay needs beside samples: the machine file, and files that detectors use; blocks."""
        values = machine_values(machine)
        files = {MACHINE_JSON: json.dumps(values, indent=1).encode()}
        if machine.text:
            files[MACHINE_TOML] = machine.text.encode()
        files |= {f"{FILES}{path}": data for path, data in files_named(values, machine.path.parent).items()}
        for key, _, _ in configured(machine.pipeline):
            with contextlib.suppress(OSError):
                files[f"{STORE}{key}.toml"] = (self._store / f"{key}.toml").read_bytes()
        return files

    def _put(self, writer: SnapshotWriter, items: Iterable[_Item]) -> None:
        """Write what has happened; blocks.

        Raises:
            OSError: the disk does not take it.
        """
        if not items:
            return
        self.folder.see_space()
        before = writer.size
        writer.write(self._entry(item) for item in items)
        self.counters.bytes_written += writer.size - before
        self._unswept_bytes += writer.size - before
        if self._unswept_bytes > ROOM_SHARE * self.folder.most_bytes:
            self._make_room({writer.path.name})

    def _finish(self, snapshot: _Open) -> Path:
        """Close the file, and give it the name of its cause; blocks.

        Raises:
            OSError: the disk does not take it.
        """
        assert snapshot.writer is not None  # noqa: S101 - for the type checker
        path = self.folder.finish(snapshot.writer, snapshot.kind)
        self._make_room({path.name})
        return path

    def _finish_anyway(self, snapshot: _Open) -> Path | None:
        """Close a file after an error, as far as it was written; blocks.

        Raises:
            OSError: the disk does not take the end either.
        """
        assert snapshot.writer is not None  # noqa: S101 - for the type checker
        return self.folder.finish_what_was_taken(snapshot.writer, snapshot.kind)

    def _make_room(self, spared: set[str]) -> None:
        """Delete what is too old or too much, but for what is being written; blocks."""
        self._unswept_bytes = 0
        others = [*self._written(), *self._lingering, *self._finishing]
        spared |= {one.writer.path.name for one in others if one.writer is not None}
        self.folder.make_room(self._clock.wall_ns(), spared)

    def _entry(self, item: _Item) -> Entry:
        """An item as it is written."""
        if isinstance(item.what, SampleBlock):
            return Entry(item.at_ns, item.what)
        match item.what:
            case Diagnosis() as diagnosis:
                noted = Noted(DIAGNOSES, statement_document(diagnosis))
            case AlarmEvent() as event:
                noted = Noted(ALARMS, alarm_document(event))
            case _Read() as read:
                noted = Noted(WINDOWS, {**read.window})
            case _Remembered() as one:
                remembered = one.memory.document()
                state: SnapshotState = {
                    "detector": one.detector,
                    "end_index": one.end_index,
                    "tree": remembered["tree"],
                    "arrays": remembered["arrays"],
                }
                noted = Noted(STATES, {**state})
            case _Stands(stream, (doubt, proven, silent)):
                stands: SnapshotStanding = {
                    "stream": stream,
                    "doubt": doubt,
                    "proven": proven,
                    "silent": silent,
                }
                noted = Noted(STANDING, {**stands})
            case _Caused(kind, words):
                cause: SnapshotCause = {"kind": kind, "cause": words}
                noted = Noted(CAUSES, {**cause})
        return Entry(item.at_ns, noted)


def _first_after(history: Sequence[_Item], memory: _Remembered) -> int | None:
    """Where the samples begin that a detector goes on with; None if some of them are forgotten."""
    for number, item in enumerate(history):
        block = item.what
        if isinstance(block, SampleBlock) and block.stream == memory.stream:
            if block.first_index - block.gap > memory.end_index:
                return None
            if block.end_index > memory.end_index:
                return number
    return len(history)


def _weightiest(*kinds: Kind) -> Kind:
    """Of several causes the one by which a file is called."""
    return min(kinds, key=get_args(Kind).index)


def _in_words(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'the disk'}: {error.strerror}"
    return f"{error}"
