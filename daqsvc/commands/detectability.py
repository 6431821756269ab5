"""``daqsvc detectability MACHINE``: what can be seen of a machine's rotor, before anything breaks."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.commands.arguments import EXIT_OK, positive

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

    from daqsvc.rotor.detectability.prediction import Detectability
    from daqsvc.settings import MachineFile

LEAST_FALSE_ALARMS = 1e-9
MOST_FALSE_ALARMS = 10.0
"""Per 1000 revolutions: what a machine file may say."""

_FAILED = 1
_BAD_FILE = 2


class DetectabilityCommand:
    """``daqsvc detectability MACHINE``.

    Args:
        load: reads a machine file; None after its errors have been printed.
        prepare_kernel_cache: says where compiled kernels are kept.
    """

    help = "say what can be told apart on a machine's rotor, how soon, and from which change on"
    description = (
        "Say, before any fault happens, what the rotor bank of a machine file can tell apart: evidence "
        "between every two modes in nats a revolution, expected delay of its alarms, smallest visible "
        "change of every kind, and which modes look the same at this speed. Without a rotor bank, what the "
        "synchronous vector of [pipeline.rotor_synchronous] can see: by its calibration, or by --noise-um."
    )

    def __init__(
        self, load: Callable[[Path], MachineFile | None], prepare_kernel_cache: Callable[[], None]
    ) -> None:
        self._load = load
        self._prepare_kernel_cache = prepare_kernel_cache

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `Command.add_arguments`."""
        parser.add_argument("file", type=Path, metavar="MACHINE", help="the machine file (TOML)")
        parser.add_argument(
            "--speed-rpm",
            type=positive,
            metavar="N",
            help="another speed than the machine file's, in the same direction",
        )
        parser.add_argument(
            "--false-alarms-per-1000-rev",
            type=positive,
            metavar="R",
            help="set the threshold by the false alarms to accept on a healthy machine, not by the file",
        )
        parser.add_argument(
            "--process-noise",
            type=positive,
            metavar="Q",
            help="how much the machine itself shakes at random: power spectral density of the acceleration, "
            "normalised (default: process_noise of the file, mostly more than a machine has)",
        )
        parser.add_argument(
            "--noise-um",
            type=positive,
            metavar="N",
            help="without a rotor bank: noise of one probe, where no calibration tells it",
        )
        parser.add_argument(
            "--eccentricity-um",
            type=positive,
            metavar="E",
            help="without a rotor bank: mass eccentricity, where neither calibration nor file tells it",
        )
        parser.add_argument("--json", action="store_true", help="print one JSON object")

    def run(self, arguments: argparse.Namespace) -> int:
        """See `Command.run`."""
        from daqsvc.detectors.rotor_bank.settings import RotorBank  # noqa: PLC0415 - brings pydantic

        machine = self._load(arguments.file)
        if machine is None:
            return _BAD_FILE
        if wrong := _misuse(machine, arguments):
            _complain(f"{arguments.file}: {wrong}")
            return _BAD_FILE
        machine = _varied(machine, arguments.speed_rpm, arguments.false_alarms_per_1000_rev)
        if machine.pipeline.table(RotorBank) is None:
            return _tell_vector(machine, arguments)
        self._prepare_kernel_cache()
        from daqsvc.commands.detectability_report import as_json, as_text  # noqa: PLC0415
        from daqsvc.settings.problems import AssemblyError  # noqa: PLC0415 - it brings the kernels' compiler

        try:
            found = _foresee(machine, arguments.process_noise)
        except (AssemblyError, ValueError) as error:
            _complain(f"{arguments.file}: {error}")
            return _FAILED
        print(json.dumps(as_json(found, machine)) if arguments.json else as_text(found, machine))  # noqa: T201
        return EXIT_OK


def _misuse(machine: MachineFile, arguments: argparse.Namespace) -> str:
    """What is wrong with the options for this machine; empty if nothing is."""
    from daqsvc.detectors.rotor_bank.settings import RotorBank  # noqa: PLC0415 - brings pydantic
    from daqsvc.detectors.rotor_synchronous.settings import RotorSynchronous  # noqa: PLC0415 - brings pydantic

    pipeline = machine.pipeline
    if pipeline.table(RotorBank) is None and pipeline.table(RotorSynchronous) is None:
        return (
            "there is neither [pipeline.rotor_bank], whose modes could be told apart, nor "
            "[pipeline.rotor_synchronous]; add one, with [machine.rotor] for the rotor that it watches"
        )
    if pipeline.table(RotorBank) is None:
        if arguments.process_noise is not None:
            return "--process-noise: there is no [pipeline.rotor_bank] that it belongs to; leave it out"
    elif arguments.noise_um is not None or arguments.eccentricity_um is not None:
        return (
            "--noise-um, --eccentricity-um: pipeline.rotor_bank.noise_um and machine.rotor.eccentricity_um "
            "say this; leave them out"
        )
    rate = arguments.false_alarms_per_1000_rev
    if rate is not None and not LEAST_FALSE_ALARMS <= rate <= MOST_FALSE_ALARMS:
        return (
            f"--false-alarms-per-1000-rev = {rate:g}: give a rate from {LEAST_FALSE_ALARMS:g} to "
            f"{MOST_FALSE_ALARMS:g}"
        )
    return ""


def _tell_vector(machine: MachineFile, arguments: argparse.Namespace) -> int:
    """Print what the synchronous vector can see."""
    from daqsvc.commands.detectability_vector import (  # noqa: PLC0415 - it brings NumPy
        foresee_vector,
        vector_json,
        vector_text,
    )

    try:
        found = foresee_vector(
            machine, noise_um=arguments.noise_um, eccentricity_um=arguments.eccentricity_um
        )
    except ValueError as error:
        _complain(f"{arguments.file}: {error}")
        return _FAILED
    print(json.dumps(vector_json(found, machine)) if arguments.json else vector_text(found, machine))  # noqa: T201
    return EXIT_OK


def _foresee(machine: MachineFile, process_noise: float | None) -> Detectability:
    """Detectability of the bank that the service would run for this machine file."""
    from daqsvc.detectors.make import detectors  # noqa: PLC0415
    from daqsvc.detectors.rotor_bank.detector import RotorBankDetector  # noqa: PLC0415
    from daqsvc.detectors.rotor_bank.settings import RotorBank  # noqa: PLC0415 - brings pydantic
    from daqsvc.rotor.adaptation import VARIANCE_FACTOR  # noqa: PLC0415
    from daqsvc.rotor.detectability.prediction import detectability  # noqa: PLC0415

    (detector,) = (made for made in detectors(machine) if isinstance(made, RotorBankDetector))
    bank = machine.pipeline.table(RotorBank)
    calibrates = bank is not None and bank.calibrate_revolutions > 0
    return detectability(
        detector.bank_modes,
        noise=detector.noise,
        duration=detector.duration,
        threshold_nats=detector.rules.thresholds(len(detector.bank_modes)),
        variance_factor=VARIANCE_FACTOR if calibrates else 1.0,
        process_noise=process_noise,
        ac_coupled=machine.ac_coupled,
    )


def _varied(
    machine: MachineFile, speed_rpm: float | None, false_alarms_per_1000_rev: float | None
) -> MachineFile:
    """The machine file at another speed or rate of false alarms."""
    if speed_rpm is not None:
        signed_rpm = math.copysign(speed_rpm, machine.machine.speed_rpm)
        at_speed = machine.machine.model_copy(update={"speed_rpm": signed_rpm})
        machine = machine.model_copy(update={"machine": at_speed})
    if false_alarms_per_1000_rev is not None:
        update = {"false_alarms_per_1000_rev": false_alarms_per_1000_rev}
        watching = {
            name: getattr(machine.pipeline, name).model_copy(update=update)
            for name in ("rotor_bank", "rotor_synchronous")
            if getattr(machine.pipeline, name) is not None
        }
        machine = machine.model_copy(update={"pipeline": machine.pipeline.model_copy(update=watching)})
    return machine


def _complain(message: str) -> None:
    print(message, file=sys.stderr)  # noqa: T201 - errors of the command line go to stderr
