"""The ways in which a device on a polled bus hands out samples, and where it keeps them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import reduce
from typing import TYPE_CHECKING, Literal, TypeAlias

from drivers.frames import LayoutError
from drivers.modbus.registers import RegisterRecord, RegisterRun, RunLimits, plan_runs
from drivers.modbus.replies import FIFO_REGISTERS, READ_HOLDING, READ_INPUT

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from drivers.modbus.registers import RegisterField

Table: TypeAlias = Literal["holding", "input"]

FUNCTIONS: dict[Table, int] = {"holding": READ_HOLDING, "input": READ_INPUT}
MAX_REGISTERS = 125
"""Registers that a request can read (Modbus Application Protocol, 6.3 and 6.4)."""


@dataclass(frozen=True)
class TrendLayout:
    """Registers that always show the present values; a sample is what one round of requests reads.

    Attributes:
        unit: address of the unit.
        table: where the registers are.
        record: the quantities; each of its runs is a request.
        limits: how registers may be read together with those of other streams; None if they must not be.
    """

    unit: int
    table: Table
    record: RegisterRecord
    limits: RunLimits | None = None


@dataclass(frozen=True)
class Count:
    """A running count of samples in registers.

    Attributes:
        address: its first register.
        bits: its width; two registers hold 32 bits.
        low_word_first: whether the lower register has the lower half.
    """

    address: int
    bits: Literal[16, 32] = 16
    low_word_first: bool = False

    @property
    def run(self) -> RegisterRun:
        """Its registers."""
        return RegisterRun(self.address, self.bits // 16)

    @property
    def modulus(self) -> int:
        """Counts after which it begins again."""
        return 65_536 if self.bits == 16 else 4_294_967_296

    def decode(self, raw: bytes) -> int:
        """The count in its registers, high byte of each first."""
        if self.low_word_first and self.bits == 32:
            raw = raw[2:4] + raw[:2]
        return int.from_bytes(raw[: self.bits // 8], "big")

    def encode(self, count: int) -> bytes:
        """The registers of a count, high byte of each first."""
        raw = (count % self.modulus).to_bytes(self.bits // 8, "big")
        return raw[2:] + raw[:2] if self.low_word_first and self.bits == 32 else raw


@dataclass(frozen=True)
class Fifo:
    """A queue read by function 24: the count of its first sample, then samples, oldest first.

    Attributes:
        unit: address of the unit.
        address: pointer of the queue.
        count: the count at the head of the queue; its address does not matter.
        record: one sample, its registers counted from 0.
        acknowledge: holding register that is told how far the queue has been taken (the count of the next
            sample, in as many registers); None if the device drops what it has handed out.
        poll_ns: how long to wait before looking again, once there was nothing more to read.
    """

    unit: int
    address: int
    count: Count
    record: RegisterRecord
    acknowledge: int | None = None
    poll_ns: int = 20_000_000

    def __post_init__(self) -> None:
        if self.samples_per_read < 1:
            raise LayoutError(
                f"a sample of {self.record.registers} registers and its count of {self.count.run.count} do "
                f"not fit the {FIFO_REGISTERS} registers of a FIFO reply; read the samples in another way"
            )

    @property
    def samples_per_read(self) -> int:
        """Samples in a reply, at most."""
        return (FIFO_REGISTERS - self.count.run.count) // self.record.registers


@dataclass(frozen=True)
class Ring:
    """A ring of samples in registers, with a count of all samples written so far.

    Sample ``i`` is written to place ``i % depth``, and then the count becomes ``i + 1``.

    Attributes:
        unit: address of the unit.
        table: where the registers are.
        count: the write counter.
        address: first register of place 0.
        depth: places; a power of two, so that the place of a sample is known also when the count wraps.
        record: one sample, its registers counted from 0.
        poll_ns: how long to wait before looking again, once there was nothing more to read.
    """

    unit: int
    table: Table
    count: Count
    address: int
    depth: int
    record: RegisterRecord
    poll_ns: int = 20_000_000

    def __post_init__(self) -> None:
        if self.depth < 2 or self.depth & (self.depth - 1) or self.depth > self.count.modulus // 2:
            raise LayoutError(
                f"a ring of {self.depth} places cannot be followed by a count of {self.count.bits} bits; its "
                f"depth must be a power of two from 2 to {self.count.modulus // 2}"
            )
        if self.record.registers > MAX_REGISTERS:
            raise LayoutError(
                f"a sample of {self.record.registers} registers does not fit a request of {MAX_REGISTERS}; "
                "split the stream"
            )

    @property
    def samples_per_read(self) -> int:
        """Samples in a reply, at most."""
        return MAX_REGISTERS // self.record.registers


@dataclass(frozen=True)
class Page:
    """A window on a block that is too long for the address space.

    Attributes:
        select: holding register that is told which page the window shows, from 0.
        registers: registers in the window.
    """

    select: int
    registers: int


@dataclass(frozen=True)
class Trigger:
    """How to make the device take a block.

    Attributes:
        address: holding register to write.
        value: what to write.
        every_ns: how often to write it.
    """

    address: int
    value: int
    every_ns: int


@dataclass(frozen=True)
class Waveform:
    """A block of samples, taken at once and then kept until the next one replaces it.

    Attributes:
        unit: address of the unit.
        table: where the registers are.
        block_id: register that changes with every block; 0 while there is none.
        address: first register of the block, or of the window on it.
        samples: samples of each channel in a block.
        record: one sample, its registers counted from 0.
        page: the window, if the block is read through one.
        trigger: how to make the device take a block; None if it does so by itself.
        poll_ns: how long to wait before looking again, for the next block.
    """

    unit: int
    table: Table
    block_id: int
    address: int
    samples: int
    record: RegisterRecord
    page: Page | None = None
    trigger: Trigger | None = None
    poll_ns: int = 100_000_000

    @property
    def pages(self) -> tuple[tuple[RegisterRun, ...], ...]:
        """The requests that read each page of a block; without a window there is one page."""
        left = self.samples * self.record.registers
        window = left if self.page is None else self.page.registers
        pages = []
        while left:
            inside = min(left, window)
            pages.append(
                tuple(
                    RegisterRun(self.address + start, min(MAX_REGISTERS, inside - start))
                    for start in range(0, inside, MAX_REGISTERS)
                )
            )
            left -= inside
        return tuple(pages)


ModbusLayout: TypeAlias = TrendLayout | Fifo | Ring | Waveform


def in_units(layout: ModbusLayout, conversion: Mapping[str, tuple[float, float]]) -> ModbusLayout:
    """The same layout in physical units; see `RegisterRecord.in_units`."""
    return replace(layout, record=layout.record.in_units(conversion))


def shared_runs(layouts: Sequence[TrendLayout]) -> tuple[RegisterRun, ...] | None:
    """The requests that read the registers of several streams of one unit and table together.

    Args:
        layouts: of the streams; what one of them must not read is not read for the others either.

    Returns:
        None if that saves no request, or cannot be.
    """
    if len(layouts) < 2 or any(layout.limits is None for layout in layouts):
        return None
    limits = reduce(RunLimits.both, [layout.limits for layout in layouts if layout.limits is not None])
    wanted = [field.run for layout in layouts for field in layout.record.fields]
    try:
        runs = plan_runs(wanted, limits)
    except LayoutError:  # one stream reads what another one must not, or together it is too much at once
        return None
    apart = sum(len(layout.record.runs) for layout in layouts)
    return runs if len(runs) < apart else None


def sample_record(fields: Sequence[RegisterField]) -> RegisterRecord:
    """A record of one sample, from fields whose addresses count from the sample's first register."""
    return RegisterRecord(tuple(fields), (RegisterRun(0, max(field.run.end for field in fields)),))
