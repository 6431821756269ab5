"""The machine file as a whole, and its tables for the machine, the broker and the store."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal
from urllib.parse import SplitResult, urlsplit

from pydantic import AfterValidator, Field, PrivateAttr
from pydantic_core import PydanticCustomError

from daqsvc.settings.alarms import Alarm, DiagnosisAlarm, LevelAlarm
from daqsvc.settings.bearing import BEARING, Bearing, WatchedBearing
from daqsvc.settings.buses import (
    Bus,
    CanBus,
    Channel,
    Counter,
    DbcChannel,
    DbcCounter,
    DbcLayout,
    Layout,
    OtherBus,
    PlainLayout,
    Stream,
)
from daqsvc.settings.pipeline import ROTOR_BANK, Levels, Mode, Pipeline, RotorBank
from daqsvc.settings.rotor import ROTOR_SYNCHRONOUS, RotorSynchronous
from daqsvc.settings.section import AngleDeg, DampingRatio, Name, Positive, Section
from daqsvc.settings.sensors import Accelerometer, Keyphasor, ProximityProbe, Sensor, VelocitySensor

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.settings.dbc import DbcMessage
    from daqsvc.settings.problems import Problem

__all__ = [
    "BEARING",
    "ROTOR_BANK",
    "ROTOR_SYNCHRONOUS",
    "Accelerometer",
    "Alarm",
    "Bearing",
    "Bus",
    "CanBus",
    "Channel",
    "Counter",
    "DbcChannel",
    "DbcCounter",
    "DbcLayout",
    "DiagnosisAlarm",
    "Keyphasor",
    "Layout",
    "LevelAlarm",
    "Levels",
    "Machine",
    "MachineFile",
    "Mode",
    "Mqtt",
    "Origin",
    "OtherBus",
    "Pipeline",
    "PlainLayout",
    "ProximityProbe",
    "Rotor",
    "RotorBank",
    "RotorSynchronous",
    "Sensor",
    "Store",
    "Stream",
    "VelocitySensor",
    "WatchedBearing",
]

_DEFAULT_PORTS = {"mqtt": 1883, "mqtts": 8883}


class Rotor(Section):
    """The Laval rotor behind its detectors."""

    natural_frequency_hz: Annotated[
        Positive, Field(description="undamped natural frequency, omega_s / 2 pi", examples=[10.0])
    ]
    damping_ratio: Annotated[DampingRatio, Field(description="zeta of the healthy rotor", examples=[0.18])]
    eccentricity_um: Positive | None = Field(
        default=None, description="mass eccentricity epsilon; for the model bank", examples=[10.0]
    )
    heavy_spot_deg: AngleDeg = Field(default=0.0, description="angle of the heavy spot against the keyphasor")
    clearance_um: Annotated[
        Positive, Field(description="radial clearance c, the characteristic length", examples=[100.0])
    ]
    static_sag_um: Annotated[
        float, Field(ge=0, description="sag of the shaft under gravity, towards -y", examples=[10.0])
    ]
    contact_stiffness: Positive | None = Field(
        default=None,
        description="K* = K_beta / (M c omega_s^2), dimensionless; for the model bank",
        examples=[30.0],
    )
    contact_radius_um: Positive = Field(
        default=25_000.0, description="radius of the surface that rubs; sets how fast it slides"
    )
    static_load_x_um: float = Field(
        default=0.0, description="sag of the healthy shaft under its static load, towards +x"
    )


def _turning(speed_rpm: float) -> float:
    if speed_rpm == 0.0:
        raise PydanticCustomError(
            "standstill",
            "is a shaft that stands still",
            {"remedy": "write the nominal speed, negative if the shaft turns clockwise"},
        )
    return speed_rpm


class Machine(Section):
    """The machine that is watched."""

    name: Annotated[Name, Field(description="name of the machine", examples=["laval-rig"])]
    description: str = Field(default="", description="what a person should know about it")
    speed_rpm: Annotated[
        float,
        AfterValidator(_turning),
        Field(
            ge=-1_000_000,
            le=1_000_000,
            description="nominal speed, negative if the shaft turns clockwise",
            examples=[600.0],
        ),
    ]
    rotor: Rotor | None = Field(default=None, description="needed by the rotor's detectors")


def _split_url(url: str) -> SplitResult:
    """The parts of a broker's address; the value is kept out of every message, it may hold a password."""
    remedy = {"remedy": 'write "mqtts://broker.example:8883", or "mqtt://..." with insecure = true'}
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        raise PydanticCustomError("broker_url", "is not the address of an MQTT broker", remedy) from None
    if parts.username is not None or parts.password is not None:
        raise PydanticCustomError(
            "broker_url_secret",
            "must not hold a user name or password",
            {
                "remedy": "take them out of the url, write username and password_file instead, "
                "and change the password: it has been in a file that others can read"
            },
        )
    if parts.scheme not in _DEFAULT_PORTS or not parts.hostname or port == 0:
        raise PydanticCustomError("broker_url", "is not the address of an MQTT broker", remedy)
    if parts.path not in {"", "/"} or parts.query or parts.fragment:
        raise PydanticCustomError(
            "broker_url", "has something after host and port", {"remedy": "end the url after the port"}
        )
    return parts


def _broker_url(url: str) -> str:
    _split_url(url)
    return url


class Mqtt(Section):
    """The broker that alarms and diagnoses go to.

    A password never stands in the machine file, only the name of the file that holds it.
    """

    url: Annotated[
        str,
        AfterValidator(_broker_url),
        Field(description="address of the broker", examples=["mqtts://broker.example:8883"]),
    ]
    insecure: bool = Field(default=False, description="says that mqtt:// without TLS is meant")
    client_id: Annotated[str, Field(min_length=1, max_length=128)] | None = Field(
        default=None, description="how the broker knows this box; daqsvc-<site>-<box> if absent"
    )
    username: Annotated[str, Field(min_length=1)] | None = Field(
        default=None, description="user at the broker"
    )
    password_file: Annotated[Path, Field(strict=False)] | None = Field(
        default=None, description="file whose first line is the password"
    )
    ca_file: Annotated[Path, Field(strict=False)] | None = Field(
        default=None, description="certificates (PEM) to trust in place of the system's"
    )
    keepalive_s: Annotated[int, Field(ge=1, le=65535)] = Field(
        default=30, description="how soon the broker notices that the box is gone"
    )
    protocol: Literal["auto", "5", "3.1.1"] = Field(
        default="auto", description="MQTT version; auto asks for 5 and takes 3.1.1 if that is refused"
    )
    topic_root: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*$")] = Field(
        default="daqsvc", description="first part of every topic"
    )

    @property
    def tls(self) -> bool:
        """Whether the connection is encrypted and the broker's certificate verified."""
        return urlsplit(self.url).scheme == "mqtts"

    @property
    def host(self) -> str:
        """Host name or address of the broker."""
        return urlsplit(self.url).hostname or ""

    @property
    def port(self) -> int:
        """TCP port of the broker: as in the url, else 1883, with TLS 8883."""
        parts = urlsplit(self.url)
        return parts.port or _DEFAULT_PORTS[parts.scheme]


class Store(Section):
    """Where state lives that must survive a restart."""

    directory: Annotated[
        Path, Field(strict=False, description="directory of the journal", examples=["/var/lib/daqsvc"])
    ]


@dataclass(frozen=True, slots=True)
class Origin:
    """Where a machine file came from and what was found besides.

    Attributes:
        path: the file.
        warnings: what should be looked at although the file can be used.
        dbc_messages: by stream, the messages that the layouts name in DBC files.
    """

    path: Path = Path("<text>")
    warnings: tuple[Problem, ...] = ()
    dbc_messages: Mapping[str, DbcMessage] = field(default_factory=lambda: MappingProxyType({}))


class MachineFile(Section):
    """Everything a box knows about the machine it watches.

    `daqsvc.settings.load.load_machine_file` makes it and guarantees that its tables fit each other;
    validating a dict with this class alone checks each value, not how they fit.
    """

    schema_version: Annotated[Literal[1], Field(description="version of this file's format", examples=[1])]
    site: Annotated[Name, Field(description="where the box stands; part of every topic", examples=["lab"])]
    box: Annotated[Name, Field(description="name of this box; part of every topic", examples=["edge-1"])]
    machine: Annotated[Machine, Field(description="the machine that is watched")]
    buses: Annotated[dict[Name, Bus], Field(min_length=1, description="the buses, by name")]
    streams: Annotated[dict[Name, Stream], Field(min_length=1, description="the streams of samples, by name")]
    sensors: Annotated[tuple[Sensor, ...], Field(strict=False, min_length=1, description="the sensors")]
    pipeline: Pipeline = Field(default=Pipeline(), description="what is computed")
    alarms: Annotated[tuple[Alarm, ...], Field(strict=False)] = Field(default=(), description="the alarms")
    mqtt: Mqtt | None = Field(default=None, description="the broker; none is configured if absent")
    store: Store | None = Field(default=None, description="the journal's place")

    _origin: Origin = PrivateAttr(default_factory=Origin)

    def model_post_init(self, context: Any, /) -> None:
        """Keep the `Origin` that is given as validation context."""
        if isinstance(context, Origin):
            self._origin = context

    @property
    def path(self) -> Path:
        """The file this came from."""
        return self._origin.path

    @property
    def warnings(self) -> tuple[Problem, ...]:
        """What should be looked at although the file can be used."""
        return self._origin.warnings

    @property
    def dbc_messages(self) -> Mapping[str, DbcMessage]:
        """By stream, the facts of the message that a `DbcLayout` names."""
        return self._origin.dbc_messages

    @property
    def detectors(self) -> tuple[str, ...]:
        """Names of the detectors that an alarm can follow."""
        configured = {
            ROTOR_BANK: self.pipeline.rotor_bank,
            ROTOR_SYNCHRONOUS: self.pipeline.rotor_synchronous,
            BEARING: self.pipeline.bearing,
        }
        return tuple(name for name, section in configured.items() if section is not None)

    @property
    def ac_coupled(self) -> bool:
        """Whether a probe of the rotor shows motion only, so that no detector sees its static position."""
        detectors = (self.pipeline.rotor_bank, self.pipeline.rotor_synchronous)
        probes = [name for detector in detectors if detector is not None for name in detector.probes]
        named = (sensor for sensor in self.sensors if sensor.name in probes)
        return any(sensor.ac_coupled for sensor in named if isinstance(sensor, ProximityProbe))

    @property
    def mqtt_client_id(self) -> str:
        """The client id for the broker: as in the file, else from site and box."""
        given = self.mqtt.client_id if self.mqtt is not None else None
        return given or f"daqsvc-{self.site}-{self.box}"

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

    def column(self, sensor: Sensor) -> int:
        """Where a sensor stands among the channels of its stream."""
        return self.streams[sensor.stream].layout.channel_names.index(sensor.channel)
