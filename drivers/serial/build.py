"""From the layouts of serial frames and lines in a machine file to what decodes them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.settings.problems import AssemblyError
from drivers.frames import FrameLayout
from drivers.packed import packed, raw_limits
from drivers.plugin import units_of
from drivers.serial.lines import TextLayout
from drivers.serial.settings import LineLayout, SerialLayout

if TYPE_CHECKING:
    from daqsvc.settings.models import MachineFile


def serial_layout(machine: MachineFile, stream: str) -> FrameLayout | TextLayout:
    """The layout of a stream on a serial port, decoding straight to the physical units of its sensors.

    Raises:
        AssemblyError: the stream does not come over one.
    """
    given = machine.streams[stream].layout
    units = units_of(machine, stream)
    if isinstance(given, SerialLayout):
        return _frame_layout(given).in_units(units)
    if isinstance(given, LineLayout):
        return _line_layout(given).in_units(units)
    raise AssemblyError(f"{machine.path}: stream {stream!r} does not come over a serial port")


def _frame_layout(given: SerialLayout) -> FrameLayout:
    return FrameLayout.plain(
        frame_id=given.stream_id or 0,
        length=given.payload_length,
        channels=packed(given.channels),
        samples_per_frame=given.samples_per_frame,
        counter_byte=given.counter.byte,
        counter_bits=given.counter.bits,
        counts=given.counter.counts,
        first_byte=given.first_byte,
        byte_order=given.byte_order,
        valid_raw=raw_limits(given.channels),
    )


def _line_layout(given: LineLayout) -> TextLayout:
    return TextLayout(
        columns=given.line,
        channels=given.channel_names,
        scale=np.array([channel.scale for channel in given.channels]),
        offset=np.array([channel.offset for channel in given.channels]),
        counter=None if given.counter is None else given.counter.column,
        counter_bits=32 if given.counter is None else given.counter.bits,
        time=None if given.time is None else given.time.column,
        time_unit="ms" if given.time is None else given.time.unit,
        prefix=given.prefix,
        separator=given.separator,
    )
