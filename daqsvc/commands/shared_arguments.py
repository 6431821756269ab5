"""The arguments that ``daqsvc analyze`` and ``daqsvc calibrate`` have in common."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from daqsvc.commands.option_types import not_negative, number, percent, positive, probe_pair, speed
from daqsvc.recording.channels import add_max_memory, channel_map, sampling_rate_hz

if TYPE_CHECKING:
    from collections.abc import Callable

TOLERANCE_PERCENT = 20.0


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
        help="which variable of the recordings is which channel or sensor (default: the one of its name)",
    )
    add("--fs", type=sampling_rate_hz, metavar="HZ", help="sampling rate, if the files do not state it")
    add_max_memory(add)


def add_rotor(add: Callable[..., argparse.Action], *, speed_help: str, told: str = "") -> None:
    """Probes, speed and rotor, which a machine file says otherwise.

    Args:
        add: ``add_argument`` of the group that takes the options.
        speed_help: what the speed is.
        told: what is said beside the rotor's figures, where something else can tell them.
    """
    add("--probes", type=probe_pair, metavar="X,Y", help="channels of the two probes, y 90 degrees after x")
    add(
        "--speed-rpm",
        type=speed,
        metavar="N",
        help=f"{speed_help}; orbit:N follows the orbit's own 1X about N",
    )
    add("--keyphasor", metavar="CH", help="channel of the keyphasor, one pulse a revolution")
    add(
        "--keyphasor-threshold",
        type=number,
        metavar="V",
        help="level that marks its edge, in the channel's unit (default: half way from low to high)",
    )
    for name, unit, metavar, about in (
        ("natural-frequency", "hz", "F", "natural frequency of the healthy shaft"),
        ("damping", "ratio", "Z", "its damping ratio"),
    ):
        add(f"--{name}-{unit}", type=positive, metavar=metavar, help=f"{about}{told}")
        add(
            f"--{name}-tolerance",
            type=percent,
            default=TOLERANCE_PERCENT,
            metavar="PERCENT",
            help=f"how far that may be off (default: {TOLERANCE_PERCENT:g})",
        )
    add("--clearance-um", type=positive, metavar="C", help="radial clearance to the stator")
    add(
        "--static-sag-um",
        type=not_negative,
        metavar="S",
        help="sag of the shaft under its weight (default: g / omega^2; 0 if it stands upright)",
    )
    add("--ac-coupled", action="store_true", help="the probes have no mean position: do not look at it")


def unknown_channels(arguments: argparse.Namespace) -> str:
    """What is wrong with ``--map`` without a machine file; empty if nothing is."""
    known = [*arguments.probes, *([arguments.keyphasor] if arguments.keyphasor is not None else [])]
    unknown = [name for name in arguments.map if name not in known]
    if not unknown:
        return ""
    return (
        f"--map names {unknown[0]!r}, which --probes and --keyphasor do not; they name {', '.join(known)}: "
        "write --map CHANNEL=VARIABLE for one of these"
    )
