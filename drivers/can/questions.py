"""What ``daqsvc new`` asks about CAN: frames packed with samples, described by a DBC file, or simulated."""

from __future__ import annotations

import tempfile
from abc import abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from daqsvc.rounding import counted
from drivers import packed_questions as packed
from drivers import questions as q
from drivers.bus_questions import BUS, BusQuestions, Heard, seconds_of
from drivers.can.sniff import CanSniffer
from drivers.questions import Answers, Question, Topic
from drivers.sniffing import (
    NothingFoundError,
    SniffError,
    sniffed,
    span,
    usual_rate,
)
from drivers.toml_lines import Hexadecimal, entry

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence


_SOCKETCAN = "socketcan"
_RATES_HZ = (2560.0, 1280.0, 640.0, 100.0, 10.0)
_MOST_FRAMES_HZ = 500.0
"""Of a default: a CAN bus of 500 kbit/s has time for some 4000 short frames a second."""
_LAST_SHORT_ID = 0x7FF
"""Of 11 bits; a higher id has 29."""
_LISTEN_S = 5.0
SHOWN = 8


def _interface(text: str) -> str:
    """An interface that python-can, or a plugin of it, knows."""
    if text == _SOCKETCAN:
        return text
    from can.interfaces import BACKENDS  # noqa: PLC0415 - slow to import

    from daqsvc.settings.problems import choice  # noqa: PLC0415 - brings the settings

    if q.line(text) not in BACKENDS:
        remedy = f"{choice(text, BACKENDS)}; or install the python-can plugin that brings it"
        raise ValueError(f'"{text}" is no interface that python-can knows. Remedy: {remedy}')
    return text


class CanQuestions(BusQuestions):
    """What all CAN buses have."""

    topics: ClassVar[Mapping[str, Topic]] = {
        "interface": Topic(
            "Kind of CAN adapter",
            "socketcan for adapters that Linux shows as can0; or another interface of python-can, e.g. pcan.",
        ),
        "channel": Topic(
            "Which CAN interface?",
            "The name that `ip link` shows, e.g. can0; with other adapters their channel.",
        ),
        "fd": Topic(
            "Are CAN FD frames on the bus?",
            "CAN FD frames carry up to 64 bytes. The device's manual states it.",
        ),
        "bitrate": Topic(
            "Bit rate of the bus, in bit/s", "As all devices on it are set: often 250000 or 500000."
        ),
        "data-bitrate": Topic("Bit rate of the data of CAN FD frames, in bit/s", "As all devices are set."),
    }

    listens_behind = "channel"

    def listen(
        self, answers: Answers, folder: Path, stop: threading.Event, tell: Callable[[str], None]
    ) -> Heard:
        """See `BusQuestions.listen`."""
        words = ["--interface", answers["interface"], *seconds_of(answers)]
        if "dbc" in answers:
            words += ["--dbc", f"{folder / answers['dbc']}"]
        line = ["--", answers["channel"]]
        try:
            # An interface of the kernel takes CAN FD frames anyway.
            fd = ["--fd"] if answers["interface"] != "socketcan" else []
            found = sniffed(CanSniffer(_LISTEN_S), [*words, *fd, *line], stop, tell)
        except NothingFoundError:
            raise
        except SniffError:
            if answers["interface"] == "socketcan":
                raise
            found = sniffed(CanSniffer(_LISTEN_S), [*words, *line], stop, tell)
        return Heard(
            list(_in_words(found)),
            lambda so_far: self._proposals(found, so_far),
            self.missed(found, answers),
            lambda so_far: self.unheard(found, so_far),
            lambda so_far, assumed: self.notes(found, so_far, assumed),
            lambda so_far: self.not_read(found, so_far),
            lambda so_far: self.not_offered(found, so_far),
            lambda so_far, assumed: self.unknown(found, so_far, assumed),
            self.guesses,
        )

    def _proposals(self, found: Mapping[str, Any], answers: Answers) -> dict[str, str]:
        fd = any(one["fd"] for one in found["ids"])
        proposed = {"fd": "yes" if fd else "no", **self.proposals(found, answers)}
        rates = {"bitrate": found["bitrate"], "data-bitrate": found["data_bitrate"]}
        return proposed | {key: f"{rate}" for key, rate in rates.items() if rate is not None}

    @abstractmethod
    def proposals(self, found: Mapping[str, Any], answers: Answers) -> dict[str, str]:
        """Those that are about frames; see `Heard.proposals`."""

    def missed(self, found: Mapping[str, Any], answers: Answers) -> str:
        """See `Heard.missed`."""
        del found, answers
        return ""

    @abstractmethod
    def unheard(self, found: Mapping[str, Any], answers: Answers) -> str:
        """See `Heard.unheard`."""

    def notes(self, found: Mapping[str, Any], answers: Answers, assumed: Collection[str]) -> Sequence[str]:
        """See `Heard.notes`."""
        del found, answers, assumed
        return ()

    def not_offered(self, found: Mapping[str, Any], answers: Answers) -> Mapping[str, Collection[str]]:
        """See `Heard.not_offered`."""
        del found, answers
        return {}

    def unknown(self, found: Mapping[str, Any], answers: Answers, assumed: Collection[str]) -> str:
        """See `Heard.unknown`."""
        del found, answers, assumed
        return ""

    def guesses(self, answers: Answers, taken: Collection[str]) -> Sequence[str]:
        """See `Heard.guesses`."""
        del answers, taken
        return ()

    def not_read(self, found: Mapping[str, Any], answers: Answers) -> str:
        """See `Heard.not_read`."""
        del found, answers
        return ""

    def _interface(self) -> Iterator[Question]:
        yield self.ask("interface", _interface, _SOCKETCAN, quiet=True)
        yield self.ask("channel", q.line, "can0")

    def _bit_rates(self, answers: Answers, *, fd: bool) -> Iterator[Question]:
        yield self.ask("bitrate", q.bit_rate, "500000")
        if fd:
            yield self.ask("data-bitrate", q.bit_rate, f"{max(2_000_000, answers['bitrate'])}")

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
        yield entry("bitrate", rate, "bit/s; daqsvc check computes from it if the bus has time enough")
        if answers["fd"]:
            yield entry("data_bitrate", answers["data-bitrate"], "bit/s of the data of CAN FD frames")
        yield ""


class PackedQuestions(CanQuestions):
    """Samples side by side in CAN frames."""

    about = "CAN or CAN FD, samples packed side by side in a frame"
    topics: ClassVar[Mapping[str, Topic]] = {
        **CanQuestions.topics,
        "id": Topic("CAN id of the frames", "Decimal, or hexadecimal with 0x. candump shows ids."),
        "length": Topic("Bytes of a frame", "candump shows them, and daqsvc sniff can."),
        **packed.TOPICS,
    }

    def questions(self, answers: Answers, folder: Path) -> Iterator[Question]:
        """See `BusQuestions.questions`."""
        del folder
        yield from self._interface()
        yield self.yes("fd", default=True)
        yield from self._bit_rates(answers, fd=answers["fd"])
        yield from self._frame(answers)

    def _frame(self, answers: Answers, **more: Any) -> Iterator[Question]:
        yield self.ask("id", q.whole, "0x101", **more)
        yield from packed.sample_questions(self, answers, 64 if answers["fd"] else 8, **more)
        yield self.ask("length", q.whole, f"{self._length(answers)}", quiet=True)

    def _length(self, answers: Answers) -> int:
        """The shortest frame that holds counter and samples; one that does not exist if none does."""
        from drivers.can.settings import CAN_FD_LENGTHS  # noqa: PLC0415 - brings the settings

        needed = packed.end_byte(answers)
        return next((length for length in CAN_FD_LENGTHS if length >= needed), needed)

    def rate_hz(self, answers: Answers) -> float:
        """See `BusQuestions.rate_hz`."""
        most = _MOST_FRAMES_HZ * answers["samples-per-frame"]
        return next((rate for rate in _RATES_HZ if rate <= most), _RATES_HZ[-1])

    def guess(self, answers: Answers, channel: str) -> tuple[str, str | None]:
        """See `BusQuestions.guess`."""
        return packed.guess(answers, channel)

    def in_volts(self, answers: Answers, channel: str) -> bool:
        """See `BusQuestions.in_volts`."""
        del channel
        return packed.in_volts(answers)

    def proposals(self, found: Mapping[str, Any], answers: Answers) -> dict[str, str]:
        """See `Heard.proposals`."""
        ids = [
            one
            for one in found["ids"]
            if one["rate_hz"] and not one["remote"] and one["extended"] == (one["id"] > _LAST_SHORT_ID)
        ]
        if not ids:
            return {}
        best = max(ids, key=lambda one: (one["counter"] is not None, one["rate_hz"]))
        proposed = {"id": f"{best['id']:#x}"}
        chosen = next((one for one in ids if one["id"] == answers.get("id", best["id"])), None)
        if chosen is None:
            return proposed
        length = max(chosen["lengths"])
        proposed |= packed.frame_proposals(length, chosen["counter"], answers) | {"length": f"{length}"}
        if "samples-per-frame" in answers:
            proposed["rate"] = f"{usual_rate(chosen['rate_hz'] * answers['samples-per-frame']):g}"
        return proposed

    def unheard(self, found: Mapping[str, Any], answers: Answers) -> str:
        """See `Heard.unheard`."""
        heard = [one["id"] for one in found["ids"]]
        if answers.get("id", heard[0]) in heard:
            return ""
        others = ", ".join(f"{one:#x}" for one in heard[:SHOWN])
        return f"{answers['id']:#x} was not heard. Remedy: correct --id; those that come: {others}"

    def notes(self, found: Mapping[str, Any], answers: Answers, assumed: Collection[str]) -> Sequence[str]:
        """See `Heard.notes`: of the layout, what is neither heard nor answered."""
        if _OF_BYTES.intersection(assumed):
            return ()  # all of it is an example then
        guessed = _PLACES.keys() & set(assumed) - self.proposals(found, answers).keys()
        if packed.RAW_BYTES[answers["raw-type"]] == 1:
            guessed -= {"byte-order"}
        places = [_PLACES[key].format(answers[key]) for key in _PLACES if key in guessed]
        if sensors := [one for one in self.channels(answers) if q.sensor_key(one, "type") in assumed]:
            places.append(f"which sensors are on {', '.join(sensors[:SHOWN])} (--sensor {sensors[0]}.type=)")
        return (
            (f"Neither heard nor answered: {'; '.join(places)}. See the device's manual.",) if places else ()
        )

    def guesses(self, answers: Answers, taken: Collection[str]) -> Sequence[str]:
        """See `Heard.guesses`: a frame shows its bytes, and not what they mean."""
        if "channels" not in taken:
            return ()
        return (f"The bytes of {answers['id']:#x} are not known: these channels are an example.",)

    def unknown(self, found: Mapping[str, Any], answers: Answers, assumed: Collection[str]) -> str:
        """See `Heard.unknown`."""
        del answers
        if not _OF_BYTES.intersection(assumed):
            return ""
        heard = [line.strip() for line in _of_ids(found)]
        more = len(found["ids"]) - len(heard)
        return (
            f"no frame states which of its bytes are which value. Heard: {'; '.join(heard)}"
            f"{f'; and {more} more' if more else ''}. Remedy: give the DBC file of the device, with --bus "
            "can-dbc --dbc; or give --channels, --raw-type and --scale as its manual states them, or answer "
            "the questions in a terminal, without --yes; daqsvc sniff can shows the frames"
        )

    def example(self, answers: Answers, assumed: Collection[str]) -> str:
        """See `BusQuestions.example`."""
        if not {"id", *_OF_BYTES}.intersection(assumed):
            return ""
        return (
            f"The frames are an example: nothing was heard, and nobody has stated what the bytes of "
            f"{answers['id']:#x} mean. Before the first run correct [streams.device.layout] by the device's "
            "manual; if there is a DBC file of the device, use daqsvc new --bus can-dbc."
        )

    def tables(self, answers: Answers) -> Iterator[str]:
        """See `BusQuestions.tables`."""
        yield from self._bus(answers)
        yield from self.stream(answers)
        yield entry("id", Hexadecimal(answers["id"]), "CAN id of the frames; candump shows those on the bus")
        if answers["id"] > _LAST_SHORT_ID:
            yield entry("extended", value=True, comment="an id of 29 bits")
        yield entry("length", answers["length"], "bytes of a frame")
        yield from packed.layout_lines(answers)


_OF_BYTES = frozenset({"channels", "raw-type", "scale"})
"""Questions that say what the bytes of a frame mean, which no frame shows."""
_PLACES = {
    "first-byte": "the byte where samples begin, {} (--first-byte)",
    "byte-order": "the byte order, {} (--byte-order)",
    "samples-per-frame": "how many samples of a channel a frame has, {} (--samples-per-frame)",
}
"""Questions that say where samples lie; their defaults are the usual ones."""


class VirtualQuestions(PackedQuestions):
    """A bus between processes, with a simulated machine on it."""

    about = "a virtual bus with a simulated machine: to try daqsvc, no hardware needed"
    topics: ClassVar[Mapping[str, Topic]] = {
        "socket": Topic("Path of the virtual bus", "A socket file that daqsvc run and daqsvc sim share."),
        **PackedQuestions.topics,
    }
    simulated = True
    listens_behind = ""

    def questions(self, answers: Answers, folder: Path) -> Iterator[Question]:
        """See `BusQuestions.questions`."""
        del folder
        yield self.ask("socket", q.line, f"{Path(tempfile.gettempdir()) / 'daqsvc-can0'}", quiet=True)
        answers["fd"] = True
        yield from self._frame(answers, quiet=True)

    def rate_hz(self, answers: Answers) -> float:
        """See `BusQuestions.rate_hz`: 64 samples a revolution."""
        per_second: float = 64.0 * abs(answers["speed"]) / 60.0
        return min(max(round(per_second), 640), 12_800)

    def example(self, answers: Answers, assumed: Collection[str]) -> str:
        """See `BusQuestions.example`: the simulated device sends what the file states."""
        del answers, assumed
        return ""

    def beside(self, file: str) -> tuple[str, str]:
        """See `BusQuestions.beside`."""
        return f"daqsvc sim {file}", "in a second terminal: plays the machine, which gets worse and worse"

    def _bus(self, answers: Answers) -> Iterator[str]:
        yield "# No hardware: `daqsvc sim` plays the devices. For a real bus, daqsvc new asks for it."
        yield f"[buses.{BUS}]"
        yield entry("driver", "can")
        yield entry("interface", "unixbus", "a CAN bus between programs of this computer")
        yield entry("channel", answers["socket"], "path of its socket")
        yield entry("fd", value=True)
        yield ""


def decoded_signals(found: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Messages of the DBC file whose signals were heard."""
    return [one for one in found["dbc"]["messages"] if one["signals"]]


def values_heard(signals: Sequence[Mapping[str, Any]]) -> str:
    """The values of some signals as they were heard."""
    shown = [
        f"{one['signal']} {span(one['min'], one['max'])}{f' {unit}' if (unit := one['unit']) else ''}"
        for one in signals[:SHOWN]
    ]
    return "; ".join(shown) + (f"; and {len(signals) - SHOWN} more" if len(signals) > SHOWN else "")


def _in_words(found: Mapping[str, Any]) -> Iterator[str]:
    """What was heard, in a few lines: the ids that come most often."""
    ids = sorted(found["ids"], key=lambda one: -(one["rate_hz"] or 0.0))
    yield f"{counted(found['frames'], 'frame')} of {counted(len(ids), 'id')}:"
    yield from _of_ids(found, values=True)
    if len(ids) > SHOWN:
        yield f"  ... and {len(ids) - SHOWN} more: daqsvc sniff can shows them"


def _of_ids(found: Mapping[str, Any], *, values: bool = False) -> Iterator[str]:
    """The ids that come most often: how long their frames are, how often they come, with which values."""
    by_message = (
        {one["message"]: one["signals"] for one in decoded_signals(found)}
        if values and "dbc" in found
        else {}
    )
    ids = sorted(found["ids"], key=lambda one: -(one["rate_hz"] or 0.0))
    for one in ids[:SHOWN]:
        lengths = ", ".join(map(str, one["lengths"]))
        rate = "once" if one["rate_hz"] is None else f"{one['rate_hz']:.4g} a second"
        counter, message = one["counter"], one["message"]
        counts = f", byte {counter['byte']} counts" if counter else ""
        if message is None and "dbc" in found:
            message = "not in the DBC file"
        yield f"  {one['id']:#x}: {lengths} bytes, {rate}{counts}{f', {message}' if message else ''}"
        signals = by_message.pop(message, [])
        if signals:
            yield f"    {values_heard(signals)}"
        yield from (f"    {signal['doubt']}" for signal in signals if signal["doubt"])
