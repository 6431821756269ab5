"""From requests to samples without loss or repeat: one reader for each way a device hands them out."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

import numpy as np

from daqsvc.acquisition.assembler import StreamAssembler, StreamCounters
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.samples import Quality, SampleBlock
from daqsvc.acquisition.timebase import TimeBaseState
from drivers.modbus_layouts import FUNCTIONS, Fifo, ModbusLayout, Ring, Trend, Waveform
from drivers.modbus_outcomes import LineLostError, NoReplyError, RefusedError
from drivers.registers import Run

if TYPE_CHECKING:
    from collections.abc import Callable

    from daqsvc.acquisition.clock import Clock
    from drivers.base import BusPort, StreamSpec
    from drivers.modbus_line import ModbusLine
    from drivers.modbus_outcomes import ModbusCounters

logger = logging.getLogger(__name__)

BATCH_NS = 20_000_000
BATCH_POLLS = 64
WORTH_A_BATCH_NS = 5_000_000
"""A pause of the poll schedule in which what has been read is handed on."""

EARLY_NS = 500_000
"""How early a poll may be: no event loop sleeps for less than a millisecond."""

LATE_NS = 2_000_000
"""How late it may be: no event loop wakes up to the millisecond, and what is overdue is soon asked for."""

LARGEST_DRIFT = 0.05
ID_MODULUS = 65_536

LayoutT = TypeVar("LayoutT", bound=ModbusLayout)


class Reader(Protocol):
    """Reads one stream."""

    async def run(self, line: ModbusLine) -> None:
        """Read until the line is lost; keeps its place for the next line."""
        ...

    def flush(self) -> None:
        """Hand over what is held back."""
        ...

    @property
    def state(self) -> tuple[StreamCounters, TimeBaseState]:
        """Counters and clock of the stream."""
        ...


class _Reader(ABC, Generic[LayoutT]):
    """What the readers have in common: going on after a request that failed."""

    def __init__(self, spec: StreamSpec[LayoutT], port: BusPort, counters: ModbusCounters) -> None:
        self._layout = spec.layout
        self._name = spec.name
        self._rate_hz = spec.rate_hz
        self._clock: Clock = port.clock
        self._counters = counters
        self._said = ""

    async def run(self, line: ModbusLine) -> None:
        """See `Reader.run`."""
        while True:
            try:
                await self._look(line)
            except LineLostError:
                return
            except (NoReplyError, RefusedError) as error:
                if isinstance(error, RefusedError) and f"{error}" != self._said:
                    self._said = f"{error}"
                    logger.warning(
                        "stream %r: %s; compare the register map of the device with the layout",
                        self._name,
                        error,
                    )
                await self._pause_after_failure()

    @abstractmethod
    async def _look(self, line: ModbusLine) -> None:
        """Read what there is, and wait until it is worth looking again."""

    @abstractmethod
    async def _pause_after_failure(self) -> None:
        """Wait until it is worth asking again."""


class _AssembledReader(_Reader[LayoutT]):
    """A reader whose samples carry a count, the device's or that of the schedule."""

    def __init__(
        self,
        spec: StreamSpec[LayoutT],
        port: BusPort,
        counters: ModbusCounters,
        counter_bits: int,
    ) -> None:
        super().__init__(spec, port, counters)
        self._assembler = StreamAssembler(
            spec.name,
            spec.rate_hz,
            counter_bits=counter_bits,
            samples_per_frame=1,
            counts_per_frame=1,
            deliver=port.deliver,
            reorder_window_ns=0,  # one request at a time: nothing overtakes anything
        )

    @property
    def state(self) -> tuple[StreamCounters, TimeBaseState]:
        """See `Reader.state`."""
        return self._assembler.counters, self._assembler.time_base

    def flush(self) -> None:
        """See `Reader.flush`."""
        self._assembler.flush()

    def _accept(self, counts: np.ndarray, rows: bytes, arrival_ns: np.ndarray) -> None:
        """Hand on samples: int64 counts and arrivals ``[n]``, and their registers side by side."""
        raw = np.frombuffer(rows, np.uint8).reshape(len(counts), -1)
        samples = self._layout.record.decode(raw)[:, None, :]
        self._assembler.accept(counts, samples, np.ones(len(counts), np.bool_), arrival_ns)
        self._assembler.tick(self._clock.monotonic_ns())


class TrendReader(_AssembledReader[Trend]):
    """Polls registers on a schedule; a sample's count is its place in the schedule.

    A poll that fails, or whose time passes while another request holds the line, is a lost sample.
    """

    def __init__(self, spec: StreamSpec[Trend], port: BusPort, counters: ModbusCounters) -> None:
        super().__init__(spec, port, counters, counter_bits=32)
        self._period_ns = NS_PER_S / spec.rate_hz
        self._start_ns: int | None = None
        self._done = -1
        self._slots: list[int] = []
        self._arrivals_ns: list[int] = []
        self._rows: list[bytes] = []

    def flush(self) -> None:
        """See `Reader.flush`."""
        self._hand_on()
        super().flush()

    async def _look(self, line: ModbusLine) -> None:
        slot = await self._wait_for_slot()
        row = b""
        for run in self._layout.record.runs:
            row += await line.read(self._layout.unit, FUNCTIONS[self._layout.table], run)
        self._slots.append(slot)
        self._arrivals_ns.append(self._clock.monotonic_ns())
        self._rows.append(row)
        if len(self._slots) >= BATCH_POLLS or self._arrivals_ns[-1] - self._arrivals_ns[0] > BATCH_NS:
            self._hand_on()

    async def _pause_after_failure(self) -> None:
        """The schedule itself is the pause."""

    async def _wait_for_slot(self) -> int:
        """Wait for the next place in the schedule that has not passed for good."""
        now_ns = self._clock.monotonic_ns()
        if self._start_ns is None:
            self._start_ns = now_ns
        slot = max(self._done + 1, -int((self._start_ns + LATE_NS - now_ns) // self._period_ns))
        wait_ns = self._start_ns + round(slot * self._period_ns) - now_ns
        if wait_ns > WORTH_A_BATCH_NS:
            self._hand_on()
        if wait_ns > EARLY_NS:
            await self._clock.sleep_ns(wait_ns)
        self._done = slot
        return slot

    def _hand_on(self) -> None:
        if self._slots:
            slots = np.array(self._slots, np.int64) % 2**32
            self._accept(slots, b"".join(self._rows), np.array(self._arrivals_ns, np.int64))
            self._slots, self._arrivals_ns, self._rows = [], [], []


class FifoReader(_AssembledReader[Fifo]):
    """Empties a queue. The count at its head tells what a lost reply took with it, or what comes twice."""

    def __init__(self, spec: StreamSpec[Fifo], port: BusPort, counters: ModbusCounters) -> None:
        super().__init__(spec, port, counters, counter_bits=spec.layout.count.bits)
        self._unacknowledged: tuple[int, int] | None = None

    async def _look(self, line: ModbusLine) -> None:
        layout = self._layout
        raw = await line.read_fifo(layout.unit, layout.address)
        arrival_ns = self._clock.monotonic_ns()
        head = 2 * layout.count.run.count
        taken, left_over = divmod(max(len(raw) - head, 0), 2 * layout.record.registers)
        if left_over or 0 < len(raw) < head:
            self._assembler.counters.frames_wrong_length += 1
            await self._clock.sleep_ns(layout.poll_ns)
            return
        if taken:
            first = layout.count.decode(raw)
            repeated = self._repeated(first, taken)
            counts = (first + np.arange(repeated, taken, dtype=np.int64)) % layout.count.modulus
            if len(counts):
                rows = raw[head + repeated * 2 * layout.record.registers :]
                self._accept(counts, rows, np.full(len(counts), arrival_ns, np.int64))
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
        self._assembler.counters.frames_duplicate += repeated
        return repeated

    async def _pause_after_failure(self) -> None:
        await self._clock.sleep_ns(self._layout.poll_ns)


class RingReader(_AssembledReader[Ring]):
    """Follows the write counter of a ring.

    What was written between two looks at the counter is read, and the second look tells whether any of
    it may have been overwritten meanwhile. A request that fails is repeated at the next look: only what
    the device has overwritten is lost, and the counter says how much that is.
    """

    def __init__(self, spec: StreamSpec[Ring], port: BusPort, counters: ModbusCounters) -> None:
        super().__init__(spec, port, counters, counter_bits=spec.layout.count.bits)
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
                self._accept(
                    counts, rows[overwritten * sample_bytes :], np.full(len(counts), seen_ns, np.int64)
                )
            if self._seen[0] != (start + due) % modulus and due >= self._layout.samples_per_read:
                self._next, self._read_ns = (start + due) % modulus, seen_ns
                return  # there is more already
            self._seen = None
        self._next, self._read_ns = (start + due) % modulus, seen_ns
        await self._clock.sleep_ns(self._layout.poll_ns)

    async def _pause_after_failure(self) -> None:
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


class WaveformReader(_Reader[Waveform]):
    """Fetches every block that the device takes.

    Blocks stand apart in time: the samples that nobody took in between are told as missing before the
    block, by the host clock; as lost are counted only those of blocks that the device took and that
    could not be read whole.
    """

    def __init__(self, spec: StreamSpec[Waveform], port: BusPort, counters: ModbusCounters) -> None:
        super().__init__(spec, port, counters)
        self._stream_counters = StreamCounters()
        self._period_ns = NS_PER_S / spec.rate_hz
        self._deliver: Callable[[SampleBlock], None] = port.deliver
        self._last_id: int | None = None
        self._end: tuple[int, int] | None = None
        self._lost_since = 0
        self._restarts = 0
        self._triggered_ns: int | None = None

    @property
    def state(self) -> tuple[StreamCounters, TimeBaseState]:
        """See `Reader.state`."""
        delivered = self._stream_counters.samples_received > 0
        return self._stream_counters, TimeBaseState(self._period_ns, 0.0, 0.0, delivered, self._restarts)

    def flush(self) -> None:
        """Nothing is ever held back."""

    async def _look(self, line: ModbusLine) -> None:
        await self._trigger(line)
        block_id = await self._id(line)
        if block_id in {0, self._last_id}:
            await self._clock.sleep_ns(self._layout.poll_ns)
            return
        seen_ns = self._clock.monotonic_ns()
        rows = b""
        page_shown: int | None = None
        for page, run in self._layout.runs:
            if self._layout.page is not None and page != page_shown:
                await line.write(self._layout.unit, self._layout.page.select, [page])
                page_shown = page
            rows += await line.read(self._layout.unit, FUNCTIONS[self._layout.table], run)
        self._stream_counters.frames_received += 1
        if await self._id(line) != block_id:
            self._counters.blocks_torn += 1
            self._lose_until(block_id)
            self._lose(1)
            return
        self._lose_until(block_id)
        self._triggered_ns = None
        self._hand_on(rows, seen_ns)

    async def _pause_after_failure(self) -> None:
        await self._clock.sleep_ns(self._layout.poll_ns)

    async def _trigger(self, line: ModbusLine) -> None:
        """Make the device take a block, unless it is at it."""
        trigger = self._layout.trigger
        if trigger is None:
            return
        now_ns = self._clock.monotonic_ns()
        if self._triggered_ns is None or now_ns - self._triggered_ns >= trigger.every_ns:
            await line.write(self._layout.unit, trigger.address, [trigger.value])
            self._triggered_ns = now_ns

    async def _id(self, line: ModbusLine) -> int:
        run = Run(self._layout.block_id, 1)
        return int.from_bytes(await line.read(self._layout.unit, FUNCTIONS[self._layout.table], run), "big")

    def _lose_until(self, block_id: int) -> None:
        """Count the blocks between the last one and this one, which nobody can read any more."""
        last, self._last_id = self._last_id, block_id
        if last is None:
            return
        # Ids run from 1 to 65535: 0 says that there is no block.
        missed = (block_id - last) % (ID_MODULUS - 1) - 1
        if missed > ID_MODULUS // 2:
            self._restarts += 1
            return
        self._counters.blocks_missed += missed
        self._lose(missed)

    def _lose(self, blocks: int) -> None:
        self._lost_since += blocks * self._layout.samples
        self._stream_counters.samples_lost += blocks * self._layout.samples

    def _hand_on(self, rows: bytes, seen_ns: int) -> None:
        raw = np.frombuffer(rows, np.uint8).reshape(self._layout.samples, -1)
        samples = np.ascontiguousarray(self._layout.record.decode(raw))
        span_ns = round(len(samples) * self._period_ns)
        first, missing = 0, 0
        quality = Quality.TIME_UNSETTLED
        if self._end is not None:
            end_index, end_ns = self._end
            missing = max(round((seen_ns - span_ns - end_ns) / self._period_ns), self._lost_since)
            first = end_index + missing
        self._lost_since = 0
        if missing:
            quality |= Quality.AFTER_LOSS | Quality.LOSS_ESTIMATED
            self._stream_counters.gaps += 1
        self._stream_counters.samples_received += len(samples)
        self._end = (first + len(samples), seen_ns)
        self._deliver(
            SampleBlock(self._name, first, samples, seen_ns - span_ns, self._period_ns, missing, quality)
        )


def reader_for(spec: StreamSpec[ModbusLayout], port: BusPort, counters: ModbusCounters) -> Reader:
    """The reader for the way in which the stream's device hands out samples."""
    kinds: dict[type, Callable[..., Reader]] = {
        Trend: TrendReader,
        Fifo: FifoReader,
        Ring: RingReader,
        Waveform: WaveformReader,
    }
    return kinds[type(spec.layout)](spec, port, counters)
