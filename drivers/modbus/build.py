"""From the layouts of registers in a machine file to what reads them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.settings.problems import AssemblyError
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
from drivers.modbus.settings import FifoLayout, RegistersLayout, RingLayout, WaveformLayout
from drivers.plugin import units_of

if TYPE_CHECKING:
    from daqsvc.settings.models import MachineFile
    from drivers.modbus.settings import RegisterChannel, SampleChannel

_NS_PER_MS = 1_000_000
_POLL_MS = 100.0
_LOOKS_PER_FILL = 4
"""How often a store of samples in a device is looked at while it fills once."""


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
    return in_units(layout, units_of(machine, stream))


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
