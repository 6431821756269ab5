"""Alarm messages out of the journal, whether the service runs or not."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING, Any

from daqsvc.outbox.reading import read_journal

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from daqsvc.outbox.reading import JournalEntry, JournalView

    Told = dict[str, Any]
    """An alarm payload as it was published."""

SCHEMA = "daqsvc.alarm/"


def current(store: Path) -> list[Told]:
    """The latest event of every alarm of every machine that the journal knows, oldest first; blocks.

    Raises:
        OutboxError: there is no journal, or it cannot be read.
    """
    view = read_journal(store, history=0)
    _tell_damage(view, store)
    return list(_told(view.latest))


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
