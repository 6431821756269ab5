"""From a machine file to the drivers of its buses."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

from daqsvc.acquisition.standing import tell_nobody
from daqsvc.errors.buses import BUS_OPTION
from daqsvc.settings.hooks import failing_in
from daqsvc.settings.problems import AssemblyError
from daqsvc.settings.registry import bus_tables, driver_of_layout
from drivers.base import BusOptionError, BusPort, StreamSpec

if TYPE_CHECKING:
    from collections.abc import Callable

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.samples import SampleBlock
    from daqsvc.acquisition.standing import Tell
    from daqsvc.settings.models import MachineFile
    from drivers.base import Driver
    from drivers.plugin import DriverPlugin

_NS_PER_MS = 1_000_000


def stream_layout(machine: MachineFile, stream: str) -> Any:
    """The layout of a stream, of the kind that its bus's driver knows; see `DriverPlugin.stream_layout`.

    Raises:
        AssemblyError, LayoutError: see `DriverPlugin.stream_layout`.
    """
    plugin = cast("DriverPlugin[Any]", driver_of_layout(machine.streams[stream].layout))
    return plugin.stream_layout(machine, stream)


def bus_self_checks(machine: MachineFile) -> dict[str, tuple[str, ...]]:
    """What the service can watch of each bus; see `BusTable.self_checks`."""
    return {name: bus_tables()[bus.driver].self_checks for name, bus in machine.buses.items()}


def bus_drivers(
    machine: MachineFile,
    clock: Clock,
    deliver: Callable[[SampleBlock], None],
    tell: Tell = tell_nobody,
) -> list[Driver]:
    """One driver per bus; see `bus_driver`.

    Raises:
        AssemblyError, LayoutError: see `bus_driver`.
    """
    return [bus_driver(machine, name, clock, deliver, tell) for name in machine.buses]


def bus_driver(
    machine: MachineFile,
    name: str,
    clock: Clock,
    deliver: Callable[[SampleBlock], None],
    tell: Tell = tell_nobody,
    *,
    at_start: bool = True,
) -> Driver:
    """The driver of one bus.

    Args:
        machine: the machine file.
        name: the bus.
        clock: the service's clock.
        deliver: see `drivers.base.BusPort`.
        tell: see `drivers.base.BusPort`.
        at_start: whether the service starts; one that runs does not end because a device is absent.

    Raises:
        AssemblyError: a driver cannot use an option, or fails when it is made.
        LayoutError: see `DriverPlugin.stream_layout`.
    """
    bus = machine.buses[name]
    plugin = cast("DriverPlugin[Any]", bus_tables()[bus.driver])
    port = bus_port(machine, name, clock, deliver, tell)
    if not at_start and port.start == "error":
        port = replace(port, start="retry")
    try:
        with failing_in(machine.path, f"buses.{name}"):
            return plugin.build(plugin.absolute(machine, bus), port)
    except BusOptionError as error:
        raise AssemblyError(f"{machine.path}: buses.{name}: {error}", code=BUS_OPTION) from error


def bus_port(
    machine: MachineFile,
    name: str,
    clock: Clock,
    deliver: Callable[[SampleBlock], None],
    tell: Tell = tell_nobody,
) -> BusPort:
    """What the driver of one bus is given beside its table; see `bus_driver`."""
    streams = [
        StreamSpec(
            stream_name,
            stream_layout(machine, stream_name),
            stream.rate_hz,
            round(stream.reorder_window_ms * _NS_PER_MS),
        )
        for stream_name, stream in machine.streams.items()
        if stream.bus == name
    ]
    return BusPort(name, streams, clock, deliver, machine.buses[name].start, tell)
