"""What others get to know about a machine: its streams, the machine file in force, files that it names."""

from __future__ import annotations

import contextlib
import json
import logging
from typing import TYPE_CHECKING, Any, TypedDict

from daqsvc.detectors.make import plugins
from daqsvc.errors.code import coded
from daqsvc.settings.hooks import PluginFailedError
from daqsvc.settings.models import MachineFile

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from daqsvc.settings.streams import Grid


log = logging.getLogger(__name__)

LONGEST_FILE = 16_000_000
"""Bytes of a file that goes along with a machine file."""
_TABLES = ("pipeline", "streams")
"""Whose values may be paths: calibrations of detectors, DBC files of layouts."""
_SUFFIXES = (".toml", ".dbc")


class StreamFacts(TypedDict):
    """What is known of a stream or a grid.

    Attributes:
        rate_hz: samples per second, by the machine file.
        channels: names of its channels.
        sensors: name of the sensor of each channel; empty for none.
        units: unit of each channel's sensor; empty for none.
    """

    rate_hz: float
    channels: list[str]
    sensors: list[str]
    units: list[str]


def machine_values(machine: MachineFile) -> dict[str, Any]:
    """What is in force of a machine file, as TOML would give it, but for outputs, store and recorder."""
    others = {key for key in type(machine).model_fields if key not in MachineFile.model_fields}
    values: dict[str, Any] = json.loads(
        machine.model_dump_json(
            serialize_as_any=True, exclude_unset=True, by_alias=True, exclude={*others, "store", "recorder"}
        )
    )
    return values


def with_paths(values: dict[str, Any], change: Callable[[str], str]) -> dict[str, Any]:
    """The values of a machine file with other paths of the files that it names.

    Args:
        values: see `machine_values`.
        change: makes of each path the other one.
    """
    return {key: _with_paths(one, change) if key in _TABLES else one for key, one in values.items()}


def _with_paths(value: Any, change: Callable[[str], str]) -> Any:
    if isinstance(value, dict):
        return {key: _with_paths(one, change) for key, one in value.items()}
    if isinstance(value, list):
        return [_with_paths(one, change) for one in value]
    is_path = isinstance(value, str) and value.lower().endswith(_SUFFIXES)
    return change(value) if is_path else value


def files_named(values: dict[str, Any], folder: Path) -> dict[str, bytes]:
    """By path as written the content of each file that a machine file names; blocks.

    Files that cannot be read, or have more than `LONGEST_FILE` bytes, are left out.

    Args:
        values: see `machine_values`.
        folder: where relative paths start.
    """
    files: dict[str, bytes] = {}

    def read(path: str) -> str:
        with contextlib.suppress(OSError):
            if (whole := folder / path).stat().st_size <= LONGEST_FILE:
                files[path] = whole.read_bytes()
        return path

    with_paths(values, read)
    return files


def fault_names(machine: MachineFile) -> dict[str, dict[str, str]]:
    """By detector and decision the fault that it means, of those whose decisions have their own names."""
    named: dict[str, dict[str, str]] = {}
    for plugin, settings in plugins(machine):
        try:
            by_detector = plugin.faults(machine, settings)
            named |= {str(detector): {**faults} for detector, faults in by_detector.items()}
        except PluginFailedError as failed:
            log.error(  # noqa: TRY400 - the message is enough
                "%s", failed.followed_by("; its decisions are shown as they are"), extra=coded(failed.code)
            )
    return named


def stream_facts(machine: MachineFile) -> Iterator[tuple[str, StreamFacts]]:
    """By stream and grid its rate, its channels, and the sensor and unit of each channel; "" for none."""
    sensors = {(one.stream, one.channel): one for one in machine.sensors}
    for name, stream in machine.streams.items():
        names = stream.layout.channel_names
        known = [sensors.get((name, channel)) for channel in names]
        yield (
            name,
            {
                "rate_hz": stream.rate_hz,
                "channels": list(names),
                "sensors": ["" if one is None else one.name for one in known],
                "units": ["" if one is None else one.unit for one in known],
            },
        )
    for grid in machine.grids:
        yield grid.name, _of_grid(grid)


def _of_grid(grid: Grid) -> StreamFacts:
    names = list(grid.channel_names)
    nothing = ["" for _ in names]
    return {"rate_hz": grid.rate_hz, "channels": names, "sensors": nothing, "units": nothing}
