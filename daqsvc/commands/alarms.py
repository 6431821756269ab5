"""``daqsvc alarms``: how the alarms stand and what has happened, from the journal."""

from __future__ import annotations

import json
import sys
import time
from typing import TYPE_CHECKING, Any

from daqsvc.commands.arguments import EXIT_FAILED, EXIT_OK, EXIT_USAGE, count
from daqsvc.commands.store_argument import BadFileError, StoreNotFoundError, add_store, chosen_store

if TYPE_CHECKING:
    import argparse
    from pathlib import Path

    from daqsvc.commands.store_argument import Load

HISTORY = 20
SLOW_DISK_S = 0.5
"""Events that ``--history`` shows if nobody says how many."""


class AlarmsCommand:
    """``daqsvc alarms [FILE | --store DIR]``.

    Args:
        load: reads a machine file; None after its errors have been printed.
    """

    help = "how the alarms stand, and what has happened, from the journal"
    description = (
        "Show the alarms that are not normal, as they stand in the journal, whether the service runs or not. "
        "An ID is what daqsvc ack, shelve, reset and the like take, as well as an alarm's name."
    )

    def __init__(self, load: Load) -> None:
        self._load = load

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        parser.add_argument("--all", action="store_true", help="those that are normal, too")
        parser.add_argument(
            "--history",
            type=count,
            nargs="?",
            const=HISTORY,
            metavar="N",
            help=f"the last N events instead, newest last (default: {HISTORY})",
        )
        parser.add_argument(
            "--json",
            action="store_true",
            help="one JSON object a line: the alarm messages as they go over MQTT",
        )
        add_store(parser)

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        from daqsvc.commands.alarm_journal import current, history  # noqa: PLC0415 - brings SQLite
        from daqsvc.outbox.messages import OutboxError  # noqa: PLC0415

        try:
            store = chosen_store(arguments, self._load)
            doubt = _doubt(store)
            try:
                if arguments.history is not None:
                    events = history(store, arguments.history)
                else:
                    events = current(store)
                    if not arguments.all:
                        events = [told for told in events if told["state"] != "normal"]
                _show(store, events, arguments)
            finally:
                if doubt:
                    # What goes wrong goes to stderr.
                    print(f"daqsvc alarms: {doubt}", file=sys.stderr)  # noqa: T201
        except BadFileError:
            return EXIT_USAGE
        except (StoreNotFoundError, OutboxError) as error:
            print(f"daqsvc alarms: {error}", file=sys.stderr)  # noqa: T201 - errors go to stderr
            return EXIT_FAILED
        return EXIT_OK


def _show(store: Path, events: list[dict[str, Any]], arguments: argparse.Namespace) -> None:
    from daqsvc.commands.alarm_journal import current_table, history_table, standing  # noqa: PLC0415

    if arguments.json:
        for told in events:
            print(json.dumps(told))  # noqa: T201 - this is what the verb is for
    elif arguments.history is not None:
        print(history_table(events) if events else "nothing has happened yet")  # noqa: T201
    elif events:
        print(current_table(standing(store, events), time.time_ns()))  # noqa: T201
    else:
        print("no alarm has ever been raised" if arguments.all else "every alarm is normal")  # noqa: T201


def _doubt(store: Path) -> str:
    """Why the journal may not be how things stand: what the disk cannot take, the service has in memory."""
    from daqsvc.control import ControlError, UnreachableError, events_waiting  # noqa: PLC0415
    from daqsvc.outbox.files import is_read_only, remedy  # noqa: PLC0415

    try:
        waiting = events_waiting(store)
        if waiting:
            time.sleep(SLOW_DISK_S)  # they are on their way to a slow disk, as a rule
            waiting = events_waiting(store)
    except UnreachableError as error:
        journal = "the journal cannot be written" if is_read_only(store) else "the journal may not be written"
        return f"{journal}, so this may not be how the alarms stand by now; {error}"
    except ControlError:
        return ""  # no service, or one that this user may not ask: the journal is all there is
    if not waiting:
        return ""
    events = "1 event waits" if waiting == 1 else f"{waiting} events wait"
    return (
        f"{events} in the service's memory for a disk that cannot be written: this is not how the alarms "
        f"stand by now; {remedy(store)}"
    )
