"""What ``daqsvc new`` asks about lines of text, or binary frames, on a serial port."""

from __future__ import annotations

import re
import textwrap
from typing import TYPE_CHECKING, ClassVar

from drivers import packed_questions as packed
from drivers import questions as q
from drivers.bus_questions import BEFOREHAND, BusQuestions, only_port, seconds_of
from drivers.names import FRAMES, SERIAL, bus_name, lines_stream
from drivers.questions import NONE, Answers, Question, Topic, sensor_key
from drivers.serial.heard import CRCS, DELIMITERS, HeardOnSerial
from drivers.serial.sniff import SerialSniffer
from drivers.serial.sniff_words import MUST_TURN, UNSEEN_WIDTH
from drivers.sniffing import is_waveform_rate, sniffed, type_by_unit, unit_of_suffix
from drivers.toml_lines import array, entry

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Collection, Iterator, Mapping
    from pathlib import Path

_CHARACTERS = {
    "8N1": (8, "none"),
    "8E1": (8, "even"),
    "8O1": (8, "odd"),
    "7E1": (7, "even"),
    "7O1": (7, "odd"),
}
_FRAMINGS = {
    "lines": "lines of text",
    "cobs": "binary frames, encoded by COBS, with a zero byte behind each",
    "sync": "binary frames of one length, each behind a sync word",
}
_ENDS = {
    "lf": "line feed, with a carriage return before it or not",
    "cr": "carriage return",
    ";": "semicolon",
}
_UNNAMED = re.compile(r"c\d+")
"""As the sniffer calls columns that have no header."""
_RATES_HZ = (12_800.0, 2560.0, 1280.0, 640.0, 100.0, 10.0, 1.0, 0.1)
_LONGEST_PAYLOAD = 4096
_LONGEST_SYNC_WORD = 8
_KINDS = dict.fromkeys(_CHARACTERS, "")
_LISTEN_S = 3.0
"""Behind the search of the baud rate, which takes some seconds itself."""


class SerialQuestions(BusQuestions):
    """Lines of text or binary frames."""

    about = "lines of text or binary frames on a serial port"
    topics: ClassVar[Mapping[str, Topic]] = {
        "character": Topic(
            "Data bits, parity and stop bits", "8N1 is the usual one: 8 bits, no parity, 1 stop bit."
        ),
        "framing": Topic(
            "What does the device send?", "daqsvc sniff serial shows it, and daqsvc new --listen finds it."
        ),
        "sync-word": Topic(
            "Bytes that each frame begins with", "In hexadecimal, as the device's manual has them, e.g. a55a."
        ),
        "crc": Topic("Which CRC is at the end of a frame?", "ibm-3740 is often called CRC-16/CCITT-FALSE."),
        "crc-order": Topic("Which byte of the CRC comes first?", "The device's manual states it."),
        "payload-length": Topic(
            "Bytes of a frame without sync word and CRC", "Counter and samples, and whatever is behind them."
        ),
        **packed.TOPICS,
        "prefix": Topic(
            "Word that each line begins with", "e.g. $ACC; none if the first column is a number."
        ),
        "line-end": Topic(
            "What ends a line?", "LF, with CR before it or not, is usual; some devices send CR alone."
        ),
        "separator": Topic(
            "Character between columns", "A comma, semicolon, tab, or a blank; there may be several blanks."
        ),
        "decimal": Topic("Decimal mark of the numbers", 'A comma, where a device writes "0,25".'),
        "checksum": Topic(
            "Checksum at the end of a line", "Behind a *: xor as in NMEA 0183, crc16, or none."
        ),
        "columns": Topic(
            "What are the columns of a line, in order?",
            "Names with commas between, e.g. t, x, y. Name columns that are not needed, too.",
        ),
        "counts": Topic(
            "What does it hold?",
            "count grows by one with each frame or line, to 255, 65535 or 4294967295, and begins again at 0; "
            f"{MUST_TURN}. s, ms and us are times.",
        ),
    }

    channel_topics: ClassVar[Mapping[str, Topic]] = {
        "prefix": Topic(
            "What is in front of the number of {channel}?",
            "A name that the device writes there, e.g. V= in V=12.3; none if the number is alone. A line "
            "with another text there is not read.",
        ),
        "suffix": Topic(
            "What is behind the number of {channel}?",
            "A unit that the device writes there, e.g. mm/s in 12.3 mm/s; none if the number is alone. "
            "A line with another text there is not read.",
        ),
    }
    listens_behind = "port"

    def listen(
        self, answers: Answers, folder: Path, stop: threading.Event, tell: Callable[[str], None]
    ) -> HeardOnSerial:
        """See `BusQuestions.listen`."""
        del folder
        baud = answers.get(BEFOREHAND, {}).get("baud", "")
        words = [*(["--baud", baud] if baud.isdecimal() else []), *seconds_of(answers)]
        figures = sniffed(SerialSniffer(_LISTEN_S), [*words, "--", answers["port"]], stop, tell)
        return HeardOnSerial(figures, self)

    def questions(self, answers: Answers, folder: Path) -> Iterator[Question]:
        """See `BusQuestions.questions`."""
        del folder
        yield self.ask("port", q.line, only_port())
        yield self.ask("baud", q.bit_rate, "115200")
        yield self.ask("character", q.exactly(_KINDS), "8N1", choices=_KINDS, quiet=True)
        yield self.choose("framing", _FRAMINGS, "lines")
        yield from (self._ask_lines if answers["framing"] == "lines" else self._ask_frames)(answers)

    def _ask_frames(self, answers: Answers) -> Iterator[Question]:
        if answers["framing"] == "sync":
            yield self.ask("sync-word", _sync_word, "a55a")
        yield self.choose("crc", CRCS, "ibm-3740")
        orders = {"big": "its high byte comes first", "little": "its low byte does"}
        yield self.choose("crc-order", orders, "big", quiet=True)
        yield from packed.sample_questions(self, answers, _LONGEST_PAYLOAD, must_count=True)
        yield self.ask("payload-length", q.whole, f"{packed.end_byte(answers)}", quiet=True)

    def _ask_lines(self, answers: Answers) -> Iterator[Question]:
        yield self.ask("prefix", q.text_or_none, NONE)
        yield self.choose("line-end", _ENDS, "lf", quiet=True)
        yield self.ask("separator", _character, ",", quiet=True)
        if answers["separator"] != ",":
            marks = {".": "as in 0.25", ",": "as in 0,25"}
            yield self.choose("decimal", marks, ".", quiet=True)
        yield self.choose("checksum", dict.fromkeys(("none", "xor", "crc16"), ""), "none", quiet=True)
        yield self.ask("columns", q.names, "t, x, y")
        columns = dict.fromkeys(answers["columns"], "")
        first = answers["columns"][0] if len(columns) > 1 else NONE
        columns[NONE] = "lines carry neither a count nor a time"
        yield self.ask("counter", q.exactly(columns), first, choices=columns)
        if answers["counter"] is None:
            return
        is_time = _is_time(answers["counter"])
        kinds = {"count": "it counts lines", "s": "time in s", "ms": "time in ms", "us": "time in us"}
        yield self.choose("counts", kinds, "ms" if is_time else "count")
        if answers["counts"] == "count":
            yield self.choose("counter-bits", dict.fromkeys(("8", "16", "32"), ""), "32", quiet=True)
        yield from self._ask_around(answers["counter"])

    def _ask_around(self, column: str) -> Iterator[Question]:
        yield self.ask_of(column, "prefix", q.text_or_none, NONE, quiet=True)
        yield self.ask_of(column, "suffix", q.text_or_none, NONE, quiet=True)

    def bus_name(self, answers: Answers) -> str:
        """See `BusQuestions.bus_name`."""
        return bus_name(answers["port"], SERIAL)

    def stream_name(self, answers: Answers) -> str:
        """See `BusQuestions.stream_name`."""
        return lines_stream(answers["prefix"]) if answers["framing"] == "lines" else FRAMES

    def channels(self, answers: Answers) -> tuple[str, ...]:
        """See `BusQuestions.channels`."""
        if answers["framing"] != "lines":
            return super().channels(answers)
        return tuple(name for name in answers["columns"] if name != answers["counter"])

    def guess(self, answers: Answers, channel: str) -> tuple[str, str | None]:
        """See `BusQuestions.guess`."""
        if answers["framing"] != "lines":
            return packed.guess(answers, channel)
        kind, unit = super().guess(answers, channel)
        suffix = answers.get(sensor_key(channel, "suffix"))
        if suffix is not None:
            unit = unit_of_suffix(suffix)
            by_unit = type_by_unit(channel, unit, waveform=is_waveform_rate(answers["rate"]))
            return kind if kind == "keyphasor" else by_unit or "trend", unit
        # A column without a name may be anything: limits of vibration are not for it.
        anything = _UNNAMED.fullmatch(channel) or answers.get(sensor_key(channel, "prefix")) is not None
        return kind, "1" if unit is None and anything else unit

    def stated(self, answers: Answers) -> Collection[str]:
        """See `BusQuestions.stated`: the device writes the unit behind a number."""
        named = [one for one in self.channels(answers) if answers.get(sensor_key(one, "suffix")) is not None]
        return {sensor_key(name, topic) for name in named for topic in ("type", "unit")}

    def of_channel(self, answers: Answers, channel: str) -> Iterator[Question]:
        """See `BusQuestions.of_channel`."""
        if answers["framing"] == "lines":
            yield from self._ask_around(channel)

    def in_volts(self, answers: Answers, channel: str) -> bool:
        """See `BusQuestions.in_volts`."""
        del channel
        return answers["framing"] != "lines" and packed.in_volts(answers)

    def rate_hz(self, answers: Answers) -> float:
        """See `BusQuestions.rate_hz`."""
        if answers["framing"] != "lines":
            # Of a frame with all that is around the payload; a character has 12 bits at most.
            frame_bits = 12 * (1.01 * answers["payload-length"] + 16)
            most = 0.5 * answers["baud"] / frame_bits * answers["samples-per-frame"]
            return next((rate for rate in _RATES_HZ if rate <= most), 0.01)
        bits = 20 * len(answers["columns"]) + 200
        return next((rate for rate in (100.0, 10.0, 1.0) if 2 * rate * bits <= answers["baud"]), 0.1)

    def tables(self, answers: Answers) -> Iterator[str]:
        """See `BusQuestions.tables`."""
        yield f"[buses.{self.bus_name(answers)}]"
        yield entry("driver", "serial")
        yield entry("port", answers["port"], "best its path below /dev/serial/by-id")
        yield entry("baud", answers["baud"], "bit/s, as the device is set")
        data_bits, parity = _CHARACTERS[answers["character"]]
        if answers["character"] != "8N1":
            yield entry("data_bits", data_bits)
            yield entry("parity", parity)
        yield entry("framing", answers["framing"], '"lines" of text, "cobs" or "sync"')
        yield from (self._lines if answers["framing"] == "lines" else self._frames)(answers)

    def _frames(self, answers: Answers) -> Iterator[str]:
        if answers["framing"] == "sync":
            yield entry("sync_word", answers["sync-word"], "the bytes that each frame begins with")
        yield entry("crc", answers["crc"], 'the CRC-16 at the end of a frame: "ibm-3740", "xmodem", "none"')
        if answers["crc"] != "none":
            yield entry("crc_order", answers["crc-order"], '"little" if its low byte comes first')
        yield ""
        yield from self.stream(answers)
        yield entry("payload_length", answers["payload-length"], "bytes without sync word and CRC")
        yield from packed.layout_lines(answers)

    def _lines(self, answers: Answers) -> Iterator[str]:
        checks = 'behind a * at the end of a line: "none", "xor", "crc16"'
        yield entry("checksum", answers["checksum"], checks)
        if answers["line-end"] != "lf":
            yield entry("delimiter", DELIMITERS[answers["line-end"]], "what ends a line")
        yield ""
        yield from self.stream(answers, "lines a second")
        if answers["prefix"] is not None:
            yield entry("prefix", answers["prefix"], "what each line begins with")
        yield entry("line", answers["columns"], "the columns, in order")
        yield entry("separator", answers["separator"])
        if answers.get("decimal") == ",":
            yield entry("decimal", ",", "numbers have a decimal comma")
        if answers["counter"] is None:
            yield entry("no_counter", value=True, comment="losses are estimated from the times of arrival")
        elif answers["counts"] == "count":
            yield f"# {MUST_TURN[0].upper()}{MUST_TURN[1:]}."
            counter = {"column": answers["counter"]}
            if answers["counter-bits"] == "32":
                yield from (f"# {line}" for line in textwrap.wrap(UNSEEN_WIDTH, 98))
            else:
                counter["bits"] = int(answers["counter-bits"])
            counter |= _around(answers, answers["counter"])
            yield entry("counter", counter, "losses are counted by it")
        else:
            time = {"column": answers["counter"], "unit": answers["counts"]}
            time |= _around(answers, answers["counter"])
            yield entry("time", time, "the device's own clock: it places the lines in time")
        yield "# scale = 0.01 behind a name if the device sends hundredths"
        channels = [{"name": name, **_around(answers, name)} for name in self._measured(answers)]
        if any("prefix" in one for one in channels):
            yield "# prefix: what the device writes in front of the number; a line without it is not read"
        if any("suffix" in one for one in channels):
            yield "# suffix: what the device writes behind the number; a line in another unit is not read"
        yield from array("channels", channels)

    def _measured(self, answers: Answers) -> tuple[str, ...]:
        """The columns that become channels: those with a sensor, as others may be no numbers."""
        named = self.channels(answers)
        kept = tuple(name for name in named if answers.get(sensor_key(name, "type")) != NONE)
        return kept or named


def _around(answers: Answers, column: str) -> dict[str, str]:
    """The keys for the texts around the number of a column."""
    texts = {key: answers.get(sensor_key(column, key)) for key in ("prefix", "suffix")}
    return {key: text for key, text in texts.items() if text is not None}


def _sync_word(text: str) -> str:
    word = text.lower().removeprefix("0x").replace(" ", "")
    try:
        length = len(bytes.fromhex(word))
    except ValueError:
        length = 0
    if not 1 <= length <= _LONGEST_SYNC_WORD:
        raise ValueError(f'"{text}" is not 1 to {_LONGEST_SYNC_WORD} bytes in hexadecimal; write e.g. a55a')
    return word


def _character(text: str) -> str:
    return "\t" if text == r"\t" else q.line(text) if text != " " else text


def _is_time(name: str) -> bool:
    """Whether the name of a column suggests a time."""
    words = ("time", "stamp", "milli", "micro", "clock")
    return name.lower() in {"t", "ts", "s", "ms", "us"} or any(word in name.lower() for word in words)
