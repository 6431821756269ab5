"""Samples that a detector takes from several streams: on one grid, as well as their clocks are known."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from daqsvc.settings.section import Section, WaitMs


class Alignment(Section):
    """Lets a rotor detector take its sensors from several streams, with clocks of their own."""

    max_error_us: Annotated[float, Field(ge=0.01, le=1_000_000)] = Field(
        default=200.0, description="samples that may be further off the reference's are left out"
    )
    max_wait_ms: WaitMs = Field(
        default=1000.0, description="how long after all others a stream may come before the rest goes on"
    )
