"""What a driver brings to the service, registered as an entry point in the group ``daqsvc.drivers``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, TypeVar

from daqsvc.errors.buses import WRONG_LAYOUT
from daqsvc.settings.buses import Bus, Layout
from daqsvc.settings.hooks import contract, may_raise
from daqsvc.settings.packing import PackedLayout
from daqsvc.settings.plugins import BusTable
from daqsvc.settings.problems import AssemblyError
from drivers.base import BusOptionError
from drivers.frames import FrameLayout, LayoutError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daqsvc.settings.models import MachineFile
    from daqsvc.settings.packing import Channel, PackedFields
    from drivers.base import BusPort, Driver
    from drivers.fields import Kind


BusT = TypeVar("BusT", bound=Bus)
LayoutT = TypeVar("LayoutT", bound=Layout)


@contract
class DriverPlugin(BusTable, Generic[BusT]):
    """A kind of driver: the models of its tables, and what makes the driver of a bus.

    Importing one must be cheap: what brings kernels is imported when a driver is made.
    """

    @may_raise(AssemblyError, LayoutError)
    def stream_layout(self, machine: MachineFile, stream: str) -> Any:
        """The layout of a stream as the driver decodes it, straight to the physical units of its sensors.

        Args:
            machine: the machine file.
            stream: name of a stream whose layout is one of `layouts`.

        Raises:
            AssemblyError: no driver decodes this layout.
            LayoutError: a file that it names does not hold what the machine file states.
        """
        layout = machine.streams[stream].layout
        if not isinstance(layout, PackedLayout):
            raise AssemblyError(
                f"{machine.path}: streams.{stream}.layout: no driver decodes {layout.kind}", code=WRONG_LAYOUT
            )
        return packed_layout(in_units(layout, machine, stream), layout.frame_bytes)

    @may_raise(AssemblyError, BusOptionError, LayoutError)
    def absolute(self, machine: MachineFile, bus: BusT) -> BusT:
        """The table of a bus with its paths made absolute; they are relative to the machine file."""
        del machine
        return bus

    @may_raise(AssemblyError, BusOptionError, LayoutError)
    def build(self, bus: BusT, port: BusPort) -> Driver:
        """The driver of a bus. Making it opens nothing.

        Args:
            bus: its table in the machine file, paths made absolute.
            port: its streams, the clock, and where to deliver.

        Raises:
            BusOptionError: an option is of no use; `daqsvc check` does not see that, so prefer `checks`.
            LayoutError: its streams do not fit together.
        """
        raise NotImplementedError


def units_of(machine: MachineFile, stream: str) -> dict[str, tuple[float, float]]:
    """Gain and shift from the wire to the physical unit, by channel of a stream."""
    return {s.channel: (s.gain, s.shift) for s in machine.sensors if s.stream == stream}


def in_units(layout: LayoutT, machine: MachineFile, stream: str) -> LayoutT:
    """The layout of a stream whose channels lead to the physical units of their sensors.

    Channels without a sensor stay in the units of the wire.
    """
    units = units_of(machine, stream)
    channels = []
    for channel in getattr(layout, layout.channels_key):
        gain, shift = units.get(channel.name, (1.0, 0.0))
        turned = {"scale": channel.scale * gain, "offset": channel.offset * gain + shift}
        channels.append(channel.model_copy(update=turned))
    return layout.model_copy(update={layout.channels_key: tuple(channels)})


def packed_layout(
    fields: PackedFields,
    length: int,
    *,
    frame_id: int = 0,
    extended: bool = False,
    any_priority: bool = False,
) -> FrameLayout:
    """The layout of a frame with samples side by side, in the units of the wire.

    Args:
        fields: where they lie.
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
        channels=packed(fields.channels),
        samples_per_frame=fields.samples_per_frame,
        counter_byte=None if fields.counter is None else fields.counter.byte,
        counter_bits=32 if fields.counter is None else fields.counter.bits,
        counts="frames" if fields.counter is None else fields.counter.counts,
        first_byte=fields.first_byte,
        crc_byte=fields.crc_byte,
        byte_order=fields.byte_order,
        valid_raw=raw_limits(fields.channels),
    )


def packed(channels: Sequence[Channel]) -> list[tuple[str, int, Kind, float, float]]:
    """See `FrameLayout.plain`."""

    def kind(raw_type: str) -> Kind:
        return "float" if raw_type == "float32" else "unsigned" if raw_type.startswith("u") else "signed"

    return [(c.name, 8 * c.raw_bytes, kind(c.type), c.scale, c.offset) for c in channels]


def raw_limits(channels: Sequence[Channel]) -> dict[str, tuple[float, float]]:
    """By channel, the raw values that are measurements, where not all are."""
    return {c.name: c.valid_raw for c in channels if c.valid_raw is not None}
