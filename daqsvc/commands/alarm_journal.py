"""Alarm messages out of the journal, whether the service runs or not, and as a person reads them.

That is in aligned columns, in local time, with how long ago that was.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, NamedTuple

from daqsvc.alarms.codes import EASES
from daqsvc.commands.complaint import complain
from daqsvc.commands.tables import ago, aligned, local_time
from daqsvc.errors.alarms import ALARM_STANDS
from daqsvc.errors.code import with_code
from daqsvc.errors.service import JOURNAL_DAMAGED
from daqsvc.outbox.reading import read_journal, read_pasts
from daqsvc.outbox.safety import as_owner_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from daqsvc.outbox.reading import JournalEntry, JournalView

    EventDocument = dict[str, Any]
    """An alarm payload as it was published."""

SCHEMA = "daqsvc.alarm/"
MOST_EVENTS = 500
"""Events of one alarm that are looked through for how it began."""

_FINDINGS = {"raised", "escalated", "lowered", "changed", "recurred", "latched", "returned"}
"""Events that state a finding, rather than what somebody did about it."""


class AlarmView(NamedTuple):
    """The state of an alarm, and how it came about.

    Attributes:
        latest: its latest event.
        since_ns: when its occurrence began, wall clock; of an alarm without one, when the event was.
        message: what was found last, and what somebody has done about it since.
    """

    latest: EventDocument
    since_ns: int
    message: str


def current(store: Path) -> list[EventDocument]:
    """The latest event of every alarm of every machine that the journal knows, oldest first; blocks.

    Raises:
        OutboxError: there is no journal, or it cannot be read.
    """
    view = _journal(store)
    _tell_damage(view, store)
    return list(_documents(view.latest))


def machines_of(store: Path) -> set[str]:
    """The machines that ever had an alarm, by the journal; blocks.

    Raises:
        OutboxError: there is no journal, or it cannot be read.
    """
    return {event["machine"] for event in _documents(_journal(store).latest)}


def standing(store: Path, events: Sequence[EventDocument]) -> list[AlarmView]:
    """The states of alarms, with what their own past adds to it; blocks.

    Args:
        store: the store's directory.
        events: from `current`.

    Raises:
        OutboxError: the journal cannot be read.
    """
    topics = {entry.topic: json.loads(entry.payload) for entry in _journal(store).latest}
    topic_of = {event.get("id"): topic for topic, event in topics.items()}
    standing_now = {
        topic: event["occurrence"]
        for event in events
        if event["occurrence"] and (topic := topic_of.get(event["id"])) is not None
    }

    def is_over(entry: JournalEntry) -> bool:
        return bool(json.loads(entry.payload).get("occurrence") != standing_now[entry.topic])

    with as_owner_of(store):
        pasts = read_pasts(store, standing_now, is_over, MOST_EVENTS) if standing_now else {}
    views = []
    for event in events:
        past = list(_documents(pasts.get(topic_of.get(event["id"], ""), ())))
        findings = [one["message"] for one in past if one["kind"] in _FINDINGS]
        message = event["message"]
        if findings and findings[-1] != message:
            message = f"{findings[-1]}; {message}"
        views.append(AlarmView(event, past[0]["wall_ns"] if past else event["wall_ns"], message))
    return views


def history(store: Path, most: int, machine: str | None = None) -> list[EventDocument]:
    """The newest events, of all machines or of one, at most so many, newest last; blocks.

    Raises:
        OutboxError: there is no journal, or it cannot be read.
    """
    asked = most
    while True:
        view = _journal(store, asked)
        events = [one for one in _documents(view.history) if machine in {None, one["machine"]}]
        # Messages of other kinds and machines may lie between.
        if len(events) >= most or len(view.history) + view.damaged < asked:
            _tell_damage(view, store)
            return events[-most:]
        asked *= 4


def _journal(store: Path, history: int = 0) -> JournalView:
    with as_owner_of(store):
        return read_journal(store, history=history)


def _tell_damage(view: JournalView, store: Path) -> None:
    if view.damaged:
        what = f"{view.damaged} messages of the journal have changed on the disk and are left out"
        complain(f"{store}", what, JOURNAL_DAMAGED)


def _documents(entries: Iterable[JournalEntry]) -> Iterable[EventDocument]:
    for entry in entries:
        event = json.loads(entry.payload)
        if str(event.get("schema", "")).startswith(SCHEMA):
            yield event


ID_LENGTH = 8
"""Characters of an occurrence's id that are enough to name it."""


def current_table(alarms: Sequence[AlarmView], now_ns: int) -> str:
    """The states of alarms: one line each, the worst first, then the newest.

    Args:
        alarms: one each.
        now_ns: wall clock, ns since the Unix epoch.
    """
    events = [alarm.latest for alarm in alarms]
    machines = _machine_title(events)
    worst_first = sorted(alarms, key=lambda alarm: (-_LEVELS.index(alarm.latest["level"]), -alarm.since_ns))
    rows = [
        [
            event["level"],
            _state(event),
            *_machine(event, machines),
            event["alarm"],
            (event["occurrence"] or "-")[:ID_LENGTH],
            f"{local_time(since_ns)} ({ago(now_ns - since_ns)})",
            with_code(message, _code(event)),
        ]
        for event, since_ns, message in worst_first
    ]
    return aligned(["LEVEL", "STATE", *machines, "ALARM", "ID", "SINCE", "MESSAGE"], rows)


def history_table(events: Sequence[EventDocument]) -> str:
    """What has happened: one line an event, newest last."""
    machines = _machine_title(events)
    rows = [
        [
            local_time(event["wall_ns"]),
            event["kind"],
            event["level"],
            _state(event),
            *_machine(event, machines),
            event["alarm"],
            (event["occurrence"] or "-")[:ID_LENGTH],
            with_code(event["message"], None if event["kind"] in EASES else _code(event)),
        ]
        for event in events
    ]
    titles = ["TIME", "EVENT", "LEVEL", "STATE", *machines, "ALARM", "ID", "MESSAGE"]
    return aligned(titles, rows)


def _code(event: EventDocument) -> str | None:
    """The code that the log gives an alarm that is not normal."""
    return None if event["level"] == "normal" else event.get("code") or ALARM_STANDS.id


_LEVELS = ("normal", "alert", "danger")


def _state(event: EventDocument) -> str:
    words = str(event["state"]).replace("_", " ")
    if event["state"] == "shelved" and (until_ns := event.get("shelved_until_wall_ns")):
        words += f" until {local_time(until_ns)}"
    if event.get("covered"):
        words += f" (over {str(event['covered']).replace('_', ' ')})"
    if event.get("first_out") and event["state"] != "normal":
        words += ", first out"
    if event.get("chattering"):
        words += ", chattering"
    return words


def _machine(event: EventDocument, machines: Sequence[str]) -> list[str]:
    return [event["machine"]] if machines else []


def _machine_title(events: Iterable[EventDocument]) -> list[str]:
    """A column for the machine, where there are several."""
    return ["MACHINE"] if len({event["machine"] for event in events}) > 1 else []
