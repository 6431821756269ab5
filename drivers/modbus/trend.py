"""Present values polled on a schedule: streams whose registers lie together share requests.

The schedule is ours, and so is the clock: a sample was taken between the moment its request went out and the
moment its reply was there. Nothing need be estimated, and a poll that had to wait for the line is still a
sample, of its own true time.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.acquisition.assembler import StreamCounters, note_gap, note_received
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.samples import Quality, SampleBlock
from daqsvc.acquisition.timebase import RECENT_DELAYS, TimeBaseState
from daqsvc.errors.buses import REGISTER_REFUSED, SAMPLES_MISSING
from daqsvc.errors.code import coded
from daqsvc.rounding import readable
from drivers.modbus.line import NS_PER_MS
from drivers.modbus.reading import PollingReader, streams_in_words
from drivers.modbus.refusals import ILLEGAL_VALUE, REFUSALS_OF_REGISTERS, RefusalSearch
from drivers.modbus.registers import (
    RegisterRecord,
    RegisterRun,
    RunLimits,
    inseparable,
    plan_runs,
    run_of,
    shared_runs,
)
from drivers.modbus.replies import FUNCTIONS, REMEDIES, NoReplyError, RequestRefusedError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daqsvc.acquisition.samples import Samples
    from drivers.base import BusPort, StreamSpec
    from drivers.modbus.line import ModbusLine, RegisterValues
    from drivers.modbus.settings import RegistersLayout

logger = logging.getLogger(__name__)

BATCH_NS = 20_000_000
BATCH_POLLS = 64
WORTH_A_BATCH_NS = 5_000_000
"""A pause of the poll schedule in which what has been read is handed on."""

EARLY_NS = 500_000
"""How early a poll may be: no event loop sleeps for less than a millisecond."""

LATE_NS = 2_000_000
"""How late one may be at least: no event loop wakes up to the millisecond; what is overdue is soon asked."""

SLOW_POLLS, ROOM = 3, 0.9
"""Polls in a row by which a schedule is known as too fast, and the part of the time that is to be used."""

APART_NS = 60 * NS_PER_S
APART_MOST_NS = 3600 * NS_PER_S
"""How long streams are read apart before they are tried together again; twice as long each time."""


class _Failure(NamedTuple):
    """A request that failed: why, for what, and whose samples it costs."""

    error: NoReplyError | RequestRefusedError
    run: RegisterRun
    takers: frozenset[_TrendStream]

    @property
    def of_merging(self) -> bool:
        """Whether the unit may have all registers that are wanted, and not all that lies between them."""
        refused = isinstance(self.error, RequestRefusedError) and self.error.code in REFUSALS_OF_REGISTERS
        return refused and (self.of_sharing or any(self.run not in one.bare_runs for one in self.takers))

    @property
    def is_of_length(self) -> bool:
        """Whether the unit may have all registers, and answer for fewer of them at once."""
        return isinstance(self.error, RequestRefusedError) and self.error.code == ILLEGAL_VALUE

    @property
    def of_sharing(self) -> bool:
        """Whether several streams have registers in the request."""
        return len(self.takers) > 1

    @property
    def of_registers(self) -> bool:
        """Whether one stream's own registers are refused: some of them may be there all the same."""
        refused = isinstance(self.error, RequestRefusedError) and self.error.code in REFUSALS_OF_REGISTERS
        return refused and not self.of_merging

    @property
    def in_words(self) -> NoReplyError | RequestRefusedError:
        """The error, with the registers that are refused; the line reports units that are silent."""
        if not isinstance(self.error, RequestRefusedError):
            return self.error
        return RequestRefusedError(f"{self.error} ({self.run.in_words})", self.error.code)


class _Row(NamedTuple):
    """The registers of a sample, its place in the schedule, and between when and when it was taken."""

    slot: int
    registers: bytes
    from_ns: int
    to_ns: int


class _TrendStream:
    """One stream of those that are polled together: its samples until a batch of them is handed on.

    A sample is placed midway between request and reply, which bound its error. Those of one block are as far
    from even steps as its polls were from the schedule: that is in the block's error, too.
    """

    def __init__(self, spec: StreamSpec[RegistersLayout], port: BusPort) -> None:
        self.name = spec.name
        self.counters = StreamCounters()
        self._channels = spec.layout.channels
        self.channels = len(self._channels)
        self.layout = spec.layout
        self._record = RegisterRecord.of(spec.layout)
        self.own_runs = self._record.runs
        self._bare = replace(RunLimits.of(spec.layout), max_gap=0)
        self._columns: list[int] = []
        self.absent: dict[str, RegisterRun] = {}
        """Registers, by channel, that the unit does not have; the values of these channels are NaN."""
        self.bare_runs: tuple[RegisterRun, ...] = ()
        """As `own_runs`, but without any register that is not needed, nor those of `absent`."""
        self._deliver = port.deliver
        self._period_ns = NS_PER_S / spec.rate_hz
        self._places: tuple[int, ...] = ()
        self._rows: list[_Row] = []
        self._start_ns = 0
        self._next: int | None = None
        self._lateness_ns: deque[float] = deque(maxlen=RECENT_DELAYS)
        self._error_ns = np.inf
        self._left_out = 0
        self.leave_out({})

    @property
    def time_base(self) -> TimeBaseState:
        """How well the schedule is kept, and how far off the time of the last sample may be."""
        late_ns = float(np.percentile(self._lateness_ns, 95)) if self._lateness_ns else 0.0
        return TimeBaseState(self._period_ns, 0.0, late_ns, self._next is not None, 0, self._error_ns)

    def read_at_most(self, count: int) -> bool:
        """Read no more registers by one request from the next `read_from` on; whether that is less.

        Those of one channel stay together.
        """
        widest = max(run.count for run in inseparable(map(run_of, self._channels)))
        max_count = max(count, widest)
        if max_count >= self.layout.max_count:
            return False
        self.layout = self.layout.model_copy(update={"max_count": max_count})
        self.own_runs = RegisterRecord.of(self.layout).runs
        self._bare = replace(RunLimits.of(self.layout), max_gap=0)
        self.leave_out(self.absent)
        return True

    def leave_out(self, absent: Mapping[str, RegisterRun]) -> None:
        """Read all channels but these from the next `read_from` on; one at least is left."""
        self.flush()
        self.absent = dict(absent)
        self._columns = [k for k, one in enumerate(self._channels) if one.name not in absent]
        self.bare_runs = plan_runs((run_of(self._channels[k]) for k in self._columns), self._bare)

    def channels_in(self, run: RegisterRun) -> dict[str, RegisterRun]:
        """Registers by channel of those that lie in a run."""
        own = {one.name: run_of(one) for one in self._channels if one.name not in self.absent}
        return {name: one for name, one in own.items() if run.address <= one.address and one.end <= run.end}

    def places_in(self, runs: Sequence[RegisterRun]) -> tuple[int, ...]:
        """Places of those runs that its quantities lie in."""
        wanted = [run_of(channel) for channel in self._record.channels]
        return tuple(
            place
            for place, run in enumerate(runs)
            if any(run.address <= one.address and one.end <= run.end for one in wanted)
        )

    def read_from(self, runs: Sequence[RegisterRun], places: Sequence[int]) -> None:
        """State which runs are read from now on, and which of them are for this stream."""
        self.flush()
        self._places = tuple(places)
        channels = tuple(self._channels[k] for k in self._columns)
        self._record = RegisterRecord(channels, tuple(runs[place] for place in places))

    def append(self, slot: int, start_ns: int, readings: Sequence[RegisterValues | None]) -> None:
        """Take the sample of a slot, from what each run holds; without one of its own it is lost.

        Args:
            slot: its place in the schedule.
            start_ns: when the schedule began, host monotonic.
            readings: of each run; None if there is none.
        """
        own = [reading for place in self._places if (reading := readings[place]) is not None]
        if len(own) < len(self._places):
            return
        self._start_ns = start_ns
        registers = b"".join(reading.registers for reading in own)
        row = _Row(slot, registers, own[0].asked_ns, own[-1].answered_ns)
        self._rows.append(row)
        if len(self._rows) >= BATCH_POLLS or row.to_ns - self._rows[0].to_ns > BATCH_NS:
            self.flush()

    def flush(self) -> None:
        """Hand on what has been read."""
        if not self._rows:
            return
        slots, registers, asked_ns, answered_ns = zip(*self._rows, strict=True)
        self._rows = []
        raw = np.frombuffer(b"".join(registers), np.uint8).reshape(len(slots), -1)
        samples = np.ascontiguousarray(self._record.decode(raw))
        slot = np.array(slots, np.int64)
        due_ns = self._start_ns + np.rint(slot * self._period_ns).astype(np.int64)
        from_ns, to_ns = np.array(asked_ns) - due_ns, np.array(answered_ns) - due_ns
        self._lateness_ns.extend(from_ns.tolist())
        gaps = (np.flatnonzero(np.diff(slot) != 1) + 1).tolist()
        for begin, end in pairwise([0, *gaps, len(slots)]):
            part = slice(begin, end)
            earliest_ns, latest_ns = int(from_ns[part].min()), int(to_ns[part].max())
            t_first_ns = int(due_ns[begin]) + (earliest_ns + latest_ns) // 2
            self._hand_on(slots[begin], samples[part], t_first_ns, (latest_ns - earliest_ns) / 2)

    def _hand_on(self, first: int, samples: Samples, t_first_ns: int, error_ns: float) -> None:
        lost = 0 if self._next is None else first - self._next
        self._next, self._error_ns = first + len(samples), error_ns
        self.counters.frames_received += len(samples)
        samples = note_received(self.counters, self.name, samples, left_out=self._left_out)
        samples = self._with_absent(samples)
        if lost:
            note_gap(self.counters, self.name, lost, first)
        quality = Quality.AFTER_LOSS if lost else Quality.GOOD
        self._deliver(
            SampleBlock(self.name, first, samples, t_first_ns, self._period_ns, lost, quality, error_ns)
        )

    def _with_absent(self, samples: Samples) -> Samples:
        """Samples of all channels, those that are left out NaN, and counted."""
        if not self.absent:
            return samples
        whole = np.full((len(samples), len(self._channels)), np.nan, np.float32)
        whole[:, self._columns] = samples
        count = len(samples) * len(self.absent)
        self._left_out += count
        self.counters.values_absent += count
        return whole


class TrendReader(PollingReader):
    """Polls registers on a schedule, which begins with the first sample; its count is its place in that.

    A poll that fails is a lost sample of every stream that has registers in it, and of no other. And so is
    one whose request could not go out before the next was due, because others held the line. Registers that
    the unit does not have cost their own channels only: each channel is asked for by itself, once, and what
    is refused is then left out.

    Args:
        specs: streams of one unit, table and rate.
        port: of the bus.
        runs: what is read for all of them together; None to read each stream's own.
    """

    def __init__(
        self,
        specs: Sequence[StreamSpec[RegistersLayout]],
        port: BusPort,
        runs: Sequence[RegisterRun] | None = None,
    ) -> None:
        super().__init__([spec.name for spec in specs], port.clock)
        self._unit = specs[0].layout.unit
        self._function = FUNCTIONS[specs[0].layout.table]
        self._period_ns = NS_PER_S / specs[0].rate_hz
        self._late_ns = max(self._period_ns, LATE_NS)
        self._start_ns = 0
        self._done = -1
        self._begun = False
        self._failures: Sequence[_Failure] = ()
        """Those of the last poll, which cost streams their samples."""
        self._streams = [_TrendStream(spec, port) for spec in specs]
        self._shared = runs
        self._bare: set[_TrendStream] = set()
        """Streams of which nothing is read but their own registers."""
        self._apart_ns = APART_NS
        self._absent_before: set[tuple[str, str]] = set()
        """Streams and channels that were left out when all were tried together last."""
        self._search_again_ns: dict[RegisterRun, int] = {}
        """When the channels of a request may be asked for one by one again, where that did not help."""
        self._asked: set[str] = set()
        """What has been asked for since the plan was another."""
        self._slow_polls = 0
        """Polls in a row that took longer than there is time for one."""
        self._slowness_logged = False
        self._together_at_ns: int | None = None
        """When what is read apart now is tried together again."""
        self._read_together()

    @property
    def streams(self) -> Mapping[str, tuple[StreamCounters, TimeBaseState]]:
        """See `Reader.streams`."""
        return {stream.name: (stream.counters, stream.time_base) for stream in self._streams}

    def flush(self) -> None:
        """See `Reader.flush`."""
        for stream in self._streams:
            stream.flush()

    async def _look(self, line: ModbusLine) -> None:
        slot = await self._wait_for_slot(line)
        now_ns = self._clock.monotonic_ns()
        if self._together_at_ns is not None and now_ns >= self._together_at_ns:
            self._read_together()
        readings, failures = await self._ask(line)
        asks_for_less = False
        while await self._ask_for_less(line, failures):
            asks_for_less = True
            readings, failures = await self._ask(line)
        self._watch_pace(now_ns, undisturbed=not (failures or asks_for_less))
        self._done = slot  # not if the line was lost meanwhile: then it is due as soon as there is one again
        if asks_for_less:
            self._together_at_ns = self._clock.monotonic_ns() + self._apart_ns
            self._apart_ns = min(2 * self._apart_ns, APART_MOST_NS)
        self._forget(line)
        self._append(slot, readings)
        self._failures = failures
        if failures:
            raise failures[-1].in_words

    def _watch_pace(self, begun_ns: int, *, undisturbed: bool) -> None:
        """State once that polls take longer than there is time for them."""
        took_ns = self._clock.monotonic_ns() - begun_ns
        self._slow_polls = self._slow_polls + 1 if undisturbed and took_ns > self._late_ns else 0
        if self._slow_polls == SLOW_POLLS and not self._slowness_logged:
            self._slowness_logged = True
            logger.warning(
                "%s: a poll takes %s ms, and at rate_hz = %s there are %s ms for it, so samples are "
                "lost. Write rate_hz = %s or less, or have fewer requests on this line (max_gap, other "
                "streams)",
                self._who,
                readable(took_ns / NS_PER_MS, 3),
                readable(NS_PER_S / self._period_ns),
                readable(self._period_ns / NS_PER_MS, 3),
                readable(ROOM * NS_PER_S / took_ns, 2),
                extra=coded(SAMPLES_MISSING),
            )

    async def run(self, line: ModbusLine) -> None:
        """See `Reader.run`: over a new line, all is tried together again at once."""
        self._apart_ns = APART_NS
        self._search_again_ns.clear()
        self._read_together()
        await super().run(line)

    async def _ask_for_less(self, line: ModbusLine, failures: Sequence[_Failure]) -> bool:
        """Ask differently where that may help; whether it is worth asking again at once."""
        differently = False
        for failure in failures:
            if failure.is_of_length and await self._read_shorter(line, failure):
                differently = True
            elif failure.of_merging:
                self._part(failure)
                differently = True
            elif failure.of_registers:
                differently = await self._leave_out(line, failure) or differently
        return differently

    def _forget(self, line: ModbusLine) -> None:
        """Have the line forget what is asked for no more: it would seem to be answered for ever."""
        planned = {what for _, what, _ in self._plan}
        for what in self._asked - planned:
            line.forget(self._unit, self._function, what)
        self._asked = planned

    async def _ask(self, line: ModbusLine) -> tuple[list[RegisterValues | None], list[_Failure]]:
        """Read all runs; the failures that cost streams their sample, one a stream at most."""
        readings: list[RegisterValues | None] = []
        lost: frozenset[_TrendStream] = frozenset()
        failures: list[_Failure] = []
        for run, what, takers in self._plan:
            reading = None
            if not takers <= lost:  # else no stream's sample can be whole any more
                self._asked.add(what)
                try:
                    reading = await line.poll(self._unit, self._function, run, what)
                except (NoReplyError, RequestRefusedError) as error:
                    failures.append(_Failure(error, run, takers))
                    lost |= takers
            readings.append(reading)
        return readings, failures

    def _append(self, slot: int, readings: Sequence[RegisterValues | None]) -> None:
        """Hand the sample to the streams; its place in the schedule is that of its request."""
        asked_ns = next((reading.asked_ns for reading in readings if reading is not None), None)
        if asked_ns is None:
            return
        if self._begun:
            self._done = max(slot, self._oldest_slot(asked_ns))
        else:
            self._begun, self._start_ns, self._done = True, asked_ns, 0
        for stream in self._streams:
            stream.append(self._done, self._start_ns, readings)

    def _part(self, failure: _Failure) -> None:
        """Ask for less at once: the unit has not all that lies between. Sooner or later try again."""
        what = "each stream is polled by itself"
        if not failure.of_sharing:
            self._bare |= failure.takers
            what = "the registers between those of the channels are left out"
        self._read_apart()
        if (message := f"{failure.error} ({failure.run.in_words})") not in self._logged:
            self._logged.add(message)
            logger.warning(
                "%s: %s; from now on %s, and the whole request is tried only now and then. A smaller "
                "max_gap, or forbidden, avoids it from the start",
                streams_in_words(sorted(stream.name for stream in failure.takers)),
                message,
                what,
                extra=coded(REGISTER_REFUSED),
            )

    async def _leave_out(self, line: ModbusLine, failure: _Failure) -> bool:
        """Find the channels whose registers the unit does not have; whether others are left to read."""
        (stream,) = failure.takers
        now_ns = self._clock.monotonic_ns()
        if now_ns < self._search_again_ns.get(failure.run, 0):
            return False
        asked = stream.channels_in(failure.run)
        search = self._search(line)
        refused, are_all_asked = (asked, True) if len(asked) == 1 else await search.refused_alone(asked)
        absent = {**stream.absent, **refused}
        if not refused and are_all_asked and await self._read_shorter(line, failure):
            return True
        if not refused or len(absent) == stream.channels:
            if are_all_asked:
                self._search_again_ns[failure.run] = now_ns + APART_MOST_NS
            return False
        if {(stream.name, name) for name in refused} - self._absent_before:
            self._apart_ns = APART_NS  # it may be short, however long others are away
        stream.leave_out(absent)
        self._bare.add(stream)
        self._read_apart()
        for name, run in refused.items():
            refusal = f"{failure.error} ({run.in_words}): channel {name!r}"
            if (message := f"stream {stream.name!r}: {refusal}") not in self._logged:
                self._logged.add(message)
                logger.warning(
                    "%s has no value, and is asked for again only now and then; %s",
                    message,
                    REMEDIES[2],
                    extra=coded(REGISTER_REFUSED),
                )
        return True

    async def _read_shorter(self, line: ModbusLine, failure: _Failure) -> bool:
        """Find out how many registers the unit answers at once, and read no more by one request."""
        if self._clock.monotonic_ns() < self._search_again_ns.get(failure.run, 0):
            return False
        assert isinstance(failure.error, RequestRefusedError)  # noqa: S101 - for the type checker
        wanted = [one for stream in failure.takers for one in stream.channels_in(failure.run).values()]
        most = await self._search(line).longest(failure.error.code, wanted)
        if most is None:
            return False
        shorter = [stream.read_at_most(most) for stream in self._streams]
        if not any(shorter):
            return False
        if self._shared is not None:
            self._shared = shared_runs([stream.layout for stream in self._streams])
        self._read_together()
        if (message := f"{failure.error} ({failure.run.in_words})") not in self._logged:
            self._logged.add(message)
            logger.warning(
                "%s: %s; it answers for %d at once, and is asked for no more by one request from now on. "
                "max_count = %d avoids the refusal",
                streams_in_words(sorted(stream.name for stream in failure.takers)),
                message,
                most,
                most,
                extra=coded(REGISTER_REFUSED),
            )
        return True

    def _search(self, line: ModbusLine) -> RefusalSearch:
        return RefusalSearch(line, self._unit, self._function, self._asked)

    def _faults_of(self, error: NoReplyError | RequestRefusedError) -> dict[str, str]:
        del error  # the last one of these
        faults: dict[str, str] = {}
        for failure in self._failures:
            faults |= self._faults_by_stream(
                failure.in_words, sorted(stream.name for stream in failure.takers)
            )
        return faults

    async def _pause_after_failure(self) -> None:
        """The schedule itself is the pause."""

    def _read_together(self) -> None:
        """Read what all streams share, or what each may read at once."""
        self._together_at_ns = None
        self._bare.clear()
        self._absent_before = {(one.name, name) for one in self._streams for name in one.absent}
        for stream in self._streams:
            stream.leave_out({})
        if self._shared is None:
            self._read_apart()
        else:
            runs = self._shared
            self._read_from(runs, {stream: stream.places_in(runs) for stream in self._streams})

    def _read_apart(self) -> None:
        runs: list[RegisterRun] = []
        places = {}
        for stream in self._streams:
            own = stream.bare_runs if stream in self._bare else stream.own_runs
            places[stream] = range(len(runs), len(runs) + len(own))
            runs += own
        self._read_from(runs, places)

    def _read_from(self, runs: Sequence[RegisterRun], places: Mapping[_TrendStream, Sequence[int]]) -> None:
        for stream in self._streams:
            stream.read_from(runs, places[stream])
        self._plan = [
            (run, run.in_words, frozenset(stream for stream in self._streams if place in places[stream]))
            for place, run in enumerate(runs)
        ]

    async def _wait_for_slot(self, line: ModbusLine) -> int:
        """Wait for the next place in the schedule that has not passed for good."""
        now_ns = self._clock.monotonic_ns()
        if self._done < 0:
            self._start_ns = now_ns
        slot = max(self._done + 1, self._oldest_slot(now_ns))
        due_ns = self._due_ns(slot)
        line.expect(self, due_ns)
        wait_ns = due_ns - now_ns
        if wait_ns > WORTH_A_BATCH_NS:
            self.flush()
        if wait_ns > EARLY_NS:
            await self._clock.sleep_ns(wait_ns)
        return slot

    def _oldest_slot(self, now_ns: int) -> int:
        """The first place in the schedule that has not passed for good: the next but one is not due yet."""
        return -int((self._start_ns + self._late_ns - now_ns) // self._period_ns)

    def _due_ns(self, slot: int) -> int:
        return self._start_ns + round(slot * self._period_ns)
