"""Layouts of Modbus registers as machine files have them, in few words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from drivers.modbus.settings import (
    BlockPage,
    BlockTrigger,
    FifoLayout,
    RegisterChannel,
    RegisterCount,
    RegistersLayout,
    RingLayout,
    SampleChannel,
    WaveformLayout,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from drivers.modbus.settings import RegisterType, Table

NS_PER_MS = 1_000_000


def register(
    name: str, address: int, kind: RegisterType, order: str = "ABCD", **more: Any
) -> RegisterChannel:
    """A number at an address."""
    channel = {"name": name, "address": address, "type": kind, "order": order, **more}
    return RegisterChannel.model_validate(channel)


def in_sample(name: str, place: int, kind: RegisterType) -> SampleChannel:
    """A number in a sample."""
    return SampleChannel(name=name, place=place, type=kind)


def count_at(address: int, bits: int = 16, *, low_word_first: bool = False) -> RegisterCount:
    """A running count."""
    return RegisterCount.model_validate({"address": address, "bits": bits, "low_word_first": low_word_first})


def registers_layout(
    unit: int, table: Table, channels: Sequence[RegisterChannel], *, max_gap: int = 0, **more: Any
) -> RegistersLayout:
    """Numbers that are polled; neighbours share a request."""
    layout = {"way": "registers", "unit": unit, "table": table, "channels": channels, "max_gap": max_gap}
    return RegistersLayout.model_validate(layout | more)


def fifo_layout(
    unit: int,
    address: int,
    count: RegisterCount,
    channels: Sequence[SampleChannel],
    acknowledge: int | None = None,
    poll_ns: int = 20_000_000,
) -> FifoLayout:
    """A queue that is read by function 24; the address of its count does not matter."""
    return FifoLayout(
        way="fifo",
        unit=unit,
        address=address,
        count=count,
        channels=tuple(channels),
        acknowledge=acknowledge,
        poll_ms=poll_ns / NS_PER_MS,
    )


def ring_layout(
    unit: int,
    table: Table,
    count: RegisterCount,
    address: int,
    depth: int,
    channels: Sequence[SampleChannel],
    poll_ns: int = 20_000_000,
) -> RingLayout:
    """A ring of samples and its write counter."""
    return RingLayout(
        way="ring",
        unit=unit,
        table=table,
        count=count,
        address=address,
        depth=depth,
        channels=tuple(channels),
        poll_ms=poll_ns / NS_PER_MS,
    )


def waveform_layout(
    unit: int,
    table: Table,
    block_id: int,
    address: int,
    samples: int,
    channels: Sequence[SampleChannel],
    page: BlockPage | None = None,
    trigger: BlockTrigger | None = None,
    poll_ns: int = 100_000_000,
) -> WaveformLayout:
    """Blocks of samples, whole or page by page."""
    return WaveformLayout(
        way="waveform",
        unit=unit,
        table=table,
        block_id=block_id,
        address=address,
        samples=samples,
        channels=tuple(channels),
        page=page,
        trigger=trigger,
        poll_ms=poll_ns / NS_PER_MS,
    )


def page_at(select: int, registers: int) -> BlockPage:
    """A window on a block."""
    return BlockPage(select=select, registers=registers)


def trigger_at(address: int, value: int, every_s: float) -> BlockTrigger:
    """What makes a device take a block."""
    return BlockTrigger(address=address, value=value, every_s=every_s)
