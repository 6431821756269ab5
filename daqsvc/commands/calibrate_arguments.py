"""The arguments of ``daqsvc calibrate``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.commands.option_types import calibration_length, positive
from daqsvc.commands.shared_arguments import add_channel_map, add_rotor, unknown_channels
from daqsvc.recording.channels import LENGTH_UNITS

if TYPE_CHECKING:
    from collections.abc import Sequence

LIVE_REVOLUTIONS = 200


def add_calibrate_arguments(parser: argparse.ArgumentParser) -> None:
    """All arguments."""
    parser.add_argument(
        "files", nargs="+", metavar="FILE", help="a machine file (.toml) if there is one, then recordings"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="where the calibration is written (.toml)")
    parser.add_argument("--json", action="store_true", help="say what was found as one JSON object")
    parser.add_argument(
        "--predict-rpm",
        type=_speeds,
        metavar="N,N,...",
        help="speeds at which to predict 1X from a run-up (default: 0.5, 0.7, 0.95 and 1 of the critical)",
    )
    live = parser.add_argument_group("from the live bus")
    live.add_argument("--live", action="store_true", help="listen to the machine instead of recordings")
    live.add_argument(
        "--revolutions",
        type=calibration_length,
        default=LIVE_REVOLUTIONS,
        metavar="N",
        help=f"usable revolutions to wait for (default: {LIVE_REVOLUTIONS})",
    )
    live.add_argument(
        "--timeout-s",
        type=positive,
        metavar="S",
        help="how long to wait for them (default: three times what they take, and 10 s)",
    )
    _add_recording_arguments(parser)
    add_rotor(
        parser.add_argument_group("without a machine file").add_argument,
        speed_help="speed of the steady recordings, negative if clockwise; exact if there is no keyphasor",
        told="; a run-up tells it",
    )


def _add_recording_arguments(parser: argparse.ArgumentParser) -> None:
    about = parser.add_argument_group("about the recordings")
    add_channel_map(about.add_argument)
    about.add_argument("--unit", choices=LENGTH_UNITS, help="unit of the probes' samples (default: um)")
    about.add_argument(
        "--sweep-rpm",
        type=_sweep,
        metavar="FROM,TO",
        help="the first recording is a run-up without a keyphasor: the speed goes evenly from FROM at its "
        "first sample to TO at its last, angle zero at the first",
    )


def misuse(arguments: argparse.Namespace, machine: str | None, recordings: Sequence[str]) -> str:
    """What is wrong with arguments that are sound one by one; empty if nothing is."""
    if arguments.out is None and not arguments.json:
        return "nothing would be kept: give --out FILE, --json or both"
    if machine is not None and (given := _rotor_options(arguments)):
        return f"{', '.join(given)}: the machine file says this; leave it out"
    if arguments.live:
        return _live_misuse(arguments, machine, recordings)
    if not recordings:
        return "no recording is given; name one after the machine file, or listen to the machine with --live"
    return "" if machine is not None else _lacking(arguments, len(recordings))


def _rotor_options(arguments: argparse.Namespace) -> list[str]:
    options = {
        "--probes": arguments.probes,
        "--speed-rpm": arguments.speed_rpm,
        "--keyphasor": arguments.keyphasor,
        "--keyphasor-threshold": arguments.keyphasor_threshold,
        "--natural-frequency-hz": arguments.natural_frequency_hz,
        "--damping-ratio": arguments.damping_ratio,
        "--clearance-um": arguments.clearance_um,
        "--static-sag-um": arguments.static_sag_um,
        "--ac-coupled": arguments.ac_coupled or None,
    }
    return [option for option, value in options.items() if value is not None]


def _live_misuse(arguments: argparse.Namespace, machine: str | None, recordings: Sequence[str]) -> str:
    if machine is None:
        return "--live needs a machine file, which says how to reach the machine"
    if recordings or arguments.sweep_rpm:
        return "--live listens to the machine; leave out recordings and --sweep-rpm, or leave out --live"
    return ""


def _lacking(arguments: argparse.Namespace, recordings: int) -> str:
    if arguments.probes is None:
        return "without a machine file, --probes must be given"
    if arguments.keyphasor is None and arguments.keyphasor_threshold is not None:
        return "--keyphasor-threshold without --keyphasor: name the channel of the keyphasor"
    if arguments.keyphasor is not None and arguments.sweep_rpm is not None:
        return "--keyphasor and --sweep-rpm both say the speed; leave out one of them"
    steady = recordings - (arguments.sweep_rpm is not None)
    if arguments.keyphasor is None and arguments.speed_rpm is None and steady:
        return (
            "the speed is not known: give --speed-rpm for a steady recording, --sweep-rpm for a run-up, or "
            "--keyphasor"
        )
    if (arguments.natural_frequency_hz is None) != (arguments.damping_ratio is None):
        return "--natural-frequency-hz and --damping-ratio go together; give both, or a run-up instead"
    return unknown_channels(arguments)


def _speeds(text: str) -> tuple[float, ...]:
    return tuple(positive(one) for one in text.split(","))


def _sweep(text: str) -> tuple[float, float]:
    ends = [positive(one) for one in text.split(",")]
    if len(ends) != 2 or ends[0] == ends[1]:
        raise argparse.ArgumentTypeError(f"{text!r} is no sweep; write FROM,TO in revolutions per minute")
    return ends[0], ends[1]
