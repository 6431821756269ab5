"""The rotor's model bank as a plugin."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.detectors.rotor_bank.checks import bank_checks, check_bank_alarm
from daqsvc.detectors.rotor_bank.settings import ROTOR_BANK, RotorBank
from daqsvc.diagnosis.plugin import Detectability, DetectorPlugin, UnfitOptionError
from daqsvc.diagnosis.reading import Reading
from daqsvc.errors.detectors import CALIBRATION_FILE, NO_OBSERVERS
from daqsvc.settings.problems import AssemblyError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from daqsvc.detectors.rotor_bank.detector import RotorBankDetector
    from daqsvc.detectors.rotor_bank.recorded import RecordedBank
    from daqsvc.detectors.rotor_bank.settings import Mode
    from daqsvc.diagnosis.plugin import DetectabilityOptions
    from daqsvc.diagnosis.recorded import RecordingOptions
    from daqsvc.settings.models import MachineFile
    from daqsvc.settings.problems import Finding, KeyPath


class RotorBankPlugin(DetectorPlugin[RotorBank]):
    """One observer per mode of the rotor, and the rule that decides between them."""

    settings = RotorBank
    about = "the rotor's model bank"
    detector = ROTOR_BANK
    states_speed = True
    predictable = True
    place = 1

    def sampled_together(self, settings: RotorBank) -> tuple[str, ...]:
        """See `PipelineTable.sampled_together`."""
        return settings.sampled_together

    def checks(self, draft: MachineFile, settings: RotorBank) -> Iterator[Iterator[Finding]]:
        """See `PipelineTable.checks`."""
        return bank_checks(draft, settings)

    def alarm_checks(self, settings: RotorBank, at: KeyPath) -> Iterator[Finding]:
        """See `PipelineTable.alarm_checks`."""
        return check_bank_alarm(settings, at)

    def start_up_signals(self, draft: MachineFile, settings: RotorBank) -> Mapping[str, tuple[str, ...]]:
        """See `PipelineTable.start_up_signals`."""
        del draft, settings
        return {ROTOR_BANK: ("speed",)}

    def faults(self, machine: MachineFile, settings: RotorBank) -> Mapping[str, Mapping[str, str]]:
        """See `DetectorPlugin.faults`."""
        from daqsvc.detectors.rotor_bank.build import faults  # noqa: PLC0415 - the kernels bring a compiler

        return {ROTOR_BANK: faults(machine, settings)}

    def describe(self, machine: MachineFile, settings: RotorBank) -> str:
        """See `PipelineTable.describe`."""
        del machine
        text = (
            f"{settings.probes[0]}, {settings.probes[1]} and {settings.keyphasor}; "
            f"noise {settings.noise_um:g} um; "
            f"rule {settings.rule}, {_thresholds(settings)}; "
        )
        if settings.calibration is not None:
            text += f"two modes from the run-up in {settings.calibration}; "
        if settings.calibrate_revolutions:
            text += f"unbalance and sag from the first {settings.calibrate_revolutions} revolutions; "
        return f"{text}modes {', '.join(map(_mode, settings.modes))}"

    def build(
        self, machine: MachineFile, settings: RotorBank, store: Path | None
    ) -> tuple[RotorBankDetector, ...]:
        """See `DetectorPlugin.build`."""
        del store
        # Here, not above: the kernels bring a compiler, which costs a second.
        from daqsvc.detectors.rotor_bank.build import bank_detector  # noqa: PLC0415
        from daqsvc.rotor.calibration.file import CalibrationFileError  # noqa: PLC0415

        try:
            return (bank_detector(machine, settings),)
        except CalibrationFileError as error:
            raise AssemblyError(
                f"{machine.path}: pipeline.rotor_bank.calibration: {error}", code=CALIBRATION_FILE
            ) from error
        except (ValueError, ArithmeticError) as error:
            raise AssemblyError(
                f"{machine.path}: pipeline.rotor_bank: its observers cannot be made of these figures "
                f"({error}); correct noise_um, process_noise, modes, or [machine.rotor]",
                code=NO_OBSERVERS,
            ) from error

    def check_files(self, machine: MachineFile, settings: RotorBank) -> None:
        """See `DetectorPlugin.check_files`: whether observers can be made of the figures."""
        self.build(machine, settings, None)

    def recorded(self, machine: MachineFile, settings: RotorBank, options: RecordingOptions) -> RecordedBank:
        """See `DetectorPlugin.recorded`."""
        from daqsvc.detectors.rotor_bank.recorded import RecordedBank  # noqa: PLC0415 - brings SciPy

        return RecordedBank(machine, settings, options)

    def detectability(
        self, machine: MachineFile, settings: RotorBank, options: DetectabilityOptions
    ) -> Detectability:
        """See `DetectorPlugin.detectability`."""
        if options.noise_um is not None or options.eccentricity_um is not None:
            raise UnfitOptionError(
                "--noise-um, --eccentricity-um: pipeline.rotor_bank.noise_um and "
                "machine.rotor.eccentricity_um state this; leave them out"
            )
        from daqsvc.detectors.rotor_bank import detectability as bank  # noqa: PLC0415 - brings the compiler

        try:
            (detector,) = self.build(machine, settings, None)
        except AssemblyError as error:
            # Who asks names the file.
            raise ValueError(str(error).removeprefix(f"{machine.path}: ")) from error
        prediction = bank.bank_detectability(machine, settings, detector, options.process_noise)
        name = machine.machine.name
        return Detectability(
            {**bank.as_json(prediction, name, detector)}, bank.as_text(prediction, name, detector)
        )

    def readings(self, machine: MachineFile, settings: RotorBank) -> Iterator[Reading]:
        """See `DetectorPlugin.readings`."""
        yield Reading(ROTOR_BANK, "statistics", "speed", "rpm")
        for mode in settings.modes:
            yield Reading(ROTOR_BANK, "probabilities", mode.name)
        if settings.calibration is not None:
            from daqsvc.detectors.rotor_bank.build import besides  # noqa: PLC0415 - brings the compiler

            for name in besides(machine, settings):
                yield Reading(ROTOR_BANK, "probabilities", name)


def _thresholds(bank: RotorBank) -> str:
    forward, back = f"{bank.threshold_nats:g} nats forward", f"{bank.back_threshold_nats:g} back"
    if bank.false_alarms_per_1000_rev is not None:
        forward = f"at most {bank.false_alarms_per_1000_rev:g} false alarms in 1000 revolutions"
    if bank.mtbf_hours is not None:
        back = f"MTBF {bank.mtbf_hours:g} h"
    return f"{forward}, {back}"


def _mode(mode: Mode) -> str:
    words = {
        "damping_ratio": f"zeta {mode.damping_ratio:g}" if mode.damping_ratio is not None else "",
        "unbalance_ratio": f"unbalance x {mode.unbalance_ratio:g}",
        "stiffness_ratio": f"stiffness x {mode.stiffness_ratio:g}",
        "static_load_um": f"static load {mode.static_load_um[0]:g}, {mode.static_load_um[1]:g} um",
        "rub": "rub",
    }
    differs = ", ".join(words[key] for key in mode.differs) or "as stated"
    return f"{mode.name} ({differs}: {mode.severity})"
