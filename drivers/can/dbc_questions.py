"""The questions of ``daqsvc new`` about CAN frames that a DBC file describes."""

from __future__ import annotations

import functools
import math
import shlex
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from daqsvc.rounding import counted
from drivers import questions as q
from drivers.bus_questions import BUS, is_count
from drivers.can.questions import SHOWN, CanQuestions, decoded_signals, values_heard
from drivers.can.sniff import STATE, number_of, numbered, of_one_channel
from drivers.questions import NONE, Answers, Question, Topic, sensor_key
from drivers.sniffing import (
    LONGEST_UNIT,
    by_name,
    is_waveform_rate,
    usual_rate,
)
from drivers.toml_lines import array, behind, entry, toml

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from cantools.database.can import Message


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
            "oldest first. no: they are of separate sensors, as Temp1, Temp2 may be.",
        ),
    }

    def questions(self, answers: Answers, folder: Path) -> Iterator[Question]:
        """See `BusQuestions.questions`."""
        yield from self._interface()
        answers["dbc-folder"] = folder
        yield self.ask("dbc", partial(_dbc_file, folder))
        messages = self._messages(answers)
        choices = {name: _about(one) for name, one in messages.items()}
        yield self.ask("message", q.exactly(choices), _likely(messages), choices=choices)
        message = messages[answers["message"]]
        answers["fd"] = message.length > 8
        yield from self._bit_rates(answers, fd=answers["fd"])
        signals = {one.name: one for one in message.signals}
        by_page = _by_page(message)
        counters = {
            one.name: f"{one.length} bits{_of_all_pages(one) if by_page else ''}"
            for one in _may_be_counters(message)
        }
        choices = {**counters, NONE: "losses are then estimated from the times of arrival"}
        yield self.ask("counter", q.exactly(choices), _likely_counter(message) or NONE, choices=choices)
        rest = [name for name in signals if name != answers["counter"]]
        measured = _likely_measured([signals[name] for name in rest])
        yield self.ask(
            "signals",
            partial(_signals, tuple(rest), signals),
            ", ".join(measured or rest[:1]),
            choices=_shown(by_page),
        )
        if samples := _samples_of_one(answers["signals"]):
            together = "; ".join(f"{stem}: {', '.join(names)}" for stem, names in samples.items())
            yield self.ask(
                "consecutive",
                q.yes_no,
                "yes" if _most_likely_samples(message.signals, answers["signals"]) else "no",
                choices={"yes": together, "no": counted(len(answers["signals"]), "channel")},
            )

    listens_behind = "dbc"

    def proposals(self, found: Mapping[str, Any], answers: Answers) -> dict[str, str]:
        """See `Heard.proposals`."""
        heard = decoded_signals(found)
        if not heard:
            return {}

        def score(message: Mapping[str, Any]) -> tuple[bool, bool, int]:
            signals = message["signals"]
            counted = any(one["counts_frames"] for one in signals)
            return counted, any(one["unit"] for one in signals), message["frames"]

        best = max(heard, key=score)
        proposed = {"message": best["message"]}
        chosen = next((m for m in heard if m["message"] == answers.get("message", best["message"])), None)
        if chosen is None:
            return proposed
        counters = [one["signal"] for one in chosen["signals"] if one["counts_frames"]]
        if any(one["multiplexed"] for one in chosen["signals"]):
            # Most signals that count do so on all pages, and a stream reads the frames of one.
            likely = _likely_counter(self._messages(answers)[chosen["message"]])
            counters = [one for one in counters if one == likely]
        proposed["counter"] = next(iter(counters), NONE)
        rates = [one["rate_hz"] for one in found["ids"] if one["message"] == chosen["message"]]
        if len(rates) == 1 and rates[0]:
            measured = [one for one in chosen["signals"] if one["signal"] in answers.get("signals", ())]
            share = _simple_share(
                min((one["frames"] for one in measured), default=chosen["frames"]), chosen["frames"]
            )
            in_frame = self._samples_in_frame(answers) if "signals" in answers else 1
            proposed["rate"] = f"{usual_rate(rates[0]) * share * in_frame:g}"
        return proposed

    def missed(self, found: Mapping[str, Any], answers: Answers) -> str:
        """See `Heard.missed`."""
        if decoded_signals(found):
            return ""
        return (
            f"No frame is as {answers['dbc']} describes: it is most likely the file of another device. "
            "Remedy: give the file of the device that sends"
        )

    def unheard(self, found: Mapping[str, Any], answers: Answers) -> str:
        """See `Heard.unheard`."""
        heard = [one["message"] for one in decoded_signals(found)]
        chosen = answers.get("message", "")
        if not heard or not chosen:
            return ""
        if chosen in heard:
            return self._other_length(found, answers) or self._other_counter(found, answers)
        return (
            f"{answers['message']} was not heard. Remedy: correct --message; those that come: "
            f"{', '.join(heard)}"
        )

    def _other_length(self, found: Mapping[str, Any], answers: Answers) -> str:
        """That the frames of the message have another length than the file states; empty if not."""
        message = answers["message"]
        length = self._messages(answers)[message].length
        lengths = {many for one in found["ids"] if one["message"] == message for many in one["lengths"]}
        # Longer frames are of CAN FD, which pads them.
        if not lengths or length in lengths or max(length, *lengths) > 8:
            return ""
        come = " and ".join(f"{many}" for many in sorted(lengths))
        return (
            f"the frames of {message} have {come} bytes, the DBC file states {length}. Remedy: give the file "
            "of the device that sends"
        )

    def _other_counter(self, found: Mapping[str, Any], answers: Answers) -> str:
        """That the signal which is to count the frames was heard and does not; empty if it may."""
        if answers.get("counter") not in self._not_counting(found, answers):
            return ""
        counters = [one for one in self._signals(found, answers) if one["counts_frames"]]
        instead = ", ".join([*(one["signal"] for one in counters), NONE])
        return (
            f"{answers['counter']} does not grow by 1 from frame to frame. Remedy: correct --counter; it may "
            f"be {instead}"
        )

    def _signals(self, found: Mapping[str, Any], answers: Answers) -> list[Mapping[str, Any]]:
        """The signals of the message as they were heard."""
        chosen = (
            one["signals"] for one in decoded_signals(found) if one["message"] == answers.get("message")
        )
        return list(next(chosen, []))

    def _not_counting(self, found: Mapping[str, Any], answers: Answers) -> set[str]:
        """Signals of the message that do not grow by 1 from frame to frame of those that a stream reads."""
        from drivers.counter_search import LEAST_COUNTS  # noqa: PLC0415 - brings numpy

        signals = self._signals(found, answers)
        paged = any(one["multiplexed"] for one in signals)
        # A counter of each page by itself has the same value in several frames in a row.
        return {
            one["signal"]
            for one in signals
            if not one["counts_frames"] and one["frames"] > LEAST_COUNTS and (one["multiplexed"] or not paged)
        }

    def not_offered(self, found: Mapping[str, Any], answers: Answers) -> Mapping[str, Collection[str]]:
        """See `Heard.not_offered`."""
        return {"counter": self._not_counting(found, answers)}

    def notes(self, found: Mapping[str, Any], answers: Answers, assumed: Collection[str]) -> Sequence[str]:
        """See `Heard.notes`: what was heard of the channels, so that a person can judge it."""
        del assumed
        heard = {one["signal"]: one for one in self._signals(found, answers)}
        read = [heard[name] for name in answers["signals"] if name in heard]
        notes = [f"Heard: {values_heard(read)}."] if read else []
        if silent := [name for name in answers["signals"] if name not in heard]:
            notes.append(f"No value was heard of {', '.join(silent[:SHOWN])}.")
        notes += _doubts(one for message in decoded_signals(found) for one in message["signals"])
        if answers["counter"] is None and not any(one["counts_frames"] for one in heard.values()):
            offered = _likely_counter(self._messages(answers)[answers["message"]])
            few = offered is not None and offered not in self._not_counting(found, answers)
            notes.append(
                (
                    f"Too few frames of {answers['message']} came to see whether {offered} counts them: "
                    f"without --counter {offered} lost ones are found by the times of arrival only."
                )
                if few
                else (
                    f"No signal is known to count the frames of {answers['message']}: lost ones are found by "
                    "the times of arrival only."
                )
            )
        counter = heard.get(answers["counter"])
        if counter is not None and not counter["counts_frames"]:
            notes.append(f"It was not heard whether {counter['signal']} counts the frames that are read.")
        return notes

    def unknown(self, found: Mapping[str, Any], answers: Answers, assumed: Collection[str]) -> str:
        """See `Heard.unknown`: values that contradict the file make it most likely that of another device."""
        if "signals" not in answers:
            return ""
        named = None if "signals" in assumed else answers["signals"]
        read = [one for one in self._signals(found, answers) if named is None or one["signal"] in named]
        if not (doubts := _doubts(read)):
            return ""
        return (
            f"{' '.join(doubts)} Remedy: give the file of the device that sends. If it is that one, name "
            "with --signals those that are right, or answer the questions in a terminal, without --yes"
        )

    def not_read(self, found: Mapping[str, Any], answers: Answers) -> str:
        """See `Heard.not_read`: the file reads one message, and of that no states if nobody names them."""
        others = [
            f"{one['message']} ({one['id']:#x})"
            for one in found["ids"]
            if one["message"] not in {None, answers["message"]}
        ]
        more = f" and {len(others) - SHOWN} more" if len(others) > SHOWN else ""
        named = ", ".join(others[:SHOWN])
        said = []
        if others:
            said.append(
                f"Not read: {named}{more}; {_sniffed_by(answers)} prints their tables. Of these take the "
                f'streams and sensors, and write bus = "{BUS}", as this file calls it.'
            )
        taken = {answers["counter"], *answers["signals"]}
        signals = self._messages(answers)[answers["message"]].signals
        states = [one.name for one in signals if one.choices and one.name not in taken]
        said += [f"{name} is left out: {STATE}." for name in states[:SHOWN]]
        heard = [one["signal"] for one in self._signals(found, answers)]
        if rest := [name for name in heard if name not in {*taken, *states}]:
            more = f" and {len(rest) - SHOWN} more" if len(rest) > SHOWN else ""
            said.append(
                f"Not read of {answers['message']}: {', '.join(rest[:SHOWN])}{more}. Name with --signals "
                "what of them is measured."
            )
        return "\n".join(said)

    def origin(self, answers: Answers) -> str:
        """See `BusQuestions.origin`."""
        return f"as {answers['dbc']} describes them"

    def stated(self, answers: Answers) -> Collection[str]:
        """See `BusQuestions.stated`."""
        known = {"message", "signals", "consecutive"}
        if self._messages(answers)[answers["message"]].cycle_time:
            known.add("rate")
        units = self._units(answers)
        return known | {
            sensor_key(name, topic) for name in units for topic in ("type", "unit", "sensitivity")
        }

    def _messages(self, answers: Answers) -> dict[str, Message]:
        return _with_signals(answers["dbc-folder"] / answers["dbc"])

    def channels(self, answers: Answers) -> tuple[str, ...]:
        """See `BusQuestions.channels`."""
        return tuple(self._by_channel(answers))

    def _by_channel(self, answers: Answers) -> dict[str, Sequence[str]]:
        """Signals of each channel."""
        if answers.get("consecutive"):
            samples = _samples_of_one(answers["signals"])
            return {stem[: q.LONGEST_NAME]: names for stem, names in samples.items()}
        return {signal[: q.LONGEST_NAME]: [signal] for signal in answers["signals"]}

    def _samples_in_frame(self, answers: Answers) -> int:
        return len(next(iter(self._by_channel(answers).values())))

    def rate_hz(self, answers: Answers) -> float:
        """See `BusQuestions.rate_hz`."""
        message = self._messages(answers)[answers["message"]]
        cycle_ms: float | None = message.cycle_time
        frames_hz = 1000.0 / (cycle_ms or 1.0) * _share(message, answers["signals"])
        return round(frames_hz * self._samples_in_frame(answers), 6)

    def guess(self, answers: Answers, channel: str) -> tuple[str, str | None]:
        """See `BusQuestions.guess`."""
        unit = self._units(answers).get(channel)
        kind = _KINDS.get(unit or "")
        if not is_waveform_rate(answers["rate"]):
            kind = "trend"
        return kind or by_name(channel) or "trend", unit

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
        by_page = _by_page(self._messages(answers)[answers["message"]])
        chosen = set(answers["signals"])
        others = {page: names for page, names in by_page.items() if not chosen & set(names)}
        if by_page and others:
            yield f"# {answers['message']} is multiplexed. For these pages make separate streams:"
            yield from (f"#   {page} {names}".rstrip() for page, names in _shown(others, ":").items())

    def _units(self, answers: Answers) -> dict[str, str]:
        """Units of the channels: as machine files write them, or as the DBC file does where none is known."""
        signals = self._messages(answers)[answers["message"]].signals
        stated = {one.name: (one.unit or "").strip() for one in signals}
        fitting = {name: unit for name, unit in stated.items() if 0 < len(unit) <= LONGEST_UNIT}
        units = {name: unit for name, unit in fitting.items() if unit.isprintable()}
        units |= _unit_names(signals, answers["signals"])
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
            counter = toml({"signal": answers["counter"], "counts": "frames"})
            yield behind(f"counter = {counter}", "grows by 1 with each frame: losses are counted by it")
        if not answers.get("consecutive"):
            yield from of_one_channel(answers["signals"])
        yield from self._other_pages(answers)
        channels = self._by_channel(answers).items()
        yield from array("channels", [{"name": name, "signals": [*signals]} for name, signals in channels])


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
    changed_ns = file.stat().st_mtime_ns if file.is_file() else 0
    return _read_once(file.absolute(), changed_ns)


@functools.lru_cache(maxsize=1)
def _read_once(file: Path, changed_ns: int) -> dict[str, Message]:
    """The same; a large file takes seconds, and is asked about several times."""
    from drivers.can.dbc import messages_of  # noqa: PLC0415 - cantools is slow to import

    del changed_ns
    return {message.name: message for message in messages_of(file) if message.signals}


def _sniffed_by(answers: Answers) -> str:
    """The command that looks at the same bus with the same DBC file."""
    adapter = [] if answers["interface"] == "socketcan" else ["--interface", answers["interface"]]
    adapter += ["--fd"] if adapter and answers["fd"] else []
    return shlex.join(["daqsvc", "sniff", "can", answers["channel"], *adapter, "--dbc", answers["dbc"]])


def _doubts(signals: Iterable[Mapping[str, Any]]) -> list[str]:
    """What of the values that were heard contradicts the DBC file."""
    return [one["doubt"] for one in signals if one["doubt"]][:SHOWN]


def _about(message: Message) -> str:
    shown = [one.name for one in message.signals[:SHOWN]]
    more = len(message.signals) - len(shown)
    pages = len(_by_page(message))
    multiplexed = f" ({pages} pages, multiplexed)" if pages else ""
    return f"id {message.frame_id:#x}: {', '.join(shown)}{f' and {more} more' if more else ''}{multiplexed}"


def _by_page(message: Message) -> dict[str, list[str]]:
    from drivers.can.dbc import signals_by_page  # noqa: PLC0415 - cantools is slow to import

    return signals_by_page(message)


def _come_together(signals: Mapping[str, Any], names: Iterable[str]) -> bool:
    """Whether some frame holds all of these signals."""
    from drivers.can.dbc import selecting_values  # noqa: PLC0415 - cantools is slow to import

    return all(selecting_values(signals, names).values())


def _share(message: Message, names: Sequence[str]) -> float:
    """Which part of the frames holds these signals, if all pages come equally often."""
    from drivers.can.dbc import selecting_values, values_of  # noqa: PLC0415 - cantools is slow to import

    pages = selecting_values({one.name: one for one in message.signals}, names)
    return math.prod(len(values) / len(values_of(message, selector)) for selector, values in pages.items())


def _simple_share(frames: int, of_all: int) -> float:
    """The simplest fraction that so many of all frames can be: of a short time, one frame more or less."""
    for pages in range(1, of_all):
        taken = max(round(frames / of_all * pages), 1)
        if abs(frames - of_all * taken / pages) <= 1.0:
            return taken / pages
    return frames / of_all


def _shown(by_page: Mapping[str, Sequence[str]], behind: str = "") -> dict[str, str]:
    """The first pages with their signals, as a person reads them."""
    shown = {f"{page}{behind}": ", ".join(by_page[page]) for page in list(by_page)[:SHOWN]}
    more = len(by_page) - len(shown)
    return {**shown, **({f"and {more} more{behind}": "daqsvc sniff can --dbc shows them"} if more else {})}


def _of_pages(signals: Iterable[Any]) -> bool:
    """Whether any of the signals comes in some frames of its message only."""
    return any(one.multiplexer_ids for one in signals)


def _of_all_pages(counter: Any) -> str:
    return "" if counter.multiplexer_ids else "; on all pages: fits if it counts each page by itself"


def _samples_of_one(signals: Sequence[str]) -> dict[str, list[str]]:
    """Signals that may be samples of one channel, by its name; none if a stream cannot read all as such."""
    found = numbered(signals)
    lengths = {len(names) for names in found.values()}
    return found if len(lengths) == 1 and sum(map(len, found.values())) == len(signals) else {}


_KINDS = {
    "g": "accelerometer",
    "m/s2": "accelerometer",
    "mm/s": "velocity",
    **dict.fromkeys(("um", "mm", "mil"), "proximity"),
}
"""Sensors by the unit of their samples."""


_MOST_OF_BITS = 0.9
"""A range up to this part of what the bits can carry is one of the sensor; SAE J1939 uses 98 % of them."""


def _stated_range(signal: Any) -> tuple[float, float] | None:
    """The range that a DBC file states for a signal; None where that is what the bits can carry."""
    if signal.minimum is None or signal.maximum is None or signal.choices:
        return None
    least, most = float(signal.minimum), float(signal.maximum)
    carried = math.inf if signal.is_float else (2.0**signal.length - 1.0) * abs(signal.scale)
    return (least, most) if 0.0 < most - least <= _MOST_OF_BITS * carried else None


def _most_likely_samples(signals: Iterable[Any], names: Sequence[str]) -> list[str]:
    """Those of the names that count from 0, and are of vibration: hardly of separate sensors."""
    units = _unit_names(signals, names)
    found = {
        stem: of_one
        for stem, of_one in numbered(names).items()
        if number_of(of_one[0]) == 0 and all(units.get(name) in _KINDS for name in of_one)
    }
    return [name for name in names if any(name in of_one for of_one in found.values())]


def _unit_names(signals: Iterable[Any], names: Iterable[str]) -> dict[str, str]:
    """Units of the signals of these names, as far as they are known, as machine files write them."""
    from daqsvc.settings.units import unit_of  # noqa: PLC0415 - brings the settings

    chosen = set(names)
    known = {one.name: unit_of(one.unit or "") for one in signals if one.name in chosen}
    return {name: unit.name for name, unit in known.items() if unit is not None}


def _likely(messages: Mapping[str, Message]) -> str:
    """The message that most likely carries samples: of vibration, with a counter, of numbers with units."""

    def score(message: Message) -> tuple[bool, bool, bool, int]:
        units = _unit_names(message.signals, [one.name for one in message.signals])
        vibration = any(unit in _KINDS for unit in units.values())
        counted = any(is_count(one.name) for one in message.signals)
        return (
            vibration,
            counted,
            not message.is_multiplexed(),
            sum(bool(one.unit) for one in message.signals),
        )

    return max(messages, key=lambda name: score(messages[name]))


def _may_be_counters(message: Message) -> list[Any]:
    """Signals of a message that may count its frames by how they are made."""
    return [one for one in message.signals if _may_count(one, len(message.signals))]


def _likely_counter(message: Message) -> str | None:
    """The signal that counts the frames of a stream by its name; None if there is none."""
    named = [one for one in _may_be_counters(message) if is_count(one.name)]
    signals = {one.name: one for one in message.signals}
    if _of_pages(signals[name] for name in _likely_measured(message.signals)):
        named = [one for one in named if _of_pages([one])]
    return next((str(one.name) for one in named), None)


def _may_count(signal: Any, signals: int) -> bool:
    plain = not signal.is_signed and not signal.is_float and signal.scale == 1 and signal.length >= 4
    return bool(plain) and signals > 1 and not signal.is_multiplexer


def _likely_measured(signals: Sequence[Any]) -> list[str]:
    """Names of what one stream measures: no states, no selectors, one page of a multiplexed message."""
    numbers = [one for one in signals if not one.is_multiplexer and not one.choices]
    always = [one for one in numbers if one.multiplexer_ids is None]
    known = {one.name: one for one in signals}
    page: list[Any] = []
    for one in sorted((n for n in numbers if n.multiplexer_ids), key=lambda n: min(n.multiplexer_ids)):
        if _come_together(known, [*(other.name for other in page), one.name]):
            page.append(one)
    for likely in (always, page):
        if found := [one.name for one in likely if one.unit]:
            return _most_likely_samples(signals, found) or found
    return [one.name for one in (always or page)[:1]]


def _signals(known: tuple[str, ...], signals: Mapping[str, Any], text: str) -> tuple[str, ...]:
    chosen = tuple(part.strip() for part in text.split(","))
    for one in chosen:
        if one not in known:
            raise ValueError(f'there is no signal "{one}"; there are {", ".join(known)}')
    if len({one[: q.LONGEST_NAME] for one in chosen}) < len(chosen):
        raise ValueError(f'"{text}" has a signal twice')
    if not _come_together(signals, chosen):
        paged = sorted(one for one in chosen if signals[one].multiplexer_ids)
        raise ValueError(f"{', '.join(paged)} are on different pages: name those of one page")
    return chosen
