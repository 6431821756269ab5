"""``daqsvc fleet report RESULTS``: what the recordings of a fleet show, of each machine and of all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.commands.analyze_fleet import lacking_extra
from daqsvc.commands.arguments import EXIT_OK, EXIT_USAGE, duration, not_negative
from daqsvc.commands.complaint import complain
from daqsvc.commands.tables import aligned, harmless, wrapped
from daqsvc.documentation import documented_in
from daqsvc.errors.command_line import EXTRA_MISSING

if TYPE_CHECKING:
    import argparse

    from daqsvc.fleet.report import FleetReport, MachineReport

WIDTH = 100
_MOST_SHOWN = 20
"""Lines of a kind; --json has all."""
_LONGEST_NAME = 24
_SHORTER_NAME = 14
"""Of a machine, where there are eight columns."""
_LONGEST_FILE = 36
_MOST_NAMES = 5


class FleetCommand:
    """``daqsvc fleet report RESULTS``."""

    help = "report on the archive of a fleet: changes, missed faults, false alarms and their cost"
    description = (
        "Report on the results that daqsvc analyze ARCHIVE --cluster has written: for each machine, "
        "where its verdict changed. With a CSV table of known faults, also report which faults were "
        f"missed, which alarms were false, and what those cost. See {documented_in('fleet')}."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        parser.add_argument("what", choices=("report",), metavar="report", help="the word report")
        parser.add_argument("results", metavar="RESULTS", help="folder or URL of the results")
        parser.add_argument(
            "--truth",
            type=Path,
            metavar="FILE",
            help="CSV table of known faults: machine, fault, first and last (recordings or times)",
        )
        parser.add_argument(
            "--false-alarm-cost",
            type=not_negative,
            metavar="N",
            help="cost of one false alarm, in any currency",
        )
        parser.add_argument(
            "--interval",
            type=duration,
            metavar="TIME",
            help="time that each recording represents, e.g. 1d (default: by the dates in their names)",
        )
        parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        if wrong := lacking_extra():
            return complain("daqsvc fleet", wrong, EXTRA_MISSING, EXIT_USAGE)
        from daqsvc.fleet import FleetError  # noqa: PLC0415 - each verb imports what it needs
        from daqsvc.fleet.report import TruthError, fleet_report, read_truth  # noqa: PLC0415
        from daqsvc.fleet.results import Results  # noqa: PLC0415

        try:
            truth = None if arguments.truth is None else read_truth(arguments.truth)
            report = fleet_report(
                Results(arguments.results),
                truth,
                cost=arguments.false_alarm_cost,
                interval_s=arguments.interval,
            )
        except TruthError as error:
            return complain("daqsvc fleet", error, error.code, EXIT_USAGE)
        except FleetError as error:
            return complain("daqsvc fleet", error, error.code)
        print(json.dumps(report.as_json()) if arguments.json else report_text(report))  # noqa: T201
        return EXIT_OK


def report_text(report: FleetReport) -> str:
    """The report for a terminal of 100 columns."""
    parts = [_machines(report), _changes(report)]
    if report.has_truth:
        parts += [_missed(report), _false_alarms(report)]
    parts += [_not_judged(report), _fleet(report)]
    return "\n\n".join(part for part in parts if part)


def _machines(report: FleetReport) -> str:
    titles = ["machine", "judged", "now", "alarms"]
    if report.has_truth:
        titles += ["faults", "missed", "false"]
    has_cost = report.false_alarm_cost is not None
    if has_cost:
        titles.append("cost")
    # A machine of which there is something to report first, so that a fleet of thousands fits.
    machines = sorted(report.machines, key=lambda one: not _is_remarkable(one))
    rows = []
    for one in machines[:_MOST_SHOWN]:
        row = [
            _short(one.machine, _SHORTER_NAME if has_cost else _LONGEST_NAME),
            f"{one.judged} of {one.recordings}",
            _short(one.now or "-"),
            f"{len(one.alarms)}",
        ]
        if report.has_truth:
            row += [f"{len(one.seen)}", f"{len(one.missed)}", f"{len(one.false_alarms)}"]
        if has_cost:
            row.append(_money(one.cost))
        rows.append(row)
    return aligned(titles, rows) + _more(len(machines), "machines")


def _is_remarkable(one: MachineReport) -> bool:
    return bool(one.alarms or one.missed or one.judged < one.recordings)


def _changes(report: FleetReport) -> str:
    """Where a verdict is not that of the machine's recording before; the first has none before it."""
    rows = [
        [
            _short(one.machine),
            _short(change.file, _LONGEST_FILE),
            f"{change.before} -> {change.now}",
        ]
        for one in report.machines
        for change in one.changes
        if change.before is not None
    ]
    if not rows:
        return "No verdict changed."
    return aligned(["changed", "at", "verdict"], rows[:_MOST_SHOWN], WIDTH) + _more(len(rows), "changes")


def _missed(report: FleetReport) -> str:
    from daqsvc.rounding import counted  # noqa: PLC0415 - each verb imports what it needs

    rows = [
        [
            _short(one.machine),
            _short(seen.fault.fault),
            f"{seen.fault.first or 'first'} to {seen.fault.last or 'last'}, "
            + counted(seen.recordings, "recording"),
        ]
        for one in report.machines
        for seen in one.missed
    ]
    if not rows:
        return "No known fault was missed."
    return aligned(["missed", "fault", "from"], rows[:_MOST_SHOWN], WIDTH) + _more(len(rows), "faults")


def _false_alarms(report: FleetReport) -> str:
    rows = [
        [_short(one.machine), _short(file, 2 * _LONGEST_FILE)]
        for one in report.machines
        for file in one.false_alarms
    ]
    if not rows:
        return "No false alarm."
    return aligned(["false alarm", "from"], rows[:_MOST_SHOWN], WIDTH) + _more(len(rows), "false alarms")


def _not_judged(report: FleetReport) -> str:
    rows = [
        # A long path in a reason must not make the line longer than the terminal.
        [
            _short(one.machine),
            f"{number}",
            " ".join(_short(word, 2 * _LONGEST_NAME) for word in reason.split()),
        ]
        for one in report.machines
        for reason, number in one.reasons.most_common()
    ]
    if not rows:
        return ""
    return aligned(["not judged", "times", "reason"], rows[:_MOST_SHOWN], WIDTH) + _more(len(rows), "reasons")


def _fleet(report: FleetReport) -> str:
    from daqsvc.rounding import counted  # noqa: PLC0415 - each verb imports what it needs

    fleet = report.as_json()["fleet"]
    years = "times not known" if report.years is None else f"{report.years:,.3g} machine-years"
    judged = f"{fleet['judged']:,} of {counted(fleet['recordings'], 'recording')} judged"
    machines, alarms = counted(fleet["machines"], "machine"), counted(fleet["alarms"], "alarm")
    lines = [f"Fleet: {machines}, {judged}, {years}, {alarms}"]
    if report.has_truth:
        lines.append(
            f"{counted(fleet['known_faults'] or 0, 'known fault')}, {fleet['missed']:,} missed, "
            f"{fleet['without_recordings']:,} without a recording that was judged"
        )
        lines.append(_cost(report))
    elif report.cost is not None:
        lines.append("What false alarms cost is not known: --truth has the alarms that are false")
    if report.years is not None and report.without_times:
        several = len(report.without_times) > 1
        lines.append(
            f"The time{'s' * several} of {_names(report.without_times)} {'are' if several else 'is'} not "
            "known: judged recordings with dates in their names, or --interval, would tell"
        )
    if report.unknown:
        lines.append(f"Of known faults there are no results of: {_names(report.unknown)}")
    return "\n".join(line for text in lines for line in wrapped(harmless(text), WIDTH))


def _cost(report: FleetReport) -> str:
    """How many false alarms there were and what they cost, first what is certain and then a year of it."""
    from daqsvc.rounding import counted  # noqa: PLC0415 - each verb imports what it needs

    sentence = counted(report.false_alarms, "false alarm")
    if report.false_alarm_cost is not None:
        sentence += f" cost{'s' * (report.false_alarms == 1)} {_money(report.false_alarm_cost)}"
    rate = report.false_alarms_per_year
    if rate is None:
        return (
            f"{sentence}; how many that is a year is not known: dates in the names, or --interval, would tell"
        )
    where = "of the machines whose times are known " if report.without_times else ""
    cost = "" if report.cost_per_year is None else f", or {report.cost_per_year:,.0f},"
    return f"{sentence}; {where}that is {rate:,.3g}{cost} a machine and year"


def _money(cost: float | None) -> str:
    return "-" if cost is None else f"{cost:,.10g}"


def _names(machines: list[str]) -> str:
    """Some of the names, and how many more there are."""
    shown = ", ".join(map(_short, machines[:_MOST_NAMES]))
    return shown + (f" and {len(machines) - _MOST_NAMES:,} more" if len(machines) > _MOST_NAMES else "")


def _more(number: int, what: str) -> str:
    return f"\n... of {number:,} {what}; --json has all" if number > _MOST_SHOWN else ""


def _short(text: str, longest: int = _LONGEST_NAME) -> str:
    """A text that leaves room for others; the end of a long name tells more than its beginning."""
    return text if len(text) <= longest else f"...{text[3 - longest :]}"
