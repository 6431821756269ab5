"""The CAN driver as a plugin."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any, ClassVar

from daqsvc.errors.buses import WRONG_LAYOUT
from daqsvc.settings.buses import percent
from daqsvc.settings.packing import samples_in_words
from daqsvc.settings.plugins import StreamWords
from daqsvc.settings.problems import AssemblyError
from daqsvc.settings.section import UnusableValueError
from drivers.can.checks import (
    bus_share,
    check_bus_load,
    check_can_keys,
    check_counter,
    check_dbc_unit,
    check_frame_length,
    check_ids,
    check_interfaces,
    check_plain_layout,
    check_recorded_buses,
    check_signals,
    frame_facts,
)
from drivers.can.dbc import check_dbc, layout_from_dbc
from drivers.can.settings import CanBus, DbcLayout, DbcMessage, PlainLayout
from drivers.plugin import DriverPlugin, in_units, packed_layout, units_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from daqsvc.settings.buses import Bus, Layout
    from daqsvc.settings.models import MachineFile, Stream
    from daqsvc.settings.problems import Finding, KeyPath
    from drivers.base import BusPort, Driver
    from drivers.frames import FrameLayout


class CanPlugin(DriverPlugin[CanBus]):
    """CAN and CAN FD buses, with layouts from the machine file or a DBC file."""

    buses: ClassVar[tuple[type[Bus], ...]] = (CanBus,)
    layouts: ClassVar[tuple[type[Layout], ...]] = (PlainLayout, DbcLayout)
    self_checks = ("overrun", "controller", "recording")
    place = 1

    def layout_of(self, table: Mapping[str, Any]) -> type[Layout] | None:
        """See `BusTable.layout_of`."""
        return DbcLayout if DbcLayout.mark in table else None

    def read_files(self, layout: Layout, folder: Path, at: KeyPath) -> tuple[Any, list[Finding]]:
        """See `BusTable.read_files`: the message of a DBC file."""
        if not isinstance(layout, DbcLayout):
            return None, []
        return check_dbc(layout, (folder / layout.dbc).absolute(), at)

    def checks(self, draft: MachineFile, facts: Mapping[str, Any]) -> Iterator[Iterator[Finding]]:
        """See `BusTable.checks`."""
        yield check_ids(draft, facts)
        yield check_bus_load(draft, facts)
        yield check_interfaces(draft)
        yield check_can_keys(draft)
        yield check_recorded_buses(draft)
        for index, sensor in enumerate(draft.sensors):
            yield check_dbc_unit(draft, sensor, facts, ("sensors", index))

    def stream_checks(
        self, draft: MachineFile, stream: Stream, facts: Any, at: KeyPath
    ) -> Iterator[Iterator[Finding]]:
        """See `BusTable.stream_checks`; other drivers report that their layouts are not for CAN."""
        yield check_frame_length(draft, stream, facts, at)
        yield check_counter(stream, facts, at)
        with suppress(UnusableValueError):
            if isinstance(stream.layout, PlainLayout):
                yield check_plain_layout(stream.layout, (*at, "layout"))
            if isinstance(stream.layout, DbcLayout):
                yield check_signals(stream.layout, (*at, "layout"))

    def describe_bus(self, machine: MachineFile, name: str) -> str:
        """See `BusTable.describe_bus`."""
        return bus_words(machine, name)

    def describe_stream(self, machine: MachineFile, name: str) -> StreamWords:
        """See `BusTable.describe_stream`."""
        return stream_words(machine, name)

    def stream_layout(self, machine: MachineFile, stream: str) -> FrameLayout:
        """See `DriverPlugin.stream_layout`."""
        return frame_layout(machine, stream)

    def absolute(self, machine: MachineFile, bus: CanBus) -> CanBus:
        """See `DriverPlugin.absolute`."""
        if bus.record is None:
            return bus
        record = bus.record.model_copy(update={"folder": machine.resolve(bus.record.folder)})
        return bus.model_copy(update={"record": record})

    def build(self, bus: CanBus, port: BusPort) -> Driver:
        """See `DriverPlugin.build`."""
        from drivers.can.driver import CanDriver  # noqa: PLC0415 - brings python-can

        return CanDriver(bus, port)


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
    samples = samples_in_words(facts.samples_per_frame, len(layout.channels))
    channels: tuple[tuple[str, ...], ...] = ()
    message = machine.layout_facts.get(name)
    if isinstance(layout, DbcLayout) and isinstance(message, DbcMessage):
        channels = tuple(_absent_by_j1939(layout, message))
    return StreamWords(
        f"{facts.frame_id:#x}",
        f"{stream.rate_hz / facts.samples_per_frame:.4g}/s",
        f"{facts.length} bytes, {samples}",
        "none: by time" if layout.counter is None else f"{facts.counter_bits} bit {layout.counter.counts}",
        shown_share,
        (("channel", "signals", "no value (SAE J1939)"), *channels) if channels else (),
    )


def _absent_by_j1939(layout: DbcLayout, message: DbcMessage) -> Iterator[tuple[str, ...]]:
    """Rows on the channels whose highest raw values are no measurements by SAE J1939."""
    for channel in layout.channels:
        valid = {message.valid_raw.get(signal) for signal in channel.signals}
        if channel.valid_raw is None and len(valid) == 1 and (only := valid.pop()) is not None:
            yield channel.name, ", ".join(channel.signals), f"raw values above 0x{int(only[1]):X}"


def _bit_rate(rate: int) -> str:
    return f"{rate / 1_000_000:g} Mbit/s" if rate >= 1_000_000 else f"{rate / 1000:g} kbit/s"


def frame_layout(machine: MachineFile, stream: str) -> FrameLayout:
    """The layout of a stream of CAN frames, decoding straight to the physical units of its sensors.

    Raises:
        AssemblyError: the stream does not come in CAN frames.
        LayoutError: the DBC file does not hold what the machine file states.
    """
    layout = machine.streams[stream].layout
    if isinstance(layout, DbcLayout):
        return layout_from_dbc(
            machine.resolve(layout.dbc),
            layout.message,
            counter=None if layout.counter is None else layout.counter.signal,
            counts="frames" if layout.counter is None else layout.counter.counts,
            channels={channel.name: channel.signals for channel in layout.channels},
            valid_raw={c.name: c.valid_raw for c in layout.channels if c.valid_raw is not None},
            units=units_of(machine, stream),
        )
    if isinstance(layout, PlainLayout):
        return packed_layout(
            in_units(layout, machine, stream),
            layout.length,
            frame_id=layout.id,
            extended=layout.extended,
            any_priority=layout.any_priority,
        )
    raise AssemblyError(f"{machine.path}: stream {stream!r} does not come in CAN frames", code=WRONG_LAYOUT)
