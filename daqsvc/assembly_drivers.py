"""From a machine file to its buses: layouts and drivers."""

from __future__ import annotations

from dataclasses import replace
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.standing import tell_nobody
from daqsvc.settings.bus_checks import DRIVERS
from daqsvc.settings.buses import CanBus
from daqsvc.settings.modbus import FifoLayout, RegistersLayout, RingLayout, WaveformLayout
from daqsvc.settings.models import DbcLayout, OtherBus, PlainLayout
from daqsvc.settings.problems import AssemblyError
from daqsvc.settings.replay import ReplayBus, TableLayout
from daqsvc.settings.serial import LineLayout as LineSettings
from daqsvc.settings.serial import SerialLayout
from drivers.base import BusOptionError, BusPort, StreamSpec
from drivers.can.dbc import layout_from_dbc
from drivers.frames import FrameLayout, Kind
from drivers.modbus.layouts import (
    Count,
    Fifo,
    ModbusLayout,
    Page,
    Ring,
    TrendLayout,
    Trigger,
    Waveform,
    in_units,
    sample_record,
)
from drivers.modbus.registers import RegisterField, RegisterRecord, RegisterRun, RunLimits, plan_runs
from drivers.replay.files import ColumnLayout
from drivers.serial.lines import TextLayout

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from importlib.metadata import EntryPoint

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.samples import SampleBlock
    from daqsvc.acquisition.standing import Tell
    from daqsvc.settings.modbus import RegisterChannel, SampleChannel
    from daqsvc.settings.models import Channel, DbcChannel, MachineFile
    from drivers.base import Driver

_NS_PER_MS = 1_000_000
_POLL_MS = 100.0
_LOOKS_PER_FILL = 4
"""How often a store of samples in a device is looked at while it fills once."""


def stream_layout(
    machine: MachineFile, stream: str
) -> FrameLayout | ModbusLayout | ColumnLayout | TextLayout:
    """The layout of a stream, of the kind that its bus's driver knows; see `frame_layout`."""
    given = machine.streams[stream].layout
    if isinstance(given, PlainLayout | DbcLayout):
        return frame_layout(machine, stream)
    if isinstance(given, SerialLayout):
        return _serial_layout(given).in_units(_units(machine, stream))
    if isinstance(given, LineSettings):
        return _line_layout(given).in_units(_units(machine, stream))
    if isinstance(given, TableLayout):
        return ColumnLayout(
            channels=given.channel_names,
            columns=tuple(column.column for column in given.columns),
            scale=np.array([column.scale for column in given.columns]),
            offset=np.array([column.offset for column in given.columns]),
        ).in_units(_units(machine, stream))
    return modbus_layout(machine, stream)


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
            valid_raw=_valid_raw(given.channels),
        )
    elif isinstance(given, PlainLayout):
        layout = _plain_layout(given)
    else:
        raise AssemblyError(f"{machine.path}: stream {stream!r} does not come in CAN frames")
    return layout.in_units(_units(machine, stream))


def modbus_layout(machine: MachineFile, stream: str) -> ModbusLayout:
    """The layout of a stream in registers, decoding straight to the physical units of its sensors.

    Raises:
        AssemblyError: the stream does not come in registers.
        LayoutError: the registers cannot be read as the machine file says.
    """
    given = machine.streams[stream].layout
    rate_hz = machine.streams[stream].rate_hz
    layout: ModbusLayout
    if isinstance(given, RegistersLayout):
        fields = tuple(_register_field(c, c.address) for c in given.channels)
        forbidden = tuple(RegisterRun(first, last - first + 1) for first, last in given.forbidden)
        limits = RunLimits(given.max_gap, given.max_count, forbidden)
        runs = plan_runs([field.run for field in fields], limits)
        layout = TrendLayout(given.unit, given.table, RegisterRecord(fields, runs), limits)
    elif isinstance(given, FifoLayout | RingLayout | WaveformLayout):
        layout = _sampled_layout(given, rate_hz)
    else:
        raise AssemblyError(f"{machine.path}: stream {stream!r} does not come in registers")
    return in_units(layout, _units(machine, stream))


def _sampled_layout(given: FifoLayout | RingLayout | WaveformLayout, rate_hz: float) -> ModbusLayout:
    record = sample_record([_register_field(c, c.place) for c in given.channels])
    if isinstance(given, FifoLayout):
        # The place of the count is the head of the queue, not an address.
        count = Count(0, given.count.bits, low_word_first=given.count.low_word_first)
        fifo = Fifo(given.unit, given.address, count, record, given.acknowledge)
        return replace(fifo, poll_ns=_poll_ns(given.poll_ms, fifo.samples_per_read / rate_hz))
    if isinstance(given, RingLayout):
        count = Count(given.count.address, given.count.bits, low_word_first=given.count.low_word_first)
        poll_ns = _poll_ns(given.poll_ms, given.depth / rate_hz)
        return Ring(given.unit, given.table, count, given.address, given.depth, record, poll_ns)
    return Waveform(
        given.unit,
        given.table,
        given.block_id,
        given.address,
        given.samples,
        record,
        None if given.page is None else Page(given.page.select, given.page.registers),
        None
        if given.trigger is None
        else Trigger(given.trigger.address, given.trigger.value, round(given.trigger.every_s * NS_PER_S)),
        _poll_ns(given.poll_ms, given.samples / rate_hz),
    )


def _poll_ns(given_ms: float | None, fill_s: float) -> int:
    """How often to look into a store that is full after ``fill_s``, unless the machine file says it."""
    by_room_ms = min(1000.0 * fill_s / _LOOKS_PER_FILL, _POLL_MS)
    return max(round((by_room_ms if given_ms is None else given_ms) * _NS_PER_MS), _NS_PER_MS)


def _register_field(channel: RegisterChannel | SampleChannel, address: int) -> RegisterField:
    return RegisterField(
        channel.name, address, channel.type, channel.order, channel.bits, channel.scale, channel.offset
    )


def _units(machine: MachineFile, stream: str) -> dict[str, tuple[float, float]]:
    """Gain and shift from the wire to the physical unit, by channel."""
    return {s.channel: (s.gain, s.shift) for s in machine.sensors if s.stream == stream}


def _plain_layout(given: PlainLayout) -> FrameLayout:
    return FrameLayout.plain(
        frame_id=given.id,
        extended=given.extended,
        any_priority=given.any_priority,
        length=given.length,
        channels=_packed(given.channels),
        samples_per_frame=given.samples_per_frame,
        counter_byte=None if given.counter is None else given.counter.byte,
        counter_bits=32 if given.counter is None else given.counter.bits,
        counts="frames" if given.counter is None else given.counter.counts,
        first_byte=given.first_byte,
        crc_byte=given.crc_byte,
        byte_order=given.byte_order,
        valid_raw=_valid_raw(given.channels),
    )


def _serial_layout(given: SerialLayout) -> FrameLayout:
    return FrameLayout.plain(
        frame_id=given.stream_id or 0,
        length=given.payload_length,
        channels=_packed(given.channels),
        samples_per_frame=given.samples_per_frame,
        counter_byte=given.counter.byte,
        counter_bits=given.counter.bits,
        counts=given.counter.counts,
        first_byte=given.first_byte,
        byte_order=given.byte_order,
        valid_raw=_valid_raw(given.channels),
    )


def _line_layout(given: LineSettings) -> TextLayout:
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


def _packed(channels: Sequence[Channel]) -> list[tuple[str, int, Kind, float, float]]:
    def kind(raw_type: str) -> Kind:
        return "float" if raw_type == "float32" else "unsigned" if raw_type.startswith("u") else "signed"

    return [(c.name, 8 * c.raw_bytes, kind(c.type), c.scale, c.offset) for c in channels]


def _valid_raw(channels: Sequence[Channel | DbcChannel]) -> dict[str, tuple[float, float]]:
    return {c.name: c.valid_raw for c in channels if c.valid_raw is not None}


def drivers(
    machine: MachineFile,
    clock: Clock,
    deliver: Callable[[SampleBlock], None],
    tell: Tell = tell_nobody,
) -> list[Driver]:
    """One driver per bus, found by its entry point; see `bus_driver`.

    Raises:
        AssemblyError: a driver cannot be loaded, or cannot use an option.
        LayoutError: see `frame_layout`.
    """
    return [bus_driver(machine, name, clock, deliver, tell=tell) for name in machine.buses]


def bus_driver(
    machine: MachineFile,
    name: str,
    clock: Clock,
    deliver: Callable[[SampleBlock], None],
    changed: Mapping[str, Any] | None = None,
    tell: Tell = tell_nobody,
) -> Driver:
    """The driver of one bus.

    Args:
        machine: the machine file.
        name: the bus.
        clock: the service's clock.
        deliver: see `drivers.base.BusPort`.
        changed: options that are other than in the machine file.
        tell: see `drivers.base.BusPort`.

    Raises:
        AssemblyError, LayoutError: see `drivers`.
    """
    bus = machine.buses[name]
    options: dict[str, Any] = dict(bus.options) if isinstance(bus, OtherBus) else bus.model_dump()
    if isinstance(bus, ReplayBus):
        options["file"] = machine.resolve(bus.file)
    if isinstance(bus, CanBus) and bus.record is not None:
        options["record"]["folder"] = machine.resolve(bus.record.folder)
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
    port = BusPort(name, {**options, **(changed or {})}, streams, clock, deliver, bus.start, tell)
    point = next(iter(entry_points(group=DRIVERS, name=bus.driver)))  # settings/bus_checks.py
    return _driver(point, port, f"{machine.path}: buses.{name}")


def _driver(point: EntryPoint, port: BusPort, bus: str) -> Driver:
    try:
        make: Callable[[BusPort], Driver] = point.load()
    except Exception as error:
        raise AssemblyError(
            f"{bus}.driver = {point.name!r}: it cannot be loaded from {point.value}: {error}; "
            "install the package that brings it again, or remove the bus"
        ) from error
    try:
        return make(port)
    except BusOptionError as error:
        raise AssemblyError(f"{bus}: {error}") from error
