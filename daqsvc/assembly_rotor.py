"""The rotor's detectors out of a machine file."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from daqsvc.diagnosis.probe_checks import KeyphasorProbe, Probe
from daqsvc.diagnosis.rotor_synchronous import RotorSynchronousDetector
from daqsvc.rotor.calibration.file import (
    CalibrationFileError,
    load_calibration,
    load_healthy,
    save_calibration,
)
from daqsvc.rotor.laval import LavalRotor
from daqsvc.rotor.synchronous.watch import WatchRules
from daqsvc.settings.models import ROTOR_SYNCHRONOUS, Keyphasor, ProximityProbe

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.diagnosis.detector import Detector
    from daqsvc.diagnosis.rotor_synchronous import SpeedReference
    from daqsvc.rotor.synchronous.baseline import Calibration
    from daqsvc.settings.alignment import Grid
    from daqsvc.settings.models import MachineFile, RotorBank, RotorSynchronous

log = logging.getLogger(__name__)

_UM_PER_UNIT = {"um": 1.0, "mm": 1000.0, "mil": 25.4}


def rotor_bank(machine: MachineFile, bank: RotorBank) -> Detector:
    """The detector that ``[pipeline.rotor_bank]`` asks for.

    Args:
        machine: the machine file.
        bank: its rotor bank.
    """
    # Here, not above: the kernels bring a compiler, which costs a second that `daqsvc check` need not wait.
    from daqsvc.diagnosis.rotor_bank import RotorBankDetector, RotorMode  # noqa: PLC0415
    from daqsvc.rotor.decision import DecisionRules  # noqa: PLC0415
    from daqsvc.rotor.model import RotorParameters  # noqa: PLC0415

    rotor = machine.machine.rotor
    # settings/rotor_checks.py: a rotor bank needs [machine.rotor], and these two in it.
    assert rotor is not None  # noqa: S101
    assert rotor.eccentricity_um is not None  # noqa: S101
    assert rotor.contact_stiffness is not None  # noqa: S101
    grid = machine.grid(bank)
    rate_hz = grid.rate_hz
    return RotorBankDetector(
        machine=machine.machine.name,
        stream=grid.name,
        rate_hz=rate_hz,
        speed_rpm=machine.machine.speed_rpm,
        probes=_probes(machine, grid, bank.probes),
        keyphasor=_keyphasor(machine, grid, bank.keyphasor),
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


def rotor_synchronous(
    machine: MachineFile,
    given: RotorSynchronous,
    known: tuple[LavalRotor, tuple[Calibration, ...]],
    store: Path | None,
) -> Detector:
    """The detector that ``[pipeline.rotor_synchronous]`` asks for.

    Args:
        machine: the machine file.
        given: its calibrated rotor.
        known: what `healthy_rotor` says of it.
        store: directory of the state that survives restarts; None to begin without any and leave none.
    """
    rotor, baselines = known
    calibration, kept = (baselines[0] if baselines else None), None
    if calibration is None and store is not None:
        kept = store / f"{ROTOR_SYNCHRONOUS}.toml"
        calibration = _kept_calibration(kept, machine.machine.speed_rpm, rotor)
    grid = machine.grid(given)
    reference: SpeedReference
    if given.reference == "keyphasor":
        assert given.keyphasor is not None  # noqa: S101 - and then the keyphasor
        reference = _keyphasor(machine, grid, given.keyphasor)
    else:
        reference = given.reference
    return RotorSynchronousDetector(
        machine=machine.machine.name,
        stream=grid.name,
        rate_hz=grid.rate_hz,
        speed_rpm=machine.machine.speed_rpm,
        probes=_probes(machine, grid, given.probes),
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


def _probes(machine: MachineFile, grid: Grid, names: tuple[str, str]) -> tuple[Probe, Probe]:
    def probe(name: str) -> Probe:
        sensor = machine.sensor(name)
        assert isinstance(sensor, ProximityProbe)  # noqa: S101 - settings/rotor_checks.py
        assert sensor.angle_deg is not None  # noqa: S101 - settings/rotor_checks.py
        return Probe(name, grid.column(sensor), sensor.angle_deg, _UM_PER_UNIT[sensor.unit])

    return probe(names[0]), probe(names[1])


def _keyphasor(machine: MachineFile, grid: Grid, name: str) -> KeyphasorProbe:
    sensor = machine.sensor(name)
    assert isinstance(sensor, Keyphasor)  # noqa: S101 - settings/rotor_checks.py
    column = grid.column(sensor)
    return KeyphasorProbe(name, column, sensor.threshold_v, sensor.hysteresis_v, sensor.edge)
