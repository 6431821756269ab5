"""Which alarms a person means: by their names, by how their ids begin, or by a pattern."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, NamedTuple

from daqsvc.alarms.commands import Verb
from daqsvc.alarms.states import AlarmState
from daqsvc.commands.alarm_journal import current
from daqsvc.errors.command_line import NO_SUCH_ALARM

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

LEAST_ID = 4
"""Letters that the beginning of an occurrence's id must have to be one."""
MOST_NAMED = 20
"""Alarms that a message names at most."""

_UNACKNOWLEDGED = {
    AlarmState.ACTIVE_UNACKNOWLEDGED,
    AlarmState.RETURNED_UNACKNOWLEDGED,
    AlarmState.LATCHED_UNACKNOWLEDGED,
}
_LATCHED = {AlarmState.LATCHED_UNACKNOWLEDGED, AlarmState.LATCHED_ACKNOWLEDGED}
_NOT_NORMAL = {*AlarmState} - {AlarmState.NORMAL}
_OF_PATTERN = {
    Verb.ACKNOWLEDGE: _UNACKNOWLEDGED,
    Verb.RESET: _LATCHED,
    Verb.SHELVE: _NOT_NORMAL - {AlarmState.OUT_OF_SERVICE},
    Verb.UNSHELVE: {AlarmState.SHELVED},
    Verb.BYPASS: _NOT_NORMAL - {AlarmState.OUT_OF_SERVICE},
    Verb.UNBYPASS: {AlarmState.OUT_OF_SERVICE},
}
"""The states of the alarms that a pattern means: the others a verb would leave as they are."""


class NoSuchAlarmError(Exception):
    """What was written means no alarm, or it is not known which one; the text states what there is."""

    code = NO_SUCH_ALARM


class Target(NamedTuple):
    """An alarm that is meant.

    Attributes:
        alarm: its name.
        occurrence: the activation that is meant; None for whichever stands.
        machine: whose alarm it is; None for the one that has an alarm of this name.
    """

    alarm: str
    occurrence: str | None = None
    machine: str | None = None

    def is_of(self, machine: str | None) -> bool:
        """Whether it may be of a machine; None is any."""
        return self.machine is None or machine in {None, self.machine}


def meant(store: Path, words: Sequence[str], verb: Verb, machine: str | None) -> list[Target]:
    """The alarms that a person means, each once, in the order of the words; blocks.

    Args:
        store: directory of the journal.
        words: names, at least `LEAST_ID` letters of an id, or patterns of the shell (``*``, ``?``, ``[..]``).
        verb: what is to be done with them.
        machine: the machine that was named; None for all.

    Raises:
        NoSuchAlarmError: a word begins the ids of several occurrences, or a pattern means no alarm.
        OutboxError: there is no journal, or it cannot be read.
    """
    events = current(store)
    targets: list[Target] = []
    for target in (one for word in words for one in _of_word(events, word, verb, machine)):
        if not any(one.alarm == target.alarm and one.is_of(target.machine) for one in targets):
            targets.append(target)
    return targets


def _of_word(
    events: Sequence[Mapping[str, Any]], word: str, verb: Verb, machine: str | None
) -> Iterator[Target]:
    if any(sign in word for sign in "*?["):
        yield from _of_pattern(events, word, verb, machine)
    elif any(event["alarm"] == word for event in events):
        yield Target(word, machine=machine)
    elif matches := _begun_by(events, word):
        if len(matches) > 1:
            raise NoSuchAlarmError(
                f"{word!r} begins the ids of {', '.join(event['alarm'] for event in matches)}: "
                "write more of the id, or the alarm's name"
            )
        yield Target(matches[0]["alarm"], matches[0]["occurrence"], machine or matches[0]["machine"])
    else:
        # An alarm that was never raised has no event yet: the service knows whether there is one.
        yield Target(word, machine=machine)


def _of_pattern(
    events: Sequence[Mapping[str, Any]], pattern: str, verb: Verb, machine: str | None
) -> Iterator[Target]:
    """Alarms that are not normal. Of these only what a person has seen is meant: the occurrence of now."""
    there = [one for one in events if one["state"] != "normal" and machine in {None, one["machine"]}]
    matches = [
        Target(one["alarm"], one["occurrence"], one["machine"])
        for one in there
        if fnmatchcase(one["alarm"], pattern) and one["state"] in _OF_PATTERN[verb]
    ]
    if not matches:
        names = [f"{one['alarm']} ({one['state'].replace('_', ' ')})" for one in there]
        more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        those = f"these are not normal: {', '.join(names[:MOST_NAMED])}{more}" if names else "all are normal"
        raise NoSuchAlarmError(
            f"no alarm that {pattern!r} matches waits for {verb}; {those}. A pattern means alarms that "
            "daqsvc alarms shows; write the name of any other"
        )
    yield from matches


def _begun_by(events: Sequence[Mapping[str, Any]], words: str) -> list[Mapping[str, Any]]:
    if len(words) < LEAST_ID:
        return []
    return [event for event in events if (event["occurrence"] or "").startswith(words)]
