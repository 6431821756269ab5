"""What a driver brings to the service, registered as an entry point in the group ``daqsvc.drivers``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, TypeVar

from daqsvc.settings.buses import Bus
from daqsvc.settings.packing import PackedLayout
from daqsvc.settings.plugins import BusTable
from daqsvc.settings.problems import AssemblyError
from drivers.packed import packed_layout

if TYPE_CHECKING:
    from daqsvc.settings.models import MachineFile
    from drivers.base import BusPort, Driver

BusT = TypeVar("BusT", bound=Bus)


class DriverPlugin(BusTable, Generic[BusT]):
    """A kind of driver: the models of its tables, and what makes the driver of a bus.

    Importing one must be cheap: what brings kernels is imported when a driver is made.
    """

    def stream_layout(self, machine: MachineFile, stream: str) -> Any:
        """The layout of a stream as the driver decodes it, straight to the physical units of its sensors.

        Args:
            machine: the machine file.
            stream: name of a stream whose layout is one of `layouts`.

        Raises:
            AssemblyError: no driver decodes this layout.
            LayoutError: a file that it names does not hold what the machine file says.
        """
        given = machine.streams[stream].layout
        if isinstance(given, PackedLayout):
            return packed_layout(given, given.frame_bytes).in_units(units_of(machine, stream))
        raise AssemblyError(f"{machine.path}: streams.{stream}.layout: no driver decodes {given.kind}")

    def options(self, machine: MachineFile, bus: BusT) -> dict[str, Any]:
        """What `BusPort.options` holds: the bus's settings by key, with paths made absolute."""
        del machine
        return bus.model_dump()

    def build(self, bus: BusT, port: BusPort) -> Driver:
        """The driver of a bus. Making it opens nothing.

        Args:
            bus: its table in the machine file.
            port: its streams, the clock, and where to deliver.

        Raises:
            BusOptionError: an option is of no use; `daqsvc check` does not see that, so prefer `checks`.
            LayoutError: its streams do not fit together.
        """
        raise NotImplementedError


def units_of(machine: MachineFile, stream: str) -> dict[str, tuple[float, float]]:
    """Gain and shift from the wire to the physical unit, by channel of a stream."""
    return {s.channel: (s.gain, s.shift) for s in machine.sensors if s.stream == stream}
