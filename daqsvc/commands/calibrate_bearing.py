"""``daqsvc calibrate`` for bearings: the healthy machine by accelerometers on its housings, into a file."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from daqsvc.commands.analyze_bearing import MOST_CHANNELS, fault_orders, orders_given
from daqsvc.commands.analyze_orders import channel_names

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from daqsvc.bearing.identify_baseline import BearingBaseline
    from daqsvc.settings import MachineFile

EXIT_OK = 0
EXIT_FAILED = 1
EXIT_REFUSED = 3

_ROTOR_ONLY = ("probes", "keyphasor", "natural_frequency_hz", "damping_ratio", "clearance_um", "sweep_rpm")


def add_bearing_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of bearings, in place of those of the rotor."""
    bearings = parser.add_argument_group("bearings, with --speed-rpm, in place of the rotor")
    bearings.add_argument(
        "--channels",
        type=channel_names,
        metavar="NAME[,NAME]",
        help="accelerometers on the housings; name them as the sensors of the machine file are",
    )
    bearings.add_argument("--bearing", metavar="NAME", help="designation in the catalogue, e.g. 6205-2RS")
    bearings.add_argument(
        "--orders",
        type=fault_orders,
        metavar="BPFI=F,BPFO=F,BSF=F,FTF=F",
        help="fault orders per revolution of the shaft, in place of --bearing",
    )


def by_bearing(arguments: argparse.Namespace) -> bool:
    """Whether the options are those of bearings."""
    return any(getattr(arguments, name) is not None for name in ("channels", "bearing", "orders"))


def bearing_misuse(arguments: argparse.Namespace, machine: str | None, recordings: Sequence[str]) -> str:
    """What is wrong with the options of bearings together; empty if nothing is."""
    if machine is not None:
        return "--channels, --bearing, --orders: the machine file says this; leave them out"
    if extra := [name for name in _ROTOR_ONLY if getattr(arguments, name) is not None]:
        return f"--{extra[0].replace('_', '-')}: not with --channels; a bearing is calibrated by itself"
    needed = {"--channels": arguments.channels, "--speed-rpm": arguments.speed_rpm}
    missing = [name for name, value in needed.items() if value is None]
    if arguments.bearing is None and arguments.orders is None:
        missing.append("--bearing or --orders")
    if missing:
        return f"to calibrate a bearing, {', '.join(missing)} must be given too"
    if arguments.bearing is not None and arguments.orders is not None:
        return "--bearing and --orders both say what the bearing is; leave out one of them"
    if len(arguments.channels) > MOST_CHANNELS:
        return f"--channels names {len(arguments.channels)} accelerometers; give one or two"
    return shared_misuse(arguments, recordings)


def shared_misuse(arguments: argparse.Namespace, recordings: Sequence[str]) -> str:
    """What is wrong with what both forms need; empty if nothing is."""
    if arguments.live:
        return "--live is for rotors; the service learns the healthy state of bearings by itself"
    if len(recordings) != 1:
        return f"{len(recordings)} recordings are given; the healthy state of bearings is learnt from one"
    if arguments.out is None and not arguments.json:
        return "nothing would be kept: give --out FILE, --json or both"
    return ""


def calibrate_bearings(
    recording: str, arguments: argparse.Namespace, machine: MachineFile | None = None
) -> int:
    """Learn the healthy state, write it, say what was found; returns the exit code.

    Args:
        recording: path of the recording of the healthy machine.
        arguments: the options.
        machine: the machine file; None: the options say what is known.

    Raises:
        ValueError: the options contradict each other.
    """
    from daqsvc.acquisition.clock import SystemClock, iso_utc  # noqa: PLC0415 - each verb imports what it needs
    from daqsvc.analysis.bearing_calibrating import learn_by_machine, learn_by_setup  # noqa: PLC0415
    from daqsvc.analysis.bearing_setup import BearingSetup  # noqa: PLC0415
    from daqsvc.analysis.setup import RefusedError  # noqa: PLC0415
    from daqsvc.bearing.identify import NotIdentifiableError  # noqa: PLC0415
    from daqsvc.bearing.identify_file import BaselineFileError, save_bearing_baseline  # noqa: PLC0415
    from daqsvc.recording.errors import RecordingError  # noqa: PLC0415

    try:
        if machine is not None:
            found = learn_by_machine(machine, recording, arguments.map, arguments.fs)
        else:
            setup = BearingSetup(
                channels=arguments.channels,
                speed_rpm=abs(arguments.speed_rpm.rpm),
                bearings=dict.fromkeys(arguments.channels, orders_given(arguments)),
                map=arguments.map,
                rate_hz=arguments.fs,
            )
            found = learn_by_setup(setup, recording)
    except (RefusedError, RecordingError, NotIdentifiableError) as error:
        if arguments.json:
            print(json.dumps({"refused": f"{error}"}), flush=True)  # noqa: T201 - this is what the verb is for
        else:
            print(f"not calibrated: {error}", file=sys.stderr)  # noqa: T201
        return EXIT_REFUSED
    found = replace(found, written=iso_utc(SystemClock().wall_ns()))
    if arguments.out is not None:
        try:
            save_bearing_baseline(found, arguments.out)
        except BaselineFileError as error:
            print(f"daqsvc calibrate: {error}", file=sys.stderr)  # noqa: T201 - errors go to stderr
            return EXIT_FAILED
    if arguments.json:
        print(json.dumps(_as_json(found, arguments.out)), flush=True)  # noqa: T201
    else:
        print(_as_text(found, arguments.out), flush=True)  # noqa: T201
    return EXIT_OK


def _as_json(found: BearingBaseline, out: object) -> dict[str, Any]:
    return {
        "refused": None,
        "source": found.source,
        "written_to": None if out is None else str(out),
        "rate_hz": found.rate_hz,
        "speed_rpm": found.speed_rpm,
        "models": [
            {
                "channels": list(channels),
                "order": residual.model.order,
                "spectral_radius": residual.model.spectral_radius,
                "whiteness_p": residual.model.whiteness.p_value,
                "predictable": residual.model.whiteness.predictable,
                "windows": residual.windows,
                "window_s": residual.window_samples / found.rate_hz,
                "spread_db": float(residual.spread_db[0]),
            }
            for channels, residual in found.residuals.items()
        ],
        "lines": {
            channel: {part: {"z": e.z, "size": e.depth} for part, e in race.evidence.items()}
            for channel, race in found.races.items()
        },
    }


def _as_text(found: BearingBaseline, out: object) -> str:
    lines = [f"{found.source}: {found.rate_hz:g} Hz, {found.speed_rpm:g} rpm"]
    for channels, residual in found.residuals.items():
        model = residual.model
        lines.append(
            f"{' and '.join(channels)}: autoregressive of order {model.order}, stable (largest pole "
            f"{model.spectral_radius:.4f}); {100.0 * model.whiteness.predictable:.2g} % of the innovations "
            f"can still be predicted; {residual.windows} windows of "
            f"{residual.window_samples / found.rate_hz:.3g} s differ by {residual.spread_db[0]:.2f} dB"
        )
    if out is not None:
        lines.append(f"written to {out}")
    return "\n  ".join(lines)
