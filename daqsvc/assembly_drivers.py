"""From a machine file to its buses: layouts and drivers."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

from daqsvc.settings.models import CanBus, DbcLayout, PlainLayout
from drivers.base import BusPort, StreamSpec
from drivers.dbc import layout_from_dbc
from drivers.frames import FrameLayout, Kind

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.samples import SampleBlock
    from daqsvc.settings.models import MachineFile
    from drivers.base import Driver

DRIVERS = "daqsvc.drivers"
_NS_PER_MS = 1_000_000


class AssemblyError(Exception):
    """A machine file that is sound by itself asks for something that is not there."""


def frame_layout(machine: MachineFile, stream: str) -> FrameLayout:
    """The layout of a stream, decoding straight to the physical units of its sensors.

    Raises:
        LayoutError: the DBC file does not hold what the machine file says.
    """
    given = machine.streams[stream].layout
    if isinstance(given, DbcLayout):
        layout = layout_from_dbc(
            machine.resolve(given.dbc),
            given.message,
            counter=given.counter.signal,
            counts=given.counter.counts,
            channels={channel.name: channel.signals for channel in given.channels},
        )
    else:
        layout = _plain_layout(given)
    units = {s.channel: (s.gain, s.shift) for s in machine.sensors if s.stream == stream}
    return layout.in_units(units)


def _plain_layout(given: PlainLayout) -> FrameLayout:
    def kind(raw_type: str) -> Kind:
        return "float" if raw_type == "float32" else "unsigned" if raw_type.startswith("u") else "signed"

    return FrameLayout.plain(
        frame_id=given.id,
        extended=given.extended,
        length=given.length,
        channels=[(c.name, 8 * c.raw_bytes, kind(c.type), c.scale, c.offset) for c in given.channels],
        samples_per_frame=given.samples_per_frame,
        counter_byte=given.counter.byte,
        counter_bits=given.counter.bits,
        counts=given.counter.counts,
        first_byte=given.first_byte,
        crc_byte=given.crc_byte,
        byte_order=given.byte_order,
    )


def drivers(machine: MachineFile, clock: Clock, deliver: Callable[[SampleBlock], None]) -> list[Driver]:
    """One driver per bus, found by its entry point.

    Raises:
        AssemblyError: no driver of that name is installed.
        LayoutError: see `frame_layout`.
    """
    installed = {point.name: point for point in entry_points(group=DRIVERS)}
    made: list[Driver] = []
    for name, bus in machine.buses.items():
        if bus.driver not in installed:
            raise AssemblyError(
                f"{machine.path}: buses.{name}.driver = {bus.driver!r}: no such driver is installed; "
                f"there are {', '.join(sorted(installed)) or 'none'}. "
                "Install the package that brings it, or correct the name"
            )
        options: Mapping[str, Any] = bus.model_dump() if isinstance(bus, CanBus) else bus.options
        streams = [
            StreamSpec(
                stream_name,
                frame_layout(machine, stream_name),
                stream.rate_hz,
                round(stream.reorder_window_ms * _NS_PER_MS),
            )
            for stream_name, stream in machine.streams.items()
            if stream.bus == name
        ]
        port = BusPort(name, options, streams, clock, deliver, bus.start)
        made.append(installed[bus.driver].load()(port))
    return made
