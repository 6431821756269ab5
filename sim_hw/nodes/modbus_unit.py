"""A unit on a Modbus line: its registers, and samples that it hands out as a layout states."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Protocol

import numpy as np

from drivers.modbus.registers import RegisterRecord
from drivers.modbus.settings import FifoLayout, RegistersLayout, RingLayout, WaveformLayout

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from drivers.modbus.settings import ModbusLayout, Table

ADDRESSES = 65_536
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE = 1, 2, 3
_TABLES: dict[int, Table] = {3: "holding", 4: "input"}
_MAX_READ, _MAX_WRITE = 125, 123
_LAST_ID = 65_535


class ModbusUnit:
    """Registers behind one unit address.

    Registers are there once they are mapped or set, and 0 until they are set. Requests for any others are
    refused with exception 2, as devices do.
    """

    def __init__(self) -> None:
        self._registers: dict[Table, NDArray[np.uint8]] = {
            name: np.zeros(2 * ADDRESSES, np.uint8) for name in _TABLES.values()
        }
        self._mapped: dict[Table, NDArray[np.bool_]] = {
            name: np.zeros(ADDRESSES, np.bool_) for name in _TABLES.values()
        }
        self._queues: dict[int, Callable[[], bytes]] = {}
        self._watchers: dict[int, Callable[[int], None]] = {}

    def map(self, table: Table, address: int, count: int) -> None:
        """Let these registers be there."""
        self._mapped[table][address : address + count] = True

    def put(self, table: Table, address: int, raw: bytes | NDArray[np.uint8]) -> None:
        """Set registers, high byte of each first."""
        data = np.frombuffer(bytes(raw), np.uint8)
        self.map(table, address, len(data) // 2)
        self._registers[table][2 * address : 2 * address + len(data)] = data

    def get(self, table: Table, address: int, count: int) -> bytes:
        """Registers, high byte of each first."""
        return self._registers[table][2 * address : 2 * (address + count)].tobytes()

    def add_queue(self, address: int, read: Callable[[], bytes]) -> None:
        """Let function 24 at ``address`` return what ``read`` returns: at most 31 registers."""
        self._queues[address] = read

    def watch(self, address: int, written: Callable[[int], None]) -> None:
        """Call ``written`` with the value whenever a holding register is written by request."""
        self.map("holding", address, 1)
        self._watchers[address] = written

    def answer(self, pdu: bytes) -> bytes:
        """The PDU of the reply to the PDU of a request."""
        function, address, data = pdu[0], int.from_bytes(pdu[1:3], "big"), pdu[3:]
        if function in _TABLES:
            reply = self._read(_TABLES[function], address, int.from_bytes(data, "big"))
        elif function == 24:
            reply = self._read_queue(address)
        elif function == 16:
            reply = self._write(address, data)
        else:
            reply = ILLEGAL_FUNCTION
        return bytes([function | 0x80, reply]) if isinstance(reply, int) else bytes([function]) + reply

    def _read(self, table: Table, address: int, count: int) -> bytes | int:
        """What follows the function in a reply, or the code of an exception; so the next ones."""
        if not 1 <= count <= _MAX_READ:
            return ILLEGAL_VALUE
        if not self._there(table, address, count):
            return ILLEGAL_ADDRESS
        return bytes([2 * count]) + self.get(table, address, count)

    def _there(self, table: Table, address: int, count: int) -> bool:
        return address + count <= ADDRESSES and bool(self._mapped[table][address : address + count].all())

    def _read_queue(self, address: int) -> bytes | int:
        if address not in self._queues:
            return ILLEGAL_ADDRESS
        raw = self._queues[address]()
        return (2 + len(raw)).to_bytes(2, "big") + (len(raw) // 2).to_bytes(2, "big") + raw

    def _write(self, address: int, data: bytes) -> bytes | int:
        count, raw = int.from_bytes(data[:2], "big"), data[3:]
        if not 1 <= count <= _MAX_WRITE or data[2] != 2 * count or len(raw) != 2 * count:
            return ILLEGAL_VALUE
        if not self._there("holding", address, count):
            return ILLEGAL_ADDRESS
        self.put("holding", address, raw)
        for k in range(count):
            if (written := self._watchers.get(address + k)) is not None:
                written(int.from_bytes(raw[2 * k : 2 * k + 2], "big"))
        return address.to_bytes(2, "big") + data[:2]


class SampleStore(Protocol):
    """How a unit keeps its samples until they are read."""

    def put(self, first_index: int, rows: NDArray[np.uint8]) -> None:
        """Take samples: the device's count of the first, and uint8 ``[n, 2 * registers]``."""
        ...


class TrendStore:
    """Registers that show the newest sample."""

    def __init__(self, unit: ModbusUnit, layout: RegistersLayout) -> None:
        self._unit, self._layout = unit, layout
        self._runs = RegisterRecord.of(layout).runs
        for run in self._runs:
            unit.map(layout.table, run.address, run.count)

    def put(self, first_index: int, rows: NDArray[np.uint8]) -> None:
        """See `SampleStore.put`."""
        del first_index
        at = 0
        for run in self._runs:
            self._unit.put(self._layout.table, run.address, rows[-1, at : at + 2 * run.count])
            at += 2 * run.count


class RingStore:
    """A ring and its write counter; each sample is written before it is counted."""

    def __init__(self, unit: ModbusUnit, layout: RingLayout) -> None:
        self._unit, self._layout = unit, layout
        unit.map(layout.table, layout.count.address, layout.count.registers)
        unit.map(layout.table, layout.address, layout.depth * layout.sample_registers)

    def put(self, first_index: int, rows: NDArray[np.uint8]) -> None:
        """See `SampleStore.put`."""
        layout = self._layout
        for k, row in enumerate(rows):
            place = (first_index + k) % layout.depth
            self._unit.put(layout.table, layout.address + place * layout.sample_registers, row)
            self._unit.put(layout.table, layout.count.address, layout.count.encode(first_index + k + 1))


class FifoStore:
    """A queue of bounded length, from which the oldest samples are lost when they are not read.

    Args:
        unit: where it is read.
        layout: of the queue.
        depth: samples that it holds.
    """

    def __init__(self, unit: ModbusUnit, layout: FifoLayout, depth: int = 1024) -> None:
        self._layout = layout
        self._queue: deque[tuple[int, bytes]] = deque(maxlen=depth)
        self._acknowledged: dict[int, int] = {}
        self._handed_out = 0
        unit.add_queue(layout.address, self._read)
        if layout.acknowledge is not None:
            for k in range(layout.count.registers):
                unit.watch(layout.acknowledge + k, lambda value, k=k: self._acknowledge(k, value))  # type: ignore[misc]

    @property
    def full(self) -> bool:
        """Whether the next sample costs the oldest one."""
        return len(self._queue) == self._queue.maxlen

    def clear(self) -> None:
        """Forget what has not been read, as a device does that is switched off."""
        self._queue.clear()

    def put(self, first_index: int, rows: NDArray[np.uint8]) -> None:
        """See `SampleStore.put`."""
        self._queue.extend((first_index + k, row.tobytes()) for k, row in enumerate(rows))

    def _read(self) -> bytes:
        oldest = [self._queue[k] for k in range(min(len(self._queue), self._layout.samples_per_read))]
        if not oldest:
            return b""
        # One count represents all: samples behind a gap must wait for the next reply.
        first = oldest[0][0]
        together = [row for k, (index, row) in enumerate(oldest) if index == first + k]
        self._handed_out = len(together)
        if self._layout.acknowledge is None:
            for _ in together:
                self._queue.popleft()
        return self._layout.count.encode(first) + b"".join(together)

    def _acknowledge(self, word: int, value: int) -> None:
        self._acknowledged[word] = value
        if len(self._acknowledged) < self._layout.count.registers:
            return
        raw = b"".join(self._acknowledged[k].to_bytes(2, "big") for k in sorted(self._acknowledged))
        self._acknowledged.clear()
        following = self._layout.count.decode(raw)
        modulus = self._layout.count.modulus
        # Only what has been handed out: behind it the count may have begun again.
        for _ in range(self._handed_out):
            if not self._queue or (following - self._queue[0][0] - 1) % modulus >= modulus // 2:
                break
            self._queue.popleft()
        self._handed_out = 0


class WaveformStore:
    """The last whole block, with an id that changes when the block does.

    Without a trigger every block is shown as soon as it is full; with one, a block is begun when the
    trigger is written.
    """

    def __init__(self, unit: ModbusUnit, layout: WaveformLayout) -> None:
        self._unit, self._layout = unit, layout
        self._taking = layout.trigger is None
        self._rows: list[NDArray[np.uint8]] = []
        self._block = b""
        self._id = 0
        self.block_starts: dict[int, int] = {}
        shown = layout.samples * layout.sample_registers if layout.page is None else layout.page.registers
        unit.map(layout.table, layout.block_id, 1)
        unit.map(layout.table, layout.address, shown)
        if layout.trigger is not None:
            unit.watch(layout.trigger.address, lambda _value: self._begin())
        if layout.page is not None:
            unit.watch(layout.page.select, self._show)

    def put(self, first_index: int, rows: NDArray[np.uint8]) -> None:
        """See `SampleStore.put`."""
        for k, row in enumerate(rows):
            if not self._taking:
                continue
            self._rows.append(row)
            if len(self._rows) == self._layout.samples:
                self._finish(first_index + k + 1 - self._layout.samples)

    def _begin(self) -> None:
        if not self._taking:
            self._taking = True
            self._rows = []

    def _finish(self, first_index: int) -> None:
        self._block = np.stack(self._rows).tobytes()
        self._rows = []
        self._taking = self._layout.trigger is None
        self._id = self._id % _LAST_ID + 1
        self.block_starts[self._id] = first_index
        self._unit.put(self._layout.table, self._layout.block_id, self._id.to_bytes(2, "big"))
        self._show(0)

    def _show(self, page: int) -> None:
        if self._layout.page is None:
            window = self._block
        else:
            size = 2 * self._layout.page.registers
            window = self._block[page * size : (page + 1) * size]
        self._unit.put(self._layout.table, self._layout.address, window)


def store_for(unit: ModbusUnit, layout: ModbusLayout) -> SampleStore:
    """A store of samples in a unit, as a layout states."""
    if isinstance(layout, RegistersLayout):
        return TrendStore(unit, layout)
    if isinstance(layout, FifoLayout):
        return FifoStore(unit, layout)
    return RingStore(unit, layout) if isinstance(layout, RingLayout) else WaveformStore(unit, layout)


def encode(layout: ModbusLayout, samples: NDArray[np.float64] | NDArray[np.float32]) -> NDArray[np.uint8]:
    """Registers of samples ``[n, channels]``, saturated as an analogue input does."""
    return RegisterRecord.of(layout).encode(samples, clip=True)
