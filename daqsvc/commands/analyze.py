"""``daqsvc analyze``: the detectors of the service over recordings, faster than real time."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from daqsvc.commands.analyze_fleet import fleet_misuse, run_fleet
from daqsvc.commands.arguments import EXIT_OK, EXIT_REFUSED, EXIT_USAGE, refuse_value
from daqsvc.commands.complaint import complain
from daqsvc.commands.recording_options import (
    add_analyze_options,
    analyze_misuse,
    by_bearing,
    by_orders,
    refuse,
    split_files,
)
from daqsvc.commands.with_kernels import VerbWithKernels
from daqsvc.errors.command_line import CANNOT_WRITE, EXTRA_MISSING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from daqsvc.errors.code import Code
    from daqsvc.offline.runner import Outcome, Runner
    from daqsvc.settings import MachineFile

    Load: TypeAlias = Callable[[Path], MachineFile | None]

_FEW_PER_PROCESS = 3
"""Its own process costs as much as so many short recordings."""


class AnalyzeCommand(VerbWithKernels):
    """``daqsvc analyze [MACHINE] RECORDING...``."""

    help = "judge recordings of a machine: which fault, how sure, since when"
    description = (
        "Run the detectors of the service over recordings, faster than real time: .npz, .mat, "
        ".csv[.gz], .wav, .parquet, .tdms, .mf4, .uff, .h5, snapshots. With a machine file also CAN "
        "logs: .blf, .asc, .log, .trc, or a folder of them. Print which fault the rotor has, what else "
        "it might be, since when, and how large it is. Either the first file is a machine file (.toml), "
        "or options describe probes, speed and rotor. Then the first revolutions of a recording must be "
        "those of the healthy machine. Accelerometers without a keyphasor are compared with a recording "
        "of the healthy machine (--channels, --baseline). With --bearing or --orders, analyze finds "
        "which part of a rolling bearing is damaged. Verdicts: normal, unbalance, damping_loss, "
        "static_load, stiffness_loss, rub, unmodelled (changed, but none of these), small_change (too "
        "small for a name); of a bearing: normal, changed, inner, outer, ball, inner_or_outer. With "
        "--cluster, FILE is the archive of a fleet: a folder or a URL with a folder for each machine. "
        "Dask judges it, and the results are a table of Parquet files."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `Command.add_arguments`."""
        self._parser = parser
        parser.epilog = (
            "Exit code: 0 if every recording was judged; 2 for wrong usage; 3 if one could not be "
            "judged (its line has the reason); 1 if something else failed."
        )
        add_analyze_options(parser)

    def run(self, arguments: argparse.Namespace) -> int:
        """See `Command.run`."""
        if wrong := fleet_misuse(arguments):
            self._parser.error(wrong)
        if arguments.cluster is not None:
            return run_fleet(arguments)
        machine, recordings = split_files(arguments)
        if wrong := analyze_misuse(arguments, machine, recordings):
            refuse(self._parser, wrong, recordings)
        from daqsvc.recording.recording import set_memory  # noqa: PLC0415 - each verb imports what it needs

        set_memory(arguments.max_memory)
        self._prepare_kernel_cache()
        if arguments.plot is not None and (lacking := _cannot_plot(arguments.plot)):
            what, of_kind = lacking
            return complain("daqsvc analyze", what, of_kind)
        loaded = None
        if machine is not None:
            loaded = self._load(machine)
            if loaded is None:
                return EXIT_USAGE
        from daqsvc.offline.machine_options import WrongValueError  # noqa: PLC0415
        from daqsvc.offline.runner import WorkerLostError  # noqa: PLC0415

        try:
            runner = _by_options(arguments) if machine is None else _by_file(machine, loaded, arguments)
            runner.prepare()
        except WrongValueError as error:
            refuse_value(self._parser, error, error.code)
        except (OSError, ValueError) as error:
            self._parser.error(str(error))
        figures = _figure_names(recordings, arguments.plot)
        processes = _processes(arguments.jobs, len(recordings))
        try:
            return _tell(_outcomes(runner, recordings, figures, processes), as_json=arguments.json)
        except WorkerLostError as error:
            return complain("daqsvc analyze", error, error.code)


def _by_file(machine: Path, loaded: MachineFile | None, arguments: argparse.Namespace) -> Runner:
    """Judges by a machine file, which has been read here, and is read once more in each other process."""
    from daqsvc.offline.machine_options import recording_options  # noqa: PLC0415
    from daqsvc.offline.runner import Runner  # noqa: PLC0415
    from daqsvc.settings import load_machine_file  # noqa: PLC0415

    options = recording_options(arguments, calibration=arguments.calibration)
    return Runner(partial(load_machine_file, machine), options, machine=loaded)


def _by_options(arguments: argparse.Namespace) -> Runner:
    """Judges by what the options state.

    Raises:
        ValueError: they contradict each other.
    """
    from daqsvc.offline import machine_options as options  # noqa: PLC0415
    from daqsvc.offline.runner import Runner  # noqa: PLC0415

    # Without the verb itself, which does not go to another process.
    analysis_options = argparse.Namespace(**{k: v for k, v in vars(arguments).items() if k != "command"})
    if by_bearing(analysis_options):
        healthy = options.recording_options(
            analysis_options,
            in_memory=True,
            patterns=True,
            calibration=analysis_options.calibration,
            healthy=analysis_options.baseline,
            healthy_channels=analysis_options.baseline_map,
            healthy_rate_hz=analysis_options.baseline_fs,
        )
        return Runner(partial(options.bearing_machine, analysis_options), healthy)
    if by_orders(analysis_options):
        from daqsvc.offline.orders import order_detectors  # noqa: PLC0415 - brings SciPy's transforms

        healthy = options.recording_options(
            analysis_options, in_memory=True, healthy=analysis_options.baseline
        )
        detectors = partial(order_detectors, analysis_options.false_alarm_probability)
        return Runner(partial(options.accelerometer_machine, analysis_options), healthy, detectors)
    step_rpm = 0.0 if analysis_options.speed_rpm is None else analysis_options.speed_rpm.step_rpm
    rotor = options.recording_options(
        analysis_options, in_memory=True, calibration=analysis_options.calibration, speed_step_rpm=step_rpm
    )
    return Runner(partial(options.rotor_machine, analysis_options), rotor)


def _outcomes(
    runner: Runner, recordings: list[str], figures: list[str | None], processes: int
) -> Iterator[Outcome]:
    from daqsvc.offline.progress import progress_bar  # noqa: PLC0415
    from daqsvc.offline.runner import judge_all  # noqa: PLC0415

    if len(recordings) == 1:
        with progress_bar(Path(recordings[0]).name) as bar:
            outcome = runner.judge(recordings[0], figures[0], bar.update)
        yield outcome
        return
    outcomes = judge_all(runner, recordings, figures, processes)
    if sys.stdout.isatty():
        yield from outcomes  # each line tells how far it is
        return
    with progress_bar(f"{len(recordings)} recordings") as bar:
        for done, outcome in enumerate(outcomes, 1):
            yield outcome
            bar.update(done, len(recordings))


def _tell(outcomes: Iterable[Outcome], *, as_json: bool) -> int:
    code = EXIT_OK
    for outcome in outcomes:
        # The reader of a pipe gets each line at once.
        print(json.dumps(outcome.json) if as_json else outcome.text, flush=True)  # noqa: T201
        if outcome.refused:
            code = EXIT_REFUSED
    return code


def _processes(jobs: int | None, recordings: int) -> int:
    if jobs is not None:
        return min(jobs, recordings)
    return max(1, min(os.cpu_count() or 1, recordings // _FEW_PER_PROCESS))


def _cannot_plot(directory: Path) -> tuple[str, Code] | None:
    if importlib.util.find_spec("matplotlib") is None:
        return "--plot needs matplotlib; install it with: pip install 'daqsvc[plot]'", EXTRA_MISSING
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        return f"--plot {directory}: {error.strerror}; name a directory that can be written", CANNOT_WRITE
    if not os.access(directory, os.W_OK | os.X_OK):
        return f"--plot {directory}: cannot be written; name another directory", CANNOT_WRITE
    return None


def _figure_names(recordings: list[str], directory: Path | None) -> list[str | None]:
    """The prefix of each recording's figures; recordings of one name get a number."""
    if directory is None:
        return [None] * len(recordings)
    names: list[str | None] = []
    seen: dict[str, int] = {}
    for recording in recordings:
        stem = Path(recording).name.split(".")[0]
        seen[stem] = seen.get(stem, 0) + 1
        names.append(str(directory / (stem if seen[stem] == 1 else f"{stem}-{seen[stem]}")))
    return names
