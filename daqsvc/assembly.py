"""From a machine file to the parts of a service: layouts, drivers, detectors."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

from daqsvc.assembly_rotor import healthy_rotor, rotor_bank, rotor_synchronous
from daqsvc.diagnosis.levels import GapCheck, LevelChannel, LevelDetector, Limits
from daqsvc.rotor.calibration.file import CalibrationFileError
from daqsvc.settings.models import (
    Accelerometer,
    CanBus,
    DbcLayout,
    LevelAlarm,
    PlainLayout,
    ProximityProbe,
    VelocitySensor,
)
from drivers.base import BusPort, StreamSpec
from drivers.dbc import layout_from_dbc
from drivers.frames import FrameLayout, Kind

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.samples import SampleBlock
    from daqsvc.diagnosis.detector import Detector
    from daqsvc.rotor.laval import LavalRotor
    from daqsvc.rotor.synchronous.baseline import Calibration
    from daqsvc.settings.models import MachineFile, RotorSynchronous, Sensor
    from drivers.base import Driver

DRIVERS = "daqsvc.drivers"
_NS_PER_MS = 1_000_000


class AssemblyError(Exception):
    """A machine file that is sound by itself asks for something that is not there."""


def frame_layout(machine: MachineFile, stream: str) -> FrameLayout:
    """The layout of a stream, decoding straight to the physical units of its sensors.

    Raises:
        LayoutError: the DBC file does not hold what the machine file says.
    """
    given = machine.streams[stream].layout
    if isinstance(given, DbcLayout):
        layout = layout_from_dbc(
            machine.resolve(given.dbc),
            given.message,
            counter=given.counter.signal,
            counts=given.counter.counts,
            channels={channel.name: channel.signals for channel in given.channels},
        )
    else:
        layout = _plain_layout(given)
    units = {s.channel: (s.gain, s.shift) for s in machine.sensors if s.stream == stream}
    return layout.in_units(units)


def _plain_layout(given: PlainLayout) -> FrameLayout:
    def kind(raw_type: str) -> Kind:
        return "float" if raw_type == "float32" else "unsigned" if raw_type.startswith("u") else "signed"

    return FrameLayout.plain(
        frame_id=given.id,
        extended=given.extended,
        length=given.length,
        channels=[(c.name, 8 * c.raw_bytes, kind(c.type), c.scale, c.offset) for c in given.channels],
        samples_per_frame=given.samples_per_frame,
        counter_byte=given.counter.byte,
        counter_bits=given.counter.bits,
        counts=given.counter.counts,
        first_byte=given.first_byte,
        crc_byte=given.crc_byte,
        byte_order=given.byte_order,
    )


def drivers(machine: MachineFile, clock: Clock, deliver: Callable[[SampleBlock], None]) -> list[Driver]:
    """One driver per bus, found by its entry point.

    Raises:
        AssemblyError: no driver of that name is installed.
        LayoutError: see `frame_layout`.
    """
    installed = {point.name: point for point in entry_points(group=DRIVERS)}
    made: list[Driver] = []
    for name, bus in machine.buses.items():
        if bus.driver not in installed:
            raise AssemblyError(
                f"{machine.path}: buses.{name}.driver = {bus.driver!r}: no such driver is installed; "
                f"there are {', '.join(sorted(installed)) or 'none'}. "
                "Install the package that brings it, or correct the name"
            )
        options: Mapping[str, Any] = bus.model_dump() if isinstance(bus, CanBus) else bus.options
        streams = [
            StreamSpec(
                stream_name,
                frame_layout(machine, stream_name),
                stream.rate_hz,
                round(stream.reorder_window_ms * _NS_PER_MS),
            )
            for stream_name, stream in machine.streams.items()
            if stream.bus == name
        ]
        port = BusPort(name, options, streams, clock, deliver, bus.start)
        made.append(installed[bus.driver].load()(port))
    return made


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
            channels = [
                LevelChannel(s.name, machine.column(s), s.unit, _limits(machine, s.name), _gap_check(s))
                for s in machine.sensors
                if s.stream == stream and isinstance(s, ProximityProbe | Accelerometer | VelocitySensor)
            ]
            if channels:
                made.append(
                    LevelDetector(
                        machine.machine.name,
                        stream,
                        machine.streams[stream].rate_hz,
                        channels,
                        window_s=machine.pipeline.levels.window_s,
                        velocity_band_hz=machine.pipeline.levels.velocity_band_hz,
                    )
                )
    if machine.pipeline.rotor_bank is not None:
        made.append(rotor_bank(machine, machine.pipeline.rotor_bank))
    if machine.pipeline.rotor_synchronous is not None:
        given = machine.pipeline.rotor_synchronous
        made.append(rotor_synchronous(machine, given, _healthy_rotor(machine, given), store))
    if machine.pipeline.bearing is not None:
        made.append(_bearing(machine, store))
    return made


def _bearing(machine: MachineFile, store: Path | None) -> Detector:
    from daqsvc.assembly_bearing import bearing_detector  # noqa: PLC0415 - brings SciPy's statistics

    try:
        return bearing_detector(machine, store)
    except ValueError as error:
        raise AssemblyError(f"{machine.path}: {error}") from error


def _limits(machine: MachineFile, sensor: str) -> list[Limits]:
    return [
        Limits(alarm.measure, alarm.alert, alarm.danger)
        for alarm in machine.alarms
        if isinstance(alarm, LevelAlarm) and alarm.sensor == sensor
    ]


def _gap_check(sensor: Sensor) -> GapCheck | None:
    if not isinstance(sensor, ProximityProbe) or sensor.sensitivity_mv_per_unit is None:
        return None
    return GapCheck(sensor.sensitivity_mv_per_unit / 1000.0, sensor.zero_v, *sensor.gap_ok_v)


def check_calibrations(machine: MachineFile) -> None:
    """See whether the calibrations that a machine file names can be used.

    Raises:
        AssemblyError: one cannot; the message names file, key, value and remedy.
    """
    pipeline = machine.pipeline
    if pipeline.rotor_synchronous is not None:
        _healthy_rotor(machine, pipeline.rotor_synchronous)
    if pipeline.bearing is not None and pipeline.bearing.calibration is not None:
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
