"""Alarm messages out of the journal, whether the service runs or not."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Any, NamedTuple

from daqsvc.outbox.reading import read_journal, read_pasts

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from daqsvc.outbox.reading import JournalEntry, JournalView

    Told = dict[str, Any]
    """An alarm payload as it was published."""

SCHEMA = "daqsvc.alarm/"
MOST_EVENTS = 500
"""Events of one alarm that are looked through for how it began."""

_FINDINGS = {"raised", "escalated", "lowered", "changed", "recurred", "latched", "returned"}
"""Events that say what was found, rather than what somebody did about it."""


class AlarmView(NamedTuple):
    """How an alarm stands, and how that came about.

    Attributes:
        told: its latest event.
        since_ns: when its occurrence began, wall clock; of an alarm without one, when the event was.
        message: what was found last, and what somebody has done about it since.
    """

    told: Told
    since_ns: int
    message: str


def current(store: Path) -> list[Told]:
    """The latest event of every alarm of every machine that the journal knows, oldest first; blocks.

    Raises:
        OutboxError: there is no journal, or it cannot be read.
    """
    view = read_journal(store, history=0)
    _tell_damage(view, store)
    return list(_told(view.latest))


def standing(store: Path, events: Sequence[Told]) -> list[AlarmView]:
    """How alarms stand, with what their own past adds to it; blocks.

    Args:
        store: the store's directory.
        events: from `current`.

    Raises:
        OutboxError: the journal cannot be read.
    """
    topics = {entry.topic: json.loads(entry.payload) for entry in read_journal(store, history=0).latest}
    topic_of = {told.get("id"): topic for topic, told in topics.items()}
    standing_now = {
        topic: told["occurrence"]
        for told in events
        if told["occurrence"] and (topic := topic_of.get(told["id"])) is not None
    }

    def is_over(entry: JournalEntry) -> bool:
        return bool(json.loads(entry.payload).get("occurrence") != standing_now[entry.topic])

    pasts = read_pasts(store, standing_now, is_over, MOST_EVENTS) if standing_now else {}
    found = []
    for told in events:
        past = list(_told(pasts.get(topic_of.get(told["id"], ""), ())))
        findings = [one["message"] for one in past if one["kind"] in _FINDINGS]
        message = told["message"]
        if findings and findings[-1] != message:
            message = f"{findings[-1]}; {message}"
        found.append(AlarmView(told, past[0]["wall_ns"] if past else told["wall_ns"], message))
    return found


def history(store: Path, most: int) -> list[Told]:
    """The newest events, at most so many, newest last; blocks.

    Raises:
        OutboxError: there is no journal, or it cannot be read.
    """
    asked = most
    while True:
        view = read_journal(store, history=asked)
        events = list(_told(view.history))
        # Messages of other kinds may lie between.
        if len(events) >= most or len(view.history) + view.damaged < asked:
            _tell_damage(view, store)
            return events[-most:]
        asked *= 4


def _tell_damage(view: JournalView, store: Path) -> None:
    if view.damaged:
        print(  # noqa: T201 - what goes wrong goes to stderr
            f"{view.damaged} messages of the journal in {store} have changed on the disk and are left out",
            file=sys.stderr,
        )


def _told(entries: Iterable[JournalEntry]) -> Iterable[Told]:
    for entry in entries:
        told = json.loads(entry.payload)
        if str(told.get("schema", "")).startswith(SCHEMA):
            yield told
