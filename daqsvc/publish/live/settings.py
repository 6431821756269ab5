"""How many may view live data over the broker, and how much is sent."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from daqsvc.settings.section import Section


class Live(Section):
    """Live waveforms over the broker, to viewers that ask for them by a request with a lease."""

    enabled: bool = Field(default=True, description="false sends nothing, whoever asks")
    max_viewers: Annotated[int, Field(ge=1, le=64)] = Field(
        default=8, description="viewers at a time, each of one machine; further ones are refused"
    )
    max_kb_per_s: Annotated[float, Field(ge=1, le=100_000)] = Field(
        default=500.0, description="the most that all of them together are sent, kB/s"
    )
