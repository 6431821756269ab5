"""Build the rotor's model bank from a machine file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.detectors.rotor_bank.detector import RotorBankDetector, RotorMode
from daqsvc.detectors.rotor_bank.modes import fault_of, named_besides
from daqsvc.detectors.shaft.build import keyphasor, probes
from daqsvc.rotor.calibration.file import CalibrationFileError, load_record
from daqsvc.rotor.decision import DecisionRules
from daqsvc.rotor.model import RotorParameters

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.detectors.rotor_bank.settings import RotorBank
    from daqsvc.rotor.calibration.two_modes import TwoModeFit
    from daqsvc.settings.models import MachineFile


def bank_detector(machine: MachineFile, bank: RotorBank) -> RotorBankDetector:
    """The detector that ``[pipeline.rotor_bank]`` asks for.

    Args:
        machine: the machine file.
        bank: its rotor bank.

    Raises:
        CalibrationFileError: the run-up that the observers are to be made of cannot be used.
    """
    rotor = healthy_rotor(machine, bank)
    grid = machine.grid(bank.sampled_together)
    rate_hz = grid.rate_hz
    return RotorBankDetector(
        machine=machine.machine.name,
        stream=grid.name,
        rate_hz=rate_hz,
        speed_rpm=machine.machine.speed_rpm,
        probes=probes(machine, grid, bank.probes),
        keyphasor=keyphasor(machine, grid, bank.keyphasor),
        rotor=rotor,
        modes=rotor_modes(machine, bank, rotor),
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


def faults(machine: MachineFile, bank: RotorBank) -> dict[str, str]:
    """By mode the fault that it means.

    Args:
        machine: the machine file.
        bank: its rotor bank.
    """
    rotor = healthy_rotor(machine, bank)
    return {mode.name: fault_of(mode, rotor) for mode in rotor_modes(machine, bank, rotor)}


def besides(machine: MachineFile, bank: RotorBank) -> tuple[str, ...]:
    """What the bank names besides its modes.

    Args:
        machine: the machine file.
        bank: its rotor bank.
    """
    rotor = healthy_rotor(machine, bank)
    return named_besides(rotor_modes(machine, bank, rotor), rotor, ac_coupled=machine.ac_coupled)


def healthy_rotor(machine: MachineFile, bank: RotorBank) -> RotorParameters:
    """The rotor of a machine file that has a rotor bank, as it should be, or as its run-up showed it.

    Args:
        machine: the machine file.
        bank: its rotor bank.

    Raises:
        CalibrationFileError: the file of the run-up cannot be used.
    """
    rotor = machine.machine.rotor
    # detectors/rotor_bank/checks.py: a rotor bank needs [machine.rotor], and these in it.
    assert rotor is not None  # noqa: S101
    assert rotor.contact_stiffness is not None  # noqa: S101
    stated = RotorParameters(
        natural_frequency_hz=rotor.natural_frequency_hz,
        damping_ratio=rotor.damping_ratio,
        eccentricity_um=rotor.eccentricity_um or 0.0,
        heavy_spot_deg=rotor.heavy_spot_deg,
        clearance_um=rotor.clearance_um,
        static_sag_um=rotor.static_sag_um,
        contact_stiffness=rotor.contact_stiffness,
        contact_radius_um=rotor.contact_radius_um,
        static_load_x_um=rotor.static_load_x_um,
        plain_bearings=rotor.plain_bearings,
    )
    if bank.calibration is None:
        return stated
    fit = _run_up(machine.resolve(bank.calibration), machine.machine.speed_rpm)
    return fit.rotor(stated, clockwise=machine.machine.speed_rpm < 0.0)


def _run_up(path: Path, speed_rpm: float) -> TwoModeFit:
    """The rotor's two modes, by a file of ``daqsvc calibrate``.

    Raises:
        CalibrationFileError: there are none, they do not represent the machine, or not at its speed.
    """
    fit = load_record(path).two_modes
    if fit is None:
        raise CalibrationFileError(
            f"{path}: holds no run-up, of which observers could be made; give daqsvc calibrate a recording "
            "of a run-up or a coast-down, or remove pipeline.rotor_bank.calibration"
        )
    if not fit.explains:
        raise CalibrationFileError(
            f"{path}: {fit.describe()}; watch this machine with [pipeline.rotor_synchronous]"
        )
    if not fit.holds_at(speed_rpm):
        low, high = fit.speed_range_rpm
        raise CalibrationFileError(
            f"{path}: the run-up went from {low:.0f} to {high:.0f} rpm, and machine.speed_rpm is "
            f"{speed_rpm:g}; record one that passes it"
        )
    return fit


def rotor_modes(machine: MachineFile, bank: RotorBank, rotor: RotorParameters) -> list[RotorMode]:
    """The modes of a rotor bank, healthy first.

    Damping is stated over that of [machine.rotor]; of a rotor as its run-up showed it, it is the same part of
    that one's.

    Args:
        machine: the machine file.
        bank: its rotor bank.
        rotor: what `healthy_rotor` states about it.
    """
    stated = machine.machine.rotor
    assert stated is not None  # noqa: S101 - see `healthy_rotor`
    damping = rotor.damping_ratio / stated.damping_ratio
    return [
        RotorMode(
            mode.name,
            None if mode.damping_ratio is None else mode.damping_ratio * damping,
            mode.severity,
            mode.rub,
            fault=mode.fault,
            unbalance_ratio=mode.unbalance_ratio,
            stiffness_ratio=mode.stiffness_ratio,
            static_load_um=mode.static_load_um,
        )
        for mode in bank.modes
    ]
