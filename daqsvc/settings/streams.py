"""Streams of samples, and the buses that they come over: the tables that drivers bring the models of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, TypeAlias

from pydantic import Field

from daqsvc.settings.buses import Bus, Layout
from daqsvc.settings.registry import BUSES, LAYOUTS
from daqsvc.settings.section import Name, Section

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.settings.sensors import Sensor

AnyBus: TypeAlias = Annotated[Bus, BUSES]
"""A table of ``[buses]``, of the kind that its driver brings."""
AnyLayout: TypeAlias = Annotated[Layout, LAYOUTS]
"""The layout of a stream, of the kind that its driver brings."""


class Stream(Section):
    """Samples that one device takes together and sends under one id."""

    bus: Annotated[Name, Field(description="the bus it comes over", examples=["can0"])]
    rate_hz: Annotated[
        float,
        Field(ge=1e-4, le=10_000_000, description="samples per second and channel", examples=[640.0]),
    ]
    reorder_window_ms: Annotated[float, Field(ge=0, le=1000)] = Field(
        default=10.0, description="how long a gap in the count may wait for a late frame"
    )
    latency_ms: Annotated[float, Field(ge=-10_000, le=10_000)] = Field(
        default=0.0,
        description="constant delay from the taking of a sample to its arrival, which no clock shows; counts "
        "where streams are aligned",
    )
    layout: Annotated[AnyLayout, Field(description="where counter and samples lie in a frame")]


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
