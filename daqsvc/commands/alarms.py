"""The verbs about alarms.

``daqsvc alarms`` states from the journal their states and what has happened. What people do with them goes to
the service that runs: ``ack``, ``reset``, ``shelve``, ``bypass``, and their undoing.
"""

from __future__ import annotations

import contextlib
import json
import os
import pwd
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

from daqsvc.commands.arguments import EXIT_FAILED, EXIT_OK, EXIT_USAGE, alarm_id, count, duration, one_line
from daqsvc.commands.complaint import complain
from daqsvc.commands.store_argument import (
    BadFileError,
    OtherFileError,
    StoreNotFoundError,
    add_store,
    chosen_store,
)
from daqsvc.errors.code import with_code
from daqsvc.errors.command_line import COMMAND_REFUSED, NO_SUCH_MACHINE
from daqsvc.errors.service import JOURNAL_BEHIND

if TYPE_CHECKING:
    import argparse

    from daqsvc.commands.alarm_targets import Target
    from daqsvc.commands.machine_files import Load
    from daqsvc.commands.store_argument import ChosenStore
    from daqsvc.errors.code import Code

HISTORY = 20
"""Events that ``--history`` shows by default."""
SLOW_DISK_S = 0.5


class AlarmsCommand:
    """``daqsvc alarms [FILE | --store DIR]``.

    Args:
        load: reads a machine file; None after its errors have been printed.
    """

    help = "show the alarms and their events, from the journal"
    description = (
        "Show the alarms that are not normal, from the journal, with and without a running service. The "
        "ID shown here, or the name of the alarm, is what daqsvc ack, reset, shelve, unshelve, bypass "
        "and unbypass take."
    )

    def __init__(self, load: Load) -> None:
        self._load = load

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        parser.add_argument(
            "--all", action="store_true", help="also show alarms that are normal, if they were ever raised"
        )
        parser.add_argument(
            "--history",
            type=count,
            nargs="?",
            const=HISTORY,
            metavar="N",
            help=f"show the last N events instead, the newest last (default: {HISTORY})",
        )
        parser.add_argument(
            "--json",
            action="store_true",
            help="print one JSON object per line: the alarm messages as they are sent over MQTT",
        )
        add_store(parser)

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        from daqsvc.commands.alarm_journal import current, history  # noqa: PLC0415 - brings SQLite
        from daqsvc.outbox.messages import OutboxError  # noqa: PLC0415

        try:
            chosen = chosen_store(arguments, self._load)
            store = chosen.directory
            doubt = _doubt(store)
            try:
                _refuse_unknown(chosen)
                if arguments.history is not None:
                    events = history(store, arguments.history, chosen.machine)
                else:
                    events = current(store)
                    if chosen.machine is not None:
                        events = [event for event in events if event["machine"] == chosen.machine]
                    if not arguments.all:
                        events = [event for event in events if event["state"] != "normal"]
                chosen.tell_other("daqsvc alarms")
                _show(store, events, arguments)
            finally:
                if doubt:
                    _complain("alarms", doubt, JOURNAL_BEHIND)
        except BadFileError:
            return EXIT_USAGE
        except (StoreNotFoundError, NoSuchMachineError, OutboxError) as error:
            return _complain("alarms", error, error.code)
        return EXIT_OK


def _complain(verb: str, what: object, code: Code | str) -> int:
    """Say what goes wrong, to stderr. Names of a journal or a service could hold anything."""
    from daqsvc.commands.tables import harmless  # noqa: PLC0415 - only what a verb needs

    return complain(f"daqsvc {verb}", harmless(f"{what}"), code)


class NoSuchMachineError(Exception):
    """The machine that was named is not among those of the store; the text states which are."""

    code = NO_SUCH_MACHINE


def _refuse_unknown(chosen: ChosenStore) -> None:
    """Make sure that a machine is one of the store: by its files, its journal, or the service that runs.

    Raises:
        NoSuchMachineError: it is not.
        OutboxError: there is no journal, or it cannot be read.
    """
    from daqsvc.commands.alarm_journal import machines_of  # noqa: PLC0415 - brings SQLite
    from daqsvc.control import ControlError, ask_status  # noqa: PLC0415 - only what a verb needs

    if chosen.machine in {None, *chosen.machines}:
        return
    known = machines_of(chosen.directory).union(chosen.machines)
    if chosen.machine in known:
        return
    with contextlib.suppress(ControlError):
        known |= {f"{status['machine']}" for status in ask_status(chosen.directory)}
    if chosen.machine not in known:
        those = ", ".join(sorted(known)) or "no machine yet"
        raise NoSuchMachineError(
            f"the store {chosen.directory} has alarms of {those}, not of {chosen.machine}"
        )


def _show(store: Path, events: list[dict[str, Any]], arguments: argparse.Namespace) -> None:
    from daqsvc.commands.alarm_journal import current_table, history_table, standing  # noqa: PLC0415

    if arguments.json:
        for event in events:
            print(json.dumps(event))  # noqa: T201 - this is what the verb is for
    elif arguments.history is not None:
        print(history_table(events) if events else "nothing has happened yet")  # noqa: T201
    elif events:
        print(current_table(standing(store, events), time.time_ns()))  # noqa: T201
    else:
        print("no alarm has ever been raised" if arguments.all else "every alarm is normal")  # noqa: T201


def _doubt(store: Path) -> str:
    """Why the journal may not be the present state: what the disk cannot take, the service has in memory."""
    from daqsvc.control import ControlError, UnreachableError, events_waiting  # noqa: PLC0415
    from daqsvc.outbox.files import is_read_only, remedy  # noqa: PLC0415

    try:
        waiting = events_waiting(store)
        if waiting:
            time.sleep(SLOW_DISK_S)  # they are on their way to a slow disk, as a rule
            waiting = events_waiting(store)
    except UnreachableError as error:
        journal = "the journal cannot be written" if is_read_only(store) else "the journal may not be written"
        return f"{journal}, so this may not be their present state; {error}"
    except ControlError:
        return ""  # no service, or one that this user may not ask: the journal is all there is
    if not waiting:
        return ""
    events = "1 event waits" if waiting == 1 else f"{waiting} events wait"
    return (
        f"{events} in the service's memory for a disk that cannot be written: this "
        f"is not their present state; {remedy(store)}"
    )


class AlarmVerbAnswer(TypedDict):
    """What came of it, for one alarm.

    Attributes:
        verb: what was asked: `acknowledge`, `reset`, `shelve`, `unshelve`, `bypass`, `unbypass`.
        alarm: name of the alarm.
        machine: name of the machine; null if no machine was named, and there is only one with the alarm.
        occurrence: id of the activation that was meant; null for whichever there is.
        by: who has asked.
        accepted: whether it was carried out.
        reason: why it was refused, or why a restart may undo it; empty if neither.
        code: code of that reason; null if there is none.
        events: ids of the alarm events that followed.
    """

    verb: str
    alarm: str
    machine: str | None
    occurrence: str | None
    by: str
    accepted: bool
    reason: str
    code: str | None
    events: list[str]


class AlarmVerb:
    """One verb for one alarm or several, carried out by the service that runs.

    Args:
        verb: the `daqsvc.alarms.commands.Verb` by its value.
        help_line: one line for the list of verbs.
        description: what ``--help`` reports first.
        load: reads a machine file; None after its errors have been printed.
    """

    def __init__(self, verb: str, help_line: str, description: str, load: Load) -> None:
        self.help = help_line
        self.description = (
            f"{description} The running service does this and writes it to its audit log. Exit code: 0 if "
            "that is on disk for every alarm, 1 if it is refused for any, or no service runs."
        )
        self._verb = verb
        self._load = load

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        parser.add_argument(
            "alarms",
            type=alarm_id,
            nargs="+",
            metavar="ID",
            help="name of the alarm, the first four or more characters of its ID in daqsvc alarms, or a "
            "pattern such as 'fan.*' of alarms that are not normal",
        )
        if self._verb == "shelve":
            parser.add_argument(
                "--for",
                dest="duration_s",
                type=duration,
                required=True,
                metavar="TIME",
                help="for how long, e.g. 90s, 30m, 8h, 2d or 1h30m",
            )
        parser.add_argument(
            "--by",
            type=one_line,
            metavar="NAME",
            help="name of the person who does this (default: the user who is logged in)",
        )
        parser.add_argument(
            "--reason",
            type=one_line,
            default="",
            metavar="TEXT",
            help="the reason, for the audit log and the alarm's event",
        )
        parser.add_argument(
            "--json", action="store_true", help="print one JSON object per alarm instead of text"
        )
        add_store(parser)

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        from daqsvc.alarms.commands import Verb  # noqa: PLC0415 - each verb imports only what it needs
        from daqsvc.commands.alarm_targets import NoSuchAlarmError, meant  # noqa: PLC0415
        from daqsvc.control import ControlError  # noqa: PLC0415
        from daqsvc.outbox.messages import OutboxError  # noqa: PLC0415

        name = arguments.verb
        _take_file(arguments)
        try:
            chosen = chosen_store(arguments, self._load)
            chosen.refuse_other()
            store = chosen.directory
            _refuse_none(arguments, chosen)
            targets = meant(store, arguments.alarms, Verb(self._verb), chosen.machine)
        except BadFileError:
            return EXIT_USAGE
        except (OtherFileError, StoreNotFoundError, NoSuchAlarmError, OutboxError) as error:
            return _complain(name, error, error.code)
        several = len({one.machine for one in targets if one.machine}) > 1
        code = EXIT_OK
        for n, target in enumerate(targets):
            try:
                code = max(code, self._ask(store, target, arguments, several=several))
            except ControlError as error:
                left = ", ".join(one.alarm for one in targets[n + 1 :])
                return _complain(name, f"{error}; not asked for then: {left}" if left else error, error.code)
        return code

    def _ask(self, store: Path, target: Target, arguments: argparse.Namespace, *, several: bool) -> int:
        """Have the service do it to one alarm, and print what came of it; the exit code.

        Raises:
            ControlError: the service cannot be asked.
        """
        from daqsvc.alarms.commands import AlarmCommand, Verb  # noqa: PLC0415 - as above
        from daqsvc.commands.tables import harmless  # noqa: PLC0415
        from daqsvc.control import ask, request_of  # noqa: PLC0415

        alarm, occurrence, machine = target
        request = request_of(
            AlarmCommand(
                verb=Verb(self._verb),
                alarm=alarm,
                by=arguments.by or user_name(),
                occurrence=occurrence,
                duration_s=getattr(arguments, "duration_s", None),
                reason=arguments.reason,
            ),
            machine,
        )
        outcome = ask(store, request)
        if arguments.json:
            answer: AlarmVerbAnswer = {
                "verb": self._verb,
                "alarm": alarm,
                "machine": machine,
                "occurrence": occurrence,
                "by": request.by,
                "accepted": outcome.accepted,
                "reason": outcome.reason,
                "code": outcome.code,
                "events": list(outcome.events),
            }
            print(json.dumps(answer), flush=True)  # noqa: T201 - this is what the verb is for
        elif outcome.accepted:
            which = f"{alarm} of {machine}" if several and machine else alarm
            line = harmless(f"{which}: {outcome.reason or _DONE[self._verb]}")
            print(with_code(line, outcome.code), flush=True)  # noqa: T201
        else:
            of = f" {machine}:" if several and machine else ""
            _complain(arguments.verb, f"refused:{of} {outcome.reason}", outcome.code or COMMAND_REFUSED)
        # Accepted with a reason: the disk has not got it yet.
        return EXIT_OK if outcome.accepted and not outcome.reason else EXIT_FAILED


def _take_file(arguments: argparse.Namespace) -> None:
    """Take a machine file for FILE wherever it was written: many write it in front of the alarm."""
    if arguments.file is None and arguments.store is None:
        files = [word for word in arguments.alarms if word.endswith(".toml")]
        if len(files) == 1:
            arguments.alarms.remove(files[0])
            arguments.file = Path(files[0])


def _refuse_none(arguments: argparse.Namespace, chosen: ChosenStore) -> None:
    """Refuse a machine file that was named alone, with the alarms that there are.

    Raises:
        NoSuchAlarmError: no alarm was named.
        OutboxError: there is no journal, or it cannot be read.
    """
    from daqsvc.commands.alarm_journal import current  # noqa: PLC0415 - each verb imports only what it needs
    from daqsvc.commands.alarm_targets import MOST_NAMED, NoSuchAlarmError  # noqa: PLC0415

    if arguments.alarms:
        return
    events = current(chosen.directory)
    names = sorted({one["alarm"] for one in events if chosen.machine in {None, one["machine"]}})
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    raised = f"raised so far: {', '.join(names[:MOST_NAMED])}{more}" if names else "none was raised so far"
    file = arguments.file
    raise NoSuchAlarmError(
        f"{file} is the machine file, and no alarm is named: write daqsvc {arguments.verb} ALARM {file}; "
        f"{raised}"
    )


def alarm_verbs(load: Load) -> dict[str, AlarmVerb]:
    """The verbs by the name that they have on the command line."""
    return {
        name: AlarmVerb(verb, help_line, description, load)
        for name, verb, help_line, description in (
            (
                "ack",
                "acknowledge",
                "acknowledge alarms: somebody has seen them",
                "Acknowledge alarms: somebody has seen them.",
            ),
            (
                "reset",
                "reset",
                "reset latched alarms whose condition is no longer present",
                "Reset latched alarms to normal. It is refused while the condition is still present.",
            ),
            (
                "shelve",
                "shelve",
                "suppress alarms for a stated time",
                "Suppress alarms for a stated time. After that they show their present states again.",
            ),
            (
                "unshelve",
                "unshelve",
                "end the shelving of alarms at once",
                "End the shelving of alarms at once.",
            ),
            (
                "bypass",
                "bypass",
                "take alarms out of service until daqsvc unbypass",
                "Take alarms out of service until they are put back with daqsvc unbypass.",
            ),
            (
                "unbypass",
                "unbypass",
                "put alarms back into service",
                "Put alarms back into service.",
            ),
        )
    }


def user_name() -> str:
    """Who is logged in: behind sudo, the person rather than root."""
    if os.geteuid() == 0 and (person := os.environ.get("SUDO_USER")):
        return person
    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        return f"uid {os.getuid()}"


_DONE = {
    "acknowledge": "acknowledged",
    "reset": "reset",
    "shelve": "shelved",
    "unshelve": "no longer shelved",
    "bypass": "out of service",
    "unbypass": "back in service",
}
