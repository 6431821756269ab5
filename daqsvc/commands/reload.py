"""``daqsvc reload``: have the service that runs read its machine files again."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

from daqsvc.commands.arguments import EXIT_OK, EXIT_USAGE
from daqsvc.commands.complaint import complain
from daqsvc.commands.store_argument import BadFileError, StoreNotFoundError, add_store, chosen_store
from daqsvc.errors.command_line import OTHER_FILES

if TYPE_CHECKING:
    import argparse

    from daqsvc.commands.machine_files import Load
    from daqsvc.control import ReloadAnswer


class Reloaded(TypedDict):
    """What came of it.

    Attributes:
        accepted: whether the machine files were taken over, or could be.
        dry_run: whether nothing was to be changed.
        code: code of the reason of a refusal; null if there is none.
        lines: what is different, or why it was refused, a sentence each.
    """

    accepted: bool
    dry_run: bool
    code: str | None
    lines: list[str]


class ReloadCommand:
    """``daqsvc reload [FILE | --store DIR]``.

    Args:
        load: reads a machine file; None after its errors have been printed.
    """

    help = "make the running service read its machine files again"
    description = (
        "Make the running service read its machine files again and take over what has changed. Buses, "
        "detectors and outputs that have not changed go on without a break, and alarms keep their "
        "state. If a file has errors, all files are refused, and the service goes on as before. SIGHUP "
        "and systemctl reload do the same. Exit code 2 if the files are refused, 1 if no service runs."
    )

    def __init__(self, load: Load) -> None:
        self._load = load

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        parser.add_argument(
            "--dry-run", action="store_true", help="change nothing, only print what would change"
        )
        parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")
        add_store(parser, of_a_machine=False)

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        from daqsvc.control import ControlError, NotRunningError, ask_reload  # noqa: PLC0415 - only what a verb needs

        try:
            store = chosen_store(arguments, self._load, all_sound=True).directory
            answer = ask_reload(store, dry_run=arguments.dry_run)
        except BadFileError:
            return EXIT_USAGE
        except (StoreNotFoundError, ControlError) as error:
            where = ""
            if arguments.file is not None and isinstance(error, NotRunningError):
                moved = f"site, box or [store] of {arguments.file}"
                where = f"; if {moved} were changed, the service must be restarted"
            return complain("daqsvc reload", f"{error}{where}", error.code)
        if arguments.json:
            report: Reloaded = {
                "accepted": answer.accepted,
                "dry_run": arguments.dry_run,
                "code": answer.code,
                "lines": list(answer.lines),
            }
            print(json.dumps(report))  # noqa: T201 - this is what the verb is for
        elif answer.accepted:
            print("\n".join(answer.lines) or "nothing is different")  # noqa: T201 - as above
        else:
            for line in answer.lines:
                print(line, file=sys.stderr)  # noqa: T201 - errors go to stderr
        if arguments.file is not None and (hint := other_files(arguments.file, answer)):
            complain("daqsvc reload", hint, OTHER_FILES)
        return EXIT_OK if answer.accepted else EXIT_USAGE


def other_files(named: Path, answer: ReloadAnswer) -> str:
    """What to know where the service reads other files than the one that was named, or more."""
    files = [Path(file) for file in answer.files]
    mine = named.absolute()
    if not files or mine in files or (answer.lines and mine.parent in files):
        return ""
    started = " ".join(answer.files)
    return f"the service was started with {started}: it reads that again, also if another one is named here"
