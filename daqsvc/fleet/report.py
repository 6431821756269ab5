"""What a table of results says of a fleet: what changed, what was missed, what false alarms cost.

A recording *alarms* if its verdict, or that of its bearings, is not ``normal``. Where it has neither, as of a
machine with levels only, the most severe statement of its detectors counts. Alarming recordings of a machine
that follow each other are one *alarm*: a person goes there once.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from daqsvc.fleet import FleetError
from daqsvc.fleet.table import recorded_at

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from daqsvc.fleet.results import Results
    from daqsvc.fleet.table import Row

YEAR_S = 365.25 * 86_400
TRUTH_COLUMNS = ("machine", "fault", "first", "last")
MOST_TRUTH_BYTES = 50_000_000
_NORMAL = "normal"
_COLUMNS = (
    *("machine", "file", "recorded", "judged", "reason", "verdict", "group", "bearing_verdict"),
    *("bearing_group", "worst_severity"),
)
_DIGITS = re.compile(r"(\d+)")


@dataclass(frozen=True, slots=True)
class KnownFault:
    """A fault that a machine is known to have had.

    Attributes:
        machine: which.
        fault: what it was; any text, a verdict's name where there is one for it.
        first: the first recording that it is in, or a time; empty: from the beginning.
        last: the last one, or a time; empty: to the end.
    """

    machine: str
    fault: str
    first: str
    last: str

    def covers(self, row: Row) -> bool:
        """Whether a recording is one with this fault."""
        return self._reaches(row, self.first, 1) and self._reaches(row, self.last, -1)

    @staticmethod
    def _reaches(row: Row, bound: str, sign: int) -> bool:
        if not bound:
            return True
        at = recorded_at(bound)
        if at is None or row["recorded"] is None or row["file"] == bound:
            key, limit = natural(row["file"]), natural(bound)
            return key >= limit if sign > 0 else key <= limit
        if sign < 0 and not re.search(r"\d[T _]\d", bound):
            at += timedelta(days=1) - timedelta(microseconds=1)  # a day without a clock, to its end
        seen: datetime = row["recorded"]
        return seen >= at if sign > 0 else seen <= at


@dataclass(frozen=True, slots=True)
class Seen:
    """What the recordings say of a known fault.

    Attributes:
        fault: the fault.
        recordings: with it, that were judged.
        alarming: of these, how many alarm.
        named: of these, how many have it among the faults that it may be.
        first_alarm: the first that alarms; None: the fault was missed.
    """

    fault: KnownFault
    recordings: int
    alarming: int
    named: int
    first_alarm: str | None


@dataclass(frozen=True, slots=True)
class Changed:
    """A recording whose verdict is not that of the one before.

    Attributes:
        file: the recording.
        before: verdict of the one before that was judged; None for the first.
        now: its verdict.
    """

    file: str
    before: str | None
    now: str


@dataclass
class MachineReport:
    """What the results say of a machine.

    Attributes:
        machine: its name.
        recordings: in the table.
        judged: of these.
        verdicts: how often each was given.
        now: verdict of the last recording that was judged; None without one.
        changes: where the verdict changed, in order.
        alarms: begins of runs of alarming recordings.
        false_alarms: of these, the ones outside of every known fault; empty without known faults.
        false_recordings: alarming recordings outside of every known fault.
        seen: the known faults.
        years: that the recordings stand for; None if no time is known.
        reasons: why recordings were not judged, each once.
    """

    machine: str
    recordings: int = 0
    judged: int = 0
    verdicts: Counter[str] = field(default_factory=Counter)
    now: str | None = None
    changes: list[Changed] = field(default_factory=list)
    alarms: list[str] = field(default_factory=list)
    false_alarms: list[str] = field(default_factory=list)
    false_recordings: int = 0
    seen: list[Seen] = field(default_factory=list)
    years: float | None = None
    reasons: Counter[str] = field(default_factory=Counter)

    @property
    def missed(self) -> list[Seen]:
        """The known faults that no recording with them alarms of."""
        return [one for one in self.seen if one.recordings and one.first_alarm is None]

    def as_json(self) -> dict[str, Any]:
        """A JSON object."""
        return {
            "machine": self.machine,
            "recordings": self.recordings,
            "judged": self.judged,
            "verdict": self.now,
            "verdicts": dict(sorted(self.verdicts.items())),
            "changes": [{"file": c.file, "before": c.before, "now": c.now} for c in self.changes],
            "alarms": self.alarms,
            "false_alarms": self.false_alarms,
            "false_recordings": self.false_recordings,
            "known_faults": [
                {
                    "fault": one.fault.fault,
                    "first": one.fault.first,
                    "last": one.fault.last,
                    "recordings": one.recordings,
                    "alarming": one.alarming,
                    "named": one.named,
                    "first_alarm": one.first_alarm,
                    "missed": one in self.missed,
                }
                for one in self.seen
            ],
            "machine_years": self.years,
            "not_judged": dict(self.reasons),
        }


@dataclass
class FleetReport:
    """What the results say of a fleet.

    Attributes:
        machines: by name.
        has_truth: whether known faults were given.
        cost: of a false alarm; None: not given.
        unknown: machines with a known fault that the results do not have.
    """

    machines: list[MachineReport]
    has_truth: bool
    cost: float | None
    unknown: list[str]

    @property
    def years(self) -> float | None:
        """Machine-years that the recordings stand for; None if not known of each machine."""
        years = [one.years for one in self.machines if one.recordings]
        return None if None in years or not years else sum(year for year in years if year is not None)

    @property
    def false_alarms(self) -> int:
        """Of all machines."""
        return sum(len(one.false_alarms) for one in self.machines)

    @property
    def false_alarms_per_year(self) -> float | None:
        """Per machine and year; None if that is not known."""
        return self.false_alarms / self.years if self.has_truth and self.years else None

    @property
    def cost_per_year(self) -> float | None:
        """Of false alarms, per machine and year, in the unit of the cost of one."""
        rate = self.false_alarms_per_year
        return None if rate is None or self.cost is None else rate * self.cost

    def as_json(self) -> dict[str, Any]:
        """A JSON object."""
        seen = [one for machine in self.machines for one in machine.seen]
        verdicts = sum((machine.verdicts for machine in self.machines), Counter[str]())
        return {
            "machines": [machine.as_json() for machine in self.machines],
            "fleet": {
                "machines": len(self.machines),
                "recordings": sum(one.recordings for one in self.machines),
                "judged": sum(one.judged for one in self.machines),
                "verdicts": dict(sorted(verdicts.items())),
                "alarms": sum(len(one.alarms) for one in self.machines),
                "machine_years": self.years,
                "known_faults": len(seen) if self.has_truth else None,
                "missed": sum(len(one.missed) for one in self.machines) if self.has_truth else None,
                "without_recordings": sum(not one.recordings for one in seen) if self.has_truth else None,
                "false_alarms": self.false_alarms if self.has_truth else None,
                "false_alarms_per_machine_year": self.false_alarms_per_year,
                "false_alarm_cost_per_machine_year": self.cost_per_year,
                "unknown_machines": self.unknown,
            },
        }


def natural(file: str) -> tuple[tuple[int, str], ...]:
    """What files are ordered by: numbers in their names by what they count, so that 9 is before 10."""
    return tuple(
        (int(part), "") if part.isascii() and part.isdecimal() and len(part) < 20 else (-1, part)
        for part in _DIGITS.split(file)
    )


def read_truth(path: Path) -> list[KnownFault]:
    """Known faults, from a CSV table with the columns machine, fault, first, last.

    Raises:
        FleetError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MOST_TRUTH_BYTES + 1)
        text = content.decode("utf-8-sig")
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is no text in UTF-8"
        raise FleetError(f"--truth {path} cannot be read: {why}; correct the path, or the file") from None
    if len(content) > MOST_TRUTH_BYTES:
        raise FleetError(
            f"--truth {path} has more than {MOST_TRUTH_BYTES // 10**6} MB; give a table of faults"
        )
    try:
        table = csv.DictReader(io.StringIO(text), skipinitialspace=True, strict=True)
        names = [(name or "").strip() for name in table.fieldnames or ()]
        if missing := [name for name in TRUTH_COLUMNS[:2] if name not in names]:
            raise FleetError(
                f"--truth {path} has no column {missing[0]}; its first line names {', '.join(TRUTH_COLUMNS)}"
            )
        table.fieldnames = names
        known: list[KnownFault] = []
        for row in table:
            values = {name: (row.get(name) or "").strip() for name in TRUTH_COLUMNS}
            if not (values["machine"] and values["fault"]):
                raise FleetError(
                    f"--truth {path}, line {table.line_num}: machine or fault is empty; fill it in"
                )
            known.append(KnownFault(**values))
    except csv.Error as error:
        raise FleetError(f"--truth {path} is no CSV table: {error}; save it anew") from None
    return known


def fleet_report(
    results: Results,
    truth: Sequence[KnownFault] | None,
    *,
    cost: float | None = None,
    interval_s: float | None = None,
) -> FleetReport:
    """Read the results, machine by machine.

    Args:
        results: the table.
        truth: known faults; all that they do not cover is healthy. None: nothing is known.
        cost: of a false alarm.
        interval_s: how long each recording stands for; None: until the next one, by the times in their names.

    Raises:
        FleetError: the results cannot be read, or there are none.
    """
    machines: list[MachineReport] = []
    for folder in results.folders():
        rows = results.rows(folder, _COLUMNS)
        if rows:
            name = rows[0]["machine"]
            known = None if truth is None else [one for one in truth if one.machine == name]
            machines.append(machine_report(name, rows, known, interval_s))
    if not machines:
        raise FleetError(
            f"{results.url} holds no results; give the folder that daqsvc analyze --cluster wrote"
        )
    machines.sort(key=lambda one: natural(one.machine))
    names = {one.machine for one in machines}
    unknown = sorted({one.machine for one in truth or () if one.machine not in names})
    return FleetReport(machines, truth is not None, cost, unknown)


def machine_report(
    machine: str, rows: Iterable[Row], truth: Sequence[KnownFault] | None, interval_s: float | None
) -> MachineReport:
    """What the rows of a machine say; arguments as of `fleet_report`."""
    ordered = sorted(rows, key=_order)
    judged = [row for row in ordered if row["judged"]]
    report = MachineReport(machine, len(ordered), len(judged))
    report.reasons = Counter(row["reason"] or "" for row in ordered if not row["judged"])
    report.years = _years(ordered, interval_s)
    was_alarming = was_false = False
    before: str | None = None
    for row in judged:
        now = verdict_of(row)
        alarming = now != _NORMAL
        is_false = alarming and truth is not None and not any(one.covers(row) for one in truth)
        report.verdicts[now] += 1
        if now != before:
            report.changes.append(Changed(row["file"], before, now))
        if alarming and not was_alarming:
            report.alarms.append(row["file"])
        if is_false:
            report.false_recordings += 1
            if not was_false:
                report.false_alarms.append(row["file"])
        before, was_alarming, was_false = now, alarming, is_false
    report.now = before
    report.seen = [_seen(one, judged) for one in truth or ()]
    return report


def verdict_of(row: Mapping[str, Any]) -> str:
    """What a recording says of its machine: of rotor and bearings the one that is not normal, or both.

    Of a machine without such verdicts, as one with levels only: the most severe statement, ``alert`` or
    ``danger``.
    """
    words = [word for word in (row["verdict"], row["bearing_verdict"]) if word is not None]
    if not words:
        worst: str | None = row["worst_severity"]
        return worst or _NORMAL
    telling = [word for word in words if word != _NORMAL]
    return " and ".join(dict.fromkeys(telling)) or _NORMAL


def _seen(fault: KnownFault, judged: Sequence[Row]) -> Seen:
    rows = [row for row in judged if fault.covers(row)]
    alarming = [row for row in rows if verdict_of(row) != _NORMAL]
    named = sum(fault.fault in (*(row["group"] or ()), *(row["bearing_group"] or ())) for row in alarming)
    return Seen(fault, len(rows), len(alarming), named, alarming[0]["file"] if alarming else None)


def _order(row: Row) -> tuple[Any, ...]:
    """By the time in the name, or by the name."""
    recorded = row["recorded"]
    return (recorded is None, recorded.timestamp() if recorded is not None else 0.0, natural(row["file"]))


def _years(ordered: Sequence[Row], interval_s: float | None) -> float | None:
    """How long a machine was watched.

    By times, from the first recording to the last, and once more what is usual between two.
    """
    if interval_s is not None:
        return len(ordered) * interval_s / YEAR_S
    times = [row["recorded"] for row in ordered]
    if None in times or len(times) < 2:
        return None
    steps = sorted((b - a).total_seconds() for a, b in pairwise(times))
    watched_s = sum(steps) + steps[len(steps) // 2]
    return watched_s / YEAR_S if watched_s > 0.0 else None
