"""The command line: ``daqsvc run FILE``, ``daqsvc check FILE``, and whatever else is registered."""

from __future__ import annotations

import argparse
import asyncio
import errno
import logging
import os
import signal
import sys
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import daqsvc
from daqsvc.commands.alarm_orders import order_commands
from daqsvc.commands.alarms import AlarmsCommand
from daqsvc.commands.analyze import AnalyzeCommand
from daqsvc.commands.calibrate import CalibrateCommand
from daqsvc.commands.detectability import DetectabilityCommand
from daqsvc.commands.record import RecordCommand
from daqsvc.commands.store_argument import store_directory

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daqsvc.settings import MachineFile

COMMANDS = "daqsvc.commands"

EXIT_OK = 0
EXIT_FAILED = 1
EXIT_BAD_FILE = 2


class Command(Protocol):
    """A verb of the command line; others register theirs by entry point in ``daqsvc.commands``."""

    help: str
    """One line for the list of verbs."""
    description: str
    """What ``daqsvc VERB --help`` says first."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the arguments; heavy imports belong into `run`."""
        ...

    def run(self, arguments: argparse.Namespace) -> int:
        """Do it; returns the exit code."""
        ...


class CheckCommand:
    """``daqsvc check FILE``."""

    help = "read a machine file and say what was understood, or every error at once"
    description = (
        "Read a machine file and print what was understood. If it cannot be used, print every error with "
        "file, line, key, value and remedy, and exit with 2."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `Command.add_arguments`."""
        parser.add_argument("file", type=Path, metavar="FILE", help="the machine file (TOML)")

    def run(self, arguments: argparse.Namespace) -> int:
        """See `Command.run`."""
        machine = load(arguments.file)
        if machine is None:
            return EXIT_BAD_FILE
        from daqsvc.assembly import AssemblyError, check_calibrations  # noqa: PLC0415
        from daqsvc.settings import describe  # noqa: PLC0415 - each verb imports only what it needs

        try:
            check_calibrations(machine)
        except AssemblyError as error:
            print(error, file=sys.stderr)  # noqa: T201 - errors of the command line go to stderr
            return EXIT_BAD_FILE
        print(describe(machine))  # noqa: T201 - this is what the verb is for
        return EXIT_OK


class RunCommand:
    """``daqsvc run FILE``."""

    help = "run the service until SIGTERM or SIGINT"
    description = (
        "Run the service for one machine file: acquire, diagnose, and publish alarms. SIGTERM or SIGINT "
        "(Ctrl-C) stop it within two seconds; alarms that the broker has not acknowledged stay in the "
        "journal and go out at the next start."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `Command.add_arguments`."""
        parser.add_argument("file", type=Path, metavar="FILE", help="the machine file (TOML)")
        parser.add_argument(
            "--store",
            type=Path,
            metavar="DIR",
            help="directory of the alarm journal (default: as in the file, else $STATE_DIRECTORY, "
            "else ~/.local/state/daqsvc)",
        )
        parser.add_argument("-v", "--verbose", action="store_true", help="log what goes well, too")

    def run(self, arguments: argparse.Namespace) -> int:
        """See `Command.run`."""
        start_logging(verbose=arguments.verbose)
        machine = load(arguments.file)
        if machine is None:
            return EXIT_BAD_FILE
        prepare_kernel_cache()
        from daqsvc.assembly import AssemblyError  # noqa: PLC0415
        from daqsvc.outbox.store import OutboxError  # noqa: PLC0415
        from drivers.base import DeviceAbsentError  # noqa: PLC0415
        from drivers.frames import LayoutError  # noqa: PLC0415

        try:
            asyncio.run(_run_until_signal(machine, arguments.store or store_directory(machine)))
        except (AssemblyError, DeviceAbsentError, LayoutError, OutboxError) as error:
            logging.getLogger(__name__).critical("%s", error)
            return EXIT_FAILED
        return EXIT_OK


async def _run_until_signal(machine: MachineFile, store: Path) -> None:
    from daqsvc.service import Service  # noqa: PLC0415

    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    # Before anything slow: a signal that comes while kernels compile must not kill.
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    service = Service(machine, store)
    log = logging.getLogger(__name__)
    running = asyncio.create_task(service.run(stop))
    ready = asyncio.create_task(service.ready.wait())
    await asyncio.wait({running, ready}, return_when=asyncio.FIRST_COMPLETED)
    if service.ready.is_set():
        log.info("watching %s; the journal is in %s", machine.machine.name, store)
    ready.cancel()
    await running
    log.info("stopped")


def load(path: Path) -> MachineFile | None:
    """The machine file at ``path``; None after its errors have been printed to stderr."""
    from daqsvc.settings import MachineFileError, load_machine_file  # noqa: PLC0415

    try:
        return load_machine_file(path)
    except MachineFileError as error:
        print(error, file=sys.stderr)  # noqa: T201 - errors of the command line go to stderr
        return None


def prepare_kernel_cache() -> None:
    """Keep compiled kernels in the service's own cache directory; call before any kernel is imported."""
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    given = os.environ.get("CACHE_DIRECTORY", "").split(":")[0]
    cache = Path(given or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    directory = cache / "kernels" if given else cache / "daqsvc" / "kernels"
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        logging.getLogger(__name__).warning(
            "compiled kernels cannot be kept in %s (%s): every start compiles them again; "
            "set NUMBA_CACHE_DIR to a directory that can be written",
            directory,
            error.strerror,
        )
        return
    os.environ["NUMBA_CACHE_DIR"] = str(directory)


def start_logging(*, verbose: bool) -> None:
    """Log to stderr; under systemd without time stamps, which the journal adds itself."""
    stamp = "" if "JOURNAL_STREAM" in os.environ else "%(asctime)s "
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING,
        format=f"{stamp}%(levelname)s %(message)s",
        stream=sys.stderr,
    )
    logging.getLogger("can").setLevel(logging.ERROR)


def commands() -> dict[str, Command]:
    """Every verb there is, by name."""
    known: dict[str, Command] = {
        "run": RunCommand(),
        "check": CheckCommand(),
        "alarms": AlarmsCommand(load),
        **order_commands(load),
        "analyze": AnalyzeCommand(load, prepare_kernel_cache),
        "calibrate": CalibrateCommand(load, prepare_kernel_cache),
        "detectability": DetectabilityCommand(load, prepare_kernel_cache),
        "record": RecordCommand(load, start_logging),
    }
    for point in entry_points(group=COMMANDS):
        try:
            known[point.name] = point.load()()
        except ImportError as error:
            # A broken extra must not keep the service from running.
            print(f"daqsvc: verb {point.name!r} is left out: {error}", file=sys.stderr)  # noqa: T201
    return known


def parser(known: dict[str, Command]) -> argparse.ArgumentParser:
    """The whole command line."""
    root = argparse.ArgumentParser(
        prog="daqsvc",
        description="Real-time data acquisition and model-based fault diagnosis for rotating machines.",
        epilog="daqsvc VERB --help tells about one verb.",
    )
    root.add_argument("--version", action="version", version=f"daqsvc {daqsvc.__version__}")
    verbs = root.add_subparsers(dest="verb", metavar="VERB", required=True, title="verbs")
    for name, command in known.items():
        verb = verbs.add_parser(name, help=command.help, description=command.description)
        command.add_arguments(verb)
        verb.set_defaults(command=command)
    return root


def _chosen(root: argparse.ArgumentParser, arguments: Sequence[str] | None) -> argparse.Namespace:
    """The arguments, those of a verb that takes files with options between them too.

    argparse takes the files of a verb in one piece and knows no better with verbs.
    """
    chosen, rest = root.parse_known_args(arguments)
    files = getattr(chosen, "files", None)
    if rest and (files is None or any(one.startswith("-") for one in rest)):
        root.parse_args(arguments)  # says what is wrong
    if rest and files is not None:
        chosen.files = [*files, *rest]
    return chosen


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the console script; returns the exit code."""
    try:
        chosen = _chosen(parser(commands()), arguments)
        command: Command = chosen.command
        code = command.run(chosen)
        sys.stdout.flush()
    except BrokenPipeError:
        # Whoever read our output has had enough, as `head` does.
        _give_up_stdout()
        return EXIT_OK
    except KeyboardInterrupt:
        print("daqsvc: interrupted", file=sys.stderr)  # noqa: T201
        return EXIT_FAILED
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        _give_up_stdout()
        print(f"daqsvc: {error.strerror}: the output is not complete", file=sys.stderr)  # noqa: T201
        return EXIT_FAILED
    return code


def _give_up_stdout() -> None:
    """Let the interpreter's own flush at exit go nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
