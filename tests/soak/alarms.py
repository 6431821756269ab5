"""The alarms: what the scenario made, what the journal has, and what reached the consumer."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import sqlite3
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from soak.machines import ALARM

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path


class Event(NamedTuple):
    """What matters of an alarm event.

    Attributes:
        sequence: its number.
        id: unique in the world.
        machine: which one.
        alarm: which one.
        state: and level, after it.
        level: after it.
        before: state and level before it, by itself.
        t_ns: when, by the monotonic clock.
        digest: of all its bytes.
    """

    sequence: int
    id: str
    machine: str
    alarm: str
    state: str
    level: str
    before: tuple[str, str]
    t_ns: int
    digest: bytes

    @classmethod
    def of(cls, payload: bytes) -> Event:
        """The event in a message."""
        told: dict[str, Any] = json.loads(payload)
        return cls(
            told["sequence"],
            told["id"],
            told["machine"],
            told["alarm"],
            told["state"],
            told["level"],
            (told["previous"]["state"], told["previous"]["level"]),
            told["monotonic_ns"],
            hashlib.blake2b(payload, digest_size=16).digest(),
        )


class Turn(NamedTuple):
    """A change of an alarm that the scenario has made, and that the service has confirmed.

    Attributes:
        machine: whose alarm.
        active: whether it was raised, or returned.
        begin_ns: when the scenario began to make it.
        end_ns: when it was confirmed, and on the disk.
    """

    machine: str
    active: bool
    begin_ns: int
    end_ns: int


@dataclass
class Cycle:
    """Has one alarm come and go, each time that the service has confirmed the last change.

    Attributes:
        machine: whose alarm.
        active: what is being made now.
        begun_ns: since when.
        turns: what has been confirmed.
    """

    machine: str
    active: bool
    begun_ns: int
    turns: list[Turn] = field(default_factory=list)
    _seen: bool = False

    def stands(self, status: Mapping[str, Any]) -> bool:
        """Whether the alarm stands as it is to."""
        standing = {one["alarm"]: one["level"] for one in status["alarms"]["standing"]}
        return (standing.get(ALARM, "normal") != "normal") == self.active

    def look(self, status: Mapping[str, Any], now_ns: int) -> bool:
        """Whether the change is confirmed, and the next one is to be made.

        It is if the status before this one showed it, too: what that showed is not in memory only any more if
        nothing is by now.
        """
        seen_before, self._seen = self._seen, self.stands(status)
        if not (seen_before and self._seen) or status["outbox"]["waiting"]:
            return False
        self.turns.append(Turn(self.machine, self.active, self.begun_ns, now_ns))
        self.active, self.begun_ns, self._seen = not self.active, now_ns, False
        return True


def read_journal(store: Path, after: int) -> list[Event]:
    """The alarm events in a journal with numbers above ``after``, in their order."""
    path = f"file:{store / 'outbox.sqlite'}?mode=ro"
    with contextlib.closing(sqlite3.connect(path, uri=True)) as connection:
        rows = connection.execute(
            "SELECT payload FROM messages WHERE topic LIKE '%/alarms/%' AND sequence > ? ORDER BY sequence",
            (after,),
        )
        return [Event.of(payload) for (payload,) in rows]


@dataclass
class Evidence:
    """All that is known of the alarms.

    Attributes:
        journal: what was ever read in the journal, by id.
        arrivals: what came to the consumer, in its order, repeats left out.
        repeats: messages that came again.
        forgotten: ids of what the broker had acknowledged when it was killed.
        turns: what the scenario has made.
    """

    journal: dict[str, Event] = field(default_factory=dict)
    arrivals: dict[str, Event] = field(default_factory=dict)
    repeats: int = 0
    forgotten: set[str] = field(default_factory=set)
    turns: list[Turn] = field(default_factory=list)

    @property
    def read_to(self) -> int:
        """The highest number that was read in the journal."""
        return max((event.sequence for event in self.journal.values()), default=0)

    def archive(self, events: Iterable[Event]) -> None:
        """Take in what the journal has."""
        self.journal |= {event.id: event for event in events}

    def arrived(self, payload: bytes) -> Iterator[str]:
        """Take in what the consumer got."""
        event = Event.of(payload)
        first = self.arrivals.setdefault(event.id, event)
        if first is not event:
            self.repeats += 1
            if first != event:
                yield f"the id {event.id} stands for two different events"

    def missing(self) -> set[str]:
        """Ids in the journal that have not reached the consumer, and did not die with a broker."""
        return self.journal.keys() - self.arrivals.keys() - self.forgotten

    def violations(self) -> list[str]:
        """What does not hold, a sentence each."""
        checks = (self._lost, self._invented, self._numbers, self._order, self._chains, self._turns)
        return [sentence for check in checks for sentence in check()]

    def _lost(self) -> Iterator[str]:
        for name in sorted(self.missing()):
            yield f"{_words(self.journal[name])} is in the journal and never reached the consumer"

    def _invented(self) -> Iterator[str]:
        for name, event in self.arrivals.items():
            stored = self.journal.get(name)
            if stored is None:
                yield f"{_words(event)} reached the consumer and was never in the journal"
            elif stored != event:
                yield f"{_words(event)} reached the consumer with other bytes than the journal has"

    def _numbers(self) -> Iterator[str]:
        ids: dict[int, str] = {}
        for event in (self.journal | self.arrivals).values():
            if ids.setdefault(event.sequence, event.id) != event.id:
                yield f"number {event.sequence} was given to {event.id} and to {ids[event.sequence]}"

    def _order(self) -> Iterator[str]:
        for before, after in itertools.pairwise(self.arrivals.values()):
            if after.sequence <= before.sequence:
                yield f"{_words(after)} came after number {before.sequence}"

    def _chains(self) -> Iterator[str]:
        last: dict[tuple[str, str], Event] = {}
        for event in sorted(self.journal.values()):
            before = last.get((event.machine, event.alarm))
            stood = (before.state, before.level) if before else ("normal", "normal")
            if stood != event.before:
                yield f"{_words(event)} says that it was {event.before} before, and it was {stood}"
            last[event.machine, event.alarm] = event

    def _turns(self) -> Iterator[str]:
        events: dict[str, list[Event]] = {}
        for event in sorted(self.journal.values()):
            if event.alarm == ALARM:
                events.setdefault(event.machine, []).append(event)
        # By their order: an event has the time of its samples, which a restart may have had to guess.
        left = {machine: iter(ones) for machine, ones in events.items()}
        for turn in self.turns:
            told = (one for one in left.get(turn.machine, iter(())) if (one.level != "normal") == turn.active)
            found = next(told, None)
            if found is None or found.t_ns > turn.end_ns:
                what = "raised" if turn.active else "returned"
                yield (
                    f"{turn.machine}/{ALARM} was {what} between {turn.begin_ns} and {turn.end_ns} ns, and no "
                    "event in the journal tells of it"
                )


def _words(event: Event) -> str:
    return f"number {event.sequence} ({event.machine}/{event.alarm}, {event.state})"


def told_by(arrivals: Sequence[bytes], evidence: Evidence) -> list[str]:
    """Take in what has come, and say what does not fit."""
    return [sentence for payload in arrivals for sentence in evidence.arrived(payload)]
