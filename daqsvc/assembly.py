"""From a machine file to its detectors."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.assembly_drivers import AssemblyError
from daqsvc.assembly_rotor import healthy_rotor, rotor_bank, rotor_synchronous
from daqsvc.diagnosis.level_statements import Limits
from daqsvc.diagnosis.levels import GapCheck, LevelChannel, LevelDetector
from daqsvc.diagnosis.trends import TrendChannel, TrendDetector
from daqsvc.rotor.calibration.file import CalibrationFileError
from daqsvc.settings.models import (
    Accelerometer,
    ProximityProbe,
    SetpointAlarm,
    TrendValue,
    VelocitySensor,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from daqsvc.diagnosis.detector import Detector
    from daqsvc.rotor.laval import LavalRotor
    from daqsvc.rotor.synchronous.baseline import Calibration
    from daqsvc.settings.models import Levels, MachineFile, RotorBank, RotorSynchronous, Sensor

__all__ = ["AssemblyError", "check_calibrations", "detectors"]


def detectors(machine: MachineFile, store: Path | None = None) -> list[Detector]:
    """Every detector that the pipeline section asks for.

    Args:
        machine: the machine file.
        store: directory of the state that survives restarts; None to begin without any and leave none.

    Raises:
        AssemblyError: a calibration that the machine file names cannot be used.
    """
    made: list[Detector] = []
    if machine.pipeline.levels is not None:
        for stream in machine.streams:
            made += _levels(machine, machine.pipeline.levels, stream)
    if machine.pipeline.rotor_bank is not None:
        made.append(_rotor_bank(machine, machine.pipeline.rotor_bank))
    if machine.pipeline.rotor_synchronous is not None:
        given = machine.pipeline.rotor_synchronous
        made.append(rotor_synchronous(machine, given, _healthy_rotor(machine, given), store))
    if machine.pipeline.bearing is not None:
        made.append(_bearing(machine, store))
    return made


def _levels(machine: MachineFile, given: Levels, stream: str) -> Iterator[Detector]:
    """What measures the levels of waveforms, and what takes levels as the device has measured them."""
    sensors = [sensor for sensor in machine.sensors if sensor.stream == stream]
    name, rate_hz = machine.machine.name, machine.streams[stream].rate_hz
    channels = [
        LevelChannel(s.name, machine.column(s), s.unit, _limits(machine, s.name), _gap_check(s))
        for s in sensors
        if isinstance(s, ProximityProbe | Accelerometer | VelocitySensor)
    ]
    if channels:
        yield LevelDetector(
            name,
            stream,
            rate_hz,
            channels,
            window_s=given.window_s,
            velocity_band_hz=given.velocity_band_hz,
        )
    trends = [
        TrendChannel(s.name, machine.column(s), s.unit, _limits(machine, s.name), s.ok_between)
        for s in sensors
        if isinstance(s, TrendValue)
    ]
    if trends:
        yield TrendDetector(name, stream, rate_hz, trends, window_s=given.window_s)


def _rotor_bank(machine: MachineFile, given: RotorBank) -> Detector:
    try:
        return rotor_bank(machine, given)
    except (ValueError, ArithmeticError) as error:
        raise AssemblyError(
            f"{machine.path}: pipeline.rotor_bank: its observers cannot be made of these figures ({error}); "
            "correct noise_um, process_noise, modes, or [machine.rotor]"
        ) from error


def _bearing(machine: MachineFile, store: Path | None) -> Detector:
    from daqsvc.assembly_bearing import bearing_detector  # noqa: PLC0415 - brings SciPy's statistics

    try:
        return bearing_detector(machine, store)
    except ValueError as error:
        raise AssemblyError(f"{machine.path}: {error}") from error


def _limits(machine: MachineFile, sensor: str) -> list[Limits]:
    return [
        Limits(alarm.measure, alarm.alert, alarm.danger, alarm.alert_low, alarm.danger_low)
        for alarm in machine.alarms
        if isinstance(alarm, SetpointAlarm) and sensor in alarm.watched
    ]


def _gap_check(sensor: Sensor) -> GapCheck | None:
    if not isinstance(sensor, ProximityProbe) or sensor.sensitivity_mv_per_unit is None:
        return None
    if sensor.gap_ok_v is None:
        return None
    return GapCheck(sensor.sensitivity_mv_per_unit / 1000.0, sensor.zero_v, *sensor.gap_ok_v)


def check_calibrations(machine: MachineFile) -> None:
    """See whether the calibrations that a machine file names can be used, and its bearings are known.

    Raises:
        AssemblyError: one cannot, or is not; the message names file, key, value and remedy.
    """
    pipeline = machine.pipeline
    if pipeline.rotor_bank is not None:
        _rotor_bank(machine, pipeline.rotor_bank)
    if pipeline.rotor_synchronous is not None:
        _healthy_rotor(machine, pipeline.rotor_synchronous)
    if pipeline.bearing is not None:
        _bearing(machine, None)


def _healthy_rotor(
    machine: MachineFile, given: RotorSynchronous
) -> tuple[LavalRotor, tuple[Calibration, ...]]:
    try:
        return healthy_rotor(machine, given)
    except CalibrationFileError as error:
        raise AssemblyError(
            f"{machine.path}: pipeline.rotor_synchronous.calibration = {str(given.calibration)!r}: {error}"
        ) from error
