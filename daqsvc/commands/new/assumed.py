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
_OF_REGISTER = ("address", "register-type", "order", "scale", "bits", "prefix", "suffix")


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
            of_channels = ("channels", "raw-type", "scale", "signals")
            one = [*of_channels, *(sensor_key(name[1], topic) for topic in _OF_REGISTER)]
            key = "channels"
        elif (begin := _KEY.match(line)) is not None:
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


def _with_comment(line: str) -> str:
    text, mark, comment = line.rpartition("  # ")
    if not mark:
        return behind(line, "assumed")
    return f"{text}{mark}assumed; {comment}"
