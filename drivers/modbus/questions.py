"""What ``daqsvc new`` asks about the registers of a Modbus unit."""

from __future__ import annotations

import math
import re
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, ClassVar

from drivers import questions as q
from drivers.bus_questions import (
    BusQuestions,
    only_port,
    seconds_of,
    unit_by_name,
)
from drivers.modbus import heard
from drivers.modbus.heard import register_count
from drivers.modbus.manual_addresses import (
    doubt_of,
    doubt_of_channel,
    doubt_of_registers,
    doubt_with_table,
    table_meant,
)
from drivers.modbus.proposed import TIMEOUT_MS, unit_of_register
from drivers.modbus.sniff import AUTO, LAST_REGISTER, ModbusSniffer, registers_of, units_of
from drivers.names import MODBUS, unit_stream
from drivers.questions import NONE, Answers, Question, Topic, sensor_key
from drivers.sniffing import NothingFoundError, SniffError, is_waveform_rate, sniffed
from drivers.toml_lines import Hexadecimal, array, entry

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from drivers.bus_questions import Heard


REGISTERS = ("uint16", "int16", "uint32", "int32", "float32", "uint64", "int64", "float64")
_OF_SAMPLES = REGISTERS[:5]
_WAYS = {
    "values": "levels that the device measures itself",
    "waveform": "blocks of samples",
    "ring": "the last samples in a ring, with a count of all",
    "fifo": "a queue of samples, emptied by function 24",
}
_ORDERS = ("ABCD", "CDAB", "BADC", "DCBA")
_COUNT_BITS = {"16": "", "32": ""}
ADDRESSES = 65_536
_READ_REGISTERS, _FIFO_REGISTERS = 125, 31
"""Of one reply."""
_UNITS, _WHOLE = ("1-10", "11-247"), "1-247"
"""Most devices have one of the first addresses; to ask for all takes two minutes."""
_OTHERS = f"To see which other units answer, add --units {_WHOLE}"


class _ModbusQuestions(BusQuestions):
    """Registers of a unit."""

    listens_behind = "registers"
    for_listening = ("registers",)
    narrowed_by: ClassVar[Mapping[str, str]] = {"units": "unit"}
    topics: ClassVar[Mapping[str, Topic]] = {
        "units": Topic(
            "Which units does --listen look for?",
            "auto: 1-10, and 11-247 if none of those answers. Else addresses, e.g. 1-247 or 5,17.",
        ),
        "registers": Topic(
            "Which registers does --listen read, e.g. 4000-4100?",
            "As on the wire, from 0: see the register map of the device. Hexadecimal with 0x: 0x1000-0x1030. "
            "auto: 0 to 200, and on if the last one exists.",
        ),
        "timeout-ms": Topic(
            "How long may the unit take to answer, in ms",
            "500 is enough for most. A slow unit, or one behind a gateway, needs more, e.g. 1500.",
        ),
        "unit": Topic(
            "Address of the unit (slave id)", "1 to 247; set in the device, by switches or software."
        ),
        "way": Topic(
            "What does the device give?",
            "values: it measures levels itself, e.g. velocity RMS; waveform: it takes a block of samples now "
            "and then; ring, fifo: it samples all the time, and keeps the last samples until they are read.",
        ),
        "table": Topic(
            "Which registers are they?",
            "Manuals call holding registers 40001 and on, input registers 30001 and on.",
        ),
        "max-count": Topic(
            "Most registers that a request may read",
            "125 by Modbus; less if the device refuses that as an illegal data value. See its manual.",
        ),
        "block-id": Topic("Register that changes with every block", "As on the wire, from 0: 40001 is 0."),
        "block-address": Topic("First register of the block", "As on the wire, from 0: 40001 is 0."),
        "samples": Topic("Samples of each channel in a block", "The device's manual states it."),
        "count-address": Topic(
            "Register that counts the samples in the ring", "As on the wire, from 0: 40001 is 0."
        ),
        "count-bits": Topic("Width of the count of samples, in bits", "16: one register. 32: two of them."),
        "ring-address": Topic("First register of the ring", "As on the wire, from 0: 40001 is 0."),
        "depth": Topic("Samples of each channel that the ring holds", "A power of two, e.g. 1024."),
        "fifo-address": Topic("Pointer of the queue", "The address that function 24 is given, from 0."),
        "acknowledge": Topic(
            "Register to which the read position of the queue is written",
            "As on the wire, from 0. none if the device drops what it has handed out.",
        ),
    }
    channel_topics: ClassVar[Mapping[str, Topic]] = {
        "address": Topic("Register of {channel}", "As on the wire, from 0: what a manual calls 40001 is 0."),
        "register-type": Topic(
            "What do the registers of {channel} hold?",
            "The register map states it. One register: uint16 (UINT, WORD, unsigned) or int16 (INT, signed). "
            "Two: uint32 (UDINT, ULONG, DWORD), int32 (DINT, LONG) or float32 (REAL, FLOAT, IEEE 754). Four: "
            "uint64, int64 or float64 (LREAL, DOUBLE). Of a status word take uint16.",
        ),
        "bits": Topic(
            "Which bits of {channel} are wanted?",
            "Of a status or alarm word: the number of one bit, from 0 for the lowest, e.g. 3; or the first "
            "and the last of several, e.g. 4-7. none takes the whole number.",
        ),
        "order": Topic("Byte order of {channel}", "ABCD is the usual one; CDAB has its words exchanged."),
        "no-value": Topic(
            "Which raw value of {channel} means that the device has none?",
            "E.g. 0x7FFF where a sensor is broken or missing: see the register map. none if there is none.",
        ),
        "scale": Topic(
            "What is one count of {channel} worth?",
            "In the unit of the value, e.g. 0.01 mm/s; see the register map. 1 takes the number as it is.",
        ),
    }

    def listen(
        self, answers: Answers, folder: Path, stop: threading.Event, tell: Callable[[str], None]
    ) -> Heard:
        """See `BusQuestions.listen`: units are asked for their registers, and nothing is written."""
        del folder
        chosen: str = answers["units"]
        registers = [] if answers["registers"] == AUTO else ["--registers", answers["registers"]]
        timeout = ["--timeout-ms", f"{answers['timeout-ms']:g}"]
        words = [*timeout, *seconds_of(answers), *registers, *self._sniffed_as(answers)]
        try:
            first = _UNITS[0] if chosen == AUTO else chosen
            figures = sniffed(ModbusSniffer(), ["--units", first, *words], stop, tell)
        except NothingFoundError as error:
            # A server that answers for units that it does not have answers alike for all of these.
            alike = error.figures.get("units_alike", False) and error.figures["units_asked"] == _first_units()
            further = chosen == AUTO and not stop.is_set()
            if error.figures.get("units") and not (alike and further):
                return heard.HeardNoRegisters(error.figures, answers["registers"])
            # Some unit answers, and too late: no other one is to be taken for it.
            late = error.figures.get("replies_late") and not error.figures.get("units")
            if not further or late:
                if not error.figures.get("units") and chosen.isdecimal():
                    raise NothingFoundError(f"{error}. {_OTHERS}", error.figures) from error
                raise
            why = "has such registers" if alike else "answers"
            tell(f"none of units {_UNITS[0]} {why}: {_UNITS[1]} are asked, too; Ctrl-C ends that")
            try:
                figures = sniffed(ModbusSniffer(), ["--units", _UNITS[1], *words], stop, tell)
            except NothingFoundError as other:
                if other.figures.get("units"):
                    return heard.HeardNoRegisters(other.figures, answers["registers"])
                raise
        except SniffError as error:
            raise SniffError(f"{error}".replace("TARGET", "its address")) from error
        if not any(one["registers"] for one in figures["tables"]):
            units = ", ".join(f"{unit}" for unit in figures["units"])
            raise NothingFoundError(
                f"the registers of unit {units} were not read yet when it was ended. Remedy: let it go on, "
                "or write --units N if the unit is known"
            )
        lines = list(heard.in_words(figures, answers["timeout-ms"]))
        if chosen == AUTO and figures["units_asked"][0] == int(_UNITS[0].partition("-")[0]):
            lines.append(f"units {_UNITS[1]} were not asked: daqsvc new --listen --units {_WHOLE} asks all")
        return heard.HeardUnits(figures, lines, answers["registers"], self._next_address)

    def _ask_timeout(self) -> Question:
        return self.ask("timeout-ms", q.number_in("ms"), f"{TIMEOUT_MS:g}")

    def _ask_units(self) -> Question:
        """Which units are to be found; only an option is asked for them."""
        return self.ask("units", _units, AUTO, quiet=True)

    def _ask_registers(self, answers: Answers) -> Question:
        """Which registers are to be read; only who listens is asked for them."""
        return self.ask("registers", _registers, AUTO, doubt=partial(doubt_of_registers, answers))

    def _sniffed_as(self, answers: Answers) -> Sequence[str]:
        """Arguments of the sniffer that state where the units are."""
        raise NotImplementedError

    def questions(self, answers: Answers, folder: Path) -> Iterator[Question]:
        """See `BusQuestions.questions`."""
        del folder
        yield from self._line(answers)
        chosen: str = answers["units"]
        yield self.ask("unit", q.whole, "1" if chosen == AUTO else f"{units_of(chosen)[0]}")
        yield self.choose("way", _WAYS, "values")
        way = answers["way"]
        if way != "fifo":
            likely = table_meant(answers, "registers") or "holding"
            yield self.choose("table", dict.fromkeys(("holding", "input"), ""), likely)
        if way == "values":
            yield self.ask("max-count", q.whole, f"{_READ_REGISTERS}", quiet=True)
        yield self.ask("channels", q.names, "vibration, temperature" if way == "values" else "x")
        if way == "values":
            return
        yield self.choose("raw-type", dict.fromkeys(_OF_SAMPLES, ""), "int16")
        yield self.ask("scale", q.number, "0.001")
        ways = {"waveform": self._ask_waveform, "ring": self._ask_ring, "fifo": self._ask_fifo}
        yield from ways[way](answers)

    def _ask_address(self, answers: Answers, key: str, default: str) -> Iterator[Question]:
        """A register of the table that the stream reads; a number of the manual states which one that is."""
        yield self.ask(key, q.whole, default, doubt=partial(doubt_with_table, answers, key))
        answers["table"] = table_meant(answers, key) or answers["table"]

    def _ask_waveform(self, answers: Answers) -> Iterator[Question]:
        yield from self._ask_address(answers, "block-id", "0")
        yield from self._ask_address(answers, "block-address", "100")
        yield self.ask("samples", q.whole, f"{max(min(4096, 60_000 // _sample_registers(answers)), 1)}")

    def _ask_ring(self, answers: Answers) -> Iterator[Question]:
        yield from self._ask_address(answers, "count-address", "0")
        yield self.choose("count-bits", _COUNT_BITS, "32")
        count = answers["count-address"]
        behind = count + 2 if count < ADDRESSES // 2 else 0
        yield from self._ask_address(answers, "ring-address", f"{16 if count + 2 <= 16 else behind}")
        begin = answers["ring-address"]
        room = (count if begin < count else ADDRESSES) - begin
        places = max(min(1024, room // _sample_registers(answers)), 2)
        yield self.ask("depth", q.whole, f"{2 ** (places.bit_length() - 1)}")

    def _ask_fifo(self, answers: Answers) -> Iterator[Question]:
        del answers
        yield self.ask("fifo-address", q.whole, "0", doubt=doubt_of)
        yield self.choose("count-bits", _COUNT_BITS, "16")
        yield self.ask("acknowledge", q.whole_or_none, NONE, doubt=doubt_of)

    def rate_hz(self, answers: Answers) -> float:
        """See `BusQuestions.rate_hz`."""
        if answers["way"] in {"values", "waveform"}:
            return 2560.0 if answers["way"] == "waveform" else 1.0
        most = self._most_hz(answers)
        return next((rate for rate in (2560.0, 1280.0, 640.0, 100.0, 10.0, 1.0, 0.1) if rate <= most), 0.01)

    def _most_hz(self, answers: Answers) -> float:
        """Samples a second that the line has time for, with room to spare."""
        del answers
        return math.inf

    def bus_name(self, answers: Answers) -> str:
        """See `BusQuestions.bus_name`."""
        del answers
        return MODBUS

    def stream_name(self, answers: Answers) -> str:
        """See `BusQuestions.stream_name`."""
        return unit_stream(answers["unit"], answers.get("table", "holding"))

    def of_channel(self, answers: Answers, channel: str) -> Iterator[Question]:
        """See `BusQuestions.of_channel`."""
        if answers["way"] != "values":
            return

        types, orders = dict.fromkeys(REGISTERS, ""), dict.fromkeys(_ORDERS, "")
        following = f"{self._next_address(answers, channel)}"
        key = sensor_key(channel, "address")
        only = channel == answers["channels"][0]
        doubted = partial(doubt_with_table, answers, key, fixed=not only)
        doubt = partial(
            doubt_of_channel,
            doubted,
            self._taken(answers, channel),
            following,
            _to_read(answers["registers"]),
        )
        yield self.ask_of(channel, "address", q.whole, following, doubt=doubt)
        if only:
            answers["table"] = table_meant(answers, key) or answers["table"]
        unit = _unit(channel)
        default = "int16" if unit == "degC" else "uint16"
        yield self.ask_of(channel, "register-type", q.one_of(types), default, choices=types)
        wide = register_count(answers[sensor_key(channel, "register-type")]) > 1
        is_word = _WORD.search(channel) is not None and _is_unsigned(answers, channel)
        yield self.ask_of(channel, "bits", _bits, NONE, quiet=not is_word)
        yield self.ask_of(channel, "order", _order, "ABCD", choices=orders, quiet=not wide)
        is_float = answers[sensor_key(channel, "register-type")].startswith("float")
        scale = "1" if is_float else _USUAL_SCALES.get(unit or "", "1")
        yield self.ask_of(channel, "scale", q.number, scale)
        yield self.ask_of(channel, "no-value", q.whole_or_none, NONE, quiet=True)

    def _taken(self, answers: Answers, channel: str) -> dict[int, str]:
        """Which registers hold the channels before."""
        taken: dict[int, str] = {}
        for before in answers["channels"][: answers["channels"].index(channel)]:
            first = answers[sensor_key(before, "address")]
            width = register_count(answers[sensor_key(before, "register-type")])
            taken.update(dict.fromkeys(range(first, first + width), before))
        return taken

    def _next_address(self, answers: Answers, channel: str) -> int:
        """Behind the registers of all channels before."""
        end = 0
        for before in answers["channels"]:
            if before == channel:
                break
            width = register_count(answers[sensor_key(before, "register-type")])
            end = max(end, answers[sensor_key(before, "address")] + width)
        return end if end < 65_535 else 0

    def sensor_types(self, answers: Answers) -> tuple[str, ...]:
        """See `BusQuestions.sensor_types`: what is polled is no waveform."""
        if answers["way"] != "values":
            return ("accelerometer", "velocity", "proximity", "trend", NONE)
        return ("trend", NONE)

    def guess(self, answers: Answers, channel: str) -> tuple[str, str | None]:
        """See `BusQuestions.guess`."""
        if answers["way"] != "values":
            return ("accelerometer" if is_waveform_rate(answers["rate"]) else "trend"), None
        unit, kind = _unit(channel), answers[sensor_key(channel, "register-type")]
        return "trend", unit_of_register(kind) if unit == "count" else unit

    def tables(self, answers: Answers) -> Iterator[str]:
        """See `BusQuestions.tables`."""
        yield f"[buses.{self.bus_name(answers)}]"
        yield entry("driver", "modbus")
        yield from self._line_keys(answers)
        yield entry("timeout_ms", answers["timeout-ms"], "how long the unit may take to answer")
        written = answers.get("acknowledge")
        if written is not None:
            count = int(answers["count-bits"]) // 16
            writes = [{"unit": answers["unit"], "address": written, "count": count}]
            yield entry("writes", writes, "nothing else is ever written")
        yield ""
        way = answers["way"]
        comments = {"values": "how often the values are read", "waveform": "within a block"}
        yield from self.stream(answers, comments.get(way, "samples a second of each channel"))
        yield "# Addresses count from 0, as on the wire: what a manual calls 40001 (or 30001) is address 0."
        yield entry("way", "registers" if way == "values" else way)
        yield entry("unit", answers["unit"], "address of the unit, its slave id")
        if way != "fifo":
            yield entry("table", answers["table"], '"holding" (40001 ...) or "input" (30001 ...)')
        if way == "values":
            yield from self._registers(answers)
            return
        ways = {"waveform": self._waveform, "ring": self._ring, "fifo": self._fifo}
        yield from ways[way](answers)
        yield "# place is the first register of a channel within a sample; value = raw * scale"
        kind, scale, width = answers["raw-type"], answers["scale"], register_count(answers["raw-type"])
        channels = enumerate(answers["channels"])
        yield from array(
            "channels",
            [{"name": name, "place": n * width, "type": kind, "scale": scale} for n, name in channels],
        )

    def _waveform(self, answers: Answers) -> Iterator[str]:
        yield entry("block_id", answers["block-id"], "register that changes with every block")
        yield entry("address", answers["block-address"], "first register of the block")
        yield entry("samples", answers["samples"], "of each channel in a block")
        yield "# If the device takes blocks on demand, add trigger = { address = .., every_s = .. }."

    def _ring(self, answers: Answers) -> Iterator[str]:
        count = {"address": answers["count-address"], "bits": int(answers["count-bits"])}
        yield entry("count", count, "counts all samples: sample i is at place i % depth")
        yield entry("address", answers["ring-address"], "first register of the ring")
        yield entry("depth", answers["depth"], "samples of each channel that it holds")

    def _fifo(self, answers: Answers) -> Iterator[str]:
        yield entry("address", answers["fifo-address"], "pointer of the queue, read by function 24")
        yield entry("count", {"bits": int(answers["count-bits"])}, "at the head of each reply")
        if answers["acknowledge"] is None:
            yield "# acknowledge = 700 if the device keeps samples until it gets the read position"
        else:
            yield entry(
                "acknowledge", answers["acknowledge"], "the read position of the queue is written there"
            )

    def _registers(self, answers: Answers) -> Iterator[str]:
        runs = sorted(
            (answers[sensor_key(name, "address")], register_count(answers[sensor_key(name, "register-type")]))
            for name in answers["channels"]
        )
        if any(before + width < after for (before, width), (after, _) in pairwise(runs)):
            yield entry("max_gap", 0, "registers between are not read: the device may not have them")
        if answers["max-count"] != _READ_REGISTERS:
            yield entry("max_count", answers["max-count"], "the device refuses requests of more registers")
        yield "# value = raw * scale, in the unit of the sensor below"
        tables = []
        for name in answers["channels"]:
            keys = {"address": "address", "type": "register-type", "order": "order", "scale": "scale"}
            tables.append({"name": name} | {k: answers[sensor_key(name, t)] for k, t in keys.items()})
            if (bits := answers[sensor_key(name, "bits")]) is not None:
                tables[-1]["bits"] = [*bits]
            mark = answers[sensor_key(name, "no-value")]
            if mark is not None:
                tables[-1]["no_value"] = Hexadecimal(mark)
        if not any("no_value" in table for table in tables):
            yield "# If a raw value means that there is no value, add e.g. no_value = 0x7FFF to its channel."
        yield from array("channels", tables)

    def _line(self, answers: Answers) -> Iterator[Question]:
        """What is asked about the line that the unit is on."""
        raise NotImplementedError

    def _line_keys(self, answers: Answers) -> Iterator[str]:
        """Lines of the table of the bus that state where that is."""
        raise NotImplementedError


class TcpQuestions(_ModbusQuestions):
    """Units behind a Modbus TCP server."""

    about = "Modbus TCP"
    topics: ClassVar[Mapping[str, Topic]] = {
        "host": Topic(
            "Address of the Modbus device",
            "An IP address or a host name, without http://. Its port is 502, or is added: 192.0.2.20:5020.",
        ),
        "tcp-port": Topic("TCP port of the Modbus device", "Nearly always 502."),
        **_ModbusQuestions.topics,
    }

    def _line(self, answers: Answers) -> Iterator[Question]:
        yield self.ask("host", q.line)
        yield self._ask_timeout()
        yield self._ask_units()
        read = partial(_tcp_port, answers["host"])
        yield self.ask("tcp-port", read, _host_and_port(answers["host"])[1], quiet=True)
        yield self._ask_registers(answers)

    def _sniffed_as(self, answers: Answers) -> Sequence[str]:
        host, _ = _host_and_port(answers["host"])
        host = f"[{host}]" if ":" in host else host
        return ["--function", "both", "--", f"{host}:{answers['tcp-port']}"]

    def _line_keys(self, answers: Answers) -> Iterator[str]:
        yield entry("transport", "tcp")
        yield entry("host", _host_and_port(answers["host"])[0])
        yield entry("tcp_port", answers["tcp-port"])


class RtuQuestions(_ModbusQuestions):
    """Units on a serial line."""

    about = "Modbus RTU on a serial line (RS-485)"
    topics: ClassVar[Mapping[str, Topic]] = {
        "parity": Topic("Parity of the line", "As the device is set: none, even or odd."),
        **_ModbusQuestions.topics,
    }

    def _line(self, answers: Answers) -> Iterator[Question]:
        yield self.ask("port", q.line, only_port())
        yield self.ask("baud", q.bit_rate, "19200")
        yield self._ask_timeout()
        yield self._ask_units()
        yield self.choose("parity", dict.fromkeys(("none", "even", "odd"), ""), "even")
        yield self._ask_registers(answers)

    def _sniffed_as(self, answers: Answers) -> Sequence[str]:
        line = ["--baud", f"{answers['baud']}", "--parity", answers["parity"]]
        return ["--function", "both", *line, "--", answers["port"]]

    def _most_hz(self, answers: Answers) -> float:
        registers = _FIFO_REGISTERS if answers["way"] == "fifo" else _READ_REGISTERS
        samples = max((registers - 2) // _sample_registers(answers), 1)
        # Twice the characters of a reply, for the count and requests, of 11 bits each; units take some ms.
        baud: int = answers["baud"]
        return 0.5 * samples / (2 * (2 * registers + 40) * 11 / baud + 0.05)

    def _line_keys(self, answers: Answers) -> Iterator[str]:
        yield entry("transport", "rtu")
        yield entry("serial_port", answers["port"], "best its path below /dev/serial/by-id")
        yield entry("baud", answers["baud"], "bit/s, as the device is set")
        yield entry("parity", answers["parity"])
        yield entry("stop_bits", 1)


_HOST_AND_PORT = re.compile(r"(\[[^\]]*\]|[^:\[\]]+):(\d+)")


def _host_and_port(text: str) -> tuple[str, str]:
    """The host and the port of an address, as the sniffer takes it too; 502 if there is no port."""
    both = _HOST_AND_PORT.fullmatch(text)
    return (text, "502") if both is None else (both[1].strip("[]"), both[2])


def _tcp_port(host: str, text: str) -> int:
    """The port; the same one if the address of the device has one already."""
    port = q.whole(text)
    if _HOST_AND_PORT.fullmatch(host) and port != int(_host_and_port(host)[1]):
        raise ValueError(f"{host} names another port: leave one of the two out")
    return port


_WORD = re.compile("stat|alarm|fault|error|flag|trip|warn|word|bits", re.IGNORECASE)
"""In the name of a channel whose bits have meanings."""


def _is_unsigned(answers: Answers, channel: str) -> bool:
    """Whether the registers of a channel hold a number that has parts."""
    kind: str = answers[sensor_key(channel, "register-type")]
    return kind.startswith("uint")


def _bits(text: str) -> tuple[int, int] | None:
    """The lowest bit and the number of bits, of one bit or the first and the last; None for ``none``."""
    if text.lower() == NONE:
        return None
    both = re.fullmatch(r"(\d{1,2})(?:\s*-\s*(\d{1,2}))?", text.strip())
    first, last = (int(both[1]), int(both[2] or both[1])) if both else (0, -1)
    if first > last:
        raise ValueError(
            f'"{text}" is no bit: write its number from 0, e.g. 3, or the first and last, e.g. 4-7'
        )
    return first, last - first + 1


def _order(text: str) -> str | None:
    """An order of bytes; small letters mean the same."""
    return q.exactly(dict.fromkeys(_ORDERS, ""))(text.upper())


_USUAL_SCALES = {"degC": "0.1", "mm/s": "0.01"}
_NAMED_BY_ADDRESS = re.compile(r"[a-z]+\d+", re.IGNORECASE)
"""Channels that are called like registers, as those found on the line: what they mean is not known."""


def _unit(channel: str) -> str | None:
    """The unit that a value with this name has, as a rule; None if the name suggests none."""
    return unit_by_name(channel) or ("count" if _NAMED_BY_ADDRESS.fullmatch(channel) else None)


def _first_units() -> list[int]:
    """The first and the last of the units that are asked at first."""
    return [int(one) for one in _UNITS[0].split("-")]


def _units(text: str) -> str:
    """Addresses of units as the sniffer takes them, or `AUTO`."""
    try:
        if text != AUTO:
            units_of(text)
    except SniffError as error:
        raise ValueError(f"{error}".partition(": ")[2]) from None
    return text


def _registers(text: str) -> str:
    """Registers as the sniffer takes them, or `AUTO`."""
    if text == AUTO:
        return text
    try:
        registers = registers_of(text)
    except SniffError as error:
        raise ValueError(f"{error}".partition(": ")[2]) from None
    if registers.end > LAST_REGISTER:
        raise ValueError(f"{registers.reason}: write {registers.there}, and --table {registers.table}")
    return text


def _to_read(registers: str) -> range:
    """The registers that --listen was to read; none if it was to choose them."""
    if registers == AUTO:
        return range(0)
    asked = registers_of(registers)
    return range(asked.begin, asked.end + 1)


def _sample_registers(answers: Answers) -> int:
    """Registers of one sample of every channel."""
    channels: int = len(answers["channels"])
    return channels * register_count(answers["raw-type"])
