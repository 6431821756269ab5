"""How much history is kept."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from daqsvc.settings.section import Section


class History(Section):
    """Trends of all figures, and the alarm events, for months, in the store of the service."""

    seconds_keep_days: Annotated[float, Field(ge=0.1, le=3660)] = Field(
        default=14.0, description="for how long each second is kept"
    )
    minutes_keep_days: Annotated[float, Field(ge=1, le=3660)] = Field(
        default=400.0, description="for how long minutes are kept: least, mean and greatest value"
    )
    hours_keep_days: Annotated[float, Field(ge=30, le=36_500)] = Field(
        default=3650.0, description="for how long hours are kept: least, mean and greatest value"
    )
    max_mb: Annotated[int, Field(ge=10, le=100_000)] = Field(
        default=1000,
        description="size of the file beyond which the oldest is deleted: seconds first, then minutes, then "
        "hours; alarm events take a quarter of it at most",
    )
