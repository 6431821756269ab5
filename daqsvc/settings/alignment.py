"""Samples that a detector takes from several streams: on one grid, as well as their clocks are known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from daqsvc.settings.section import Section, WaitMs

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.settings.buses import Stream
    from daqsvc.settings.sensors import Sensor


class Alignment(Section):
    """Lets a rotor detector take its sensors from several streams, with clocks of their own."""

    max_error_us: Annotated[float, Field(ge=0.01, le=1_000_000)] = Field(
        default=200.0, description="samples that may be further off the reference's are left out"
    )
    max_wait_ms: WaitMs = Field(
        default=1000.0, description="how long after all others a stream may come before the rest goes on"
    )


@dataclass(frozen=True, slots=True)
class Grid:
    """Where a detector finds its samples: in one stream, or in several on the grid of the first one.

    Attributes:
        streams: by name, the one whose samples are the grid first.
    """

    streams: Mapping[str, Stream]

    @property
    def name(self) -> str:
        """Name of the stream, or of the grid: its streams joined by ``+``, which no stream's name has."""
        return "+".join(self.streams)

    @property
    def aligned(self) -> bool:
        """Whether several streams must be put on one grid."""
        return len(self.streams) > 1

    @property
    def rate_hz(self) -> float:
        """Samples per second."""
        return next(iter(self.streams.values())).rate_hz

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the columns."""
        if not self.aligned:
            return next(iter(self.streams.values())).layout.channel_names
        return tuple(
            f"{name}.{channel}" for name, s in self.streams.items() for channel in s.layout.channel_names
        )

    def column(self, sensor: Sensor) -> int:
        """Where a sensor stands among the columns."""
        names = list(self.streams)
        before = names[: names.index(sensor.stream)]
        own = self.streams[sensor.stream].layout.channel_names.index(sensor.channel)
        return sum(len(self.streams[name].layout.channel_names) for name in before) + own
