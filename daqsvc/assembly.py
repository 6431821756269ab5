"""From a machine file to the parts of a service: layouts, drivers, detectors, alarm rules."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarms.events import Identity
from daqsvc.alarms.rules import DiagnosisRule, LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.diagnosis.levels import GapCheck, LevelChannel, LevelDetector, Limits
from daqsvc.diagnosis.probe_checks import KeyphasorProbe, Probe
from daqsvc.diagnosis.rotor_synchronous import RotorSynchronousDetector
from daqsvc.publish.mqtt import MqttSettings
from daqsvc.rotor.calibration.file import (
    CalibrationFileError,
    load_calibration,
    load_healthy,
    save_calibration,
)
from daqsvc.rotor.laval import LavalRotor
from daqsvc.rotor.synchronous.watch import WatchRules
from daqsvc.settings.models import (
    ROTOR_SYNCHRONOUS,
    Accelerometer,
    CanBus,
    DbcLayout,
    Keyphasor,
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
    from daqsvc.diagnosis.rotor_synchronous import SpeedReference
    from daqsvc.rotor.synchronous.baseline import Calibration
    from daqsvc.settings.models import MachineFile, RotorBank, RotorSynchronous, Sensor
    from drivers.base import Driver

log = logging.getLogger(__name__)

DRIVERS = "daqsvc.drivers"
_NS_PER_MS = 1_000_000
_UM_PER_UNIT = {"um": 1.0, "mm": 1000.0, "mil": 25.4}


class AssemblyError(Exception):
    """A machine file that is sound by itself asks for something that is not there."""


def identity(machine: MachineFile) -> Identity:
    """Whose alarms these are."""
    return Identity(machine.site, machine.box, machine.machine.name)


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
                LevelChannel(s.name, _column(machine, s), s.unit, _limits(machine, s.name), _gap_check(s))
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
        made.append(_rotor_bank(machine, machine.pipeline.rotor_bank))
    if machine.pipeline.rotor_synchronous is not None:
        made.append(_rotor_synchronous(machine, machine.pipeline.rotor_synchronous, store))
    if machine.pipeline.bearing is not None:
        made.append(_bearing(machine, store))
    return made


def _bearing(machine: MachineFile, store: Path | None) -> Detector:
    from daqsvc.assembly_bearing import bearing_detector  # noqa: PLC0415 - brings SciPy's statistics

    try:
        return bearing_detector(machine, store)
    except ValueError as error:
        raise AssemblyError(f"{machine.path}: {error}") from error


def _column(machine: MachineFile, sensor: Sensor) -> int:
    return machine.streams[sensor.stream].layout.channel_names.index(sensor.channel)


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


def _rotor_bank(machine: MachineFile, bank: RotorBank) -> Detector:
    # Here, not above: the kernels bring a compiler, which costs a second that `daqsvc check` need not wait.
    from daqsvc.diagnosis.rotor_bank import RotorBankDetector, RotorMode  # noqa: PLC0415
    from daqsvc.rotor.decision import DecisionRules  # noqa: PLC0415
    from daqsvc.rotor.model import RotorParameters  # noqa: PLC0415

    rotor = machine.machine.rotor
    # settings/rotor_checks.py: a rotor bank needs [machine.rotor], and these two in it.
    assert rotor is not None  # noqa: S101
    assert rotor.eccentricity_um is not None  # noqa: S101
    assert rotor.contact_stiffness is not None  # noqa: S101
    stream = machine.sensor(bank.keyphasor).stream
    rate_hz = machine.streams[stream].rate_hz
    return RotorBankDetector(
        machine=machine.machine.name,
        stream=stream,
        rate_hz=rate_hz,
        speed_rpm=machine.machine.speed_rpm,
        probes=_probes(machine, bank.probes),
        keyphasor=_keyphasor(machine, bank.keyphasor),
        rotor=RotorParameters(
            natural_frequency_hz=rotor.natural_frequency_hz,
            damping_ratio=rotor.damping_ratio,
            eccentricity_um=rotor.eccentricity_um,
            heavy_spot_deg=rotor.heavy_spot_deg,
            clearance_um=rotor.clearance_um,
            static_sag_um=rotor.static_sag_um,
            contact_stiffness=rotor.contact_stiffness,
            contact_radius_um=rotor.contact_radius_um,
            static_load_x_um=rotor.static_load_x_um,
        ),
        modes=[
            RotorMode(
                mode.name,
                mode.damping_ratio,
                mode.severity,
                mode.rub,
                fault=mode.fault,
                unbalance_ratio=mode.unbalance_ratio,
                stiffness_ratio=mode.stiffness_ratio,
                static_load_um=mode.static_load_um,
            )
            for mode in bank.modes
        ],
        noise_um=bank.noise_um,
        process_noise=bank.process_noise,
        rub_process_noise=bank.rub_process_noise,
        rules=DecisionRules.from_rates(
            rule=bank.rule,
            threshold_nats=bank.threshold_nats,
            back_threshold_nats=bank.back_threshold_nats,
            identity_nats=bank.identity_nats,
            settle_revolutions=bank.settle_revolutions,
            false_alarms_per_1000_rev=bank.false_alarms_per_1000_rev,
            mtbf_hours=bank.mtbf_hours,
            speed_rpm=machine.machine.speed_rpm,
            samples_per_rev=60.0 * rate_hz / abs(machine.machine.speed_rpm),
            modes=len(bank.modes),
        ),
        calibrate_revolutions=bank.calibrate_revolutions,
        ac_coupled=machine.ac_coupled,
    )


def healthy_rotor(
    machine: MachineFile, given: RotorSynchronous, calibration: Path | None = None
) -> tuple[LavalRotor, tuple[Calibration, ...]]:
    """What is known of the calibrated rotor: by its calibration if there is one, else by the machine file.

    Args:
        machine: the machine file.
        given: its calibrated rotor.
        calibration: file to take in place of the one that the machine file names.

    Returns:
        See `load_healthy`: at most one baseline, that of the machine's speed.

    Raises:
        CalibrationFileError: the calibration cannot be used at the machine's speed.
    """
    rotor = machine.machine.rotor
    assert rotor is not None  # noqa: S101 - settings/rotor_checks.py: it needs [machine.rotor]
    if calibration is None and given.calibration is not None:
        calibration = machine.resolve(given.calibration)
    if calibration is not None:
        return load_healthy(calibration, machine.machine.speed_rpm, rotor.clearance_um)
    stated = LavalRotor(
        natural_frequency_hz=rotor.natural_frequency_hz,
        damping_ratio=rotor.damping_ratio,
        natural_frequency_tolerance=given.natural_frequency_tolerance_percent / 100.0,
        damping_tolerance=given.damping_tolerance_percent / 100.0,
        clearance_um=rotor.clearance_um,
        static_sag_um=rotor.static_sag_um,
    )
    return stated, ()


def check_calibrations(machine: MachineFile) -> None:
    """See whether the calibrations that a machine file names can be used.

    Raises:
        AssemblyError: one cannot; the message names file, key, value and remedy.
    """
    pipeline = machine.pipeline
    if pipeline.rotor_synchronous is not None:
        _stated_rotor(machine, pipeline.rotor_synchronous)
    if pipeline.bearing is not None and pipeline.bearing.calibration is not None:
        _bearing(machine, None)


def _stated_rotor(
    machine: MachineFile, given: RotorSynchronous
) -> tuple[LavalRotor, tuple[Calibration, ...]]:
    try:
        return healthy_rotor(machine, given)
    except CalibrationFileError as error:
        raise AssemblyError(
            f"{machine.path}: pipeline.rotor_synchronous.calibration = {str(given.calibration)!r}: {error}"
        ) from error


def _rotor_synchronous(machine: MachineFile, given: RotorSynchronous, store: Path | None) -> Detector:
    rotor, baselines = _stated_rotor(machine, given)
    calibration, kept = (baselines[0] if baselines else None), None
    if calibration is None and store is not None:
        kept = store / f"{ROTOR_SYNCHRONOUS}.toml"
        calibration = _kept_calibration(kept, machine.machine.speed_rpm, rotor)
    stream = machine.sensor(given.probes[0]).stream
    reference: SpeedReference
    if given.reference == "keyphasor":
        assert given.keyphasor is not None  # noqa: S101 - and then the keyphasor
        reference = _keyphasor(machine, given.keyphasor)
    else:
        reference = given.reference
    return RotorSynchronousDetector(
        machine=machine.machine.name,
        stream=stream,
        rate_hz=machine.streams[stream].rate_hz,
        speed_rpm=machine.machine.speed_rpm,
        probes=_probes(machine, given.probes),
        reference=reference,
        rotor=rotor,
        rules=WatchRules(
            calibrate_revolutions=given.calibrate_revolutions,
            false_alarms_per_1000_rev=given.false_alarms_per_1000_rev,
            probe_drift_um=given.probe_drift_um,
        ),
        calibration=calibration,
        ac_coupled=machine.ac_coupled,
        keep=None if kept is None else partial(_keep_calibration, kept),
    )


def _kept_calibration(path: Path, speed_rpm: float, rotor: LavalRotor) -> Calibration | None:
    """The healthy state that was measured before a restart, with what the file says of the rotor now."""
    if not path.exists():
        return None
    try:
        return replace(load_calibration(path, speed_rpm), rotor=rotor)
    except CalibrationFileError as error:
        log.warning("the healthy state of the rotor is measured anew: %s", error)
        return None


def _keep_calibration(path: Path, calibration: Calibration) -> None:
    """Keep the healthy state, so that a restart does not take a faulty machine for a healthy one."""
    try:
        save_calibration(calibration, path, source="the running service")
    except CalibrationFileError as error:
        log.error("the healthy state of the rotor will be lost at the next restart: %s", error)  # noqa: TRY400


def _probes(machine: MachineFile, names: tuple[str, str]) -> tuple[Probe, Probe]:
    def probe(name: str) -> Probe:
        sensor = machine.sensor(name)
        assert isinstance(sensor, ProximityProbe)  # noqa: S101 - settings/rotor_checks.py
        assert sensor.angle_deg is not None  # noqa: S101 - settings/rotor_checks.py
        return Probe(name, _column(machine, sensor), sensor.angle_deg, _UM_PER_UNIT[sensor.unit])

    return probe(names[0]), probe(names[1])


def _keyphasor(machine: MachineFile, name: str) -> KeyphasorProbe:
    sensor = machine.sensor(name)
    assert isinstance(sensor, Keyphasor)  # noqa: S101 - settings/rotor_checks.py
    column = _column(machine, sensor)
    return KeyphasorProbe(name, column, sensor.threshold_v, sensor.hysteresis_v, sensor.edge)


def alarm_rules(machine: MachineFile) -> list[LevelRule | DiagnosisRule]:
    """One rule per alarm."""
    rules: list[LevelRule | DiagnosisRule] = []
    for alarm in machine.alarms:
        if isinstance(alarm, LevelAlarm):
            setpoint = Setpoint(
                alarm.alert,
                alarm.danger,
                alarm.deadband,
                round(alarm.on_delay_s * NS_PER_S),
                round(alarm.off_delay_s * NS_PER_S),
            )
            rules.append(LevelRule(alarm.name, alarm.sensor, alarm.measure, setpoint, alarm.latching))
        else:
            rules.append(DiagnosisRule(alarm.name, alarm.detector, alarm.latching))
    return rules


def mqtt_settings(machine: MachineFile) -> MqttSettings | None:
    """How to reach the broker; None if the machine file has none."""
    given = machine.mqtt
    if given is None:
        return None
    return MqttSettings(
        host=given.host,
        port=given.port,
        client_id=machine.mqtt_client_id,
        tls=given.tls,
        ca_file=None if given.ca_file is None else machine.resolve(given.ca_file),
        username=given.username,
        password_file=None if given.password_file is None else machine.resolve(given.password_file),
        keepalive_s=given.keepalive_s,
        topic_root=given.topic_root,
        protocol=given.protocol,
    )
