"""What ``daqsvc sniff serial`` found on a port: in words, in figures, and as a machine file."""

from __future__ import annotations

import textwrap
from bisect import bisect_left, bisect_right
from operator import itemgetter
from typing import TYPE_CHECKING, NamedTuple

from daqsvc.rounding import counted
from drivers.names import FRAMES, SERIAL, bus_name, lines_stream, table_name, unused
from drivers.serial.ports import lasting_name
from drivers.serial.sniff_words import (
    ANY_BAUD,
    LINES_NEED,
    MUST_TURN,
    NO_NUMBERS,
    UNSEEN_WIDTH,
    absent_words,
    cut_off,
    frames_need,
    no_number_words,
    other_lines_words,
    overrun_words,
    seen_width,
    sync_words,
    turn_words,
    unchecked_words,
    width_words,
)
from drivers.sniffing import (
    Sniffed,
    SniffTable,
    quoted,
    rounded_rate,
    sensor_lines,
    unit_of_suffix,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from drivers.counter_search import FrameCounter
    from drivers.serial.recognise import Recognised
    from drivers.serial.recognise_frames import BinaryFrames
    from drivers.serial.recognise_lines import Column, TextLines
    from drivers.serial.sniff_json import SerialFigures

_SHOWN_LINES = 8
_SHOWN_ROWS = 8
_ROW = 16
_PER_S = {"s": 1.0, "ms": 1e3, "us": 1e6}
_FAST = (9600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 921_600, 2_000_000, 4_000_000, 12_000_000)
"""Baud rates to propose where the port has none."""
WAITING_S = 0.05
"""Within this time from the first byte on, those come that had been waiting in the port."""
LEAST_TEXT = 8
"""Bytes that are text by chance at a wrong baud rate once in 2000 times."""
_LEAST_ALIKE = 3
_FEW = 64
_SURELY = 1.05
_MOST_MISSING = 1.5
"""Steps of a counter per line, with lines missing; what seems more is a counter that began again."""
_WHOLE = 0.995
"""Share of the bytes in frames from which on the rest is not worth a word."""


class Heard(NamedTuple):
    """What came over an open port.

    Attributes:
        data: the bytes, the last `MOST_KEPT` of them.
        received: how many came.
        first_s: when the first came, host monotonic.
        last_s: when the last did.
        errors: characters that the UART found without a stop bit; 0 where it does not count.
        lost: why the port was lost; empty if it was not.
        waiting: how many of the bytes came within `WAITING_S`: most of them had been waiting in the port.
        marks: when the bytes came: how many had come by then, and the time, host monotonic, oldest first.
    """

    data: bytes
    received: int
    first_s: float
    last_s: float
    errors: int
    lost: str = ""
    waiting: int = 0
    marks: Sequence[tuple[int, float]] = ()

    def came_s(self, behind: int) -> float:
        """When that byte came behind which so many others came."""
        if not self.marks:
            return self.last_s - (self.last_s - self.first_s) * behind / max(self.received, 1)
        at = bisect_left(self.marks, self.received - behind, key=itemgetter(0))
        return self.marks[min(at, len(self.marks) - 1)][1]


class Tried(NamedTuple):
    """One baud rate: how it was opened, what came, and what that is."""

    baud: int
    parity: str
    heard: Heard
    recognised: Recognised

    @property
    def may_be_text(self) -> bool:
        """Whether the bytes may be text, although they may be too few to judge."""
        from drivers.serial.recognise import LEAST_PRINTABLE  # noqa: PLC0415 - only for who listens

        return self.heard.received >= LEAST_TEXT and self.recognised.printable >= LEAST_PRINTABLE


def too_few(tried: Sequence[Tried]) -> bool:
    """Whether so few bytes came at each of the baud rates that they cannot be judged."""
    return all(one.heard.received < _FEW and not one.recognised.sure for one in tried)


def all_alike(tried: Sequence[Tried]) -> bool:
    """Whether the bytes have a meaning at all baud rates: the port does not use them.

    A pseudo-terminal does not, nor do many devices that are the USB port themselves. Where a device sends
    little, the bytes are text at all of them.
    """
    if len(tried) > 1 and all(one.recognised.sure for one in tried):
        return True
    came = [one for one in tried if one.heard.received]
    return len(came) >= _LEAST_ALIKE and all(one.may_be_text for one in came)


def dump(data: bytes) -> str:
    """Bytes in hexadecimal beside what they are as text, 16 on a line."""
    rows = []
    for at in range(0, len(data), _ROW):
        row = data[at : at + _ROW]
        text = "".join(chr(byte) if 0x20 <= byte < 0x7F else "." for byte in row)
        rows.append(f"{at:06x}  {row.hex(' '):<{3 * _ROW - 1}}  {text}")
    return "\n".join(rows)


class Report(NamedTuple):
    """What was heard, in words, in figures and as a machine file."""

    port: str
    tried: Sequence[Tried]
    best: Tried
    asked: bool

    def sniffed(self) -> Sniffed:
        """All of it."""
        return Sniffed(list(self._parts()), self._figures(), self._fragment(), self._problem())

    @property
    def _what(self) -> TextLines | BinaryFrames | None:
        """What was found; a guess is none of it."""
        return self.best.recognised.what if self.best.recognised.sure else None

    @property
    def _any_baud(self) -> bool:
        """Whether all rates came out alike, or one brings more than it can carry."""
        return all_alike(self.tried) or self._is_overrun

    @property
    def _bits_per_s(self) -> float:
        """What comes; what had been waiting in the port is left out."""
        heard = self.best.heard
        bits = 2 + (7 if self.best.recognised.parity else 8) + (self._parity != "none")
        seconds = heard.last_s - heard.first_s - WAITING_S
        return bits * (heard.received - heard.waiting) / seconds if seconds > 0 else 0.0

    @property
    def _is_overrun(self) -> bool:
        """Whether more bytes come than the baud rate carries: a port that is USB itself has none."""
        return self._bits_per_s > _SURELY * self.best.baud

    @property
    def _baud(self) -> int:
        """The baud rate for the machine file: the least usual one that carries what comes."""
        from daqsvc.settings.buses import BUSY  # noqa: PLC0415 - brings the settings

        if not self._is_overrun:
            return self.best.baud
        return next((baud for baud in _FAST if BUSY * baud >= self._bits_per_s), _FAST[-1])

    @property
    def _parity(self) -> str:
        return self.best.recognised.parity or self.best.parity

    @property
    def _character(self) -> str:
        bits = 7 if self.best.recognised.parity else 8
        return f"{bits}{self._parity[0].upper()}1"

    def _rate_hz(self, what: TextLines | BinaryFrames | None) -> float | None:
        """Lines of one kind, or frames, a second; None where it cannot be known."""
        from drivers.serial.recognise_lines import TextLines  # noqa: PLC0415 - only for who listens

        heard = self.best.heard
        seconds = heard.last_s - heard.first_s
        if seconds <= 0 or what is None:
            return None
        if isinstance(what, TextLines):
            return _lines_hz(heard, what)
        per_frame = what.bytes_per_frame
        return max(heard.received - per_frame, 0) / per_frame / seconds or None

    def _sampling_hz(self, what: TextLines) -> float | None:
        """Lines of one kind a second by the device's own clock, where it sends one, else as they came."""
        column = self._time(what)
        unit = None if column is None else self._time_unit(what, column)
        if column is None or unit is None:
            return self._rate_hz(what)
        return _PER_S[unit] / column.per_line

    def _problem(self) -> str:
        heard = self.best.heard
        if heard.lost:
            return f"{self.port} was lost: {heard.lost}. Remedy: plug it in again and see `dmesg`"
        if not heard.received and not any(one.heard.received for one in self.tried):
            return (
                f"{self.port}: no byte came. Remedy: check that the device is powered and sends without "
                "being asked. Its TX must lead to RX of this port (for RS-485: A to A, B to B), and "
                "ground must be connected. A Modbus device must be asked: daqsvc sniff modbus"
            )
        if self._what is None and (few := self._too_few()):
            return few
        if self.best.recognised.is_enclosed:
            return (
                f"{self.port}: text comes between the bytes 02 (STX) and 03 (ETX), which daqsvc does not "
                "read. Remedy: set the device to lines that end with a line feed or a carriage return; else "
                "write a driver"
            )
        if self._what is None:
            tried = f"--baud {self.best.baud}" if self.asked else "each of the usual baud rates"
            return (
                f"{self.port}: bytes come, but by {tried} they are neither lines of text nor frames of one "
                f"length{self._guess()}. Remedy: state the device's rate by --baud; check that no other "
                "device drives the line"
            )
        return ""

    def _too_few(self) -> str:
        """What to do where too few bytes came to judge them; empty if there were more."""
        from drivers.serial.recognise import LEAST_BYTES  # noqa: PLC0415 - only for who listens

        if self.tried and too_few(self.tried):
            most = max(one.heard.received for one in self.tried)
            return (
                f"{self.port}: bytes come, but too few to judge the baud rate by: {most} at most at each of "
                "the usual ones. Remedy: have each tried for longer by --seconds, e.g. --seconds 20; or "
                "state the device's rate by --baud"
            )
        if self.best.heard.received < LEAST_BYTES:
            return (
                f"{self.port}: only {self.best.heard.received} bytes came, which are too few to tell what "
                "they are. Remedy: listen longer by --seconds, with --baud if the device's rate is known"
            )
        return ""

    def _guess(self) -> str:
        """What the bytes are most likely, in words; empty if they are like nothing."""
        from drivers.serial.recognise_lines import TextLines  # noqa: PLC0415 - only for who listens

        what, score = self.best.recognised.what, self.best.recognised.score
        if what is None:
            return ""
        if isinstance(what, TextLines):
            likely = "lines of text"
        elif what.framing == "cobs":
            likely = f"COBS frames of {what.length} bytes"
        else:
            likely = f"frames of {what.length} bytes behind {what.sync.hex(' ')}"
        return f"; most likely they are {likely}, but a score of {score:.2f} may be chance"

    def _parts(self) -> Iterator[str | SniffTable]:
        from drivers.serial.recognise_lines import TextLines  # noqa: PLC0415 - only for who listens

        heard = self.best.heard
        if len(self.tried) > 1:
            rows = [_tried_row(one) for one in self.tried]
            yield SniffTable(("bit/s", "bytes", "framing errors", "text", "score"), rows)
        if not heard.received:
            yield f"{self.port}: no byte came"
            return
        per_s = heard.received / max(heard.last_s - heard.first_s, 1e-3)
        line = f"{'any baud rate' if self._any_baud else f'{self.best.baud} bit/s'}, {self._character}"
        yield f"{self.port} at {line}: {heard.received} bytes, {per_s:.0f}/s"
        if self._is_overrun:
            yield overrun_words(self.best.baud, self._baud)
        begin = heard.data[: _ROW * _SHOWN_ROWS]
        yield f"The first bytes:\n{dump(begin)}"
        what = self._what
        if isinstance(what, TextLines):
            if what.others:
                yield f"{len(what.kinds)} kinds of lines, by their first column: {_prefixes(what)}"
            for kind in what.kinds:
                yield from self._lines(kind)
        elif what is not None:
            yield self._frames(what)

    def _lines(self, what: TextLines) -> Iterator[str | SniffTable]:
        shown = "\n".join(map(cut_off, what.lines[:_SHOWN_LINES]))
        yield f"The first lines:\n{shown}"
        words = [counted(len(what.columns), "column")]
        between = "blanks" if what.separator == " " else quoted(what.separator)
        words += [f"separated by {between}"] * bool(what.separator)
        words += ["numbers have a decimal comma"] * (what.decimal == ",")
        words += [f"each line begins with {what.prefix}"] * bool(what.prefix)
        words += ["the first line names them"] * what.header
        words += [f"checksum {what.checksum}"] * (what.checksum != "none")
        if what.damaged:
            words.append(_other_lines(what))
        rate_hz = self._rate_hz(what)
        rate = "" if rate_hz is None else f", {rate_hz:.4g} lines/s"
        yield f"Lines of text{rate}: {'; '.join(words)}"
        counter, time_column = _counter(what), self._time(what)
        rows = []
        for one in what.columns:
            # As the device writes them, and as the last one is shown.
            limits = [
                f"{end:g}".replace(".", what.decimal) if one.numeric else "" for end in (one.least, one.most)
            ]
            use = "counts" if one is counter else "time" if one is time_column else ""
            use = f"counts to {one.turns_at - 1}" if one.turns_at else use
            use = ", ".join(filter(None, (use, f"in {one.unit}" if one.unit else "")))
            rows.append((one.name, "number" if one.numeric else "text", *limits, one.last[:24], use))
        yield SniffTable(("column", "kind", "min", "max", "last", ""), rows)
        yield from (turn_words(one.name, one.turns_at) for one in what.columns if one.turns_at)
        yield from self._not_read(what, {one: one.name for one in what.columns})

    def _not_read(self, what: TextLines, names: Mapping[Column, str]) -> Iterator[str]:
        """What of the lines does not become samples, beside those of another layout; names by column."""
        heard = len(what.lines) - len(what.damaged)
        yield from (
            absent_words(names[one], one.absent, heard, one.absent_text) for one in what.columns if one.absent
        )
        texts = {names[one]: one.last for one in what.columns if not one.numeric}
        if texts and len(texts) < len(what.columns):
            yield no_number_words(texts)

    def _time(self, what: TextLines) -> Column | None:
        """The column that has the device's time, if none counts."""
        if _counter(what) is not None:
            return None
        growing = [one for one in what.columns if one.grows and self._time_unit(what, one) is not None]
        return growing[0] if growing else None

    def _time_unit(self, what: TextLines, column: Column) -> str | None:
        """The unit in which a column grows by as much as lines take; None if there is none."""
        from drivers.serial.recognise_lines import TIME_UNITS  # noqa: PLC0415 - only for who listens

        rate_hz = self._rate_hz(what)
        if rate_hz is None:
            return None
        for unit, per_s in _PER_S.items():
            if column.unit and TIME_UNITS[column.unit] != unit:
                continue
            if 0.8 < column.per_line * rate_hz / per_s < 1.25:
                return unit
        return None

    def _frames(self, what: BinaryFrames) -> str:
        name = "COBS frames"
        if what.framing == "sync":
            name = f"Frames behind the sync word {what.sync.hex(' ')}"
        rate_hz = self._rate_hz(what)
        rate = "" if rate_hz is None else f", {rate_hz:.4g} frames/s"
        check = "no check that is known"
        if what.crc:
            order = f", {what.crc_order} endian" if what.crc_bytes > 1 else ""
            begin = "" if what.crc_from or not what.sync else ", sync word included"
            check = f"check {what.crc}{order}{begin}"
            count = len(what.frames) + what.damaged
            share = f"{100 * what.passing:.0f} %" if what.damaged else "all"
            check += f", passes in {share} of {count} frames"
        sync = f"\n{sync_words(what.sync.hex())}" if what.sync and not what.crc else ""
        packed = _packed(what)
        counter = f"counter at {what.counter}" if what.counter else "no counter"
        guess = (
            f"\n{width_words(packed.counter.bits, packed.counter.step, rate_hz)}"
            if packed and packed.is_guess
            else ""
        )
        stray = ""
        if what.coverage < _WHOLE:
            stray = f"; {100 * (1 - what.coverage):.0f} % of the bytes are in no frame"
        return (
            f"{name}{rate}: {what.length} bytes, of them {what.payload_length} of payload; {check}; "
            f"{counter} (bytes of the payload count from 0){stray}{guess}{sync}"
        )

    def _figures(self) -> SerialFigures:
        from drivers.serial.recognise_lines import TextLines  # noqa: PLC0415 - only for who listens

        heard, what = self.best.heard, self._what
        figures: SerialFigures = {
            "bus": "serial",
            "port": self.port,
            "baud": self._baud,
            "overrun_baud": self.best.baud if self._is_overrun else None,
            "any_baud": self._any_baud,
            "character": self._character,
            "bytes": heard.received,
            "framing_errors": heard.errors,
            "score": round(self.best.recognised.score, 3),
            "tried": [{"baud": one.baud, "score": round(one.recognised.score, 3)} for one in self.tried],
            "first_bytes": heard.data[: _ROW * _SHOWN_ROWS].hex(),
            "rate_hz": self._sampling_hz(what) if isinstance(what, TextLines) else self._rate_hz(what),
            "framing": None,
        }
        if isinstance(what, TextLines):
            counter, time_column = _counter(what), self._time(what)
            figures |= {
                "framing": "lines",
                "delimiter": what.delimiter,
                "separator": what.separator,
                "decimal": what.decimal,
                "prefix": what.prefix,
                "checksum": what.checksum,
                "header": what.header,
                "columns": [
                    {
                        "name": one.name,
                        "numeric": one.numeric,
                        "prefix": one.prefix or None,
                        "unit": one.unit or None,
                        "min": one.least,
                        "max": one.most,
                        "counts": one is counter,
                        "turns_at": one.turns_at or None,
                        "time_unit": self._time_unit(what, one) if one is time_column else None,
                        "last": one.last,
                        "swings": one.swings,
                        "absent": one.absent,
                        "absent_text": one.absent_text if one.absent else None,
                        "bits": one.bits or None,
                    }
                    for one in what.columns
                ],
                "lines": list(what.lines[:_SHOWN_LINES]),
                "other_prefixes": [one.prefix for one in what.others],
                "lines_heard": len(what.lines),
                "lines_damaged": len(what.damaged),
                "damaged_line": what.damaged[0] if what.damaged else None,
            }
        elif what is not None:
            figures |= {
                "framing": what.framing,
                "sync_word": what.sync.hex(),
                "frame_length": what.length,
                "payload_length": what.payload_length,
                "crc": what.crc,
                "crc_order": what.crc_order,
                "crc_bytes": what.crc_bytes,
                "crc_from": what.crc_from,
                "frames_passing": round(what.passing, 4),
                "counter": None if what.counter is None else what.counter._asdict(),
                "counter_bits": None if (packed := _packed(what)) is None else packed.counter.bits,
                "counter_byte": None if packed is None else packed.counter.byte,
                "counter_order": None if packed is None else packed.counter.order,
                "counter_guess": packed is not None and packed.is_guess,
            }
        return figures

    def _fragment(self) -> str:
        from drivers.serial.recognise_lines import TextLines  # noqa: PLC0415 - only for who listens

        what = self._what
        if what is None:
            return ""
        name = bus_name(self.port, SERIAL)
        head = [
            f"[buses.{name}]",
            'driver = "serial"',
            f"port = {quoted(lasting_name(self.port))}",
            f"baud = {self._baud:_}{f'    # {ANY_BAUD}' if self._any_baud else ''}",
        ]
        head += ["data_bits = 7"] * (self.best.recognised.parity is not None)
        head += [f"parity = {quoted(self._parity)}"] * (self._parity != "none")
        if isinstance(what, TextLines):
            return "\n".join([*head, *self._lines_tables(what, name)])
        return "\n".join([*head, *self._frames_tables(what, name)])

    def _lines_tables(self, what: TextLines, bus: str) -> Iterator[str]:
        yield 'framing = "lines"'
        if what.checksum in {"xor", "crc16"}:
            yield f"checksum = {quoted(what.checksum)}"
        if what.delimiter != "\n":
            yield f"delimiter = {quoted(what.delimiter)}"
        sensors: set[str] = set()
        for kind in what.kinds:
            yield ""
            yield from self._stream(kind, bus, sensors, of_several=bool(what.others))

    def _stream(self, what: TextLines, bus: str, sensors: set[str], *, of_several: bool) -> Iterator[str]:
        stream = lines_stream(what.prefix)
        counter, time_column = _counter(what), self._time(what)
        # What begins again after 999 counts, and measures nothing.
        numbers = [
            one
            for one in what.columns
            if one.numeric and not one.turns_at and one not in {counter, time_column}
        ]
        place, rate_hz = counter or time_column, self._sampling_hz(what)
        if not numbers or rate_hz is None:
            if what.prefix:
                yield f"# Lines that begin with {what.prefix}:"
            if not any(one.numeric for one in what.columns):
                yield f"# {NO_NUMBERS}"
            yield from (
                f"# {line}" for line in textwrap.wrap(f"{LINES_NEED}; have the device send them.", 90)
            )
            return
        names = _names(what.columns)
        yield from self._remarks(what, names)
        yield f"[streams.{stream}]"
        yield f"bus = {quoted(bus)}"
        yield f"rate_hz = {rounded_rate(rate_hz)}    # as measured; see the device's manual"
        yield ""
        yield f"[streams.{stream}.layout]"
        if what.prefix:
            yield f"prefix = {quoted(what.prefix)}"
        yield f"line = [{', '.join(quoted(name) for name in names.values())}]"
        if what.separator not in {",", ""}:  # of one column there is none
            yield f"separator = {quoted(what.separator)}"
        if what.decimal != ".":
            yield f"decimal = {quoted(what.decimal)}"
        if counter is not None:
            yield from _counter_lines(counter, names[counter])
        elif place is None:
            yield "no_counter = true    # none was seen, and no time: losses are estimated from the arrivals"
        else:
            unit = self._time_unit(what, place)
            yield f'time = {{ column = {quoted(names[place])}, unit = "{unit}"{_texts(place)} }}'
        listed = [f"{{ name = {quoted(names[one])}{_texts(one)} }}" for one in numbers]
        comment = ""
        if any(map(_texts, numbers)):
            comment = "    # a line with other texts there is not read: it is counted as damaged"
        yield f"channels = [{', '.join(listed)}]{comment}"
        channels = {names[one]: unit_of_suffix(one.unit) for one in numbers}
        swinging = {names[one] for one in numbers if one.swings}
        by_stream = of_several and bool(what.prefix)
        yield from sensor_lines(
            stream, channels, sensors, rate_hz, by_stream=by_stream, guess=True, swinging=swinging
        )

    def _remarks(self, what: TextLines, names: Mapping[Column, str]) -> Iterator[str]:
        """What of the lines the file does not read, as comments."""
        others = [f"{_other_lines(what)}."] if what.damaged else []
        for remark in (*others, *self._not_read(what, names)):
            yield from (f"# {line}" for line in textwrap.wrap(remark, 98))

    def _frames_tables(self, what: BinaryFrames, bus: str) -> Iterator[str]:
        yield f"framing = {quoted(what.framing)}"
        if what.sync and not what.crc:
            yield from (f"# {line}" for line in textwrap.wrap(sync_words(what.sync.hex()), 98))
        if what.sync:
            yield f"sync_word = {quoted(what.sync.hex())}"
        driver_checks = what.crc in {"ibm-3740", "xmodem"} and what.crc_from == len(what.sync)
        if what.crc and not driver_checks:
            yield f"# {unchecked_words(what.crc)}"
        yield f"crc = {quoted(what.crc if driver_checks else 'none')}"
        if driver_checks and what.crc_order == "little":
            yield 'crc_order = "little"'
        payload = what.payload_length + (0 if driver_checks else what.crc_bytes)
        yield ""
        packed = _packed(what)
        rate_hz = self._rate_hz(what)
        if packed is None or rate_hz is None:
            needed = f"{frames_need(payload)}. See the manual of the device."
            yield from (f"# {line}" for line in textwrap.wrap(needed, 90))
            return
        counter, samples = packed.counter, packed.samples_per_frame
        if packed.is_guess:
            yield from (
                f"# {line}" for line in textwrap.wrap(width_words(counter.bits, counter.step, rate_hz), 98)
            )
        yield f"[streams.{FRAMES}]"
        yield f"bus = {quoted(bus)}"
        yield f"rate_hz = {rounded_rate(rate_hz * samples)}    # as measured; see the device's manual"
        yield ""
        guess = "what is behind the counter is a guess: see the device's manual"
        yield f"[streams.{FRAMES}.layout]    # {guess}"
        yield f"payload_length = {payload}"
        known = f"as the counter has; {'little' if counter.order == 'big' else 'big'} if the values jump"
        if counter.bits == 8:
            known = "a guess; big if the values jump"
        yield f'byte_order = "{counter.order}"    # {known}'
        counts = "frames" if counter.step == 1 else "samples"
        yield f'counter = {{ byte = {counter.byte}, bits = {counter.bits}, counts = "{counts}" }}'
        yield f"first_byte = {counter.byte + counter.bits // 8}"
        yield f"samples_per_frame = {samples}"
        names = [f"c{k + 1}" for k in range(packed.channels)]
        listed = ", ".join(f'{{ name = "{one}", type = "int16", scale = 1.0 }}' for one in names)
        yield f"channels = [{listed}]"
        yield from sensor_lines(FRAMES, dict.fromkeys(names, "1"), set(), rate_hz * samples, guess=True)


class _Packed(NamedTuple):
    """How samples of two bytes may lie behind the counter of a frame."""

    counter: FrameCounter
    samples_per_frame: int
    channels: int
    is_guess: bool


def _packed(what: BinaryFrames) -> _Packed | None:
    """What fits; None if nothing does."""
    if what.counter is None:
        return None
    payloads = what.frames[:, len(what.sync) : len(what.sync) + what.payload_length]
    counter, is_guess = _widened(what.counter, payloads)
    room = what.payload_length - counter.byte - counter.bits // 8
    channels = room // (2 * counter.step)
    return None if channels < 1 else _Packed(counter, counter.step, channels, is_guess)


def _widened(counter: FrameCounter, payloads: NDArray[np.uint8]) -> tuple[FrameCounter, bool]:
    """A counter with the bytes beside it that it may have, too; and whether that is a guess.

    Args:
        counter: by what was seen of it.
        payloads: uint8 ``[n, length]``.
    """
    still = (payloads == payloads[0]).all(axis=0)
    byte, end, length = counter.byte, counter.byte + counter.bits // 8, payloads.shape[1]
    is_guess = False
    if counter.bits == 8:
        carried = (payloads[1:, byte] < payloads[:-1, byte]).any()
        behind, before = end < length and still[end], byte > 0 and still[byte - 1]
        if carried or not (behind or before):
            return counter, False
        is_guess = True
        if before and not payloads[0, byte - 1] and not (behind and not payloads[0, end]):
            # Samples of two bytes fill what is behind it; they do not behind a byte more or less.
            if (length - end) % 2:
                return counter, is_guess
            counter = counter._replace(byte=byte - 1, bits=16, order="big")
        elif behind and (length - end) % 2:
            counter, end = counter._replace(bits=16), end + 1
        else:
            return counter, is_guess
    if counter.order == "little" and length - byte >= 6 and not payloads[:, end : end + 2].any():
        # The upper half of 32 bits, which has not carried yet.
        return counter._replace(bits=32), True
    return counter, is_guess


def _lines_hz(heard: Heard, what: TextLines) -> float | None:
    """Lines of the layout a second, from the first to the last; None where it cannot be known.

    Those that had been waiting in the port came at once: the last of them is the first that counts. Where a
    column counts lines, those that are missing count, too.
    """
    times = [heard.came_s(behind) for behind in what.behind]
    first = max(bisect_right(times, heard.first_s + WAITING_S) - 1, 0)
    if len(times) - first < 2 or times[-1] <= times[first]:
        return None
    counter = _counter(what)
    per_line = 1.0 if counter is None or not 1 <= counter.per_line < _MOST_MISSING else counter.per_line
    return (len(times) - 1 - first) * per_line / (times[-1] - times[first])


def _tried_row(one: Tried) -> Sequence[str]:
    heard, recognised = one.heard, one.recognised
    return (
        f"{one.baud}{'' if one.parity == 'none' else f', {one.parity} parity'}",
        f"{heard.received}",
        f"{heard.errors}",
        f"{100 * recognised.printable:.0f} %",
        f"{recognised.score:.2f}",
    )


def _other_lines(what: TextLines) -> str:
    return other_lines_words(len(what.damaged), len(what.lines), what.damaged[0])


def _counter(what: TextLines) -> Column | None:
    """The column that counts lines: whole numbers, always by 1, to a power of two."""
    counts = (one for one in what.columns if one.numeric and one.step == 1 and one.least >= 0)
    return next((one for one in counts if not one.turns_at), None)


def _prefixes(what: TextLines) -> str:
    """The words by which kinds of lines are told apart."""
    return ", ".join(kind.prefix for kind in what.kinds)


def _counter_lines(counter: Column, name: str) -> Iterator[str]:
    """The key of the column that counts lines.

    One that is taken too narrow loses all lines once it is past its width: only what was seen is stated.
    """
    bits = f", bits = {counter.bits}" if counter.bits else ""
    if not bits:
        yield from (f"# {line}" for line in textwrap.wrap(UNSEEN_WIDTH, 98))
    known = seen_width(counter.bits) if bits else f"as far as it was seen: {MUST_TURN}"
    yield f"counter = {{ column = {quoted(name)}{bits}{_texts(counter)} }}    # {known}"


def _texts(column: Column) -> str:
    """The keys for the texts around the number of a column; empty without any."""
    texts = {"prefix": column.prefix, "suffix": column.unit}
    return "".join(f", {key} = {quoted(text)}" for key, text in texts.items() if text)


def _names(columns: Sequence[Column]) -> dict[Column, str]:
    """Names of columns that a machine file can have, each once."""
    taken: set[str] = set()
    return {one: unused(table_name(one.name, "column"), taken) for one in columns}
