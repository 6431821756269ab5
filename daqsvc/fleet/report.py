"""What a table of results states about a fleet: what changed, what was missed, what false alarms cost.

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
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeAlias, TypedDict

from daqsvc.fleet import FleetError
from daqsvc.fleet.table import bound_at

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from daqsvc.fleet.results import Results
    from daqsvc.fleet.table import Row

YEAR_S = 365.25 * 86_400
TRUTH_COLUMNS = ("machine", "fault", "first", "last")
MOST_TRUTH_BYTES = 50_000_000
VERDICT_COLUMNS = ("verdict", "bearing_verdict", "worst_severity")
"""What `verdict_of` reads."""
_NORMAL = "normal"
_COLUMNS = ("machine", "file", "recorded", "judged", "reason", "group", "bearing_group", *VERDICT_COLUMNS)
_DIGITS = re.compile(r"(\d+)")
_Key: TypeAlias = "tuple[Any, ...]"
"""Of `_order`; without its end, which is the name of the recording, it is a time."""


class TruthError(FleetError):
    """A table of known faults states what cannot be, or names what the results do not have."""


@dataclass(frozen=True, slots=True)
class KnownFault:
    """A fault that a machine is known to have had.

    Attributes:
        machine: which.
        fault: what it was; any text, a verdict's name where there is one for it.
        first: the first recording that it is in, or a time; empty: from the beginning.
        last: the last one, or a time; empty: to the end.
        where: table and line that state it.
    """

    machine: str
    fault: str
    first: str
    last: str
    where: str = "--truth"


@dataclass(frozen=True, slots=True)
class _Span:
    """From where to where a known fault reaches, in the order of the recordings; None is without a bound."""

    fault: KnownFault
    first: _Key | None
    last: _Key | None

    def covers(self, row: Row) -> bool:
        """Whether a recording is one with this fault."""
        key = _order(row)
        return (self.first is None or key[: len(self.first)] >= self.first) and (
            self.last is None or key[: len(self.last)] <= self.last
        )


@dataclass(frozen=True, slots=True)
class Seen:
    """What the recordings show of a known fault.

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


class ChangedJson(TypedDict):
    """Where the verdict of a machine changed.

    Attributes:
        file: the recording with the new verdict.
        before: the verdict before; null at the first one.
        now: the new verdict.
    """

    file: str
    before: str | None
    now: str


class KnownFaultJson(TypedDict):
    """A known fault.

    Attributes:
        fault: its name.
        first: the first recording or time with it.
        last: the last recording or time with it; empty if it is still there.
        recordings: recordings with it.
        alarming: how many of these alarm.
        named: how many of these name it.
        first_alarm: the first of these that alarms; null if none does.
        missed: whether there are recordings with it, and none alarms.
    """

    fault: str
    first: str
    last: str
    recordings: int
    alarming: int
    named: int
    first_alarm: str | None
    missed: bool


class MachineReportJson(TypedDict):
    """One machine.

    Attributes:
        machine: name of the machine.
        recordings: recordings of it.
        judged: how many of these were judged.
        verdict: verdict of the last recording that was judged; null without one.
        verdicts: how often each verdict was given.
        changes: where the verdict changed, in order.
        alarms: first recordings of runs of alarming ones.
        false_alarms: those of them outside of every known fault; empty without known faults.
        false_recordings: alarming recordings outside of every known fault.
        false_alarm_cost: cost of the false alarms; null if it is not known.
        known_faults: the known faults.
        machine_years: years that the recordings represent; null if no time is known.
        not_judged: why recordings were not judged, and how many.
    """

    machine: str
    recordings: int
    judged: int
    verdict: str | None
    verdicts: dict[str, int]
    changes: list[ChangedJson]
    alarms: list[str]
    false_alarms: list[str]
    false_recordings: int
    false_alarm_cost: float | None
    known_faults: list[KnownFaultJson]
    machine_years: float | None
    not_judged: dict[str, int]


class FleetJson(TypedDict):
    """All machines together.

    Attributes:
        machines: how many there are.
        recordings: recordings of them.
        judged: how many of these were judged.
        verdicts: how often each verdict was given.
        alarms: runs of alarming recordings.
        machine_years: years that the recordings represent; null if no time is known.
        known_faults: how many known faults there are; null if none were given.
        missed: known faults that no recording alarms of; null without known faults.
        without_recordings: known faults without a recording that was judged; null without known faults.
        false_alarms: alarms outside of every known fault; null without known faults.
        false_alarm_cost: their cost; null if it is not known.
        times_not_known: machines of which it is not known how long they were watched.
        false_alarms_per_machine_year: false alarms of a machine in a year; null if that is not known.
        false_alarm_cost_per_machine_year: their cost; null if that is not known.
        unknown_machines: machines with a known fault that the results do not have.
    """

    machines: int
    recordings: int
    judged: int
    verdicts: dict[str, int]
    alarms: int
    machine_years: float | None
    known_faults: int | None
    missed: int | None
    without_recordings: int | None
    false_alarms: int | None
    false_alarm_cost: float | None
    times_not_known: list[str]
    false_alarms_per_machine_year: float | None
    false_alarm_cost_per_machine_year: float | None
    unknown_machines: list[str]


class FleetReportJson(TypedDict):
    """What the results report.

    Attributes:
        machines: each machine.
        fleet: all machines together.
    """

    machines: list[MachineReportJson]
    fleet: FleetJson


@dataclass
class MachineReport:
    """What the results show of a machine.

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
        years: that the recordings that were judged represent; None if no time is known.
        reasons: why recordings were not judged, each once.
        cost: of its false alarms; None: nothing is known of it.
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
    cost: float | None = None

    @property
    def missed(self) -> list[Seen]:
        """The known faults that no recording with them alarms of."""
        return [one for one in self.seen if one.recordings and one.first_alarm is None]

    def as_json(self) -> MachineReportJson:
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
            "false_alarm_cost": self.cost,
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
    """What the results show of a fleet.

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
        """Machine-years, of the machines of which they are known; None if they are of none."""
        years = [one.years for one in self.machines if one.years is not None]
        return sum(years) if years else None

    @property
    def without_times(self) -> list[str]:
        """The machines of which it is not known how long they were watched."""
        return [one.machine for one in self.machines if one.years is None]

    @property
    def false_alarms(self) -> int:
        """Of all machines."""
        return sum(len(one.false_alarms) for one in self.machines)

    @property
    def false_alarms_per_year(self) -> float | None:
        """Per machine and year, of the machines whose times are known; None if there is none."""
        if not (self.has_truth and self.years):
            return None
        return sum(len(one.false_alarms) for one in self.machines if one.years is not None) / self.years

    @property
    def false_alarm_cost(self) -> float | None:
        """Of all false alarms; None if that of one, or the known faults, are not given."""
        return self.false_alarms * self.cost if self.has_truth and self.cost is not None else None

    @property
    def cost_per_year(self) -> float | None:
        """Of false alarms, per machine and year, in the unit of the cost of one."""
        rate = self.false_alarms_per_year
        return None if rate is None or self.cost is None else rate * self.cost

    def as_json(self) -> FleetReportJson:
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
                "false_alarm_cost": self.false_alarm_cost,
                "times_not_known": self.without_times,
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
            known.append(KnownFault(**values, where=f"--truth {path}, line {table.line_num}"))
    except csv.Error as error:
        raise FleetError(f"--truth {path} is no CSV table: {error}; save it again") from None
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
        interval_s: how long each recording represents; None: until the next one, by the times in their names.

    Raises:
        FleetError: the results cannot be read, or there are none.
        TruthError: a known fault begins or ends at what is neither a time nor a recording, or ends too early.
    """
    machines: list[MachineReport] = []
    for folder in results.folders():
        rows = results.rows(folder, _COLUMNS)
        if rows:
            name = rows[0]["machine"]
            known = None if truth is None else [one for one in truth if one.machine == name]
            report = machine_report(name, rows, known, interval_s)
            if known is not None and cost is not None:
                report.cost = len(report.false_alarms) * cost
            machines.append(report)
    if not machines:
        raise FleetError(
            f"{results.url} holds no results; give the folder that daqsvc analyze --cluster wrote"
        )
    machines.sort(key=lambda one: natural(one.machine))
    names = {one.machine for one in machines}
    unknown = [one for one in truth or () if one.machine not in names]
    for fault in unknown:
        _span(fault, ())
    return FleetReport(machines, truth is not None, cost, sorted({one.machine for one in unknown}))


def machine_report(
    machine: str, rows: Iterable[Row], truth: Sequence[KnownFault] | None, interval_s: float | None
) -> MachineReport:
    """What the rows of a machine show; arguments as of `fleet_report`.

    Raises:
        TruthError: as `fleet_report`.
    """
    ordered = sorted(rows, key=_order)
    judged = [row for row in ordered if row["judged"]]
    report = MachineReport(machine, len(ordered), len(judged))
    report.reasons = Counter(row["reason"] or "" for row in ordered if not row["judged"])
    report.years = _years(judged, interval_s)
    spans = [_span(one, ordered) for one in truth or ()]
    was_alarming = was_false = False
    before: str | None = None
    for row in judged:
        now = verdict_of(row)
        alarming = now != _NORMAL
        is_false = alarming and truth is not None and not any(one.covers(row) for one in spans)
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
    report.seen = [_seen(one, judged) for one in spans]
    return report


def verdict_of(row: Mapping[str, Any]) -> str:
    """What a recording states of its machine: of rotor and bearings the one that is not normal, or both.

    Of a machine without such verdicts, as one with levels only: the most severe statement, ``alert`` or
    ``danger``.
    """
    words = [word for word in (row["verdict"], row["bearing_verdict"]) if word is not None]
    if not words:
        worst: str | None = row["worst_severity"]
        return worst or _NORMAL
    telling = [word for word in words if word != _NORMAL]
    return " and ".join(dict.fromkeys(telling)) or _NORMAL


def _span(fault: KnownFault, ordered: Sequence[Row]) -> _Span:
    """Where a known fault reaches.

    Args:
        fault: what is known.
        ordered: the recordings of its machine, judged or not; empty: its bounds cannot be compared with any.

    Raises:
        TruthError: a bound is neither a time nor a recording, or the last one is before the first.
    """
    first = _bound(fault, fault.first, ordered, 0)
    last = _bound(fault, fault.last, ordered, 1)
    if first is not None and last is not None:
        shorter = min(len(first), len(last))
        if first[:shorter] > last[:shorter]:
            raise TruthError(
                f"{fault.where}: first, {fault.first!r}, is after last, {fault.last!r}; correct the line"
            )
    return _Span(fault, first, last)


def _bound(fault: KnownFault, bound: str, ordered: Sequence[Row], which: int) -> _Key | None:
    """The key of the recording or time; ``which`` end of a day is meant is 0 or 1."""
    if not bound:
        return None
    for row in ordered:
        if row["file"] == bound:
            return _order(row)
    at = bound_at(bound)
    if at is not None and ordered and all(row["recorded"] is None for row in ordered):
        raise TruthError(
            f"{fault.where}: {bound!r} is a time, and no recording of {fault.machine} has one in its name; "
            f"name recordings, e.g. {ordered[0]['file']!r}"
        )
    if at is not None:
        return (False, at[which].timestamp())
    if ordered:
        raise TruthError(
            f"{fault.where}: {bound!r} is neither a time nor a recording of {fault.machine}; write a time as "
            f"2026-03-01 or 2026-03-01T06:00, or a recording as {ordered[0]['file']!r}"
        )
    return None


def _seen(span: _Span, judged: Sequence[Row]) -> Seen:
    fault = span.fault
    rows = [row for row in judged if span.covers(row)]
    alarming = [row for row in rows if verdict_of(row) != _NORMAL]
    named = sum(fault.fault in (*(row["group"] or ()), *(row["bearing_group"] or ())) for row in alarming)
    return Seen(fault, len(rows), len(alarming), named, alarming[0]["file"] if alarming else None)


def _order(row: Row) -> tuple[Any, ...]:
    """By the time in the name, or by the name."""
    recorded = row["recorded"]
    return (recorded is None, recorded.timestamp() if recorded is not None else 0.0, natural(row["file"]))


def _years(judged: Sequence[Row], interval_s: float | None) -> float | None:
    """How long a machine was watched: a recording that was not judged cannot alarm, and so does not count.

    By times, from the first recording to the last, and once more what is usual between two.
    """
    if interval_s is not None:
        return len(judged) * interval_s / YEAR_S
    times = [row["recorded"] for row in judged]
    if None in times or len(times) < 2:
        return None
    steps = sorted((b - a).total_seconds() for a, b in pairwise(times))
    watched_s = sum(steps) + steps[len(steps) // 2]
    return watched_s / YEAR_S if watched_s > 0.0 else None
