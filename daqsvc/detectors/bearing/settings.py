"""Rolling bearings: which are watched, by which accelerometers, and how sure an alarm must be."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from daqsvc.settings.files import FilePath  # noqa: TC001 - pydantic reads the annotations
from daqsvc.settings.section import Name, Section, Text

BEARING = "bearing"
"""Name of the bearings' detector."""

WINDOW_S = 2.5
"""Time that the race test evaluates at once; `daqsvc.bearing.race.judge` states why."""

Order = Annotated[float, Field(ge=0.01, le=1000)]
MassKg = Annotated[float, Field(ge=1e-6, le=1e6)]
StiffnessNPerM = Annotated[float, Field(ge=1, le=1e13)]
DampingNsPerM = Annotated[float, Field(ge=1e-6, le=1e9)]


class FaultOrders(Section):
    """How often the parts of a bearing meet, per revolution of the shaft."""

    bpfi: Annotated[
        Order,
        Field(
            description="how often balls pass a point of the inner race, per revolution of the shaft",
            examples=[5.415],
        ),
    ]
    bpfo: Annotated[
        Order,
        Field(
            description="how often balls pass a point of the outer race, per revolution of the shaft",
            examples=[3.585],
        ),
    ]
    bsf: Annotated[
        Order,
        Field(
            description="how often a ball turns about itself, per revolution of the shaft", examples=[2.357]
        ),
    ]
    ftf: Annotated[
        Order, Field(description="how often the cage turns, per revolution of the shaft", examples=[0.398])
    ]


class RollingGeometry(Section):
    """The dimensions of a rolling bearing, of one row; from its data sheet or measured."""

    balls: Annotated[int, Field(ge=3, le=500, description="balls or rollers of one row", examples=[9])]
    ball_diameter_mm: Annotated[
        float,
        Field(
            ge=0.01,
            le=10_000,
            description="diameter of a ball, or of a roller at its middle",
            examples=[7.94],
        ),
    ]
    pitch_diameter_mm: Annotated[
        float,
        Field(
            ge=0.01,
            le=100_000,
            description="diameter of the circle through the centres of balls or rollers",
            examples=[39.04],
        ),
    ]
    contact_deg: Annotated[float, Field(ge=0, lt=90)] = Field(
        default=0.0, description="contact angle; 0 for deep-groove and cylindrical roller bearings"
    )


class ThreeMasses(Section):
    """The bearing as a chain of rotor, rolling elements and housing, to ground."""

    masses_kg: Annotated[
        tuple[MassKg, MassKg, MassKg],
        Field(
            strict=False,
            description="masses of rotor, rolling elements and housing",
            examples=["[4.0, 0.0185, 2.0]"],
        ),
    ]
    stiffness_n_per_m: Annotated[
        tuple[StiffnessNPerM, StiffnessNPerM, StiffnessNPerM],
        Field(
            strict=False, description="stiffness of shaft, contact and housing", examples=["[2e7, 1e8, 5e7]"]
        ),
    ]
    damping_n_s_per_m: Annotated[
        tuple[DampingNsPerM, DampingNsPerM, DampingNsPerM],
        Field(
            strict=False,
            description="damping of shaft, contact and housing",
            examples=["[200.0, 300.0, 2000.0]"],
        ),
    ]
    mismatch: Annotated[float, Field(ge=0, le=0.4)] = Field(
        default=0.1, description="share by which masses, stiffness and damping may be wrong"
    )


class WatchedBearing(Section):
    """One bearing with the accelerometer on its housing."""

    name: Annotated[Name, Field(description="name of the bearing", examples=["drive-end"])]
    sensor: Annotated[Name, Field(description="the accelerometer on its housing", examples=["accel-de"])]
    type: Text | None = Field(
        default=None,
        description='designation in the catalogue, e.g. "6205-2RS"; or orders, or geometry',
        examples=["6205-2RS"],
    )
    orders: FaultOrders | None = Field(
        default=None, description="fault orders of the bearing, in place of type"
    )
    geometry: RollingGeometry | None = Field(
        default=None,
        description="dimensions of the bearing, in place of type: of ball and roller bearings of any kind",
    )
    rotor_sensor: Name | None = Field(
        default=None,
        description="accelerometer that moves with the rotor, to tell the races apart by direction",
        examples=["accel-rotor"],
    )
    model: ThreeMasses | None = Field(
        default=None, description="the bearing's masses and springs, needed by rotor_sensor"
    )

    @property
    def sensors(self) -> tuple[Name, ...]:
        """The sensors that it is judged by."""
        return (self.sensor,) if self.rotor_sensor is None else (self.rotor_sensor, self.sensor)


class Bearing(Section):
    """Bearings judged by the lines of their kinematics, and against the healthy machine."""

    bearings: Annotated[
        tuple[WatchedBearing, ...],
        Field(
            strict=False,
            min_length=1,
            max_length=64,
            description="the bearings; all of one machine, so that they can be compared",
            examples=['[{ name = "drive-end", sensor = "accel-de", type = "6205-2RS" }]'],
        ),
    ]
    keyphasor: Name | None = Field(
        default=None,
        description="the keyphasor that measures the speed; without it, the machine keeps to speed_rpm",
        examples=["keyphasor"],
    )
    calibrate_s: Annotated[float, Field(ge=10, le=120)] = Field(
        default=30.0, description="first seconds, which are the healthy state; kept over restarts"
    )
    calibration: FilePath | None = Field(
        default=None,
        description="file of daqsvc calibrate with the healthy state, in place of the first seconds",
        examples=["motor.calibration.toml"],
    )
    false_alarm_probability: Annotated[float, Field(ge=1e-9, le=0.1)] = Field(
        default=1e-4, description="probability of calling an unchanged machine changed, at each evaluation"
    )

    repeatability_db: Annotated[float, Field(ge=0, le=6)] = Field(
        default=0.8,
        description="standard deviation of the healthy machine's level from run to run: temperature, load",
    )

    @property
    def sensors(self) -> tuple[Name, ...]:
        """The accelerometers that it rests on, each once."""
        return tuple(dict.fromkeys(name for bearing in self.bearings for name in bearing.sensors))
