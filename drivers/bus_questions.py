"""What a driver brings to ``daqsvc new``: questions about a bus of its kind, and the tables made of them.

Those of this tree are named in `daqsvc.commands.new.buses`; a separate package registers one by entry point
in the group ``daqsvc.questions``, under the word that ``--bus`` takes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from drivers import questions as q
from drivers.names import BUS, STREAM
from drivers.questions import NONE, Answers, Question, Topic, sensor_key
from drivers.sniffing import by_name, is_waveform_rate, plain_name
from drivers.toml_lines import entry

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

BEFOREHAND = "beforehand"
"""Key, beside the answers that `BusQuestions.listen` gets, of those that were given beforehand."""
_BY_ID = Path("/dev/serial/by-id")

SHARED = {
    "channels": Topic(
        "What are the channels called?",
        "Names with commas between, in the order in which the device sends them: x, y, kph",
    ),
    "raw-type": Topic("Type of a sample in the frame", "The device's manual states it."),
    "scale": Topic(
        "What is one count of a sample worth?",
        "In volts if the device digitises a sensor, else in the unit of the sensor. See the device's manual.",
    ),
    "port": Topic(
        "Which serial port?",
        "Best the path below /dev/serial/by-id, which stays the same: ls -l /dev/serial/by-id shows it.",
    ),
    "baud": Topic("Baud rate, in bit/s", "As the device is set; its manual states it."),
    "counter": Topic(
        "Which signal or column counts the frames or lines, or tells the time?",
        "By it lost samples are found. none if there is none: losses are then estimated from the times of "
        "arrival. Binary frames of a serial port need one.",
    ),
}
"""What is asked about buses of several kinds."""


class Heard(ABC):
    """What was found on a bus; a driver overrides what it knows of it.

    In all methods ``answers`` are those so far. ``taken`` are the keys of those that are nothing but a
    default, be it proposed or not; ``assumed`` are the keys of those of them that were not proposed.

    Attributes:
        lines: what it is, for a person; a few lines.
        missed: what is looked for and was not there, so that an answer before may have to be corrected, with
            its remedy; empty if all was there. Without a person, ``daqsvc new`` then writes nothing.
    """

    def __init__(self, lines: Sequence[str], missed: str = "") -> None:
        self.lines, self.missed = lines, missed

    @abstractmethod
    def proposals(self, answers: Answers) -> Mapping[str, str]:
        """Answers by the key of their question, as they would be typed, that fit the answers so far.

        One that cannot be used is not offered. A default that is not among them was not heard: its line is
        marked as assumed, unless it was typed.
        """

    def beside(self, answers: Answers) -> Mapping[str, str]:
        """By the key of a question, what was heard of its proposal, for a person to judge it."""
        del answers
        return {}

    def not_offered(self, answers: Answers) -> Mapping[str, Collection[str]]:
        """Choices, by the key of their question, that what was heard shows to be wrong."""
        del answers
        return {}

    def unheard(self, answers: Answers) -> str:
        """What the answers state and was not heard, with its remedy; empty if it may have been.

        Without a person, ``daqsvc new`` then writes nothing.
        """
        del answers
        return ""

    def unknown(self, answers: Answers, assumed: Collection[str]) -> str:
        """What must be answered because nothing that was heard shows it, with its remedy.

        Empty if all is known. Without a person, ``daqsvc new`` then writes nothing.
        """
        del answers, assumed
        return ""

    def notes(self, answers: Answers, assumed: Collection[str], taken: Collection[str]) -> Iterable[str]:
        """Sentences for the file, of all answers: what was heard of it, and what of it is a guess."""
        del answers, assumed, taken
        return ()

    def not_read(self, answers: Answers) -> Iterable[str]:
        """Sentences for the file, of all answers: what was heard and is not in it."""
        del answers
        return ()


class BusQuestions(ABC):
    """A kind of bus for ``daqsvc new``; importing its module must be cheap.

    Attributes:
        about: what it is, beside its word in the list of buses.
        topics: what is asked about it beyond `SHARED`, by the key of the question, which is an option of
            ``daqsvc new``, too.
        channel_topics: what is asked about one channel; ``{channel}`` is filled in.
        listens_behind: key of the question behind which it is known where the device is, so that `listen` can
            look at it; empty if nothing can.
        for_listening: keys of questions that only `listen` uses; without it they are neither asked nor given.
        narrowed_by: keys of questions that only `listen` uses, each with that of a later question: an answer
            to it that was given beforehand is all that is looked for.
        simulated: whether ``daqsvc sim`` plays the device, so that most defaults need no question.
    """

    about: ClassVar[str]
    topics: ClassVar[Mapping[str, Topic]] = {}
    channel_topics: ClassVar[Mapping[str, Topic]] = {}
    listens_behind: ClassVar[str] = ""
    for_listening: ClassVar[Sequence[str]] = ()
    narrowed_by: ClassVar[Mapping[str, str]] = {}
    simulated: ClassVar[bool] = False

    @abstractmethod
    def questions(self, answers: Answers, folder: Path) -> Iterator[Question]:
        """What is asked before the speed: where the device is and how its samples lie.

        Args:
            answers: those before; whoever takes a question puts its answer there before the next one.
            folder: of the machine file, where relative paths start.
        """

    @abstractmethod
    def tables(self, answers: Answers) -> Iterator[str]:
        """Lines of ``[buses]`` and ``[streams]``."""

    @abstractmethod
    def rate_hz(self, answers: Answers) -> float:
        """The sampling rate unless something else is answered."""

    def listen(
        self, answers: Answers, folder: Path, stop: threading.Event, tell: Callable[[str], None]
    ) -> Heard:
        """Look at the bus, for ``daqsvc new --listen``. Nothing is changed there.

        Args:
            answers: as far as `listens_behind`; ``seconds`` is the time to listen, and None or not there if
                that is up to the driver. `BEFOREHAND` has the texts of all answers that were given
                beforehand, also of later questions.
            folder: of the machine file, where relative paths start.
            stop: set when the person has waited enough; look at it every 0.2 s or so.
            tell: states one line while it goes on.

        Raises:
            SniffError: nothing was found; states what to do.
        """
        raise NotImplementedError

    def example(self, answers: Answers, assumed: Collection[str]) -> str:
        """A sentence for the file on what is an example, where nobody has listened; empty if nothing is.

        Args:
            answers: all of them.
            assumed: keys of those that are nothing but a default.
        """
        del answers, assumed
        return ""

    def origin(self, answers: Answers) -> str:
        """Where the channels come from if none of them was heard."""
        del answers
        return "an example"

    def stated(self, answers: Answers) -> Collection[str]:
        """Keys of questions whose defaults the device or a file of it states."""
        del answers
        return ()

    def channels(self, answers: Answers) -> tuple[str, ...]:
        """Names of the channels."""
        named: tuple[str, ...] = answers["channels"]
        return named

    def bus_name(self, answers: Answers) -> str:
        """What the only bus of the file is called; `drivers.names` has what ``daqsvc sniff`` calls it."""
        del answers
        return BUS

    def stream_name(self, answers: Answers) -> str:
        """What the only stream of the file is called."""
        del answers
        return STREAM

    def of_channel(self, answers: Answers, channel: str) -> Iterator[Question]:
        """What is asked about a channel before its sensor."""
        del answers, channel
        yield from ()

    def sensor_types(self, answers: Answers) -> tuple[str, ...]:
        """Types of sensors that the samples can be of."""
        del answers
        return ("proximity", "accelerometer", "velocity", "keyphasor", "trend", NONE)

    def guess(self, answers: Answers, channel: str) -> tuple[str, str | None]:
        """Type and, where it is known, unit of the sensor on a channel."""
        waveform = is_waveform_rate(answers["rate"])
        return by_name(channel) or ("accelerometer" if waveform else "trend"), unit_by_name(channel)

    def measuring_range(self, answers: Answers, channel: str) -> tuple[float, float] | None:
        """Least and greatest value that a file of the device states for a channel; None if none does."""
        del answers, channel
        return None

    def in_volts(self, answers: Answers, channel: str) -> bool:
        """Whether the samples of the sensor on a channel are volts, as a rule."""
        del answers, channel
        return False

    def beside(self, file: str) -> tuple[str, str]:
        """What to type beside the service, and what that does."""
        return f"daqsvc status {file}", "in a second terminal: values, losses, alarms"

    def ask(self, key: str, read: Callable[[str], Any], default: str | None = None, **more: Any) -> Question:
        """A question about one of its topics."""
        return Question(key, self._topic(key), read, default, **more)

    def choose(self, key: str, choices: Mapping[str, str], default: str | None, **more: Any) -> Question:
        """A question that is answered by one of some words."""
        return self.ask(key, q.one_of(choices), default, choices=choices, **more)

    def yes(self, key: str, *, default: bool) -> Question:
        """A question that is answered by yes or no."""
        return self.ask(key, q.yes_no, "yes" if default else "no", choices=q.YES_NO)

    def ask_of(
        self, channel: str, topic: str, read: Callable[[str], Any], default: str, **more: Any
    ) -> Question:
        """A question about a channel."""
        words = self.channel_topics[topic]
        filled = Topic(words.text.format(channel=channel), words.help)
        return Question(sensor_key(channel, topic), filled, read, default, **more)

    def stream(self, answers: Answers, comment: str = "samples a second of each channel") -> Iterator[str]:
        """Lines of ``[streams]``, up to the keys of the layout."""
        name = self.stream_name(answers)
        yield f"[streams.{name}]"
        yield entry("bus", self.bus_name(answers))
        yield entry("rate_hz", answers["rate"], comment)
        yield ""
        yield f"[streams.{name}.layout]"

    def _topic(self, key: str) -> Topic:
        return self.topics[key] if key in self.topics else SHARED[key]


_UNIT_OF = {
    "temp": "degC",
    "speed": "rpm",
    "rpm": "rpm",
    "drehz": "rpm",
    "curr": "A",
    "motorstrom": "A",
    "volt": "V",
    "spannung": "V",
    "press": "bar",
    "druck": "bar",
    "schwingweg": "um",
    "beschl": "g",
    "vib": "mm/s",
    "veloc": "mm/s",
    "schwing": "mm/s",
}
"""Unit by what is in a name, in English or German; what comes first counts. Volumenstrom is no current."""


def unit_by_name(channel: str) -> str | None:
    """The unit that the name of a channel suggests; None if it suggests none."""
    low = plain_name(channel)
    return next((unit for word, unit in _UNIT_OF.items() if word in low), None)


def guessed_sensors(answers: Answers, channels: Sequence[str], taken: Collection[str]) -> list[str]:
    """Sentences on types and units of sensors that are a guess, by the rate or by the name of a channel.

    Args:
        answers: all of them.
        channels: those whose unit neither the device nor a file states.
        taken: see `Heard.guesses`.
    """
    by_rate, named = [], []
    for channel in channels:
        kind = answers.get(sensor_key(channel, "type"))
        unit = answers.get(sensor_key(channel, "unit"))
        if kind in {"accelerometer", "velocity"} and by_name(channel) is None:
            if sensor_key(channel, "type") in taken:
                by_rate.append(channel)
        elif unit and unit == unit_by_name(channel) and sensor_key(channel, "unit") in taken:
            named.append(f"{channel} ({unit})")
    rate = (
        f"{', '.join(by_rate)}: type and unit of the sensor are a guess by the rate; see the device's manual."
    )
    name = f"Units that are a guess by the names of channels: {', '.join(named)}. See the device's manual."
    return [rate] * bool(by_rate) + [name] * bool(named)


def seconds_of(answers: Answers) -> list[str]:
    """Arguments of a sniffer that state how long it listens, where that was answered."""
    seconds = answers.get("seconds")
    return [] if seconds is None else ["--seconds", f"{seconds:g}"]


def is_count(name: str) -> bool:
    """Whether the name of a signal or column suggests a counter."""
    words = ("seq", "count", "cnt", "ctr", "zaehl", "alive", "index")
    return any(part in plain_name(name) for part in words)


def only_port() -> str | None:
    """The serial port that was plugged in, if it is the only one."""
    ports = sorted(_BY_ID.glob("*"))
    return f"{ports[0]}" if len(ports) == 1 else None
