"""``daqsvc detectability MACHINE``: what can be seen of a machine's rotor, before anything breaks."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from daqsvc.commands.arguments import EXIT_OK, EXIT_USAGE, positive
from daqsvc.commands.complaint import complain
from daqsvc.commands.with_kernels import VerbWithKernels
from daqsvc.errors.code import with_code
from daqsvc.errors.command_line import ARGUMENTS, WRONG_VALUE
from daqsvc.errors.machine_file import MISSING_KEY

if TYPE_CHECKING:
    from daqsvc.diagnosis.plugin import DetectorPlugin
    from daqsvc.errors.code import Code
    from daqsvc.settings import MachineFile

LEAST_FALSE_ALARMS = 1e-9
MOST_FALSE_ALARMS = 10.0
"""Per 1000 revolutions: what a machine file may state."""


class DetectabilityCommand(VerbWithKernels):
    """``daqsvc detectability MACHINE``."""

    help = "compute which faults of a rotor can be told apart, how soon, and from which size on"
    description = (
        "Compute, before any fault happens, which faults the rotor bank of a machine file can tell "
        "apart. Print the evidence between every two modes in nats per revolution, and the expected "
        "delay of its alarms. Also print the smallest visible change of every kind, and the modes that "
        "look the same at this speed. Without a rotor bank, compute what [pipeline.rotor_synchronous] can "
        "see: from its calibration, or from --noise-um."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `Command.add_arguments`."""
        parser.add_argument("file", type=Path, metavar="MACHINE", help="machine file (TOML)")
        parser.add_argument(
            "--speed-rpm",
            type=positive,
            metavar="N",
            help="speed of the shaft (default: that of the machine file); the direction is that of the file",
        )
        parser.add_argument(
            "--false-alarms-per-1000-rev",
            type=positive,
            metavar="R",
            help="false alarms to accept in 1000 revolutions, which set the threshold (default: that of "
            "the file)",
        )
        parser.add_argument(
            "--process-noise",
            type=positive,
            metavar="Q",
            help="random motion of the machine itself: normalised power spectral density of its acceleration "
            "(default: process_noise of the file, which is mostly more than a machine has)",
        )
        parser.add_argument(
            "--noise-um",
            type=positive,
            metavar="N",
            help="without a rotor bank: noise of one probe, in um, if there is no calibration",
        )
        parser.add_argument(
            "--eccentricity-um",
            type=positive,
            metavar="E",
            help="without a rotor bank: mass eccentricity, in um, if it is neither in calibration nor file",
        )
        # For the page, which knows what is in force, and where the files that it names are.
        parser.add_argument("--values-in", type=Path, metavar="FOLDER", help=argparse.SUPPRESS)
        parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")

    def run(self, arguments: argparse.Namespace) -> int:
        """See `Command.run`."""
        folder = arguments.values_in
        machine = self._load(arguments.file) if folder is None else _of_values(arguments.file, folder)
        if machine is None:
            return EXIT_USAGE
        from daqsvc.diagnosis.plugin import DetectabilityOptions, UnfitOptionError  # noqa: PLC0415 - pydantic
        from daqsvc.settings.plugins import configured  # noqa: PLC0415 - as above
        from daqsvc.settings.problems import AssemblyError  # noqa: PLC0415 - as above

        if wrong := _misuse(machine, arguments):
            who, what, code = wrong
            return complain(who, what, code, EXIT_USAGE)
        machine = _varied(machine, arguments.speed_rpm, arguments.false_alarms_per_1000_rev)
        plugin, settings = next(
            (table, settings) for _, table, settings in configured(machine.pipeline) if _is_predictable(table)
        )
        options = DetectabilityOptions(
            process_noise=arguments.process_noise,
            noise_um=arguments.noise_um,
            eccentricity_um=arguments.eccentricity_um,
        )
        self._prepare_kernel_cache()
        try:
            prediction = cast("DetectorPlugin[Any]", plugin).detectability(machine, settings, options)
        except UnfitOptionError as error:
            return complain(f"{arguments.file}", error, error.code, EXIT_USAGE)
        except AssemblyError as error:
            return complain(f"{arguments.file}", error, error.code)
        except ValueError as error:
            return complain(f"{arguments.file}", error, ARGUMENTS)
        print(json.dumps(prediction.json) if arguments.json else prediction.text)  # noqa: T201 - this is what the verb is for
        return EXIT_OK


def _of_values(file: Path, folder: Path) -> MachineFile | None:
    """The machine file of values in JSON, as if it lay in a folder; None after its errors were printed."""
    from daqsvc.settings.load import machine_file_of  # noqa: PLC0415 - brings pydantic
    from daqsvc.settings.problems import MachineFileError  # noqa: PLC0415 - as above

    try:
        return machine_file_of(json.loads(file.read_text()), folder / "machine.toml")
    except MachineFileError as error:
        problem = error.problems[0]
        print(with_code(problem.message, problem.code), file=sys.stderr)  # noqa: T201 - as `complain`, for the page
        return None


def _is_predictable(table: object) -> bool:
    return cast("DetectorPlugin[Any]", table).predictable


def _misuse(machine: MachineFile, arguments: argparse.Namespace) -> tuple[str, str, Code] | None:
    """What is wrong with the machine file or the options, as `complain` takes it; None if nothing is."""
    from daqsvc.settings.plugins import configured, detector_tables  # noqa: PLC0415 - brings pydantic

    if not any(_is_predictable(table) for _, table, _ in configured(machine.pipeline)):
        known = [f"[pipeline.{key}]" for key, table in detector_tables().items() if _is_predictable(table)]
        lacking = (
            f"there is neither {' nor '.join(known)}, whose view of a fault could be computed; add one, with "
            "[machine.rotor] for the rotor that it watches"
        )
        return f"{arguments.file}", lacking, MISSING_KEY
    rate = arguments.false_alarms_per_1000_rev
    if rate is not None and not LEAST_FALSE_ALARMS <= rate <= MOST_FALSE_ALARMS:
        beyond = (
            f"--false-alarms-per-1000-rev = {rate:g}: give a rate from {LEAST_FALSE_ALARMS:g} to "
            f"{MOST_FALSE_ALARMS:g}"
        )
        return "daqsvc detectability", beyond, WRONG_VALUE
    return None


def _varied(
    machine: MachineFile, speed_rpm: float | None, false_alarms_per_1000_rev: float | None
) -> MachineFile:
    """The machine file at another speed or rate of false alarms."""
    from daqsvc.settings.plugins import configured  # noqa: PLC0415 - brings pydantic

    if speed_rpm is not None:
        signed_rpm = math.copysign(speed_rpm, machine.machine.speed_rpm)
        at_speed = machine.machine.model_copy(update={"speed_rpm": signed_rpm})
        machine = machine.model_copy(update={"machine": at_speed})
    if false_alarms_per_1000_rev is not None:
        update = {"false_alarms_per_1000_rev": false_alarms_per_1000_rev}
        watching = {
            key: settings.model_copy(update=update)
            for key, _, settings in configured(machine.pipeline)
            if update.keys() <= type(settings).model_fields.keys()
        }
        machine = machine.model_copy(update={"pipeline": machine.pipeline.model_copy(update=watching)})
    return machine
