"""Whether what a machine file states of Modbus lines and of the layouts on them fits together.

No two numbers are in one register, and nothing is written among samples.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

from daqsvc.errors.buses import (
    BITS,
    BUS_TOO_SLOW,
    FORBIDDEN_REGISTERS,
    MANUALS_NUMBER,
    NO_ROOM_FOR_REGISTERS,
    NO_VALUE_MARK,
    RAW_VALUES,
    REGISTERS_OVERLAP,
    UNIT_ADDRESS,
    WRITE_NOT_ALLOWED,
    WRONG_LAYOUT,
)
from daqsvc.errors.machine_file import WRONG_ORDER
from daqsvc.rounding import counted, with_unit
from daqsvc.settings.alarms import LevelAlarm, VotingAlarm
from daqsvc.settings.buses import BUSY
from daqsvc.settings.problems import Finding
from daqsvc.settings.section import UnusableValueError
from daqsvc.settings.sensors import TrendValue
from drivers.modbus.load import USUAL_ANSWER_S, line_load
from drivers.modbus.settings import (
    FIFO_REGISTERS,
    MAX_REGISTERS,
    FifoLayout,
    ModbusRtuBus,
    ModbusTcpBus,
    RegisterChannel,
    RegistersLayout,
    RingLayout,
    WaveformLayout,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from daqsvc.settings.models import MachineFile, Stream
    from daqsvc.settings.problems import KeyPath
    from drivers.modbus.settings import ModbusLayout, SampleChannel


ADDRESSES = 65_536
_MANUALS_FIRST = (30_001, 40_001)
"""What manuals call the first input register and the first holding register ..."""
_MANUALS_RANGE = 9_999
"""... and how many of each they can number so."""
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
                code=WRONG_LAYOUT,
            )
        elif isinstance(layout, _LAYOUTS) and bus is not None:
            yield Finding(
                (*at, "layout"),
                f'is one of registers, but bus "{stream.bus}" is no Modbus line',
                'correct bus, or write driver = "modbus" and transport in its table',
                code=WRONG_LAYOUT,
            )
        return
    if not isinstance(layout, _LAYOUTS) or not isinstance(bus, _BUSES):
        return
    path: KeyPath = (*at, "layout")
    if isinstance(bus, ModbusRtuBus) and not 1 <= layout.unit <= 247:
        yield Finding(
            (*path, "unit"),
            "is no address of a unit on a serial line",
            "take 1 to 247, as set in the unit",
            code=UNIT_ADDRESS,
        )
    yield from _check_bits(layout, path)
    yield from _check_marks(layout, path)
    yield from _check_counted_from_0(layout, path)
    yield from check_channel_overlaps(layout, path)
    yield from _check_room(layout, path)
    yield from _check_writes(bus, stream.bus, layout, path)


def check_line_load(draft: MachineFile) -> Iterator[Finding]:
    """A serial line has time for all requests."""
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
                    code=BUS_TOO_SLOW,
                )
            elif load.usual > BUSY:
                yield Finding(
                    ("buses", name, "baud"),
                    f"leaves little room: {asked}, and {100 * load.usual:.3g} % if units answer after "
                    f"{1e3 * USUAL_ANSWER_S:g} ms; what does not fit is lost, and a request without reply "
                    "holds all others up",
                    remedy,
                    fatal=False,
                    code=BUS_TOO_SLOW,
                )


def check_no_value(draft: MachineFile) -> Iterator[Finding]:
    """What devices write where they have no value is not taken for one.

    SunSpec, and many devices beside it, mark so a value that is "not implemented".
    """
    watched = _watched(draft)
    for index, sensor in enumerate(draft.sensors):
        with suppress(UnusableValueError):
            if not isinstance(sensor, TrendValue) or sensor.ok_between is not None:
                continue
            layout = draft.streams[sensor.stream].layout if sensor.stream in draft.streams else None
            channels = layout.channels if isinstance(layout, RegistersLayout) else ()
            channel = next((one for one in channels if one.name == sensor.channel), None)
            if channel is None or channel.type not in _NO_VALUE or channel.bits or channel.no_value:
                continue
            # A count or a state that no alarm watches may be any number.
            if channel.scale == 1.0 and sensor.name not in watched:
                continue
            raw = _NO_VALUE[channel.type]
            mark = f"0x{raw & (1 << 16 * channel.registers) - 1:X}"
            value = (raw * channel.scale + channel.offset) * sensor.gain + sensor.shift
            yield Finding(
                ("sensors", index),
                f"has no ok_between: {mark} in its {channel.type}, by which many devices mean that they have "
                f"no value, would be {with_unit(value, sensor.unit, 6)}",
                f"write no_value = {mark} into its channel if the device's manual has it, or ok_between "
                "with the least and the greatest value that the sensor can measure",
                fatal=False,
                code=NO_VALUE_MARK,
            )


def _watched(draft: MachineFile) -> set[str]:
    """Names of the sensors that an alarm of a measure watches."""
    names: set[str] = set()
    for alarm in draft.alarms:
        with suppress(UnusableValueError):
            if isinstance(alarm, LevelAlarm | VotingAlarm):
                names.update(alarm.watched)
    return names


_NO_VALUE = {"int16": -(1 << 15), "uint16": (1 << 16) - 1, "int32": -(1 << 31), "uint32": (1 << 32) - 1}
"""By the type of a register, the mark for no value."""


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
                code=BITS,
            )


def _check_marks(layout: ModbusLayout, path: KeyPath) -> Iterator[Finding]:
    """The type of each channel can hold the raw values that mean no value."""
    for index, channel in enumerate(layout.channels):
        width = channel.width
        lowest = 0 if channel.bits is not None else -(2 ** (width - 1))
        wrong = [value for value in channel.no_value if not lowest <= value < 2**width]
        if wrong and not channel.type.startswith("float"):
            what = channel.type if channel.bits is None else f"{width} bits"
            yield Finding(
                (*path, "channels", index, "no_value"),
                f"{what} cannot hold {wrong[0]}",
                "write the raw value as the device sends it, before scale and offset",
                code=RAW_VALUES,
            )


def manuals_first(address: int) -> int | None:
    """The number that manuals give the first register, if an address looks like one of theirs."""
    return next((first for first in _MANUALS_FIRST if first <= address < first + _MANUALS_RANGE), None)


def _check_counted_from_0(layout: ModbusLayout, path: KeyPath) -> Iterator[Finding]:
    """An address is one of the line, and not the number that a manual gives."""
    if not isinstance(layout, RegistersLayout):
        return
    for index, channel in enumerate(layout.channels):
        if first := manuals_first(channel.address):
            number = channel.address - first
            table = "holding" if first > 40_000 else "input"
            other = "" if layout.table == table else f' and table = "{table}"'
            yield Finding(
                (*path, "channels", index, "address"),
                f"looks like a number of the manual, where registers begin at {first}",
                f"write address = {number}{other}, as registers begin at 0 here; leave it if the device has "
                "such addresses",
                fatal=False,
                code=MANUALS_NUMBER,
            )


def _check_room(layout: ModbusLayout, path: KeyPath) -> Iterator[Finding]:
    """Samples fit a request, and the registers the address space; forbidden ones are not wanted."""
    if isinstance(layout, RegistersLayout):
        yield from _check_forbidden(layout, path)
        return
    width = layout.sample_registers
    room = FIFO_REGISTERS - layout.count.registers if isinstance(layout, FifoLayout) else MAX_REGISTERS
    if width > room and not isinstance(layout, WaveformLayout):
        yield Finding(
            (*path, "channels"),
            f"take {width} registers a sample, and a reply has room for {room}",
            "leave out channels, or read them in another way",
            code=NO_ROOM_FOR_REGISTERS,
        )
    if isinstance(layout, RingLayout):
        end = layout.address + layout.depth * width
        if layout.depth > 2**layout.count.bits // 2:
            yield Finding(
                (*path, "depth"),
                f"is more than half of what a count of {layout.count.bits} bits can tell",
                "write count = { ..., bits = 32 }, if the device has it",
                code=NO_ROOM_FOR_REGISTERS,
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
            code=NO_ROOM_FOR_REGISTERS,
        )


def _check_forbidden(layout: RegistersLayout, path: KeyPath) -> Iterator[Finding]:
    for index, (first, last) in enumerate(layout.forbidden):
        if first > last:
            yield Finding(
                (*path, "forbidden", index),
                "ends before it begins",
                f"write [{last}, {first}]",
                code=WRONG_ORDER,
            )
        for place, channel in enumerate(layout.channels):
            if channel.address <= last and first < channel.address + channel.registers:
                yield Finding(
                    (*path, "channels", place, "address"),
                    f"lies in the forbidden registers {first} to {last}",
                    "leave out the channel, or narrow the forbidden range",
                    code=FORBIDDEN_REGISTERS,
                )


def _check_writes(
    bus: ModbusTcpBus | ModbusRtuBus, name: str, layout: ModbusLayout, path: KeyPath
) -> Iterator[Finding]:
    needed: list[tuple[tuple[str, ...], int, int]] = []
    if isinstance(layout, FifoLayout) and layout.acknowledge is not None:
        needed.append((("acknowledge",), layout.acknowledge, layout.count.registers))
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
                code=WRITE_NOT_ALLOWED,
            )


class _Block(NamedTuple):
    """Registers of a unit that hold one thing."""

    first: int
    registers: int
    what: str
    path: KeyPath

    @property
    def last(self) -> int:
        return self.first + self.registers - 1

    def overlaps(self, other: _Block) -> bool:
        return self.first <= other.last and other.first <= self.last


def check_channel_overlaps(layout: ModbusLayout, path: KeyPath) -> Iterator[Finding]:
    """No register is a part of two numbers, but where each takes its own bits of it."""
    key = "address" if isinstance(layout, RegistersLayout) else "place"
    channels: Sequence[RegisterChannel | SampleChannel] = layout.channels
    placed = [(channel.first, index, channel) for index, channel in enumerate(channels)]
    widest: tuple[int, SampleChannel | RegisterChannel] | None = None
    for first, index, other in sorted(placed, key=lambda item: item[:2]):
        if widest is not None:
            yield from _clash(*widest, first, other, (*path, "channels", index, key))
        if widest is None or first + other.registers > widest[0] + widest[1].registers:
            widest = first, other


def _clash(
    begin: int,
    one: RegisterChannel | SampleChannel,
    first: int,
    other: RegisterChannel | SampleChannel,
    at: KeyPath,
) -> Iterator[Finding]:
    """What there is to report of two numbers, of which the other one does not begin before the first."""
    end = begin + one.registers
    if first >= end:
        return
    whole = first == begin and one.type == other.type
    if whole and one.bits is not None and other.bits is not None and _apart(one.bits, other.bits):
        return
    floats = one.type.startswith("float") or other.type.startswith("float")
    # The same number twice, or words of a long whole number by themselves, may be meant.
    within = first + other.registers <= end
    registers = f"registers {begin} to {end - 1}" if end - begin > 1 else f"register {begin}"
    yield Finding(
        at,
        f'is part of {one.type} "{one.name}" too, which takes {registers}',
        f"correct the two: {one.type} takes {counted(one.registers, 'register')}, "
        f"so the next number begins at {end} or later",
        fatal=not whole and (floats or not within),
        code=REGISTERS_OVERLAP,
    )


def _apart(one: tuple[int, int], other: tuple[int, int]) -> bool:
    return one[0] + one[1] <= other[0] or other[0] + other[1] <= one[0]


def check_writes_and_samples(draft: MachineFile) -> Iterator[Finding]:
    """What is written, and what shows that there is something new, lies beside the samples."""
    taken: dict[_Place, list[tuple[str, _Block]]] = {}
    controls: list[tuple[_Place, str, _Block]] = []
    for name, stream in draft.streams.items():
        with suppress(UnusableValueError):
            layout, path = stream.layout, ("streams", name, "layout")
            if not isinstance(layout, _LAYOUTS):
                continue
            table = "fifo" if isinstance(layout, FifoLayout) else layout.table
            at = _Place(stream.bus, layout.unit, table)
            taken.setdefault(at, []).extend((name, block) for block in _samples(layout, path))
            controls += [
                (at._replace(table=in_table), name, control) for in_table, control in _controls(layout, path)
            ]
    for number, (place, name, control) in enumerate(controls):
        mine = [other for there, owner, other in controls[:number] if (there, owner) == (place, name)]
        yield from _among_samples(control, name, taken.get(place, []))
        yield from _twice(control, mine)


class _Place(NamedTuple):
    """Where registers are."""

    bus: str
    unit: int
    table: str


_REMEDY = "correct the address of one of them, as in the device's register map"


def _among_samples(control: _Block, name: str, samples: Sequence[tuple[str, _Block]]) -> Iterator[Finding]:
    for owner, block in samples:
        if control.overlaps(block):
            whose = block.what if owner == name else f'{block.what} of stream "{owner}"'
            yield Finding(
                control.path,
                f"register {control.first} is {control.what}, but lies among {whose}, registers "
                f"{block.first} to {block.last}",
                _REMEDY,
                code=REGISTERS_OVERLAP,
            )
            return


def _twice(control: _Block, others: Sequence[_Block]) -> Iterator[Finding]:
    for other in others:
        if control.overlaps(other):
            yield Finding(
                control.path,
                f"register {control.first} is {other.what} already, and cannot be {control.what} too",
                _REMEDY,
                code=REGISTERS_OVERLAP,
            )
            return


def _samples(layout: ModbusLayout, path: KeyPath) -> Iterator[_Block]:
    if isinstance(layout, RegistersLayout):
        for index, channel in enumerate(layout.channels):
            at = (*path, "channels", index, "address")
            yield _Block(channel.address, channel.registers, f'channel "{channel.name}"', at)
    elif isinstance(layout, RingLayout):
        yield _Block(layout.address, layout.depth * layout.sample_registers, "the ring", (*path, "address"))
    elif isinstance(layout, WaveformLayout):
        whole = layout.samples * layout.sample_registers
        count = whole if layout.page is None else min(whole, layout.page.registers)
        yield _Block(layout.address, count, "the samples of a block", (*path, "address"))


def _controls(layout: ModbusLayout, path: KeyPath) -> Iterator[tuple[str, _Block]]:
    """Registers that steer the reading, each with its table; only holding ones can be written."""
    if isinstance(layout, RingLayout):
        count = layout.count
        at = (*path, "count", "address")
        yield layout.table, _Block(count.address, count.registers, "the count of the ring", at)
    elif isinstance(layout, FifoLayout) and layout.acknowledge is not None:
        at = (*path, "acknowledge")
        yield (
            "holding",
            _Block(layout.acknowledge, layout.count.registers, "where a queue is acknowledged", at),
        )
    elif isinstance(layout, WaveformLayout):
        yield layout.table, _Block(layout.block_id, 1, "the id of the block", (*path, "block_id"))
        if layout.page is not None:
            yield (
                "holding",
                _Block(layout.page.select, 1, "the choice of the page", (*path, "page", "select")),
            )
        if layout.trigger is not None:
            at = (*path, "trigger", "address")
            yield "holding", _Block(layout.trigger.address, 1, "the trigger", at)
