"""Alarms: on a measured level, on a vote of several, or on a detector; and what holds for all of them."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self, TypeAlias

from pydantic import Field, PrivateAttr

from daqsvc.settings.measures import Measure  # noqa: TC001 - pydantic reads the annotations
from daqsvc.settings.section import (
    MOST,
    AngleDeg,
    DelayS,
    Kinds,
    Name,
    NamesDetector,
    Nats,
    Quantity,
    Section,
    Text,
    Unit,
)
from daqsvc.settings.zones import Boundaries, Zones  # noqa: TC001 - pydantic reads the annotations


class BaseAlarm(Section):
    """What all alarms have."""

    name: Annotated[Name, Field(description="name of the alarm", examples=["shaft-vibration"])]
    latching: bool = Field(default=False, description="whether the alarm stays until it is reset")
    first_out_group: Name = Field(
        default="machine", description="name of the group of alarms among which the first one is marked"
    )


class Setpoints(BaseAlarm):
    """Setpoints on a measure, in its unit (velocity RMS in mm/s)."""

    measure: Annotated[Measure, Field(description="what is compared with the setpoints", examples=["rms"])]
    alert: Quantity | None = Field(
        default=None, description="first setpoint, in the unit of the measure", examples=[40.0]
    )
    danger: Quantity | None = Field(
        default=None, description="second setpoint, in the unit of the measure", examples=[60.0]
    )
    alert_low: Quantity | None = Field(
        default=None, description="first lower setpoint, of what can be too low", examples=[4.0]
    )
    danger_low: Quantity | None = Field(
        default=None, description="second lower setpoint, of what can be too low", examples=[2.0]
    )
    deadband: Annotated[float, Field(ge=0, le=MOST)] = Field(
        default=0.0, description="how far the value must go back from a setpoint before the alarm returns"
    )
    on_delay_s: DelayS = Field(
        default=0.0, description="how long the value must be beyond a setpoint before the alarm is raised"
    )
    off_delay_s: DelayS = Field(
        default=0.0, description="how long the value must be clear of it before the alarm returns"
    )
    trip_multiply: Annotated[
        float, Field(ge=1, le=10, description="factor on alert and danger while the machine starts up")
    ] = 1.0
    reference_deg: AngleDeg | None = Field(
        default=None,
        description="of a phase: that of the machine in good order, from which setpoints count either way",
        examples=[135.0],
    )
    zones: Zones | None = Field(
        default=None,
        description="zones of a standard, whose boundaries are the setpoints that are not stated",
        examples=['{ standard = "iso-20816-3", group = 2, support = "rigid" }'],
    )

    _boundaries: Boundaries | None = PrivateAttr(default=None)

    @property
    def boundaries(self) -> Boundaries | None:
        """Where zones B, C and D begin, in the unit of the measure; None without zones."""
        return self._boundaries

    def in_zones(self, boundaries: Boundaries) -> Self:
        """The same, alert where zone C begins and danger where D does, but for what it states itself.

        Args:
            boundaries: where zones B, C and D begin, in the unit of the measure.
        """
        stated = {"alert": self.alert, "danger": self.danger}
        of_zones = {"alert": boundaries[1], "danger": boundaries[2]}
        copy = self.model_copy(update={key: of_zones[key] for key, at in stated.items() if at is None})
        copy._boundaries = boundaries  # noqa: SLF001 - its own
        return copy

    @property
    def setpoints(self) -> dict[str, float]:
        """Those that it has, by key, from the lowest to the highest if they are in order."""
        upwards = {
            "danger_low": self.danger_low,
            "alert_low": self.alert_low,
            "alert": self.alert,
            "danger": self.danger,
        }
        return {key: value for key, value in upwards.items() if value is not None}


DeviationDeg = Annotated[float, Field(gt=0, le=180)]
"""How far a phase may be from another one, the shorter way round."""


class PhaseLimits(Section):
    """How far the phase of a component may be from that of the machine in good order."""

    reference_deg: Annotated[
        AngleDeg, Field(description="phase lag of the machine in good order", examples=[135.0])
    ]
    alert: Annotated[DeviationDeg | None, Unit("deg")] = Field(
        default=None, description="first setpoint, in degrees either way", examples=[30.0]
    )
    danger: Annotated[DeviationDeg | None, Unit("deg")] = Field(
        default=None, description="second setpoint, in degrees either way", examples=[60.0]
    )
    deadband: Annotated[float, Field(ge=0, le=180), Unit("deg")] = Field(
        default=0.0,
        description="how far within a setpoint the phase must be before the alarm returns, in degrees",
    )


class LevelAlarm(Setpoints):
    """Setpoints on a measure of one sensor."""

    kind: ClassVar[str] = "a level alarm"

    sensor: Annotated[Name, Field(description="the sensor it watches", examples=["probe-x"])]
    phase: PhaseLimits | None = Field(
        default=None, description="of an amplitude: limits of its phase, which make them one region"
    )

    @property
    def watched(self) -> tuple[str, ...]:
        """Names of the sensors that it watches."""
        return (self.sensor,)


class VotingAlarm(Setpoints):
    """Setpoints on the same measure of several sensors, of which some must agree."""

    kind: ClassVar[str] = "a voting alarm"

    sensors: Annotated[
        tuple[Name, ...],
        Field(
            strict=False,
            min_length=2,
            max_length=1000,
            description="the sensors that vote",
            examples=[["de-x", "de-y"]],
        ),
    ]
    vote: Annotated[
        int, Field(ge=1, le=1000, description="how many of them must be at a setpoint", examples=[2])
    ]

    @property
    def watched(self) -> tuple[str, ...]:
        """Names of the sensors that it watches."""
        return self.sensors


SetpointAlarm = LevelAlarm | VotingAlarm
"""What has setpoints on the measure of one or several sensors."""


class DiagnosisAlarm(BaseAlarm):
    """An alarm on a detector's decision; the severity comes from the decision."""

    kind: ClassVar[str] = "an alarm on a detector"

    detector: Annotated[Name, Field(description="the detector it follows"), NamesDetector()]
    evidence_nats: Nats = Field(
        default=0.0, description="evidence without which it is not raised, where the detector states it"
    )


def _kind(table: object) -> type[LevelAlarm | VotingAlarm | DiagnosisAlarm]:
    keys = table if isinstance(table, dict) else {}
    if "detector" in keys:
        return DiagnosisAlarm
    return VotingAlarm if "sensors" in keys else LevelAlarm


Alarm: TypeAlias = Annotated[
    LevelAlarm | VotingAlarm | DiagnosisAlarm, Kinds(_kind, (LevelAlarm, VotingAlarm, DiagnosisAlarm))
]


class StartUp(Section):
    """How a start-up is recognised, during which ``trip_multiply`` holds: a range, a rate, or either."""

    detector: Annotated[
        Text, Field(description="the detector whose statements hold the signal"), NamesDetector()
    ]
    measure: Text = Field(default="speed", description="the signal among the statistics of the detector")
    between: Annotated[tuple[Quantity, Quantity], Field(strict=False)] | None = Field(
        default=None,
        description="the machine starts up while the signal lies in this range",
        examples=[[300.0, 2700.0]],
    )
    change_per_s: Annotated[float, Field(ge=1e-9, le=MOST)] | None = Field(
        default=None,
        description="the machine starts up while the signal changes at least at this rate",
        examples=[20.0],
    )
    at_most_s: Annotated[float, Field(ge=0.1, le=86_400)] = Field(
        default=120.0, description="how long a start-up may last at most"
    )


AlarmSeconds = Annotated[float, Field(ge=0.1, le=86_400)]


class AlarmHandling(Section):
    """What holds for all alarms of the machine."""

    chatter_raises: Annotated[int, Field(ge=0, le=1000)] = Field(
        default=5, description="raises within the window beyond which an alarm chatters; 0: never"
    )
    chatter_window_s: AlarmSeconds = Field(
        default=60.0, description="the window that raises of one alarm are counted over"
    )
    chatter_quiet_s: AlarmSeconds = Field(
        default=60.0, description="how long an alarm that chatters must not change before it counts as quiet"
    )
    flood_alarms: Annotated[int, Field(ge=0, le=100_000)] = Field(
        default=10, description="alarms within the window beyond which they are a flood; 0: never"
    )
    flood_window_s: AlarmSeconds = Field(
        default=600.0, description="the window that alarms of a flood are counted over"
    )
    shelve_at_most_s: Annotated[float, Field(ge=1, le=31_622_400)] = Field(
        default=28_800.0, description="the longest time to shelve an alarm"
    )
    start_up: StartUp | None = Field(
        default=None, description="how a start-up is recognised, during which trip_multiply holds"
    )
