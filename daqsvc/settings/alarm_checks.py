"""Whether the alarms of a machine file can be judged, raised and returned as they stand."""

from __future__ import annotations

import math
from contextlib import suppress
from itertools import pairwise
from typing import TYPE_CHECKING

from daqsvc.errors.alarms import (
    ALWAYS_STARTING,
    DEADBAND,
    NEVER_REACHED,
    NO_REFERENCE,
    NO_SETPOINT,
    NOT_MEASURED,
    NOT_OF_STANDARD,
    RESERVED_NAME,
    SETPOINT_ORDER,
    SILENT_DETECTOR,
    TRIP_MULTIPLY,
    UNFIT_MEASURE,
    UNFIT_SETPOINT,
    VOTE,
)
from daqsvc.errors.machine_file import (
    INCOMPLETE,
    NO_EFFECT,
    NO_SUCH_NAME,
    SPEED_UNKNOWN,
    WRONG_ORDER,
    WRONG_SENSOR_TYPE,
)
from daqsvc.settings.alarms import DiagnosisAlarm, LevelAlarm, SetpointAlarm, VotingAlarm
from daqsvc.settings.measures import AMPLITUDES, PHASES, UNITS, VELOCITIES
from daqsvc.settings.plugins import configured, detector_tables
from daqsvc.settings.problems import Finding, choice
from daqsvc.settings.section import UnusableValueError
from daqsvc.settings.sensors import ProximityProbe, TrendValue
from daqsvc.settings.zone_checks import zone_checks

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.settings.alarms import StartUp
    from daqsvc.settings.models import MachineFile, Sensor
    from daqsvc.settings.problems import KeyPath


_TAKEN = ("alarm-flood", "trip-multiply")
"""Alarms that the service raises itself."""
_START_UP: KeyPath = ("alarm_handling", "start_up")


def alarm_checks(draft: MachineFile) -> Iterator[Iterator[Finding]]:
    """Every check of the alarms.

    Args:
        draft: the machine file, or what is valid of it.
    """
    with suppress(UnusableValueError):
        for index, alarm in enumerate(draft.alarms):
            at: KeyPath = ("alarms", index)
            yield _name(alarm.name, at)
            if isinstance(alarm, SetpointAlarm):
                yield from _setpoint_checks(draft, alarm, at)
            if isinstance(alarm, VotingAlarm):
                yield _vote(draft, alarm, at)
            if isinstance(alarm, DiagnosisAlarm):
                yield _detector(draft, alarm, at)
    with suppress(UnusableValueError):
        if draft.alarm_handling.start_up is not None:
            yield _start_up(draft, draft.alarm_handling.start_up)


def _name(name: str, at: KeyPath) -> Iterator[Finding]:
    if name in _TAKEN:
        yield Finding(
            (*at, "name"),
            "is an alarm that the service raises itself",
            "give this one another name",
            code=RESERVED_NAME,
        )


def _vote(draft: MachineFile, alarm: VotingAlarm, at: KeyPath) -> Iterator[Finding]:
    count = len(alarm.sensors)
    if alarm.vote > count:
        yield Finding(
            (*at, "vote"),
            f"cannot be reached by {count} sensors",
            f"write vote = {count} or less, or add sensors",
            code=VOTE,
        )
    for position, name in enumerate(alarm.sensors):
        if name in alarm.sensors[:position]:
            yield Finding((*at, "sensors", position), "votes twice", "name each sensor once", code=VOTE)
    if alarm.measure in UNITS:
        return
    units = {s.unit for s in draft.sensors if s.name in alarm.sensors and s.type != "keyphasor"}
    if len(units) > 1:
        yield Finding(
            (*at, "sensors"),
            f"one setpoint for sensors in {' and '.join(sorted(units))}",
            "let only sensors of one unit vote together",
            code=VOTE,
        )


def _detector(draft: MachineFile, alarm: DiagnosisAlarm, at: KeyPath) -> Iterator[Finding]:
    """The detector that an alarm follows is there and can raise it."""
    keys = {plugin.detector: key for key, plugin in detector_tables().items() if plugin.detector is not None}
    if alarm.detector not in keys:
        yield Finding(
            (*at, "detector"), "there is no such detector", choice(alarm.detector, keys), code=NO_SUCH_NAME
        )
        return
    key = keys[alarm.detector]
    settings = getattr(draft.pipeline, key)
    if settings is None:
        yield Finding(
            (*at, "detector"),
            "this detector is not configured",
            f"write a table [pipeline.{key}], or remove the alarm",
            code=SILENT_DETECTOR,
        )
        return
    yield from detector_tables()[key].alarm_checks(settings, at)


def _start_up(draft: MachineFile, start_up: StartUp) -> Iterator[Finding]:
    if start_up.between is None and start_up.change_per_s is None:
        yield Finding(
            _START_UP, "has neither between nor change_per_s", "add one of the two, or both", code=INCOMPLETE
        )
    if start_up.between is not None and not start_up.between[0] < start_up.between[1]:
        yield Finding((*_START_UP, "between"), "is no range", "write the lower end first", code=WRONG_ORDER)
    yield from _never_up(draft, start_up)
    yield from _start_up_signal(draft, start_up)
    if not any(isinstance(alarm, SetpointAlarm) and alarm.trip_multiply > 1 for alarm in draft.alarms):
        yield Finding(
            _START_UP,
            "has no effect: no alarm has a trip_multiply",
            "write e.g. trip_multiply = 2.0 in an alarm on a level, or remove it",
            fatal=False,
            code=NO_EFFECT,
        )


def _never_up(draft: MachineFile, start_up: StartUp) -> Iterator[Finding]:
    """A machine at its nominal speed has started up."""
    speed_rpm = abs(draft.machine.speed_rpm)
    if start_up.between is None or start_up.measure != "speed":
        return
    low, high = start_up.between
    if low <= speed_rpm <= high:
        yield Finding(
            (*_START_UP, "between"),
            f"holds machine.speed_rpm, {speed_rpm:g} rpm: the machine would always be starting up",
            f"end it below {speed_rpm:g}, e.g. between = [{0.1 * speed_rpm:g}, {0.9 * speed_rpm:g}]",
            code=ALWAYS_STARTING,
        )


def _start_up_signal(draft: MachineFile, start_up: StartUp) -> Iterator[Finding]:
    signals: dict[str, tuple[str, ...]] = {}
    for _, plugin, settings in configured(draft.pipeline):
        signals |= plugin.start_up_signals(draft, settings)
    if not signals:
        tables = [f"[pipeline.{key}]" for key, plugin in detector_tables().items() if plugin.states_speed]
        yield Finding(
            (*_START_UP, "detector"),
            "no detector of this machine states a speed",
            f"write a table {' or '.join(tables)}, take a trend value that is the speed, or remove "
            "[alarm_handling.start_up] and every trip_multiply",
            code=SPEED_UNKNOWN,
        )
    elif start_up.detector not in signals:
        there = (
            start_up.detector in draft.detectors or start_up.detector.partition("/")[0] in detector_tables()
        )
        yield Finding(
            (*_START_UP, "detector"),
            "states no speed while the machine starts up"
            if there
            else "there is no such detector in [pipeline]",
            choice(start_up.detector, list(signals)),
            code=NO_SUCH_NAME,
        )
    elif start_up.measure not in signals[start_up.detector]:
        yield Finding(
            (*_START_UP, "measure"),
            f"is nothing that {start_up.detector} states while the machine starts up",
            choice(start_up.measure, signals[start_up.detector]),
            code=NO_SUCH_NAME,
        )


_TWO_SIDED = ("value", "gap_voltage")
"""Measures that can be too low, and negative."""
_SIZES_THAT_FADE = AMPLITUDES
"""Measures that are never negative, and can be too low all the same: 1X that fades is a change, too."""
_LEAST = {"crest_factor": 1.0, "kurtosis": 1.0}
"""What measures of any waveform are at least, where that is more than 0."""
_FROM_PEAK_TO_PEAK = 'write measure = "peak_to_peak", with setpoints from peak to peak'
"""As the standards of shaft vibration have it: a limit of theirs for another measure is far too high."""
_UPPER = ("alert", "danger")
_HALF_A_TURN_DEG = 180.0


def _setpoint_checks(draft: MachineFile, alarm: SetpointAlarm, at: KeyPath) -> Iterator[Iterator[Finding]]:
    """Every check of an alarm that has setpoints.

    Args:
        draft: the machine file, or what is valid of it.
        alarm: one of its alarms.
        at: where that stands.
    """
    yield zone_checks(draft, alarm, at)
    yield _setpoints(alarm, at)
    yield _phase_alone(alarm, at)
    if isinstance(alarm, LevelAlarm):
        yield _phase_limits(alarm, at)
    yield _deadband(alarm, at)
    yield _sensors(draft, alarm, at)
    yield _believed(draft, alarm, at)
    yield _believed_at_start_up(draft, alarm, at)
    yield _measured(draft, alarm, at)
    yield _trip_multiply(draft, alarm, at)


def _setpoints(alarm: SetpointAlarm, at: KeyPath) -> Iterator[Finding]:
    setpoints = alarm.setpoints
    if not setpoints and alarm.zones is None:
        yield Finding(at, "has neither alert nor danger", "add alert, danger or both", code=NO_SETPOINT)
    for (key, value), (above, higher) in pairwise(setpoints.items()):
        if value >= higher and alarm.boundaries is not None and value in alarm.boundaries:
            yield Finding(
                (*at, above),
                f"must be above {key} = {value:g}, where zone C begins",
                f"write {key} as well, or leave {above} to the zones",
                code=SETPOINT_ORDER,
            )
        elif value >= higher and alarm.boundaries is not None and higher in alarm.boundaries:
            yield Finding(
                (*at, key),
                f"must be below {above} = {higher:g}, where zone D begins",
                f"write {above} as well, or leave {key} to the zones",
                code=SETPOINT_ORDER,
            )
        elif value >= higher:
            yield Finding(
                (*at, key),
                f"must be below {above} = {higher:g}",
                "correct one of the two" if value == higher else "swap the two, or correct one of them",
                code=SETPOINT_ORDER,
            )
    if alarm.measure in _TWO_SIDED:
        return
    for key, value in setpoints.items():
        if key not in _UPPER and alarm.measure not in _SIZES_THAT_FADE:
            lower = [*_TWO_SIDED, *_SIZES_THAT_FADE]
            yield Finding(
                (*at, key),
                f"does not go with {alarm.measure}: only {', '.join(lower[:-1])} and {lower[-1]} have lower "
                "setpoints",
                "remove it",
                code=UNFIT_SETPOINT,
            )
        elif value <= (least := _LEAST.get(alarm.measure, 0.0)):
            yield Finding(
                (*at, key),
                f"must be greater than {least:g}: {alarm.measure} is never less",
                f"write a setpoint above {least:g}" if least else "write a positive setpoint",
                code=UNFIT_SETPOINT,
            )


def _phase_alone(alarm: SetpointAlarm, at: KeyPath) -> Iterator[Finding]:
    """A phase is compared with a reference, and nothing else is."""
    if alarm.measure not in PHASES:
        if alarm.reference_deg is not None:
            remedy = (
                "write phase = { reference_deg = .., alert = .. } for the phase beside the amplitude"
                if alarm.measure in AMPLITUDES
                else "remove it"
            )
            yield Finding(
                (*at, "reference_deg"),
                f"goes with a phase, not with {alarm.measure}",
                remedy,
                code=UNFIT_SETPOINT,
            )
        return
    if alarm.reference_deg is None:
        yield Finding(
            at,
            f"does not state from where {alarm.measure} counts: its setpoints are how far it may be from a "
            "reference, either way",
            "add reference_deg, the phase of the machine in good order, e.g. reference_deg = 135.0",
            code=NO_REFERENCE,
        )
    for key, value in alarm.setpoints.items():
        if key in _UPPER and value > _HALF_A_TURN_DEG:
            yield Finding(
                (*at, key),
                "is never reached: no phase is farther than 180 deg from another one",
                "write how far it may be from reference_deg either way, e.g. 30.0",
                code=NEVER_REACHED,
            )


def _phase_limits(alarm: LevelAlarm, at: KeyPath) -> Iterator[Finding]:
    """Limits of the phase beside those of the amplitude."""
    phase, here = alarm.phase, (*at, "phase")
    if phase is None:
        return
    if alarm.measure not in AMPLITUDES:
        yield Finding(
            here,
            f"goes with an amplitude, not with {alarm.measure}",
            f"write measure = {' or '.join(map(repr, AMPLITUDES))}, or remove it".replace("'", '"'),
            code=UNFIT_SETPOINT,
        )
        return
    limits = [limit for limit in (phase.alert, phase.danger) if limit is not None]
    if not limits:
        yield Finding(
            here, "has neither alert nor danger", "add alert, danger or both, in degrees", code=NO_SETPOINT
        )
    elif phase.alert is not None and phase.danger is not None and phase.alert >= phase.danger:
        yield Finding(
            (*here, "alert"),
            f"must be below danger = {phase.danger:g}",
            "correct one of the two" if phase.alert == phase.danger else "swap the two, or correct one",
            code=SETPOINT_ORDER,
        )
    if limits and phase.deadband >= min(limits):
        yield Finding(
            (*here, "deadband"),
            f"must be smaller than the setpoint {min(limits):g}, or the alarm never returns",
            f"write e.g. deadband = {min(limits) / 20:.3g}",
            code=DEADBAND,
        )


def _deadband(alarm: SetpointAlarm, at: KeyPath) -> Iterator[Finding]:
    upper = [(value, key) for key, value in alarm.setpoints.items() if key in _UPPER]
    lower = [(value, key) for key, value in alarm.setpoints.items() if key not in _UPPER]
    if upper and alarm.measure not in _TWO_SIDED and 0 < min(upper)[0] <= alarm.deadband:
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
        code=DEADBAND,
    )


def _sensors(draft: MachineFile, alarm: SetpointAlarm, at: KeyPath) -> Iterator[Finding]:
    sensors = _named(draft)
    for position, name in enumerate(alarm.watched):
        here = (*at, "sensor") if isinstance(alarm, LevelAlarm) else (*at, "sensors", position)
        if name not in sensors:
            yield Finding(here, "there is no such sensor", choice(name, sensors), code=NO_SUCH_NAME)
        elif sensors[name].type == "keyphasor":
            vibration = [other for other, described in sensors.items() if described.type != "keyphasor"]
            yield Finding(
                here,
                "is a keyphasor, which measures no vibration",
                choice(name, vibration),
                code=WRONG_SENSOR_TYPE,
            )
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
                code=UNFIT_MEASURE,
            )
        return
    if measure == "peak" and isinstance(sensor, ProximityProbe):
        yield Finding(
            here,
            "is from the mean to the farthest point; the limits of shaft vibration in ISO 20816 and API 670 "
            "are peak to peak, about twice that",
            _FROM_PEAK_TO_PEAK,
            fatal=False,
            code=NOT_OF_STANDARD,
        )
    instead = (
        _FROM_PEAK_TO_PEAK
        if isinstance(sensor, ProximityProbe)
        else f'write measure = "rms" or "peak", with setpoints in {sensor.unit}'
    )
    if measure == "value":
        yield Finding(
            here,
            f'needs a trend value, but "{sensor.name}" is {sensor.kind}, of which waveforms are expected',
            f'{instead}, or type = "trend" if the device sends a level of it',
            code=UNFIT_MEASURE,
        )
    elif measure == "gap_voltage" and not isinstance(sensor, ProximityProbe):
        yield Finding(
            here,
            f'needs a proximity probe, but "{sensor.name}" is {sensor.kind}',
            instead,
            code=UNFIT_MEASURE,
        )
    elif measure == "gap_voltage" and sensor.sensitivity_mv_per_unit is None:
        yield Finding(
            here,
            f'is not known: "{sensor.name}" has no sensitivity_mv_per_unit',
            f"add sensitivity_mv_per_unit and zero_v to the sensor, or {instead}",
            code=UNFIT_MEASURE,
        )
    elif measure in VELOCITIES and isinstance(sensor, ProximityProbe):
        yield Finding(
            here,
            f'needs an accelerometer or a velocity sensor, but "{sensor.name}" is a proximity probe',
            instead,
            code=UNFIT_MEASURE,
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
        limits_text = f'the OK limits {limits[0]:g} to {limits[1]:g} of "{name}"'
        for setpoint, value in alarm.setpoints.items():
            if not limits[0] <= value <= limits[1]:
                yield Finding(
                    (*at, setpoint),
                    f"is never reached: it lies outside {limits_text}, where that is not believed",
                    f"correct it, or {key} of the sensor",
                    code=NEVER_REACHED,
                )
            room = value - limits[0] if setpoint in _UPPER else limits[1] - value
            if 0 < room <= alarm.deadband:
                yield _never_returns(at, f"the {room:g} that {limits_text} leave beside {setpoint}", room)
                return


def _believed_at_start_up(draft: MachineFile, alarm: SetpointAlarm, at: KeyPath) -> Iterator[Finding]:
    """Whether the largest setpoint times trip_multiply can be reached while the sensors are believed."""
    upper = {value: key for key, value in alarm.setpoints.items() if key in _UPPER}
    if alarm.measure not in _TWO_SIDED or alarm.trip_multiply <= 1 or min(upper, default=0.0) <= 0:
        return
    largest = max(upper)
    reached = largest * alarm.trip_multiply
    sensors = _named(draft)
    ends = [
        (limits[1], key, name)
        for name in alarm.watched
        for key, limits in (_ok_limits(sensors.get(name)),)
        if limits is not None
    ]
    end, key, name = min(ends, default=(math.inf, "", ""))
    if largest <= end < reached:
        most = math.floor(10.0 * end / largest) / 10.0
        yield Finding(
            (*at, "trip_multiply"),
            f"has {upper[largest]} = {largest:g} wait for {reached:g} at a start-up, which is never reached: "
            f'the OK limits of "{name}" end at {end:g}',
            f"{f'make it at most {most:g}' if most > 1 else 'remove it'}, or have {key} of the sensor end "
            f"beyond {reached:g}",
            code=NEVER_REACHED,
        )


def _ok_limits(sensor: Sensor | None) -> tuple[str, tuple[float, float] | None]:
    if isinstance(sensor, TrendValue):
        return "ok_between", sensor.ok_between
    return "gap_ok_v", sensor.gap_ok_v if isinstance(sensor, ProximityProbe) else None


def _measured(draft: MachineFile, alarm: SetpointAlarm, at: KeyPath) -> Iterator[Finding]:
    with suppress(UnusableValueError):
        if not set(alarm.watched) <= set(_named(draft)):
            return  # reported already, for the same key
    if not any(plugin.measures_levels for _, plugin, _ in configured(draft.pipeline)):
        tables = (f"[pipeline.{key}]" for key, plugin in detector_tables().items() if plugin.measures_levels)
        one = isinstance(alarm, LevelAlarm)
        yield Finding(
            (*at, "sensor" if one else "sensors"),
            "nothing measures its level" if one else "nothing measures their levels",
            f"write a table {' or '.join(tables)} (it may be empty), or remove the alarm",
            code=NOT_MEASURED,
        )


def _trip_multiply(draft: MachineFile, alarm: SetpointAlarm, at: KeyPath) -> Iterator[Finding]:
    if alarm.trip_multiply <= 1:
        return
    here = (*at, "trip_multiply")
    if draft.alarm_handling.start_up is None:
        yield Finding(
            here,
            "never holds: nothing states when the machine starts up",
            "write a table [alarm_handling.start_up], or remove it",
            code=TRIP_MULTIPLY,
        )
    upper = [value for key, value in alarm.setpoints.items() if key in _UPPER]
    if alarm.measure in _TWO_SIDED and min(upper, default=0.0) <= 0:
        yield Finding(
            here,
            "multiplies alert and danger, which must be greater than 0 for that",
            "remove it",
            code=TRIP_MULTIPLY,
        )


def _named(draft: MachineFile) -> dict[str, Sensor]:
    return {sensor.name: sensor for sensor in draft.sensors}
