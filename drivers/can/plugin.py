"""The CAN driver as a plugin."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any, ClassVar

from daqsvc.settings.section import UnusableValueError
from drivers.can.checks import (
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
)
from drivers.can.dbc_file import check_dbc
from drivers.can.settings import CanBus, DbcLayout, PlainLayout
from drivers.can.words import bus_words, stream_words
from drivers.plugin import DriverPlugin

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from daqsvc.settings.buses import Bus, Layout
    from daqsvc.settings.models import MachineFile, Stream
    from daqsvc.settings.plugins import StreamWords
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
        """See `BusTable.stream_checks`; other drivers say of their layouts that they are not for CAN."""
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
        from drivers.can.build import frame_layout  # noqa: PLC0415 - only the service needs it

        return frame_layout(machine, stream)

    def options(self, machine: MachineFile, bus: CanBus) -> dict[str, Any]:
        """See `DriverPlugin.options`."""
        options = bus.model_dump()
        if bus.record is not None:
            options["record"]["folder"] = machine.resolve(bus.record.folder)
        return options

    def build(self, bus: CanBus, port: BusPort) -> Driver:
        """See `DriverPlugin.build`."""
        from drivers.can.driver import CanDriver  # noqa: PLC0415 - brings python-can

        del bus
        return CanDriver(port)
