"""The lines of a new machine file that nobody has stated: each has a comment that it is assumed."""

from __future__ import annotations

import re
import tomllib
from typing import TYPE_CHECKING

from daqsvc.commands.new.buses import bus_of
from drivers.questions import Answers, sensor_key
from drivers.toml_lines import behind

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

ASSUMED = "assumed"
"""Key, beside the answers, of the keys of those that nobody has given and nothing has shown."""
_KEY = re.compile(r"([a-z_]+) = ")
_CHANNEL = re.compile(r'\s+\{ name = "([^"]*)"')
_OTHER = {
    "rate_hz": ("rate",),
    "line": ("columns",),
    "counter": ("counter", "counter-byte", "counter-bits", "counter-counts", "counts"),
    "time": ("counter", "counts"),
    "no_counter": ("counter", "counter-byte"),
    "count": ("count-address", "count-bits"),
    "address": ("block-address", "ring-address", "fifo-address"),
    "serial_port": ("port",),
}
"""Questions behind keys of buses and streams, where they are called otherwise."""
_PART_KEY = "{} of channels"
_ONLY_TYPE = 'type = "trend"'
"""The only type that slow values can have."""
_NEVER = {"interface", "timeout-ms", "tcp-port", "max-count", "length", "payload-length", "acknowledge"}
"""Questions whose defaults hardly any machine needs to be changed, or which follow from others."""
_OF_SENSOR = {
    "type": "type",
    "unit": "unit",
    "sensitivity_mv_per_unit": "sensitivity",
    "angle_deg": "angle",
    "threshold_v": "threshold",
}
_OF_CHANNELS = {
    "channels": "name",
    "signals": "signals",
    "consecutive": "signals",
    "raw-type": "type",
    "scale": "scale",
}
"""What of the line of a channel is in the answers to questions about all channels."""
_OF_CHANNEL = {
    "address": "address",
    "register-type": "type",
    "order": "order",
    "scale": "scale",
    "bits": "bits",
    "prefix": "prefix",
    "suffix": "suffix",
}
"""The same of questions about one channel."""
_MAIN = {"name", "signals", "address", "type", "scale"}
"""What is named as assumed one by one, if somebody has stated another of them."""


def marked(lines: Iterable[str], answers: Answers) -> tuple[list[str], list[str]]:
    """The lines of the tables with these comments, and the keys in them.

    Args:
        lines: of all tables.
        answers: to all questions, with those at `ASSUMED`.
    """
    assumed: Collection[str] = answers.get(ASSUMED, ())
    marked_lines = [*lines]
    keys: dict[str, None] = {}
    if not assumed:
        return marked_lines, []
    bus, table, channel = bus_of(answers), "", ""
    stream = f"streams.{bus.stream_name(answers)}"
    tables = {f"buses.{bus.bus_name(answers)}", stream, f"{stream}.layout"}
    for place, line in enumerate(marked_lines):
        if line.startswith("["):
            table = line.partition("#")[0].strip().strip("[]")
            rest = (one for one in marked_lines[place:] if one.startswith("channel = "))
            channel = tomllib.loads(next(rest, 'channel = ""'))["channel"] if table == "sensors" else ""
            continue
        if (name := _CHANNEL.match(line)) is not None and table.startswith("streams."):
            if parts := _parts(name[1], answers):
                is_all = parts == ["channels"]
                marked_lines[place] = _with_comment(line, "" if is_all else f": {', '.join(parts)}")
                keys |= dict.fromkeys(parts if is_all else map(_PART_KEY.format, parts))
            continue
        if (begin := _KEY.match(line)) is not None:
            key = begin[1]
            one = _questions(table, key, channel, tables)
        else:
            continue
        if line.endswith("[") or line == _ONLY_TYPE:
            continue
        if not _NEVER.issuperset(one) and any(each in assumed for each in one):
            marked_lines[place] = _with_comment(line)
            keys[key] = None
    return marked_lines, [*keys]


def _questions(table: str, key: str, channel: str, tables: Collection[str]) -> list[str]:
    """The questions whose answers are in a line; ``tables`` are those of the bus and of the stream."""
    if table == "machine":
        return ["speed"] if key == "speed_rpm" else []
    if table in tables:
        return [key.replace("_", "-"), *_OTHER.get(key, ())]
    if table == "sensors":
        return [sensor_key(channel, _OF_SENSOR[key])] if key in _OF_SENSOR else []
    return (
        [{"zones": "class"}.get(key, key)]
        if table == "alarms" and key in {"zones", "alert", "danger"}
        else []
    )


def _parts(channel: str, answers: Answers) -> list[str]:
    """What of the line of a channel is assumed: ``channels`` if nobody has stated any of it."""
    questions = {**_OF_CHANNELS, **{sensor_key(channel, topic): part for topic, part in _OF_CHANNEL.items()}}
    parts = dict.fromkeys(part for key, part in questions.items() if key in answers)
    assumed = {part for key, part in questions.items() if key in answers[ASSUMED]}
    stated = _MAIN.intersection(parts) - assumed
    return [part for part in parts if part in assumed] if stated else ["channels"] * bool(assumed)


def _with_comment(line: str, of_it: str = "") -> str:
    """The line with the comment; ``of_it`` states what of it is assumed, if not all is."""
    text, mark, comment = line.rpartition("  # ")
    if not mark:
        return behind(line, f"assumed{of_it}")
    return f"{text}{mark}assumed{of_it}; {comment}"
