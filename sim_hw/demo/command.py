"""``daqsvc demo``: the whole service against a simulated machine, with nothing else needed."""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim_hw.demo.errors import DemoError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from sim_hw.demo.listener import Received
    from sim_hw.demo.session import Outcome, Script
    from sim_hw.recordings import Recording

EXIT_FAILED = 1
UNITS = ("g", "m/s2", "mm/s", "um", "mm", "mil")


class DemoCommand:
    """The verb ``demo`` (entry-point group ``daqsvc.commands``)."""

    help = "run the whole service against a simulated machine or a recording"
    description = (
        "Run the whole service - virtual CAN bus, driver, ring, detectors, alarms, journal, MQTT - against a "
        "simulated machine or a measured recording. It needs no broker, no root and no network: a broker "
        "starts inside the process, and what you see has come back from it."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        what = parser.add_argument_group("what to play")
        what.add_argument(
            "--scenario",
            default="paper",
            metavar="NAME|FILE",
            help="a built-in scenario (paper, healthy, link-faults) or a scenario file (default: paper)",
        )
        what.add_argument(
            "--seed", type=_whole, metavar="N", help="seed of everything random (default: the scenario's)"
        )
        what.add_argument(
            "--snr-db",
            type=float,
            metavar="DB",
            help="signal to noise of the probes (default: the scenario's)",
        )
        what.add_argument(
            "--recording",
            type=Path,
            metavar="FILE",
            help="play a measured recording (.mat, .csv, .csv.gz, .npz) instead of a scenario",
        )
        what.add_argument(
            "--map",
            type=_mapping,
            metavar="SENSOR=VARIABLE,...",
            help="which variables of the recording to play, and as which sensors (default: all of them)",
        )
        what.add_argument("--fs", type=_positive, metavar="HZ", help="sampling rate of the recording")
        what.add_argument(
            "--unit", choices=UNITS, default="g", help="unit of the recording's channels (default: g)"
        )
        what.add_argument(
            "--baseline",
            type=Path,
            metavar="FILE",
            help="recording of the healthy machine: alarm setpoints become 1.5 and 3 times its RMS",
        )
        what.add_argument("--baseline-map", type=_mapping, metavar="SENSOR=VARIABLE,...", help="as --map")
        what.add_argument("--baseline-fs", type=_positive, metavar="HZ", help="as --fs (default: the same)")
        how = parser.add_argument_group("how to play it")
        how.add_argument(
            "--speed",
            type=_positive,
            default=1.0,
            metavar="N",
            help="N times as fast as real time (default: 1)",
        )
        how.add_argument(
            "--broker",
            metavar="URL",
            help="publish to this broker, mqtt://HOST:PORT (default: one in the process)",
        )
        how.add_argument(
            "--json",
            action="store_true",
            help='print one JSON object a line: type "diagnosis", "alarm", "status", at the end "summary"',
        )

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        from daqsvc.cli import prepare_kernel_cache, start_logging  # noqa: PLC0415

        start_logging(verbose=False)
        if not arguments.json:
            import logging  # noqa: PLC0415

            # The view shows every alarm; the service's log would say it twice.
            logging.getLogger("daqsvc.service").setLevel(logging.ERROR)
        prepare_kernel_cache()
        try:
            import sim_hw.demo.session  # noqa: F401, PLC0415 - is all there that it needs?
            from daqsvc.settings import MachineFileError  # noqa: PLC0415
            from sim_hw.recordings import RecordingError  # noqa: PLC0415
            from sim_hw.scenario import ScenarioError  # noqa: PLC0415
        except ModuleNotFoundError as error:
            return _fail(f"the demo needs {error.name}; install it with: pip install 'daqsvc[demo]'")
        try:
            script = script_of(arguments)
            summary = _play(script, arguments)
        except (DemoError, MachineFileError, RecordingError, ScenarioError) as error:
            return _fail(str(error))
        except KeyboardInterrupt:
            return _fail("interrupted")
        return (
            0
            if summary["complete"]
            else _fail("the service's last messages did not come back from the broker")
        )


def _fail(message: str) -> int:
    print(f"daqsvc demo: {message}", file=sys.stderr)  # noqa: T201 - errors of the command line go to stderr
    return EXIT_FAILED


def _play(script: Script, arguments: argparse.Namespace) -> dict[str, Any]:
    from sim_hw.demo.session import Session  # noqa: PLC0415
    from sim_hw.demo.summary import summarise  # noqa: PLC0415

    def play(hear: Callable[[Received], None]) -> Outcome:
        session = Session(script, speed=arguments.speed, broker_url=arguments.broker, hear=hear)
        return asyncio.run(session.run())

    if arguments.json:
        summary = summarise(script, play(_print_message), speed=arguments.speed)
        _print_json(summary)
        return summary
    from sim_hw.demo.view import View  # noqa: PLC0415

    with View(script, arguments.speed) as view:
        outcome = play(view.hear)
    summary = summarise(script, outcome, speed=arguments.speed)
    view.show_summary(summary)
    return summary


def _print_message(message: Received) -> None:
    if message.kind in {"diagnosis", "alarm", "status"}:
        _print_json({"type": message.kind, "topic": message.topic, **message.payload})


def _print_json(content: Mapping[str, Any]) -> None:
    print(json.dumps(content), flush=True)  # noqa: T201 - this is the output


def script_of(arguments: argparse.Namespace) -> Script:
    """What the arguments ask to play.

    Raises:
        DemoError, RecordingError, ScenarioError: it cannot be played.
    """
    return _from_scenario(arguments) if arguments.recording is None else _from_recording(arguments)


def _from_scenario(arguments: argparse.Namespace) -> Script:
    import numpy as np  # noqa: PLC0415

    from sim_hw.demo.machines import laval_rig  # noqa: PLC0415
    from sim_hw.demo.session import Script  # noqa: PLC0415
    from sim_hw.scenario import load_scenario  # noqa: PLC0415

    scenario = load_scenario(arguments.scenario)
    machine = scenario.simulate(arguments.seed, arguments.snr_db)
    samples = np.column_stack([machine.channels[name] for name in ("x_um", "y_um", "keyphasor_v")])
    return Script(
        title=scenario.title,
        machine=lambda url: laval_rig(scenario, machine.noise_um, url),
        stream="shaft",
        samples=samples,
        rate_hz=machine.rate_hz,
        onsets=machine.onsets,
        samples_per_rev=machine.samples_per_rev,
        faults=scenario.link(arguments.seed),
        seed=scenario.seed if arguments.seed is None else arguments.seed,
    )


def _from_recording(arguments: argparse.Namespace) -> Script:
    from sim_hw.demo.baseline import setpoints  # noqa: PLC0415
    from sim_hw.demo.machines import Setpoints, for_recording  # noqa: PLC0415
    from sim_hw.demo.session import Script  # noqa: PLC0415
    from sim_hw.recordings import load_recording  # noqa: PLC0415

    recording = _playable(load_recording(arguments.recording, arguments.map, arguments.fs))
    limits = Setpoints()
    if arguments.baseline is not None:
        rate_hz = arguments.baseline_fs or arguments.fs
        healthy = _playable(
            load_recording(arguments.baseline, arguments.baseline_map or arguments.map, rate_hz)
        )
        limits = setpoints(healthy, recording.rate_hz)
        if not set(limits) & set(recording.names):
            raise DemoError(
                f"baseline {healthy.source} gives {', '.join(limits)}, the recording "
                f"{', '.join(recording.names)}; give both the same sensor names with --map and --baseline-map"
            )
    return Script(
        title=f"{recording.source.name}: {', '.join(recording.names)} at {recording.rate_hz:g} Hz",
        machine=lambda url: for_recording(recording, arguments.unit, limits, url),
        stream="recording",
        samples=recording.samples,
        rate_hz=recording.rate_hz,
    )


def _playable(recording: Recording) -> Recording:
    if recording.nan_count:
        raise DemoError(
            f"{recording.source} holds {recording.nan_count} NaN samples, which no device could send; "
            "cut them out or interpolate them"
        )
    names = tuple(re.sub(r"[^A-Za-z0-9_.-]+", "-", name).strip("-") for name in recording.names)
    return replace(recording, names=names)


def _mapping(text: str) -> dict[str, str]:
    pairs = [pair.partition("=") for pair in text.split(",")]
    if not all(sensor and variable for sensor, _, variable in pairs):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a map; write SENSOR=VARIABLE, several with commas between"
        )
    return {sensor.strip(): variable.strip() for sensor, _, variable in pairs}


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return value


def _whole(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 on")
    return int(text)
