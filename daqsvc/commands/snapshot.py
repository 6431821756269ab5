"""``daqsvc snapshot``: have the service that runs write down what its machine does now."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, TypedDict

from daqsvc.commands.arguments import EXIT_FAILED, EXIT_OK, EXIT_USAGE
from daqsvc.commands.complaint import complain
from daqsvc.commands.store_argument import (
    BadFileError,
    OtherFileError,
    StoreNotFoundError,
    add_store,
    chosen_store,
)
from daqsvc.errors.command_line import COMMAND_REFUSED

if TYPE_CHECKING:
    import argparse

    from daqsvc.commands.machine_files import Load


class SnapshotTaken(TypedDict):
    """What came of it.

    Attributes:
        accepted: whether a snapshot was made.
        reason: why not; empty if one was.
        code: code of that reason; null if there is none.
        path: file of the snapshot; empty if none was made.
    """

    accepted: bool
    reason: str
    code: str | None
    path: str


class SnapshotCommand:
    """``daqsvc snapshot [FILE | --store DIR]``.

    Args:
        load: reads a machine file; None after its errors have been printed.
    """

    help = "make the running service write a snapshot of a machine: samples, statements, alarms"
    description = (
        "Make the running service write a snapshot: the samples of all channels of a machine, with the "
        "statements of its detectors and its alarms. It begins before_s before now and ends after_s after "
        "it. Wait until the file is complete and print its path. The machine file needs a table "
        "[recorder]. Exit code 1 if no snapshot was written."
    )

    def __init__(self, load: Load) -> None:
        self._load = load

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")
        add_store(parser)

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        from daqsvc.control import ControlError, ask_snapshot  # noqa: PLC0415 - only what a verb needs

        try:
            store = chosen_store(arguments, self._load)
            store.refuse_other()
            answer = ask_snapshot(store.directory, store.machine)
        except BadFileError:
            return EXIT_USAGE
        except (OtherFileError, StoreNotFoundError, ControlError) as error:
            return complain("daqsvc snapshot", error, error.code)
        if arguments.json:
            report: SnapshotTaken = {
                "accepted": answer.accepted,
                "reason": answer.reason,
                "code": answer.code,
                "path": answer.path,
            }
            print(json.dumps(report))  # noqa: T201 - this is what the verb is for
        elif answer.accepted:
            print(answer.path)  # noqa: T201 - as above
        else:
            complain("daqsvc snapshot", answer.reason, answer.code or COMMAND_REFUSED)
        return EXIT_OK if answer.accepted else EXIT_FAILED
