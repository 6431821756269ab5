"""Whether streams, layouts and sensors fit each other, on any kind of bus."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from daqsvc.settings.problems import Finding, choice
from daqsvc.settings.section import UnusableValueError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.settings.buses import Layout
    from daqsvc.settings.models import MachineFile, Sensor, Stream
    from daqsvc.settings.problems import KeyPath


def check_channels(layout: Layout, at: KeyPath) -> Iterator[Finding]:
    """Channel names are unique."""
    yield from unique(list(layout.channel_names), (*at, layout.channels_key), "channel")


def check_stream_bus(draft: MachineFile, stream: Stream, at: KeyPath) -> Iterator[Finding]:
    """The stream's bus exists."""
    if stream.bus not in draft.buses:
        yield Finding((*at, "bus"), "there is no such bus", choice(stream.bus, draft.buses))


def check_sensor_channel(draft: MachineFile, sensor: Sensor, at: KeyPath) -> Iterator[Finding]:
    """The sensor's stream and channel exist."""
    if sensor.stream not in draft.streams:
        yield Finding((*at, "stream"), "there is no such stream", choice(sensor.stream, draft.streams))
        return
    channels = draft.streams[sensor.stream].layout.channel_names
    if sensor.channel not in channels:
        yield Finding(
            (*at, "channel"),
            f'stream "{sensor.stream}" has no such channel',
            choice(sensor.channel, channels),
        )


def check_channel_use(draft: MachineFile) -> Iterator[Finding]:
    """No channel is claimed by two sensors."""
    owners: dict[tuple[str, str], int] = {}
    for index, sensor in enumerate(draft.sensors):
        with suppress(UnusableValueError):
            owner = owners.setdefault((sensor.stream, sensor.channel), index)
            if owner != index:
                yield Finding(
                    ("sensors", index, "channel"),
                    f'channel "{sensor.channel}" of stream "{sensor.stream}" belongs to '
                    f'sensor "{draft.sensors[owner].name}" already',
                    "give each sensor a channel of its own",
                )


def unique(names: list[str], at: KeyPath, what: str) -> Iterator[Finding]:
    """Findings for every name that has been given before in the same array."""
    seen: dict[str, int] = {}
    for index, name in enumerate(names):
        if seen.setdefault(name, index) != index:
            yield Finding(
                (*at, index, "name"),
                f"is the name of an earlier {what} already",
                f"give each {what} a name of its own",
            )
