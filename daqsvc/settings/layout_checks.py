"""Whether buses, streams, layouts and sensors fit each other."""

from __future__ import annotations

from contextlib import suppress
from itertools import combinations
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from daqsvc.settings.buses import CanBus, DbcLayout, PlainLayout, Stream
from daqsvc.settings.packing import CRC_BYTES
from daqsvc.settings.problems import Finding, choice
from daqsvc.settings.replay import TableLayout
from daqsvc.settings.section import UnusableValueError
from daqsvc.settings.serial import SerialLayout
from daqsvc.settings.wire import BUSY, CLASSIC_MAX_LENGTH, frame_time

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from daqsvc.settings.buses import Layout
    from daqsvc.settings.dbc import DbcMessage
    from daqsvc.settings.models import MachineFile, Sensor
    from daqsvc.settings.packing import Channel
    from daqsvc.settings.problems import KeyPath

SHORTEST_WRAP_S = 0.040
"""A counter that wraps sooner cannot tell a long gap from a short one."""

LEAST_COUNTER_BITS = 4
"""A narrower counter wraps within a few frames."""

PRIORITY = 0x1C00_0000
"""Bits of a J1939 id that say how urgent it is, and nothing else (SAE J1939-21, 5.2)."""


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
    def told_apart(self) -> tuple[bool, int]:
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
    """Counter, CRC and samples lie within the frame and beside each other; the id has its width."""
    if not layout.extended and layout.id > 0x7FF:
        yield Finding(
            (*at, "id"),
            "does not fit into 11 bits (0x7ff)",
            "write extended = true if the device sends 29-bit ids, else correct the id",
        )
    if layout.any_priority and not layout.extended:
        yield Finding(
            (*at, "any_priority"),
            "cannot be with an id of 11 bits: it has no priority to leave out",
            "write extended = true, since all ids of SAE J1939 have 29 bits; else leave any_priority out",
        )
    fields = [("first_byte", "the samples", layout.first_byte, layout.samples_end_byte)]
    if layout.counter is not None:
        fields.append(("counter", "the counter", layout.counter.byte, layout.counter.end_byte))
    if layout.crc_byte is not None:
        fields.append(("crc_byte", "the CRC", layout.crc_byte, layout.crc_byte + CRC_BYTES))
    fields.sort(key=lambda field: field[2])
    for key, what, start, end in fields:
        if end > layout.length:
            yield Finding(
                (*at, key),
                f"{what} would take bytes {start} to {end - 1} of a frame of {layout.length} bytes",
                _make_room(layout, key, end - start),
            )
    inside = [field for field in fields if field[3] <= layout.length]
    for (_, first, start, end), (key, what, later_start, later_end) in combinations(inside, 2):
        if later_start < end:
            yield Finding(
                (*at, key),
                f"{what} (bytes {later_start} to {later_end - 1}) would overlap {first} "
                f"(bytes {start} to {end - 1})",
                f"move {what} to byte {end} or behind, as the device sends it",
            )


def _make_room(layout: PlainLayout, key: str, needed_bytes: int) -> str:
    """What to do about a field that reaches past the end of the frame."""
    fitting_samples = (layout.length - layout.first_byte) // layout.sample_bytes
    if key == "first_byte" and fitting_samples > 0:
        return f"write samples_per_frame = {fitting_samples}, or make the frame longer"
    if key != "first_byte" and layout.length >= needed_bytes:
        return f"move it to byte {layout.length - needed_bytes} or before, or make the frame longer"
    return "make the frame longer"


def check_channels(layout: Layout, at: KeyPath) -> Iterator[Finding]:
    """Channel names are unique; in a DBC layout every channel has as many samples, each its own signal."""
    if isinstance(layout, TableLayout):
        yield from unique(list(layout.channel_names), (*at, "columns"), "channel")
        return
    yield from unique([channel.name for channel in layout.channels], (*at, "channels"), "channel")
    if isinstance(layout, PlainLayout | SerialLayout):
        yield from _check_valid_raw(layout.channels, (*at, "channels"))
    if not isinstance(layout, DbcLayout):
        return
    taken = {} if layout.counter is None else {layout.counter.signal: "the counter"}
    for index, channel in enumerate(layout.channels):
        path = (*at, "channels", index, "signals")
        if len(channel.signals) != layout.samples_per_frame:
            yield Finding(
                path,
                f"has {len(channel.signals)} samples in a frame, but channel "
                f'"{layout.channels[0].name}" has {layout.samples_per_frame}',
                "name as many signals for every channel of the stream",
            )
        for place, signal in enumerate(channel.signals):
            if signal in taken:
                yield Finding(
                    (*path, place),
                    f"is taken by {taken[signal]} already",
                    "name each signal once",
                )
            taken[signal] = f'channel "{channel.name}"'


def _check_valid_raw(channels: Sequence[Channel], at: KeyPath) -> Iterator[Finding]:
    """What is to be a measurement can be sent."""
    for index, channel in enumerate(channels):
        least, largest = channel.raw_limits
        if channel.valid_raw is not None and not (
            least <= channel.valid_raw[0] and channel.valid_raw[1] <= largest
        ):
            yield Finding(
                (*at, index, "valid_raw"),
                f"does not lie within what {channel.type} can carry, {least:g} to {largest:g}",
                "write the raw values as the device sends them, before scale and offset",
            )
        elif (
            channel.valid_raw is not None
            and channel.type != "float32"
            and any(v % 1 for v in channel.valid_raw)
        ):
            yield Finding(
                (*at, index, "valid_raw"),
                f"has a fraction, which no {channel.type} can carry",
                "write whole numbers: raw values as the device sends them, before scale and offset",
            )


def check_stream_bus(draft: MachineFile, stream: Stream, at: KeyPath) -> Iterator[Finding]:
    """The stream's bus exists."""
    if stream.bus not in draft.buses:
        yield Finding((*at, "bus"), "there is no such bus", choice(stream.bus, draft.buses))


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
            )
        elif load > BUSY:
            yield Finding(
                ("buses", bus, "bitrate"),
                f"leaves little room: the streams take {100 * load:.0f} % of the bus's time without stuff "
                f"bits, {100 * most:.0f} % with the most there can be; frames of low priority come late",
                remedy,
                fatal=False,
            )


def check_counter(stream: Stream, message: DbcMessage | None, at: KeyPath) -> Iterator[Finding]:
    """There is a counter, unless the file denies it, and it tells how much is missing after a gap."""
    layout, facts = stream.layout, frame_facts(stream, message)
    if isinstance(layout, PlainLayout | DbcLayout):
        yield from _check_counted(layout, (*at, "layout"))
    if facts is None or facts.counter_bits is None:
        return
    if facts.counter_bits < LEAST_COUNTER_BITS:
        yield Finding(
            (*at, "layout", "counter"),
            f"has {facts.counter_bits} bit{'s' if facts.counter_bits > 1 else ''}: it wraps within a few "
            f"frames, and tells nothing of what was lost",
            f"name a counter of {LEAST_COUNTER_BITS} bits or more; if the device sends none, write "
            "no_counter = true in its place, and loss is estimated from the times of arrival",
        )
        return
    step = facts.samples_per_frame if facts.counts_samples else 1
    if step >= 2 ** (facts.counter_bits - 2):
        yield Finding(
            (*at, "layout", "counter"),
            f"a counter of {facts.counter_bits} bits cannot tell frames of {step} samples apart: it wraps "
            "within four of them",
            'have the device send a wider counter, or count "frames"',
        )
        return
    per_count = 1 if facts.counts_samples else facts.samples_per_frame
    wrap_s = 2**facts.counter_bits * per_count / stream.rate_hz
    if wrap_s < SHORTEST_WRAP_S:
        yield Finding(
            (*at, "layout", "counter"),
            f"a counter of {facts.counter_bits} bits wraps every {wrap_s * 1e3:.3g} ms at "
            f"{stream.rate_hz:g} Hz: the loss in a longer gap is estimated from the host clock",
            'have the device send a wider counter, or count "frames"',
            fatal=False,
        )


def _check_counted(layout: PlainLayout | DbcLayout, at: KeyPath) -> Iterator[Finding]:
    """Whoever goes without a counter says so."""
    if layout.counter is None and not layout.no_counter:
        yield Finding(
            (*at, "counter"),
            "is missing: it tells what was lost, and what the time of a sample is",
            "say where the device's counter lies; if it sends none, write no_counter = true, and loss is "
            "estimated from the times of arrival",
        )
    elif layout.counter is not None and layout.no_counter:
        yield Finding(
            (*at, "no_counter"),
            "contradicts counter",
            "leave it out if the device counts, else remove counter",
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
                    "give each stream of a bus an id of its own, as the devices send it",
                )


def _clash(a: FrameFacts, b: FrameFacts) -> bool:
    """Whether some frame would be one of both streams."""
    if a.any_priority != b.any_priority:
        a, b = a._replace(any_priority=True), b._replace(any_priority=True)
    if a.told_apart != b.told_apart:
        return False
    return not any(a.pages[name].isdisjoint(b.pages[name]) for name in a.pages.keys() & b.pages.keys())


def check_sensor_channel(draft: MachineFile, sensor: Sensor, at: KeyPath) -> Iterator[Finding]:
    """The sensor's stream and channel exist."""
    if sensor.stream not in draft.streams:
        yield Finding((*at, "stream"), "there is no such stream", choice(sensor.stream, draft.streams))
        return
    channels = draft.streams[sensor.stream].layout.channel_names
    if sensor.channel not in channels:
        yield Finding(
            (*at, "channel"),
            f'stream "{sensor.stream}" has no such channel',
            choice(sensor.channel, channels),
        )


def check_channel_use(draft: MachineFile) -> Iterator[Finding]:
    """No channel is claimed by two sensors."""
    owners: dict[tuple[str, str], int] = {}
    for index, sensor in enumerate(draft.sensors):
        with suppress(UnusableValueError):
            owner = owners.setdefault((sensor.stream, sensor.channel), index)
            if owner != index:
                yield Finding(
                    ("sensors", index, "channel"),
                    f'channel "{sensor.channel}" of stream "{sensor.stream}" belongs to '
                    f'sensor "{draft.sensors[owner].name}" already',
                    "give each sensor a channel of its own",
                )


def unique(names: list[str], at: KeyPath, what: str) -> Iterator[Finding]:
    """Findings for every name that has been given before in the same array."""
    seen: dict[str, int] = {}
    for index, name in enumerate(names):
        if seen.setdefault(name, index) != index:
            yield Finding(
                (*at, index, "name"),
                f"is the name of an earlier {what} already",
                f"give each {what} a name of its own",
            )
