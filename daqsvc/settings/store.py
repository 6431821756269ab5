"""Where state lives that must survive a restart, and how much of it is kept."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from daqsvc.settings.files import FilePath  # noqa: TC001 - pydantic reads the annotations
from daqsvc.settings.section import Section


class Store(Section):
    """Where state lives that must survive a restart, and how much of it is kept.

    The limits hold for what the broker has, and for telemetry. An alarm that the broker has not confirmed is
    kept for as long as the disk has room.
    """

    directory: Annotated[
        FilePath, Field(description="directory of the journal", examples=["/var/lib/daqsvc"])
    ]
    alarms_max_mb: Annotated[int, Field(ge=1, le=100_000)] = Field(
        default=256, description="size of the journal from which on its oldest, sent messages are deleted"
    )
    alarms_keep_days: Annotated[float, Field(ge=0.001, le=36_500)] = Field(
        default=90.0, description="age from which on sent messages of the journal are deleted"
    )
    telemetry_max_mb: Annotated[int, Field(ge=1, le=100_000)] = Field(
        default=64, description="telemetry that waits for the broker; beyond that, the oldest is dropped"
    )
    telemetry_max_age_s: Annotated[float, Field(ge=1, le=3.2e9)] = Field(
        default=86_400.0, description="age from which on telemetry is dropped"
    )
    reserve_mb: Annotated[int, Field(ge=0, le=100_000)] = Field(
        default=64, description="free space on the disk that telemetry leaves to the alarms"
    )
    audit_max_mb: Annotated[int, Field(ge=1, le=100_000)] = Field(
        default=32,
        description="size of the audit log, from which on its oldest parts are deleted",
    )
