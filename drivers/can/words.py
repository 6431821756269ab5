"""What was understood of CAN buses and of the frames on them, for a person."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.settings.buses import percent
from daqsvc.settings.plugins import StreamWords
from drivers.can.checks import bus_share, frame_facts
from drivers.can.settings import CanBus, DbcLayout, PlainLayout

if TYPE_CHECKING:
    from daqsvc.settings.models import MachineFile


def bus_words(machine: MachineFile, name: str) -> str:
    """See `BusTable.describe_bus`."""
    bus = machine.buses[name]
    assert isinstance(bus, CanBus)  # noqa: S101 - for the type checker
    parts = [f"{'CAN FD' if bus.fd else 'classic CAN'}, {bus.interface} {bus.channel}"]
    if bus.bitrate is not None:
        parts.append(_bit_rate(bus.bitrate))
    if bus.fd and bus.data_bitrate is not None:
        parts.append(f"data {_bit_rate(bus.data_bitrate)}")
    if bus.options:
        parts.append(f"options {' '.join(sorted(bus.options))}")
    streams = [key for key, stream in machine.streams.items() if stream.bus == name]
    loads = [bus_share(machine, key, machine.layout_facts.get(key)) for key in streams]
    known = [load for load in loads if load is not None]
    if loads and len(known) == len(loads):
        load = percent(sum(least for least, _ in known), sum(most for _, most in known))
        parts.append(f"load about {load} of the bus")
    if bus.record is not None:
        parts.append(
            f"recorded as {bus.record.format} in {bus.record.folder}, {bus.record.keep_mb} MB at most"
        )
    return ", ".join(parts)


def stream_words(machine: MachineFile, name: str) -> StreamWords:
    """See `BusTable.describe_stream`."""
    stream = machine.streams[name]
    layout = stream.layout
    assert isinstance(layout, PlainLayout | DbcLayout)  # noqa: S101 - for the type checker
    facts = frame_facts(stream, machine.layout_facts.get(name))
    share = bus_share(machine, name, machine.layout_facts.get(name))
    shown_share = "" if share is None else percent(*share)
    if facts is None:
        return StreamWords(share=shown_share)
    samples = f"{facts.samples_per_frame} x {len(layout.channels)} samples"
    return StreamWords(
        f"{facts.frame_id:#x}",
        f"{stream.rate_hz / facts.samples_per_frame:.4g}/s",
        f"{facts.length} bytes, {samples}",
        "none: by time" if layout.counter is None else f"{facts.counter_bits} bit {layout.counter.counts}",
        shown_share,
    )


def _bit_rate(rate: int) -> str:
    return f"{rate / 1_000_000:g} Mbit/s" if rate >= 1_000_000 else f"{rate / 1000:g} kbit/s"
