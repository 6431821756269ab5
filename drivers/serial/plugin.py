"""The driver of serial ports as a plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from daqsvc.errors.buses import WRONG_LAYOUT
from daqsvc.settings.problems import AssemblyError
from drivers.frames import FrameLayout
from drivers.plugin import DriverPlugin, in_units, packed, raw_limits
from drivers.serial.checks import check_serial, check_serial_ports, check_suffixes
from drivers.serial.settings import FRAMINGS, CobsBus, LineLayout, LinesBus, SerialBus, SerialLayout, SyncBus

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from daqsvc.settings.buses import Bus, Layout
    from daqsvc.settings.models import MachineFile, Stream
    from daqsvc.settings.problems import Finding, KeyPath
    from drivers.base import BusPort, Driver


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
        yield check_suffixes(draft)

    def stream_checks(
        self, draft: MachineFile, stream: Stream, facts: Any, at: KeyPath
    ) -> Iterator[Iterator[Finding]]:
        """See `BusTable.stream_checks`."""
        yield check_serial(draft, stream, at)
        del facts

    def stream_layout(self, machine: MachineFile, stream: str) -> FrameLayout | LineLayout:
        """See `DriverPlugin.stream_layout`."""
        layout = in_units(machine.streams[stream].layout, machine, stream)
        if isinstance(layout, LineLayout):
            return layout
        if not isinstance(layout, SerialLayout):
            raise AssemblyError(
                f"{machine.path}: stream {stream!r} does not come over a serial port", code=WRONG_LAYOUT
            )
        return FrameLayout.plain(
            frame_id=layout.stream_id or 0,
            length=layout.payload_length,
            channels=packed(layout.channels),
            samples_per_frame=layout.samples_per_frame,
            counter_byte=layout.counter.byte,
            counter_bits=layout.counter.bits,
            counts=layout.counter.counts,
            first_byte=layout.first_byte,
            byte_order=layout.byte_order,
            valid_raw=raw_limits(layout.channels),
        )

    def build(self, bus: SerialBus, port: BusPort) -> Driver:
        """See `DriverPlugin.build`."""
        from drivers.serial.driver import SerialDriver  # noqa: PLC0415 - brings compiled kernels

        return SerialDriver(bus, port)
