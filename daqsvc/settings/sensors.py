"""Sensors: what a channel measures, in which unit, and when the sensor itself is to be believed."""

from __future__ import annotations

from collections.abc import Mapping  # noqa: TC003 - keeps the signature of `_kind_of` resolvable
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from daqsvc.errors.machine_file import BAD_TEXT, UNLIKELY_SENSITIVITY, WRONG_ORDER
from daqsvc.settings.section import MOST, NOT_ZERO, AngleDeg, Kinds, Line, Name, Quantity, Section, Volts

TYPE = "what kind of sensor it is"


def _not_zero(sensitivity_mv_per_unit: float) -> float:
    if sensitivity_mv_per_unit == 0:
        raise PydanticCustomError(
            "zero_sensitivity",
            "cannot be zero",
            {
                "remedy": "copy the figure from the sensor's calibration sheet, or leave it out if the "
                "channel already carries the physical unit",
                "code": UNLIKELY_SENSITIVITY,
            },
        )
    if abs(sensitivity_mv_per_unit) < 1 / MOST:
        raise PydanticCustomError(
            "small_sensitivity",
            "is what no sensor has",
            {
                "remedy": "copy the figure from the sensor's calibration sheet, in mV per unit",
                "code": UNLIKELY_SENSITIVITY,
            },
        )
    return sensitivity_mv_per_unit


def _ordered(limits: tuple[float, float]) -> tuple[float, float]:
    if limits[0] >= limits[1]:
        raise PydanticCustomError(
            "limit_order",
            "the lower limit must come first",
            {
                "remedy": f"write [{min(limits)}, {max(limits)}]"
                if limits[0] > limits[1]
                else "write two different limits, e.g. [-18.0, -2.0]",
                "code": WRONG_ORDER,
            },
        )
    return limits


def _printable(unit: str) -> str:
    if not unit.isprintable() or unit != unit.strip():
        raise PydanticCustomError(
            "unit_text",
            "is no unit: it holds spaces at an end, or what cannot be printed",
            {"remedy": 'write e.g. unit = "degC"', "code": BAD_TEXT},
        )
    return unit


class BaseSensor(Section):
    """What all sensors have; physical = (V - zero_v) * 1000 / sensitivity_mv_per_unit."""

    name: Annotated[Name, Field(description="name of the sensor", examples=["probe-x"])]
    stream: Annotated[Name, Field(description="the stream it is in", examples=["shaft"])]
    channel: Annotated[Name, Field(description="its channel in that stream", examples=["x"])]
    sensitivity_mv_per_unit: (
        Annotated[float, Field(ge=-MOST, le=MOST), AfterValidator(_not_zero), NOT_ZERO] | None
    ) = Field(
        default=None,
        description="sensitivity of the sensor; absent if the channel already carries the physical unit",
        examples=[7.87],
    )
    zero_v: Volts = Field(default=0.0, description="voltage that means 0 in the physical unit")

    @property
    def gain(self) -> float:
        """Physical units per unit on the wire: physical = wire * gain + shift."""
        return 1.0 if self.sensitivity_mv_per_unit is None else 1000.0 / self.sensitivity_mv_per_unit

    @property
    def shift(self) -> float:
        """Physical value of a zero on the wire: physical = wire * gain + shift."""
        return 0.0 if self.sensitivity_mv_per_unit is None else -self.zero_v * self.gain


class ProximityProbe(BaseSensor):
    """An eddy-current probe: shaft position against the housing, with a gap voltage to watch."""

    kind: ClassVar[str] = "a proximity probe"

    type: Annotated[Literal["proximity"], Field(description=TYPE, examples=["proximity"])]
    unit: Annotated[Literal["um", "mm", "mil"], Field(description="unit of the position", examples=["um"])]
    gap_ok_v: Annotated[tuple[Volts, Volts], AfterValidator(_ordered), Field(strict=False)] | None = Field(
        default=None,
        description="OK limits of the mean gap voltage, in V; needed where that is known",
        examples=["[-18.0, -2.0]"],
    )
    angle_deg: AngleDeg | None = Field(
        default=None, description="where the sensor points, from +x anticlockwise", examples=[45.0]
    )
    ac_coupled: bool = Field(
        default=False, description="whether it shows motion only, not the static position of the shaft"
    )


class Accelerometer(BaseSensor):
    """An accelerometer on the housing."""

    kind: ClassVar[str] = "an accelerometer"

    type: Annotated[Literal["accelerometer"], Field(description=TYPE, examples=["accelerometer"])]
    unit: Annotated[
        Literal["g", "m/s2", "mg", "mm/s2"], Field(description="unit of the acceleration", examples=["g"])
    ]
    angle_deg: AngleDeg | None = Field(
        default=None, description="where the sensor points, from +x anticlockwise", examples=[45.0]
    )


class VelocitySensor(BaseSensor):
    """A velocity sensor on the housing."""

    kind: ClassVar[str] = "a velocity sensor"

    type: Annotated[Literal["velocity"], Field(description=TYPE, examples=["velocity"])]
    unit: Annotated[Literal["mm/s"], Field(description="unit of the velocity", examples=["mm/s"])]


class Keyphasor(BaseSensor):
    """A probe over a notch or a key: one pulse a revolution, whose edge marks angle zero."""

    kind: ClassVar[str] = "a keyphasor"

    type: Annotated[Literal["keyphasor"], Field(description=TYPE, examples=["keyphasor"])]
    unit: Annotated[Literal["V"], Field(description="unit of the pulse", examples=["V"])]
    threshold_v: Annotated[Volts, Field(description="level that a pulse crosses, in V", examples=[-6.0])]
    hysteresis_v: Annotated[float, Field(ge=0, le=1000)] = Field(
        default=0.5,
        description="how far the signal must go back from threshold_v before the next crossing counts",
    )
    edge: Literal["rising", "falling"] = Field(
        default="rising", description="edge of the pulse that marks angle zero"
    )


class TrendValue(BaseSensor):
    """A level that the device has measured itself, e.g. an RMS velocity, a temperature, a gap voltage."""

    kind: ClassVar[str] = "a trend value"

    type: Annotated[Literal["trend"], Field(description=TYPE, examples=["trend"])]
    unit: Annotated[
        str,
        AfterValidator(_printable),
        Field(min_length=1, max_length=16, description="unit of the value", examples=["mm/s"]),
    ]
    ok_between: Annotated[tuple[Quantity, Quantity], AfterValidator(_ordered), Field(strict=False)] | None = (
        Field(
            default=None,
            description="OK limits, in its unit: beyond them the sensor is not believed",
            examples=["[-40.0, 125.0]"],
        )
    )


class _UntypedSensor(BaseSensor, extra="ignore"):
    """In place of a sensor whose type is missing or unknown: the keys that depend on it go unchecked."""

    type: Annotated[
        Literal["proximity", "accelerometer", "velocity", "keyphasor", "trend"],
        Field(description=TYPE, examples=["proximity"]),
    ]
    unit: Annotated[Line, Field(description="unit of the samples", examples=["um"])]


_KINDS: dict[str, type[BaseSensor]] = {
    "proximity": ProximityProbe,
    "accelerometer": Accelerometer,
    "velocity": VelocitySensor,
    "keyphasor": Keyphasor,
    "trend": TrendValue,
}


def _kind_of(table: Mapping[str, Any]) -> type[Section]:
    kind = table.get("type")
    return _KINDS.get(kind, _UntypedSensor) if isinstance(kind, str) else _UntypedSensor


Sensor: TypeAlias = Annotated[
    ProximityProbe | Accelerometer | VelocitySensor | Keyphasor | TrendValue,
    Kinds(_kind_of, tuple(_KINDS.values())),
]
