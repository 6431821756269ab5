"""Whether measures that are made on request can be made: of which sensors, how fast, by which keyphasor."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

from daqsvc.dsp.window_orders import LEAST_SAMPLES_PER_REVOLUTION
from daqsvc.errors.alarms import BAND_WITHOUT_1X, UNFIT_ZONES
from daqsvc.errors.detectors import BAND_TOO_HIGH, NEEDS_KEYPHASOR, WINDOW_TOO_SHORT
from daqsvc.errors.machine_file import (
    NAMED_TWICE,
    NO_EFFECT,
    NO_SUCH_NAME,
    SAMPLED_APART,
    SAMPLED_TOO_SLOWLY,
    WRONG_SENSOR_TYPE,
)
from daqsvc.rounding import rounded_up
from daqsvc.settings.measures import (
    ISO_BAND_HZ,
    OF_THE_SHAFT,
    PHASE_OF,
    PHASES,
    SAMPLES_PER_PERIOD,
    SLOW_BAND_HZ,
    SLOW_RPM,
    SLOW_VELOCITY,
    VELOCITIES,
    VELOCITY,
    highest_hz,
)
from daqsvc.settings.models import LevelAlarm, SetpointAlarm
from daqsvc.settings.problems import Finding, choice
from daqsvc.settings.section import UnusableValueError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.detectors.levels.settings import Levels
    from daqsvc.settings.models import MachineFile, Sensor
    from daqsvc.settings.problems import KeyPath

_LEVELS: KeyPath = ("pipeline", "levels")
_LEAST_REVOLUTIONS = 2.0
"""A window that holds fewer does not tell 1X from what lies beside it."""
_LEAST_PERIODS = 2.0
_SAMPLED = ("proximity", "accelerometer", "velocity")
_CASING = ("accelerometer", "velocity")
_OF_STEADY_PARTS = ("gap_voltage", *OF_THE_SHAFT)
"""Measures that need no samples of a motion, or have their own check of how many a revolution has."""


class _Asked(NamedTuple):
    """A measure that somebody asks for.

    Attributes:
        at: where that stands.
        measure: its name.
        sensors: those of whom it is asked and that can have it.
        alarm: whether an alarm asks.
    """

    at: KeyPath
    measure: str
    sensors: list[Sensor]
    alarm: bool


def measure_checks(draft: MachineFile, levels: Levels) -> Iterator[Iterator[Finding]]:
    """Every check of measures that are made on request.

    Args:
        draft: the machine file, or what is valid of it.
        levels: its level detectors.
    """
    yield _keyphasor(draft, levels)
    yield _revolutions(draft, levels)
    with suppress(UnusableValueError):
        for asked in _all_asked(draft, levels):
            if asked.measure in OF_THE_SHAFT:
                yield _of_the_shaft(draft, levels, asked)
            if asked.measure == SLOW_VELOCITY:
                yield _slow_velocity(draft, levels, asked)
    yield _listed(draft, levels)
    yield _zones(draft, levels)
    yield _speed_in_band(draft, levels)
    yield _speed_in_samples(draft)


def _all_asked(draft: MachineFile, levels: Levels) -> Iterator[_Asked]:
    sampled = {sensor.name: sensor for sensor in draft.sensors if sensor.type in _SAMPLED}
    with suppress(UnusableValueError):
        for index, measure in enumerate(levels.measures):
            having = [one for one in sampled.values() if _has(one, measure)]
            yield _Asked((*_LEVELS, "measures", index), measure, having, alarm=False)
    for index, alarm in enumerate(draft.alarms):
        with suppress(UnusableValueError):
            if not isinstance(alarm, SetpointAlarm):
                continue
            watched = [sampled[name] for name in alarm.watched if name in sampled]
            having = [one for one in watched if _has(one, alarm.measure)]
            yield _Asked(("alarms", index, "measure"), alarm.measure, having, alarm=True)
            if isinstance(alarm, LevelAlarm) and alarm.phase is not None and alarm.measure in PHASE_OF:
                yield _Asked(("alarms", index, "phase"), PHASE_OF[alarm.measure], having, alarm=True)


def _has(sensor: Sensor, measure: str) -> bool:
    return measure not in VELOCITIES or sensor.type in _CASING


def _keyphasor(draft: MachineFile, levels: Levels) -> Iterator[Finding]:
    """The keyphasor is one, its pulses can be seen, and something uses it."""
    name, at = levels.keyphasor, (*_LEVELS, "keyphasor")
    if name is None:
        return
    sensors = {sensor.name: sensor for sensor in draft.sensors}
    if name not in sensors:
        yield Finding(at, "there is no such sensor", choice(name, sensors), code=NO_SUCH_NAME)
        return
    if sensors[name].type != "keyphasor":
        suitable = [sensor.name for sensor in draft.sensors if sensor.type == "keyphasor"]
        yield Finding(
            at, 'must be a sensor of type "keyphasor"', choice(name, suitable), code=WRONG_SENSOR_TYPE
        )
        return
    yield from _samples_per_revolution(draft, sensors[name], at)
    if not any(asked.measure in OF_THE_SHAFT for asked in _all_asked(draft, levels)):
        yield Finding(
            at,
            "has no effect: no measure of 1X or 2X is listed or watched",
            'write e.g. measures = ["1x_amplitude", "1x_phase_lag"], or remove it',
            fatal=False,
            code=NO_EFFECT,
        )


def _samples_per_revolution(draft: MachineFile, sensor: Sensor, at: KeyPath) -> Iterator[Finding]:
    speed_rpm = abs(draft.machine.speed_rpm)
    if sensor.stream not in draft.streams:
        return
    rate_hz = draft.streams[sensor.stream].rate_hz
    samples = 60.0 * rate_hz / speed_rpm
    if samples < LEAST_SAMPLES_PER_REVOLUTION:
        yield Finding(
            at,
            f'"{sensor.name}" is sampled {samples:.3g} times a revolution ({rate_hz:g} Hz at {speed_rpm:g} '
            f"rpm); 1X and 2X need {LEAST_SAMPLES_PER_REVOLUTION:g}",
            f"sample at {rounded_up(LEAST_SAMPLES_PER_REVOLUTION * speed_rpm / 60.0, 4)} Hz or faster, or "
            "remove it",
            code=SAMPLED_TOO_SLOWLY,
        )


def _revolutions(draft: MachineFile, levels: Levels) -> Iterator[Finding]:
    """A window holds revolutions enough."""
    speed_rpm, window_s = abs(draft.machine.speed_rpm), levels.window_s
    if window_s * speed_rpm / 60.0 < _LEAST_REVOLUTIONS and any(
        asked.measure in OF_THE_SHAFT for asked in _all_asked(draft, levels)
    ):
        yield Finding(
            (*_LEVELS, "window_s"),
            f"{window_s:g} s hold {window_s * speed_rpm / 60.0:.3g} revolutions at {speed_rpm:g} rpm: 1X is "
            "not separate from what lies beside it",
            f"write window_s = {rounded_up(_LEAST_REVOLUTIONS * 60.0 / speed_rpm)} or more",
            code=WINDOW_TOO_SHORT,
        )


def _of_the_shaft(draft: MachineFile, levels: Levels, asked: _Asked) -> Iterator[Finding]:
    """A revolution has samples enough, and a phase has its mark."""
    slow = [one for sensor in asked.sensors for one in _samples_per_revolution(draft, sensor, asked.at)]
    if slow:
        # Of the phase beside an amplitude the same is reported once.
        yield from slow[:1] if asked.at[-1] != "phase" else []
        return
    if asked.measure not in PHASES:
        return
    if levels.keyphasor is None:
        keyphasors = [sensor.name for sensor in draft.sensors if sensor.type == "keyphasor"]
        yield Finding(
            asked.at,
            "needs a keyphasor: from the stated speed alone the angle of the shaft is not known",
            f'write keyphasor = "{keyphasors[0]}" in [pipeline.levels]'
            if keyphasors
            else "add a sensor of type keyphasor, or watch the amplitude only",
            code=NEEDS_KEYPHASOR,
        )
        return
    streams = [sensor.stream for sensor in draft.sensors if sensor.name == levels.keyphasor]
    apart = [sensor for sensor in asked.sensors if streams and sensor.stream != streams[0]]
    # What is listed is listed for all sensors: it is made of those that are sampled with the keyphasor.
    if apart and (asked.alarm or len(apart) == len(asked.sensors)):
        yield Finding(
            asked.at,
            f'"{apart[0].name}" is in stream "{apart[0].stream}", but keyphasor "{levels.keyphasor}" is in '
            f'stream "{streams[0]}": a phase needs samples of one stream with its mark',
            "take a sensor and a keyphasor of one stream, or watch the amplitude only",
            code=SAMPLED_APART,
        )


def _slow_velocity(draft: MachineFile, levels: Levels, asked: _Asked) -> Iterator[Finding]:
    low_hz, high_hz = SLOW_BAND_HZ
    for sensor in asked.sensors:
        if sensor.stream in draft.streams and high_hz >= draft.streams[sensor.stream].rate_hz / 2:
            half_hz = draft.streams[sensor.stream].rate_hz / 2
            yield Finding(
                asked.at,
                f"ends at {high_hz:g} Hz, which must be below {half_hz:g} Hz, half the rate of stream "
                f'"{sensor.stream}" (sensor "{sensor.name}")',
                'sample faster, or take measure = "velocity_rms" with e.g. '
                f"velocity_band_hz = [{low_hz:.1f}, {0.8 * half_hz:.1f}]",
                code=BAND_TOO_HIGH,
            )
            return
    if low_hz * levels.window_s < _LEAST_PERIODS and asked.sensors:
        yield Finding(
            asked.at,
            f"a window of {levels.window_s:g} s holds {low_hz * levels.window_s:.3g} periods of {low_hz:g} "
            "Hz: so slow a motion cannot be separated from the mean value",
            f"write window_s = {rounded_up(_LEAST_PERIODS / low_hz)} or more in [pipeline.levels]",
            fatal=False,
            code=WINDOW_TOO_SHORT,
        )


def _listed(draft: MachineFile, levels: Levels) -> Iterator[Finding]:
    """What is listed is listed once, and some sensor has it."""
    for index, measure in enumerate(levels.measures):
        at = (*_LEVELS, "measures", index)
        if measure in levels.measures[:index]:
            yield Finding(at, "is listed twice", "name each measure once", fatal=False, code=NAMED_TWICE)
        elif not any(sensor.type in _SAMPLED and _has(sensor, measure) for sensor in draft.sensors):
            kind = "accelerometer or velocity sensor" if measure in VELOCITIES else "sensor"
            yield Finding(
                at, f"has no effect: no {kind} sends a waveform", "remove it", fatal=False, code=NO_EFFECT
            )


def _zones(draft: MachineFile, levels: Levels) -> Iterator[Finding]:
    """Zones hold for the band of the standard, which depends on the speed."""
    speed_rpm = abs(draft.machine.speed_rpm)
    slow = speed_rpm <= SLOW_RPM
    wanted_hz = SLOW_BAND_HZ[0] if slow else ISO_BAND_HZ[0]
    begins_hz = {VELOCITY: levels.velocity_band_hz[0], SLOW_VELOCITY: SLOW_BAND_HZ[0]}
    band = f"velocity_band_hz = [{wanted_hz:.1f}, {levels.velocity_band_hz[1]:.1f}] in [pipeline.levels]"
    remedy = {
        VELOCITY: f'measure = "{SLOW_VELOCITY}"' if slow else band,
        SLOW_VELOCITY: f'measure = "{VELOCITY}"',
    }
    for index, alarm in enumerate(draft.alarms):
        with suppress(UnusableValueError):
            if not isinstance(alarm, SetpointAlarm) or alarm.zones is None or alarm.measure not in VELOCITIES:
                continue
            low_hz = begins_hz[alarm.measure]
            if low_hz > wanted_hz or (alarm.measure == SLOW_VELOCITY and not slow):
                yield Finding(
                    ("alarms", index, "zones"),
                    f"are those of a velocity from {wanted_hz:g} Hz on at {speed_rpm:g} rpm, and this one "
                    f"begins at {low_hz:g} Hz",
                    f"write {remedy[alarm.measure]}",
                    fatal=False,
                    code=UNFIT_ZONES,
                )


def _speed_in_band(draft: MachineFile, levels: Levels) -> Iterator[Finding]:
    """An alarm on a velocity sees what happens once a revolution, as an unbalance does."""
    bands_hz = {VELOCITY: levels.velocity_band_hz, SLOW_VELOCITY: SLOW_BAND_HZ}
    speed_rpm = abs(draft.machine.speed_rpm)
    once_hz = speed_rpm / 60.0
    wanted_hz = (SLOW_BAND_HZ if speed_rpm <= SLOW_RPM else ISO_BAND_HZ)[0]
    for index, alarm in enumerate(draft.alarms):
        with suppress(UnusableValueError):
            if not isinstance(alarm, SetpointAlarm) or alarm.measure not in VELOCITIES:
                continue
            low_hz, high_hz = bands_hz[alarm.measure]
            if low_hz <= once_hz <= high_hz or (alarm.zones is not None and low_hz > wanted_hz):
                continue  # of such zones `_zones` warns
            for sensor in draft.sensors:
                if sensor.name not in alarm.watched or sensor.type not in _CASING:
                    continue
                rate_hz = draft.streams[sensor.stream].rate_hz if sensor.stream in draft.streams else 0.0
                if high_hz >= rate_hz / 2:
                    continue  # an error already
                yield Finding(
                    ("alarms", index, "measure"),
                    f'does not see 1X: "{alarm.name}" watches {low_hz:g} Hz to {high_hz:g} Hz, and the '
                    f"machine turns at {once_hz:.4g} Hz ({speed_rpm:g} rpm). An unbalance does not show. "
                    f'Stream "{sensor.stream}" has rate_hz = {rate_hz:g}',
                    _remedy_for_1x(alarm.measure, once_hz, bands_hz[alarm.measure], rate_hz, sensor),
                    fatal=False,
                    code=BAND_WITHOUT_1X,
                )
                break


_IF_A_LEVEL = (
    'if the device sends a level that it has computed, e.g. an RMS, write type = "trend" for the sensor, and '
    'measure = "value" in its alarms'
)


def _speed_in_samples(draft: MachineFile) -> Iterator[Finding]:
    """Samples show 1X of the machine: of slower ones RMS and peak depend on chance.

    A probe may be there for the position of the shaft, and of an alarm on a velocity `_speed_in_band` warns.
    """
    speed_rpm = abs(draft.machine.speed_rpm)
    once_hz = speed_rpm / 60.0
    watched: dict[str, set[str]] = {}
    for alarm in draft.alarms:
        with suppress(UnusableValueError):
            if isinstance(alarm, SetpointAlarm):
                for name in alarm.watched:
                    watched.setdefault(name, set()).add(alarm.measure)
    for stream, table in draft.streams.items():
        with suppress(UnusableValueError):
            if not is_below_1x(draft, stream):
                continue
            there = [one for one in draft.sensors if one.stream == stream and one.type in _SAMPLED]
            if any(watched.get(one.name, set()) & set(VELOCITIES) for one in there):
                continue
            moving = [
                one.name
                for one in there
                if one.type in _CASING or watched.get(one.name, set()) - set(_OF_STEADY_PARTS)
            ]
            if not moving:
                continue
            yield Finding(
                ("streams", stream, "rate_hz"),
                f"shows nothing above {table.rate_hz / 2:g} Hz, and the machine turns at {once_hz:.4g} Hz "
                f"({speed_rpm:g} rpm). RMS and peak of {', '.join(moving)} do not show its vibration",
                show_1x(once_hz),
                fatal=False,
                code=SAMPLED_TOO_SLOWLY,
            )


def is_below_1x(draft: MachineFile, stream: str) -> bool:
    """Whether the samples of a stream are too slow to show 1X of the machine."""
    with suppress(UnusableValueError):
        return draft.streams[stream].rate_hz < 2.0 * abs(draft.machine.speed_rpm) / 60.0
    return False


def show_1x(once_hz: float) -> str:
    """The remedy where samples are too slow for that."""
    needed = rounded_up(SAMPLES_PER_PERIOD * once_hz)
    return f"have the device send {needed} samples a second or more; or, {_IF_A_LEVEL}"


def _remedy_for_1x(
    measure: str, once_hz: float, band_hz: tuple[float, float], rate_hz: float, sensor: Sensor
) -> str:
    low_hz, high_hz = band_hz
    other = f'write another measure, e.g. measure = "rms" with limits of your own in {sensor.unit}'
    if rate_hz < 2.0 * once_hz:
        other = _IF_A_LEVEL  # an RMS of such samples does not show 1X either
    if measure == SLOW_VELOCITY or once_hz < SLOW_BAND_HZ[0]:
        return other
    if once_hz > highest_hz(rate_hz):
        least, best = (
            rounded_up(SAMPLES_PER_PERIOD * one_hz, 3) for one_hz in (max(once_hz, low_hz), ISO_BAND_HZ[1])
        )
        return (
            f"have the device send {least} samples a second or more, and end the band at 0.4 times the rate. "
            f"Best are {best}, {SAMPLES_PER_PERIOD:g} times the {ISO_BAND_HZ[1]:g} Hz of ISO 20816-3. "
            f"Or {other}"
        )
    begin_hz = (
        low_hz if low_hz <= once_hz else SLOW_BAND_HZ[0] if once_hz < ISO_BAND_HZ[0] else ISO_BAND_HZ[0]
    )
    end_hz = high_hz if once_hz <= high_hz else min(ISO_BAND_HZ[1], highest_hz(rate_hz))
    return f"write velocity_band_hz = [{begin_hz:.1f}, {end_hz:.1f}] in [pipeline.levels]; or {other}"
