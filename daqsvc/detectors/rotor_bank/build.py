"""The rotor's model bank out of a machine file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.detectors.rotor_bank.detector import RotorBankDetector, RotorMode
from daqsvc.detectors.rotor_bank.modes import fault_of
from daqsvc.detectors.shaft.build import keyphasor, probes
from daqsvc.rotor.decision import DecisionRules
from daqsvc.rotor.model import RotorParameters

if TYPE_CHECKING:
    from daqsvc.detectors.rotor_bank.settings import RotorBank
    from daqsvc.settings.models import MachineFile


def bank_detector(machine: MachineFile, bank: RotorBank) -> RotorBankDetector:
    """The detector that ``[pipeline.rotor_bank]`` asks for.

    Args:
        machine: the machine file.
        bank: its rotor bank.
    """
    grid = machine.grid(bank.sampled_together)
    rate_hz = grid.rate_hz
    return RotorBankDetector(
        machine=machine.machine.name,
        stream=grid.name,
        rate_hz=rate_hz,
        speed_rpm=machine.machine.speed_rpm,
        probes=probes(machine, grid, bank.probes),
        keyphasor=keyphasor(machine, grid, bank.keyphasor),
        rotor=healthy_rotor(machine),
        modes=rotor_modes(bank),
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
    rotor = healthy_rotor(machine)
    return {mode.name: fault_of(mode, rotor) for mode in rotor_modes(bank)}


def healthy_rotor(machine: MachineFile) -> RotorParameters:
    """The rotor of a machine file that has a rotor bank, as it should be."""
    rotor = machine.machine.rotor
    # detectors/shaft/checks.py: a rotor bank needs [machine.rotor], and these two in it.
    assert rotor is not None  # noqa: S101
    assert rotor.eccentricity_um is not None  # noqa: S101
    assert rotor.contact_stiffness is not None  # noqa: S101
    return RotorParameters(
        natural_frequency_hz=rotor.natural_frequency_hz,
        damping_ratio=rotor.damping_ratio,
        eccentricity_um=rotor.eccentricity_um,
        heavy_spot_deg=rotor.heavy_spot_deg,
        clearance_um=rotor.clearance_um,
        static_sag_um=rotor.static_sag_um,
        contact_stiffness=rotor.contact_stiffness,
        contact_radius_um=rotor.contact_radius_um,
        static_load_x_um=rotor.static_load_x_um,
    )


def rotor_modes(bank: RotorBank) -> list[RotorMode]:
    """The modes of a rotor bank, healthy first."""
    return [
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
    ]
