"""What ``daqsvc new --listen`` heard on a serial port, for the questions and for the file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from daqsvc.rounding import counted
from drivers import packed_questions as packed
from drivers.bus_questions import Heard, guessed_sensors
from drivers.names import lines_stream, sensor_name, table_name, unused
from drivers.questions import NONE, Answers, sensor_key
from drivers.serial.sniff_words import (
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
    seen_width,
    sync_words,
    turn_words,
    unchecked_words,
    width_words,
)
from drivers.sniffing import (
    LEAST_SWINGING_HZ,
    TYPE_OF_UNIT,
    by_name,
    quoted,
    unit_of_suffix,
    usual_rate,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from drivers.bus_questions import BusQuestions

CRCS = {"ibm-3740": "begins with 0xffff", "xmodem": "begins with 0", "none": "frames have none"}
DELIMITERS = {"lf": "\n", "cr": "\r", ";": ";"}
_SHOWN_LINES = 2
_WIDEST_COUNTER = 32
_UNKNOWN_CHANNELS = "c1, c2, c3"


class HeardOnSerial(Heard):
    """Lines of text or binary frames.

    Attributes:
        figures: those of `drivers.serial.sniff.SerialSniffer`.
    """

    def __init__(self, figures: Mapping[str, Any], questions: BusQuestions) -> None:
        super().__init__(list(_in_words(figures)), _missed(figures))
        self.figures, self._questions = figures, questions

    def proposals(self, answers: Answers) -> dict[str, str]:
        """See `Heard.proposals`."""
        proposed = {"baud": f"{self.figures['baud']}", "character": self.figures["character"]}
        proposed["framing"] = self.figures["framing"]
        of_framing = self._of_lines if self.figures["framing"] == "lines" else self._of_frames
        return proposed | of_framing(answers) | self._no_limits(answers)

    def _of_lines(self, answers: Answers) -> dict[str, str]:
        """Proposals for lines of text."""
        taken: set[str] = set()
        named = {unused(table_name(one["name"], "column"), taken): one for one in self.figures["columns"]}
        proposed = {
            "prefix": self.figures["prefix"] or NONE,
            "line-end": next(name for name, end in DELIMITERS.items() if end == self.figures["delimiter"]),
            "separator": {"\t": r"\t"}.get(self.figures["separator"], self.figures["separator"] or ","),
            "decimal": self.figures["decimal"],
            "checksum": self.figures["checksum"],
            "columns": ", ".join(named),
        }
        if self.figures["rate_hz"] is not None:
            proposed["rate"] = f"{usual_rate(self.figures['rate_hz']):g}"
        # Most engineers name the columns themselves: what is known of each is known by its place.
        for name, one in zip(answers.get("columns", named), named.values(), strict=False):
            if one["numeric"] and one["prefix"]:
                proposed[sensor_key(name, "prefix")] = one["prefix"]
            if one["numeric"] and one["unit"]:
                proposed[sensor_key(name, "suffix")] = one["unit"]
            if kind := _swinging_type(one, name, answers.get("rate", self.figures["rate_hz"])):
                proposed[sensor_key(name, "type")] = kind
            if (chosen := answers.get(sensor_key(name, "type"))) and self._is_of_several(answers):
                named_after = sensor_name(name, chosen, lines_stream(answers["prefix"]), by_stream=True)
                proposed[sensor_key(name, "name")] = named_after
            if one["counts"] or one["time_unit"]:
                proposed |= {"counter": name, "counts": one["time_unit"] or "count"}
                proposed["counter-bits"] = f"{one['bits'] or _WIDEST_COUNTER}"
            elif one["turns_at"] or not one["numeric"]:
                # What begins again after 999 is no counter, and measures nothing: what was heard states it.
                proposed[sensor_key(name, "type")] = NONE
        # Else a person who takes all defaults would have lines counted by what counts nothing.
        proposed.setdefault("counter", NONE)
        return proposed

    def _is_of_several(self, answers: Answers) -> bool:
        """Whether the stream is of one kind of lines out of several: columns may have the same names."""
        return bool(answers.get("prefix") and self.figures["other_prefixes"])

    def _of_frames(self, answers: Answers) -> dict[str, str]:
        """Proposals for binary frames."""
        figures = self.figures
        known = _is_known_crc(figures)
        proposed = {
            "crc": figures["crc"] if known else "none",
            "payload-length": f"{_payload_length(figures)}",
        }
        if figures["sync_word"]:
            proposed["sync-word"] = figures["sync_word"]
        if known:
            proposed["crc-order"] = figures["crc_order"]
        # As the sniffer proposes it: what a count is worth is not known, and volts of a probe are not heard.
        proposed["scale"] = "1"
        if figures["counter"] is not None:
            counter = figures["counter"]
            if figures["counter_bits"] is not None:
                counter = {**counter, **{key: figures[f"counter_{key}"] for key in ("byte", "bits", "order")}}
            proposed |= packed.frame_proposals(figures["payload_length"], counter, answers)
        # Where more channels fit than are worth proposing, the names of an example would seem to be known.
        proposed.setdefault("channels", _UNKNOWN_CHANNELS)
        if "samples-per-frame" in answers and figures["rate_hz"] is not None:
            proposed["rate"] = f"{usual_rate(figures['rate_hz'] * answers['samples-per-frame']):g}"
        return proposed

    def _no_limits(self, answers: Answers) -> dict[str, str]:
        """No limits are proposed where type and unit of every sensor are a guess."""
        if "rate" not in answers or "limits" in answers:
            return {}
        bus = self._questions
        kinds = {one: answers.get(sensor_key(one, "type")) for one in bus.channels(answers)}
        vibrations = {one: kind for one, kind in kinds.items() if kind in TYPE_OF_UNIT.values()}
        is_guess = [
            kind in {bus.guess(answers, one)[0], "accelerometer"}
            and by_name(one) is None
            and answers.get(sensor_key(one, "suffix")) is None
            for one, kind in vibrations.items()
        ]
        levels = [one for one in kinds if answers.get(sensor_key(one, "unit")) == "mm/s"]
        return {"limits": NONE} if is_guess and all(is_guess) and not levels else {}

    def notes(self, answers: Answers, assumed: Collection[str], taken: Collection[str]) -> Iterable[str]:
        """See `Heard.notes`."""
        del assumed
        if self.figures["any_baud"]:
            yield f"baud = {answers['baud']} is {ANY_BAUD}."
        channels = self._questions.channels(answers)
        if answers["framing"] != "lines":
            if {"channels", "raw-type", "byte-order", "scale"} & set(taken):
                yield (
                    "What is behind the counter of a frame is a guess: channels, type, byte order and scale. "
                    "See the device's manual."
                )
            if "sync-word" in taken and self.figures["sync_word"] and not self.figures["crc"]:
                yield sync_words(self.figures["sync_word"])
            if "counter-bits" in taken and (guess := _width(self.figures)):
                yield guess
            yield from guessed_sensors(answers, channels, taken)
            return
        counter = answers["counter"]
        if counter is not None and "counter" in taken:
            what = (
                "counts lines"
                if answers["counts"] == "count"
                else f"is the device's time in {answers['counts']}"
            )
            yield f"That {counter} {what} is a guess by the lines that came: see the device's manual."
        yield from self._guessed_by_values(answers, channels, taken)

    def _guessed_by_values(
        self, answers: Answers, channels: Sequence[str], taken: Collection[str]
    ) -> Iterator[str]:
        """Which sensors are a guess, and by what."""
        swinging = self._swinging(answers)
        kinds = {name: answers[sensor_key(name, "type")] for name in swinging}
        by_values = [
            name
            for name, kind in kinds.items()
            if kind in {"accelerometer", "velocity"} and sensor_key(name, "type") in taken
        ]
        if by_values:
            yield (
                f"{', '.join(by_values)}: type and unit of the sensor are a guess by the values, which swing "
                "about 0; see the device's manual."
            )
        if averaged := [name for name, kind in kinds.items() if kind == "trend"]:
            yield (
                f"{', '.join(averaged)}: the values swing about 0. A trend value is averaged over "
                "window_s, so that an alarm on it may never come: if it is a vibration, have the device send "
                "its RMS."
            )
        unstated = [name for name in channels if answers.get(sensor_key(name, "suffix")) is None]
        yield from guessed_sensors(answers, [one for one in unstated if one not in by_values], taken)

    def _swinging(self, answers: Answers) -> list[str]:
        """The columns that swing about 0 and have a sensor, by the names that were answered."""
        figures = self.figures
        if figures["framing"] != "lines" or len(answers["columns"]) != len(figures["columns"]):
            return []
        pairs = zip(answers["columns"], figures["columns"], strict=True)
        return [name for name, one in pairs if one["swings"] and sensor_key(name, "type") in answers]

    def not_read(self, answers: Answers) -> Iterable[str]:
        """See `Heard.not_read`."""
        figures = self.figures
        if figures["framing"] != answers["framing"]:
            return
        if figures["framing"] == "lines":
            yield from self._not_read_of_lines(answers)
        elif figures["crc"] and not _is_known_crc(figures):
            yield unchecked_words(figures["crc"])

    def _not_read_of_lines(self, answers: Answers) -> Iterator[str]:
        """What of the lines is not in the file."""
        figures = self.figures
        if self.missed:
            yield f"What was heard does not fit this file: {self.missed}."
            return
        if figures["lines_damaged"]:
            words = other_lines_words(
                figures["lines_damaged"], figures["lines_heard"], figures["damaged_line"]
            )
            yield f"{words}."
        kinds = [figures["prefix"], *figures["other_prefixes"]]
        if figures["other_prefixes"] and answers["prefix"] in kinds:
            yield other_kinds_words([one for one in kinds if one != answers["prefix"]])
        if len(answers["columns"]) == len(figures["columns"]):
            yield from self._columns_not_read(answers)

    def _columns_not_read(self, answers: Answers) -> Iterator[str]:
        """What of the columns is not in the file, or not always."""
        figures = self.figures
        heard, texts = figures["lines_heard"] - figures["lines_damaged"], {}
        for name, one in zip(answers["columns"], figures["columns"], strict=True):
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


def _swinging_type(one: Mapping[str, Any], name: str, rate_hz: float | None) -> str | None:
    """The type of the sensor of a column whose values swing about 0; None if nothing is known."""
    if not one["swings"] or rate_hz is None or rate_hz < LEAST_SWINGING_HZ:
        return None
    if by_name(name) not in {None, "accelerometer"}:
        return None
    return TYPE_OF_UNIT.get(unit_of_suffix(one["unit"])) if one["unit"] else "accelerometer"


def _in_words(figures: Mapping[str, Any]) -> Iterator[str]:
    """What was heard, in a few lines."""
    rate = "" if figures["rate_hz"] is None else f", {figures['rate_hz']:.4g} a second"
    baud = "any baud rate" if figures["any_baud"] else f"{figures['baud']} bit/s"
    line = f"{baud}, {figures['character']}"
    if figures["overrun_baud"] is not None:
        yield overrun_words(figures["overrun_baud"], figures["baud"])
    if figures["framing"] != "lines":
        kind = "COBS frames" if figures["framing"] == "cobs" else f"frames behind {figures['sync_word']}"
        counter = figures["counter"]
        counts = f"byte {counter['byte']} of the payload counts" if counter else "nothing counts"
        check = f"CRC {figures['crc'] or 'unknown'}"
        if figures["frames_passing"] < 1:
            check += f" (passes in {100 * figures['frames_passing']:.0f} % of the frames)"
        yield f"{line}: {kind} of {figures['frame_length']} bytes{rate}, {check}, {counts}"
        if figures["sync_word"] and not figures["crc"]:
            yield f"  {sync_words(figures['sync_word'])}"
        if guess := _width(figures):
            yield f"  {guess}"
        return
    prefix = f", each begins with {figures['prefix']}" if figures["prefix"] else ""
    comma = ", numbers with a decimal comma" if figures["decimal"] == "," else ""
    yield f"{line}: lines of text{rate}, {counted(len(figures['columns']), 'column')}{prefix}{comma}"
    if figures["lines_damaged"]:
        damaged, heard = figures["lines_damaged"], figures["lines_heard"]
        yield f"  {other_lines_words(damaged, heard, figures['damaged_line'])}"
    yield from (f"  {one}" for one in figures["lines"][:_SHOWN_LINES])
    yield from (f"  {words}" for one in figures["columns"] for words in _column_words(one))
    if figures["other_prefixes"]:
        yield f"  {other_kinds_words(figures['other_prefixes'])}"


def _width(figures: Mapping[str, Any]) -> str:
    """That the width of the counter is a guess; empty if it is none."""
    if not figures["counter_guess"]:
        return ""
    return width_words(figures["counter_bits"], figures["counter"]["step"], figures["rate_hz"])


def _column_words(one: Mapping[str, Any]) -> Iterator[str]:
    """What is known of a column, in a few lines."""
    if one["turns_at"]:
        yield turn_words(one["name"], one["turns_at"])
    elif one["counts"] and not one["bits"]:
        yield f"{one['name']} counts lines; {MUST_TURN}"
    elif one["counts"]:
        yield f"{one['name']} counts lines, and {seen_width(one['bits'])}"
    elif one["unit"]:
        yield f"{one['name']} is in {one['unit']}, as the device writes it behind the number"
    if one["prefix"]:
        yield f"{one['name']} is the number behind {one['prefix']}"


def _missed(figures: Mapping[str, Any]) -> str:
    """See `Heard.missed`: what a stream needs, and the device does not send."""
    if figures["framing"] != "lines":
        if figures["counter"] is not None and figures["counter_bits"] is not None:
            return ""
        return f"{frames_need(_payload_length(figures))}. Remedy: see the manual of the device"
    numbers = [one for one in figures["columns"] if one["numeric"]]
    if any(not (one["counts"] or one["time_unit"] or one["turns_at"]) for one in numbers):
        return ""
    begin = "" if numbers else f"{NO_NUMBERS} "
    return f"{begin}{LINES_NEED}. Remedy: have the device send them"


def _is_known_crc(figures: Mapping[str, Any]) -> bool:
    """Whether it is one of the two that the driver knows, which leave out the sync word."""
    return figures["crc"] in CRCS and figures["crc_from"] == len(figures["sync_word"]) // 2


def _payload_length(figures: Mapping[str, Any]) -> int:
    """Bytes of the payload for the driver; a check that it does not know is a part of it."""
    length: int = figures["payload_length"]
    return length + (0 if _is_known_crc(figures) else figures["crc_bytes"])
