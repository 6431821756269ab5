"""What a driver brings to the service, registered as an entry point in the group ``daqsvc.drivers``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, TypeVar

from daqsvc.settings.buses import Bus
from daqsvc.settings.packing import PackedLayout
from daqsvc.settings.plugins import BusTable
from daqsvc.settings.problems import AssemblyError
from drivers.frames import FrameLayout

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daqsvc.settings.models import MachineFile
    from daqsvc.settings.packing import Channel, PackedFields
    from drivers.base import BusPort, Driver
    from drivers.fields import Kind


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


def packed_layout(
    given: PackedFields,
    length: int,
    *,
    frame_id: int = 0,
    extended: bool = False,
    any_priority: bool = False,
) -> FrameLayout:
    """The layout of a frame with samples side by side, in the units of the wire.

    Args:
        given: where they lie.
        length: bytes of a frame.
        frame_id: what tells the frames of the stream from others.
        extended: whether that has 29 bits; of CAN frames.
        any_priority: see `FrameLayout`.
    """
    return FrameLayout.plain(
        frame_id=frame_id,
        extended=extended,
        any_priority=any_priority,
        length=length,
        channels=packed(given.channels),
        samples_per_frame=given.samples_per_frame,
        counter_byte=None if given.counter is None else given.counter.byte,
        counter_bits=32 if given.counter is None else given.counter.bits,
        counts="frames" if given.counter is None else given.counter.counts,
        first_byte=given.first_byte,
        crc_byte=given.crc_byte,
        byte_order=given.byte_order,
        valid_raw=raw_limits(given.channels),
    )


def packed(channels: Sequence[Channel]) -> list[tuple[str, int, Kind, float, float]]:
    """See `FrameLayout.plain`."""

    def kind(raw_type: str) -> Kind:
        return "float" if raw_type == "float32" else "unsigned" if raw_type.startswith("u") else "signed"

    return [(c.name, 8 * c.raw_bytes, kind(c.type), c.scale, c.offset) for c in channels]


def raw_limits(channels: Sequence[Channel]) -> dict[str, tuple[float, float]]:
    """By channel, the raw values that are measurements, where not all are."""
    return {c.name: c.valid_raw for c in channels if c.valid_raw is not None}
