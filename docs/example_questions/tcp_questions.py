"""What ``daqsvc new`` asks about a data logger on TCP, and the tables that it writes."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from daqsvc.api import BusQuestions, Question, Topic, questions, toml_lines


class LoggerQuestions(BusQuestions):
    """A data logger, which has one stream."""

    about = "a data logger on TCP"
    topics: Mapping[str, Topic] = {
        "logger": Topic("Address of the logger", "An IP address or a host name; its display shows it."),
        "logger-port": Topic("TCP port of the logger", "4001, unless somebody has changed it."),
    }

    def questions(self, answers: dict[str, Any], folder: Path) -> Iterator[Question]:
        """Where the logger is, and what it sends."""
        del answers, folder
        yield self.ask("logger", questions.line)
        yield self.ask("logger-port", questions.whole, "4001", quiet=True)
        yield self.ask("channels", questions.names, "x, y")
        yield self.ask("scale", questions.number, "0.001")

    def rate_hz(self, answers: dict[str, Any]) -> float:
        """It leaves the factory with this rate."""
        del answers
        return 1000.0

    def tables(self, answers: dict[str, Any]) -> Iterator[str]:
        """The bus and its stream."""
        names = answers["channels"]
        yield "[buses.main]"
        yield toml_lines.entry("driver", "tcp-frames")
        yield toml_lines.entry("host", answers["logger"])
        yield toml_lines.entry("tcp_port", answers["logger-port"])
        yield ""
        yield from self.stream(answers)
        yield toml_lines.entry("frame_bytes", 4 + 60 * len(names), "counter, and 30 samples of each channel")
        yield 'counter = { byte = 0, bits = 32, counts = "samples" }'
        yield toml_lines.entry("first_byte", 4)
        yield toml_lines.entry("samples_per_frame", 30)
        channels = [{"name": name, "type": "int16", "scale": answers["scale"]} for name in names]
        yield from toml_lines.array("channels", channels)
