"""The arguments of ``daqsvc analyze``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.analysis.acceleration import ACCELERATION_UNITS
from daqsvc.commands.option_types import calibration_length, count, positive
from daqsvc.commands.shared_arguments import TOLERANCE_PERCENT, add_channel_map, add_rotor, unknown_channels
from daqsvc.recording.channels import LENGTH_UNITS

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

CALIBRATE_REVOLUTIONS = 50
FALSE_ALARMS_PER_1000_REV = 0.1


def add_rotor_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that stand in for a machine file."""
    rotor = parser.add_argument_group("without a machine file")
    add_rotor(
        rotor.add_argument,
        speed_help="shaft speed, negative if clockwise: nominal with a keyphasor, else exact to half of its "
        "last digit",
    )
    rotor.add_argument("--follow-orbit", action="store_true", help="the same as --speed-rpm orbit:N")
    rotor.add_argument(
        "--calibrate-revs",
        type=calibration_length,
        default=CALIBRATE_REVOLUTIONS,
        metavar="N",
        help=f"revolutions of the healthy machine at the start (default: {CALIBRATE_REVOLUTIONS})",
    )
    rotor.add_argument(
        "--false-alarms-per-1000-rev",
        type=positive,
        default=FALSE_ALARMS_PER_1000_REV,
        metavar="R",
        help=f"rate of false alarms to accept (default: {FALSE_ALARMS_PER_1000_REV:g})",
    )


def add_machine_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that both forms know."""
    both = parser.add_argument_group("about the recordings")
    add_channel_map(both.add_argument)
    both.add_argument(
        "--unit",
        choices=(*LENGTH_UNITS, *ACCELERATION_UNITS),
        help="unit of the samples (default: um, or the machine file's; of accelerometers: g)",
    )
    both.add_argument(
        "--calibration",
        type=Path,
        metavar="FILE",
        help="the healthy machine as daqsvc calibrate wrote it, in place of the first revolutions",
    )


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """What comes out, and how."""
    output = parser.add_argument_group("output")
    output.add_argument(
        "--json", action="store_true", help="one JSON object a line for each recording, in the order given"
    )
    output.add_argument(
        "--plot",
        type=Path,
        metavar="DIR",
        help="write figures there: orbit, Poincare map, phase plane, probabilities, innovations, polar plot",
    )
    output.add_argument(
        "--jobs",
        type=count,
        metavar="N",
        help="processes at a time (default: as many as there are cores, fewer for a few recordings)",
    )


def misuse(arguments: argparse.Namespace, machine: str | None, recordings: Sequence[str]) -> str:
    """What is wrong with arguments that are sound one by one; empty if nothing is."""
    if not recordings:
        return f"{machine} is a machine file, and there is no recording after it; name at least one"
    if machines := [name for name in recordings if name.lower().endswith(".toml")]:
        return f"{machines[0]} is not a recording; a machine file comes first, and there is only one"
    if arguments.unit in ACCELERATION_UNITS:
        return f"--unit {arguments.unit}: proximity probes measure in {', '.join(LENGTH_UNITS)}"
    given = rotor_options(arguments)
    if machine is not None:
        extra = [name for name, is_there in given.items() if is_there]
        return f"{', '.join(extra)}: the machine file says this; leave it out" if extra else ""
    known = [
        name
        for name in ("--natural-frequency-hz", "--damping-ratio", "--static-sag-um")
        if given[name] and arguments.calibration is not None
    ]
    if known:
        return f"{', '.join(known)}: the calibration says this; leave it out, or leave out --calibration"
    return _lacking(arguments, given) or unknown_channels(arguments)


def rotor_options(arguments: argparse.Namespace) -> dict[str, bool]:
    """Which of the options of `add_rotor_arguments` are given."""
    return {
        "--probes": arguments.probes is not None,
        "--speed-rpm": arguments.speed_rpm is not None,
        "--follow-orbit": arguments.follow_orbit,
        "--keyphasor": arguments.keyphasor is not None,
        "--keyphasor-threshold": arguments.keyphasor_threshold is not None,
        "--natural-frequency-hz": arguments.natural_frequency_hz is not None,
        "--damping-ratio": arguments.damping_ratio is not None,
        "--clearance-um": arguments.clearance_um is not None,
        "--static-sag-um": arguments.static_sag_um is not None,
        "--calibrate-revs": arguments.calibrate_revs != CALIBRATE_REVOLUTIONS,
        "--false-alarms-per-1000-rev": arguments.false_alarms_per_1000_rev != FALSE_ALARMS_PER_1000_REV,
        "--ac-coupled": arguments.ac_coupled,
        "--natural-frequency-tolerance": arguments.natural_frequency_tolerance != TOLERANCE_PERCENT,
        "--damping-tolerance": arguments.damping_tolerance != TOLERANCE_PERCENT,
    }


def _lacking(arguments: argparse.Namespace, given: dict[str, bool]) -> str:
    needed = ["--probes"]
    if arguments.calibration is None:
        needed += ["--natural-frequency-hz", "--damping-ratio"]
    if arguments.keyphasor is None:
        needed.append("--speed-rpm")
        if arguments.keyphasor_threshold is not None:
            return "--keyphasor-threshold without --keyphasor: name the channel of the keyphasor"
    missing = [name for name in needed if not given[name]]
    if not missing:
        return ""
    instead = ", or --keyphasor in place of --speed-rpm" if "--speed-rpm" in missing else ""
    return f"without a machine file, {', '.join(missing)} must be given{instead}"
