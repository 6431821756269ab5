"""``daqsvc replay``: judge a snapshot again, by the detectors and alarms of the service."""

from __future__ import annotations

import asyncio
import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypedDict

from daqsvc.commands.arguments import EXIT_FAILED, EXIT_OK, EXIT_REFUSED, EXIT_USAGE, positive
from daqsvc.commands.complaint import complain
from daqsvc.commands.tables import harmless
from daqsvc.commands.with_kernels import VerbWithKernels

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterator

    from daqsvc.alarms.events import AlarmEvent
    from daqsvc.offline.replay import Replayed

_SHOWN = 5
"""Differences that are shown one by one."""


class ReplayCommand(VerbWithKernels):
    """``daqsvc replay SNAPSHOT [MACHINE]``."""

    help = "run detectors and alarms again over the samples of a snapshot"
    description = (
        "Play the samples of a snapshot into the rings, detectors and alarms of the service, as fast as "
        "possible or at a stated speed. Print the alarms that follow. Compare them, and every statement "
        "of the detectors, bit by bit with those of the service. With MACHINE, use that machine file "
        "instead of the one in the snapshot. Exit code: 0 if it was replayed; with --check 1 if "
        "anything differs or nothing could be compared; 2 for wrong usage; 3 if it cannot be read or "
        "replayed."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        parser.add_argument("snapshot", type=Path, metavar="SNAPSHOT", help="snapshot file (.mcap)")
        parser.add_argument(
            "machine",
            type=Path,
            nargs="?",
            metavar="MACHINE",
            help="machine file (TOML) to use instead of the one in the snapshot",
        )
        parser.add_argument(
            "--speed",
            type=positive,
            metavar="X",
            help="X times as fast as real time, e.g. 1 (default: as fast as possible)",
        )
        parser.add_argument("--check", action="store_true", help="exit with 1 if anything differs")
        parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        from daqsvc.confined.limits import ResourceLimits  # noqa: PLC0415 - each verb imports what it needs
        from daqsvc.offline.replay import Pace, ReplayError, replay  # noqa: PLC0415
        from daqsvc.snapshots.reading import SnapshotError, read_snapshot  # noqa: PLC0415

        machine = None
        if arguments.machine is not None and (machine := self._load(arguments.machine)) is None:
            return EXIT_USAGE
        self._prepare_kernel_cache()
        try:
            snapshot = read_snapshot(arguments.snapshot, ResourceLimits())
            pace = None if arguments.speed is None else Pace(arguments.speed)
            heard = _nothing if arguments.json else _print_alarm
            with tempfile.TemporaryDirectory(prefix="daqsvc-replay-") as directory:
                replayed = asyncio.run(replay(snapshot, machine, Path(directory), pace, heard))
        except SnapshotError as error:
            return complain("daqsvc replay", harmless(f"{error}"), error.code, EXIT_REFUSED)
        except ReplayError as error:
            what = harmless(f"{arguments.snapshot} {error}")
            return complain("daqsvc replay", what, error.code, EXIT_REFUSED)
        # A snapshot may be anybody's: what is in it is shown and not carried out.
        lines = [json.dumps(_document(replayed))] if arguments.json else map(harmless, _lines(replayed))
        print("\n".join(lines))  # noqa: T201 - this is what the verb is for
        return EXIT_FAILED if arguments.check and not replayed.is_equal else EXIT_OK


def _nothing(_event: AlarmEvent) -> None:
    """All is in the one object at the end."""


def _print_alarm(event: AlarmEvent) -> None:
    from daqsvc.acquisition.clock import iso_utc  # noqa: PLC0415 - only what a verb needs

    line = f"{iso_utc(event.wall_ns)} {event.alarm} {event.kind.value}: {event.message}"
    print(harmless(line), flush=True)  # noqa: T201 - this is what the verb is for


def _lines(replayed: Replayed) -> Iterator[str]:
    if replayed.causes:
        more = len(replayed.causes) - _SHOWN
        shown = "; ".join(replayed.causes[:_SHOWN])
        yield f"made for: {shown}" + (f"; {more} more (--json has all)" if more > 0 else "")
    yield from replayed.notes
    for detector, why in replayed.anew.items():
        yield f"{detector} is judged again: {why}"
    if not replayed.alarms:
        yield "no alarm changes"
    for words, comparison in (("statements", replayed.said), ("alarm events", replayed.alarmed)):
        then = comparison.equal + len(comparison.changed)
        yield f"{comparison.equal} of {then} {words} are as they were, to the last bit"
        for document in comparison.changed[:_SHOWN]:
            yield f"  only then: {_in_short(document)}"
        for document in comparison.added[:_SHOWN]:
            yield f"  only now: {_in_short(document)}"
        if comparison.later:
            yield f"  {comparison.later} more are of samples at the end, of which the file has none"
    if not replayed.is_compared:
        yield "nothing was compared: the snapshot has no statement or alarm event of what was judged again"


def _in_short(document: dict[str, Any]) -> str:
    return ", ".join(
        f"{key} {document[key]}"
        for key in ("alarm", "kind", "level", "detector", "decision", "monotonic_ns", "quality")
        if key in document
    )


class ComparedStatements(TypedDict):
    """The statements then and now.

    Attributes:
        equal: how many are the same to the last bit.
        only_then: those of the snapshot that do not come now.
        only_now: those that come now and are not in the snapshot.
    """

    equal: int
    only_then: list[Annotated[dict[str, Any], "statement"]]
    only_now: list[Annotated[dict[str, Any], "statement"]]


class ComparedAlarms(TypedDict):
    """The alarm events then and now.

    Attributes:
        equal: how many are the same to the last bit.
        only_then: those of the snapshot that do not come now.
        only_now: those that come now and are not in the snapshot.
    """

    equal: int
    only_then: list[Annotated[dict[str, Any], "daqsvc.alarm/1"]]
    only_now: list[Annotated[dict[str, Any], "daqsvc.alarm/1"]]


class Compared(TypedDict):
    """What was compared.

    Attributes:
        statements: of the detectors.
        alarms: events of the alarms.
    """

    statements: ComparedStatements
    alarms: ComparedAlarms


class ReplayReport(TypedDict):
    """What came of the replay.

    Attributes:
        causes: why the snapshot was made, in words.
        is_equal: whether what is stated now is what was stated then; false if nothing was compared.
        is_compared: whether there was anything to compare.
        anew: detectors that began from nothing, and why.
        notes: what a person should know of the snapshot, in sentences.
        alarms: events of the alarms, in order.
        statements: of the detectors, in order.
        compared: the same, compared with the snapshot.
    """

    causes: list[str]
    is_equal: bool
    is_compared: bool
    anew: dict[str, str]
    notes: list[str]
    alarms: list[Annotated[dict[str, Any], "daqsvc.alarm/1"]]
    statements: list[Annotated[dict[str, Any], "statement"]]
    compared: Compared


def _document(replayed: Replayed) -> ReplayReport:
    from pydantic_core import to_json  # noqa: PLC0415 - as above

    from daqsvc.publish.payloads import alarm_document, statement_document  # noqa: PLC0415 - only what is needed

    statements, alarms = replayed.said, replayed.alarmed
    report: ReplayReport = {
        "causes": replayed.causes,
        "is_equal": replayed.is_equal,
        "is_compared": replayed.is_compared,
        "anew": replayed.anew,
        "notes": replayed.notes,
        "alarms": [alarm_document(event) for event in replayed.alarms],
        "statements": [statement_document(one) for one in replayed.statements],
        "compared": {
            "statements": {
                "equal": statements.equal,
                "only_then": statements.changed,
                "only_now": statements.added,
            },
            "alarms": {"equal": alarms.equal, "only_then": alarms.changed, "only_now": alarms.added},
        },
    }
    finite: ReplayReport = json.loads(to_json(report, inf_nan_mode="null"))
    return finite
