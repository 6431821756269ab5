"""The buses that ``daqsvc new`` knows: what it asks about each, and the tables that come of it."""

from __future__ import annotations

import tempfile
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from daqsvc.commands.new import question as q
from daqsvc.commands.new.question import NONE, Answers, Question, sensor_key
from daqsvc.commands.new.toml_lines import Hexadecimal, array, behind, entry, toml
from daqsvc.commands.new.topics import SENSOR_TOPICS, TOPICS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from cantools.database.can import Message

BUS, STREAM = "main", "device"
"""Names of the only bus and the only stream of the file."""
RAW_BYTES = {"int8": 1, "int16": 2, "int24": 3, "int32": 4, "uint8": 1, "uint16": 2, "uint24": 3, "uint32": 4}
REGISTERS = ("uint16", "int16", "uint32", "int32", "float32")
_COUNTER_BYTES = 2
_RATES_HZ = (2560.0, 1280.0, 640.0, 100.0, 10.0)
_MOST_FRAMES_HZ = 500.0
"""Of a default: a CAN bus of 500 kbit/s has time for some 4000 short frames a second."""
_BY_ID = Path("/dev/serial/by-id")
_PROBE_V = 18.0
"""A proximity probe goes down to so many volts below 0."""


class BusKind(Protocol):
    """A kind of bus."""

    about: str
    """What it is, beside its word."""

    def questions(self, answers: Answers, folder: Path) -> Iterator[Question]:
        """What is asked before the speed: where the device is and how its samples lie."""
        ...

    def channels(self, answers: Answers) -> tuple[str, ...]:
        """Names of the channels."""
        ...

    def rate_hz(self, answers: Answers) -> float:
        """The sampling rate unless something else is answered."""
        ...

    def of_channel(self, answers: Answers, channel: str) -> Iterator[Question]:
        """What is asked about a channel before its sensor."""
        ...

    def sensor_types(self, answers: Answers) -> tuple[str, ...]:
        """Types of sensors that the samples can be of."""
        ...

    def guess(self, answers: Answers, channel: str) -> tuple[str, str | None]:
        """Type and, where it is known, unit of the sensor on a channel."""
        ...

    def in_volts(self, answers: Answers) -> bool:
        """Whether the samples of a sensor are volts, as a rule."""
        ...

    def tables(self, answers: Answers) -> Iterator[str]:
        """Lines of ``[buses]`` and ``[streams]``."""
        ...

    def beside(self, file: str) -> tuple[str, str]:
        """What to type beside the service, and what that does."""
        ...


def _status(file: str) -> tuple[str, str]:
    return f"daqsvc status {file}", "in a second terminal: values, losses, alarms"


def _ask(key: str, read: Any, default: str | None = None, **more: Any) -> Question:
    return Question(key, TOPICS[key], read, default, **more)


def _choose(key: str, choices: Mapping[str, str], default: str | None, **more: Any) -> Question:
    return Question(key, TOPICS[key], q.one_of(choices), default, choices, **more)


def _yes(key: str, *, default: bool) -> Question:
    return Question(key, TOPICS[key], q.yes_no, "yes" if default else "no", q.YES_NO)


def _by_name(channel: str) -> str | None:
    low = channel.lower()
    if any(part in low for part in ("kph", "key", "phas", "tacho")):
        return "keyphasor"
    if low.startswith(("acc", "a_")) or low == "a":
        return "accelerometer"
    if any(part in low for part in ("temp", "press", "speed", "rpm", "rms")):
        return "trend"
    return None


def _stream(answers: Answers, comment: str = "samples a second of each channel") -> Iterator[str]:
    yield f"[streams.{STREAM}]"
    yield entry("bus", BUS)
    yield entry("rate_hz", answers["rate"], comment)
    yield ""
    yield f"[streams.{STREAM}.layout]"


class _Can:
    """What all CAN buses have."""

    def of_channel(self, answers: Answers, channel: str) -> Iterator[Question]:
        """See `BusKind.of_channel`."""
        del answers, channel
        yield from ()

    def sensor_types(self, answers: Answers) -> tuple[str, ...]:
        """See `BusKind.sensor_types`."""
        del answers
        return ("proximity", "accelerometer", "velocity", "keyphasor", "trend", NONE)

    def beside(self, file: str) -> tuple[str, str]:
        """See `BusKind.beside`."""
        return _status(file)

    def _interface(self) -> Iterator[Question]:
        yield _ask("interface", q.line, "socketcan", quiet=True)
        yield _ask("channel", q.line, "can0")

    def _bit_rates(self, answers: Answers, *, fd: bool) -> Iterator[Question]:
        yield _ask("bitrate", q.whole, "500000")
        if fd:
            yield _ask("data-bitrate", q.whole, f"{max(2_000_000, answers['bitrate'])}")

    def _bus(self, answers: Answers) -> Iterator[str]:
        rate, channel = answers["bitrate"], answers["channel"]
        fd = f" dbitrate {answers['data-bitrate']} fd on" if answers["fd"] else ""
        if answers["interface"] == "socketcan":
            yield "# Bring the interface up before the service starts, with the bit rates of the bus:"
            yield f"#   ip link set {channel} up type can bitrate {rate}{fd}"
        yield f"[buses.{BUS}]"
        yield entry("driver", "can")
        yield entry("interface", answers["interface"], "any interface that python-can knows")
        yield entry("channel", channel)
        yield entry("fd", answers["fd"], "whether CAN FD frames are on the bus")
        yield entry("bitrate", rate, "bit/s; it sets nothing, and tells whether the bus has time enough")
        if answers["fd"]:
            yield entry("data_bitrate", answers["data-bitrate"], "bit/s of the data of CAN FD frames")
        yield ""


class _Packed(_Can):
    """Samples side by side in CAN frames."""

    about = "CAN or CAN FD, samples packed side by side in a frame"

    def questions(self, answers: Answers, folder: Path) -> Iterator[Question]:
        """See `BusKind.questions`."""
        del folder
        yield from self._interface()
        yield _yes("fd", default=True)
        yield from self._bit_rates(answers, fd=answers["fd"])
        yield from self._frame(answers)

    def _frame(self, answers: Answers, **more: Any) -> Iterator[Question]:
        yield _ask("id", q.whole, "0x101", **more)
        yield _ask("channels", q.names, "x, y, kph", **more)
        yield _choose("raw-type", dict.fromkeys(RAW_BYTES, ""), "int16", **more)
        yield _ask("scale", q.number, "0.001", **more)
        room = (64 if answers["fd"] else 8) - _COUNTER_BYTES
        most = room // self._sample_bytes(answers)
        yield _ask("samples-per-frame", q.whole, f"{max(min(most, 10), 1)}", **more)

    def _sample_bytes(self, answers: Answers) -> int:
        channels: int = len(answers["channels"])
        return channels * RAW_BYTES[answers["raw-type"]]

    def _length(self, answers: Answers) -> int:
        """The shortest frame that holds counter and samples; one that does not exist if none does."""
        from drivers.can.settings import CAN_FD_LENGTHS  # noqa: PLC0415 - brings the settings

        needed: int = _COUNTER_BYTES + self._sample_bytes(answers) * answers["samples-per-frame"]
        return next((length for length in CAN_FD_LENGTHS if length >= needed), needed)

    def channels(self, answers: Answers) -> tuple[str, ...]:
        """See `BusKind.channels`."""
        named: tuple[str, ...] = answers["channels"]
        return named

    def rate_hz(self, answers: Answers) -> float:
        """See `BusKind.rate_hz`."""
        most = _MOST_FRAMES_HZ * answers["samples-per-frame"]
        return next((rate for rate in _RATES_HZ if rate <= most), _RATES_HZ[-1])

    def guess(self, answers: Answers, channel: str) -> tuple[str, str | None]:
        """See `BusKind.guess`."""
        named, signed = _by_name(channel), not answers["raw-type"].startswith("u")
        carried_v = abs(answers["scale"]) * 2.0 ** (8 * RAW_BYTES[answers["raw-type"]] - 1)
        probe = signed and carried_v > _PROBE_V and self.in_volts(answers)
        if named == "keyphasor" and not probe:
            named = None
        slow = answers["rate"] < _RATES_HZ[-2]
        return named or ("proximity" if probe and not slow else "trend" if slow else "accelerometer"), None

    def in_volts(self, answers: Answers) -> bool:
        """See `BusKind.in_volts`."""
        return bool(abs(answers["scale"]) < 0.5)  # no converter is so coarse

    def tables(self, answers: Answers) -> Iterator[str]:
        """See `BusKind.tables`."""
        yield from self._bus(answers)
        yield from _stream(answers)
        yield entry("id", Hexadecimal(answers["id"]), "CAN id of the frames; candump shows those on the bus")
        if answers["id"] > 0x7FF:
            yield entry("extended", value=True, comment="an id of 29 bits")
        yield entry("length", self._length(answers), "bytes of a frame")
        yield entry("byte_order", "little", '"big" if the device sends the high byte first')
        yield behind(
            f"counter = {toml({'byte': 0, 'bits': 16, 'counts': 'samples'})}", 'or counts = "frames"'
        )
        yield entry("first_byte", _COUNTER_BYTES, "where the samples begin, behind the counter")
        yield entry("samples_per_frame", answers["samples-per-frame"])
        yield "# value = raw * scale: volts if the sensor below has a sensitivity, else its unit"
        yield from array(
            "channels",
            [
                {"name": name, "type": answers["raw-type"], "scale": answers["scale"]}
                for name in answers["channels"]
            ],
        )


class _Virtual(_Packed):
    """A bus between processes, with a simulated machine on it."""

    about = "a virtual bus with a simulated machine: to try daqsvc, no hardware needed"

    def questions(self, answers: Answers, folder: Path) -> Iterator[Question]:
        """See `BusKind.questions`."""
        del folder
        yield _ask("socket", q.line, f"{Path(tempfile.gettempdir()) / 'daqsvc-can0'}", quiet=True)
        answers["fd"] = True
        yield from self._frame(answers, quiet=True)

    def rate_hz(self, answers: Answers) -> float:
        """See `BusKind.rate_hz`: 64 samples a revolution."""
        per_second: float = 64.0 * abs(answers["speed"]) / 60.0
        return min(max(round(per_second), 640), 12_800)

    def beside(self, file: str) -> tuple[str, str]:
        """See `BusKind.beside`."""
        return f"daqsvc sim {file}", "in a second terminal: plays the machine, which gets worse and worse"

    def _bus(self, answers: Answers) -> Iterator[str]:
        yield "# No hardware: `daqsvc sim` plays the devices. For a real bus, daqsvc new asks for it."
        yield f"[buses.{BUS}]"
        yield entry("driver", "can")
        yield entry("interface", "unixbus", "a CAN bus between programs of this computer")
        yield entry("channel", answers["socket"], "path of its socket")
        yield entry("fd", value=True)
        yield ""


class _Dbc(_Can):
    """Samples as signals of a DBC message."""

    about = "CAN, frames described by a DBC file"

    def questions(self, answers: Answers, folder: Path) -> Iterator[Question]:
        """See `BusKind.questions`."""
        yield from self._interface()
        answers["dbc-folder"] = folder
        yield _ask("dbc", partial(_dbc_file, folder))
        messages = self._messages(answers)
        choices = {name: _about(one) for name, one in messages.items()}
        yield Question("message", TOPICS["message"], _exactly(choices), _likely(messages), choices)
        message = messages[answers["message"]]
        answers["fd"] = message.length > 8
        yield from self._bit_rates(answers, fd=answers["fd"])
        signals = {one.name: one for one in message.signals}
        counters = {
            name: f"{one.length} bits" for name, one in signals.items() if _may_count(one, len(signals))
        }
        likely = next((name for name in counters if _is_count(name)), NONE)
        choices = {**counters, NONE: "losses are then told by the times of arrival"}
        yield Question("counter", TOPICS["counter"], _exactly(choices), likely, choices)
        measured = [one.name for one in message.signals if _is_measured(one, answers["counter"])]
        rest = [name for name in signals if name != answers["counter"]]
        yield _ask("signals", partial(_signals, tuple(rest)), ", ".join(measured or rest[:1]))

    def _messages(self, answers: Answers) -> dict[str, Message]:
        return _with_signals(answers["dbc-folder"] / answers["dbc"])

    def channels(self, answers: Answers) -> tuple[str, ...]:
        """See `BusKind.channels`."""
        return tuple(signal[: q.LONGEST_NAME] for signal in answers["signals"])

    def rate_hz(self, answers: Answers) -> float:
        """See `BusKind.rate_hz`."""
        message = self._messages(answers)[answers["message"]]
        cycle_ms: float | None = message.cycle_time
        return 1000.0 if not cycle_ms else round(1000.0 / cycle_ms, 6)

    def guess(self, answers: Answers, channel: str) -> tuple[str, str | None]:
        """See `BusKind.guess`."""
        unit = self._units(answers).get(channel)
        kind = {"g": "accelerometer", "m/s2": "accelerometer", "mm/s": "velocity"}.get(unit or "")
        kind = "proximity" if unit in {"um", "mm", "mil"} else kind
        if answers["rate"] < _RATES_HZ[-2]:
            kind = "trend"
        return kind or _by_name(channel) or "trend", unit

    def in_volts(self, answers: Answers) -> bool:
        """See `BusKind.in_volts`."""
        return "V" in self._units(answers).values()

    def _units(self, answers: Answers) -> dict[str, str]:
        from daqsvc.settings.units import unit_of  # noqa: PLC0415 - brings the settings

        message = self._messages(answers)[answers["message"]]
        known = {one.name[: q.LONGEST_NAME]: unit_of(one.unit or "") for one in message.signals}
        return {name: unit.name for name, unit in known.items() if unit is not None}

    def tables(self, answers: Answers) -> Iterator[str]:
        """See `BusKind.tables`."""
        yield from self._bus(answers)
        yield from _stream(answers, "frames a second: the DBC file or candump says so")
        yield entry("dbc", answers["dbc"], "relative to this file; where signals lie, scale, unit")
        yield entry("message", answers["message"])
        if answers["counter"] is None:
            yield entry("no_counter", value=True, comment="losses are told by the times of arrival")
        else:
            counter = toml({"signal": answers["counter"], "counts": "frames"})
            yield behind(f"counter = {counter}", "grows by 1 with each frame: losses are counted by it")
        named = zip(self.channels(answers), answers["signals"], strict=True)
        yield from array("channels", [{"name": name, "signals": [signal]} for name, signal in named])


def _dbc_file(folder: Path, text: str) -> str:
    from drivers.frames import LayoutError  # noqa: PLC0415 - only what a bus needs

    path = Path(q.line(text)).expanduser()
    if not (folder / path).exists() and path.exists():
        path = path.absolute()  # typed from another folder than that of the machine file
    try:
        messages = _with_signals(folder / path)
    except LayoutError as error:
        raise ValueError(f"{error}") from None
    if not messages:
        raise ValueError(f"{text} describes no message with signals; give another DBC file")
    return f"{path}"


def _with_signals(file: Path) -> dict[str, Message]:
    """The messages of a DBC file that hold signals, by name.

    Raises:
        LayoutError: the file cannot be read, or cantools is not installed.
    """
    from drivers.can.dbc import messages_of  # noqa: PLC0415 - cantools is slow to import

    return {message.name: message for message in messages_of(file.absolute()) if message.signals}


def _about(message: Message) -> str:
    return f"id {message.frame_id:#x}: {', '.join(one.name for one in message.signals[:6])}"


def _likely(messages: Mapping[str, Message]) -> str:
    """The message that most likely carries samples: with a counter, and with numbers that have units."""

    def score(message: Message) -> tuple[bool, int]:
        counted = any(_is_count(one.name) for one in message.signals)
        return counted, sum(bool(one.unit) for one in message.signals)

    return max(messages, key=lambda name: score(messages[name]))


def _is_count(signal: str) -> bool:
    return any(part in signal.lower() for part in ("seq", "count", "cnt", "index"))


def _may_count(signal: Any, signals: int) -> bool:
    plain = not signal.is_signed and not signal.is_float and signal.scale == 1 and signal.length >= 4
    return bool(plain) and signals > 1


def _is_measured(signal: Any, counter: str | None) -> bool:
    return signal.name != counter and bool(signal.unit) and signal.multiplexer_ids is None


def _exactly(choices: Mapping[str, str]) -> Any:
    def read(text: str) -> str | None:
        if text not in choices:
            raise ValueError(f'"{text}" is not one of {", ".join(choices)}')
        return None if text == NONE else text

    return read


def _signals(known: tuple[str, ...], text: str) -> tuple[str, ...]:
    chosen = tuple(part.strip() for part in text.split(","))
    for one in chosen:
        if one not in known:
            raise ValueError(f'there is no signal "{one}"; there are {", ".join(known)}')
    if len({one[: q.LONGEST_NAME] for one in chosen}) < len(chosen):
        raise ValueError(f'"{text}" has a signal twice')
    return chosen


class _Modbus:
    """Registers of a unit."""

    def __init__(self, transport: str, about: str) -> None:
        self._transport, self.about = transport, about

    def questions(self, answers: Answers, folder: Path) -> Iterator[Question]:
        """See `BusKind.questions`."""
        del folder
        if self._transport == "tcp":
            yield _ask("host", q.line)
            yield _ask("tcp-port", q.whole, "502", quiet=True)
        else:
            yield _ask("port", q.line, _only_port())
            yield _ask("baud", q.whole, "19200")
            yield _choose("parity", dict.fromkeys(("none", "even", "odd"), ""), "even")
        yield _ask("unit", q.whole, "1")
        ways = {"values": "levels that the device measures itself", "waveform": "blocks of samples"}
        yield _choose("way", ways, "values")
        yield _choose("table", dict.fromkeys(("holding", "input"), ""), "holding")
        waveform = answers["way"] == "waveform"
        yield _ask("channels", q.names, "x" if waveform else "vibration, temperature")
        if waveform:
            yield _choose("raw-type", dict.fromkeys(REGISTERS, ""), "int16")
            yield _ask("scale", q.number, "0.001")
            yield _ask("block-id", q.whole, "0")
            yield _ask("block-address", q.whole, "100")
            width = 2 if answers["raw-type"].endswith("32") else 1
            most = 60_000 // (width * len(answers["channels"]))
            yield _ask("samples", q.whole, f"{max(min(4096, most), 1)}")

    def channels(self, answers: Answers) -> tuple[str, ...]:
        """See `BusKind.channels`."""
        named: tuple[str, ...] = answers["channels"]
        return named

    def rate_hz(self, answers: Answers) -> float:
        """See `BusKind.rate_hz`."""
        return 2560.0 if answers["way"] == "waveform" else 1.0

    def of_channel(self, answers: Answers, channel: str) -> Iterator[Question]:
        """See `BusKind.of_channel`."""
        if answers["way"] == "waveform":
            return

        def ask(topic: str, read: Any, default: str, **more: Any) -> Question:
            words = SENSOR_TOPICS[topic]
            filled = q.Topic(words.text.format(channel=channel), words.help)
            return Question(sensor_key(channel, topic), filled, read, default, **more)

        types, orders = dict.fromkeys(REGISTERS, ""), dict.fromkeys(("ABCD", "CDAB", "BADC", "DCBA"), "")
        yield ask("address", q.whole, f"{self._next_address(answers, channel)}")
        temperature = "temp" in channel.lower()
        default = "int16" if temperature else "uint16"
        yield ask("register-type", q.one_of(types), default, choices=types)
        wide = answers[sensor_key(channel, "register-type")].endswith("32")
        yield ask("order", _exactly(orders), "ABCD", choices=orders, quiet=not wide)
        is_float = answers[sensor_key(channel, "register-type")].startswith("float")
        yield ask("scale", q.number, "1" if is_float else "0.1" if temperature else "0.01")

    def _next_address(self, answers: Answers, channel: str) -> int:
        """Behind the registers of all channels before."""
        end = 0
        for before in answers["channels"]:
            if before == channel:
                break
            width = 2 if answers[sensor_key(before, "register-type")].endswith("32") else 1
            end = max(end, answers[sensor_key(before, "address")] + width)
        return end if end < 65_535 else 0

    def sensor_types(self, answers: Answers) -> tuple[str, ...]:
        """See `BusKind.sensor_types`: what is polled is no waveform."""
        if answers["way"] == "waveform":
            return ("accelerometer", "velocity", "proximity", "trend", NONE)
        return ("trend", NONE)

    def guess(self, answers: Answers, channel: str) -> tuple[str, str | None]:
        """See `BusKind.guess`."""
        if answers["way"] == "waveform":
            return ("accelerometer" if answers["rate"] >= _RATES_HZ[-2] else "trend"), None
        return "trend", "degC" if "temp" in channel.lower() else "mm/s"

    def in_volts(self, answers: Answers) -> bool:
        """See `BusKind.in_volts`."""
        del answers
        return False

    def beside(self, file: str) -> tuple[str, str]:
        """See `BusKind.beside`."""
        return _status(file)

    def tables(self, answers: Answers) -> Iterator[str]:
        """See `BusKind.tables`."""
        yield f"[buses.{BUS}]"
        yield entry("driver", "modbus")
        yield entry("transport", self._transport)
        if self._transport == "tcp":
            yield entry("host", answers["host"])
            yield entry("tcp_port", answers["tcp-port"])
        else:
            yield entry("serial_port", answers["port"], "best its path below /dev/serial/by-id")
            yield entry("baud", answers["baud"], "bit/s, as the device is set")
            yield entry("parity", answers["parity"])
            yield entry("stop_bits", 1)
        yield entry("timeout_ms", 500.0, "how long the unit may take to answer")
        yield ""
        waveform = answers["way"] == "waveform"
        yield from _stream(answers, "within a block" if waveform else "how often the values are read")
        yield "# Addresses count from 0, as on the wire: what a manual calls 40001 (or 30001) is address 0."
        yield entry("way", "waveform" if waveform else "registers")
        yield entry("unit", answers["unit"], "address of the unit, its slave id")
        yield entry("table", answers["table"], '"holding" (40001 ...) or "input" (30001 ...)')
        yield from self._waveform(answers) if waveform else self._registers(answers)

    def _waveform(self, answers: Answers) -> Iterator[str]:
        width = 2 if answers["raw-type"].endswith("32") else 1
        yield entry("block_id", answers["block-id"], "register that changes with every block")
        yield entry("address", answers["block-address"], "first register of the block")
        yield entry("samples", answers["samples"], "of each channel in a block")
        yield "# If the device takes blocks on demand, add trigger = { address = .., every_s = .. }."
        yield "# place is the first register of a channel within a sample; value = raw * scale"
        yield from array(
            "channels",
            [
                {
                    "name": name,
                    "place": index * width,
                    "type": answers["raw-type"],
                    "scale": answers["scale"],
                }
                for index, name in enumerate(answers["channels"])
            ],
        )

    def _registers(self, answers: Answers) -> Iterator[str]:
        yield "# value = raw * scale, in the unit of the sensor below"
        tables = []
        for name in answers["channels"]:
            keys = {"address": "address", "type": "register-type", "order": "order", "scale": "scale"}
            tables.append({"name": name} | {k: answers[sensor_key(name, t)] for k, t in keys.items()})
        yield from array("channels", tables)


class _Lines:
    """Lines of text on a serial port."""

    about = "lines of text on a serial port"

    def questions(self, answers: Answers, folder: Path) -> Iterator[Question]:
        """See `BusKind.questions`."""
        del folder
        yield _ask("port", q.line, _only_port())
        yield _ask("baud", q.whole, "115200")
        yield _ask("prefix", q.text_or_none, NONE)
        yield _ask("separator", _character, ",", quiet=True)
        yield _choose("checksum", dict.fromkeys(("none", "xor", "crc16"), ""), "none", quiet=True)
        yield _ask("columns", _columns, "t, x, y")
        columns = dict.fromkeys(answers["columns"], "")
        first = answers["columns"][0]
        yield Question("counter", TOPICS["counter"], _exactly(columns), first, columns)
        counted = _is_count(answers["counter"])
        kinds = {"count": "it counts lines", "s": "time in s", "ms": "time in ms", "us": "time in us"}
        yield _choose("counts", kinds, "count" if counted else "ms")

    def channels(self, answers: Answers) -> tuple[str, ...]:
        """See `BusKind.channels`."""
        return tuple(name for name in answers["columns"] if name != answers["counter"])

    def rate_hz(self, answers: Answers) -> float:
        """See `BusKind.rate_hz`."""
        bits = 20 * len(answers["columns"]) + 200
        return next((rate for rate in (100.0, 10.0, 1.0) if 2 * rate * bits <= answers["baud"]), 0.1)

    def of_channel(self, answers: Answers, channel: str) -> Iterator[Question]:
        """See `BusKind.of_channel`."""
        del answers, channel
        yield from ()

    def sensor_types(self, answers: Answers) -> tuple[str, ...]:
        """See `BusKind.sensor_types`."""
        del answers
        return ("accelerometer", "velocity", "proximity", "trend", "keyphasor", NONE)

    def guess(self, answers: Answers, channel: str) -> tuple[str, str | None]:
        """See `BusKind.guess`."""
        unit = "degC" if "temp" in channel.lower() else None
        waveform = answers["rate"] >= _RATES_HZ[-2]
        return _by_name(channel) or ("accelerometer" if waveform else "trend"), unit

    def in_volts(self, answers: Answers) -> bool:
        """See `BusKind.in_volts`."""
        del answers
        return False

    def beside(self, file: str) -> tuple[str, str]:
        """See `BusKind.beside`."""
        return _status(file)

    def tables(self, answers: Answers) -> Iterator[str]:
        """See `BusKind.tables`."""
        yield f"[buses.{BUS}]"
        yield entry("driver", "serial")
        yield entry("port", answers["port"], "best its path below /dev/serial/by-id")
        yield entry("baud", answers["baud"], "bit/s, as the device is set")
        yield entry("framing", "lines")
        yield entry(
            "checksum", answers["checksum"], 'behind a * at the end of a line: "none", "xor", "crc16"'
        )
        yield ""
        yield from _stream(answers, "lines a second")
        if answers["prefix"] is not None:
            yield entry("prefix", answers["prefix"], "what each line begins with")
        yield entry("line", answers["columns"], "the columns, in order")
        yield entry("separator", answers["separator"])
        if answers["counts"] == "count":
            yield entry("counter", {"column": answers["counter"]}, "losses are counted by it")
        else:
            time = {"column": answers["counter"], "unit": answers["counts"]}
            yield entry("time", time, "the device's own clock: it places the lines in time")
        yield "# scale = 0.01 behind a name if the device sends hundredths"
        yield from array("channels", [{"name": name} for name in self.channels(answers)])


def _character(text: str) -> str:
    return "\t" if text == r"\t" else q.line(text) if text != " " else text


def _columns(text: str) -> tuple[str, ...]:
    columns = q.names(text)
    if len(columns) < 2:
        raise ValueError("a line needs a column that counts or tells the time, and one that is measured")
    return columns


def _only_port() -> str | None:
    ports = sorted(_BY_ID.glob("*"))
    return f"{ports[0]}" if len(ports) == 1 else None


BUSES: dict[str, BusKind] = {
    "virtual": _Virtual(),
    "can-dbc": _Dbc(),
    "can": _Packed(),
    "modbus-tcp": _Modbus("tcp", "Modbus TCP"),
    "modbus-rtu": _Modbus("rtu", "Modbus RTU on a serial line (RS-485)"),
    "serial": _Lines(),
}
