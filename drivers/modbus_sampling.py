"""Samples with a count of their own, from a queue or a ring, without loss or repeat; and who reads what."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from drivers.modbus_layouts import FUNCTIONS, Fifo, Ring, Trend, shared_runs
from drivers.modbus_reading import PollingReader, RowAssembler
from drivers.modbus_trend import TrendReader
from drivers.modbus_waveform import WaveformReader
from drivers.registers import Run

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.acquisition.assembler import StreamCounters
    from daqsvc.acquisition.timebase import TimeBaseState
    from drivers.base import BusPort, StreamSpec
    from drivers.modbus_line import ModbusLine
    from drivers.modbus_outcomes import ModbusCounters
    from drivers.modbus_reading import Reader

LARGEST_DRIFT = 0.05

CountedT = TypeVar("CountedT", Fifo, Ring)


class _CountedReader(PollingReader, Generic[CountedT]):
    """A reader of samples that the device counts."""

    def __init__(self, spec: StreamSpec[CountedT], port: BusPort) -> None:
        super().__init__([spec.name], port.clock)
        self._name = spec.name
        self._layout: CountedT = spec.layout
        self._rows = RowAssembler(spec, port.clock, port.deliver, spec.layout.count.bits)

    @property
    def streams(self) -> Mapping[str, tuple[StreamCounters, TimeBaseState]]:
        """See `Reader.streams`."""
        return {self._name: (self._rows.counters, self._rows.time_base)}

    def flush(self) -> None:
        """See `Reader.flush`."""
        self._rows.flush()

    async def _pause_after_failure(self) -> None:
        await self._clock.sleep_ns(self._layout.poll_ns)


class FifoReader(_CountedReader[Fifo]):
    """Empties a queue. The count at its head tells what a lost reply took with it, or what comes twice."""

    def __init__(self, spec: StreamSpec[Fifo], port: BusPort) -> None:
        super().__init__(spec, port)
        self._unacknowledged: tuple[int, int] | None = None

    async def _look(self, line: ModbusLine) -> None:
        layout = self._layout
        raw = await line.read_fifo(layout.unit, layout.address)
        arrival_ns = self._clock.monotonic_ns()
        head = 2 * layout.count.run.count
        taken, left_over = divmod(max(len(raw) - head, 0), 2 * layout.record.registers)
        if left_over or 0 < len(raw) < head:
            self._rows.counters.frames_wrong_length += 1
            await self._clock.sleep_ns(layout.poll_ns)
            return
        if taken:
            first = layout.count.decode(raw)
            repeated = self._repeated(first, taken)
            counts = (first + np.arange(repeated, taken, dtype=np.int64)) % layout.count.modulus
            if len(counts):
                rows = raw[head + repeated * 2 * layout.record.registers :]
                self._rows.accept(layout.record, counts, rows, np.full(len(counts), arrival_ns, np.int64))
            if layout.acknowledge is not None:
                self._unacknowledged = first, taken
                told = layout.count.encode(first + taken)
                words = [int.from_bytes(told[k : k + 2], "big") for k in range(0, len(told), 2)]
                await line.write(layout.unit, layout.acknowledge, words)
                self._unacknowledged = None
        if taken < layout.samples_per_read:
            await self._clock.sleep_ns(layout.poll_ns)

    def _repeated(self, first: int, taken: int) -> int:
        """How many samples of a reply were in the one before, which the device does not know to be taken."""
        if self._unacknowledged is None or self._unacknowledged[0] != first:
            return 0
        repeated = min(self._unacknowledged[1], taken)
        self._rows.counters.frames_duplicate += repeated
        return repeated


class RingReader(_CountedReader[Ring]):
    """Follows the write counter of a ring.

    What was written between two looks at the counter is read, and the second look tells whether any of
    it may have been overwritten meanwhile. A request that fails is repeated at the next look: only what
    the device has overwritten is lost, and the counter says how much that is.
    """

    def __init__(self, spec: StreamSpec[Ring], port: BusPort, counters: ModbusCounters) -> None:
        super().__init__(spec, port)
        self._counters = counters
        self._rate_hz = spec.rate_hz
        self._next: int | None = None
        self._read_ns = 0
        self._seen: tuple[int, int] | None = None

    async def run(self, line: ModbusLine) -> None:
        """See `Reader.run`."""
        self._seen = None  # what was seen before the line was lost is old
        await super().run(line)

    async def _look(self, line: ModbusLine) -> None:
        modulus = self._layout.count.modulus
        written, seen_ns = self._seen or await self._count(line)
        self._seen = None
        start, due = self._due(written, seen_ns)
        if due:
            rows = b""
            for run in self._runs(start, due):
                rows += await line.read(self._layout.unit, FUNCTIONS[self._layout.table], run)
            self._seen = await self._count(line)
            overwritten = max((self._seen[0] - start) % modulus - (self._layout.depth - 1), 0)
            if overwritten > modulus // 2:  # the counter went back: what was read may be from before or after
                return
            if overwritten:
                self._counters.ring_overruns += 1
                overwritten = min(overwritten, due)
            counts = (start + np.arange(overwritten, due, dtype=np.int64)) % modulus
            if len(counts):
                sample_bytes = 2 * self._layout.record.registers
                fresh = rows[overwritten * sample_bytes :]
                arrivals_ns = np.full(len(counts), seen_ns, np.int64)
                self._rows.accept(self._layout.record, counts, fresh, arrivals_ns)
            if self._seen[0] != (start + due) % modulus and due >= self._layout.samples_per_read:
                self._next, self._read_ns = (start + due) % modulus, seen_ns
                return  # there is more already
            self._seen = None
        self._next, self._read_ns = (start + due) % modulus, seen_ns
        await self._clock.sleep_ns(self._layout.poll_ns)

    async def _count(self, line: ModbusLine) -> tuple[int, int]:
        """How many samples have been written, and by when at the latest."""
        raw = await line.read(self._layout.unit, FUNCTIONS[self._layout.table], self._layout.count.run)
        return self._layout.count.decode(raw), self._clock.monotonic_ns()

    def _due(self, written: int, now_ns: int) -> tuple[int, int]:
        """First sample to read, by its count, and how many."""
        modulus = self._layout.count.modulus
        whole = self._layout.depth - 1  # in the place that is left, the next sample is being written
        fresh = min(written, whole)
        if self._next is None:
            return written - fresh, fresh
        advance = (written - self._next) % modulus
        if advance <= whole:
            return self._next, advance
        expected = self._rate_hz * (now_ns - self._read_ns) / NS_PER_S
        off = (advance - expected + modulus / 2) % modulus - modulus / 2
        if abs(off) > self._layout.depth + LARGEST_DRIFT * expected:
            return written - fresh, fresh  # the device has restarted: the ring is older than the counter
        self._counters.ring_overruns += 1
        return (written - whole) % modulus, whole

    def _runs(self, start: int, due: int) -> list[Run]:
        """The requests for ``due`` samples from ``start`` on; the ring may end in between."""
        width, depth = self._layout.record.registers, self._layout.depth
        runs = []
        while due:
            place = start % depth
            count = min(due, depth - place, self._layout.samples_per_read)
            runs.append(Run(self._layout.address + place * width, count * width))
            start, due = start + count, due - count
        return runs


def readers_for(port: BusPort, counters: ModbusCounters) -> list[Reader]:
    """A reader for each stream, by the way its device hands out samples; one for all that share requests."""
    readers: list[Reader] = []
    polled: dict[tuple[int, str, float], list[StreamSpec[Any]]] = {}
    for spec in port.streams:
        layout = spec.layout
        if isinstance(layout, Trend):
            polled.setdefault((layout.unit, layout.table, spec.rate_hz), []).append(spec)
        elif isinstance(layout, Fifo):
            readers.append(FifoReader(spec, port))
        elif isinstance(layout, Ring):
            readers.append(RingReader(spec, port, counters))
        else:
            readers.append(WaveformReader(spec, port, counters))
    for specs in polled.values():
        if (runs := shared_runs([spec.layout for spec in specs])) is not None:
            readers.append(TrendReader(specs, port, runs))
        else:
            readers += [TrendReader([spec], port) for spec in specs]
    return readers
