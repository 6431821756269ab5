"""Whether the table of a sensor can be true: unit, sensitivity, voltages, and what its channel carries."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple

from daqsvc.errors.alarms import NEVER_REACHED, OK_LIMITS_TOO_NEAR
from daqsvc.errors.machine_file import (
    BEYOND_CHANNEL,
    GAP_VOLTAGE,
    INCOMPLETE,
    PROBES_IN_LINE,
    UNIT_UNKNOWN,
    UNLIKELY_SENSITIVITY,
    WRONG_SCALE,
)
from daqsvc.rounding import rounded_up, unit_behind
from daqsvc.settings.alarms import SetpointAlarm
from daqsvc.settings.measures import NOT_1X
from daqsvc.settings.problems import Finding
from daqsvc.settings.section import UnusableValueError
from daqsvc.settings.sensors import Keyphasor, ProximityProbe, TrendValue
from daqsvc.settings.units import factor_between, is_of_vibration, may_be_unit

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from daqsvc.settings.buses import WireRange
    from daqsvc.settings.models import MachineFile, Sensor
    from daqsvc.settings.problems import KeyPath

_ALONG_ONE_LINE_DEG = 1.0
_COARSE_V = 0.5
"""No device resolves the voltage of a sensor so coarsely."""
_TIMES_SETPOINT = 1.5
"""How far beyond its highest setpoint a vibration must be believed: a machine that fails goes beyond it."""
_WHOLE_CHANNEL = 0.95
"""Part of what a channel carries beyond which a value is a mark for a broken sensor, or nearly one."""


class _Usual(NamedTuple):
    """Sensitivities in mV per unit: beyond the outer ones none is built, beyond the inner ones few are."""

    least: float
    few_below: float
    few_above: float
    most: float
    example: float


_USUAL = {
    # Eddy-current probes have 4 to 16 mV/um, 7.87 (200 mV/mil) by API 670; capacitive ones up to some 200.
    "um": _Usual(0.05, 0.5, 100.0, 2_000.0, 7.87),
    "mm": _Usual(50.0, 500.0, 100e3, 2e6, 7870.0),
    "mil": _Usual(1.3, 13.0, 2_500.0, 50e3, 200.0),
    # Accelerometers for machines have 10 to 1000 mV/g, those for shocks 0.05, those for earthquakes 10,000.
    "g": _Usual(0.02, 0.5, 2_000.0, 100e3, 100.0),
    "m/s2": _Usual(0.002, 0.05, 200.0, 10e3, 10.2),
    "mg": _Usual(20e-6, 0.5e-3, 2.0, 100.0, 0.1),
    "mm/s2": _Usual(2e-6, 50e-6, 0.2, 10.0, 0.0102),
    # Velocity sensors have 4 (100 mV per in/s) to some 30.
    "mm/s": _Usual(0.01, 0.5, 200.0, 10e3, 4.0),
}


def check_voltages(draft: MachineFile, sensor: Sensor, at: KeyPath) -> Iterator[Finding]:
    """What is stated in volts has a sensitivity to go with it, and a healthy probe lies within its limits."""
    probe = sensor if isinstance(sensor, ProximityProbe) else None
    if sensor.sensitivity_mv_per_unit is None:
        if sensor.zero_v != 0:
            yield Finding(
                (*at, "zero_v"),
                "has no effect without sensitivity_mv_per_unit",
                "add sensitivity_mv_per_unit, or remove zero_v if the channel carries the physical unit",
                code=INCOMPLETE,
            )
        if probe is not None and probe.gap_ok_v is not None:
            yield Finding(
                (*at, "gap_ok_v"),
                "cannot be checked: without sensitivity_mv_per_unit the gap voltage is not known",
                "add sensitivity_mv_per_unit and zero_v, and let the channel carry volts; or remove it",
                fatal=False,
                code=GAP_VOLTAGE,
            )
        return
    if probe is None:
        return
    if probe.gap_ok_v is None:
        if not probe.ac_coupled:
            yield Finding(
                (*at, "gap_ok_v"),
                "is missing: OK limits of the mean gap voltage, in V",
                f'add gap_ok_v = [-18.0, -2.0] to the entry "{probe.name}" of sensors, as its manual has it',
                code=GAP_VOLTAGE,
            )
        return
    low_v, high_v = probe.gap_ok_v
    if low_v <= probe.zero_v <= high_v:
        return
    if "zero_v" in probe.model_fields_set:
        yield Finding(
            (*at, "zero_v"),
            f"lies outside gap_ok_v, {low_v:g} to {high_v:g} V: the "
            "readings would be rejected where the shaft belongs",
            "write the gap voltage with the shaft centred, with its sign, e.g. zero_v = "
            f"{(low_v + high_v) / 2:g}; or correct gap_ok_v",
            code=GAP_VOLTAGE,
        )
    elif _of_a_rotor(draft, probe.name):
        yield Finding(
            at,
            "has no zero_v: its position counts from 0 V, far from where the shaft is",
            f"add the gap voltage with the shaft centred, e.g. zero_v = {(low_v + high_v) / 2:g}",
            fatal=False,
            code=GAP_VOLTAGE,
        )


def _of_a_rotor(draft: MachineFile, name: str) -> bool:
    return any(name in together for together in draft.sampled_together)


def check_sensitivity(sensor: Sensor, at: KeyPath) -> Iterator[Finding]:
    """The sensitivity is one that sensors of this unit have."""
    stated, usual = sensor.sensitivity_mv_per_unit, _USUAL.get(sensor.unit)
    if stated is None or usual is None or isinstance(sensor, TrendValue):
        return
    size = abs(stated)
    if usual.few_below <= size <= usual.few_above:
        return
    built = usual.least <= size <= usual.most
    meant = [
        f"{unit_text} are sensitivity_mv_per_unit = {value:.4g}"
        for value, unit_text in (
            (stated * 1000.0, f"{stated:g} V/{sensor.unit}"),
            *(
                (stated * (factor_between(sensor.unit, other) or math.nan), f"{stated:g} mV/{other}")
                for other in _USUAL
                if other != sensor.unit
            ),
        )
        if usual.few_below <= abs(value) <= usual.few_above
    ]
    yield Finding(
        (*at, "sensitivity_mv_per_unit"),
        f"{stated:g} mV/{sensor.unit} is what {'hardly any' if built else 'no'} sensor has; usual is some "
        f"{usual.example:g}",
        "; ".join(meant) or f"write it in mV per {sensor.unit}, from the sensor's calibration sheet",
        fatal=not built,
        code=UNLIKELY_SENSITIVITY,
    )


def check_unit(sensor: Sensor, at: KeyPath) -> Iterator[Finding]:
    """The unit of a value is one; of other sensors it is one of a few."""
    if isinstance(sensor, TrendValue) and not may_be_unit(sensor.unit):
        yield Finding(
            (*at, "unit"),
            "is not known as a unit",
            "write the unit of its values, e.g. mm/s, degC, kW or 1; or leave it if it is one",
            fatal=False,
            code=UNIT_UNKNOWN,
        )


def check_probe_angles(draft: MachineFile) -> Iterator[Finding]:
    """The only two probes of a machine do not look along one line; those of a rotor have their own check."""
    probes = [
        (index, sensor, sensor.angle_deg)
        for index, sensor in enumerate(draft.sensors)
        if isinstance(sensor, ProximityProbe) and sensor.angle_deg is not None
    ]
    if len(probes) != 2:
        return
    (_, first, one_deg), (index, second, other_deg) = probes
    if _of_a_rotor(draft, first.name) or _of_a_rotor(draft, second.name):
        return
    apart_deg = abs(math.degrees(math.asin(math.sin(math.radians(other_deg - one_deg)))))
    if apart_deg < _ALONG_ONE_LINE_DEG:
        yield Finding(
            ("sensors", index, "angle_deg"),
            f'points along one line with "{first.name}" ({one_deg:g} deg): the two see one direction of the '
            "motion only",
            "correct it, unless the two probes are at different bearings",
            fatal=False,
            code=PROBES_IN_LINE,
        )


def check_reach(
    draft: MachineFile, sensor: Sensor, facts: Mapping[str, Any], at: KeyPath
) -> Iterator[Finding]:
    """The limits of a sensor lie within what its channel can carry."""
    wire = wire_range(draft, sensor, facts)
    if wire is None:
        return
    low, high = wire.low, wire.high
    remedy = "correct it, or the scale of the channel"
    volts = sensor.sensitivity_mv_per_unit is not None and not isinstance(sensor, Keyphasor)
    if volts and wire.step >= _COARSE_V:
        yield Finding(
            (*at, "channel"),
            f"is taken in volts, and one count of it would be {wire.step:g} V",
            f"write scale = {wire.step / 1000:g} in the layout if the device counts mV",
            code=WRONG_SCALE,
        )
    if isinstance(sensor, ProximityProbe) and sensor.sensitivity_mv_per_unit is not None:
        limits = sensor.gap_ok_v
        if limits is not None and (limits[1] < low or high < limits[0]):
            yield Finding(
                (*at, "gap_ok_v"),
                f"is never met: the channel carries {low:g} to {high:g} V",
                remedy,
                code=BEYOND_CHANNEL,
            )
        elif not low <= sensor.zero_v <= high:
            yield Finding(
                (*at, "zero_v"),
                f"is never measured: the channel carries {low:g} to {high:g} V",
                remedy,
                code=BEYOND_CHANNEL,
            )
    elif isinstance(sensor, TrendValue) and sensor.ok_between is not None:
        least, largest = _in_units(sensor, wire)
        if sensor.ok_between[1] < least or largest < sensor.ok_between[0]:
            yield Finding(
                (*at, "ok_between"),
                f"is never met: the channel carries {least:g} to {largest:g}{unit_behind(sensor.unit)}",
                remedy,
                code=BEYOND_CHANNEL,
            )
    elif isinstance(sensor, Keyphasor):
        least, largest = _in_units(sensor, wire)
        if not least < sensor.threshold_v < largest:
            yield Finding(
                (*at, "threshold_v"),
                f"is never crossed: the channel carries {least:g} to {largest:g} V",
                remedy,
                code=BEYOND_CHANNEL,
            )


def _in_units(sensor: Sensor, wire: WireRange) -> tuple[float, float]:
    """What the channel can carry, in the unit of the sensor."""
    a, b = (end * sensor.gain + sensor.shift for end in (wire.low, wire.high))
    return min(a, b), max(a, b)


def check_alarm_reach(draft: MachineFile, facts: Mapping[str, Any]) -> Iterator[Finding]:
    """Setpoints lie within what the channels can carry."""
    sensors = {sensor.name: sensor for sensor in draft.sensors}
    for index, alarm in enumerate(draft.alarms):
        with suppress(UnusableValueError):
            if not isinstance(alarm, SetpointAlarm):
                continue
            for name in alarm.watched:
                with suppress(UnusableValueError):
                    sensor = sensors.get(name)
                    reach = None if sensor is None else _reach(draft, sensor, facts, alarm.measure)
                    if sensor is None or reach is None:
                        continue
                    for key, value in alarm.setpoints.items():
                        if not reach[0] <= value <= reach[1]:
                            unit = "V" if alarm.measure == "gap_voltage" else sensor.unit
                            yield Finding(
                                ("alarms", index, key),
                                f'is never reached: the channel of "{name}" carries {_range(reach, unit)}',
                                "correct it, or scale and sensitivity of the channel and its sensor",
                                code=NEVER_REACHED,
                            )


def check_room_above(draft: MachineFile, facts: Mapping[str, Any]) -> Iterator[Finding]:
    """A vibration is still believed where the machine is at its worst.

    Temperatures and pressures seldom go far beyond danger, and many of their sensors end there.
    """
    for index, sensor in enumerate(draft.sensors):
        with suppress(UnusableValueError):
            if not isinstance(sensor, TrendValue) or sensor.ok_between is None:
                continue
            low, high = sensor.ok_between
            setpoints = [one for one in _upper_setpoints(draft, sensor) if 0 < one[0] <= high]
            # Beside 0 a position of the shaft has limits on both sides, as the machine has.
            if not setpoints or not is_of_vibration(sensor.unit) or low < -high / 2:
                continue
            highest, key, alarm = max(setpoints)
            wire = wire_range(draft, sensor, facts)
            if high >= _TIMES_SETPOINT * highest or (
                wire is not None and high >= _WHOLE_CHANNEL * _in_units(sensor, wire)[1]
            ):
                continue
            unit = unit_behind(sensor.unit)
            yield Finding(
                ("sensors", index, "ok_between"),
                f'ends just above {key} = {highest:g} of alarm "{alarm}". If the machine vibrates more than '
                f"{high:g}{unit}, the sensor counts as broken, and the alarm is suppressed",
                "ok_between is for what the sensor cannot measure, e.g. with a broken wire: end it at "
                f"{rounded_up(_TIMES_SETPOINT * highest, 2)}{unit} or more",
                fatal=False,
                code=OK_LIMITS_TOO_NEAR,
            )


def _upper_setpoints(draft: MachineFile, sensor: Sensor) -> Iterator[tuple[float, str, str]]:
    """Value, key and alarm of the upper setpoints of a sensor, also of those that zones represent."""
    with suppress(UnusableValueError):
        for alarm in draft.alarms:
            with suppress(UnusableValueError):
                if isinstance(alarm, SetpointAlarm) and sensor.name in alarm.watched:
                    for key in ("alert", "danger"):
                        if key in alarm.setpoints:
                            yield alarm.setpoints[key], key, alarm.name


def _range(reach: tuple[float, float], unit: str) -> str:
    return (
        f"{reach[1]:.4g}{unit_behind(unit)} at most"
        if math.isinf(reach[0])
        else f"{reach[0]:.4g} to {reach[1]:.4g}{unit_behind(unit)}"
    )


def _reach(
    draft: MachineFile, sensor: Sensor, facts: Mapping[str, Any], measure: str
) -> tuple[float, float] | None:
    """Least and largest value that a measure of a sensor can have; None if that is not known."""
    wire = wire_range(draft, sensor, facts)
    if wire is None:
        return None
    if measure == "gap_voltage":
        return wire.low, wire.high
    low, high = _in_units(sensor, wire)
    if measure == "value":
        return low, high
    # From the mean to the farthest sample, where the mean may lie at one end.
    ranged = {"rms", "peak", "peak_to_peak", *NOT_1X}
    return (-math.inf, high - low) if measure in ranged else None


def check_value_names(draft: MachineFile, sensor: Sensor, facts: Mapping[str, Any]) -> Iterator[Finding]:
    """Whether the layout can be asked for the names of values: else it would fail when the service starts."""
    draft.value_names_of(sensor, facts)
    yield from ()


def wire_range(draft: MachineFile, sensor: Sensor, facts: Mapping[str, Any]) -> WireRange | None:
    """What the channel of a sensor can carry; None of a float or a text, and where it is not known.

    Args:
        draft: the machine file, or what is valid of it.
        sensor: one of its sensors.
        facts: by stream, what was read from the files that its layout names.
    """
    stream = draft.streams.get(sensor.stream)
    return None if stream is None else stream.layout.wire_range(sensor.channel, facts.get(sensor.stream))
