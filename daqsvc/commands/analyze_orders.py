"""``daqsvc analyze REC... --channels``: accelerometers without a keyphasor, against a healthy run."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

from daqsvc.analysis.acceleration import ACCELERATION_UNITS
from daqsvc.commands.analyze_arguments import rotor_options

if TYPE_CHECKING:
    from daqsvc.analysis.many import Analyst

FALSE_ALARM_PROBABILITY = 1e-3

_SHARED = ("--speed-rpm",)


def add_order_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of accelerometers, in place of those of probes."""
    orders = parser.add_argument_group("accelerometers, in place of probes")
    orders.add_argument(
        "--channels", type=channel_names, metavar="NAME,...", help="channels of one unit, e.g. the three axes"
    )
    orders.add_argument(
        "--baseline", metavar="HEALTHY_REC", help="a recording of the healthy machine at the same speed"
    )
    orders.add_argument(
        "--false-alarm-probability",
        type=probability,
        default=FALSE_ALARM_PROBABILITY,
        metavar="P",
        help=f"of a recording of the unchanged machine, at most (default: {FALSE_ALARM_PROBABILITY:g})",
    )


def by_orders(arguments: argparse.Namespace) -> bool:
    """Whether the options are those of accelerometers."""
    return arguments.channels is not None or arguments.baseline is not None


def order_misuse(arguments: argparse.Namespace, machine: str | None) -> str:
    """What is wrong with the options of accelerometers together; empty if nothing is."""
    if machine is not None:
        return "--channels, --baseline: the machine file says what is measured; leave them out"
    given = {
        **rotor_options(arguments),
        "--calibration": arguments.calibration is not None,
        "--plot": arguments.plot is not None,
    }
    if extra := [name for name, is_there in given.items() if is_there and name not in _SHARED]:
        return f"{', '.join(extra)}: not with --channels and --baseline; leave it out"
    missing = [
        name
        for name, value in (
            ("--channels", arguments.channels),
            ("--baseline", arguments.baseline),
            ("--speed-rpm", arguments.speed_rpm),
        )
        if value is None
    ]
    if missing:
        bearing = "to judge a bearing, --bearing or --orders; " if arguments.baseline is None else ""
        told = ", ".join(missing)
        return f"{bearing}to compare accelerometers with a healthy run, {told} must be given too"
    if arguments.speed_rpm.orbit:
        return "--speed-rpm orbit:N needs two probes; with --channels give the nominal speed alone"
    if arguments.unit is not None and arguments.unit not in ACCELERATION_UNITS:
        return f"--unit {arguments.unit}: accelerometers measure in {', '.join(ACCELERATION_UNITS)}"
    return ""


def order_analyst(arguments: argparse.Namespace) -> Analyst:
    """An analyst by the options.

    Raises:
        ValueError: the healthy run cannot be used.
    """
    from daqsvc.analysis.order_analysis import OrderAnalyst, OrderSetup  # noqa: PLC0415 - brings numpy
    from daqsvc.rotor.orders.change import OrderRules  # noqa: PLC0415

    setup = OrderSetup(
        channels=arguments.channels,
        speed_rpm=arguments.speed_rpm.rpm,
        unit=arguments.unit or "g",
        map=arguments.map,
        rate_hz=arguments.fs,
        rules=OrderRules(false_alarm_probability=arguments.false_alarm_probability),
    )
    return OrderAnalyst.of(setup, arguments.baseline)


def channel_names(text: str) -> tuple[str, ...]:
    """``NAME,...``: one or more channels.

    Raises:
        argparse.ArgumentTypeError: one is empty or named twice.
    """
    names = tuple(name.strip() for name in text.split(","))
    if not all(names) or len(set(names)) < len(names):
        raise argparse.ArgumentTypeError(f"{text!r} does not name channels; write NAME,NAME, each once")
    return names


def probability(text: str) -> float:
    """A false-alarm probability.

    Raises:
        argparse.ArgumentTypeError: it is not from 1e-9 to 0.5.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 1e-9 <= value <= 0.5:
        raise argparse.ArgumentTypeError(f"{text!r} is not a probability from 1e-9 to 0.5")
    return value
