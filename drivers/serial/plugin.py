"""The driver of serial ports as a plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from daqsvc.settings.problems import AssemblyError
from drivers.frames import FrameLayout
from drivers.plugin import DriverPlugin, packed, raw_limits, units_of
from drivers.serial.checks import check_serial, check_serial_ports
from drivers.serial.settings import FRAMINGS, CobsBus, LineLayout, LinesBus, SerialBus, SerialLayout, SyncBus

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from daqsvc.settings.buses import Bus, Layout
    from daqsvc.settings.models import MachineFile, Stream
    from daqsvc.settings.problems import Finding, KeyPath
    from drivers.base import BusPort, Driver
    from drivers.serial.lines import TextLayout


class SerialPlugin(DriverPlugin[SerialBus]):
    """Serial ports with binary frames or lines of text."""

    buses: ClassVar[tuple[type[Bus], ...]] = (CobsBus, SyncBus, LinesBus)
    layouts: ClassVar[tuple[type[Layout], ...]] = (LineLayout, SerialLayout)
    self_checks = ("overrun",)
    place = 3

    def bus_of(self, table: Mapping[str, Any]) -> type[Bus]:
        """See `BusTable.bus_of`."""
        framing = table.get("framing")
        return FRAMINGS.get(framing, CobsBus) if isinstance(framing, str) else CobsBus

    def checks(self, draft: MachineFile, facts: Mapping[str, Any]) -> Iterator[Iterator[Finding]]:
        """See `BusTable.checks`."""
        del facts
        yield check_serial_ports(draft)

    def stream_checks(
        self, draft: MachineFile, stream: Stream, facts: Any, at: KeyPath
    ) -> Iterator[Iterator[Finding]]:
        """See `BusTable.stream_checks`."""
        yield check_serial(draft, stream, at)
        del facts

    def stream_layout(self, machine: MachineFile, stream: str) -> FrameLayout | TextLayout:
        """See `DriverPlugin.stream_layout`."""
        return serial_layout(machine, stream)

    def build(self, bus: SerialBus, port: BusPort) -> Driver:
        """See `DriverPlugin.build`."""
        from drivers.serial.driver import SerialDriver  # noqa: PLC0415 - brings compiled kernels

        del bus
        return SerialDriver(port)


def serial_layout(machine: MachineFile, stream: str) -> FrameLayout | TextLayout:
    """The layout of a stream on a serial port, decoding straight to the physical units of its sensors.

    Raises:
        AssemblyError: the stream does not come over one.
    """
    given = machine.streams[stream].layout
    units = units_of(machine, stream)
    if isinstance(given, SerialLayout):
        return _frame_layout(given).in_units(units)
    if isinstance(given, LineLayout):
        from drivers.serial.lines import text_layout  # noqa: PLC0415 - brings compiled kernels

        return text_layout(given).in_units(units)
    raise AssemblyError(f"{machine.path}: stream {stream!r} does not come over a serial port")


def _frame_layout(given: SerialLayout) -> FrameLayout:
    return FrameLayout.plain(
        frame_id=given.stream_id or 0,
        length=given.payload_length,
        channels=packed(given.channels),
        samples_per_frame=given.samples_per_frame,
        counter_byte=given.counter.byte,
        counter_bits=given.counter.bits,
        counts=given.counter.counts,
        first_byte=given.first_byte,
        byte_order=given.byte_order,
        valid_raw=raw_limits(given.channels),
    )
