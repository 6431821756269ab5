"""Who may look on over the broker, and how much that may send."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from daqsvc.settings.section import Section


class Live(Section):
    """Waveforms over the broker, to who asks for them by a request with a lease; nothing else is sent."""

    enabled: bool = Field(default=True, description="false sends to nobody, whoever asks")
    most_lookers: Annotated[int, Field(ge=1, le=64)] = Field(
        default=8, description="how many machines and pages may be looked at a time; further ones are refused"
    )
    max_kb_per_s: Annotated[float, Field(ge=1, le=100_000)] = Field(
        default=500.0, description="what all of them together may take of the way to the broker, kB/s"
    )
