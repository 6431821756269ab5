"""What ``daqsvc new`` asks about CAN: frames packed with samples, described by a DBC file, or simulated."""

from __future__ import annotations

import tempfile
from abc import abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from drivers import packed_questions as packed
from drivers import questions as q
from drivers.bus_questions import BusQuestions, seconds_of
from drivers.can.heard import LAST_SHORT_ID, OF_BYTES, HeardFrames
from drivers.can.sniff import CanSniffer
from drivers.names import BUS, CAN, bus_name
from drivers.questions import Answers, Question, Topic
from drivers.sniffing import NothingFoundError, SniffError, sniffed
from drivers.toml_lines import Hexadecimal, entry

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Collection, Iterator, Mapping

    from drivers.can.heard import HeardOnCan


_SOCKETCAN = "socketcan"
_RATES_HZ = (2560.0, 1280.0, 640.0, 100.0, 10.0)
_MOST_FRAMES_HZ = 500.0
"""Of a default: a CAN bus of 500 kbit/s has time for some 4000 short frames a second."""
_LISTEN_S = 5.0


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
    ) -> HeardOnCan:
        """See `BusQuestions.listen`."""
        words = ["--interface", answers["interface"], *seconds_of(answers)]
        if "dbc" in answers:
            words += ["--dbc", f"{folder / answers['dbc']}"]
        line = ["--", answers["channel"]]
        try:
            # An interface of the kernel takes CAN FD frames anyway.
            fd = ["--fd"] if answers["interface"] != "socketcan" else []
            figures = sniffed(CanSniffer(_LISTEN_S), [*words, *fd, *line], stop, tell)
        except NothingFoundError:
            raise
        except SniffError:
            if answers["interface"] == "socketcan":
                raise
            figures = sniffed(CanSniffer(_LISTEN_S), [*words, *line], stop, tell)
        return self.heard(figures, answers)

    @abstractmethod
    def heard(self, figures: Mapping[str, Any], answers: Answers) -> HeardOnCan:
        """What the frames that were heard show of the answers behind `listens_behind`.

        Args:
            figures: figures of `CanSniffer`.
            answers: those before.
        """

    def bus_name(self, answers: Answers) -> str:
        """See `BusQuestions.bus_name`."""
        return bus_name(answers["channel"], CAN)

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
        yield f"[buses.{self.bus_name(answers)}]"
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

    def heard(self, figures: Mapping[str, Any], answers: Answers) -> HeardOnCan:
        """See `CanQuestions.heard`."""
        del answers
        return HeardFrames(figures, self.channels)

    def example(self, answers: Answers, assumed: Collection[str]) -> str:
        """See `BusQuestions.example`."""
        if not {"id", *OF_BYTES}.intersection(assumed):
            return ""
        layout = f"[streams.{self.stream_name(answers)}.layout]"
        return (
            f"The frames are an example: nothing was heard, and nobody has stated what the bytes of "
            f"{answers['id']:#x} mean. Before the first run correct {layout} by the device's "
            "manual; if there is a DBC file of the device, use daqsvc new --bus can-dbc."
        )

    def tables(self, answers: Answers) -> Iterator[str]:
        """See `BusQuestions.tables`."""
        yield from self._bus(answers)
        yield from self.stream(answers)
        yield entry("id", Hexadecimal(answers["id"]), "CAN id of the frames; candump shows those on the bus")
        if answers["id"] > LAST_SHORT_ID:
            yield entry("extended", value=True, comment="an id of 29 bits")
        yield entry("length", answers["length"], "bytes of a frame")
        yield from packed.layout_lines(answers)


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

    def bus_name(self, answers: Answers) -> str:
        """See `BusQuestions.bus_name`."""
        del answers
        return BUS

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
