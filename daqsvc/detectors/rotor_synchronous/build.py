"""Build the calibrated rotor from a machine file: its detector, and its healthy state."""

from __future__ import annotations

import logging
import os
from functools import partial
from typing import TYPE_CHECKING

from daqsvc.detectors.rotor_synchronous.detector import RotorSynchronousDetector
from daqsvc.detectors.rotor_synchronous.settings import ROTOR_SYNCHRONOUS
from daqsvc.detectors.shaft.build import keyphasor, probes
from daqsvc.diagnosis.recorded import known
from daqsvc.errors.code import coded
from daqsvc.errors.detectors import HEALTHY_STATE
from daqsvc.rotor.calibration.file import (
    CalibrationFileError,
    load_calibration,
    load_healthy,
    save_calibration,
)
from daqsvc.rotor.laval import LavalRotor
from daqsvc.rotor.synchronous.baseline import with_rotor
from daqsvc.rotor.synchronous.watch import WatchRules

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.detectors.rotor_synchronous.detector import SpeedReference
    from daqsvc.detectors.rotor_synchronous.settings import RotorSynchronous
    from daqsvc.diagnosis.detector import Detector
    from daqsvc.rotor.synchronous.baseline import Calibration
    from daqsvc.settings.models import MachineFile

log = logging.getLogger(__name__)


def healthy_rotor(
    machine: MachineFile, settings: RotorSynchronous, calibration: Path | None = None
) -> tuple[LavalRotor, tuple[Calibration, ...]]:
    """What is known of the calibrated rotor: by its calibration if there is one, else by the machine file.

    Args:
        machine: the machine file.
        settings: its calibrated rotor.
        calibration: file to take in place of the one that the machine file names.

    Returns:
        See `load_healthy`: at most one baseline, that of the machine's speed if it is known.

    Raises:
        CalibrationFileError: the calibration cannot be used at the machine's speed.
    """
    rotor = machine.machine.rotor
    assert rotor is not None  # noqa: S101 - detectors/shaft/checks.py: it needs [machine.rotor]
    if calibration is None and settings.calibration is not None:
        calibration = machine.resolve(settings.calibration)
    if calibration is not None:
        return load_healthy(
            calibration,
            known(machine.machine.speed_rpm),
            rotor.clearance_um,
            plain_bearings=rotor.plain_bearings,
        )
    stated = LavalRotor(
        natural_frequency_hz=rotor.natural_frequency_hz,
        damping_ratio=rotor.damping_ratio,
        natural_frequency_tolerance=settings.natural_frequency_tolerance_percent / 100.0,
        damping_tolerance=settings.damping_tolerance_percent / 100.0,
        clearance_um=rotor.clearance_um,
        static_sag_um=rotor.static_sag_um,
        plain_bearings=rotor.plain_bearings,
    )
    return stated, ()


def rotor_synchronous(
    machine: MachineFile,
    settings: RotorSynchronous,
    known: tuple[LavalRotor, tuple[Calibration, ...]],
    store: Path | None,
) -> Detector:
    """The detector that ``[pipeline.rotor_synchronous]`` asks for.

    Args:
        machine: the machine file.
        settings: its calibrated rotor.
        known: what `healthy_rotor` states about it.
        store: directory of the state that survives restarts; None to begin without any and leave none.
    """
    rotor, baselines = known
    calibration, kept = (baselines[0] if baselines else None), None
    if calibration is None and store is not None:
        kept = store / f"{ROTOR_SYNCHRONOUS}.toml"
        calibration = _kept_calibration(kept, machine.machine.speed_rpm, rotor)
    grid = machine.grid(settings.sampled_together)
    reference: SpeedReference
    if settings.reference == "keyphasor":
        assert settings.keyphasor is not None  # noqa: S101 - and then the keyphasor
        reference = keyphasor(machine, grid, settings.keyphasor)
    else:
        reference = settings.reference
    return RotorSynchronousDetector(
        machine=machine.machine.name,
        stream=grid.name,
        rate_hz=grid.rate_hz,
        speed_rpm=machine.machine.speed_rpm,
        probes=probes(machine, grid, settings.probes),
        reference=reference,
        rotor=rotor,
        rules=WatchRules(
            calibrate_revolutions=settings.calibrate_revolutions,
            false_alarms_per_1000_rev=settings.false_alarms_per_1000_rev,
            probe_drift_um=settings.probe_drift_um,
        ),
        calibration=calibration,
        ac_coupled=machine.ac_coupled,
        keep=None if kept is None else partial(_keep_calibration, kept),
    )


def _kept_calibration(path: Path, speed_rpm: float, rotor: LavalRotor) -> Calibration | None:
    """The healthy state that was measured before a restart, with what the file states about the rotor now."""
    if not os.path.lexists(path):  # also if it cannot be read: the outbox reports that
        return None
    try:
        return with_rotor(load_calibration(path, speed_rpm), rotor)
    except CalibrationFileError as error:
        log.warning("the healthy state of the rotor is measured again: %s", error, extra=coded(HEALTHY_STATE))
        return None


def _keep_calibration(path: Path, calibration: Calibration) -> None:
    """Keep the healthy state, so that a restart does not take a faulty machine for a healthy one."""
    try:
        save_calibration(calibration, path, source="the running service")
    except CalibrationFileError as error:
        log.error(  # noqa: TRY400 - the message is enough
            "the healthy state of the rotor will be lost at the next restart: %s",
            error,
            extra=coded(HEALTHY_STATE),
        )
