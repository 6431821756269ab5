"""``daqsvc analyze REC... --channels --bearing``: bearings by accelerometers on their housings."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

from daqsvc.analysis.acceleration import ACCELERATION_UNITS
from daqsvc.commands.analyze_arguments import rotor_options
from daqsvc.recording.channels import channel_map, sampling_rate_hz

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.analysis.many import Analyst
    from daqsvc.bearing.geometry import BearingOrders

MOST_CHANNELS = 2

_SHARED = ("--speed-rpm",)
_KEYS = ("BPFI", "BPFO", "BSF", "FTF")


def add_bearing_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of bearings, beside those of accelerometers."""
    bearings = parser.add_argument_group("bearings, with --channels and --speed-rpm")
    bearings.add_argument("--bearing", metavar="NAME", help="designation in the catalogue, e.g. 6205-2RS")
    bearings.add_argument(
        "--orders",
        type=fault_orders,
        metavar="BPFI=F,BPFO=F,BSF=F,FTF=F",
        help="fault orders per revolution of the shaft, in place of --bearing",
    )
    bearings.add_argument(
        "--baseline-map",
        type=channel_map,
        default={},
        metavar="NAME=VARIABLE,...",
        help="which variable of the healthy run is which channel, where that is not as in the recordings",
    )
    bearings.add_argument(
        "--baseline-fs", type=sampling_rate_hz, metavar="HZ", help="its sampling rate (default: --fs)"
    )


def by_bearing(arguments: argparse.Namespace) -> bool:
    """Whether the options are those of bearings."""
    return arguments.bearing is not None or arguments.orders is not None


def bearing_misuse(arguments: argparse.Namespace, machine: str | None) -> str:
    """What is wrong with the options of bearings together; empty if nothing is."""
    return next(_wrong(arguments, machine), "")


def _wrong(arguments: argparse.Namespace, machine: str | None) -> Iterator[str]:
    if machine is not None:
        yield "--bearing, --orders: the machine file says which bearings there are; leave them out"
    if arguments.bearing is not None and arguments.orders is not None:
        yield "--bearing and --orders both say what the bearing is; leave out one of them"
    if arguments.calibration is not None:
        yield (
            "--calibration: goes with a machine file, whose bearings it was learnt for; with --bearing or "
            "--orders give the healthy recording itself, --baseline FILE"
        )
    given = rotor_options(arguments)
    if extra := [name for name, is_there in given.items() if is_there and name not in _SHARED]:
        yield f"{', '.join(extra)}: not with --bearing or --orders; leave it out"
    missing = [
        name
        for name, value in (("--channels", arguments.channels), ("--speed-rpm", arguments.speed_rpm))
        if value is None
    ]
    if missing:
        yield f"to judge a bearing, {', '.join(missing)} must be given too"
    elif len(arguments.channels) > MOST_CHANNELS:
        yield f"--channels names {len(arguments.channels)} accelerometers; a bearing is judged by one or two"
    elif arguments.speed_rpm.orbit:
        yield "--speed-rpm orbit:N needs two probes; with --bearing give the speed alone"
    if arguments.unit is not None and arguments.unit not in ACCELERATION_UNITS:
        yield f"--unit {arguments.unit}: accelerometers measure in {', '.join(ACCELERATION_UNITS)}"
    if arguments.baseline is None and (arguments.baseline_map or arguments.baseline_fs is not None):
        yield "--baseline-map, --baseline-fs: there is no --baseline that they could be about"


def bearing_analyst(arguments: argparse.Namespace) -> Analyst:
    """An analyst by the options.

    Raises:
        ValueError: the bearing is not known, or the healthy run cannot be used.
    """
    from daqsvc.analysis.bearing import BearingAnalyst  # noqa: PLC0415 - brings numpy and scipy
    from daqsvc.analysis.bearing_inputs import load_healthy  # noqa: PLC0415
    from daqsvc.analysis.bearing_setup import BearingSetup  # noqa: PLC0415
    from daqsvc.bearing.identify_change import ChangeRules  # noqa: PLC0415

    setup = BearingSetup(
        channels=arguments.channels,
        speed_rpm=abs(arguments.speed_rpm.rpm),
        bearings=dict.fromkeys(arguments.channels, orders_given(arguments)),
        designations=dict.fromkeys(arguments.channels if arguments.bearing else (), arguments.bearing),
        unit=arguments.unit or "g",
        map=arguments.map,
        rate_hz=arguments.fs,
        change=ChangeRules(false_alarm_probability=arguments.false_alarm_probability),
    )
    if arguments.baseline is None:
        return BearingAnalyst(setup)
    healthy = load_healthy(setup, arguments.baseline, arguments.baseline_map, arguments.baseline_fs)
    return BearingAnalyst(setup, healthy)


def orders_given(arguments: argparse.Namespace) -> BearingOrders:
    """Fault orders as given, or out of the catalogue.

    Raises:
        ValueError: they contradict each other, or the catalogue does not know the bearing.
    """
    from daqsvc.bearing.catalogue import bearing_orders  # noqa: PLC0415
    from daqsvc.bearing.geometry import BearingOrders  # noqa: PLC0415

    if arguments.bearing is not None:
        try:
            return bearing_orders(arguments.bearing)
        except KeyError as error:
            raise ValueError(f"--bearing: {error.args[0]}") from None
    given = arguments.orders
    try:
        return BearingOrders(inner=given["BPFI"], outer=given["BPFO"], ball=given["BSF"], cage=given["FTF"])
    except ValueError as error:
        raise ValueError(f"--orders: {error}") from None


def fault_orders(text: str) -> dict[str, float]:
    """``BPFI=F,BPFO=F,BSF=F,FTF=F``, in any order: positive numbers per revolution of the shaft.

    Raises:
        argparse.ArgumentTypeError: one is missing, unknown, given twice or no positive number.
    """
    form = ",".join(f"{key}=.." for key in _KEYS)
    found: dict[str, float] = {}
    for part in text.split(","):
        key, _, value = (piece.strip() for piece in part.partition("="))
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if key.upper() not in _KEYS or key.upper() in found or not (math.isfinite(number) and number > 0.0):
            raise argparse.ArgumentTypeError(f"{part!r} is no fault order; write {form}, each once")
        found[key.upper()] = number
    if missing := [key for key in _KEYS if key not in found]:
        raise argparse.ArgumentTypeError(f"{', '.join(missing)} missing in {text!r}; write {form}")
    return found
