"""The Modbus driver as a plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from daqsvc.settings.buses import percent
from daqsvc.settings.plugins import StreamWords
from drivers.modbus.checks import check_line_load, check_modbus, check_no_value, check_writes_and_samples
from drivers.modbus.load import line_load
from drivers.modbus.settings import (
    WAYS,
    FifoLayout,
    ModbusRtuBus,
    ModbusTcpBus,
    RegistersLayout,
    RingLayout,
    WaveformLayout,
)
from drivers.plugin import DriverPlugin, in_units

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from daqsvc.settings.buses import Bus, Layout
    from daqsvc.settings.models import MachineFile, Stream
    from daqsvc.settings.problems import Finding, KeyPath
    from drivers.base import BusPort, Driver
    from drivers.modbus.settings import ModbusBus


class ModbusPlugin(DriverPlugin["ModbusBus"]):
    """Modbus lines, TCP and RTU, and the ways in which devices on them hand out samples."""

    buses: ClassVar[tuple[type[Bus], ...]] = (ModbusTcpBus, ModbusRtuBus)
    layouts: ClassVar[tuple[type[Layout], ...]] = tuple(WAYS.values())
    place = 2

    def bus_of(self, table: Mapping[str, Any]) -> type[Bus]:
        """See `BusTable.bus_of`."""
        return ModbusRtuBus if table.get("transport") == "rtu" else ModbusTcpBus

    def layout_of(self, table: Mapping[str, Any]) -> type[Layout] | None:
        """See `BusTable.layout_of`."""
        if RegistersLayout.mark not in table:
            return None
        way = table[RegistersLayout.mark]
        return WAYS.get(way, RegistersLayout) if isinstance(way, str) else RegistersLayout

    def checks(self, draft: MachineFile, facts: Mapping[str, Any]) -> Iterator[Iterator[Finding]]:
        """See `BusTable.checks`."""
        del facts
        yield check_line_load(draft)
        yield check_no_value(draft)
        yield check_writes_and_samples(draft)

    def stream_checks(
        self, draft: MachineFile, stream: Stream, facts: Any, at: KeyPath
    ) -> Iterator[Iterator[Finding]]:
        """See `BusTable.stream_checks`."""
        del facts
        yield check_modbus(draft, stream, at)

    def describe_bus(self, machine: MachineFile, name: str) -> str:
        """See `BusTable.describe_bus`."""
        bus = machine.buses[name]
        if not isinstance(bus, ModbusRtuBus):
            return bus.summary
        load = line_load(machine, name, bus)
        return f"{bus.summary}, load about {percent(load.least, load.usual)} of the line"

    def describe_stream(self, machine: MachineFile, name: str) -> StreamWords:
        """See `BusTable.describe_stream`."""
        from drivers.modbus.channel_table import channel_table  # noqa: PLC0415 - only for who checks

        layout = machine.streams[name].layout
        assert isinstance(layout, RegistersLayout | FifoLayout | RingLayout | WaveformLayout)  # noqa: S101 - for the type checker
        return StreamWords(frame=layout.summary, channels=channel_table(layout))

    def stream_layout(self, machine: MachineFile, stream: str) -> Layout:
        """See `DriverPlugin.stream_layout`."""
        return in_units(machine.streams[stream].layout, machine, stream)

    def build(self, bus: ModbusBus, port: BusPort) -> Driver:
        """See `DriverPlugin.build`."""
        from drivers.modbus.driver import ModbusDriver  # noqa: PLC0415 - brings pymodbus

        return ModbusDriver(bus, port)
