"""Blocks of samples that a device takes at once and keeps until the next: fetched page by page."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.acquisition.assembler import StreamCounters
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.samples import Quality, SampleBlock
from daqsvc.acquisition.timebase import TimeBaseState
from drivers.modbus_layouts import FUNCTIONS
from drivers.modbus_reading import PollingReader
from drivers.registers import Run

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from drivers.base import BusPort, StreamSpec
    from drivers.modbus_layouts import Waveform
    from drivers.modbus_line import ModbusLine
    from drivers.modbus_outcomes import ModbusCounters

ID_MODULUS = 65_536


class _Ended(NamedTuple):
    """When a block ended, and how far that may be off."""

    t_ns: int
    error_ns: float

    @classmethod
    def between(cls, after_ns: int | None, by_ns: int) -> _Ended:
        """It had not ended at ``after_ns`` (None: nobody looked), and had at ``by_ns``."""
        if after_ns is None:
            return cls(by_ns, math.inf)
        return cls((after_ns + by_ns) // 2, (by_ns - after_ns) / 2)


class WaveformReader(PollingReader):
    """Fetches every block that the device takes.

    Blocks stand apart in time: the samples that nobody took in between are told as missing before the
    block, by the host clock; as lost are counted only those of blocks that the device took and that
    could not be read whole.

    Nothing in a block tells when it was taken. But the last look at the id that found another one was before
    its end, and the first that found its own was after it: it ended midway, give or take half of that time.
    """

    def __init__(self, spec: StreamSpec[Waveform], port: BusPort, counters: ModbusCounters) -> None:
        super().__init__([spec.name], port.clock)
        self._name = spec.name
        self._layout = spec.layout
        self._counters = counters
        self._stream_counters = StreamCounters()
        self._period_ns = NS_PER_S / spec.rate_hz
        self._deliver: Callable[[SampleBlock], None] = port.deliver
        self._last_id: int | None = None
        self._end: tuple[int, int] | None = None
        self._lost_since = 0
        self._restarts = 0
        self._triggered_ns: int | None = None
        self._shown: int | None = None
        self._asked_ns: int | None = None
        self._ended = _Ended(0, math.inf)

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
        if block_id in {0, self._last_id}:
            await self._clock.sleep_ns(self._layout.poll_ns)
            return
        ended = self._ended
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
        self._hand_on(rows, ended)

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
        """The id of the block that the device shows, and with a new one when that block ended."""
        asked_ns = self._clock.monotonic_ns()
        run = Run(self._layout.block_id, 1)
        raw = await line.read(self._layout.unit, FUNCTIONS[self._layout.table], run)
        block_id = int.from_bytes(raw, "big")
        if block_id != self._shown:
            self._ended = _Ended.between(self._asked_ns, self._clock.monotonic_ns())
        self._shown, self._asked_ns = block_id, asked_ns
        return block_id

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

    def _hand_on(self, rows: bytes, ended: _Ended) -> None:
        raw = np.frombuffer(rows, np.uint8).reshape(self._layout.samples, -1)
        samples = np.ascontiguousarray(self._layout.record.decode(raw))
        span_ns = round(len(samples) * self._period_ns)
        first, missing = 0, 0
        t_first_ns = ended.t_ns - span_ns
        quality = Quality.GOOD if math.isfinite(ended.error_ns) else Quality.TIME_UNSETTLED
        if self._end is not None:
            end_index, end_ns = self._end
            missing = max(round((t_first_ns - end_ns) / self._period_ns), self._lost_since)
            first = end_index + missing
        self._lost_since = 0
        if missing:
            quality |= Quality.AFTER_LOSS | Quality.LOSS_ESTIMATED
            self._stream_counters.gaps += 1
        self._stream_counters.samples_received += len(samples)
        self._end = (first + len(samples), ended.t_ns)
        self._deliver(
            SampleBlock(
                self._name, first, samples, t_first_ns, self._period_ns, missing, quality, ended.error_ns
            )
        )
