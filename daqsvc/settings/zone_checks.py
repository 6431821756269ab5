"""Whether the zones of an alarm are those of what it watches, and the limits that they represent."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from daqsvc.errors.alarms import UNFIT_ZONES
from daqsvc.settings.alarms import SetpointAlarm
from daqsvc.settings.measures import UNITS, VELOCITIES
from daqsvc.settings.problems import Finding
from daqsvc.settings.section import UnusableValueError
from daqsvc.settings.sensors import ProximityProbe, TrendValue
from daqsvc.settings.units import is_of_peak, same_unit
from daqsvc.settings.zones import boundaries

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.settings.alarms import Alarm
    from daqsvc.settings.models import MachineFile, Sensor
    from daqsvc.settings.problems import KeyPath
    from daqsvc.settings.zones import Zones


def with_zones(machine: MachineFile) -> MachineFile:
    """The machine file with the limits that zones represent; those that it states itself win.

    Args:
        machine: the machine file, or what is valid of it.
    """
    with suppress(UnusableValueError):
        filled = tuple(_filled(machine, alarm) for alarm in machine.alarms)
        if any(new is not old for new, old in zip(filled, machine.alarms, strict=True)):
            return machine.model_copy(update={"alarms": filled})
    return machine


def _filled(machine: MachineFile, alarm: Alarm) -> Alarm:
    with suppress(UnusableValueError):
        if (
            isinstance(alarm, SetpointAlarm)
            and alarm.zones is not None
            and not any(zone_checks(machine, alarm, ()))
        ):
            sensors = [sensor for sensor in machine.sensors if sensor.name in alarm.watched]
            units = {UNITS.get(alarm.measure, sensor.unit) for sensor in sensors}
            at = boundaries(alarm.zones, machine.machine.speed_rpm, units.pop()) if len(units) == 1 else None
            return alarm if at is None else alarm.in_zones(at)
    return alarm


def zone_checks(draft: MachineFile, alarm: SetpointAlarm, at: KeyPath) -> Iterator[Finding]:
    """Whether the zones go with what the alarm watches, one finding at most.

    Args:
        draft: the machine file, or what is valid of it.
        alarm: one of its alarms.
        at: where that stands.
    """
    if alarm.zones is None:
        return
    here = (*at, "zones")
    watched = [sensor for sensor in draft.sensors if sensor.name in alarm.watched]
    check = _of_shaft if alarm.zones.shaft else _of_housing
    yield from check(alarm, alarm.zones, watched, here)


def _of_shaft(alarm: SetpointAlarm, zones: Zones, watched: list[Sensor], here: KeyPath) -> Iterator[Finding]:
    stranger = next((one for one in watched if not isinstance(one, ProximityProbe)), None)
    if zones.group is not None or zones.support is not None:
        key = "group" if zones.group is not None else "support"
        yield Finding(
            (*here, key),
            "has no effect on the shaft, whose zones follow from machine.speed_rpm alone",
            "remove it, or shaft = true for the zones of the velocity",
            code=UNFIT_ZONES,
        )
    elif stranger is not None:
        yield Finding(
            (*here, "shaft"),
            f'needs proximity probes, but "{stranger.name}" is {stranger.kind}',
            'write group and support in place of it, with measure = "velocity_rms"',
            code=UNFIT_ZONES,
        )
    elif alarm.measure != "peak_to_peak":
        yield Finding(
            (*here, "shaft"),
            f"are zones of the displacement from peak to peak, not of {alarm.measure}",
            'write measure = "peak_to_peak", or setpoints in place of zones',
            code=UNFIT_ZONES,
        )


def _of_housing(
    alarm: SetpointAlarm, zones: Zones, watched: list[Sensor], here: KeyPath
) -> Iterator[Finding]:
    probes = [sensor for sensor in watched if isinstance(sensor, ProximityProbe)]
    others = [one for one in watched if isinstance(one, TrendValue) and one.unit != "mm/s"]
    if probes and alarm.measure == "peak_to_peak":
        yield Finding(
            here,
            f'are those of the velocity of a housing, but "{probes[0].name}" is {probes[0].kind}',
            'write zones = { standard = "iso-20816-3", shaft = true }',
            code=UNFIT_ZONES,
        )
    elif alarm.measure not in VELOCITIES and not (alarm.measure == "value" and watched and not others):
        what = f'"{others[0].name}" is in {others[0].unit}' if others else f"{alarm.measure} is none"
        yield Finding(
            here,
            f"are those of a velocity in mm/s, but {what}",
            _remedy(others[0] if others else None),
            code=UNFIT_ZONES,
        )
    elif zones.group is None or zones.support is None:
        lacks = [key for key in ("group", "support") if getattr(zones, key) is None]
        yield Finding(
            here,
            f"lack {' and '.join(lacks)}: the zones of the velocity differ with the class of machine",
            'write e.g. { standard = "iso-20816-3", group = 2, support = "rigid" }, or shaft = true with '
            "proximity probes",
            code=UNFIT_ZONES,
        )


def _remedy(other: TrendValue | None) -> str:
    if other is None:
        return 'write measure = "velocity_rms", or setpoints in place of zones'
    if same_unit(other.unit, "mm/s") and not is_of_peak(other.unit):
        return f'write unit = "mm/s" for "{other.name}"'
    return "give it its own alarm, with setpoints in place of zones"
