"""Whether what a machine file says of Modbus lines and of the layouts on them fits together."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from daqsvc.settings.buses import BUSY
from daqsvc.settings.problems import Finding
from daqsvc.settings.section import UnusableValueError
from drivers.modbus.load import USUAL_ANSWER_S, line_load
from drivers.modbus.overlaps import check_channel_overlaps
from drivers.modbus.settings import (
    FIFO_REGISTERS,
    MAX_REGISTERS,
    FifoLayout,
    ModbusRtuBus,
    ModbusTcpBus,
    RegistersLayout,
    RingLayout,
    WaveformLayout,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.settings.models import MachineFile, Stream
    from daqsvc.settings.problems import KeyPath
    from drivers.modbus.settings import ModbusLayout

ADDRESSES = 65_536
_LAYOUTS = (RegistersLayout, FifoLayout, RingLayout, WaveformLayout)
_BUSES = (ModbusTcpBus, ModbusRtuBus)


def check_modbus(draft: MachineFile, stream: Stream, at: KeyPath) -> Iterator[Finding]:
    """The layout belongs to the bus, its registers exist, and what it must write may be written."""
    bus, layout = draft.buses.get(stream.bus), stream.layout
    if isinstance(layout, _LAYOUTS) != isinstance(bus, _BUSES):
        if isinstance(bus, _BUSES):
            yield Finding(
                (*at, "layout"),
                "is not one of registers, and its bus is a Modbus line",
                'write way = "registers", "fifo", "ring" or "waveform", and unit',
            )
        elif isinstance(layout, _LAYOUTS) and bus is not None:
            yield Finding(
                (*at, "layout"),
                f'is one of registers, but bus "{stream.bus}" is no Modbus line',
                'correct bus, or write driver = "modbus" and transport in its table',
            )
        return
    if not isinstance(layout, _LAYOUTS) or not isinstance(bus, _BUSES):
        return
    path: KeyPath = (*at, "layout")
    if isinstance(bus, ModbusRtuBus) and not 1 <= layout.unit <= 247:
        yield Finding(
            (*path, "unit"), "is no address of a unit on a serial line", "take 1 to 247, as set in the unit"
        )
    yield from _check_bits(layout, path)
    yield from check_channel_overlaps(layout, path)
    yield from _check_room(layout, path)
    yield from _check_writes(bus, stream.bus, layout, path)


def check_line_load(draft: MachineFile) -> Iterator[Finding]:
    """A serial line has time for all that it is asked."""
    for name, bus in draft.buses.items():
        with suppress(UnusableValueError):
            if not isinstance(bus, ModbusRtuBus):
                continue
            load = line_load(draft, name, bus)
            asked = f"{load.requests_per_s:.3g} requests a second take {100 * load.least:.3g} % of its time"
            remedy = "poll more seldom, let requests read more at once (max_gap), or use a faster line"
            if load.least > 1.0:
                yield Finding(
                    ("buses", name, "baud"),
                    f"is too slow: {asked} at least, with units that answer at once",
                    remedy,
                )
            elif load.usual > BUSY:
                yield Finding(
                    ("buses", name, "baud"),
                    f"leaves little room: {asked}, and {100 * load.usual:.3g} % if units answer after "
                    f"{1e3 * USUAL_ANSWER_S:g} ms; what does not fit is lost, and a request without reply "
                    "holds all others up",
                    remedy,
                    fatal=False,
                )


def _check_bits(layout: ModbusLayout, path: KeyPath) -> Iterator[Finding]:
    for index, channel in enumerate(layout.channels):
        if channel.bits is None:
            continue
        lowest, width = channel.bits
        if (
            not channel.type.startswith("u")
            or lowest < 0
            or width < 1
            or lowest + width > 16 * channel.registers
        ):
            yield Finding(
                (*path, "channels", index, "bits"),
                f"are no part of {channel.type}",
                "write [lowest bit, number of bits] of an unsigned type that holds them, e.g. [0, 4]",
            )


def _check_room(layout: ModbusLayout, path: KeyPath) -> Iterator[Finding]:
    """Samples fit a request, and the registers the address space; forbidden ones are not wanted."""
    if isinstance(layout, RegistersLayout):
        yield from _check_forbidden(layout, path)
        return
    width = layout.sample_registers
    room = FIFO_REGISTERS - layout.count.bits // 16 if isinstance(layout, FifoLayout) else MAX_REGISTERS
    if width > room and not isinstance(layout, WaveformLayout):
        yield Finding(
            (*path, "channels"),
            f"take {width} registers a sample, and a reply has room for {room}",
            "leave out channels, or read them in another way",
        )
    if isinstance(layout, RingLayout):
        end = layout.address + layout.depth * width
        if layout.depth > 2**layout.count.bits // 2:
            yield Finding(
                (*path, "depth"),
                f"is more than half of what a count of {layout.count.bits} bits can tell",
                "write count = { ..., bits = 32 }, if the device has it",
            )
    elif isinstance(layout, WaveformLayout):
        registers = layout.samples * width if layout.page is None else layout.page.registers
        end = layout.address + registers
    else:
        return
    if end > ADDRESSES:
        yield Finding(
            (*path, "address"),
            f"leaves no room: the samples would end at register {end - 1}, beyond {ADDRESSES - 1}",
            "correct the address, or the number of samples",
        )


def _check_forbidden(layout: RegistersLayout, path: KeyPath) -> Iterator[Finding]:
    for index, (first, last) in enumerate(layout.forbidden):
        if first > last:
            yield Finding((*path, "forbidden", index), "ends before it begins", f"write [{last}, {first}]")
        for place, channel in enumerate(layout.channels):
            if channel.address <= last and first < channel.address + channel.registers:
                yield Finding(
                    (*path, "channels", place, "address"),
                    f"lies in the forbidden registers {first} to {last}",
                    "leave out the channel, or narrow the forbidden range",
                )


def _check_writes(
    bus: ModbusTcpBus | ModbusRtuBus, name: str, layout: ModbusLayout, path: KeyPath
) -> Iterator[Finding]:
    needed: list[tuple[tuple[str, ...], int, int]] = []
    if isinstance(layout, FifoLayout) and layout.acknowledge is not None:
        needed.append((("acknowledge",), layout.acknowledge, layout.count.bits // 16))
    if isinstance(layout, WaveformLayout):
        if layout.page is not None:
            needed.append((("page", "select"), layout.page.select, 1))
        if layout.trigger is not None:
            needed.append((("trigger", "address"), layout.trigger.address, 1))
    for keys, address, count in needed:
        if not bus.may_write(layout.unit, address, count):
            yield Finding(
                (*path, *keys),
                f'would have to be written, and bus "{name}" does not allow it',
                f"add {{ unit = {layout.unit}, address = {address}, count = {count} }} to writes in "
                f"[buses.{name}]",
            )
