"""Blocks of samples that a device takes at once and keeps until the next: fetched page by page."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.acquisition.assembler import StreamCounters, note_received
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.samples import Quality, SampleBlock
from daqsvc.acquisition.timebase import TimeBaseState
from daqsvc.errors.buses import NEVER_WHOLE, TIME_UNSURE
from daqsvc.errors.code import coded
from daqsvc.notice import notice
from daqsvc.rounding import readable
from drivers.modbus.counted import SURE, SampleClock
from drivers.modbus.reading import PollingReader
from drivers.modbus.registers import RegisterRecord, RegisterRun
from drivers.modbus.replies import FUNCTIONS
from drivers.modbus.settings import MAX_REGISTERS

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Mapping

    from drivers.base import BusPort, StreamSpec
    from drivers.modbus.line import ModbusLine
    from drivers.modbus.replies import ModbusCounters
    from drivers.modbus.settings import WaveformLayout

logger = logging.getLogger(__name__)

IDS = 65_535
"""How many ids there are: they run from 1 to this, and again from 1; 0 states that there is no block."""

NO_BLOCK = 0

TORN = 3
"""Blocks in a row that were replaced while they were read, by which it is known that the line is too slow."""


class _Ended(NamedTuple):
    """When a block ended, and how far that may be off."""

    t_ns: int
    error_ns: float

    @classmethod
    def between(cls, after_ns: int | None, by_ns: int) -> _Ended:
        """It had not ended at ``after_ns`` (None: not read), and had at ``by_ns``."""
        if after_ns is None:
            return cls(by_ns, math.inf)
        return cls((after_ns + by_ns) // 2, (by_ns - after_ns) / 2)


class _Torn(NamedTuple):
    """The first of several blocks in a row that were replaced while they were read.

    Attributes:
        block_id: its id.
        ended_ns: when it ended.
    """

    block_id: int
    ended_ns: int


def pages_of(layout: WaveformLayout) -> tuple[tuple[RegisterRun, ...], ...]:
    """The requests that read each page of a block; without a window on it there is one page."""
    left = layout.samples * layout.sample_registers
    window = left if layout.page is None else layout.page.registers
    pages = []
    while left:
        inside = min(left, window)
        pages.append(
            tuple(
                RegisterRun(layout.address + start, min(MAX_REGISTERS, inside - start))
                for start in range(0, inside, MAX_REGISTERS)
            )
        )
        left -= inside
    return tuple(pages)


class WaveformReader(PollingReader):
    """Fetches every block that the device takes.

    Blocks are snapshots: between them there are no samples, and nothing is missing. The host clock shows how
    long that was. Only samples of blocks that the device took, and that could not be read whole, count as
    lost.

    A trigger is written when it is due, never more often: it may cost a sensor a part of its battery. So it
    is not written again when its reply is lost, for the device may have heard it.

    Nothing in a block shows when it was taken. But the last reading of the id that found another one was
    before its end, and the first that found its own was after it. So it ended midway, give or take half of
    that time.

    A new id is believed once another reading finds it, too; several, if it is not the one that was due.

    Args:
        spec: the stream.
        port: of its bus.
        counters: of the bus.
        window: held while a page is selected and read, by all streams of the unit.
    """

    def __init__(
        self, spec: StreamSpec[WaveformLayout], port: BusPort, counters: ModbusCounters, window: asyncio.Lock
    ) -> None:
        super().__init__([spec.name], port.clock)
        self._name = spec.name
        self._layout = spec.layout
        self._record = RegisterRecord.of(spec.layout)
        self._pages = pages_of(spec.layout)
        self._poll_ns = spec.layout.poll_ns(spec.rate_hz)
        self._counters = counters
        self._window = window
        self._stream_counters = StreamCounters()
        self._period_ns = NS_PER_S / spec.rate_hz
        self._sample_clock = SampleClock(spec.rate_hz)
        self._deliver: Callable[[SampleBlock], None] = port.deliver
        self._last_id: int | None = None
        self._last_seen_ns = 0
        self._end: tuple[int, int] | None = None
        self._lost_since = 0
        self._restarts = 0
        self._triggered_ns: int | None = None
        self._shown: int | None = None
        self._asked_ns: int | None = None
        self._ended = _Ended(0, math.inf)
        self._torn: _Torn | None = None
        self._torn_in_a_row = 0
        self._never_whole = ""
        """Why no block is read whole, in a clause; empty as long as one is now and then."""
        self._is_logged = False

    @property
    def streams(self) -> Mapping[str, tuple[StreamCounters, TimeBaseState]]:
        """See `Reader.streams`."""
        error_ns = self._ended.error_ns
        settled = math.isfinite(error_ns)
        time_base = TimeBaseState(self._period_ns, 0.0, 0.0, settled, self._restarts, error_ns)
        return {self._name: (self._stream_counters, time_base)}

    def flush(self) -> None:
        """Nothing is ever held back."""

    async def _look(self, line: ModbusLine) -> None:
        await self._trigger(line)
        block_id = await self._id(line)
        if block_id == NO_BLOCK:
            self._note_no_block()
        if block_id in {NO_BLOCK, self._last_id}:
            await self._clock.sleep_ns(self._poll_ns)
            return
        ended, begun_ns = self._ended, self._clock.monotonic_ns()
        rows = await self._read_block(line, block_id)
        self._watch_pace(None if rows else _Torn(block_id, ended.t_ns), begun_ns)
        self._stream_counters.frames_received += 1
        self._lose_until(block_id)
        if rows is None:
            self._counters.blocks_torn += 1
            self._lose(1)
            return
        self._hand_on(rows, ended)

    def _watch_pace(self, torn: _Torn | None, begun_ns: int) -> None:
        """State once that blocks are replaced before they are read; ``torn`` is one that was."""
        if torn is None:
            if self._never_whole and self._is_logged:
                notice(logger, "%s: a block was read whole again", self._who)
            self._torn, self._torn_in_a_row, self._never_whole = None, 0, ""
            return
        self._torn = self._torn or torn
        self._torn_in_a_row += 1
        taken = ((self._shown or 0) - self._torn.block_id) % IDS
        if self._torn_in_a_row < TORN or not taken:
            return
        took_s = (self._clock.monotonic_ns() - begun_ns) / NS_PER_S
        stands_s = (self._ended.t_ns - self._torn.ended_ns) / taken / NS_PER_S
        fault = (
            f"no block is read whole: reading one takes {readable(took_s, 2)} s, and the "
            f"device replaces it after about {readable(stands_s, 2)} s"
        )
        self._never_whole = f"{fault}; {self._remedy}"
        if not self._is_logged:
            self._is_logged = True
            logger.warning(
                "%s: %s, so all of them are lost; %s",
                self._who,
                fault,
                self._remedy,
                extra=coded(NEVER_WHOLE),
            )

    @property
    def _remedy(self) -> str:
        often = "have the device take blocks less often"
        if self._layout.trigger is not None:
            often = "raise every_s of trigger"
        return f"{often}, or have fewer samples in a block, or fewer and rarer requests of other streams"

    def _stand(self, faults: Mapping[str, str]) -> None:
        """See `PollingReader`: that the unit answers does not bring a whole block."""
        super()._stand({self._name: self._never_whole} | dict(faults) if self._never_whole else faults)

    async def _read_block(self, line: ModbusLine, block_id: int) -> bytes | None:
        """Read all pages of a block; None if another block has taken its place meanwhile."""
        layout = self._layout
        rows = b""
        for page, runs in enumerate(self._pages):
            async with self._window:  # else another stream of the unit might turn the page
                if layout.page is not None:
                    await line.write(layout.unit, layout.page.select, [page])
                for run in runs:
                    rows += await line.read(layout.unit, FUNCTIONS[layout.table], run, self._what)
            if await self._id(line) != block_id:
                return None
        return rows

    @property
    def _what(self) -> str:
        return f"stream {self._name!r}"

    async def _pause_after_failure(self) -> None:
        await self._clock.sleep_ns(self._poll_ns)

    async def _trigger(self, line: ModbusLine) -> None:
        """Make the device take a block, if one is due."""
        trigger = self._layout.trigger
        if trigger is None:
            return
        now_ns = self._clock.monotonic_ns()
        if self._triggered_ns is None or now_ns - self._triggered_ns >= trigger.every_s * NS_PER_S:
            self._triggered_ns = now_ns
            await line.write(self._layout.unit, trigger.address, [trigger.value])

    async def _id(self, line: ModbusLine) -> int:
        """The id of the block that the device shows, and with a new one when that block ended."""
        layout = self._layout
        run = RegisterRun(layout.block_id, 1)
        while True:
            first = await line.poll(layout.unit, FUNCTIONS[layout.table], run, self._what)
            again = first
            block_id = int.from_bytes(first.registers, "big")
            if block_id != self._shown:
                is_next = self._shown is not None and block_id == self._shown % IDS + 1
                for _ in range(1 if is_next else SURE - 1):
                    again = await line.poll(layout.unit, FUNCTIONS[layout.table], run, self._what)
                    if again.registers != first.registers:
                        break
            if again.registers == first.registers:
                if block_id != self._shown:
                    self._ended = _Ended.between(self._asked_ns, first.answered_ns)
                self._shown, self._asked_ns = block_id, again.asked_ns
                break
            self._counters.counts_doubted += 1
            await self._clock.sleep_ns(self._poll_ns)
        if block_id == self._last_id:
            self._last_seen_ns = self._asked_ns
        return block_id

    def _note_no_block(self) -> None:
        """Before the first block of a device there is none; so it has restarted if there was one."""
        if self._last_id not in {None, NO_BLOCK}:
            self._tell_restart()
        self._last_id, self._last_seen_ns = NO_BLOCK, self._asked_ns or 0

    def _lose_until(self, block_id: int) -> None:
        """Count the blocks between the last one and this one, which can no longer be read."""
        last, self._last_id = self._last_id, block_id
        since_ns, self._last_seen_ns = self._last_seen_ns, self._asked_ns or 0
        if last is None:
            return
        missed = (block_id - last - 1) % IDS
        elapsed_ns = self._clock.monotonic_ns() - since_ns
        most = (self._sample_clock.most(elapsed_ns) + self._sample_clock.at_once) / self._layout.samples
        if missed > most:
            self._tell_restart()
            missed = block_id - 1 if block_id - 1 <= most else 0
        self._counters.blocks_missed += missed
        self._lose(missed)

    def _tell_restart(self) -> None:
        logger.warning(
            "stream %r: the device has begun to count its blocks again; blocks that it took just before are "
            "not counted as lost",
            self._name,
            extra=coded(TIME_UNSURE),
        )
        self._restarts += 1

    def _lose(self, blocks: int) -> None:
        self._lost_since += blocks * self._layout.samples
        self._stream_counters.samples_lost += blocks * self._layout.samples

    def _hand_on(self, rows: bytes, ended: _Ended) -> None:
        raw = np.frombuffer(rows, np.uint8).reshape(self._layout.samples, -1)
        samples = note_received(
            self._stream_counters, self._name, np.ascontiguousarray(self._record.decode(raw))
        )
        span_ns = round(len(samples) * self._period_ns)
        t_first_ns = ended.t_ns - span_ns
        quality = Quality.GOOD if math.isfinite(ended.error_ns) else Quality.TIME_UNSETTLED
        end_index, end_ns = self._end or (0, t_first_ns)
        lost, self._lost_since = self._lost_since, 0
        pause = max(round((t_first_ns - end_ns) / self._period_ns) - lost, 0)
        first = end_index + lost + pause
        if lost:
            quality |= Quality.AFTER_LOSS | Quality.LOSS_ESTIMATED
            self._stream_counters.gaps += 1
        self._end = (first + len(samples), ended.t_ns)
        self._deliver(
            SampleBlock(
                self._name,
                first,
                samples,
                t_first_ns,
                self._period_ns,
                lost,
                quality,
                ended.error_ns,
                pause,
            )
        )
