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
    from daqsvc.settings.problems import KeyPath

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


def check_can_owners(draft: MachineFile) -> Iterator[Finding]:
    """No interface belongs to two buses: each would take the other's frames for foreign ones."""
    owners: dict[tuple[str, str], str] = {}
    for name, bus in draft.buses.items():
        with suppress(UnusableValueError):
            if not isinstance(bus, CanBus):
                continue
            owner = owners.setdefault((bus.interface, bus.channel), name)
            if owner != name:
                yield Finding(
                    ("buses", name, "channel"),
                    f'belongs to bus "{owner}" already',
                    "put all streams of the interface on one bus, or correct the channel",
                )


def check_can_keys(draft: MachineFile) -> Iterator[Finding]:
    """What is said of a CAN bus has an effect, and goes together."""
    for name, bus in draft.buses.items():
        with suppress(UnusableValueError):
            if not isinstance(bus, CanBus):
                continue
            at: KeyPath = ("buses", name)
            if bus.data_bitrate is not None and not bus.fd:
                yield Finding(
                    (*at, "data_bitrate"),
                    "has no effect on classic CAN",
                    "write fd = true if CAN FD frames are on the bus, or remove it",
                    fatal=False,
                )
            elif bus.data_bitrate is not None and bus.bitrate is not None and bus.data_bitrate < bus.bitrate:
                yield Finding(
                    (*at, "data_bitrate"),
                    f"is less than bitrate = {bus.bitrate:,}, and the data of CAN FD never go slower",
                    "swap the two, or correct one of them",
                )
            if bus.interface == "socketcan":
                continue
            for key in ("filter", "receive_buffer_bytes"):
                if key in bus.model_fields_set:
                    yield Finding(
                        (*at, key),
                        f'has no effect with interface "{bus.interface}", only with SocketCAN',
                        "remove it",
                        fatal=False,
                    )
