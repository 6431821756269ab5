"""Samples from a ring of registers with a write counter, each once, or counted as lost."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from drivers.modbus.counted import SURE, CountedReader
from drivers.modbus.registers import RegisterRun
from drivers.modbus.replies import FUNCTIONS
from drivers.modbus.settings import RingLayout

if TYPE_CHECKING:
    from drivers.base import BusPort, StreamSpec
    from drivers.modbus.line import ModbusLine
    from drivers.modbus.replies import ModbusCounters

REQUESTS_PER_LOOK = 16
"""Requests for samples between two readings of the counter, at most: if one fails, all are made again."""


class _Look(NamedTuple):
    """A reading of the write counter.

    Attributes:
        written: how many samples have been written, as many bits of it as the counter has.
        asked_ns: they have been written after this, or before,
        seen_ns: and by this at the latest.
    """

    written: int
    asked_ns: int
    seen_ns: int


class DeviceRingReader(CountedReader[RingLayout]):
    """Follows the write counter of a ring.

    What was written between two readings of the counter is read, and the reading after that shows
    whether any of it may have been overwritten meanwhile. A request that fails is repeated at the next
    reading: only what the device has overwritten is lost, and the counter states how much that is.

    No single reading is believed. A counter does not go back: one that was damaged on its way is above the
    next one, or below the one before. A counter that has begun again is so at the next reading, too, and
    then only what must have been written since is read.
    """

    def __init__(
        self, spec: StreamSpec[RingLayout], port: BusPort, counters: ModbusCounters, *, checked: bool
    ) -> None:
        """Begin with the next reading.

        Args:
            spec: the stream.
            port: of its bus.
            counters: of the bus.
            checked: whether a checksum goes with each reply, so that none is damaged unnoticed.
        """
        super().__init__(spec, port)
        self._counters = counters
        self._checked = checked
        self._whole = self._layout.depth - 1  # in the place that is left, the next sample is being written
        self._at_once = min(self._sample_clock.at_once, self._layout.depth)
        self._known: tuple[_Look, int] | None = None
        self._seen: _Look | None = None

    async def run(self, line: ModbusLine) -> None:
        """See `Reader.run`."""
        self._seen = None  # what was seen before the line was lost is old
        await super().run(line)

    def flush(self) -> None:
        """No sample is ever held back."""
        self._rows.flush()

    async def _look(self, line: ModbusLine) -> None:
        look = await self._believable(line)
        if look is None or not await self._read_until(look, line):
            self._counters.counts_doubted += 1
            self._seen = None
        if self._seen is None:
            await self._clock.sleep_ns(self._poll_ns)

    async def _believable(self, line: ModbusLine) -> _Look | None:
        """The next reading of the counter; None if another one contradicts it."""
        first, self._seen = self._seen or await self._count(line), None
        explained = self._advance(first) is not None
        if explained and self._checked:
            return first
        if explained:
            return first if self._follows(first, await self._count(line)) else None
        for _ in range(SURE - 1):
            second = await self._count(line)
            ahead = (second.written - first.written) % self._modulus
            most = self._sample_clock.most(second.seen_ns - first.asked_ns) + self._at_once
            if self._advance(second) is not None or ahead > most:
                return None  # the counter is where it was, or its place is not known
            first = second
        return first

    async def _read_until(self, look: _Look, line: ModbusLine) -> bool:
        """Read what was written until a reading; returns whether the next reading confirms that."""
        self._place(look)
        assert self._next is not None  # noqa: S101 - `_place` has set it
        layout, start = self._layout, self._next
        due = min((look.written - start) % self._modulus, REQUESTS_PER_LOOK * self._per_read)
        if not due:
            return True
        rows = b""
        for run in self._runs(start, due):
            rows += await line.read(layout.unit, FUNCTIONS[layout.table], run, self._what)
        after = await self._count(line)
        if not self._follows(look, after):
            return False
        overwritten = min(max((after.written - start) % self._modulus - self._whole, 0), due)
        if overwritten:
            if not (self._checked or self._follows(after, await self._count(line))):
                return False
            self._counters.ring_overruns += 1
            self._skip(overwritten)
        if overwritten < due:
            self._rows.counters.frames_received += due - overwritten
            self._hand_on(rows[overwritten * self._sample_bytes :], look.seen_ns)
        unread = (after.written - self._next) % self._modulus
        since_look = (after.written - look.written) % self._modulus
        lately = self._sample_clock.most(after.seen_ns - look.asked_ns)
        if since_look <= lately + self._sample_clock.standstill:
            # Of two readings in order the later one is nearer to the truth, if the first was too low.
            self._known = after, self._index + unread
        if unread >= self._per_read:
            self._seen = after  # there is more already
        return True

    @property
    def _what(self) -> str:
        return f"stream {self._name!r}"

    async def _count(self, line: ModbusLine) -> _Look:
        layout = self._layout
        run = RegisterRun(layout.count.address, layout.count.registers)
        reading = await line.poll(layout.unit, FUNCTIONS[layout.table], run, self._what)
        written = layout.count.decode(reading.registers)
        self._rows.look(written, reading.answered_ns)
        return _Look(written, reading.asked_ns, reading.answered_ns)

    def _follows(self, first: _Look, second: _Look) -> bool:
        return (second.written - first.written) % self._modulus < self._modulus // 2

    def _advance(self, look: _Look) -> int | None:
        """Samples from the next one to where the counter is; None if the clock cannot explain that."""
        if self._known is None or self._next is None:
            return None
        known, index = self._known
        ahead = (look.written - self._next) % self._modulus
        unread = index - self._index
        least = unread + self._sample_clock.least(look.asked_ns - known.seen_ns)
        most = unread + self._sample_clock.most(look.seen_ns - known.asked_ns)
        advance = ahead + round(((least + most) / 2 - ahead) / self._modulus) * self._modulus
        # Where the counter has passed 0, what lies behind that may be older than a restart.
        behind = self._at_once if look.written < self._next else self._sample_clock.standstill
        return advance if advance >= 0 and least - behind <= advance <= most + self._at_once else None

    def _place(self, look: _Look) -> None:
        """Take the next sample to be the oldest one that is there for sure, and has not been read."""
        advance = self._advance(look)
        fresh = min(look.written, self._whole)
        if self._known is None or self._next is None:
            self._next = self._index = look.written - fresh
        elif advance is None:
            fresh = min(fresh, self._written_since(look, self._known[0], self._next))
            known, index = self._known
            index += self._sample_clock.samples(look.seen_ns - known.seen_ns)
            self._begin_again(index - fresh)
            self._next = look.written - fresh
        elif advance > self._whole:
            # Not what was written before the counter passed 0: it may have begun there, unseen.
            self._counters.ring_overruns += 1
            self._skip(advance - fresh)
        self._known = look, self._index + (look.written - self._next) % self._modulus

    def _written_since(self, look: _Look, known: _Look, following: int) -> int:
        """Samples that are new for sure, whether the device has begun again at 0 or has stopped."""
        if look.written > self._sample_clock.most(look.seen_ns - known.asked_ns) + self._at_once:
            return 0  # it has not begun at 0, so where it has is not known
        return look.written - following if look.written >= following else look.written

    def _runs(self, start: int, due: int) -> list[RegisterRun]:
        """The requests for ``due`` samples from ``start`` on; the ring may end in between."""
        width, depth = self._sample_bytes // 2, self._layout.depth
        runs = []
        while due:
            place = start % depth
            count = min(due, depth - place, self._per_read)
            runs.append(RegisterRun(self._layout.address + place * width, count * width))
            start, due = start + count, due - count
        return runs
