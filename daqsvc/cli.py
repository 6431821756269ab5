"""The command line: ``daqsvc run FILE``, ``daqsvc check FILE``, and whatever else is registered."""

from __future__ import annotations

from daqsvc.commands import early_signals  # before all that takes long
from daqsvc.documentation import documented_in

# isort: split
import argparse
import atexit
import contextlib
import errno
import logging
import os
import signal
import sys
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import daqsvc
from daqsvc import kernel_cache
from daqsvc.commands.account import AccountCommand
from daqsvc.commands.alarms import AlarmsCommand, alarm_verbs
from daqsvc.commands.analyze import AnalyzeCommand
from daqsvc.commands.arguments import EXIT_FAILED, EXIT_OK, EXIT_USAGE, ArgumentParser, is_path
from daqsvc.commands.calibrate import CalibrateCommand
from daqsvc.commands.complaint import complain
from daqsvc.commands.detectability import DetectabilityCommand
from daqsvc.commands.example import ExampleCommand
from daqsvc.commands.explain import ExplainCommand
from daqsvc.commands.export import ExportCommand
from daqsvc.commands.fleet import FleetCommand
from daqsvc.commands.machine_files import load_box
from daqsvc.commands.new.command import NewCommand
from daqsvc.commands.page import PageCommand
from daqsvc.commands.record import RecordCommand
from daqsvc.commands.reload import ReloadCommand
from daqsvc.commands.replay import ReplayCommand
from daqsvc.commands.run import RunCommand
from daqsvc.commands.snapshot import SnapshotCommand
from daqsvc.commands.sniff import SniffCommand
from daqsvc.commands.status import StatusCommand
from daqsvc.commands.trend import TrendCommand
from daqsvc.errors.code import with_code
from daqsvc.errors.command_line import INTERRUPTED, LEFT_OUT, OUTPUT_CUT
from daqsvc.notice import NOTICE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daqsvc.box import Box
    from daqsvc.settings import MachineFile

COMMANDS = "daqsvc.commands"


class Command(Protocol):
    """A verb of the command line; others register theirs by entry point in ``daqsvc.commands``."""

    help: str
    """One line for the list of verbs."""
    description: str
    """What ``daqsvc VERB --help`` reports first."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the arguments; heavy imports belong into `run`."""
        ...

    def run(self, arguments: argparse.Namespace) -> int:
        """Do it; returns the exit code."""
        ...


class _SchemaAction(argparse.Action):
    """Prints a schema and ends, as ``--version`` does: no other argument is needed."""

    def __init__(self, option_strings: Sequence[str], dest: str, help: str) -> None:  # noqa: A002 - argparse
        super().__init__(option_strings, dest, nargs=0, default=argparse.SUPPRESS, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from daqsvc.settings.json_schema import machine_schema_text  # noqa: PLC0415 - it reads all plugins

        print(machine_schema_text(), end="", flush=True)  # noqa: T201 - this is what the option is for
        parser.exit()


class CheckCommand:
    """``daqsvc check FILE ...``."""

    help = "read a machine file and print what was understood, or all of its errors"
    description = (
        "Read a machine file and print what was understood. If it has errors, print all of them, each "
        "with file, line, key, value and remedy, and exit with 2. With several files, or a directory of "
        "them, also print whether one service can watch all of them."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `Command.add_arguments`."""
        parser.add_argument(
            "files",
            type=Path,
            nargs="+",
            metavar="FILE",
            help="machine file (TOML), the machine files of several machines on one box, or their directory",
        )
        parser.add_argument(
            "--schema",
            action=_SchemaAction,
            help="print the JSON Schema of machine files, for editors, and exit: "
            f"see {documented_in('machine-file')}",
        )

    def run(self, arguments: argparse.Namespace) -> int:
        """See `Command.run`."""
        box = load_box(arguments.files, load)
        if box is None:
            return EXIT_USAGE
        kernel_cache.prepare()
        codes = []
        for number, machine in enumerate(box.machines.values()):
            if number:
                print()  # noqa: T201 - this is what the verb is for
            codes.append(self._check(machine, box))
        return max(codes)

    def _check(self, machine: MachineFile, box: Box) -> int:
        from daqsvc.commands.store_argument import (  # noqa: PLC0415
            doubts_of_owner,
            store_doubts,
            store_in_words,
        )
        from daqsvc.detectors.make import check_files  # noqa: PLC0415
        from daqsvc.publish.make import check_outputs  # noqa: PLC0415
        from daqsvc.settings import describe  # noqa: PLC0415 - each verb imports only what it needs
        from daqsvc.settings.checks import failure  # noqa: PLC0415
        from daqsvc.settings.error_messages import dotted  # noqa: PLC0415
        from daqsvc.settings.hooks import collecting  # noqa: PLC0415

        check_files(machine)
        check_outputs(machine)
        doubts = [*store_doubts(machine), *doubts_of_owner(box)]
        with collecting() as failures:
            print(describe(machine, doubts, box.own, store_in_words(box)))  # noqa: T201 - this is what the verb is for
        for failed in failures:
            failed.file, failed.table = machine.path, dotted(failure(machine, failed).path)
            print(failed, file=sys.stderr)  # noqa: T201
        return EXIT_USAGE if failures else EXIT_OK


def load(path: Path) -> MachineFile | None:
    """The machine file at ``path``; None after its errors have been printed to stderr."""
    from daqsvc.settings import MachineFileError, load_machine_file  # noqa: PLC0415

    try:
        return load_machine_file(path)
    except MachineFileError as error:
        text = f"{error}" if not _is_journal() else _with_level(f"{error}", logging.ERROR)
        print(text, file=sys.stderr)  # noqa: T201 - errors of the command line go to stderr
        return None


def _with_level(text: str, level: int) -> str:
    priority = next(number for least, number in _PRIORITIES if level >= least)
    return "\n".join(f"<{priority}>{line}" for line in text.splitlines() if line)


class _OneLine(logging.Formatter):
    """A message on one line, whatever words of plugins and devices are in it; tracebacks have their own.

    It ends with the code of its kind, which the record has as a field (`coded`).
    """

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - of logging
        from daqsvc.settings.failures import one_line  # noqa: PLC0415 - each verb imports only what it needs

        record.message = with_code(one_line(record.message), getattr(record, "code", None))
        return super().formatMessage(record)


class _JournalFormatter(_OneLine):
    """Lines for systemd's journal: no time stamps, and the level in front, see sd-daemon(3)."""

    def format(self, record: logging.LogRecord) -> str:
        """See `logging.Formatter.format`."""
        return _with_level(super().format(record), record.levelno)


_PRIORITIES = (
    (logging.CRITICAL, 2),
    (logging.ERROR, 3),
    (logging.WARNING, 4),
    (NOTICE, 5),
    (logging.INFO, 6),
    (0, 7),
)
"""Priorities of syslog(3) from these levels on."""


def _is_journal() -> bool:
    """Whether stderr goes to systemd's journal; who inherits ``$JOURNAL_STREAM`` may write elsewhere."""
    try:
        stderr = os.fstat(2)
    except OSError:
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{stderr.st_dev}:{stderr.st_ino}"


def start_logging(*, verbose: bool, handler: logging.Handler | None = None) -> None:
    """Log to stderr, or to a handler; under systemd as its journal takes it."""
    handler = handler or logging.StreamHandler()
    text = "%(levelname)s %(message)s"
    if "JOURNAL_STREAM" not in os.environ:
        text = f"%(asctime)s {text}"
    handler.setFormatter(_JournalFormatter(text) if _is_journal() else _OneLine(text))
    logging.basicConfig(level=logging.INFO if verbose else NOTICE, handlers=[handler])
    logging.getLogger("can").setLevel(logging.ERROR)


def commands() -> dict[str, Command]:
    """Every verb there is, by name."""
    known: dict[str, Command] = {
        "run": RunCommand(load, start_logging),
        "check": CheckCommand(),
        "reload": ReloadCommand(load),
        "snapshot": SnapshotCommand(load),
        "replay": ReplayCommand(load, kernel_cache.prepare),
        "status": StatusCommand(load),
        "page": PageCommand(load, start_logging),
        "account": AccountCommand(),
        "trend": TrendCommand(load),
        "alarms": AlarmsCommand(load),
        **alarm_verbs(load),
        "analyze": AnalyzeCommand(load, kernel_cache.prepare),
        "fleet": FleetCommand(),
        "calibrate": CalibrateCommand(load, kernel_cache.prepare),
        "export": ExportCommand(load, kernel_cache.prepare),
        "detectability": DetectabilityCommand(load, kernel_cache.prepare),
        "example": ExampleCommand(),
        "sniff": SniffCommand(),
        "explain": ExplainCommand(),
        "new": NewCommand(),
        "record": RecordCommand(load, start_logging),
    }
    for point in entry_points(group=COMMANDS):
        try:
            known[point.name] = point.load()()
        except ImportError as error:
            # A broken extra must not keep the service from running.
            complain("daqsvc", f"verb {point.name!r} is left out: {error}", LEFT_OUT)
    return known


def parser(known: Mapping[str, Command]) -> argparse.ArgumentParser:
    """The command line with these verbs."""
    root = ArgumentParser(
        prog="daqsvc",
        description="Real-time data acquisition and model-based fault diagnosis for rotating machines.",
        epilog="daqsvc VERB --help explains one verb.",
    )
    root.add_argument("--version", action="version", version=f"daqsvc {daqsvc.__version__}")
    verbs = root.add_subparsers(dest="verb", metavar="VERB", required=True, title="verbs")
    for name, command in known.items():
        verb = verbs.add_parser(name, help=command.help, description=command.description)
        command.add_arguments(verb)
        verb.set_defaults(command=command)
    return root


def _meant(known: Mapping[str, Command], words: Sequence[str]) -> Mapping[str, Command]:
    """The verb that the words begin with; all verbs if they begin with another word.

    What the arguments of the others need would take most of the time of a short verb.
    """
    verb = words[0] if words else ""
    return {verb: known[verb]} if verb in known else known


_ONE_FILE = "one file of the service is enough, or the directory of them"


def _chosen(root: argparse.ArgumentParser, arguments: Sequence[str]) -> argparse.Namespace:
    """The arguments, those of a verb that takes files with options between them too.

    argparse takes the words of a verb in one piece, where a FILE that may be left out ends up empty before an
    option, and knows no better with verbs.
    """
    chosen, rest = root.parse_known_args(arguments)
    files = getattr(chosen, "files", None)
    verb_parser = ArgumentParser(prog=f"{root.prog} {chosen.verb}")  # errors name the verb
    if "" in rest and not any(one.startswith("-") for one in rest):
        verb_parser.error("argument FILE: must not be empty")
    if any(one.startswith("-") for one in rest):
        verb_parser.error(f"unrecognized arguments: {' '.join(rest)}")
    elif (alarms := getattr(chosen, "alarms", None)) is not None:
        _take_words(verb_parser, chosen, [*alarms, *rest])
    elif rest and files is not None:
        chosen.files = [*files, *(rest if isinstance(files[0], str) else map(Path, rest))]
    elif len(rest) == 1 and {"file", "store"} <= vars(chosen).keys() and chosen.file is None:
        if chosen.store is not None:
            verb_parser.error("argument FILE: not allowed with argument --store")
        chosen.file = Path(rest[0])
    elif rest and getattr(chosen, "file", None) is not None and "store" in chosen:
        verb_parser.error(f"unrecognized arguments: {' '.join(rest)}: {_ONE_FILE}")
    elif rest:
        verb_parser.error(f"unrecognized arguments: {' '.join(rest)}")
    return chosen


def _take_words(
    verb_parser: argparse.ArgumentParser, chosen: argparse.Namespace, words: Sequence[str]
) -> None:
    """Take the alarms of a verb, and FILE, which may be anywhere behind the first of them."""
    paths = [word for word in words[1:] if is_path(word)]
    if paths and chosen.store is not None:
        verb_parser.error("argument FILE: not allowed with argument --store")
    if len(paths) > 1:
        verb_parser.error(f"unrecognized arguments: {' '.join(paths[1:])}: {_ONE_FILE}")
    chosen.alarms = [word for word in words if word not in paths]
    chosen.file = Path(paths[0]) if paths else None


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the console script; returns the exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    early_signals.ignore_until_heard(words)
    if arguments is None:
        # Before it ends, the interpreter takes its handlers back, and a late SIGHUP would end the process.
        atexit.register(_ignore_from_here, words)
    try:
        early_signals.imported()
        chosen = _chosen(parser(_meant(commands(), words)), words)
        command: Command = chosen.command
        code = command.run(chosen)
        sys.stdout.flush()
    except BrokenPipeError:
        # Whoever read our output has had enough, as `head` does.
        _give_up_stdout()
        return EXIT_OK
    except KeyboardInterrupt:
        return complain("daqsvc", "interrupted", INTERRUPTED)
    except OSError as error:
        if error.errno not in {errno.ENOSPC, errno.EIO}:
            raise
        # A full disk, or a terminal that is gone; stderr may be the same one.
        _give_up_stdout()
        with contextlib.suppress(OSError):
            complain("daqsvc", f"{error.strerror}: the output is not complete", OUTPUT_CUT)
        return EXIT_FAILED
    except Exception as error:
        from daqsvc.settings.failures import one_line  # noqa: PLC0415 - with all that reads machine files
        from daqsvc.settings.problems import AssemblyError  # noqa: PLC0415

        if not isinstance(error, AssemblyError):
            raise
        print(one_line(f"{error}"), file=sys.stderr)  # noqa: T201
        return EXIT_USAGE
    return code


def _ignore_from_here(arguments: Sequence[str]) -> None:
    if arguments[:1] == ["run"]:
        for number in (signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2):
            signal.signal(number, signal.SIG_IGN)


def _give_up_stdout() -> None:
    """Let the interpreter's own flush at exit go nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
