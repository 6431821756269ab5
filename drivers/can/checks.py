"""Whether what a machine file states of CAN buses and of the frames on them fits together."""

from __future__ import annotations

import re
from contextlib import suppress
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple, get_args

from daqsvc import rounding
from daqsvc.errors.buses import (
    BUS_TOO_SLOW,
    CAN_ID,
    FRAME_LENGTH,
    NO_SUCH_INTERFACE,
    NOT_IN_ONE_FRAME,
    NOT_TOLD_APART,
    TOO_LITTLE_KEPT,
    UNFIT_COUNTER,
)
from daqsvc.errors.machine_file import CONTRADICTION, NAMED_TWICE, NO_EFFECT, WRONG_SCALE
from daqsvc.settings.buses import BUSY
from daqsvc.settings.packing import counted, packed_room, valid_raw
from daqsvc.settings.problems import Finding, choice
from daqsvc.settings.section import UnusableValueError
from daqsvc.settings.units import factor_between, same_unit, unit_of
from drivers.can.settings import PRIORITY, CanBus, DbcLayout, PlainLayout

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from daqsvc.settings.models import MachineFile, Sensor, Stream
    from daqsvc.settings.problems import KeyPath
    from drivers.can.settings import DbcMessage


SHORTEST_WRAP_S = 0.040
"""A counter that wraps sooner cannot tell a long gap from a short one."""

LEAST_COUNTER_BITS = 4
"""A narrower counter wraps within a few frames."""

_OF_LINUX = re.compile(r"[^/\s]{1,15}").fullmatch
"""Names that a network interface can have (IFNAMSIZ in linux/if.h)."""


class FrameFacts(NamedTuple):
    """What the wire shows of a stream, wherever its layout comes from."""

    frame_id: int
    extended: bool
    length: int
    counter_bits: int | None
    counts_samples: bool
    samples_per_frame: int
    any_priority: bool
    pages: Mapping[str, frozenset[int]] = MappingProxyType({})

    @property
    def compared_id(self) -> tuple[bool, int]:
        """What no other frames on the bus have: the id, less its priority where that does not count."""
        return self.extended, self.frame_id & ~PRIORITY if self.any_priority else self.frame_id


def frame_facts(stream: Stream, message: DbcMessage | None) -> FrameFacts | None:
    """Id, length and counter of a stream's CAN frames.

    None if they are in a DBC message that is not at hand, or if the stream comes over another kind of bus.
    """
    layout = stream.layout
    if not isinstance(layout, PlainLayout | DbcLayout):
        return None
    counts_samples = layout.counter is not None and layout.counter.counts == "samples"
    if isinstance(layout, PlainLayout):
        return FrameFacts(
            layout.id,
            layout.extended,
            layout.length,
            None if layout.counter is None else layout.counter.bits,
            counts_samples,
            layout.samples_per_frame,
            layout.any_priority,
        )
    if message is None or (layout.counter is not None and layout.counter.signal not in message.signal_bits):
        return None
    return FrameFacts(
        message.frame_id,
        message.extended,
        message.length,
        None if layout.counter is None else message.signal_bits[layout.counter.signal],
        counts_samples,
        layout.samples_per_frame,
        message.any_priority,
        message.pages,
    )


def bus_share(machine: MachineFile, name: str, message: DbcMessage | None) -> tuple[float, float] | None:
    """Share of the bus's time that a stream takes, with the fewest and the most stuff bits.

    None where the bit rate or the frame is not known.
    """
    stream = machine.streams[name]
    bus = machine.buses.get(stream.bus)
    facts = frame_facts(stream, message)
    if not isinstance(bus, CanBus) or bus.bitrate is None or facts is None:
        return None
    time = frame_time(
        facts.length, extended=facts.extended, bitrate=bus.bitrate, data_bitrate=bus.data_bitrate
    )
    frames_per_s = stream.rate_hz / facts.samples_per_frame
    return frames_per_s * time.least_s, frames_per_s * time.most_s


def check_plain_layout(layout: PlainLayout, at: KeyPath) -> Iterator[Finding]:
    """The id has its width; counter, CRC and samples fit the frame."""
    if not layout.extended and layout.id > 0x7FF:
        yield Finding(
            (*at, "id"),
            "does not fit into 11 bits (0x7ff)",
            "write extended = true if the device sends 29-bit ids, else correct the id",
            code=CAN_ID,
        )
    if layout.any_priority and not layout.extended:
        yield Finding(
            (*at, "any_priority"),
            "cannot be with an id of 11 bits: it has no priority to leave out",
            "write extended = true, since all ids of SAE J1939 have 29 bits; else leave any_priority out",
            code=CAN_ID,
        )
    yield from packed_room(layout, at)
    yield from valid_raw(layout.channels, (*at, "channels"))


def check_signals(layout: DbcLayout, at: KeyPath) -> Iterator[Finding]:
    """Every channel has as many samples, each its own signal."""
    taken = {} if layout.counter is None else {layout.counter.signal: "the counter"}
    for index, channel in enumerate(layout.channels):
        path = (*at, "channels", index, "signals")
        if len(channel.signals) != layout.samples_per_frame:
            yield Finding(
                path,
                f"has {rounding.counted(len(channel.signals), 'sample')} in a frame, but channel "
                f'"{layout.channels[0].name}" has {layout.samples_per_frame}',
                "name as many signals for every channel of the stream",
                code=NOT_IN_ONE_FRAME,
            )
        for place, signal in enumerate(channel.signals):
            if signal in taken:
                yield Finding(
                    (*path, place),
                    f"is taken by {taken[signal]} already",
                    "name each signal once",
                    code=NAMED_TWICE,
                )
            taken[signal] = f'channel "{channel.name}"'


def check_frame_length(
    draft: MachineFile, stream: Stream, message: DbcMessage | None, at: KeyPath
) -> Iterator[Finding]:
    """The stream's bus can carry its frames."""
    facts, bus = frame_facts(stream, message), draft.buses.get(stream.bus)
    if facts is None or not isinstance(bus, CanBus):
        return
    if facts.length > CLASSIC_MAX_LENGTH and not bus.fd:
        key = "length" if isinstance(stream.layout, PlainLayout) else "message"
        yield Finding(
            (*at, "layout", key),
            f"has {facts.length} bytes: only CAN FD carries more than 8, "
            f'and bus "{stream.bus}" is classic CAN',
            f"write fd = true in [buses.{stream.bus}], or make the frame 8 bytes or shorter",
            code=FRAME_LENGTH,
        )


def check_bus_load(draft: MachineFile, messages: Mapping[str, DbcMessage]) -> Iterator[Finding]:
    """A bus has time for all the frames on it."""
    for bus in draft.buses:
        load = most = 0.0
        remedy = "correct the rates of the streams, put more samples in a frame, or use a faster bus"
        for name, stream in draft.streams.items():
            with suppress(UnusableValueError):
                share = bus_share(draft, name, messages.get(name)) if stream.bus == bus else None
                load, most = (load, most) if share is None else (load + share[0], most + share[1])
        if load > 1.0:
            yield Finding(
                ("buses", bus, "bitrate"),
                f"is too slow: the streams on the bus would take it {100 * load:,.0f} % of the time at least",
                remedy,
                code=BUS_TOO_SLOW,
            )
        elif load > BUSY:
            yield Finding(
                ("buses", bus, "bitrate"),
                f"leaves little room: the streams take {100 * load:.0f} % of the bus's time without stuff "
                f"bits, {100 * most:.0f} % with the most there can be; frames of low priority come late",
                remedy,
                fatal=False,
                code=BUS_TOO_SLOW,
            )


def check_counter(stream: Stream, message: DbcMessage | None, at: KeyPath) -> Iterator[Finding]:
    """There is a counter, unless the file denies it, and it shows how much is missing after a gap."""
    layout, facts = stream.layout, frame_facts(stream, message)
    if isinstance(layout, PlainLayout | DbcLayout):
        yield from counted(layout, (*at, "layout"))
    if facts is None or facts.counter_bits is None:
        return
    if facts.counter_bits < LEAST_COUNTER_BITS:
        yield Finding(
            (*at, "layout", "counter"),
            f"has {facts.counter_bits} bit{'s' if facts.counter_bits > 1 else ''}: it wraps within a few "
            f"frames, and does not show what was lost",
            f"name a counter of {LEAST_COUNTER_BITS} bits or more; if the device sends none, write "
            "no_counter = true in its place, and loss is estimated from the times of arrival",
            code=UNFIT_COUNTER,
        )
        return
    step = facts.samples_per_frame if facts.counts_samples else 1
    or_frames = ', or count "frames"' if step > 1 else ""
    if step >= 2 ** (facts.counter_bits - 2):
        yield Finding(
            (*at, "layout", "counter"),
            f"a counter of {facts.counter_bits} bits cannot tell frames of {step} samples apart: it wraps "
            "within four of them",
            f"have the device send a wider counter{or_frames}",
            code=UNFIT_COUNTER,
        )
        return
    per_count = 1 if facts.counts_samples else facts.samples_per_frame
    wrap_s = 2**facts.counter_bits * per_count / stream.rate_hz
    if wrap_s < SHORTEST_WRAP_S:
        yield Finding(
            (*at, "layout", "counter"),
            f"a counter of {facts.counter_bits} bits wraps every {wrap_s * 1e3:.3g} ms at "
            f"{stream.rate_hz:g} Hz: the loss in a longer gap is estimated from the host clock",
            f"have the device send a wider counter{or_frames}",
            fatal=False,
            code=UNFIT_COUNTER,
        )


def check_ids(draft: MachineFile, messages: Mapping[str, DbcMessage]) -> Iterator[Finding]:
    """No two streams of one bus share an id, but for those on different pages of a multiplexer."""
    owners: dict[str, list[tuple[str, FrameFacts]]] = {}
    for name, stream in draft.streams.items():
        with suppress(UnusableValueError):
            facts = frame_facts(stream, messages.get(name))
            if facts is None:
                continue
            others = owners.setdefault(stream.bus, [])
            owner = next((other for other, theirs in others if _clash(facts, theirs)), None)
            others.append((name, facts))
            if owner is not None:
                key = "id" if isinstance(stream.layout, PlainLayout) else "message"
                yield Finding(
                    ("streams", name, "layout", key),
                    f'id {facts.frame_id:#x} on bus "{stream.bus}" belongs to stream "{owner}" already',
                    "give each stream of a bus its own id, as the devices send it",
                    code=NOT_TOLD_APART,
                )


def _clash(a: FrameFacts, b: FrameFacts) -> bool:
    """Whether some frame would be one of both streams."""
    if a.any_priority != b.any_priority:
        a, b = a._replace(any_priority=True), b._replace(any_priority=True)
    if a.compared_id != b.compared_id:
        return False
    return not any(a.pages[name].isdisjoint(b.pages[name]) for name in a.pages.keys() & b.pages.keys())


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
                    code=NO_SUCH_INTERFACE,
                )
            elif isinstance(bus, CanBus) and bus.interface == "socketcan" and not _OF_LINUX(bus.channel):
                yield Finding(
                    ("buses", name, "channel"),
                    "is no name of a CAN interface of Linux: these have at most 15 characters and no /",
                    'write e.g. channel = "can0" (`ip link` lists them); for a bus between programs, write '
                    'interface = "unixbus"',
                    code=NO_SUCH_INTERFACE,
                )
            elif isinstance(bus, CanBus) and bus.interface == "socketcan" and bus.options:
                yield Finding(
                    ("buses", name, "options"),
                    "mean nothing to SocketCAN",
                    f"remove {', '.join(bus.options)}; set the interface up by `ip link set {bus.channel}`",
                    code=NO_EFFECT,
                )


def check_can_keys(draft: MachineFile) -> Iterator[Finding]:
    """What is stated of a CAN bus has an effect, and goes together."""
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
                    code=NO_EFFECT,
                )
            elif bus.data_bitrate is not None and bus.bitrate is not None and bus.data_bitrate < bus.bitrate:
                yield Finding(
                    (*at, "data_bitrate"),
                    f"is less than bitrate = {bus.bitrate:,}, and the data of CAN FD never go slower",
                    "swap the two, or correct one of them",
                    code=CONTRADICTION,
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
                        code=NO_EFFECT,
                    )


def check_recorded_buses(draft: MachineFile) -> Iterator[Finding]:
    """What is kept holds the file that is being written and one before it."""
    for name, bus in draft.buses.items():
        with suppress(UnusableValueError):
            if isinstance(bus, CanBus) and bus.record and bus.record.keep_mb < 2 * bus.record.file_mb:
                yield Finding(
                    ("buses", name, "record", "keep_mb"),
                    f"keeps no finished file beside the one being written, of up to {bus.record.file_mb} MB",
                    f"keep {2 * bus.record.file_mb} MB or more, or write smaller files (file_mb)",
                    code=TOO_LITTLE_KEPT,
                )


def check_dbc_unit(
    draft: MachineFile, sensor: Sensor, messages: Mapping[str, DbcMessage], at: KeyPath
) -> Iterator[Finding]:
    """The DBC file and the sensor agree on the unit."""
    layout = draft.streams[sensor.stream].layout if sensor.stream in draft.streams else None
    message = messages.get(sensor.stream)
    if not isinstance(layout, DbcLayout) or message is None:
        return
    wire_unit = sensor.unit if sensor.sensitivity_mv_per_unit is None else "V"
    signals = next((channel.signals for channel in layout.channels if channel.name == sensor.channel), ())
    for signal in signals:
        unit = message.signal_units.get(signal, "")
        if unit == "" or same_unit(unit, wire_unit):
            continue
        factor = factor_between(unit, wire_unit)
        statement = (
            f'the DBC file gives signal "{signal}" in "{unit}", but this sensor takes it as "{wire_unit}"'
        )
        known = unit_of(unit) is not None and unit_of(wire_unit) is not None
        yield Finding(
            (*at, "unit"),
            statement
            if factor is None
            else f"{statement}: wrong by a factor of {max(factor, 1 / factor):.4g}",
            _unit_remedy(sensor, unit, factor),
            fatal=known,
            code=WRONG_SCALE,
        )
        return


def _units_of_type(sensor: Sensor) -> tuple[str, ...]:
    """The units that sensors of this type can have; none where any can be."""
    units: tuple[str, ...] = get_args(type(sensor).model_fields["unit"].annotation)
    return units


def _unit_remedy(sensor: Sensor, unit: str, factor: float | None) -> str:
    meant, of_type = unit_of(unit), _units_of_type(sensor)
    if sensor.sensitivity_mv_per_unit is None and meant is not None and meant.quantity == "voltage":
        return "add sensitivity_mv_per_unit, if the channel carries a voltage; or correct the DBC file"
    if sensor.sensitivity_mv_per_unit is not None and factor is not None:
        return f"give the signal in V in the DBC file: multiply its scale and offset there by {factor:g}"
    if sensor.sensitivity_mv_per_unit is not None:
        return "remove sensitivity_mv_per_unit if the device sends the physical unit; or correct the DBC file"
    if meant is not None and factor is not None and of_type and meant.name not in of_type:
        units = f"{', '.join(of_type[:-1])} or {of_type[-1]}" if len(of_type) > 1 else of_type[0]
        return (
            f"{sensor.kind} has its samples in {units}: multiply scale and offset of the "
            f'signal in the DBC file by {factor:.6g} and write "{sensor.unit}" as its unit there; if it is a '
            'value that the device measures itself, write type = "trend"'
        )
    if meant is not None and factor is not None:
        return f'write unit = "{meant.name}", or correct the DBC file'
    return "correct unit (or sensitivity_mv_per_unit), or the unit in the DBC file"


CLASSIC_MAX_LENGTH = 8

_TAIL_BITS = 13
"""CRC delimiter, ACK slot, ACK delimiter, end of frame (7) and intermission (3)."""


class FrameTime(NamedTuple):
    """Time of a frame on the wire in s: without stuff bits, and with as many as there can be."""

    least_s: float
    most_s: float


def frame_time(
    length: int, *, extended: bool, bitrate: int, data_bitrate: int | None = None, fd: bool = False
) -> FrameTime:
    """Time that one data frame takes on the wire, intermission included.

    Args:
        length: payload bytes; more than 8 makes it a CAN FD frame.
        extended: whether the id has 29 bits rather than 11.
        bitrate: nominal bit/s.
        data_bitrate: bit/s of the data phase of a CAN FD frame; None if it does not switch.
        fd: whether it is a CAN FD frame whatever its length.
    """
    if length <= CLASSIC_MAX_LENGTH and not fd:
        # SOF, id, RTR, IDE, r0, DLC (extended: SRR, 18 more id bits and r1 as well), data, CRC.
        stuffed = (39 if extended else 19) + 8 * length + 15
        total = stuffed + _TAIL_BITS
        return FrameTime(total / bitrate, (total + _most_stuff_bits(stuffed)) / bitrate)
    data_rate = data_bitrate or bitrate
    # SOF, id, RRS, IDE, FDF, res, BRS (extended: SRR and 18 more id bits as well).
    arbitration = 36 if extended else 17
    payload = 1 + 4 + 8 * length  # ESI, DLC, data
    crc = 17 if length <= 16 else 21
    fixed_stuff = 1 + -(-crc // 4)  # before the stuff count, then after every 4 bits of it and of the CRC
    # The rate switches back at the CRC delimiter, which is counted with the data phase.
    data = payload + 4 + crc + fixed_stuff + 1
    least_s = (arbitration + _TAIL_BITS - 1) / bitrate + data / data_rate
    stuff_s = _most_stuff_bits(arbitration) / bitrate + (payload // 4) / data_rate
    return FrameTime(least_s, least_s + stuff_s)


def _most_stuff_bits(bits: int) -> int:
    """Stuff bits in the worst sequence of ``bits`` bits: one after the first five, then after every four."""
    return (bits - 1) // 4
