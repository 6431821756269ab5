"""Options that the simulator's commands share, and what their values may be."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.commands.arguments import add_max_memory, channel_map, sampling_rate_hz

if TYPE_CHECKING:
    from collections.abc import Iterable

    Group = argparse._ArgumentGroup  # noqa: SLF001 - argparse has no public name for it

MOST_DB = 200.0
"""Beyond this ratio, either way, there is only noise or none in double precision."""


def add_random(group: Group) -> None:
    """Options of a scenario's chance: ``--seed`` and ``--snr-db``."""
    group.add_argument(
        "--seed", type=whole, metavar="N", help="seed of all random numbers (default: that of the scenario)"
    )
    group.add_argument(
        "--snr-db",
        type=decibels,
        metavar="DB",
        help="signal-to-noise ratio of the sensors, in dB (default: that of the scenario)",
    )


def add_recording(group: Group) -> None:
    """Options of a measured recording: ``--recording``, ``--map`` and ``--fs``."""
    group.add_argument(
        "--recording",
        type=Path,
        metavar="FILE",
        help="play a measured recording instead of a scenario: all that daqsvc analyze reads, also CAN logs "
        "and snapshots",
    )
    group.add_argument(
        "--map",
        type=channel_map,
        metavar="SENSOR=VARIABLE,...",
        help="which variables of the recording to play, and as which sensors, e.g. x=X097_DE_time (default: "
        "those with the names of sensors)",
    )
    group.add_argument(
        "--fs",
        type=sampling_rate_hz,
        metavar="HZ",
        help="sampling rate in Hz, if the recordings do not state it",
    )
    add_max_memory(group.add_argument)


def add_speed(group: Group, remark: str = "") -> None:
    """The option ``--speed``; ``remark`` goes behind its help."""
    group.add_argument(
        "--speed",
        type=positive,
        default=1.0,
        metavar="N",
        help=f"N times as fast as real time (default: 1){remark}",
    )


def misplaced(
    arguments: argparse.Namespace, of_recordings: Iterable[str], of_scenarios: Iterable[str]
) -> str | None:
    """What is wrong with options of a recording without one, or of a scenario beside one; None if nothing."""
    if arguments.recording is None:
        if option := first_option(arguments, of_recordings):
            return f"{option} goes with a recording; give that with --recording, or leave {option} out"
    elif option := first_option(arguments, of_scenarios):
        return f"{option} goes with a scenario, and --recording plays a recording; leave one of the two out"
    return None


def first_option(arguments: argparse.Namespace, names: Iterable[str]) -> str | None:
    """The first of these options that is on the command line, as it is written there."""
    return next(
        (f"--{name.replace('_', '-')}" for name in names if getattr(arguments, name) is not None), None
    )


def positive(text: str) -> float:
    """A number greater than zero."""
    value = _number(text)
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return value


def decibels(text: str) -> float:
    """A ratio of powers."""
    value = _number(text)
    if not abs(value) <= MOST_DB:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from {-MOST_DB:g} to {MOST_DB:g} dB")
    return value


def whole(text: str) -> int:
    """A whole number from 0 on."""
    if not (text.isascii() and text.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 on")
    return int(text)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
