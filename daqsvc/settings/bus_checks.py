"""Whether the drivers of the buses are there, and each bus has its device for itself."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from daqsvc.settings.problems import Finding, choice
from daqsvc.settings.registry import broken_drivers, bus_tables
from daqsvc.settings.section import UnusableValueError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.settings.models import MachineFile


def check_drivers(draft: MachineFile) -> Iterator[Finding]:
    """The drivers of the buses are installed, and can be loaded."""
    installed, broken = bus_tables(), broken_drivers()
    for name, bus in draft.buses.items():
        with suppress(UnusableValueError):
            at = ("buses", name, "driver")
            if bus.driver in broken:
                remedy = f"install the package that brings it again, or remove [buses.{name}]"
                yield Finding(at, broken[bus.driver], remedy)
            elif bus.driver not in installed:
                remedy = f"{choice(bus.driver, installed)}; or install the package that brings it"
                yield Finding(at, "no such driver is installed", remedy)


def check_devices(draft: MachineFile) -> Iterator[Finding]:
    """No device belongs to two buses."""
    owners: dict[object, str] = {}
    for name, bus in draft.buses.items():
        with suppress(UnusableValueError):
            device = bus.device
            owner = name if device is None else owners.setdefault(device.identity, name)
            if device is not None and owner != name:
                yield Finding(("buses", name, device.key), f'belongs to bus "{owner}" already', device.remedy)


def check_unused(draft: MachineFile) -> Iterator[Finding]:
    """Streams come over every bus."""
    used = {stream.bus for stream in draft.streams.values()}
    for name in draft.buses:
        if name not in used:
            yield Finding(
                ("buses", name), "no stream comes over this bus", "remove it, or add its streams", fatal=False
            )
