"""Whether this computer has what the buses of a machine file need."""

from __future__ import annotations

from contextlib import suppress
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from daqsvc.settings.buses import CanBus
from daqsvc.settings.problems import Finding, choice
from daqsvc.settings.section import UnusableValueError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.settings.models import MachineFile

DRIVERS = "daqsvc.drivers"
"""The group of entry points that drivers are registered in."""


def check_drivers(draft: MachineFile) -> Iterator[Finding]:
    """The drivers of the buses are installed."""
    installed = {point.name for point in entry_points(group=DRIVERS)}
    for name, bus in draft.buses.items():
        with suppress(UnusableValueError):
            if bus.driver not in installed:
                yield Finding(
                    ("buses", name, "driver"),
                    "no such driver is installed",
                    f"{choice(bus.driver, installed)}; or install the package that brings it",
                )


def check_interfaces(draft: MachineFile) -> Iterator[Finding]:
    """python-can, or a plugin of it, knows the interfaces of the CAN buses."""
    # Imported here: it is slow, and nothing else in the settings needs it.
    from can.interfaces import BACKENDS  # noqa: PLC0415

    for name, bus in draft.buses.items():
        with suppress(UnusableValueError):
            if isinstance(bus, CanBus) and bus.interface not in BACKENDS:
                yield Finding(
                    ("buses", name, "interface"),
                    "python-can knows no such interface",
                    f"{choice(bus.interface, BACKENDS)}; or install the python-can plugin that brings it",
                )
            elif isinstance(bus, CanBus) and bus.interface == "socketcan" and bus.options:
                yield Finding(
                    ("buses", name, "options"),
                    "mean nothing to SocketCAN",
                    f"remove {', '.join(bus.options)}; set the interface up by `ip link set {bus.channel}`",
                )
