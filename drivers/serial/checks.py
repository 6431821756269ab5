"""Whether what a machine file states of serial ports and of the layouts on them fits together."""

from __future__ import annotations

import json
import math
import re
from contextlib import suppress
from itertools import combinations
from typing import TYPE_CHECKING, get_args

from daqsvc.errors.buses import (
    BUS_TOO_SLOW,
    FIELD_OUTSIDE,
    FIELDS_OVERLAP,
    LOSS_UNNOTICED,
    NOT_TOLD_APART,
    PORT_MAY_CHANGE,
    TIMES_SHARED,
    WRONG_LAYOUT,
)
from daqsvc.errors.machine_file import (
    CONTRADICTION,
    INCOMPLETE,
    NAMED_TWICE,
    NO_EFFECT,
    NO_SUCH_NAME,
    WRONG_SCALE,
)
from daqsvc.settings.buses import BUSY
from daqsvc.settings.problems import Finding, choice
from daqsvc.settings.section import UnusableValueError
from daqsvc.settings.units import factor_between, unit_of
from drivers.serial.settings import (
    UNITS_PER_S,
    CobsBus,
    LineChannel,
    LineLayout,
    LinesBus,
    SerialBus,
    SerialLayout,
    SyncBus,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.settings.models import MachineFile, Sensor, Stream
    from daqsvc.settings.problems import KeyPath

_CHECKSUM_CHARACTERS = {"none": 0, "xor": 3, "crc16": 5}
"""An asterisk and hexadecimal digits."""

EXACT_STAMPS = 4.0
"""How many times finer than the time between lines stamps must be for every gap to be exact."""

HARDLY_LONGER = 1.1
"""Units of time from line to line below which one of two units cannot be told from a lost line."""

_LIKE_SCALE = 0.02
"""Share by which a scale may differ from the factor between two units, as people round it."""

_NUMBERED = re.compile(r"/dev/tty(USB|ACM)\d+")


def check_serial(draft: MachineFile, stream: Stream, at: KeyPath) -> Iterator[Finding]:
    """The layout belongs to the bus, and its parts fit each other."""
    bus, layout, path = draft.buses.get(stream.bus), stream.layout, (*at, "layout")
    if isinstance(bus, CobsBus | SyncBus | LinesBus):
        _ = bus.framing  # unusable if it is wrong: no layout is wrong then
    if isinstance(bus, LinesBus):
        if not isinstance(layout, LineLayout):
            yield Finding(
                path,
                f'is no layout of a line, and bus "{stream.bus}" carries lines',
                'write line = ["seq", "x"], the names of the columns',
                code=WRONG_LAYOUT,
            )
            return
        if layout.separator == bus.delimiter:
            yield Finding(
                (*path, "separator"),
                f'is the delimiter of bus "{stream.bus}" too',
                "correct one of them, as the device sends it",
                code=CONTRADICTION,
            )
        yield from _check_texts(layout, bus.delimiter, path)
    elif isinstance(bus, CobsBus | SyncBus):
        if not isinstance(layout, SerialLayout):
            yield Finding(
                path,
                f'is no layout of a binary serial frame, and bus "{stream.bus}" carries such frames',
                "write payload_length (and stream_id if stream_ids = true) in place of id and length",
                code=WRONG_LAYOUT,
            )
            return
        yield from _check_id(bus, stream.bus, layout, path)
    elif isinstance(layout, SerialLayout | LineLayout) and bus is not None:
        yield Finding(
            path,
            f'is one of a serial port, but bus "{stream.bus}" is none',
            'correct bus, or write driver = "serial", port, baud and framing in its table',
            code=WRONG_LAYOUT,
        )
        return
    if isinstance(layout, LineLayout):
        yield from _check_columns(layout, path)
        yield from _check_time(layout, stream.rate_hz, (*path, "time", "unit"))
    elif isinstance(layout, SerialLayout):
        yield from _check_room(layout, path)


def check_serial_ports(draft: MachineFile) -> Iterator[Finding]:
    """Ports are named so as to be found again, and are fast enough for their streams."""
    for name, bus in draft.buses.items():
        with suppress(UnusableValueError):
            if not isinstance(bus, SerialBus):
                continue
            if _NUMBERED.fullmatch(bus.port):
                yield Finding(
                    ("buses", name, "port"),
                    "may be another device once a port has been re-plugged",
                    "write its path below /dev/serial/by-id (ls -l /dev/serial/by-id)",
                    fatal=False,
                    code=PORT_MAY_CHANGE,
                )
            yield from _check_streams(draft, name, bus)


def check_suffixes(draft: MachineFile) -> Iterator[Finding]:
    """What the device writes behind a number is the unit of the sensor, unless the scale converts it."""
    for index, sensor in enumerate(draft.sensors):
        with suppress(UnusableValueError):
            layout = draft.streams[sensor.stream].layout if sensor.stream in draft.streams else None
            if not isinstance(layout, LineLayout):
                continue
            channel = next((one for one in layout.channels if one.name == sensor.channel), None)
            if channel is not None and channel.suffix is not None:
                yield from _check_suffix(sensor, channel, channel.suffix, ("sensors", index, "unit"))


def _check_suffix(sensor: Sensor, channel: LineChannel, suffix: str, path: KeyPath) -> Iterator[Finding]:
    """A sensor has the unit that its channel has behind the number."""
    wanted = sensor.unit if sensor.sensitivity_mv_per_unit is None else "V"
    sent, taken = unit_of(suffix), unit_of(wanted)
    if sent is None or taken is None or sent == taken:
        return
    # 58.3° is a temperature more often than an angle.
    if sent.name == "deg" and taken.quantity == "temperature":
        return
    factor = factor_between(suffix, wanted)
    converts = channel.scale != 1.0 or channel.offset != 0.0
    if converts and (factor is None or math.isclose(abs(channel.scale), factor, rel_tol=_LIKE_SCALE)):
        return
    alike = sent.quantity == taken.quantity
    statement = f'the device writes "{suffix}" behind the number, but this sensor takes it as "{wanted}"'
    if factor is not None:
        off = abs(factor / channel.scale)
        statement += f": wrong by a factor of {max(off, 1 / off):.4g}"
    of_type = get_args(type(sensor).model_fields["unit"].annotation)
    remedies = []
    if sensor.sensitivity_mv_per_unit is None and (not of_type or sent.name in of_type):
        remedies.append(f'write unit = "{sent.name}"')
    if factor is not None:
        remedies.append(f'write scale = {factor:.6g} in the channel "{channel.name}", which converts it')
    elif alike:
        remedies.append(f'write scale and offset in the channel "{channel.name}", which convert it')
    else:
        remedies.append(f'correct suffix of the channel "{channel.name}", or unit and type of the sensor')
    yield Finding(path, statement, "; or ".join(remedies), fatal=alike and not converts, code=WRONG_SCALE)


def _check_id(bus: CobsBus | SyncBus, name: str, layout: SerialLayout, path: KeyPath) -> Iterator[Finding]:
    if bus.stream_ids and layout.stream_id is None:
        yield Finding(
            (*path, "stream_id"),
            f'is missing: frames on bus "{name}" begin with the id of their stream',
            f"add stream_id = 1, as the device sends it, or write stream_ids = false in [buses.{name}]",
            code=INCOMPLETE,
        )
    if not bus.stream_ids and layout.stream_id is not None:
        yield Finding(
            (*path, "stream_id"),
            f'has no effect: bus "{name}" carries no stream ids',
            f"write stream_ids = true in [buses.{name}], or remove it",
            code=NO_EFFECT,
        )


def _check_room(layout: SerialLayout, path: KeyPath) -> Iterator[Finding]:
    """Counter and samples lie within the payload and beside each other."""
    fields = [
        ("counter", "the counter", layout.counter.byte, layout.counter.end_byte),
        ("first_byte", "the samples", layout.first_byte, layout.samples_end_byte),
    ]
    for key, what, start, end in fields:
        if end > layout.payload_length:
            yield Finding(
                (*path, key),
                f"{what} would take bytes {start} to {end - 1} of a payload of {layout.payload_length} bytes",
                f"write payload_length = {end} or more, or fewer samples_per_frame",
                code=FIELD_OUTSIDE,
            )
    for (_, first, _, end), (key, what, later, later_end) in combinations(
        sorted(fields, key=lambda f: f[2]), 2
    ):
        if later < end:
            yield Finding(
                (*path, key),
                f"{what} (bytes {later} to {later_end - 1}) would overlap {first} (up to byte {end - 1})",
                f"move {what} to byte {end} or behind, as the device sends it",
                code=FIELDS_OVERLAP,
            )


def _check_columns(layout: LineLayout, path: KeyPath) -> Iterator[Finding]:
    """Every column is there once; a line has a counter, or the device's time."""
    if layout.separator == layout.decimal:
        yield Finding(
            (*path, "decimal"),
            "is the separator too, and a number would be two columns",
            'write separator = ";", or whatever the device puts between columns, or remove decimal',
            code=CONTRADICTION,
        )
    seen: set[str] = set()
    for place, name in enumerate(layout.line):
        if name in seen:
            yield Finding(
                (*path, "line", place),
                "is the name of an earlier column already",
                "give each column its own name",
                code=NAMED_TWICE,
            )
        seen.add(name)
    yield from _check_place(layout, path)
    for key, part in (("counter", layout.counter), ("time", layout.time)):
        if part is not None and part.column not in layout.line:
            yield Finding(
                (*path, key, "column"),
                "the line has no such column",
                choice(part.column, layout.line),
                code=NO_SUCH_NAME,
            )
    for index, channel in enumerate(layout.channels):
        if channel.name not in layout.line:
            yield Finding(
                (*path, "channels", index, "name"),
                "the line has no such column",
                choice(channel.name, layout.line),
                code=NO_SUCH_NAME,
            )


def _check_place(layout: LineLayout, path: KeyPath) -> Iterator[Finding]:
    """A line has a counter or the device's time, or the file states that it has neither."""
    if layout.counter is None and layout.time is None and not layout.no_counter:
        yield Finding(
            path,
            "has neither counter nor time: lost lines would not be noticed",
            'add counter = { column = "seq" } or time = { column = "t", unit = "ms" }, whichever it sends; '
            "if it sends neither, no_counter = true",
            code=LOSS_UNNOTICED,
        )
    elif layout.no_counter and (layout.counter is not None or layout.time is not None):
        yield Finding(
            (*path, "no_counter"),
            f"contradicts {'time' if layout.counter is None else 'counter'}",
            "leave it out if the device counts its lines or sends its time, else remove that",
            code=CONTRADICTION,
        )
    elif layout.no_counter:
        yield Finding(
            (*path, "no_counter"),
            "lets lost lines be estimated from the times of arrival: a few lost ones are mostly not noticed",
            "have the device send a counter or its time; if it can send neither, leave it",
            fatal=False,
            code=LOSS_UNNOTICED,
        )
    if layout.counter is not None and layout.time is not None:
        yield Finding(
            (*path, "time"),
            "has no effect beside counter, which tells loss exactly",
            "remove time; its column may stay in line",
            code=NO_EFFECT,
        )


def _check_texts(layout: LineLayout, delimiter: str, path: KeyPath) -> Iterator[Finding]:
    """A text beside numbers has neither a separator nor the end of the line in it."""
    tables = [(("channels", index), channel) for index, channel in enumerate(layout.channels)]
    places = [((name,), getattr(layout, name)) for name in ("counter", "time")]
    texts = [
        ((*path, *where, key), getattr(table, key) or "")
        for where, table in (*places, *tables)
        if table is not None
        for key in ("prefix", "suffix")
    ]
    for where, text in (((*path, "prefix"), layout.prefix or ""), *texts):
        for what, mark in (("separator", layout.separator), ("delimiter", delimiter)):
            if mark in text:
                yield Finding(
                    where,
                    f"has the {what} {json.dumps(mark)} in it",
                    "correct one of them; what comes behind a separator is a separate column in line",
                    code=CONTRADICTION,
                )


def _check_time(layout: LineLayout, rate_hz: float, path: KeyPath) -> Iterator[Finding]:
    """The device's time may tell each line from the next one; whether it has decimals is not known here."""
    if layout.time is None or layout.counter is not None:
        return
    unit = layout.time.unit
    period = UNITS_PER_S[unit] / rate_hz
    if period < 1.0:
        why = (
            f"is longer than the {period:.4g} {unit} from line to line: if the device sends whole {unit}, "
            "several lines have the same time. A single lost line is then mostly not noticed"
        )
    elif 1.0 < period < HARDLY_LONGER:
        why = (
            f"is hardly shorter than the {period:.4g} {unit} from line to line: if the device sends whole "
            f"{unit}, some lines are taken for lost that are not"
        )
    else:
        return
    finer = next((one for one, per_s in UNITS_PER_S.items() if per_s >= EXACT_STAMPS * rate_hz), "us")
    yield Finding(
        path,
        why,
        f'have the device send a counter, or {finer} with unit = "{finer}"; if it sends decimals, e.g. '
        f"12.345 {unit}, leave it",
        fatal=False,
        code=TIMES_SHARED,
    )


def _check_streams(draft: MachineFile, name: str, bus: SerialBus) -> Iterator[Finding]:
    """The streams of a port can be told apart, and the port has time for them."""
    wanted = LineLayout if isinstance(bus, LinesBus) else SerialLayout
    owners: dict[object, str] = {}
    characters_per_s = 0.0
    for key, stream in draft.streams.items():
        with suppress(UnusableValueError):
            layout = stream.layout
            if stream.bus != name or not isinstance(layout, wanted):
                continue
            mark: object
            if isinstance(layout, LineLayout):
                mark, what, where = layout.prefix, "prefix", "a prefix"
            else:
                mark, what = layout.stream_id, "stream_id"
                where = f"a stream_id (with stream_ids = true in [buses.{name}])"
            if mark is None and isinstance(bus, CobsBus | SyncBus) and bus.stream_ids:
                continue  # that is reported already
            if owners and (mark is None or None in owners or mark in owners):
                owner = owners.get(mark, next(iter(owners.values())))
                yield Finding(
                    ("streams", key, "layout", what),
                    f'does not tell this stream from "{owner}" on the same port',
                    f"give each stream of a port {where} of its own, as the device sends it",
                    code=NOT_TOLD_APART,
                )
            owners[mark] = key
            characters_per_s += stream.rate_hz / layout.samples_per_frame * _least_characters(bus, layout)
    needed = characters_per_s * bus.bits_per_character
    if needed > BUSY * bus.baud:
        fits = needed <= bus.baud
        yield Finding(
            ("buses", name, "baud"),
            f"{'leaves little room' if fits else 'is too slow'}: the streams on the port need "
            f"{needed:,.0f} bit/s at least, {100 * needed / bus.baud:,.0f} % of it",
            "correct the rates of the streams, or set port and device to a faster rate",
            fatal=not fits,
            code=BUS_TOO_SLOW,
        )


def _least_characters(bus: SerialBus, layout: LineLayout | SerialLayout) -> int:
    """Characters that a frame or line takes at least."""
    if isinstance(layout, LineLayout):
        # A digit in each column, separators between them, and an end.
        prefix = 0 if layout.prefix is None else len(layout.prefix) + 1
        checksum = _CHECKSUM_CHARACTERS[bus.checksum] if isinstance(bus, LinesBus) else 0
        texts = sum(len(front) + len(behind) for front, behind in layout.beside.values())
        return prefix + 2 * len(layout.line) + texts + checksum
    if not isinstance(bus, CobsBus | SyncBus):
        return layout.payload_length
    length = layout.payload_length + bus.crc_bytes + bus.stream_ids
    # COBS: a byte in front of every 254 and a zero behind them all.
    return length + (len(bus.sync_word) // 2 if isinstance(bus, SyncBus) else -(-length // 254) + 1)
