"""The machine file as a whole, and its table for the machine."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, Field, PrivateAttr
from pydantic_core import PydanticCustomError

from daqsvc.errors.machine_file import STANDSTILL
from daqsvc.settings.alarms import (
    Alarm,
    AlarmHandling,
    DiagnosisAlarm,
    LevelAlarm,
    SetpointAlarm,
    VotingAlarm,
)
from daqsvc.settings.buses import Bus, Layout
from daqsvc.settings.packing import Channel, Counter
from daqsvc.settings.pipeline import Pipeline, TableT
from daqsvc.settings.recorder import Recorder
from daqsvc.settings.registry import (
    INSTALLED,
    configured,
    configured_outputs,
    no_detectors,
    with_outputs,
)
from daqsvc.settings.section import (
    NOT_ZERO,
    AngleDeg,
    DampingRatio,
    FrozenTables,
    Line,
    Name,
    PositionUm,
    Section,
)
from daqsvc.settings.sensors import (
    Accelerometer,
    Keyphasor,
    ProximityProbe,
    Sensor,
    TrendValue,
    VelocitySensor,
)
from daqsvc.settings.store import Store
from daqsvc.settings.streams import AnyBus, Grid, Stream

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daqsvc.settings.problems import Problem

__all__ = [
    "Accelerometer",
    "Alarm",
    "AlarmHandling",
    "Bus",
    "Channel",
    "Counter",
    "DiagnosisAlarm",
    "Keyphasor",
    "Layout",
    "LevelAlarm",
    "Machine",
    "MachineFile",
    "Origin",
    "Pipeline",
    "ProximityProbe",
    "Recorder",
    "Rotor",
    "Sensor",
    "SetpointAlarm",
    "Store",
    "Stream",
    "TrendValue",
    "VelocitySensor",
    "VotingAlarm",
]


MOST_ENTRIES = 4096
"""Sensors, and alarms, of a machine."""


class Rotor(Section):
    """The Laval rotor behind its detectors."""

    natural_frequency_hz: Annotated[
        float,
        Field(
            ge=0.01,
            le=10_000,
            description="undamped natural frequency of the rotor, omega_s / 2 pi",
            examples=[10.0],
        ),
    ]
    damping_ratio: Annotated[
        DampingRatio,
        Field(
            description="damping ratio zeta of the healthy rotor, as a fraction of critical damping",
            examples=[0.18],
        ),
    ]
    eccentricity_um: Annotated[float, Field(ge=1e-3, le=10_000)] | None = Field(
        default=None, description="mass eccentricity epsilon; for the model bank", examples=[10.0]
    )
    heavy_spot_deg: AngleDeg = Field(default=0.0, description="angle of the heavy spot against the keyphasor")
    clearance_um: Annotated[
        float,
        Field(
            ge=0.1,
            le=100_000,
            description="radial clearance c, the characteristic length",
            examples=[100.0],
        ),
    ]
    static_sag_um: Annotated[
        float,
        Field(ge=0, le=100_000, description="sag of the shaft under gravity, towards -y", examples=[10.0]),
    ]
    contact_stiffness: Annotated[float, Field(ge=1e-3, le=1e6)] | None = Field(
        default=None,
        description="K* = K_beta / (M c omega_s^2), dimensionless; for the model bank",
        examples=[30.0],
    )
    contact_radius_um: Annotated[float, Field(ge=1, le=1e7)] = Field(
        default=25_000.0, description="radius of the surface that rubs; sets how fast it slides"
    )
    static_load_x_um: PositionUm = Field(
        default=0.0, description="sag of the healthy shaft under its static load, towards +x"
    )
    plain_bearings: bool | None = Field(
        default=None,
        description="whether oil films carry the shaft; if not given, the run-up of a calibration shows it",
        examples=[True],
    )


def _turning(speed_rpm: float) -> float:
    if speed_rpm == 0.0:
        raise PydanticCustomError(
            "standstill",
            "is a shaft that stands still",
            {"remedy": "write the nominal speed, negative if the shaft turns clockwise", "code": STANDSTILL},
        )
    return speed_rpm


class Machine(Section):
    """The machine that is watched."""

    name: Annotated[Name, Field(description="name of the machine", examples=["laval-rig"])]
    description: Line = Field(
        default="",
        description="what a person should know about it",
        examples=["cooling water pump 2, hall B"],
    )
    speed_rpm: Annotated[
        float,
        AfterValidator(_turning),
        NOT_ZERO,
        Field(
            ge=-1_000_000,
            le=1_000_000,
            description="nominal speed, negative if the shaft turns clockwise",
            examples=[600.0],
        ),
    ]
    rotor: Rotor | None = Field(default=None, description="the rotor; its detectors need it")


@dataclass(frozen=True, slots=True)
class Origin:
    """Where a machine file came from and what was found besides.

    Attributes:
        path: the file.
        warnings: what should be examined although the file can be used.
        layout_facts: by stream, what was read from the files that its layout names.
        text: the file as it was read; empty if it was made in memory.
    """

    path: Path = Path("<text>")
    warnings: tuple[Problem, ...] = ()
    layout_facts: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    text: str = ""


class MachineFile(Section):
    """Everything a box knows about the machine it watches.

    `daqsvc.settings.load.load_machine_file` makes it and guarantees that its tables fit each other;
    validating a dict alone checks each value, not how they fit. `machine_file_model` adds the tables of the
    outputs that are installed.
    """

    schema_version: Annotated[Literal[1], Field(description="version of this file's format", examples=[1])]
    site: Annotated[Name, Field(description="where the box is; part of every topic", examples=["lab"])]
    box: Annotated[Name, Field(description="name of this box; part of every topic", examples=["edge-1"])]
    machine: Annotated[Machine, Field(description="the machine that is watched")]
    buses: Annotated[
        dict[Name, AnyBus],
        Field(min_length=1, max_length=64, description="the buses that samples come over, by name"),
        AfterValidator(FrozenTables),
    ]
    streams: Annotated[
        dict[Name, Stream],
        Field(min_length=1, max_length=1024, description="the streams of samples, by name"),
        AfterValidator(FrozenTables),
    ]
    sensors: Annotated[
        tuple[Sensor, ...],
        Field(strict=False, min_length=1, max_length=MOST_ENTRIES, description="the sensors"),
    ]
    pipeline: Annotated[Pipeline, INSTALLED] = Field(
        default_factory=no_detectors, description="the detectors, and how much of the past they can reach"
    )
    alarms: Annotated[tuple[Alarm, ...], Field(strict=False, max_length=MOST_ENTRIES)] = Field(
        default=(), description="the alarms"
    )
    alarm_handling: AlarmHandling = Field(default=AlarmHandling(), description="what holds for all alarms")
    recorder: Recorder | None = Field(
        default=None, description="the recorder of snapshots; none are made if absent"
    )
    store: Store | None = Field(
        default=None,
        description="where the journal is kept, which survives a power cut; below ~/.local/state/daqsvc if "
        "absent, or in the state directory of the unit under systemd",
    )

    _origin: Origin = PrivateAttr(default_factory=Origin)

    def found_at(self, origin: Origin) -> MachineFile:
        """The same, with where it came from."""
        copy = self.model_copy()
        copy._origin = origin  # noqa: SLF001 - its own
        return copy

    @property
    def path(self) -> Path:
        """The file this came from."""
        return self._origin.path

    @property
    def text(self) -> str:
        """The file as it was read; empty if it was made in memory."""
        return self._origin.text

    @property
    def warnings(self) -> tuple[Problem, ...]:
        """What should be examined although the file can be used."""
        return self._origin.warnings

    @property
    def layout_facts(self) -> Mapping[str, Any]:
        """By stream, what was read from the files that its layout names, e.g. a message of a DBC file."""
        return self._origin.layout_facts

    @property
    def value_names(self) -> dict[str, Mapping[float, str]]:
        """By sensor, what some of its values mean, as a file that its layout names states it."""
        by_sensor = {sensor.name: self.value_names_of(sensor, self.layout_facts) for sensor in self.sensors}
        return {name: names for name, names in by_sensor.items() if names}

    def value_names_of(self, sensor: Sensor, facts: Mapping[str, Any]) -> Mapping[float, str]:
        """What some values of a sensor mean; empty where that is not known.

        Args:
            sensor: one of its sensors.
            facts: by stream, what was read from the files that its layout names.
        """
        stream = self.streams.get(sensor.stream)
        # In another unit, or with a sensitivity, a value is another number than the file's.
        if stream is None or not isinstance(sensor, TrendValue) or sensor.unit != "1":
            return {}
        return stream.layout.value_names(sensor.channel, facts.get(sensor.stream))

    @property
    def detectors(self) -> tuple[str, ...]:
        """Names of the detectors that an alarm can follow."""
        names = (plugin.detector for _, plugin, _ in configured(self.pipeline))
        return tuple(name for name in names if name is not None)

    @property
    def ac_coupled(self) -> bool:
        """Whether a probe of the rotor shows motion only, so that no detector sees its static position."""
        probes = {name for together in self.sampled_together for name in together}
        named = (sensor for sensor in self.sensors if sensor.name in probes)
        return any(sensor.ac_coupled for sensor in named if isinstance(sensor, ProximityProbe))

    def output(self, kind: type[TableT]) -> TableT | None:
        """The table of an output, by its class; None if the file has none.

        Raises:
            UnusableValueError: it is there and not valid.
        """
        return next(
            (settings for _, _, settings in configured_outputs(self) if isinstance(settings, kind)), None
        )

    def resolve(self, path: Path) -> Path:
        """A path of the file, made absolute: relative ones start at the directory of the machine file."""
        return (self.path.parent / path).absolute()

    def sensor(self, name: str) -> Sensor:
        """The sensor of that name.

        Raises:
            KeyError: there is none.
        """
        for sensor in self.sensors:
            if sensor.name == name:
                return sensor
        raise KeyError(f"no sensor {name!r}; there are {', '.join(s.name for s in self.sensors)}")

    @property
    def sampled_together(self) -> tuple[tuple[str, ...], ...]:
        """The sensors that each detector takes together, sample by sample; the reference's first."""
        together = (plugin.sampled_together(settings) for _, plugin, settings in configured(self.pipeline))
        return tuple(names for names in together if names)

    def grid(self, together: Sequence[str]) -> Grid:
        """Where a detector finds the samples of sensors that it takes together.

        Args:
            together: names of the sensors; the stream of the first one is the grid.
        """
        streams = [self.sensor(name).stream for name in together]
        return Grid({name: self.streams[name] for name in streams})

    @property
    def grids(self) -> tuple[Grid, ...]:
        """The grids of several streams that the detectors need, each once."""
        grids = [self.grid(together) for together in self.sampled_together]
        return tuple({grid.name: grid for grid in grids if grid.aligned}.values())

    def column(self, sensor: Sensor) -> int:
        """Where a sensor stands among the channels of its stream."""
        return self.streams[sensor.stream].layout.channel_names.index(sensor.channel)


def machine_file_model() -> type[MachineFile]:
    """The machine file with a table for each output that is installed."""
    return with_outputs(MachineFile)
