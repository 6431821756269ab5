"""Alarms: on a measured level, or on what a detector declares."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, TypeAlias

from pydantic import Field

from daqsvc.settings.section import Kinds, Name, NotNegative, Positive, Section

Measure = Literal["rms", "peak", "crest_factor", "velocity_rms"]


class BaseAlarm(Section):
    """What all alarms have."""

    name: Annotated[Name, Field(description="name of the alarm", examples=["shaft-vibration"])]
    latching: bool = Field(default=False, description="whether it stays until it is reset")


class LevelAlarm(BaseAlarm):
    """Setpoints on a measure of one sensor, in its unit (velocity RMS in mm/s)."""

    kind: ClassVar[str] = "a level alarm"

    sensor: Annotated[Name, Field(description="the sensor it watches", examples=["probe-x"])]
    measure: Annotated[Measure, Field(description="what is held against the setpoints", examples=["rms"])]
    alert: Positive | None = Field(default=None, description="first setpoint")
    danger: Positive | None = Field(default=None, description="second setpoint")
    deadband: NotNegative = Field(default=0.0, description="how far below a setpoint it returns")
    on_delay_s: NotNegative = Field(default=0.0, description="how long above before it is raised")
    off_delay_s: NotNegative = Field(default=0.0, description="how long below before it returns")


class DiagnosisAlarm(BaseAlarm):
    """An alarm on a detector's decision; the severity comes from the decision."""

    kind: ClassVar[str] = "an alarm on a detector"

    detector: Annotated[Name, Field(description="the detector it follows", examples=["rotor-bank"])]


Alarm: TypeAlias = Annotated[
    LevelAlarm | DiagnosisAlarm,
    Kinds(
        lambda table: DiagnosisAlarm if "detector" in table else LevelAlarm,
        (LevelAlarm, DiagnosisAlarm),
    ),
]
