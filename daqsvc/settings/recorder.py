"""What is recorded of a machine: snapshots of all its samples around alarms, now and then, and on demand."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from daqsvc.settings.section import Section


class Recorder(Section):
    """Snapshots of all samples of the machine, with what was judged by them; see docs/recorder.md."""

    before_s: Annotated[float, Field(ge=0.0, le=600.0)] = Field(
        default=10.0, description="how much a snapshot holds of the time before its cause"
    )
    after_s: Annotated[float, Field(ge=0.0, le=600.0)] = Field(
        default=10.0,
        description="how much a snapshot holds of the time after its cause; a further cause in that time "
        "makes it longer",
    )
    longest_s: Annotated[float, Field(ge=1.0, le=86_400.0)] = Field(
        default=600.0, description="how long one snapshot may become"
    )
    every_s: Annotated[float, Field(ge=10.0, le=3.2e7)] | None = Field(
        default=None,
        description="how often a snapshot is made without a cause; never if absent",
        examples=[3600.0],
    )
    every_rpm: Annotated[float, Field(ge=1.0, le=1e6)] | None = Field(
        default=None,
        description="change of the speed, up or down, after which a snapshot is made; none if absent",
        examples=[100.0],
    )
    continuous: bool = Field(default=False, description="whether everything is recorded, file after file")
    continuous_s: Annotated[float, Field(ge=1.0, le=86_400.0)] = Field(
        default=600.0, description="how long each file of a continuous recording is"
    )
    max_mb: Annotated[int, Field(ge=1, le=10_000_000)] = Field(
        default=1000,
        description="size of all snapshots, beyond which the oldest are deleted, those of alarms last",
    )
    keep_days: Annotated[float, Field(ge=0.001, le=36_500)] = Field(
        default=90.0, description="age from which on a snapshot is deleted"
    )
    reserve_mb: Annotated[int, Field(ge=0, le=1_000_000)] = Field(
        default=256, description="free space on the disk that is left to the alarms"
    )
