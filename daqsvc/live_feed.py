"""What happens at a machine, for viewers: samples, statements, alarms. Nothing is made without viewers.

A viewer gets lines of JSON. The first one is `LiveFeed.about`. Each further one has one key:
``samples`` (of a stream, base64 of float32), ``statement``, ``alarm``, ``standing``, ``left_out``: how many
samples and other things were left out since the last line, as they were not taken fast enough. Or ``alive``,
where nothing else has passed for a while.
"""

from __future__ import annotations

import asyncio
import base64
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, NotRequired, TypeAlias, TypedDict

import numpy as np
from pydantic_core import to_json

from daqsvc import __version__
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.samples import SampleBlock
from daqsvc.acquisition.standing import StreamState
from daqsvc.alarms.events import AlarmEvent
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.machine_facts import StreamFacts, fault_names, machine_values, stream_facts
from daqsvc.publish.payloads import alarm_document, statement_document

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.ring import SampleRing
    from daqsvc.settings.models import MachineFile

SCHEMA: Literal["daqsvc.live/1"] = "daqsvc.live/1"
ALIVE_S = 1.0
"""Time without other lines after which a line shows that the service is there."""
ALIVE = b'{"alive":true}\n'
GATHER_S = 0.05
"""What comes within this time is sent together."""
MOST_WAITING_BYTES = 4_000_000
"""Samples that wait for one who looks."""
MOST_WAITING = 2000
"""Items of every kind that wait for one who looks."""
BEFORE_S = 20.0
"""Time before the request whose samples are sent first, as far as the rings hold them."""


class LiveBegin(TypedDict):
    """The first line: whose machine it is, what comes of it, and its state.

    Attributes:
        folder: folder of the machine file; only for processes on the box.
        schema: what the lines are, and of which version.
        version: version of daqsvc.
        site: name of the site.
        box: name of the box.
        machine: name of the machine.
        begun_ns: when the service began to watch it so, by the monotonic clock of the box, ns.
        wall_ns_at_0: time by the wall clock at 0 of the monotonic clock, ns since the Unix epoch.
        streams: what is known of each stream and grid.
        values: what is in force of the machine file, but for outputs, store and recorder.
        faults: by detector and decision the fault that it means.
        statements: the last statement of each detector.
        alarms: the last event of each alarm.
        standings: how each stream stands.
    """

    folder: NotRequired[str]
    schema: Literal["daqsvc.live/1"]
    version: str
    site: str
    box: str
    machine: str
    begun_ns: int
    wall_ns_at_0: int
    streams: dict[str, StreamFacts]
    values: dict[str, Any]
    faults: dict[str, dict[str, str]]
    statements: list[Annotated[dict[str, Any], "statement"]]
    alarms: list[Annotated[dict[str, Any], "daqsvc.alarm/1"]]
    standings: dict[str, Annotated[dict[str, Any], StreamState]]


class LiveSamples(TypedDict):
    """Samples of a stream or a grid that go on from each other.

    Attributes:
        stream: name of the stream or the grid.
        first_index: number of the first sample.
        t_first_ns: its time by the monotonic clock of the box, ns.
        period_ns: time from sample to sample, ns.
        lost_before: samples that were lost right before.
        quality: 0 if the samples are good; else flags that are added up.
        shape: how many samples, and how many channels.
        values: the samples, of each all channels, as base64 of little-endian float32.
    """

    stream: str
    first_index: int
    t_first_ns: int
    period_ns: float
    lost_before: int
    quality: int
    shape: list[int]
    values: str


class LiveStanding(TypedDict):
    """A stream stands otherwise.

    Attributes:
        stream: its name.
        doubt: why nothing can be judged by its samples; empty if there is no evidence against them.
        proven: whether its rate seems to be the nominal one, or could not be found out in time.
        silent: whether the doubt is that nothing comes at all, since another doubt was active.
    """

    stream: str
    doubt: str
    proven: bool
    silent: bool


class LiveLine(TypedDict):
    """A further line: it has one of these keys.

    Attributes:
        samples: samples have come.
        statement: a detector has given a statement.
        alarm: an alarm has changed.
        standing: a stream stands otherwise.
        left_out: how many samples and other things were left out, as they were not taken in time.
        alive: nothing else has passed for a second.
    """

    samples: NotRequired[LiveSamples]
    statement: NotRequired[Annotated[dict[str, Any], "statement"]]
    alarm: NotRequired[Annotated[dict[str, Any], "daqsvc.alarm/1"]]
    standing: NotRequired[LiveStanding]
    left_out: NotRequired[int]
    alive: NotRequired[Literal[True]]


class _StreamStands(NamedTuple):
    stream: str
    standing: StreamState


_Happened: TypeAlias = "SampleBlock | Diagnosis | AlarmEvent | _StreamStands"


class Looker:
    """One who looks on.

    Args:
        about: makes the first line, on a thread.
        streams: those whose samples are wanted.
    """

    def __init__(self, about: Callable[[], LiveBegin], streams: Collection[str]) -> None:
        self.streams = frozenset(streams)
        self._about: Callable[[], LiveBegin] | None = about
        self._waiting: deque[_Happened] = deque()
        self._bytes = 0
        self._left_out = 0
        self._has_come = asyncio.Event()
        self._is_over = False

    def add(self, happened: _Happened) -> None:
        """Have it wait until it is released."""
        size = happened.samples.nbytes if isinstance(happened, SampleBlock) else 0
        if len(self._waiting) >= MOST_WAITING or self._bytes + size > MOST_WAITING_BYTES:
            self._left_out += len(happened.samples) if isinstance(happened, SampleBlock) else 1
        else:
            self._waiting.append(happened)
            self._bytes += size
        self._has_come.set()

    def end(self) -> None:
        """No more comes: the machine is watched otherwise from now on, or not at all."""
        self._is_over = True
        self._has_come.set()

    async def lines(self) -> bytes:
        """What has come since, as lines; waits for it, but not for long. Nothing at the end."""
        if self._about is None:
            try:
                async with asyncio.timeout(ALIVE_S):
                    await self._has_come.wait()
            except TimeoutError:
                return ALIVE
            if not self._is_over:
                await asyncio.sleep(GATHER_S)
        about, self._about = self._about, None
        items, self._waiting, self._bytes = self._waiting, deque(), 0
        left_out, self._left_out = self._left_out, 0
        self._has_come.clear()
        if self._is_over:
            self._has_come.set()
        return await asyncio.to_thread(_encoded, about, items, left_out)


class LiveFeed:
    """What passes of one machine, and those who look on.

    Args:
        machine: the machine file.
        clock: the service's clock.
    """

    def __init__(self, machine: MachineFile, clock: Clock) -> None:
        self.machine = machine
        self._clock = clock
        self._begun_ns = clock.monotonic_ns()
        self._lookers: set[Looker] = set()

    def about(
        self,
        statements: Iterable[Diagnosis],
        alarms: Iterable[AlarmEvent],
        standings: Mapping[str, StreamState],
        *,
        of_this_box: bool = True,
    ) -> LiveBegin:
        """Whose machine it is, what comes of it, and its state.

        Args:
            statements: the last statement of each detector.
            alarms: the last event of each alarm.
            standings: how each stream stands.
            of_this_box: whether who looks is, and can use the files that the machine file names.
        """
        machine = self.machine
        begin: LiveBegin = {
            "schema": SCHEMA,
            "version": __version__,
            "site": machine.site,
            "box": machine.box,
            "machine": machine.machine.name,
            "begun_ns": self._begun_ns,
            "wall_ns_at_0": self._clock.wall_ns() - self._clock.monotonic_ns(),
            "streams": dict(stream_facts(machine)),
            "values": machine_values(machine),
            "faults": fault_names(machine),
            "statements": [statement_document(one) for one in statements],
            "alarms": [alarm_document(one) for one in alarms],
            "standings": {name: one._asdict() for name, one in standings.items()},
        }
        return {"folder": f"{machine.path.parent.absolute()}", **begin} if of_this_box else begin

    def look(
        self,
        streams: Collection[str],
        statements: Iterable[Diagnosis],
        alarms: Iterable[AlarmEvent],
        standings: Mapping[str, StreamState],
        rings: Mapping[str, SampleRing],
        before_bytes: int | None = None,
    ) -> Looker:
        """Begin to look on.

        Args:
            streams: streams or grids whose samples are wanted.
            statements: see `about`.
            alarms: see `about`.
            standings: see `about`.
            rings: what has come recently, by stream and grid.
            before_bytes: samples of these that are sent first, at most, to who is elsewhere; None for
                a process of this box, which also receives where the machine file is.
        """
        # Copied here, and made into text on a thread: that takes its time of thousands of sensors.
        about = partial(
            self.about, [*statements], [*alarms], dict(standings), of_this_box=before_bytes is None
        )
        before_bytes = MOST_WAITING_BYTES // 2 if before_bytes is None else before_bytes
        looker = Looker(about, streams)
        wanted = sorted(looker.streams & rings.keys())
        for stream in wanted:
            if (before := _before(rings[stream], before_bytes // len(wanted))) is not None:
                looker.add(before)
        self._lookers.add(looker)
        return looker

    def leave(self, looker: Looker) -> None:
        """It looks no more."""
        self._lookers.discard(looker)

    def block(self, block: SampleBlock) -> None:
        """Samples have come, of a stream or a grid."""
        for looker in self._lookers:
            if block.stream in looker.streams:
                looker.add(block)

    def diagnosis(self, diagnosis: Diagnosis) -> None:
        """A detector has made a statement."""
        self._tell(diagnosis)

    def alarm(self, event: AlarmEvent) -> None:
        """An alarm has changed."""
        self._tell(event)

    def stand(self, stream: str, standing: StreamState) -> None:
        """A stream stands otherwise."""
        self._tell(_StreamStands(stream, standing))

    def end(self) -> None:
        """The machine is watched no more, or otherwise: who looks is to look again."""
        for looker in self._lookers:
            looker.end()
        self._lookers.clear()

    def _tell(self, happened: _Happened) -> None:
        for looker in self._lookers:
            looker.add(happened)


def _before(ring: SampleRing, most_bytes: int) -> SampleBlock | None:
    """What a ring holds of the last `BEFORE_S`, of the newest no more than so many bytes; None if nothing."""
    most = most_bytes // (4 * len(ring.channels))
    if not ring.started or not most:
        return None
    last = ring.end_index - 1
    count = min(round(BEFORE_S * NS_PER_S / ring.period_at(last)), last + 1 - ring.oldest_index, most)
    first = last + 1 - count
    return SampleBlock(ring.stream, first, ring.read(first, count), ring.time_of(first), ring.period_at(last))


def _encoded(about: Callable[[], LiveBegin] | None, items: Iterable[_Happened], left_out: int) -> bytes:
    """Lines of JSON; on a thread."""
    lines: list[LiveBegin | LiveLine] = [] if about is None else [about()]
    lines += _lines(items)
    if left_out:
        lines.append({"left_out": left_out})
    return b"".join(map(_line, lines))


def _lines(items: Iterable[_Happened]) -> Iterator[LiveLine]:
    """Each thing that has happened; blocks of a stream that go on from each other are one."""
    held: dict[str, list[SampleBlock]] = {}
    for item in items:
        if isinstance(item, SampleBlock):
            blocks = held.setdefault(item.stream, [])
            if blocks and not _goes_on(blocks[-1], item):
                yield _samples(blocks)
                blocks.clear()
            blocks.append(item)
        elif isinstance(item, Diagnosis):
            yield {"statement": statement_document(item)}
        elif isinstance(item, AlarmEvent):
            yield {"alarm": alarm_document(item)}
        else:
            doubt, proven, silent = item.standing
            yield {
                "standing": {"stream": item.stream, "doubt": doubt, "proven": proven, "silent": silent},
            }
    for blocks in held.values():
        if blocks:
            yield _samples(blocks)


def _goes_on(before: SampleBlock, block: SampleBlock) -> bool:
    return block.first_index == before.end_index and block.quality == before.quality


def _samples(blocks: list[SampleBlock]) -> LiveLine:
    """Blocks that go on from each other, with the time of the newest one's first sample counted back."""
    first, last = blocks[0], blocks[-1]
    rows = np.concatenate([block.samples for block in blocks]).astype("<f4")
    before = len(rows) - len(last.samples)
    return {
        "samples": {
            "stream": first.stream,
            "first_index": first.first_index,
            "t_first_ns": last.t_first_ns - round(before * last.period_ns),
            "period_ns": last.period_ns,
            "lost_before": first.lost_before,
            "quality": int(last.quality),
            "shape": list(rows.shape),
            "values": base64.b64encode(rows.tobytes()).decode(),
        }
    }


def _line(document: LiveBegin | LiveLine) -> bytes:
    # What JSON has no number for is null, as in all that the service publishes.
    return to_json(document, inf_nan_mode="null") + b"\n"
