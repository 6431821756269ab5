"""From the layouts of CAN frames in a machine file to what decodes them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.settings.problems import AssemblyError
from drivers.can.dbc import layout_from_dbc
from drivers.can.settings import DbcLayout, PlainLayout
from drivers.packed import packed_layout
from drivers.plugin import units_of

if TYPE_CHECKING:
    from daqsvc.settings.models import MachineFile
    from drivers.frames import FrameLayout


def frame_layout(machine: MachineFile, stream: str) -> FrameLayout:
    """The layout of a stream of CAN frames, decoding straight to the physical units of its sensors.

    Raises:
        AssemblyError: the stream does not come in CAN frames.
        LayoutError: the DBC file does not hold what the machine file says.
    """
    given = machine.streams[stream].layout
    if isinstance(given, DbcLayout):
        layout = layout_from_dbc(
            machine.resolve(given.dbc),
            given.message,
            counter=None if given.counter is None else given.counter.signal,
            counts="frames" if given.counter is None else given.counter.counts,
            channels={channel.name: channel.signals for channel in given.channels},
            valid_raw={c.name: c.valid_raw for c in given.channels if c.valid_raw is not None},
        )
    elif isinstance(given, PlainLayout):
        layout = packed_layout(
            given,
            given.length,
            frame_id=given.id,
            extended=given.extended,
            any_priority=given.any_priority,
        )
    else:
        raise AssemblyError(f"{machine.path}: stream {stream!r} does not come in CAN frames")
    return layout.in_units(units_of(machine, stream))
