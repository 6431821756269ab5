"""Present values polled on a schedule: streams whose registers lie together share requests."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from drivers.modbus_layouts import FUNCTIONS
from drivers.modbus_outcomes import NoReplyError, RefusedError
from drivers.modbus_reading import PollingReader, RowAssembler

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daqsvc.acquisition.assembler import StreamCounters
    from daqsvc.acquisition.samples import SampleBlock
    from daqsvc.acquisition.timebase import TimeBaseState
    from drivers.base import BusPort, StreamSpec
    from drivers.modbus_layouts import Trend
    from drivers.modbus_line import ModbusLine
    from drivers.registers import Run

logger = logging.getLogger(__name__)

BATCH_NS = 20_000_000
BATCH_POLLS = 64
WORTH_A_BATCH_NS = 5_000_000
"""A pause of the poll schedule in which what has been read is handed on."""

EARLY_NS = 500_000
"""How early a poll may be: no event loop sleeps for less than a millisecond."""

LATE_NS = 2_000_000
"""How late it may be: no event loop wakes up to the millisecond, and what is overdue is soon asked for."""

REFUSALS_OF_REGISTERS = frozenset({2, 3})
"""Exceptions by which a unit says that it has not these registers, or not so many at once."""


class _Reply(NamedTuple):
    """Registers, and when they were there."""

    registers: bytes
    arrival_ns: int


class _TrendStream:
    """One stream of those that are polled together: its samples until a batch of them is handed on."""

    def __init__(self, spec: StreamSpec[Trend], port: BusPort) -> None:
        self.name = spec.name
        self.own_runs = spec.layout.record.runs
        self._record = spec.layout.record
        self._port = port
        self._places: tuple[int, ...] = ()
        self._assembler = RowAssembler(spec, port.clock, self._deliver, counter_bits=32)
        self._lateness_ns = 0.0
        self._slots: list[int] = []
        self._arrivals_ns: list[int] = []
        self._rows: list[bytes] = []

    @property
    def state(self) -> tuple[StreamCounters, TimeBaseState]:
        """Counters and clock; what is told of the clock's error is that of a single sample's time, too."""
        time_base = self._assembler.time_base
        return self._assembler.counters, time_base._replace(error_ns=time_base.error_ns + time_base.jitter_ns)

    def places_in(self, runs: Sequence[Run]) -> tuple[int, ...]:
        """Places of those runs that its quantities lie in."""
        wanted = [field.run for field in self._record.fields]
        return tuple(
            place
            for place, run in enumerate(runs)
            if any(run.address <= one.address and one.end <= run.end for one in wanted)
        )

    def take_from(self, runs: Sequence[Run], places: Sequence[int]) -> None:
        """Say which runs are read from now on, and which of them are for this stream."""
        self.hand_on()
        self._places = tuple(places)
        self._record = replace(self._record, runs=tuple(runs[place] for place in places))

    def take(self, slot: int, replies: Sequence[_Reply | None]) -> None:
        """Take the sample of a slot, from the reply to each run; without one of its own it is lost."""
        row = b""
        arrival_ns = 0
        for place in self._places:
            reply = replies[place]
            if reply is None:
                return
            row += reply.registers
            arrival_ns = reply.arrival_ns
        self._slots.append(slot)
        self._arrivals_ns.append(arrival_ns)
        self._rows.append(row)
        if len(self._slots) >= BATCH_POLLS or arrival_ns - self._arrivals_ns[0] > BATCH_NS:
            self.hand_on()

    def hand_on(self) -> None:
        """Hand on what has been read."""
        if self._slots:
            slots = np.array(self._slots, np.int64) % 2**32
            arrivals_ns = np.array(self._arrivals_ns, np.int64)
            rows = b"".join(self._rows)
            self._slots, self._arrivals_ns, self._rows = [], [], []
            self._lateness_ns = self._assembler.time_base.jitter_ns
            self._assembler.accept(self._record, slots, rows, arrivals_ns)

    def flush(self) -> None:
        """Hand over what is held back."""
        self.hand_on()
        self._assembler.flush()

    def _deliver(self, block: SampleBlock) -> None:
        # The time base knows the schedule better than any poll keeps it: a value is as late as its poll.
        self._port.deliver(replace(block, t_error_ns=block.t_error_ns + self._lateness_ns))


class TrendReader(PollingReader):
    """Polls registers on a schedule; a sample's count is its place in the schedule.

    A poll that fails, or whose time passes while another request holds the line, is a lost sample of every
    stream that has registers in it, and of no other.

    Args:
        specs: streams of one unit, table and rate.
        port: of the bus.
        runs: what is read for all of them together; None to read each stream's own.
    """

    def __init__(
        self, specs: Sequence[StreamSpec[Trend]], port: BusPort, runs: Sequence[Run] | None = None
    ) -> None:
        super().__init__([spec.name for spec in specs], port.clock)
        self._unit = specs[0].layout.unit
        self._function = FUNCTIONS[specs[0].layout.table]
        self._period_ns = NS_PER_S / specs[0].rate_hz
        self._start_ns: int | None = None
        self._done = -1
        self._streams = [_TrendStream(spec, port) for spec in specs]
        if runs is None:
            self._read_apart()
        else:
            self._read_from(runs, {stream: stream.places_in(runs) for stream in self._streams})

    @property
    def streams(self) -> Mapping[str, tuple[StreamCounters, TimeBaseState]]:
        """See `Reader.streams`."""
        return {stream.name: stream.state for stream in self._streams}

    def flush(self) -> None:
        """See `Reader.flush`."""
        for stream in self._streams:
            stream.flush()

    async def _look(self, line: ModbusLine) -> None:
        slot = await self._wait_for_slot()
        replies: list[_Reply | None] = []
        lost: frozenset[_TrendStream] = frozenset()
        failure: tuple[NoReplyError | RefusedError, Run, frozenset[_TrendStream]] | None = None
        for run, takers in self._plan:
            reply = None
            if not takers <= lost:  # else nobody's sample can be whole any more
                try:
                    registers = await line.read(self._unit, self._function, run)
                except (NoReplyError, RefusedError) as error:
                    failure = error, run, takers
                    lost |= takers
                else:
                    reply = _Reply(registers, self._clock.monotonic_ns())
            replies.append(reply)
        for stream in self._streams:
            stream.take(slot, replies)
        if failure is not None:
            self._fail(*failure)

    def _fail(self, error: NoReplyError | RefusedError, run: Run, takers: frozenset[_TrendStream]) -> None:
        """Read the streams apart if the unit has not all that they share; else tell the failure as it is."""
        if not isinstance(error, RefusedError):
            raise error
        told = RefusedError(f"{error} (registers {run.address} to {run.end - 1})", error.code)
        if error.code not in REFUSALS_OF_REGISTERS or len(takers) == 1:
            raise told from error
        logger.warning(
            "%s: %s; each stream is polled by itself from now on, and from the start with a smaller max_gap "
            "or forbidden",
            self._who,
            told,
        )
        self._read_apart()

    async def _pause_after_failure(self) -> None:
        """The schedule itself is the pause."""

    def _read_apart(self) -> None:
        runs: list[Run] = []
        places = {}
        for stream in self._streams:
            places[stream] = range(len(runs), len(runs) + len(stream.own_runs))
            runs += stream.own_runs
        self._read_from(runs, places)

    def _read_from(self, runs: Sequence[Run], places: Mapping[_TrendStream, Sequence[int]]) -> None:
        for stream in self._streams:
            stream.take_from(runs, places[stream])
        self._plan = [
            (run, frozenset(stream for stream in self._streams if place in places[stream]))
            for place, run in enumerate(runs)
        ]

    async def _wait_for_slot(self) -> int:
        """Wait for the next place in the schedule that has not passed for good."""
        now_ns = self._clock.monotonic_ns()
        if self._start_ns is None:
            self._start_ns = now_ns
        slot = max(self._done + 1, -int((self._start_ns + LATE_NS - now_ns) // self._period_ns))
        wait_ns = self._start_ns + round(slot * self._period_ns) - now_ns
        if wait_ns > WORTH_A_BATCH_NS:
            for stream in self._streams:
                stream.hand_on()
        if wait_ns > EARLY_NS:
            await self._clock.sleep_ns(wait_ns)
        self._done = slot
        return slot
