"""The questions of ``daqsvc new`` about CAN frames that a DBC file describes."""

from __future__ import annotations

import math
from contextlib import suppress
from functools import partial
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any, ClassVar

from daqsvc.rounding import counted
from drivers import packed_questions as packed
from drivers import questions as q
from drivers.bus_questions import BEFOREHAND
from drivers.can.dbc_heard import HeardMessages
from drivers.can.dbc_likely import (
    by_page_of,
    come_together,
    likely_counter,
    likely_measured,
    likely_message,
    may_be_counters,
    never_negative,
    share_of_frames,
    with_signals,
)
from drivers.can.heard import SHOWN
from drivers.can.numbered import (
    beside_samples,
    is_named_sample,
    most_likely_samples,
    of_one_channel,
    of_separate_sensors,
    samples_of_one,
    unit_names,
)
from drivers.can.questions import CanQuestions
from drivers.can.sniff import of_another_stream
from drivers.names import LONGEST_NAME, message_stream
from drivers.questions import NONE, Answers, Question, Topic, sensor_key
from drivers.sniffing import LONGEST_UNIT, Values, by_name, is_waveform_rate, quoted, type_by_unit
from drivers.toml_lines import array, behind, entry, toml

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    from cantools.database.can import Message

    from drivers.can.heard import HeardOnCan


class DbcQuestions(CanQuestions):
    """Samples as signals of a DBC message."""

    about = "CAN, frames described by a DBC file"
    topics: ClassVar[Mapping[str, Topic]] = {
        **CanQuestions.topics,
        "dbc": Topic(
            "Which DBC file describes the frames?", "The maker of the device has it. A path from this folder."
        ),
        "message": Topic(
            "Which message of it carries the samples?", "The frame that comes at the sampling rate."
        ),
        "signals": Topic(
            "Which of its signals are measured?",
            "Names with commas between, e.g. AccelX, AccelY; each becomes a channel. Leave out counters and "
            "states. Of a multiplexed message take the signals of one page: the other pages get separate "
            "streams.",
        ),
        "consecutive": Topic(
            "Are numbered signals such as AX_0, AX_1 consecutive samples of one channel?",
            "yes: the device measures faster than it sends, and puts several samples into a frame, the "
            "oldest first; what has no number is then left out, as it comes once a frame. no: they are of "
            "separate sensors, as Temp1, Temp2 may be.",
        ),
        "counter-counts": packed.TOPICS["counter-counts"],
    }

    def questions(self, answers: Answers, folder: Path) -> Iterator[Question]:
        """See `BusQuestions.questions`."""
        yield from self._interface()
        answers["dbc-folder"] = folder
        yield self.ask("dbc", partial(_dbc_file, folder))
        messages = self._messages(answers)
        choices = {name: _about(one) for name, one in messages.items()}
        yield self.ask("message", partial(_message, messages), likely_message(messages), choices=choices)
        message = messages[answers["message"]]
        answers["fd"] = message.length > 8
        yield from self._bit_rates(answers, fd=answers["fd"])
        signals = {one.name: one for one in message.signals}
        by_page = by_page_of(message)
        counters = {
            one.name: f"{one.length} bits{_of_all_pages(one) if by_page else ''}"
            for one in may_be_counters(message)
        }
        choices = {**counters, NONE: "losses are then estimated from the times of arrival"}
        yield self.ask("counter", q.exactly(choices), likely_counter(message) or NONE, choices=choices)
        rest = [name for name in signals if name != answers["counter"]]
        measured = likely_measured([signals[name] for name in rest])
        yield self.ask(
            "signals",
            partial(_signals, tuple(rest), signals),
            ", ".join(measured or rest[:1]),
            choices=_shown(by_page),
        )
        if samples := samples_of_one(answers["signals"]):
            together = "; ".join(f"{stem}: {', '.join(names)}" for stem, names in samples.items())
            others = beside_samples(answers["signals"])
            likely = not others and most_likely_samples(message.signals, answers["signals"])
            if others:
                together += f"; not {', '.join(others)}"
            yield self.ask(
                "consecutive",
                q.yes_no,
                "yes" if likely else "no",
                choices={"yes": together, "no": counted(len(answers["signals"]), "channel")},
            )
        if answers["counter"] is not None and self._samples_in_frame(answers) > 1:
            yield self.choose("counter-counts", packed.COUNTS, "frames", quiet=True)

    listens_behind = "dbc"

    def heard(self, figures: Mapping[str, Any], answers: Answers) -> HeardOnCan:
        """See `CanQuestions.heard`."""
        return HeardMessages(
            figures,
            answers["dbc"],
            self._messages(answers),
            self._samples_in_frame,
            self._types,
            rate_is_stated="rate" in answers.get(BEFOREHAND, {}),
        )

    def origin(self, answers: Answers) -> str:
        """See `BusQuestions.origin`."""
        return f"as {answers['dbc']} describes them"

    def example(self, answers: Answers, assumed: Collection[str]) -> str:
        """See `BusQuestions.example`: what the file states is none, but may leave something out."""
        del assumed
        left_out = beside_samples(answers["signals"]) if answers.get("consecutive") else []
        if not left_out:
            return ""
        return f"Not read: {', '.join(left_out)}. Each {of_another_stream(self._samples_in_frame(answers))}."

    def stated(self, answers: Answers) -> Collection[str]:
        """See `BusQuestions.stated`."""
        known = {"message", "signals", "counter-counts"}
        if not answers.get("consecutive") or all(map(is_named_sample, self._by_channel(answers))):
            known.add("consecutive")  # else it is a guess, whatever the file states of each signal
        if self._messages(answers)[answers["message"]].cycle_time:
            known.add("rate")
        units = self._units(answers)
        return known | {
            sensor_key(name, topic) for name in units for topic in ("type", "unit", "sensitivity")
        }

    def _messages(self, answers: Answers) -> dict[str, Message]:
        return with_signals(answers["dbc-folder"] / answers["dbc"])

    def stream_name(self, answers: Answers) -> str:
        """See `BusQuestions.stream_name`."""
        return message_stream(answers["message"])

    def channels(self, answers: Answers) -> tuple[str, ...]:
        """See `BusQuestions.channels`."""
        return tuple(self._by_channel(answers))

    def _by_channel(self, answers: Answers) -> dict[str, Sequence[str]]:
        """Signals of each channel."""
        if answers.get("consecutive"):
            samples = samples_of_one(answers["signals"])
            return {stem[:LONGEST_NAME]: names for stem, names in samples.items()}
        return {signal[:LONGEST_NAME]: [signal] for signal in answers["signals"]}

    def _samples_in_frame(self, answers: Answers) -> int:
        return len(next(iter(self._by_channel(answers).values())))

    def rate_hz(self, answers: Answers) -> float:
        """See `BusQuestions.rate_hz`."""
        message = self._messages(answers)[answers["message"]]
        cycle_ms: float | None = message.cycle_time
        frames_hz = 1000.0 / (cycle_ms or 1.0) * share_of_frames(message, answers["signals"])
        return round(frames_hz * self._samples_in_frame(answers), 6)

    def guess(self, answers: Answers, channel: str) -> tuple[str, str | None]:
        """See `BusQuestions.guess`."""
        return self._types(answers, {})[channel], self._units(answers).get(channel)

    def _types(self, answers: Answers, heard: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
        """The most likely type of the sensor on each channel.

        Args:
            answers: so far.
            heard: figures of the signals that were heard, by name.
        """
        units, waveform = self._units(answers), is_waveform_rate(answers["rate"])
        signals = {one.name: one for one in self._messages(answers)[answers["message"]].signals}

        def kind_of(channel: str, names: Sequence[str]) -> str:
            of_names = [heard[name] for name in names if name in heard]
            values = Values(
                all(never_negative(signals[name]) for name in names),
                min((one["min"] for one in of_names), default=math.nan),
                max((one["max"] for one in of_names), default=math.nan),
            )
            kind = type_by_unit(channel, units.get(channel), waveform=waveform, values=values)
            return kind or by_name(channel) or "trend"

        return {name: kind_of(name, names) for name, names in self._by_channel(answers).items()}

    def measuring_range(self, answers: Answers, channel: str) -> tuple[float, float] | None:
        """See `BusQuestions.measuring_range`: what the file states, unless it is what the bits can carry."""
        if answers.get(sensor_key(channel, "unit")) != self._units(answers).get(channel):
            return None
        names = self._by_channel(answers)[channel]
        signals = self._messages(answers)[answers["message"]].signals
        ranges = {_stated_range(one) for one in signals if one.name in names}
        return ranges.pop() if len(ranges) == 1 else None

    def in_volts(self, answers: Answers, channel: str) -> bool:
        """See `BusQuestions.in_volts`."""
        return self._units(answers).get(channel) == "V"

    def _other_pages(self, answers: Answers) -> Iterator[str]:
        """Comments on the pages of a multiplexed message that the stream does not read."""
        by_page = by_page_of(self._messages(answers)[answers["message"]])
        chosen = set(answers["signals"])
        others = {page: names for page, names in by_page.items() if not chosen & set(names)}
        if by_page and others:
            yield f"# {answers['message']} is multiplexed. For these pages make separate streams:"
            yield from (f"#   {page} {names}".rstrip() for page, names in _shown(others, ":").items())

    def _states(self, answers: Answers) -> Iterator[str]:
        """Comments on what the values of states mean: limits of alarms lie between them."""
        for signal in self._messages(answers)[answers["message"]].signals:
            if signal.choices and signal.name in answers["signals"]:
                meanings = ", ".join(f"{value} {quoted(f'{text}')}" for value, text in signal.choices.items())
                yield from (f"# {line}" for line in wrap(f"{signal.name} is a state: {meanings}", 98))

    def _units(self, answers: Answers) -> dict[str, str]:
        """Units of the channels: as machine files write them, or as the DBC file does where none is known."""
        signals = self._messages(answers)[answers["message"]].signals
        stated = {one.name: (one.unit or "").strip() for one in signals}
        fitting = {name: unit for name, unit in stated.items() if 0 < len(unit) <= LONGEST_UNIT}
        units = {name: unit for name, unit in fitting.items() if unit.isprintable()}
        units |= unit_names(signals, answers["signals"])
        return {
            name: units[first] for name, (first, *_) in self._by_channel(answers).items() if first in units
        }

    def tables(self, answers: Answers) -> Iterator[str]:
        """See `BusQuestions.tables`."""
        yield from self._bus(answers)
        in_frame = self._samples_in_frame(answers)
        many = "one" if in_frame == 1 else f"{in_frame}"
        yield from self.stream(answers, f"samples a second of each channel, here {many} a frame")
        yield entry("dbc", answers["dbc"], "relative to this file; where signals lie, scale, unit")
        yield entry("message", answers["message"])
        if answers["counter"] is None:
            yield entry("no_counter", value=True, comment="losses are estimated from the times of arrival")
        else:
            counts = answers.get("counter-counts", "frames")
            counter = toml({"signal": answers["counter"], "counts": counts})
            grows = "1 with" if counts == "frames" else "the samples in"
            yield behind(f"counter = {counter}", f"grows by {grows} each frame: losses are counted by it")
        if answers.get("consecutive"):
            for name in beside_samples(answers["signals"]):
                yield f"# {name} is left out: it {of_another_stream(in_frame)}"
            if answers.get("counter-counts") != "samples" and "consecutive" not in self.stated(answers):
                yield from of_separate_sensors(self._by_channel(answers))
        else:
            yield from of_one_channel(answers["signals"])
        yield from self._other_pages(answers)
        yield from self._states(answers)
        channels = self._by_channel(answers).items()
        yield from array("channels", [{"name": name, "signals": [*signals]} for name, signals in channels])


def _dbc_file(folder: Path, text: str) -> str:
    from drivers.frames import LayoutError  # noqa: PLC0415 - only what a bus needs

    path = Path(q.line(text)).expanduser()
    if not (folder / path).exists() and path.exists():
        path = path.absolute()  # typed from another folder than that of the machine file
    try:
        messages = with_signals(folder / path)
    except LayoutError as error:
        raise ValueError(f"{error}") from None
    if not messages:
        raise ValueError(f"{text} describes no message with signals; give another DBC file")
    return f"{path}"


def _message(messages: Mapping[str, Message], text: str) -> str:
    """A message, by its name or by its id."""
    with suppress(ValueError):
        number = int(text.lower().removeprefix("id").strip(), 0)
        of_id = [name for name, one in messages.items() if one.frame_id == number]
        if len(of_id) == 1 and text not in messages:
            return of_id[0]
    return q.exactly(dict.fromkeys(messages, ""))(text) or text


def _about(message: Message) -> str:
    shown = [one.name for one in message.signals[:SHOWN]]
    more = len(message.signals) - len(shown)
    pages = len(by_page_of(message))
    multiplexed = f" ({pages} pages, multiplexed)" if pages else ""
    return f"id {message.frame_id:#x}: {', '.join(shown)}{f' and {more} more' if more else ''}{multiplexed}"


def _shown(by_page: Mapping[str, Sequence[str]], behind: str = "") -> dict[str, str]:
    """The first pages with their signals, as a person reads them."""
    shown = {f"{page}{behind}": ", ".join(by_page[page]) for page in list(by_page)[:SHOWN]}
    more = len(by_page) - len(shown)
    return {**shown, **({f"and {more} more{behind}": "daqsvc sniff can --dbc shows them"} if more else {})}


def _of_all_pages(counter: Any) -> str:
    return "" if counter.multiplexer_ids else "; on all pages: fits if it counts each page by itself"


_MOST_OF_BITS = 0.9
"""A range up to this part of what the bits can carry is one of the sensor; SAE J1939 uses 98 % of them."""


def _stated_range(signal: Any) -> tuple[float, float] | None:
    """The range that a DBC file states for a signal; None where that is what the bits can carry."""
    if signal.minimum is None or signal.maximum is None or signal.choices:
        return None
    least, most = float(signal.minimum), float(signal.maximum)
    carried = math.inf if signal.is_float else (2.0**signal.length - 1.0) * abs(signal.scale)
    return (least, most) if 0.0 < most - least <= _MOST_OF_BITS * carried else None


def _signals(known: tuple[str, ...], signals: Mapping[str, Any], text: str) -> tuple[str, ...]:
    chosen = tuple(part.strip() for part in text.split(","))
    for one in chosen:
        if one not in known:
            raise ValueError(f'there is no signal "{one}"; there are {", ".join(known)}')
    if len({one[:LONGEST_NAME] for one in chosen}) < len(chosen):
        raise ValueError(f'"{text}" has a signal twice')
    if not come_together(signals, chosen):
        paged = sorted(one for one in chosen if signals[one].multiplexer_ids)
        raise ValueError(f"{', '.join(paged)} are on different pages: name those of one page")
    return chosen
