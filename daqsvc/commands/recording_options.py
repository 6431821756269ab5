"""The options of `analyze` and `calibrate`, and what is wrong with them together.

They go by what is measured: probes on a rotor, accelerometers against a healthy run (orders), accelerometers
on bearings. One of these replaces a machine file.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from daqsvc.commands.analyze_fleet import cluster_address
from daqsvc.commands.arguments import (
    add_max_memory,
    calibration_length,
    channel_map,
    channel_names,
    count,
    not_negative,
    number,
    percent,
    positive,
    probability,
    probe_pair,
    refuse_value,
    sampling_rate_hz,
    speed,
)
from daqsvc.documentation import documented_in
from daqsvc.dsp.quality.unit import ACCELERATION_UNITS, LENGTH_UNITS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

MOST_CHANNELS = 2
"""Accelerometers that a bearing is judged by."""
CALIBRATE_REVOLUTIONS = 50
FALSE_ALARMS_PER_1000_REV = 0.1
FALSE_ALARM_PROBABILITY = 1e-3
LIVE_REVOLUTIONS = 200
TOLERANCE_PERCENT = 20.0

_DEFAULTS = {
    "--calibrate-revs": CALIBRATE_REVOLUTIONS,
    "--false-alarms-per-1000-rev": FALSE_ALARMS_PER_1000_REV,
    "--natural-frequency-tolerance": TOLERANCE_PERCENT,
    "--damping-tolerance": TOLERANCE_PERCENT,
}
_ROTOR = (
    *("--keyphasor", "--keyphasor-threshold", "--natural-frequency-hz", "--damping-ratio"),
    *("--clearance-um", "--static-sag-um"),
)
_PROBES_ONLY = (
    *("--probes", "--follow-orbit", *_ROTOR, "--calibrate-revs", "--false-alarms-per-1000-rev"),
    *("--ac-coupled", "--natural-frequency-tolerance", "--damping-tolerance"),
)
"""Options of `analyze` that accelerometers have not."""
_DEFINED_TWICE = "--bearing and --orders both define the bearing; leave out one of them"
_WITHOUT = "without a machine file, "
"""Begins what asks for options."""
_DIMENSIONS = ("--balls", "--ball-diameter-mm", "--pitch-diameter-mm")
_ORDER_KEYS = ("BPFI", "BPFO", "BSF", "FTF")


def add_analyze_options(parser: argparse.ArgumentParser) -> None:
    """All of ``daqsvc analyze``."""
    _add_files(parser)
    _add_rotor_of_analyze(parser)
    _add_orders(parser)
    _add_bearings(parser)
    _add_about_recordings(parser)
    _add_output(parser)
    _add_fleet(parser)


def add_calibrate_options(parser: argparse.ArgumentParser) -> None:
    """All of ``daqsvc calibrate``."""
    _add_files(parser)
    parser.add_argument("--out", type=Path, metavar="FILE", help="file for the calibration (.toml)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    parser.add_argument(
        "--predict-rpm",
        type=_speeds,
        metavar="N,N,...",
        help="speeds in rpm at which to predict 1X from a run-up (default: 0.5, 0.7, 0.95 and 1 times the "
        "critical speed)",
    )
    live = parser.add_argument_group("from the live bus")
    live.add_argument(
        "--live", action="store_true", help="read the buses of the machine file instead of recordings"
    )
    live.add_argument(
        "--revolutions",
        type=calibration_length,
        default=LIVE_REVOLUTIONS,
        metavar="N",
        help=f"number of usable revolutions (default: {LIVE_REVOLUTIONS})",
    )
    live.add_argument(
        "--timeout-s",
        type=positive,
        metavar="S",
        help="longest wait for them, in s (default: three times what they take, and 10 s)",
    )
    _add_about_healthy_recordings(parser)
    _add_rotor(
        parser.add_argument_group("without a machine file").add_argument,
        speed_help="speed of the steady recordings, negative if clockwise; exact if there is no keyphasor",
        help_more="; not needed with a run-up",
    )
    _add_bearing_of_calibrate(parser)


def _add_files(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "files", nargs="+", metavar="FILE", help="machine file (.toml) if there is one, then recordings"
    )


def split_files(arguments: argparse.Namespace) -> tuple[Path | None, list[str]]:
    """The machine file, if the first file is one, and the recordings."""
    first, *others = arguments.files
    return (Path(first), others) if first.lower().endswith(".toml") else (None, arguments.files)


def by_bearing(arguments: argparse.Namespace) -> bool:
    """Whether the options are those of bearings."""
    return arguments.bearing is not None or arguments.orders is not None


def by_orders(arguments: argparse.Namespace) -> bool:
    """Whether the options are those of accelerometers."""
    return arguments.channels is not None or arguments.baseline is not None


def analyze_misuse(arguments: argparse.Namespace, machine: Path | None, recordings: Sequence[str]) -> str:
    """What is wrong with options of `analyze` that are sound one by one; empty if nothing is."""
    if wrong := _take_dimensions(arguments):
        return wrong
    if by_bearing(arguments):
        return next(_bearing_misuse(arguments, machine), "")
    if by_orders(arguments):
        return _order_misuse(arguments, machine)
    return _probe_misuse(arguments, machine, recordings)


def _take_dimensions(arguments: argparse.Namespace) -> str:
    """Make orders of the dimensions of a bearing, if those are given; what is wrong with them, or empty."""
    dimensions = _options_in_use(arguments, (*_DIMENSIONS, "--contact-deg"))
    if not dimensions:
        return ""
    if missing := _missing(arguments, _DIMENSIONS):
        return f"{dimensions[0]} is one of a bearing's dimensions: {', '.join(missing)} must be given too"
    if arguments.bearing is not None or arguments.orders is not None:
        return "--balls, --bearing and --orders all define the bearing; leave out all but one of them"
    from daqsvc.bearing.geometry import BearingGeometry  # noqa: PLC0415 - each verb imports only what it needs

    sizes = arguments.balls, arguments.ball_diameter_mm, arguments.pitch_diameter_mm
    try:
        orders = BearingGeometry(*sizes, arguments.contact_deg or 0.0).orders()
    except ValueError as error:
        return f"--balls: {error}"
    values = (orders.inner, orders.outer, orders.ball, orders.cage)
    arguments.orders = dict(zip(_ORDER_KEYS, values, strict=True))
    return ""


def _probe_misuse(arguments: argparse.Namespace, machine: Path | None, recordings: Sequence[str]) -> str:
    if not recordings:
        return (
            f"{arguments.files[0]} is a machine file, and there is no recording after it; name at least one"
        )
    if machines := [name for name in recordings if name.lower().endswith(".toml")]:
        return f"{machines[0]} is not a recording; a machine file comes first, and there is only one"
    if arguments.unit in ACCELERATION_UNITS:
        return f"--unit {arguments.unit}: proximity probes measure in {', '.join(LENGTH_UNITS)}"
    if machine is not None:
        extra = _options_in_use(arguments, ("--probes", "--speed-rpm", *_PROBES_ONLY[1:]))
        return f"{', '.join(extra)}: the machine file states this; leave it out" if extra else ""
    known = _options_in_use(arguments, ("--natural-frequency-hz", "--damping-ratio", "--static-sag-um"))
    if known and arguments.calibration is not None:
        return f"{', '.join(known)}: the calibration states this; leave it out, or leave out --calibration"
    return _lacking(arguments) or _unknown_channels(arguments)


def refuse(parser: argparse.ArgumentParser, wrong: str, recordings: Iterable[str]) -> NoReturn:
    """Say what is wrong, and exit with 2; if options are asked for, first what is no recording.

    Args:
        parser: of the verb.
        wrong: what `analyze_misuse` or `calibrate_misuse` states.
        recordings: the files.
    """
    if wrong.startswith(_WITHOUT):
        from daqsvc.recording import RecordingError  # noqa: PLC0415 - each verb imports only what it needs
        from daqsvc.recording.formats import find  # noqa: PLC0415

        try:
            for recording in recordings:
                find(Path(recording))
        except RecordingError as error:
            refuse_value(parser, error, error.code)
    parser.error(wrong)


def calibrate_misuse(arguments: argparse.Namespace, machine: Path | None, recordings: Sequence[str]) -> str:
    """What is wrong with options of `calibrate` that are sound one by one; empty if nothing is."""
    return _take_dimensions(arguments) or _calibrate_misuse(arguments, machine, recordings)


def _calibrate_misuse(arguments: argparse.Namespace, machine: Path | None, recordings: Sequence[str]) -> str:
    if calibrates_bearing(arguments):
        return _healthy_bearing_misuse(arguments, machine, recordings)
    if arguments.out is None and not arguments.json:
        return "nothing would be kept: give --out FILE, --json or both"
    rotor = ("--probes", "--speed-rpm", *_ROTOR, "--ac-coupled")
    if machine is not None and (options := _options_in_use(arguments, rotor)):
        return f"{', '.join(options)}: the machine file states this; leave it out"
    if arguments.live:
        return _live_misuse(arguments, machine, recordings)
    if not recordings:
        return "no recording is given; name one after the machine file, or listen to the machine with --live"
    return "" if machine is not None else _lacking_to_calibrate(arguments, len(recordings))


def calibrates_bearing(arguments: argparse.Namespace) -> bool:
    """Whether the options are those of bearings."""
    return any(getattr(arguments, name) is not None for name in ("channels", "bearing", "orders"))


def bearing_recording_misuse(arguments: argparse.Namespace, recordings: Sequence[str]) -> str:
    """What is wrong with what calibrates bearings, by options or by a machine file; empty if nothing is."""
    if arguments.live:
        return "--live is for rotors; the service learns the healthy state of bearings by itself"
    if len(recordings) != 1:
        return f"{len(recordings)} recordings are given; the healthy state of bearings is learnt from one"
    if arguments.out is None and not arguments.json:
        return "nothing would be kept: give --out FILE, --json or both"
    return ""


def fault_orders(text: str) -> dict[str, float]:
    """``BPFI=F,BPFO=F,BSF=F,FTF=F``, in any order: positive numbers per revolution of the shaft.

    Raises:
        argparse.ArgumentTypeError: one is missing, unknown, given twice or no positive number.
    """
    form = ",".join(f"{key}=.." for key in _ORDER_KEYS)
    orders: dict[str, float] = {}
    for part in text.split(","):
        key, _, value = (piece.strip() for piece in part.partition("="))
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if (
            key.upper() not in _ORDER_KEYS
            or key.upper() in orders
            or not (math.isfinite(number) and number > 0.0)
        ):
            raise argparse.ArgumentTypeError(f"{part!r} is no fault order; write {form}, each once")
        orders[key.upper()] = number
    if missing := [key for key in _ORDER_KEYS if key not in orders]:
        raise argparse.ArgumentTypeError(f"{', '.join(missing)} missing in {text!r}; write {form}")
    return orders


def _add_rotor_of_analyze(parser: argparse.ArgumentParser) -> None:
    """Options that replace a machine file."""
    rotor = parser.add_argument_group("without a machine file")
    _add_rotor(
        rotor.add_argument,
        speed_help="speed of the shaft, negative if clockwise; nominal with a keyphasor, else exact to half "
        "of its last digit",
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
        help=f"false alarms to accept in 1000 revolutions (default: {FALSE_ALARMS_PER_1000_REV:g})",
    )


def _add_orders(parser: argparse.ArgumentParser) -> None:
    """Options of accelerometers, in place of those of probes."""
    orders = parser.add_argument_group("accelerometers, instead of probes")
    orders.add_argument(
        "--channels",
        type=channel_names,
        metavar="NAME,...",
        help="channels that have one unit, e.g. three axes x,y,z",
    )
    orders.add_argument(
        "--baseline", metavar="HEALTHY_REC", help="recording of the healthy machine at the same speed"
    )
    orders.add_argument(
        "--false-alarm-probability",
        type=probability,
        default=FALSE_ALARM_PROBABILITY,
        metavar="P",
        help="highest probability of an alarm on a recording of the unchanged machine "
        f"(default: {FALSE_ALARM_PROBABILITY:g})",
    )


def _add_bearings(parser: argparse.ArgumentParser) -> None:
    """Options of bearings, beside those of accelerometers."""
    bearings = parser.add_argument_group("bearings, with --channels and --speed-rpm")
    _add_bearing(bearings.add_argument)
    bearings.add_argument(
        "--baseline-map",
        type=channel_map,
        default={},
        metavar="NAME=VARIABLE,...",
        help="like --map, for the recording of the healthy machine (default: --map)",
    )
    bearings.add_argument(
        "--baseline-fs",
        type=sampling_rate_hz,
        metavar="HZ",
        help="like --fs, for the recording of the healthy machine (default: --fs)",
    )


def _add_about_recordings(parser: argparse.ArgumentParser) -> None:
    """Options that both forms know."""
    both = parser.add_argument_group("about the recordings")
    add_channel_map(both.add_argument)
    both.add_argument(
        "--unit",
        choices=(*LENGTH_UNITS, *ACCELERATION_UNITS),
        help="unit of the samples (default: that of the machine file, else um, for accelerometers g)",
    )
    both.add_argument(
        "--calibration",
        type=Path,
        metavar="FILE",
        help="file of daqsvc calibrate, used instead of the first revolutions or of --baseline",
    )


def _add_output(parser: argparse.ArgumentParser) -> None:
    """What comes out, and how."""
    output = parser.add_argument_group("output")
    output.add_argument(
        "--json",
        action="store_true",
        help="print one JSON object per line, one for each recording, in the order given",
    )
    output.add_argument(
        "--plot",
        type=Path,
        metavar="DIR",
        help="folder for figures: orbit, Poincare map, phase plane, probabilities, innovations, polar plot",
    )
    output.add_argument(
        "--jobs",
        type=count,
        metavar="N",
        help="number of processes (default: one for each core, fewer for few recordings)",
    )


def _add_fleet(parser: argparse.ArgumentParser) -> None:
    """What is stated of the archive of a fleet."""
    fleet = parser.add_argument_group(f"the archive of a fleet ({documented_in('fleet')})")
    fleet.add_argument(
        "--cluster",
        type=cluster_address,
        metavar="ADDRESS",
        help="judge an archive on Dask: local (one process for each core of this computer), local:N "
        "(N processes), or the address of a scheduler, tcp://HOST:8786",
    )
    fleet.add_argument(
        "--results",
        metavar="PLACE",
        help="folder or URL of the results; recordings that it contains are not judged again "
        "(default: ARCHIVE-results)",
    )
    fleet.add_argument(
        "--verify",
        action="store_true",
        help="read all files to find changed contents, even if size and time have not changed",
    )
    fleet.add_argument(
        "--retry", action="store_true", help="judge again the recordings that could not be judged"
    )


def _add_about_healthy_recordings(parser: argparse.ArgumentParser) -> None:
    about = parser.add_argument_group("about the recordings")
    add_channel_map(about.add_argument)
    about.add_argument(
        "--unit",
        choices=LENGTH_UNITS,
        help="unit of the samples (default: that of the machine file, else um)",
    )
    about.add_argument(
        "--sweep-rpm",
        type=_sweep,
        metavar="FROM,TO",
        help="the first recording is a run-up without a keyphasor: the speed in rpm changes linearly from "
        "FROM at its first sample to TO at its last, e.g. 600,3000; the angle is zero at the first sample",
    )


def _add_bearing_of_calibrate(parser: argparse.ArgumentParser) -> None:
    """Options of bearings, in place of those of the rotor."""
    bearings = parser.add_argument_group("bearings, with --speed-rpm, instead of the rotor")
    bearings.add_argument(
        "--channels",
        type=channel_names,
        metavar="NAME[,NAME]",
        help="accelerometers on the bearing housings, with the names of sensors in the machine file",
    )
    _add_bearing(bearings.add_argument)


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


def add_channel_map(add: Callable[..., argparse.Action]) -> None:
    """What the recordings call their channels, and how fast they were sampled.

    Args:
        add: ``add_argument`` of the group that takes the options.
    """
    add(
        "--map",
        type=channel_map,
        action=_MergedMap,
        default={},
        metavar="NAME=VARIABLE,...",
        help="which variable of the recordings is which channel or sensor, e.g. x=X097_DE_time (default: the "
        "one with its name)",
    )
    add(
        "--fs",
        type=sampling_rate_hz,
        metavar="HZ",
        help="sampling rate in Hz, if the recordings do not state it",
    )
    add_max_memory(add)


def _add_bearing(add: Callable[..., argparse.Action]) -> None:
    """What the bearing is.

    Args:
        add: ``add_argument`` of the group that takes the options.
    """
    add("--bearing", metavar="NAME", help="designation in the catalogue, e.g. 6205-2RS")
    add(
        "--orders",
        type=fault_orders,
        metavar="BPFI=F,BPFO=F,BSF=F,FTF=F",
        help="fault orders per revolution of the shaft, instead of --bearing",
    )
    add(
        "--balls",
        type=count,
        metavar="N",
        help="its dimensions instead of --bearing: number of balls or rollers in a row",
    )
    for name, about in (
        ("ball-diameter-mm", "of a ball, or of a roller at its middle"),
        ("pitch-diameter-mm", "of the circle through their centres"),
    ):
        add(f"--{name}", type=positive, metavar="D", help=f"with --balls: diameter {about}, in mm")
    add(
        "--contact-deg",
        type=not_negative,
        metavar="A",
        help="with --balls: contact angle in degrees (default: 0)",
    )


def _add_rotor(add: Callable[..., argparse.Action], *, speed_help: str, help_more: str = "") -> None:
    """Probes, speed and rotor, which a machine file states otherwise.

    Args:
        add: ``add_argument`` of the group that takes the options.
        speed_help: what the speed is.
        help_more: help beside the rotor's figures, where something else can state them.
    """
    add(
        "--probes", type=probe_pair, metavar="X,Y", help="channels of the two probes; y is 90 degrees after x"
    )
    add(
        "--speed-rpm",
        type=speed,
        metavar="N",
        help=f"{speed_help}; orbit:N finds it from the 1X of the orbit, near N",
    )
    add("--keyphasor", metavar="CH", help="channel of the keyphasor, one pulse per revolution")
    add(
        "--keyphasor-threshold",
        type=number,
        metavar="V",
        help="level of its edge, in the unit of the channel (default: half way from low to high)",
    )
    for name, unit, metavar, about in (
        ("natural-frequency", "hz", "F", "natural frequency of the healthy shaft, in Hz"),
        ("damping", "ratio", "Z", "damping ratio of the healthy shaft"),
    ):
        add(f"--{name}-{unit}", type=positive, metavar=metavar, help=f"{about}{help_more}")
        add(
            f"--{name}-tolerance",
            type=percent,
            default=TOLERANCE_PERCENT,
            metavar="PERCENT",
            help=f"how wrong that may be, in %% (default: {TOLERANCE_PERCENT:g})",
        )
    add("--clearance-um", type=positive, metavar="C", help="radial clearance to the stator, in um")
    add(
        "--static-sag-um",
        type=not_negative,
        metavar="S",
        help="sag of the shaft under its weight, in um (default: g / omega^2); 0 if the shaft is vertical",
    )
    add("--ac-coupled", action="store_true", help="the probes are AC-coupled: do not use their mean position")


def _options_in_use(arguments: argparse.Namespace, options: Iterable[str]) -> list[str]:
    """Those of the options whose value is not the default."""
    return [
        option
        for option in options
        if (value := _value(arguments, option)) is not None
        and value is not False
        and value != _DEFAULTS.get(option)
    ]


def _missing(arguments: argparse.Namespace, options: Iterable[str]) -> list[str]:
    return [option for option in options if _value(arguments, option) is None]


def _value(arguments: argparse.Namespace, option: str) -> object:
    return getattr(arguments, option.removeprefix("--").replace("-", "_"))


def _lacking(arguments: argparse.Namespace) -> str:
    needed = ["--probes"]
    if arguments.calibration is None:
        needed += ["--natural-frequency-hz", "--damping-ratio"]
    if arguments.keyphasor is None:
        needed.append("--speed-rpm")
        if arguments.keyphasor_threshold is not None:
            return "--keyphasor-threshold without --keyphasor: name the channel of the keyphasor"
    missing = _missing(arguments, needed)
    if not missing:
        return ""
    instead = ", or --keyphasor in place of --speed-rpm" if "--speed-rpm" in missing else ""
    return f"{_WITHOUT}{', '.join(missing)} must be given{instead}"


def _order_misuse(arguments: argparse.Namespace, machine: Path | None) -> str:
    """What is wrong with the options of accelerometers together; empty if nothing is."""
    if machine is not None:
        return "--channels, --baseline: the machine file states what is measured; leave them out"
    if extra := _options_in_use(arguments, (*_PROBES_ONLY, "--calibration", "--plot")):
        return f"{', '.join(extra)}: not with --channels and --baseline; leave it out"
    if missing := ", ".join(_missing(arguments, ("--channels", "--baseline", "--speed-rpm"))):
        bearing = "to judge a bearing, --bearing or --orders; " if arguments.baseline is None else ""
        return f"{bearing}to compare accelerometers with a healthy run, {missing} must be given too"
    if arguments.speed_rpm.orbit:
        return "--speed-rpm orbit:N needs two probes; with --channels give the nominal speed alone"
    return next(_misuse_of_accelerometers(arguments), "")


def _misuse_of_accelerometers(arguments: argparse.Namespace) -> Iterator[str]:
    """What is wrong with unit and healthy run, against which accelerometers are compared."""
    if arguments.unit is not None and arguments.unit not in ACCELERATION_UNITS:
        yield f"--unit {arguments.unit}: accelerometers measure in {', '.join(ACCELERATION_UNITS)}"
    if arguments.baseline is not None and arguments.baseline.lower().endswith(".toml"):
        yield (
            f"--baseline {arguments.baseline}: takes a recording; a file that daqsvc calibrate wrote of "
            "bearings is for --calibration, with --bearing or --orders or a machine file"
        )


def _bearing_misuse(arguments: argparse.Namespace, machine: Path | None) -> Iterator[str]:
    """What is wrong with the options of bearings together."""
    if machine is not None:
        yield "--bearing, --orders: the machine file lists the bearings; leave them out"
    if arguments.bearing is not None and arguments.orders is not None:
        yield _DEFINED_TWICE
    if arguments.calibration is not None and arguments.baseline is not None:
        yield "--calibration and --baseline both define the healthy machine; leave out one of them"
    if extra := _options_in_use(arguments, _PROBES_ONLY):
        yield f"{', '.join(extra)}: not with --bearing or --orders; leave it out"
    if missing := _missing(arguments, ("--channels", "--speed-rpm")):
        yield f"to judge a bearing, {', '.join(missing)} must be given too"
    elif len(arguments.channels) > MOST_CHANNELS:
        yield f"--channels names {len(arguments.channels)} accelerometers; a bearing is judged by one or two"
    elif arguments.speed_rpm.orbit:
        yield "--speed-rpm orbit:N needs two probes; with --bearing give the speed alone"
    yield from _misuse_of_accelerometers(arguments)
    if arguments.baseline is None and (arguments.baseline_map or arguments.baseline_fs is not None):
        yield "--baseline-map, --baseline-fs: there is no --baseline that they could be about"


def _healthy_bearing_misuse(
    arguments: argparse.Namespace, machine: Path | None, recordings: Sequence[str]
) -> str:
    """What is wrong with the options of bearings together; empty if nothing is."""
    if machine is not None:
        return "--channels, --bearing, --orders: the machine file states this; leave them out"
    rotor = ("--probes", "--keyphasor", "--natural-frequency-hz", "--damping-ratio", "--clearance-um")
    if extra := _options_in_use(arguments, (*rotor, "--sweep-rpm")):
        return f"{extra[0]}: not with --channels; a bearing is calibrated by itself"
    missing = _missing(arguments, ("--channels", "--speed-rpm"))
    if arguments.bearing is None and arguments.orders is None:
        missing.append("--bearing or --orders")
    if missing:
        return f"to calibrate a bearing, {', '.join(missing)} must be given too"
    if arguments.bearing is not None and arguments.orders is not None:
        return _DEFINED_TWICE
    if len(arguments.channels) > MOST_CHANNELS:
        return f"--channels names {len(arguments.channels)} accelerometers; give one or two"
    return bearing_recording_misuse(arguments, recordings)


def _live_misuse(arguments: argparse.Namespace, machine: Path | None, recordings: Sequence[str]) -> str:
    if machine is None:
        return "--live needs a machine file, which states how to reach the machine"
    if recordings or arguments.sweep_rpm:
        return "--live listens to the machine; leave out recordings and --sweep-rpm, or leave out --live"
    return ""


def _lacking_to_calibrate(arguments: argparse.Namespace, recordings: int) -> str:
    if arguments.probes is None:
        return f"{_WITHOUT}--probes must be given"
    if arguments.keyphasor is None and arguments.keyphasor_threshold is not None:
        return "--keyphasor-threshold without --keyphasor: name the channel of the keyphasor"
    if arguments.keyphasor is not None and arguments.sweep_rpm is not None:
        return "--keyphasor and --sweep-rpm both state the speed; leave out one of them"
    steady = recordings - (arguments.sweep_rpm is not None)
    if arguments.keyphasor is None and arguments.speed_rpm is None and steady:
        return (
            "the speed is not known: give --speed-rpm for a steady recording, --sweep-rpm for a run-up, or "
            "--keyphasor"
        )
    if (arguments.natural_frequency_hz is None) != (arguments.damping_ratio is None):
        return "--natural-frequency-hz and --damping-ratio go together; give both, or a run-up instead"
    return _unknown_channels(arguments)


def _unknown_channels(arguments: argparse.Namespace) -> str:
    """What is wrong with ``--map`` without a machine file; empty if nothing is."""
    known = [*arguments.probes, *([arguments.keyphasor] if arguments.keyphasor is not None else [])]
    unknown = [name for name in arguments.map if name not in known]
    if not unknown:
        return ""
    return (
        f"--map names {unknown[0]!r}, which --probes and --keyphasor do not; they name {', '.join(known)}: "
        "write --map CHANNEL=VARIABLE for one of these"
    )


def _speeds(text: str) -> tuple[float, ...]:
    return tuple(positive(one) for one in text.split(","))


def _sweep(text: str) -> tuple[float, float]:
    ends = [positive(one) for one in text.split(",")]
    if len(ends) != 2 or ends[0] == ends[1]:
        raise argparse.ArgumentTypeError(f"{text!r} is no sweep; write FROM,TO in revolutions per minute")
    return ends[0], ends[1]
