"""The level detectors as a plugin: from ``[pipeline.levels]`` to one detector a stream.

And whether their settings fit the streams and sensors.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.detectors.levels.measure_checks import is_below_1x, measure_checks, show_1x
from daqsvc.detectors.levels.settings import Levels
from daqsvc.diagnosis.plugin import DetectorPlugin
from daqsvc.diagnosis.reading import STALE_S, Reading
from daqsvc.diagnosis.snapshots import at_once, patience
from daqsvc.errors.detectors import BAND_TOO_HIGH, WINDOW_TOO_SHORT
from daqsvc.errors.machine_file import NO_EFFECT, RING_TOO_SHORT
from daqsvc.rounding import rounded_up
from daqsvc.settings.measures import PHASE_OF, PHASES, UNITS, VELOCITIES, VELOCITY
from daqsvc.settings.models import (
    Accelerometer,
    Keyphasor,
    LevelAlarm,
    ProximityProbe,
    SetpointAlarm,
    TrendValue,
    VelocitySensor,
)
from daqsvc.settings.problems import Finding
from daqsvc.settings.section import UnusableValueError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

    from daqsvc.detectors.levels.detector import GapCheck
    from daqsvc.detectors.levels.shaft_angle import ShaftAngle
    from daqsvc.detectors.levels.statements import Limits
    from daqsvc.diagnosis.detector import Detector
    from daqsvc.diagnosis.recorded import RecordedDetector, RecordingOptions
    from daqsvc.settings.models import MachineFile, Sensor


class LevelsPlugin(DetectorPlugin[Levels]):
    """Levels of every vibration sensor, and values that a device measures itself."""

    settings = Levels
    about = "level detectors"
    measures_levels = True
    place = 0

    def checks(self, draft: MachineFile, settings: Levels) -> Iterator[Iterator[Finding]]:
        """See `PipelineTable.checks`."""
        return level_checks(draft, settings)

    def start_up_signals(self, draft: MachineFile, settings: Levels) -> Mapping[str, tuple[str, ...]]:
        """See `PipelineTable.start_up_signals`: a trend value may be the speed."""
        del settings
        trends = (sensor.name for sensor in draft.sensors if sensor.type == "trend")
        return {f"levels/{name}": ("value",) for name in trends}

    def describe(self, machine: MachineFile, settings: Levels) -> str:
        """See `PipelineTable.describe`."""
        return _described(machine, settings)

    def build(self, machine: MachineFile, settings: Levels, store: Path | None) -> Iterator[Detector]:
        """See `DetectorPlugin.build`."""
        del store
        for stream in machine.streams:
            yield from _of_stream(machine, settings, stream)

    def change_setpoints(self, machine: MachineFile, settings: Levels, running: Iterable[Detector]) -> None:
        """See `DetectorPlugin.change_setpoints`."""
        from daqsvc.detectors.levels.detector import LevelDetector  # noqa: PLC0415 - brings SciPy

        del settings
        for detector in running:
            if isinstance(detector, LevelDetector):
                detector.change_setpoints({s.name: _limits(machine, s.name) for s in machine.sensors})

    def recorded(
        self, machine: MachineFile, settings: Levels, options: RecordingOptions
    ) -> RecordedDetector[Levels]:
        """See `DetectorPlugin.recorded`."""
        from daqsvc.detectors.levels.recorded import RecordedLevels  # noqa: PLC0415 - brings NumPy

        return RecordedLevels(machine, settings, options, self.build)

    def readings(self, machine: MachineFile, settings: Levels) -> Iterator[Reading]:
        """See `DetectorPlugin.readings`."""
        for sensor in _measured(machine):
            rate_hz = machine.streams[sensor.stream].rate_hz
            silent_s = patience(machine, sensor.stream, rate_hz).ns / NS_PER_S
            stale_s = max(STALE_S, math.ceil(silent_s))
            for name in _shown(machine, settings, sensor):
                yield Reading(
                    f"levels/{sensor.name}", "statistics", name, UNITS.get(name, sensor.unit), stale_s
                )

    def quality_alarms(self, machine: MachineFile, settings: Levels) -> Iterator[str]:
        """See `DetectorPlugin.quality_alarms`."""
        del settings
        return (f"sensor-ok/{sensor.name}" for sensor in _measured(machine))


def _of_stream(machine: MachineFile, settings: Levels, stream: str) -> Iterator[Detector]:
    """What measures the levels of waveforms, and what takes levels as the device has measured them."""
    # Here, not above: they bring SciPy, which `daqsvc check` need not wait for.
    from daqsvc.detectors.levels.detector import LevelChannel, LevelDetector  # noqa: PLC0415
    from daqsvc.detectors.levels.trends import TrendChannel, TrendDetector  # noqa: PLC0415

    sensors = [sensor for sensor in machine.sensors if sensor.stream == stream]
    name, rate_hz = machine.machine.name, machine.streams[stream].rate_hz
    shaft = _shaft_angle(machine, settings, stream)
    channels = [
        LevelChannel(
            s.name,
            machine.column(s),
            s.unit,
            _limits(machine, s.name),
            _gap_check(s),
            _listed(settings, s, has_phase=shaft is not None),
        )
        for s in sensors
        if isinstance(s, ProximityProbe | Accelerometer | VelocitySensor)
    ]
    if channels:
        yield LevelDetector(
            name,
            stream,
            rate_hz,
            channels,
            window_s=settings.window_s,
            velocity_band_hz=settings.band_hz(rate_hz, machine.machine.speed_rpm),
            speed_rpm=machine.machine.speed_rpm,
            shaft=shaft,
        )
    trends = [
        TrendChannel(
            s.name,
            machine.column(s),
            s.unit,
            _limits(machine, s.name),
            s.ok_between,
            machine.streams[stream].layout.number_keys,
        )
        for s in sensors
        if isinstance(s, TrendValue)
    ]
    if trends:
        yield TrendDetector(name, stream, rate_hz, trends, window_s=settings.window_s)


def _limits(machine: MachineFile, sensor: str) -> list[Limits]:
    from daqsvc.detectors.levels.statements import Limits  # noqa: PLC0415 - as above

    limits: list[Limits] = []
    for alarm in machine.alarms:
        if not isinstance(alarm, SetpointAlarm) or sensor not in alarm.watched:
            continue
        limits.append(
            Limits(
                alarm.measure,
                alarm.alert,
                alarm.danger,
                alarm.alert_low,
                alarm.danger_low,
                alarm.reference_deg,
                alarm.boundaries,
            )
        )
        if isinstance(alarm, LevelAlarm) and (phase := alarm.phase) is not None:
            limits.append(
                Limits(PHASE_OF[alarm.measure], phase.alert, phase.danger, reference_deg=phase.reference_deg)
            )
    return limits


def _shaft_angle(machine: MachineFile, settings: Levels, stream: str) -> ShaftAngle | None:
    """What follows the keyphasor, if it is in this stream."""
    from daqsvc.detectors.levels.shaft_angle import ShaftAngle  # noqa: PLC0415 - as above
    from daqsvc.detectors.shaft.build import keyphasor  # noqa: PLC0415 - as above

    name = settings.keyphasor
    if name is None or machine.sensor(name).stream != stream:
        return None
    grid = machine.grid([name])
    period = 60.0 * grid.rate_hz / abs(machine.machine.speed_rpm)
    return ShaftAngle(keyphasor(machine, grid, name), period)


def _keyphasor_beside(draft: MachineFile, settings: Levels, sensor: Sensor) -> bool:
    """Whether the keyphasor is in the stream of a sensor."""
    named = (one.stream for one in draft.sensors if one.name == settings.keyphasor)
    return sensor.stream in named


def _listed(settings: Levels, sensor: Sensor, *, has_phase: bool) -> frozenset[str]:
    """What is listed and can be made of a sensor."""
    casing = isinstance(sensor, Accelerometer | VelocitySensor)
    return frozenset(
        name
        for name in settings.measures
        if (casing or name not in VELOCITIES) and (has_phase or name not in PHASES)
    )


def _gap_check(sensor: Sensor) -> GapCheck | None:
    from daqsvc.detectors.levels.detector import GapCheck  # noqa: PLC0415 - as above

    if not isinstance(sensor, ProximityProbe) or sensor.sensitivity_mv_per_unit is None:
        return None
    if sensor.gap_ok_v is None:
        return None
    return GapCheck(sensor.sensitivity_mv_per_unit / 1000.0, sensor.zero_v, *sensor.gap_ok_v)


def _measured(machine: MachineFile) -> Iterator[Sensor]:
    return (sensor for sensor in machine.sensors if not isinstance(sensor, Keyphasor))


def _band_hz(machine: MachineFile, settings: Levels, sensor: Sensor) -> tuple[float, float] | None:
    return settings.band_hz(machine.streams[sensor.stream].rate_hz, machine.machine.speed_rpm)


def _shown(machine: MachineFile, settings: Levels, sensor: Sensor) -> list[str]:
    """Measures of a sensor that are readings: the usual ones, those listed, and those that alarms watch."""
    shown = ["value"] if isinstance(sensor, TrendValue) else ["rms", "peak"]
    if isinstance(sensor, ProximityProbe):
        shown += ["gap_voltage"] * (sensor.sensitivity_mv_per_unit is not None)
    elif isinstance(sensor, Accelerometer | VelocitySensor):
        shown += [VELOCITY] * (_band_hz(machine, settings, sensor) is not None)
    if not isinstance(sensor, TrendValue):
        listed = _listed(settings, sensor, has_phase=_keyphasor_beside(machine, settings, sensor))
        shown += [name for name in settings.measures if name in listed]
    for alarm in machine.alarms:
        if isinstance(alarm, SetpointAlarm) and sensor.name in alarm.watched:
            shown.append(alarm.measure)
            if isinstance(alarm, LevelAlarm) and alarm.phase is not None:
                shown.append(PHASE_OF[alarm.measure])
    return list(dict.fromkeys(shown))


def _described(machine: MachineFile, settings: Levels) -> str:
    casing = [s for s in machine.sensors if isinstance(s, Accelerometer | VelocitySensor)]
    waveforms = [s for s in machine.sensors if not isinstance(s, Keyphasor | TrendValue)]
    steady = [s.name for s in waveforms if not at_once(machine, s.stream)]
    of_blocks = [s.name for s in waveforms if at_once(machine, s.stream)]
    trends = [s.name for s in machine.sensors if isinstance(s, TrendValue)]
    parts: list[str] = []
    if steady:
        parts.append(f"RMS, peak and crest factor over {settings.window_s:g} s of {', '.join(steady)}")
    if of_blocks:
        parts.append(f"RMS, peak and crest factor over each block of {', '.join(of_blocks)}")
    if with_velocity := [s.name for s in casing if _band_hz(machine, settings, s) is not None]:
        low_hz, high_hz = settings.velocity_band_hz
        parts.append(f"velocity RMS {low_hz:g} to {high_hz:g} Hz of {', '.join(with_velocity)}")
    if without := [s.name for s in casing if s.name not in with_velocity]:
        parts.append(f"no velocity RMS of {', '.join(without)}: sampled too slowly for 1X of the machine")
    if settings.measures:
        parts.append(f"{', '.join(settings.measures)} besides")
    if settings.keyphasor is not None:
        parts.append(f"shaft angle from {settings.keyphasor}")
    if trends:
        parts.append(
            f"{', '.join(trends)} as they come, or averaged over {settings.window_s:g} s if they are faster"
        )
    return "; ".join(parts)


_RING_WINDOWS = 2
_LEAST_WINDOW_SAMPLES = 16
_LEAST_PERIODS = 2.0
"""A taper of Hann spreads each frequency by two of its bins."""
_WAVEFORMS = ("proximity", "accelerometer", "velocity")
"""Types of sensors whose levels are measured here, window by window."""


def level_checks(draft: MachineFile, levels: Levels) -> Iterator[Iterator[Finding]]:
    """Every check of the level detectors.

    Args:
        draft: the machine file, or what is valid of it.
        levels: its level detectors.
    """
    yield _window(draft, levels)
    yield _velocity_band(draft, levels)
    yield _lowest_frequency(draft, levels)
    yield from measure_checks(draft, levels)


def _rate_hz(draft: MachineFile, sensor: Sensor) -> float | None:
    return draft.streams[sensor.stream].rate_hz if sensor.stream in draft.streams else None


def _window(draft: MachineFile, levels: Levels) -> Iterator[Finding]:
    window_s, ring_s = levels.window_s, draft.pipeline.ring_s
    at = ("pipeline", "levels", "window_s")
    waveforms = {sensor.stream for sensor in draft.sensors if sensor.type in _WAVEFORMS}
    slow = [(draft.streams[name].rate_hz, name) for name in waveforms if name in draft.streams]
    if slow and window_s * min(slow)[0] < _LEAST_WINDOW_SAMPLES:
        slowest_hz, name = min(slow)
        remedy = f"write window_s = {rounded_up(_LEAST_WINDOW_SAMPLES / slowest_hz)} or more"
        yield Finding(
            at,
            f"{window_s:g} s at {slowest_hz:g} Hz are fewer than {_LEAST_WINDOW_SAMPLES} samples",
            _remedy(draft, name, remedy),
            code=WINDOW_TOO_SHORT,
        )
    if ring_s < _RING_WINDOWS * window_s:
        yield Finding(
            at,
            f"a ring of {ring_s:g} s must hold at least {_RING_WINDOWS} windows",
            f"write ring_s = {rounded_up(_RING_WINDOWS * window_s, 6)} or more in [pipeline], or a "
            "shorter window",
            code=RING_TOO_SHORT,
        )


def _velocity_band(draft: MachineFile, levels: Levels) -> Iterator[Finding]:
    at = ("pipeline", "levels", "velocity_band_hz")
    low_hz, high_hz = levels.velocity_band_hz
    casing = [sensor for sensor in draft.sensors if sensor.type in {"accelerometer", "velocity"}]
    if not casing and "velocity_band_hz" in levels.model_fields_set:
        yield Finding(
            at,
            "has no effect: no accelerometer or velocity sensor sends a waveform, and a trend value has the "
            "band of its device",
            "remove it",
            fatal=False,
            code=NO_EFFECT,
        )
    for sensor in casing:
        rate_hz = _rate_hz(draft, sensor)
        if rate_hz is not None and high_hz >= rate_hz / 2:
            if _has_no_velocity(draft, levels, sensor):
                continue
            usable_hz = 0.4 * rate_hz
            remedy = (
                f"write velocity_band_hz = [{low_hz:.1f}, {usable_hz:.1f}]"
                if usable_hz > low_hz
                else "sample faster, or write a lower band"
            )
            yield Finding(
                at,
                f"the band {low_hz:g} Hz to {high_hz:g} Hz must end below {rate_hz / 2:g} Hz, half the rate "
                f'of stream "{sensor.stream}" (sensor "{sensor.name}")',
                _remedy(draft, sensor.stream, remedy),
                code=BAND_TOO_HIGH,
            )
            return


def _has_no_velocity(draft: MachineFile, levels: Levels, sensor: Sensor) -> bool:
    """Whether a sensor has no velocity RMS, and needs none; values that are polled are no waveform at all."""
    stream = draft.streams[sensor.stream]
    try:
        watched = any(
            isinstance(alarm, SetpointAlarm) and alarm.measure == VELOCITY and sensor.name in alarm.watched
            for alarm in draft.alarms
        )
        none = levels.band_hz(stream.rate_hz, draft.machine.speed_rpm) is None
    except UnusableValueError:
        return False
    return none and not watched and not stream.layout.polled


def _lowest_frequency(draft: MachineFile, levels: Levels) -> Iterator[Finding]:
    """A window holds the lowest frequency of the velocity band: below, the mean value leaks into it."""
    streams = dict.fromkeys(one.stream for one in draft.sensors if one.type in {"accelerometer", "velocity"})
    low_hz, window_s = levels.velocity_band_hz[0], levels.window_s
    blocks = {
        name: draft.streams[name].layout.block
        for name in streams
        if name in draft.streams
        and levels.band_hz(draft.streams[name].rate_hz, draft.machine.speed_rpm) is not None
        and not is_below_1x(draft, name)  # a warning of that shows what to do
    }
    for name, block in blocks.items():
        if block is None:
            continue
        block_s = block.samples / draft.streams[name].rate_hz
        if low_hz * block_s < _LEAST_PERIODS:
            begin_hz = rounded_up(_LEAST_PERIODS / block_s)
            needed = math.ceil(_LEAST_PERIODS / low_hz * draft.streams[name].rate_hz)
            yield Finding(
                ("streams", name, "layout"),
                f"its blocks of {block.samples} samples are {block_s:.3g} s long. That is "
                f"{low_hz * block_s:.3g} periods of {low_hz:g} Hz, the lowest frequency of velocity_band_hz: "
                "the velocity RMS is too low, or that of the mean value",
                f"have the device take {needed} samples or more, or begin the band at {begin_hz} Hz",
                fatal=False,
                code=WINDOW_TOO_SHORT,
            )
    if any(block is None for block in blocks.values()) and low_hz * window_s < _LEAST_PERIODS:
        yield Finding(
            ("pipeline", "levels", "window_s"),
            f"{window_s:g} s hold {low_hz * window_s:.3g} periods of {low_hz:g} Hz, the lowest frequency of "
            "velocity_band_hz: its velocity cannot be separated from the mean value",
            f"write window_s = {rounded_up(_LEAST_PERIODS / low_hz)} or more, or begin the band at "
            f"{rounded_up(_LEAST_PERIODS / window_s)} Hz",
            fatal=False,
            code=WINDOW_TOO_SHORT,
        )


def _remedy(draft: MachineFile, stream: str, of_waveforms: str) -> str:
    """What to do about a stream that is too slow, also where it is polled, or does not show 1X.

    Args:
        draft: the machine file, or what is valid of it.
        stream: its name.
        of_waveforms: what to do where samples are those of a motion.
    """
    if draft.streams[stream].layout.polled:
        return f'{of_waveforms}, or type = "trend" for sensors whose level the device measures itself'
    if is_below_1x(draft, stream):
        return show_1x(abs(draft.machine.speed_rpm) / 60.0)
    return of_waveforms
