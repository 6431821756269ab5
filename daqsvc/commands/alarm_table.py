"""Alarms as a person reads them: aligned columns, local time, and how long ago that was."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from daqsvc.acquisition.clock import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from daqsvc.commands.alarm_journal import AlarmView

    Told = Mapping[str, Any]
    """An alarm payload (schema ``daqsvc.alarm/1``), as it was published."""

ID_LENGTH = 8
"""So much of an occurrence's id is enough for a person to name it by."""

_AGES = ((86_400, "d"), (3600, "h"), (60, "min"))
_GAP = "  "


def current(alarms: Sequence[AlarmView], now_ns: int) -> str:
    """How alarms stand: one line each, the worst first, then the newest.

    Args:
        alarms: one each.
        now_ns: wall clock, ns since the Unix epoch.
    """
    events = [alarm.told for alarm in alarms]
    machines = _machine_title(events)
    worst_first = sorted(alarms, key=lambda alarm: (-_LEVELS.index(alarm.told["level"]), -alarm.since_ns))
    rows = [
        [
            told["level"],
            _state(told),
            *_machine(told, machines),
            told["alarm"],
            (told["occurrence"] or "-")[:ID_LENGTH],
            f"{_local(since_ns)} ({ago(now_ns - since_ns)})",
            message,
        ]
        for told, since_ns, message in worst_first
    ]
    return _aligned(["LEVEL", "STATE", *machines, "ALARM", "ID", "SINCE", "MESSAGE"], rows)


def history(events: Sequence[Told]) -> str:
    """What has happened: one line an event, newest last."""
    machines = _machine_title(events)
    rows = [
        [
            _local(told["wall_ns"]),
            told["kind"],
            told["level"],
            _state(told),
            *_machine(told, machines),
            told["alarm"],
            (told["occurrence"] or "-")[:ID_LENGTH],
            told["message"],
        ]
        for told in events
    ]
    titles = ["TIME", "EVENT", "LEVEL", "STATE", *machines, "ALARM", "ID", "MESSAGE"]
    return _aligned(titles, rows)


def ago(age_ns: int) -> str:
    """An age in its largest unit, e.g. ``12 min``; the wall clock may have stepped since."""
    age_s = age_ns // NS_PER_S
    if age_s < -60:
        return "the clock was ahead"
    for unit_s, name in _AGES:
        if age_s >= unit_s:
            return f"{age_s // unit_s} {name}"
    return f"{max(age_s, 0)} s"


_LEVELS = ("normal", "alert", "danger")


def _state(told: Told) -> str:
    words = str(told["state"]).replace("_", " ")
    if told["state"] == "shelved" and (until_ns := told.get("shelved_until_wall_ns")):
        words += f" until {_local(until_ns)}"
    if told.get("covered"):
        words += f" (over {str(told['covered']).replace('_', ' ')})"
    if told.get("first_out") and told["state"] != "normal":
        words += ", first out"
    if told.get("chattering"):
        words += ", chattering"
    return words


def _machine(told: Told, machines: Sequence[str]) -> list[str]:
    return [told["machine"]] if machines else []


def _machine_title(events: Iterable[Told]) -> list[str]:
    """A column for the machine, where there are several."""
    return ["MACHINE"] if len({told["machine"] for told in events}) > 1 else []


def _local(wall_ns: int) -> str:
    moment = datetime.fromtimestamp(wall_ns // NS_PER_S, UTC).astimezone()
    return moment.strftime("%Y-%m-%d %H:%M:%S")


def _aligned(titles: list[str], rows: list[list[str]]) -> str:
    lines = [titles, *([_harmless(cell) for cell in row] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        _GAP.join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )


def _harmless(text: str) -> str:
    """Text that does to a terminal nothing but stand there, whoever has put what into a message."""
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)
