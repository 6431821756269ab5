"""Whether the setpoints of a machine file can be reached and left, by sensors that have the measure."""

from __future__ import annotations

from contextlib import suppress
from itertools import pairwise
from typing import TYPE_CHECKING

from daqsvc.settings.alarms import LevelAlarm
from daqsvc.settings.plugins import configured, detector_tables
from daqsvc.settings.problems import Finding, choice
from daqsvc.settings.section import UnusableValueError
from daqsvc.settings.sensors import ProximityProbe, TrendValue

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.settings.alarms import SetpointAlarm
    from daqsvc.settings.models import MachineFile, Sensor
    from daqsvc.settings.problems import KeyPath

_TWO_SIDED = ("value", "gap_voltage")
"""Measures that can be too low; what is left is a size, and never negative."""
_UPPER = ("alert", "danger")


def setpoint_checks(draft: MachineFile, alarm: SetpointAlarm, at: KeyPath) -> Iterator[Iterator[Finding]]:
    """Every check of an alarm that has setpoints.

    Args:
        draft: the machine file, or what is valid of it.
        alarm: one of its alarms.
        at: where that stands.
    """
    yield _setpoints(alarm, at)
    yield _deadband(alarm, at)
    yield _sensors(draft, alarm, at)
    yield _believed(draft, alarm, at)
    yield _measured(draft, alarm, at)
    yield _trip_multiply(draft, alarm, at)


def _setpoints(alarm: SetpointAlarm, at: KeyPath) -> Iterator[Finding]:
    setpoints = alarm.setpoints
    if not setpoints:
        yield Finding(at, "has neither alert nor danger", "add alert, danger or both")
    for (key, value), (above, higher) in pairwise(setpoints.items()):
        if value >= higher:
            yield Finding(
                (*at, key),
                f"must be below {above} = {higher:g}",
                "correct one of the two" if value == higher else "swap the two, or correct one of them",
            )
    if alarm.measure in _TWO_SIDED:
        return
    for key, value in setpoints.items():
        if key not in _UPPER:
            yield Finding(
                (*at, key),
                f"does not go with {alarm.measure}: only {' and '.join(_TWO_SIDED)} have lower setpoints",
                "remove it",
            )
        elif value <= 0:
            yield Finding(
                (*at, key),
                f"must be greater than 0: {alarm.measure} is never less",
                "write a positive setpoint",
            )


def _deadband(alarm: SetpointAlarm, at: KeyPath) -> Iterator[Finding]:
    upper = [(value, key) for key, value in alarm.setpoints.items() if key in _UPPER]
    lower = [(value, key) for key, value in alarm.setpoints.items() if key not in _UPPER]
    if alarm.measure not in _TWO_SIDED:
        if upper and 0 < min(upper)[0] <= alarm.deadband:
            yield _never_returns(at, f"the setpoint {min(upper)[0]:g}", min(upper)[0])
    elif upper and lower:
        (highest, low_key), (lowest, key) = max(lower), min(upper)
        if 0 < lowest - highest <= alarm.deadband:
            between = lowest - highest
            yield _never_returns(at, f"the {between:g} between {low_key} and {key}", between)


def _never_returns(at: KeyPath, than: str, room: float) -> Finding:
    return Finding(
        (*at, "deadband"),
        f"must be smaller than {than}, or the alarm never returns",
        f"write e.g. deadband = {room / 20:.3g}",
    )


def _sensors(draft: MachineFile, alarm: SetpointAlarm, at: KeyPath) -> Iterator[Finding]:
    sensors = _named(draft)
    for position, name in enumerate(alarm.watched):
        here = (*at, "sensor") if isinstance(alarm, LevelAlarm) else (*at, "sensors", position)
        if name not in sensors:
            yield Finding(here, "there is no such sensor", choice(name, sensors))
        elif sensors[name].type == "keyphasor":
            vibration = [other for other, described in sensors.items() if described.type != "keyphasor"]
            yield Finding(here, "is a keyphasor, which measures no vibration", choice(name, vibration))
        else:
            yield from _measure(alarm, sensors[name], at)


def _measure(alarm: SetpointAlarm, sensor: Sensor, at: KeyPath) -> Iterator[Finding]:
    """Whether the sensor has the measure that the alarm is about."""
    measure, here = alarm.measure, (*at, "measure")
    if isinstance(sensor, TrendValue):
        if measure != "value":
            yield Finding(
                here,
                f'needs a waveform, but "{sensor.name}" is a trend value, a level that the device measures',
                f'write measure = "value", with setpoints in {sensor.unit}',
            )
        return
    if measure == "peak" and isinstance(sensor, ProximityProbe):
        yield Finding(
            here,
            "is from the mean to the farthest point; the limits of shaft vibration in ISO 20816 and API 670 "
            "are peak to peak, about twice that",
            'write measure = "peak_to_peak", with setpoints from peak to peak',
            fatal=False,
        )
    instead = f'write measure = "rms" or "peak", with setpoints in {sensor.unit}'
    if measure == "value":
        yield Finding(
            here,
            f'needs a trend value, but "{sensor.name}" is {sensor.kind}, of which waveforms are expected',
            f'{instead}, or type = "trend" if the device sends a level of it',
        )
    elif measure == "gap_voltage" and not isinstance(sensor, ProximityProbe):
        yield Finding(here, f'needs a proximity probe, but "{sensor.name}" is {sensor.kind}', instead)
    elif measure == "gap_voltage" and sensor.sensitivity_mv_per_unit is None:
        yield Finding(
            here,
            f'is not known: "{sensor.name}" has no sensitivity_mv_per_unit',
            f"add sensitivity_mv_per_unit and zero_v to the sensor, or {instead}",
        )
    elif measure == "velocity_rms" and isinstance(sensor, ProximityProbe):
        yield Finding(
            here,
            f'needs an accelerometer or a velocity sensor, but "{sensor.name}" is a proximity probe',
            instead,
        )


def _believed(draft: MachineFile, alarm: SetpointAlarm, at: KeyPath) -> Iterator[Finding]:
    """Whether the setpoints can be reached, and left, while the sensors are believed."""
    if alarm.measure not in _TWO_SIDED:
        return
    sensors = _named(draft)
    for name in alarm.watched:
        sensor = sensors.get(name)
        key, limits = _ok_limits(sensor)
        if limits is None:
            continue
        said = f'the OK limits {limits[0]:g} to {limits[1]:g} of "{name}"'
        for setpoint, value in alarm.setpoints.items():
            if not limits[0] <= value <= limits[1]:
                yield Finding(
                    (*at, setpoint),
                    f"is never reached: it lies outside {said}, where that is not believed",
                    f"correct it, or {key} of the sensor",
                )
            room = value - limits[0] if setpoint in _UPPER else limits[1] - value
            if 0 < room <= alarm.deadband:
                yield _never_returns(at, f"the {room:g} that {said} leave beside {setpoint}", room)
                return


def _ok_limits(sensor: Sensor | None) -> tuple[str, tuple[float, float] | None]:
    if isinstance(sensor, TrendValue):
        return "ok_between", sensor.ok_between
    return "gap_ok_v", sensor.gap_ok_v if isinstance(sensor, ProximityProbe) else None


def _measured(draft: MachineFile, alarm: SetpointAlarm, at: KeyPath) -> Iterator[Finding]:
    with suppress(UnusableValueError):
        if not set(alarm.watched) <= set(_named(draft)):
            return  # said already, about the same key
    if not any(plugin.measures_levels for _, plugin, _ in configured(draft.pipeline)):
        tables = (f"[pipeline.{key}]" for key, plugin in detector_tables().items() if plugin.measures_levels)
        one = isinstance(alarm, LevelAlarm)
        yield Finding(
            (*at, "sensor" if one else "sensors"),
            "nothing measures its level" if one else "nothing measures their levels",
            f"write a table {' or '.join(tables)} (it may be empty), or remove the alarm",
        )


def _trip_multiply(draft: MachineFile, alarm: SetpointAlarm, at: KeyPath) -> Iterator[Finding]:
    if alarm.trip_multiply <= 1:
        return
    here = (*at, "trip_multiply")
    if draft.alarm_handling.start_up is None:
        yield Finding(
            here,
            "never holds: nothing says when the machine starts up",
            "write a table [alarm_handling.start_up], or remove it",
        )
    upper = [value for key, value in alarm.setpoints.items() if key in _UPPER]
    if alarm.measure in _TWO_SIDED and min(upper, default=0.0) <= 0:
        yield Finding(here, "multiplies alert and danger, which must be greater than 0 for that", "remove it")


def _named(draft: MachineFile) -> dict[str, Sensor]:
    return {sensor.name: sensor for sensor in draft.sensors}
