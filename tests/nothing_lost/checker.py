"""What a run must have kept: every promise about alarms, checked from outside.

Four witnesses that do not trust each other: the script (what must be told), the teller's notes (what it
was told to be on disk), the journal file (what is on disk), and the consumer (what came). The proxy adds
what the broker has acknowledged.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import sqlite3
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

from nothing_lost.script import ALARM_OF, QUALITY_ALARM_OF, Expected

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from nothing_lost.consumer import Arrival
    from nothing_lost.script import Script
    from nothing_lost.teller import Witness

TOLD = {*ALARM_OF.values(), *QUALITY_ALARM_OF.values()}
"""The alarms that the script is about; the service may have others about itself."""


def journal_of(store: Path) -> dict[str, bytes]:
    """Every alarm payload in the journal file by its id, in the order of its numbers."""
    path = f"file:{store / 'outbox.sqlite'}?mode=ro"
    with contextlib.closing(sqlite3.connect(path, uri=True)) as connection:
        rows = connection.execute(
            "SELECT payload FROM messages WHERE topic LIKE '%/alarms/%' ORDER BY sequence"
        ).fetchall()
    return {json.loads(payload)["id"]: payload for (payload,) in rows}


@dataclass
class Evidence:
    """All that is known of a run when it is over.

    Attributes:
        script: what was to be told.
        witness: what the teller wrote down.
        journal: payloads on disk, by id, in order.
        arrivals: what the consumer got, in order.
        forgotten: what the broker had acknowledged when it was killed with no time to pass it on, by id.
        made_room: ids that the broker had acknowledged, if the disk was full: the journal may have given
            them up to make room.
        killed_on_full_disk: whether the process was killed while the disk took nothing: what it had told from
            memory is on no disk, so the script goes back to what is, and each alarm is told as it stands
            there.
    """

    script: Script
    witness: Witness
    journal: dict[str, bytes]
    arrivals: Sequence[Arrival]
    forgotten: dict[str, bytes] = field(default_factory=dict)
    made_room: set[str] = field(default_factory=set)
    killed_on_full_disk: bool = False

    @property
    def events(self) -> list[dict[str, Any]]:
        """Every event of the run by its number, be it still in the journal or only with others."""
        arrived = {arrival.alarm["id"]: arrival.payload for arrival in self.arrivals}
        payloads = self.forgotten | arrived | self.journal
        return sorted(map(json.loads, payloads.values()), key=lambda alarm: alarm["sequence"])


@dataclass
class Verdict:
    """What came out.

    Attributes:
        violations: what was not kept, in words; empty if all was.
        alarms: alarm events in the journal.
        repeats: messages that came again, with the same id.
        forgotten: events that the broker acknowledged and lost with its memory before anybody got them.
        worst_delay_s: longest time from the disk to the consumer.
    """

    violations: list[str]
    alarms: int
    repeats: int
    forgotten: int
    worst_delay_s: float

    @classmethod
    def on(cls, evidence: Evidence) -> Self:
        """Check everything."""
        checks: list[Callable[[Evidence], Iterable[str]]] = [
            _finished,
            _on_disk_stays_on_disk,
            _nothing_lost,
            _nothing_invented,
            _ids_used_once,
            _in_order,
            _the_known_sequence,
            _chains_unbroken,
            _occurrences_complete,
            _last_state_known,
        ]
        received = _without_repeats(evidence.arrivals)
        committed_ns = evidence.witness.committed_ns
        delays_ns = [
            arrival.t_ns - committed_ns[alarm["sequence"]]
            for arrival, alarm in received
            if alarm["sequence"] in committed_ns
        ]
        return cls(
            violations=[violation for check in checks for violation in check(evidence)],
            alarms=len(evidence.events),
            repeats=len(evidence.arrivals) - len(received),
            forgotten=len(evidence.forgotten.keys() - _ids(evidence)),
            worst_delay_s=max(delays_ns, default=0) / 1e9,
        )


def _without_repeats(arrivals: Iterable[Arrival]) -> list[tuple[Arrival, dict[str, Any]]]:
    """The first arrival of each id, with its payload, as a consumer is told to read the topic."""
    first: dict[str, tuple[Arrival, dict[str, Any]]] = {}
    for arrival in arrivals:
        alarm = arrival.alarm
        first.setdefault(alarm["id"], (arrival, alarm))
    return list(first.values())


def _ids(evidence: Evidence) -> set[str]:
    return {arrival.alarm["id"] for arrival in evidence.arrivals}


def _committed(evidence: Evidence) -> set[str]:
    """The ids of what the teller was told to be on disk."""
    return evidence.witness.committed_ids


def _finished(evidence: Evidence) -> Iterable[str]:
    if not evidence.witness.done:
        last = evidence.script.steps[-1].number
        yield f"never came to an end: settled to step {evidence.witness.settled} of {last}"


def _on_disk_stays_on_disk(evidence: Evidence) -> Iterable[str]:
    for name in sorted(_committed(evidence) - evidence.journal.keys() - evidence.made_room):
        yield f"{name} was said to be on disk and is not in the journal"


def _nothing_lost(evidence: Evidence) -> Iterable[str]:
    for lost in sorted(
        (_committed(evidence) | evidence.journal.keys()) - _ids(evidence) - evidence.forgotten.keys()
    ):
        yield f"{lost} was committed and never reached the consumer"


def _nothing_invented(evidence: Evidence) -> Iterable[str]:
    for arrival, alarm in _without_repeats(evidence.arrivals):
        if alarm["id"] in evidence.made_room - evidence.journal.keys():
            continue
        if alarm["id"] not in evidence.journal and not evidence.killed_on_full_disk:
            yield f"{alarm['id']} reached the consumer and is not in the journal"
        elif arrival.payload != evidence.journal.get(alarm["id"], arrival.payload):
            yield f"{alarm['id']} reached the consumer with other bytes than in the journal"


def _ids_used_once(evidence: Evidence) -> Iterable[str]:
    for sequence in evidence.witness.committed_twice:
        yield f"number {sequence} was given twice"
    payloads: dict[str, set[bytes]] = {}
    for arrival in evidence.arrivals:
        payloads.setdefault(arrival.alarm["id"], set()).add(arrival.payload)
    for name, different in payloads.items():
        if len(different) > 1:
            yield f"{name} stands for {len(different)} different events"
    numbers = Counter(alarm["sequence"] for alarm in evidence.events)
    for sequence, times in numbers.items():
        if times > 1:
            yield f"number {sequence} is {times} times in the journal"


def _in_order(evidence: Evidence) -> Iterable[str]:
    for (_, before), (_, after) in itertools.pairwise(_without_repeats(evidence.arrivals)):
        if after["sequence"] <= before["sequence"]:
            yield f"{after['id']} came after {before['id']}"


def _the_known_sequence(evidence: Evidence) -> Iterable[str]:
    """What came, and what the broker forgot, is what the script says, event by event."""
    by_id = {alarm["id"]: alarm for _, alarm in _without_repeats(evidence.arrivals)}
    for name, payload in evidence.forgotten.items():
        by_id.setdefault(name, json.loads(payload))
    told = [
        Expected(alarm["cause"]["window"]["first_index"], alarm["alarm"], alarm["level"])
        for alarm in sorted(by_id.values(), key=lambda alarm: alarm["sequence"])
        if alarm["alarm"] in TOLD
    ]
    expected = evidence.script.expected()
    if evidence.killed_on_full_disk:
        told = _without_what_is_told_again(told, expected)
    for at, (wanted, got) in enumerate(itertools.zip_longest(expected, told)):
        if wanted != got:
            yield f"event {at} should be {wanted} and is {got}; {len(expected)} wanted, {len(told)} came"
            return


def _without_what_is_told_again(told: Sequence[Expected], expected: Sequence[Expected]) -> list[Expected]:
    """What was told, but for what was told again from an earlier point on, or as it had been before."""
    course: list[Expected] = []
    for event in told:
        if len(course) < len(expected) and event == expected[len(course)]:
            course.append(event)
        elif event not in course and event.level != "normal":
            return [*course, event]
    return course


def _chains_unbroken(evidence: Evidence) -> Iterable[str]:
    if evidence.killed_on_full_disk:
        return
    last: dict[str, dict[str, Any]] = {}
    for alarm in evidence.events:
        before = last.get(alarm["alarm"])
        stood = (before["state"], before["level"]) if before else ("normal", "normal")
        if stood != (alarm["previous"]["state"], alarm["previous"]["level"]):
            yield f"{alarm['id']} says that {alarm['alarm']} was {alarm['previous']}, but it was {stood}"
        last[alarm["alarm"]] = alarm


def _occurrences_complete(evidence: Evidence) -> Iterable[str]:
    if evidence.killed_on_full_disk:
        return
    kinds: dict[str, list[str]] = {}
    for alarm in evidence.events:
        if alarm["occurrence"] is not None and alarm["alarm"] in TOLD:
            kinds.setdefault(alarm["occurrence"], []).append(alarm["kind"])
    for occurrence, course in kinds.items():
        if course[0] != "raised" or course.count("raised") > 1 or course[-1] != "returned":
            yield f"occurrence {occurrence} went {' -> '.join(course)}"


def _last_state_known(evidence: Evidence) -> Iterable[str]:
    """Whatever a broker has forgotten: the consumer ends up with each alarm's last state."""
    on_disk = {alarm["alarm"]: alarm["id"] for alarm in evidence.events}
    known: dict[str, tuple[int, str]] = {}
    for _, alarm in _without_repeats(evidence.arrivals):
        known[alarm["alarm"]] = max(known.get(alarm["alarm"], (0, "")), (alarm["sequence"], alarm["id"]))
    for name, latest in on_disk.items():
        if known.get(name, (0, ""))[1] != latest:
            yield f"the consumer's last state of {name} is {known.get(name)}, not {latest}"
