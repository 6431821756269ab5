"""The sample ring: one writer, many readers, every sample at its absolute index.

Missing samples keep their place as rows of NaN, so an index means the same instant to every reader. A
reader that falls behind learns exactly how many samples it has lost; it never sees a row that was
overwritten under its hands.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
from array import array
from bisect import bisect_right
from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.acquisition.samples import Quality, Window

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daqsvc.acquisition.samples import SampleBlock, Samples

ANCHORS = 4096
SNAPSHOTS = 1024
"""Snapshots that a ring remembers the places of."""
GAPS = 256
"""Gaps that a ring remembers, to tell what a reader has missed from what never came; breaks as well."""


class RingError(Exception):
    """What a ring refuses."""


class RingOverrun(RingError):  # noqa: N818 - the field's word
    """The samples asked for have been overwritten.

    Attributes:
        lost: how many of them, exactly.
        oldest: the oldest index still there.
    """

    def __init__(self, stream: str, first: int, oldest: int) -> None:
        self.lost = oldest - first
        self.oldest = oldest
        super().__init__(f"{self.lost} samples of {stream!r} from index {first} on were overwritten")


class RingNotYet(RingError):  # noqa: N818
    """The samples asked for have not been written yet."""


class RingClosed(RingError):  # noqa: N818
    """The writer is gone and the index waited for will never come."""


class SampleRing:
    """A preallocated ring of float32 samples ``[capacity, channels]``.

    `write` belongs to one thread, the event loop's; `read` may be called from any. A writer that
    laps a reader in the middle of a copy is noticed after the copy and reported as an overrun.

    Args:
        stream: name of the stream.
        channels: names of the columns.
        capacity: samples it holds, at least 1.
    """

    def __init__(self, stream: str, channels: Sequence[str], capacity: int) -> None:
        if capacity < 1 or not channels:
            raise ValueError(
                f"ring of {stream!r} needs a capacity >= 1 and channels, not {capacity}, {channels}"
            )
        self.stream = stream
        self.channels = tuple(channels)
        self.capacity = capacity
        self.samples_lost = 0
        self._data = np.full((capacity, len(channels)), np.nan, np.float32)
        self._oldest = 0
        self._end: int | None = None
        # Objects in lists would take six times the memory, and that only when the ring has run for minutes.
        self._anchor_index = array("q", bytes(8 * ANCHORS))
        self._anchor_t_ns = array("q", bytes(8 * ANCHORS))
        self._anchor_period_ns = array("d", bytes(8 * ANCHORS))
        self._anchors = 0
        self._gaps: deque[tuple[int, int]] = deque(maxlen=GAPS)
        self._breaks: deque[int] = deque(maxlen=GAPS)
        self._snapshots: deque[tuple[int, int]] = deque(maxlen=SNAPSHOTS)
        self._order = itertools.count()
        self._waiting: list[tuple[int, int, asyncio.Future[None]]] = []
        self._closed = False

    @property
    def started(self) -> bool:
        """Whether anything has been written."""
        return self._end is not None

    @property
    def oldest_index(self) -> int:
        """Index of the oldest sample that can be read."""
        return self._oldest

    @property
    def end_index(self) -> int:
        """One past the index of the newest sample; 0 before the first block."""
        return 0 if self._end is None else self._end

    def write(self, block: SampleBlock) -> None:
        """Append a block; what is lost before it, and a pause, become rows of NaN.

        Raises:
            ValueError: the block has other channels, or does not follow the last one.
        """
        n = len(block.samples)
        if block.samples.shape[1] != len(self.channels):
            raise ValueError(
                f"block of {self.stream!r} has {block.samples.shape[1]} channels, "
                f"the ring {len(self.channels)}"
            )
        if self._end is None:
            self._end = self._oldest = block.first_index - block.gap
        elif block.quality & Quality.PLACE_ESTIMATED:
            self._breaks.append(block.first_index)
        if block.first_index != self._end + block.gap:
            raise ValueError(
                f"block of {self.stream!r} at index {block.first_index} does not follow {self._end} "
                f"with {block.gap} samples between that are lost or were never taken"
            )
        # Readers on other threads compare with this before and after they copy.
        self._oldest = max(self._oldest, block.end_index - self.capacity)
        if block.gap:
            self._gaps.append((self._end, block.first_index))
        self._fill(self._end, block.gap, None)
        self._fill(block.first_index, n, block.samples)
        if block.pause_before is not None:
            self._snapshots.append((block.first_index, block.end_index))
        self.samples_lost += block.lost_before
        slot = self._anchors % ANCHORS
        self._anchor_index[slot] = block.first_index
        self._anchor_t_ns[slot] = block.t_first_ns
        self._anchor_period_ns[slot] = block.period_ns
        self._anchors += 1
        self._end = block.end_index
        self._wake()

    def _fill(self, first: int, count: int, samples: Samples | None) -> None:
        skip = max(0, count - self.capacity)  # what would be overwritten at once
        done = skip
        while done < count:
            slot = (first + done) % self.capacity
            run = min(count - done, self.capacity - slot)
            self._data[slot : slot + run] = np.nan if samples is None else samples[done : done + run]
            done += run

    def read(self, first: int, count: int) -> Samples:
        """A copy of ``count`` samples from index ``first`` on, float32 ``[count, channels]``.

        Raises:
            RingOverrun: some of them have been overwritten.
            RingNotYet: some of them are still to come.
        """
        if count < 0 or first + count > self.end_index or self._end is None:
            raise RingNotYet(
                f"samples {first} to {first + count} of {self.stream!r} are not there; "
                f"it ends at {self.end_index}"
            )
        if first < self._oldest:
            raise RingOverrun(self.stream, first, self._oldest)
        slot = first % self.capacity
        head = min(count, self.capacity - slot)
        copy = np.concatenate([self._data[slot : slot + head], self._data[: count - head]])
        if first < self._oldest:
            raise RingOverrun(self.stream, first, self._oldest)
        return copy

    @property
    def has_snapshots(self) -> bool:
        """Whether its blocks are snapshots, each by itself."""
        return bool(self._snapshots)

    def snapshot_from(self, index: int) -> tuple[int, int] | None:
        """First and end index of the oldest snapshot that ends behind ``index``; None if there is none."""
        return next((place for place in self._snapshots if place[1] > index), None)

    def lost_between(self, first: int, end: int) -> int:
        """How many of the samples from index ``first`` up to ``end`` are missing, by the last `GAPS` gaps."""
        return sum(max(0, min(end, gap_end) - max(first, gap_first)) for gap_first, gap_end in self._gaps)

    def breaks_between(self, first: int, end: int) -> list[int]:
        """See `Window.breaks`; of the last `GAPS` ones, those from index ``first`` up to ``end``."""
        return [index for index in self._breaks if first <= index < end]

    def time_of(self, index: int) -> int:
        """Host monotonic time in ns at which sample ``index`` was (or will be) taken.

        Raises:
            RingNotYet: nothing has been written.
        """
        return round(self._time_at(index)[0])

    def period_at(self, index: int) -> float:
        """Time between samples around ``index``, in ns."""
        return self._time_at(index)[1]

    def _time_at(self, index: int) -> tuple[float, float]:
        if not self._anchors:
            raise RingNotYet(f"{self.stream!r} has no samples yet, so no time")
        known = range(max(0, self._anchors - ANCHORS), self._anchors)
        place = bisect_right(known, index, key=lambda k: self._anchor_index[k % ANCHORS])
        slot = known[max(place - 1, 0)] % ANCHORS
        period_ns = self._anchor_period_ns[slot]
        return self._anchor_t_ns[slot] + (index - self._anchor_index[slot]) * period_ns, period_ns

    async def wait_for(self, index: int) -> None:
        """Wait until sample ``index - 1`` has been written, so that everything below ``index`` is there.

        Raises:
            RingClosed: the ring was closed before.
        """
        if self._end is not None and self._end >= index:
            return
        if self._closed:
            raise RingClosed(f"{self.stream!r} ended at {self.end_index}, before index {index}")
        woken: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        heapq.heappush(self._waiting, (index, next(self._order), woken))
        try:
            await woken
        finally:
            # Else its exception, which holds this frame, would keep the ring until the collector comes.
            del woken

    async def window(self, trigger: int, before: int, after: int) -> Samples:
        """The samples around a trigger: ``before`` of them up to it and ``after`` from it on.

        Raises:
            RingOverrun: the oldest of them are gone.
            RingClosed: the newest of them will not come.
        """
        await self.wait_for(trigger + after)
        return self.read(trigger - before, before + after)

    def _wake(self) -> None:
        while self._waiting and self._waiting[0][0] <= self.end_index:
            _, _, woken = heapq.heappop(self._waiting)
            if not woken.done():
                woken.set_result(None)

    @property
    def is_closed(self) -> bool:
        """Whether nothing more will be written."""
        return self._closed

    def close(self) -> None:
        """End all waiting; what was written can still be read."""
        self._closed = True
        for _, _, woken in self._waiting:
            if not woken.done():
                woken.set_exception(RingClosed(f"{self.stream!r} was closed at index {self.end_index}"))
        self._waiting.clear()


class RingReader:
    """One reader's place in a ring.

    Attributes:
        position: index of the next sample to read; None until the ring has its first block.
        samples_skipped: samples lost to overruns since the start, exactly; what was missing anyway is none.
    """

    def __init__(self, ring: SampleRing) -> None:
        self.ring = ring
        self.position: int | None = ring.end_index if ring.started else None
        self.samples_skipped = 0

    @property
    def behind(self) -> int:
        """Samples written and not yet read."""
        if self.position is None:
            return self.ring.end_index - self.ring.oldest_index if self.ring.started else 0
        return self.ring.end_index - self.position

    async def read(self, block: int, most_blocks: int) -> Window:
        """Wait for ``block`` samples and read as many whole blocks as there are, up to ``most_blocks``.

        Of a stream of snapshots the next one is read, whatever its length.

        Raises:
            RingClosed: the ring was closed with less than a block left.
        """
        ring = self.ring
        if self.position is None:
            if not ring.started:
                await self._first_block()
            self.position = ring.oldest_index
        if ring.has_snapshots:
            return await self._read_snapshot(self.position)
        skipped = lost = 0
        while True:
            await ring.wait_for(self.position + block)
            count = min((ring.end_index - self.position) // block, most_blocks) * block
            try:
                samples = ring.read(self.position, count)
            except RingOverrun as overrun:
                skipped += overrun.lost
                lost += ring.lost_between(self.position, overrun.oldest)
                self.position = overrun.oldest
                continue
            first, self.position = self.position, self.position + count
            self.samples_skipped += skipped - lost
            return self._window(first, samples, skipped)

    async def _read_snapshot(self, position: int) -> Window:
        ring, skipped = self.ring, 0
        while True:
            await ring.wait_for(position + 1)
            place = ring.snapshot_from(position)
            if place is None:
                position = self.position = ring.end_index
                continue
            first, end = place
            position = self.position = end
            try:
                samples = ring.read(first, end - first)
            except RingOverrun:
                skipped += end - first
                continue
            self.samples_skipped += skipped
            return self._window(first, samples, skipped, snapshot=True)

    def _window(self, first: int, samples: Samples, skipped: int, *, snapshot: bool = False) -> Window:
        ring, end = self.ring, first + len(samples)
        breaks = sorted({max(index, first) for index in ring.breaks_between(first - skipped, end)})
        return Window(
            first, samples, ring.time_of(end - 1), ring.period_at(end - 1), skipped, snapshot, tuple(breaks)
        )

    async def _first_block(self) -> None:
        # Any index will do: the first block starts wherever the device's counter stands.
        await self.ring.wait_for(-(2**63))
