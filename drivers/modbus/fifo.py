"""Samples from a queue that is read by function 24, each once, or counted as lost."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from drivers.modbus.counted import SURE, CountedReader
from drivers.modbus.settings import FifoLayout

if TYPE_CHECKING:
    from collections.abc import Sequence

    from drivers.base import BusPort, StreamSpec
    from drivers.modbus.line import ModbusLine

REPLIES_LOST_AT_ONCE = 8
"""Replies that may get lost without time to speak of, each with the samples that it took out of the queue."""


class _Reply(NamedTuple):
    """What came out of the queue.

    Attributes:
        first: count of the first sample.
        rows: registers, sample by sample.
        taken: samples.
        asked_ns: when it was asked for, host monotonic.
        seen_ns: when it was there.
    """

    first: int
    rows: bytes
    taken: int
    asked_ns: int
    seen_ns: int


class _Emptied(NamedTuple):
    """How far the device had counted when its queue was found empty, and when that was."""

    at_index: int
    seen_ns: int


class FifoReader(CountedReader[FifoLayout]):
    """Empties a queue, and acknowledges what it has taken if the device waits for that.

    The count at the head of a reply shows what is missing before it, and what has come before. A count that
    does not go on from the last reply is believed when the next ones go on from it; until then nothing is
    acknowledged, and the samples are held back. Where each reply has a checksum, what the clock can explain
    is believed at once.

    Args:
        spec: the stream.
        port: of its bus.
        checked: whether a checksum goes with each reply, so that none is damaged unnoticed.
    """

    def __init__(self, spec: StreamSpec[FifoLayout], port: BusPort, *, checked: bool) -> None:
        super().__init__(spec, port)
        self._checked = checked
        self._drops = spec.layout.acknowledge is None
        self._unacknowledged = 0
        self._held: list[_Reply] = []
        self._last: _Reply | None = None
        self._emptied: _Emptied | None = None

    def flush(self) -> None:
        """Hand over what is held back, unless its count cannot be right."""
        if self._held and self._gap(self._held[0]) is not None:
            self._go_on_with(self._held)
        self._reject_held()
        self._rows.flush()

    async def _look(self, line: ModbusLine) -> None:
        reply = await self._read(line)
        if reply is not None and self._take(reply) and self._layout.acknowledge is not None:
            await self._acknowledge(line, self._layout.acknowledge)
        if reply is None or reply.taken < self._per_read:
            await self._clock.sleep_ns(self._poll_ns)

    async def _read(self, line: ModbusLine) -> _Reply | None:
        """What the queue hands out; None if that is nothing, or no whole samples."""
        layout = self._layout
        asked_ns = self._clock.monotonic_ns()
        raw = await line.read_fifo(layout.unit, layout.address, f"stream {self._name!r}")
        head = 2 * layout.count.registers
        taken, left_over = divmod(max(len(raw) - head, 0), self._sample_bytes)
        if left_over or 0 < len(raw) < head:
            self._rows.counters.frames_wrong_length += 1
            return None
        if not taken:
            return None
        reply = _Reply(layout.count.decode(raw), raw[head:], taken, asked_ns, self._clock.monotonic_ns())
        self._rows.look(reply.first, reply.seen_ns)
        return reply

    async def _acknowledge(self, line: ModbusLine, address: int) -> None:
        """Tell the device how far its queue has been taken."""
        count_bytes = self._layout.count.encode(self._following)
        words = [int.from_bytes(count_bytes[k : k + 2], "big") for k in range(0, len(count_bytes), 2)]
        await line.write(self._layout.unit, address, words)
        self._unacknowledged = 0

    def _take(self, reply: _Reply) -> bool:
        """Hand on what is new in a reply, or hold it back; returns whether anything has been believed."""
        if self._next is None:
            self._next = self._index = reply.first
        self._place_held(reply)
        if self._continues(reply):
            self._reject_held()
            self._rows.counters.frames_received += reply.taken
            self._hand_on_new(reply)
            return True
        if self._drops:
            self._rows.counters.frames_received += reply.taken
            if self._last is not None and (reply.first, reply.rows) == (self._last.first, self._last.rows):
                self._rows.counters.frames_duplicate += reply.taken
                return False
        if self._held and self._contradicts_held(reply):
            self._reject_held()
        self._held.append(reply)
        explained = self._is_explained(self._held[0])
        if not (self._checked and explained) and len(self._held) < (2 if explained else SURE):
            return False
        self._rows.counters.frames_duplicate += self._repeated(self._held[0])
        if self._checked:
            self._go_on_with(self._held)
            return True
        *certain, last = self._held
        self._go_on_with(certain)
        if self._dropped(certain[-1], last):
            self._held = [last]
        else:
            self._go_on_with([last])
        return True

    @property
    def _following(self) -> int:
        assert self._next is not None  # noqa: S101 - there is a next sample once one has been taken
        return self._next

    def _continues(self, reply: _Reply) -> bool:
        """Whether a reply begins with the next sample."""
        return reply.first == self._following

    def _repeated(self, reply: _Reply) -> int:
        """How many samples at the head of a reply have been taken before."""
        behind = (self._following - reply.first) % self._modulus
        repeatable = 0 if self._drops else max(self._unacknowledged, self._per_read)
        return min(behind, reply.taken) if behind <= repeatable else 0

    def _is_explained(self, reply: _Reply) -> bool:
        """Whether a reply repeats samples, or the clock can explain what is missing before it."""
        return self._repeated(reply) > 0 or self._gap(reply) is not None

    def _follows(self, held: _Reply, reply: _Reply) -> bool:
        """Whether a reply goes on from another one, but for what the device may have dropped in between."""
        dropped = self._dropped(held, reply)
        return dropped <= self._sample_clock.most(reply.seen_ns - held.asked_ns) + self._sample_clock.at_once

    def _dropped(self, held: _Reply, reply: _Reply) -> int:
        """Samples that the device has dropped between two replies."""
        kept = held.taken if self._drops else 0
        return (reply.first - held.first - kept) % self._modulus

    def _place_held(self, reply: _Reply) -> None:
        """Hand on a reply of which only the count was damaged: the replies around it show its place."""
        if self._drops and len(self._held) == 1:
            (held,) = self._held
            if (reply.first - self._following) % self._modulus == held.taken:
                self._held = []
                self._hand_on_new(held._replace(first=self._following))

    def _contradicts_held(self, reply: _Reply) -> bool:
        """Whether a reply does not go on from those held back, or shows that the count is where it was."""
        if not self._follows(self._held[-1], reply):
            return True
        return self._is_explained(reply) and not self._is_explained(self._held[0])

    def _go_on_with(self, replies: Sequence[_Reply]) -> None:
        """Hand on replies that were held back."""
        self._held = []
        for reply in replies:
            if not (self._continues(reply) or self._repeated(reply)):
                self._go_on_at(reply)
            if not self._drops:
                self._rows.counters.frames_received += reply.taken - self._repeated(reply)
            self._hand_on_new(reply)

    def _reject_held(self) -> None:
        for reply in self._held:
            repeated = self._repeated(reply)
            self._rows.counters.frames_duplicate += repeated
            self._rows.counters.frames_rejected += reply.taken - repeated
        self._held = []

    def _go_on_at(self, reply: _Reply) -> None:
        """Take the first sample of a reply as the next one."""
        gap = self._gap(reply)
        if gap is None:
            elapsed_ns = reply.seen_ns - (self._last or reply).seen_ns
            self._begin_again(self._index + self._sample_clock.samples(elapsed_ns) - reply.taken)
            self._emptied = None
        else:
            self._index += gap
        self._next = reply.first
        self._unacknowledged = 0

    def _gap(self, reply: _Reply) -> int | None:
        """Samples that are missing before a reply; None if the clock cannot explain so many.

        The head of a queue moves on as samples are taken out, or as the queue is full and new ones come.
        """
        since_ns = reply.seen_ns - (self._last or reply).asked_ns
        popped = REPLIES_LOST_AT_ONCE * self._per_read
        most = self._sample_clock.most(since_ns) + self._sample_clock.at_once + popped
        ahead = (reply.first - self._following) % self._modulus
        return ahead + int((most - ahead) // self._modulus) * self._modulus if ahead <= most else None

    def _hand_on_new(self, reply: _Reply) -> None:
        repeated = self._repeated(reply)
        if repeated < reply.taken:
            new = reply.taken - repeated
            self._check_standstill(reply, new)
            self._hand_on(reply.rows[repeated * self._sample_bytes :], reply.seen_ns)
            self._unacknowledged += 0 if self._drops else new
        self._last = reply

    def _check_standstill(self, reply: _Reply, new: int) -> None:
        """See whether the device has counted as long as the clock has run; an emptied queue shows that."""
        if reply.taken == self._per_read:
            return
        index = self._index + new
        if self._emptied is not None:
            elapsed_ns = reply.asked_ns - self._emptied.seen_ns
            counted = index - self._emptied.at_index
            if counted < self._sample_clock.least(elapsed_ns) - self._sample_clock.standstill:
                index = self._emptied.at_index + self._sample_clock.samples(elapsed_ns)
                self._begin_again(index - new)
        self._emptied = _Emptied(self._index + new, reply.seen_ns)
