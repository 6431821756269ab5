"""The arguments of ``daqsvc analyze``."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.analysis.acceleration import ACCELERATION_UNITS
from daqsvc.recording.channels import LENGTH_UNITS, channel_map, sampling_rate_hz

if TYPE_CHECKING:
    from collections.abc import Sequence

CALIBRATE_REVOLUTIONS = 50
FALSE_ALARMS_PER_1000_REV = 0.1
TOLERANCE_PERCENT = 20.0

_ORBIT = "orbit:"


@dataclass(frozen=True, slots=True)
class SpeedOption:
    """What ``--speed-rpm`` says.

    Attributes:
        rpm: the speed, negative if clockwise.
        orbit: whether the orbit's own 1X is followed about it.
        step_rpm: the step of its last digit: 5111 is not 5111.000.
    """

    rpm: float | None
    orbit: bool = False
    step_rpm: float = 0.0


class _MergedMap(argparse.Action):
    """``--map A=1,B=2 --map C=3``: all of them, none twice."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> None:
        assert isinstance(values, dict)  # noqa: S101 - made by channel_map
        merged = dict(getattr(namespace, self.dest))
        for name, variable in values.items():
            if name in merged:
                parser.error(f"{option_string} names {name!r} twice; give each channel one variable")
            merged[name] = variable
        setattr(namespace, self.dest, merged)


def add_rotor_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that stand in for a machine file."""
    rotor = parser.add_argument_group("without a machine file")
    rotor.add_argument(
        "--probes", type=probe_pair, metavar="X,Y", help="channels of the two probes, y 90 degrees after x"
    )
    rotor.add_argument(
        "--speed-rpm",
        type=speed,
        metavar="N",
        help="shaft speed, negative if clockwise: nominal with a keyphasor, else exact to half of its last "
        "digit; orbit:N follows the orbit's own 1X about N",
    )
    rotor.add_argument("--follow-orbit", action="store_true", help="the same as --speed-rpm orbit:N")
    rotor.add_argument("--keyphasor", metavar="CH", help="channel of the keyphasor, one pulse a revolution")
    rotor.add_argument(
        "--keyphasor-threshold",
        type=number,
        metavar="V",
        help="level that marks its edge, in the channel's unit (default: half way from low to high)",
    )
    rotor.add_argument(
        "--natural-frequency-hz", type=positive, metavar="F", help="natural frequency of the healthy shaft"
    )
    rotor.add_argument(
        "--natural-frequency-tolerance",
        type=percent,
        default=TOLERANCE_PERCENT,
        metavar="PERCENT",
        help=f"how far that may be off (default: {TOLERANCE_PERCENT:g})",
    )
    rotor.add_argument("--damping-ratio", type=positive, metavar="Z", help="its damping ratio")
    rotor.add_argument(
        "--damping-tolerance",
        type=percent,
        default=TOLERANCE_PERCENT,
        metavar="PERCENT",
        help=f"how far that may be off (default: {TOLERANCE_PERCENT:g})",
    )
    rotor.add_argument("--clearance-um", type=positive, metavar="C", help="radial clearance to the stator")
    rotor.add_argument(
        "--static-sag-um",
        type=not_negative,
        metavar="S",
        help="sag of the shaft under its weight (default: g / omega^2; 0 if it stands upright)",
    )
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
    rotor.add_argument(
        "--ac-coupled", action="store_true", help="the probes have no mean position: do not look at it"
    )


def add_machine_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that both forms know."""
    both = parser.add_argument_group("about the recordings")
    both.add_argument(
        "--map",
        type=channel_map,
        action=_MergedMap,
        default={},
        metavar="NAME=VARIABLE,...",
        help="which variable of the recordings is which channel or sensor (default: the one of its name)",
    )
    both.add_argument(
        "--unit",
        choices=(*LENGTH_UNITS, *ACCELERATION_UNITS),
        help="unit of the samples (default: um, or the machine file's; of accelerometers: g)",
    )
    both.add_argument(
        "--fs", type=sampling_rate_hz, metavar="HZ", help="sampling rate, if the files do not state it"
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
    return _lacking(arguments, given)


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


def probe_pair(text: str) -> tuple[str, str]:
    """``X,Y``: two channels."""
    names = tuple(name.strip() for name in text.split(","))
    if len(names) != 2 or not all(names) or names[0] == names[1]:
        raise argparse.ArgumentTypeError(f"{text!r} does not name two probes; write X,Y")
    return names[0], names[1]


def speed(text: str) -> SpeedOption:
    """``N``, ``-N`` or ``orbit:N``."""
    orbit = text.startswith(_ORBIT)
    value = _float(text.removeprefix(_ORBIT))
    if not math.isfinite(value) or not 0.0 < abs(value) <= 1e6:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a speed; write revolutions per minute, negative if clockwise, or orbit:N"
        )
    exponent = Decimal(text.removeprefix(_ORBIT)).as_tuple().exponent
    return SpeedOption(value, orbit, step_rpm=10.0**exponent if isinstance(exponent, int) else 0.0)


def number(text: str) -> float:
    """A finite number."""
    value = _float(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a finite number")
    return value


def positive(text: str) -> float:
    """A finite number above 0."""
    value = _float(text)
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value


def not_negative(text: str) -> float:
    """A finite number from 0 on."""
    value = _float(text)
    if not (math.isfinite(value) and value >= 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from 0 on")
    return value


def percent(text: str) -> float:
    """A part in percent, from 0 to below 100."""
    value = _float(text)
    if not 0.0 <= value < 100.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a percentage from 0 to below 100")
    return value


def count(text: str) -> int:
    """A whole number from 1 on."""
    value = _whole(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 on")
    return value


def calibration_length(text: str) -> int:
    """Revolutions that make a baseline."""
    from daqsvc.rotor.synchronous.baseline import LEAST_REVOLUTIONS  # noqa: PLC0415 - brings NumPy

    value = _whole(text)
    if not LEAST_REVOLUTIONS <= value <= 100_000:
        raise argparse.ArgumentTypeError(
            f"{text!r} revolutions do not make a baseline; "
            f"give a whole number from {LEAST_REVOLUTIONS} to 100000"
        )
    return value


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        return -1
