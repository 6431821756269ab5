"""``daqsvc analyze``: the detectors of the service over recordings, faster than real time."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from daqsvc.commands.analyze_arguments import (
    add_machine_arguments,
    add_output_arguments,
    add_rotor_arguments,
    misuse,
)
from daqsvc.commands.analyze_bearing import add_bearing_arguments, bearing_analyst, bearing_misuse, by_bearing
from daqsvc.commands.analyze_orders import add_order_arguments, by_orders, order_analyst, order_misuse
from daqsvc.commands.option_types import SpeedOption

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterable, Iterator

    from daqsvc.analysis.many import Analyst, Outcome
    from daqsvc.rotor.synchronous.baseline import Calibration
    from daqsvc.settings import MachineFile

    Load: TypeAlias = Callable[[Path], MachineFile | None]

EXIT_OK = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_REFUSED = 3

_FEW_PER_PROCESS = 3
"""A process of its own costs as much as so many short recordings."""


class AnalyzeCommand:
    """``daqsvc analyze [MACHINE] RECORDING...``.

    Args:
        load: reads a machine file; None after its errors have been printed.
        prepare_kernel_cache: says where compiled kernels are kept.
    """

    help = "say what a machine's recordings show: which fault, how sure, since when"
    description = (
        "Run the detectors of the service over recordings (.npz, .mat, .csv[.gz], .wav, .parquet; with a "
        "machine file CAN logs too: .blf, .asc, .log, .trc, or a folder of them), faster than real time, and "
        "say which fault the rotor has, what else it might be, since when, and how large "
        "it is. Either the first file is a machine file (.toml), or options name probes, speed and rotor; "
        "the first revolutions of a recording are then the healthy machine. Accelerometers without a "
        "keyphasor are compared with a recording of the healthy machine (--channels, --baseline); with "
        "--bearing or --orders they say which part of a rolling bearing is damaged. Verdicts: "
        "normal, unbalance, damping_loss, static_load, stiffness_loss, rub, unmodelled (changed, but none "
        "of these), small_change (too small for a name); of a bearing: normal, changed, inner, outer, ball, "
        "inner_or_outer."
    )

    def __init__(self, load: Load, prepare_kernel_cache: Callable[[], None]) -> None:
        self._load = load
        self._prepare_kernel_cache = prepare_kernel_cache

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `Command.add_arguments`."""
        self._parser = parser
        parser.epilog = (
            "Exit code: 0 if every recording was judged, 3 if one could not be (its line says why), 2 for "
            "wrong usage, 1 if something else failed."
        )
        parser.add_argument(
            "files", nargs="+", metavar="FILE", help="a machine file (.toml) if there is one, then recordings"
        )
        add_rotor_arguments(parser)
        add_order_arguments(parser)
        add_bearing_arguments(parser)
        add_machine_arguments(parser)
        add_output_arguments(parser)

    def run(self, arguments: argparse.Namespace) -> int:
        """See `Command.run`."""
        machine = arguments.files[0] if arguments.files[0].lower().endswith(".toml") else None
        recordings = arguments.files[1:] if machine is not None else arguments.files
        if by_bearing(arguments):
            wrong, make = bearing_misuse(arguments, machine), bearing_analyst
        elif by_orders(arguments):
            wrong, make = order_misuse(arguments, machine), order_analyst
        else:
            wrong, make = misuse(arguments, machine, recordings), None
        if wrong:
            self._parser.error(wrong)
        from daqsvc.recording.recording import set_memory  # noqa: PLC0415 - each verb imports what it needs

        set_memory(arguments.max_memory)
        self._prepare_kernel_cache()
        if arguments.plot is not None and (wrong := _cannot_plot(arguments.plot)):
            return _fail(wrong, EXIT_FAILED)
        if make is not None:
            analyst = self._accelerometers(make, arguments)
        else:
            analyst = self._rotor(arguments) if machine is None else self._machine(machine, arguments)
        if analyst is None:
            return EXIT_USAGE
        from daqsvc.analysis.many import WorkerLostError  # noqa: PLC0415

        figures = _figure_names(recordings, arguments.plot)
        processes = _processes(arguments.jobs, len(recordings))
        try:
            return _tell(_outcomes(analyst, recordings, figures, processes), as_json=arguments.json)
        except WorkerLostError as error:
            return _fail(str(error), EXIT_FAILED)

    def _rotor(self, arguments: argparse.Namespace) -> Analyst | None:
        """An analyst by the options; None after their error has been printed."""
        from daqsvc.analysis.analyst import RotorAnalyst  # noqa: PLC0415
        from daqsvc.analysis.setup import Keyphasor, RotorSetup  # noqa: PLC0415
        from daqsvc.rotor.laval import LavalRotor  # noqa: PLC0415
        from daqsvc.rotor.synchronous.departure import threshold_for  # noqa: PLC0415
        from daqsvc.rotor.synchronous.watch import WatchRules  # noqa: PLC0415

        keyphasor, speed = arguments.keyphasor, arguments.speed_rpm or SpeedOption(None)
        try:
            rules = WatchRules(
                calibrate_revolutions=arguments.calibrate_revs,
                false_alarms_per_1000_rev=arguments.false_alarms_per_1000_rev,
                retry=False,
            )
            threshold_for(rules.false_alarms_per_1000_rev)
            calibrations: tuple[Calibration, ...] = ()
            if arguments.calibration is not None:
                from daqsvc.rotor.calibration.file import load_healthy  # noqa: PLC0415

                rotor, calibrations = load_healthy(arguments.calibration, speed.rpm, arguments.clearance_um)
            else:
                rotor = LavalRotor(
                    natural_frequency_hz=arguments.natural_frequency_hz,
                    damping_ratio=arguments.damping_ratio,
                    natural_frequency_tolerance=arguments.natural_frequency_tolerance / 100.0,
                    damping_tolerance=arguments.damping_tolerance / 100.0,
                    clearance_um=arguments.clearance_um,
                    static_sag_um=arguments.static_sag_um,
                )
            setup = RotorSetup(
                probes=arguments.probes,
                rotor=rotor,
                speed_rpm=speed.rpm,
                speed_step_rpm=speed.step_rpm,
                unit=arguments.unit or "um",
                keyphasor=None if keyphasor is None else Keyphasor(keyphasor, arguments.keyphasor_threshold),
                follow_orbit=speed.orbit or arguments.follow_orbit,
                rules=rules,
                calibrations=calibrations,
                ac_coupled=arguments.ac_coupled,
                channels=arguments.map,
                rate_hz=arguments.fs,
            )
        except (OSError, ValueError) as error:
            self._parser.error(str(error))
        return RotorAnalyst(setup)

    def _accelerometers(
        self, make: Callable[[argparse.Namespace], Analyst], arguments: argparse.Namespace
    ) -> Analyst | None:
        """An analyst of accelerometers; None after its error has been printed."""
        try:
            return make(arguments)
        except ValueError as error:
            self._parser.error(str(error))

    def _machine(self, machine: str, arguments: argparse.Namespace) -> Analyst | None:
        """An analyst by a machine file; None after its errors have been printed."""
        loaded = self._load(Path(machine))
        if loaded is None:
            return None
        from daqsvc.analysis.machine import MachineAnalyst  # noqa: PLC0415

        try:
            analyst = MachineAnalyst(
                machine=machine,
                channels=arguments.map,
                rate_hz=arguments.fs,
                unit=arguments.unit,
                calibration=arguments.calibration,
                read=[loaded],
            )
            analyst.check()
        except (OSError, ValueError) as error:
            self._parser.error(str(error))
        return analyst


def _outcomes(
    analyst: Analyst, recordings: list[str], figures: list[str | None], processes: int
) -> Iterator[Outcome]:
    from daqsvc.analysis.many import judge_all  # noqa: PLC0415
    from daqsvc.analysis.progress import progress_bar  # noqa: PLC0415

    if len(recordings) == 1:
        with progress_bar(Path(recordings[0]).name) as bar:
            outcome = analyst.judge(recordings[0], figures[0], bar.update)
        yield outcome
        return
    found = judge_all(analyst, recordings, figures, processes)
    if sys.stdout.isatty():
        yield from found  # each line tells how far it is
        return
    with progress_bar(f"{len(recordings)} recordings") as bar:
        for done, outcome in enumerate(found, 1):
            yield outcome
            bar.update(done, len(recordings))


def _tell(outcomes: Iterable[Outcome], *, as_json: bool) -> int:
    code = EXIT_OK
    for outcome in outcomes:
        # Whoever reads a pipe wants each line when it is there.
        print(json.dumps(outcome.json) if as_json else outcome.text, flush=True)  # noqa: T201
        if outcome.refused:
            code = EXIT_REFUSED
    return code


def _processes(jobs: int | None, recordings: int) -> int:
    if jobs is not None:
        return min(jobs, recordings)
    return max(1, min(os.cpu_count() or 1, recordings // _FEW_PER_PROCESS))


def _cannot_plot(directory: Path) -> str:
    if importlib.util.find_spec("matplotlib") is None:
        return "--plot needs matplotlib; install it with: pip install 'daqsvc[plot]'"
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        return f"--plot {directory}: {error.strerror}; name a directory that can be written"
    if not os.access(directory, os.W_OK | os.X_OK):
        return f"--plot {directory}: cannot be written; name another directory"
    return ""


def _figure_names(recordings: list[str], directory: Path | None) -> list[str | None]:
    """What each recording's figures begin with; recordings of one name are told apart by a number."""
    if directory is None:
        return [None] * len(recordings)
    names: list[str | None] = []
    seen: dict[str, int] = {}
    for recording in recordings:
        stem = Path(recording).name.split(".")[0]
        seen[stem] = seen.get(stem, 0) + 1
        names.append(str(directory / (stem if seen[stem] == 1 else f"{stem}-{seen[stem]}")))
    return names


def _fail(message: str, code: int) -> int:
    print(f"daqsvc analyze: {message}", file=sys.stderr)  # noqa: T201 - errors of the command line go to stderr
    return code
