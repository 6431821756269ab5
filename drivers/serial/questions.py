"""What ``daqsvc new`` asks about lines of text, or binary frames, on a serial port."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, ClassVar

from daqsvc.rounding import counted
from drivers import packed_questions as packed
from drivers import questions as q
from drivers.bus_questions import BEFOREHAND, BUS, BusQuestions, Heard, guessed_sensors, only_port, seconds_of
from drivers.questions import NONE, Answers, Question, Topic, sensor_key
from drivers.serial.sniff import SerialSniffer
from drivers.serial.sniff_report import (
    ANY_BAUD,
    LINES_NEED,
    MUST_TURN,
    NO_NUMBERS,
    absent_words,
    frames_need,
    no_number_words,
    other_kinds_words,
    other_lines_words,
    overrun_words,
    turn_words,
    unchecked_words,
    unit_of_suffix,
)
from drivers.sniffing import (
    LEAST_SWINGING_HZ,
    by_name,
    is_waveform_rate,
    quoted,
    sniffed,
    table_name,
    unused,
    usual_rate,
)
from drivers.toml_lines import array, entry

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
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
_CRCS = {"ibm-3740": "begins with 0xffff", "xmodem": "begins with 0", "none": "frames have none"}
_ENDS = {
    "lf": "line feed, with a carriage return before it or not",
    "cr": "carriage return",
    ";": "semicolon",
}
_DELIMITERS = {"lf": "\n", "cr": "\r", ";": ";"}
_UNNAMED = re.compile(r"c\d+")
"""As the sniffer calls columns that have no header."""
_RATES_HZ = (12_800.0, 2560.0, 1280.0, 640.0, 100.0, 10.0, 1.0, 0.1)
_LONGEST_PAYLOAD = 4096
_LONGEST_SYNC_WORD = 8
_TYPE_OF = {
    "g": "accelerometer",
    "m/s2": "accelerometer",
    "mm/s": "velocity",
    **dict.fromkeys(("um", "mm", "mil"), "proximity"),
}
"""Type of a sensor by the unit of its samples, if they are a waveform."""
_KINDS = dict.fromkeys(_CHARACTERS, "")
_LISTEN_S = 3.0
"""Behind the search of the baud rate, which takes some seconds itself."""
_SHOWN_LINES = 2


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
    ) -> Heard:
        """See `BusQuestions.listen`."""
        del folder
        baud = answers.get(BEFOREHAND, {}).get("baud", "")
        words = [*(["--baud", baud] if baud.isdecimal() else []), *seconds_of(answers)]
        found = sniffed(SerialSniffer(_LISTEN_S), [*words, "--", answers["port"]], stop, tell)
        return Heard(
            list(_in_words(found)),
            lambda so_far: _proposals(found, so_far) | self._no_limits(so_far),
            _missed(found),
            notes=lambda so_far, _: [f"baud = {so_far['baud']} is {ANY_BAUD}."] * found["any_baud"],
            not_read=lambda so_far: "\n".join(_not_read(found, so_far)),
            guesses=lambda so_far, taken: _guesses(found, so_far, self.channels(so_far), taken),
        )

    def _no_limits(self, answers: Answers) -> dict[str, str]:
        """No limits are proposed where type and unit of every sensor are a guess."""
        if "rate" not in answers or "limits" in answers:
            return {}
        kinds = {one: answers.get(sensor_key(one, "type")) for one in self.channels(answers)}
        vibrations = {one: kind for one, kind in kinds.items() if kind in _TYPE_OF.values()}
        is_guess = [
            kind in {self.guess(answers, one)[0], "accelerometer"}
            and by_name(one) is None
            and answers.get(sensor_key(one, "suffix")) is None
            for one, kind in vibrations.items()
        ]
        levels = [one for one in kinds if answers.get(sensor_key(one, "unit")) == "mm/s"]
        return {"limits": NONE} if is_guess and all(is_guess) and not levels else {}

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
        yield self.choose("crc", _CRCS, "ibm-3740")
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
        yield from self._ask_around(answers["counter"])

    def _ask_around(self, column: str) -> Iterator[Question]:
        yield self.ask_of(column, "prefix", q.text_or_none, NONE, quiet=True)
        yield self.ask_of(column, "suffix", q.text_or_none, NONE, quiet=True)

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
            usual = _TYPE_OF if is_waveform_rate(answers["rate"]) else {}
            return kind if kind == "keyphasor" else usual.get(unit, "trend"), unit
        # A column without a name may be anything: limits of vibration are not for it.
        anything = _UNNAMED.fullmatch(channel) or answers.get(sensor_key(channel, "prefix")) is not None
        return kind, "1" if unit is None and anything else unit

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
        yield f"[buses.{BUS}]"
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
            yield entry("delimiter", _DELIMITERS[answers["line-end"]], "what ends a line")
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
            counter = {"column": answers["counter"], **_around(answers, answers["counter"])}
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


def _in_words(found: Mapping[str, Any]) -> Iterator[str]:
    """What was heard, in a few lines."""
    rate = "" if found["rate_hz"] is None else f", {found['rate_hz']:.4g} a second"
    baud = "any baud rate" if found["any_baud"] else f"{found['baud']} bit/s"
    line = f"{baud}, {found['character']}"
    if found["overrun_baud"] is not None:
        yield overrun_words(found["overrun_baud"], found["baud"])
    if found["framing"] != "lines":
        kind = "COBS frames" if found["framing"] == "cobs" else f"frames behind {found['sync_word']}"
        counter = found["counter"]
        counts = f"byte {counter['byte']} of the payload counts" if counter else "nothing counts"
        check = f"CRC {found['crc'] or 'unknown'}"
        if found["frames_passing"] < 1:
            check += f" (passes in {100 * found['frames_passing']:.0f} % of the frames)"
        yield f"{line}: {kind} of {found['frame_length']} bytes{rate}, {check}, {counts}"
        return
    prefix = f", each begins with {found['prefix']}" if found["prefix"] else ""
    comma = ", numbers with a decimal comma" if found["decimal"] == "," else ""
    yield f"{line}: lines of text{rate}, {counted(len(found['columns']), 'column')}{prefix}{comma}"
    if found["lines_damaged"]:
        yield f"  {other_lines_words(found['lines_damaged'], found['lines_heard'], found['damaged_line'])}"
    yield from (f"  {one}" for one in found["lines"][:_SHOWN_LINES])
    yield from (f"  {words}" for one in found["columns"] for words in _column_words(one))
    if found["other_prefixes"]:
        yield f"  {other_kinds_words(found['other_prefixes'])}"


def _column_words(one: Mapping[str, Any]) -> Iterator[str]:
    """What is known of a column, in a few lines."""
    if one["turns_at"]:
        yield turn_words(one["name"], one["turns_at"])
    elif one["counts"]:
        yield f"{one['name']} counts lines; {MUST_TURN}"
    elif one["unit"]:
        yield f"{one['name']} is in {one['unit']}, as the device writes it behind the number"
    if one["prefix"]:
        yield f"{one['name']} is the number behind {one['prefix']}"


def _proposals(found: Mapping[str, Any], answers: Answers) -> dict[str, str]:
    """See `Heard.proposals`."""
    proposed = {"baud": f"{found['baud']}", "character": found["character"]}
    proposed["framing"] = found["framing"]
    if found["framing"] != "lines":
        return proposed | _frame_proposals(found, answers)
    taken: set[str] = set()
    named = {unused(table_name(one["name"], "column"), taken): one for one in found["columns"]}
    proposed |= {
        "prefix": found["prefix"] or NONE,
        "line-end": next(name for name, end in _DELIMITERS.items() if end == found["delimiter"]),
        "separator": {"\t": r"\t"}.get(found["separator"], found["separator"] or ","),
        "decimal": found["decimal"],
        "checksum": found["checksum"],
        "columns": ", ".join(named),
    }
    if found["rate_hz"] is not None:
        proposed["rate"] = f"{usual_rate(found['rate_hz']):g}"
    # Most engineers name the columns themselves: what is known of each is known by its place.
    for name, one in zip(answers.get("columns", named), named.values(), strict=False):
        if one["numeric"] and one["prefix"]:
            proposed[sensor_key(name, "prefix")] = one["prefix"]
        if one["numeric"] and one["unit"]:
            proposed[sensor_key(name, "suffix")] = one["unit"]
        if kind := _swinging_type(one, name, answers.get("rate", found["rate_hz"])):
            proposed[sensor_key(name, "type")] = kind
        if one["counts"] or one["time_unit"]:
            proposed |= {"counter": name, "counts": one["time_unit"] or "count"}
        elif one["turns_at"] or not one["numeric"]:
            # What begins again after 999 is no counter, and measures nothing: what was heard states it.
            proposed[sensor_key(name, "type")] = NONE
    # Else a person who takes all defaults would have lines counted by what counts nothing.
    proposed.setdefault("counter", NONE)
    return proposed


def _swinging_type(one: Mapping[str, Any], name: str, rate_hz: float | None) -> str | None:
    """The type of the sensor of a column whose values swing about 0; None if nothing is known."""
    if not one["swings"] or rate_hz is None or rate_hz < LEAST_SWINGING_HZ:
        return None
    if by_name(name) not in {None, "accelerometer"}:
        return None
    return _TYPE_OF.get(unit_of_suffix(one["unit"])) if one["unit"] else "accelerometer"


def _not_read(found: Mapping[str, Any], answers: Answers) -> Iterator[str]:
    """See `Heard.not_read`."""
    if found["framing"] != answers["framing"]:
        return
    if found["framing"] == "lines":
        yield from _not_read_of_lines(found, answers)
    elif found["crc"] and not _is_known_crc(found):
        yield unchecked_words(found["crc"])


def _not_read_of_lines(found: Mapping[str, Any], answers: Answers) -> Iterator[str]:
    if missed := _missed(found):
        yield f"What was heard does not fit this file: {missed}."
        return
    if found["lines_damaged"]:
        words = other_lines_words(found["lines_damaged"], found["lines_heard"], found["damaged_line"])
        yield f"{words}."
    kinds = [found["prefix"], *found["other_prefixes"]]
    if found["other_prefixes"] and answers["prefix"] in kinds:
        yield other_kinds_words([one for one in kinds if one != answers["prefix"]])
    if len(answers["columns"]) == len(found["columns"]):
        yield from _columns_not_read(found, answers)


def _columns_not_read(found: Mapping[str, Any], answers: Answers) -> Iterator[str]:
    """What of the columns is not in the file, or not always."""
    heard, texts = found["lines_heard"] - found["lines_damaged"], {}
    for name, one in zip(answers["columns"], found["columns"], strict=True):
        measured = answers.get(sensor_key(name, "type")) not in {None, NONE}
        if not one["numeric"] and (measured or name == answers["counter"]):
            yield (
                f"No number was heard in column {name}, but e.g. {quoted(one['last'])}: a line without a "
                "number there is not read."
            )
        elif not one["numeric"]:
            texts[name] = one["last"]
        elif measured and one["absent"]:
            yield absent_words(name, one["absent"], heard, one["absent_text"])
    if texts:
        yield no_number_words(texts)


def _guesses(
    found: Mapping[str, Any], answers: Answers, channels: Sequence[str], taken: Collection[str]
) -> list[str]:
    """See `Heard.guesses`."""
    notes = []
    if answers["framing"] != "lines":
        if {"channels", "raw-type", "byte-order", "scale"} & set(taken):
            notes.append(
                "What is behind the counter of a frame is a guess: channels, type, byte order and scale. "
                "See the device's manual."
            )
        return [*notes, *guessed_sensors(answers, channels, taken)]
    counter = answers["counter"]
    if counter is not None and "counter" in taken:
        what = (
            "counts lines" if answers["counts"] == "count" else f"is the device's time in {answers['counts']}"
        )
        notes.append(f"That {counter} {what} is a guess by the lines that came: see the device's manual.")
    swinging = _swinging(found, answers)
    by_values = [
        name for name in swinging if answers[sensor_key(name, "type")] in {"accelerometer", "velocity"}
    ]
    by_values = [name for name in by_values if sensor_key(name, "type") in taken]
    if by_values:
        notes.append(
            f"{', '.join(by_values)}: type and unit of the sensor are a guess by the values, which swing "
            "about 0; see the device's manual."
        )
    averaged = [name for name in swinging if answers[sensor_key(name, "type")] == "trend"]
    if averaged:
        notes.append(
            f"{', '.join(averaged)}: the values swing about 0. A trend value is averaged over "
            "window_s, so that an alarm on it may never come: if it is a vibration, have the device send its "
            "RMS."
        )
    unstated = [name for name in channels if answers.get(sensor_key(name, "suffix")) is None]
    return [*notes, *guessed_sensors(answers, [one for one in unstated if one not in by_values], taken)]


def _swinging(found: Mapping[str, Any], answers: Answers) -> list[str]:
    """The columns that swing about 0 and have a sensor, by the names that were answered."""
    if found["framing"] != "lines" or len(answers["columns"]) != len(found["columns"]):
        return []
    pairs = zip(answers["columns"], found["columns"], strict=True)
    return [name for name, one in pairs if one["swings"] and sensor_key(name, "type") in answers]


def _missed(found: Mapping[str, Any]) -> str:
    """See `Heard.missed`: what a stream needs, and the device does not send."""
    if found["framing"] != "lines":
        if found["counter"] is not None and found["counter_bits"] is not None:
            return ""
        return f"{frames_need(_payload_length(found))}. Remedy: see the manual of the device"
    numbers = [one for one in found["columns"] if one["numeric"]]
    if any(not (one["counts"] or one["time_unit"] or one["turns_at"]) for one in numbers):
        return ""
    begin = "" if numbers else f"{NO_NUMBERS} "
    return f"{begin}{LINES_NEED}. Remedy: have the device send them"


def _is_known_crc(found: Mapping[str, Any]) -> bool:
    """Whether it is one of the two that the driver knows, which leave out the sync word."""
    return found["crc"] in _CRCS and found["crc_from"] == len(found["sync_word"]) // 2


def _payload_length(found: Mapping[str, Any]) -> int:
    """Bytes of the payload for the driver; a check that it does not know is a part of it."""
    length: int = found["payload_length"]
    return length + (0 if _is_known_crc(found) else found["crc_bytes"])


def _frame_proposals(found: Mapping[str, Any], answers: Answers) -> dict[str, str]:
    """Those of binary frames; see `Heard.proposals`."""
    known = _is_known_crc(found)
    proposed = {"crc": found["crc"] if known else "none", "payload-length": f"{_payload_length(found)}"}
    if found["sync_word"]:
        proposed["sync-word"] = found["sync_word"]
    if known:
        proposed["crc-order"] = found["crc_order"]
    # As the sniffer proposes it: what a count is worth is not known, and volts of a probe are not heard.
    proposed["scale"] = "1"
    if found["counter"] is not None:
        counter = {**found["counter"], "bits": found["counter_bits"] or found["counter"]["bits"]}
        proposed |= packed.frame_proposals(found["payload_length"], counter, answers)
    if "samples-per-frame" in answers and found["rate_hz"] is not None:
        proposed["rate"] = f"{usual_rate(found['rate_hz'] * answers['samples-per-frame']):g}"
    return proposed
