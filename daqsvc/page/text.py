"""The state of a machine, in HTML that is put into the page as it is."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from daqsvc.acquisition.clock import NS_PER_S, iso_utc
from daqsvc.page.views.modes import in_words
from daqsvc.rounding import with_unit

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from daqsvc.page.machine_live import MachineLive

    Document = dict[str, Any]

BETWEEN = ":"
"""Between site, box and machine in the name that a machine of a plant has."""
COVERED = {"shelved", "suppressed", "out_of_service"}
MOST_EVENTS = 50
WORST = {"danger": 2, "alert": 1}
STATES = {
    "active_unacknowledged": "active, not acknowledged",
    "active_acknowledged": "active, acknowledged",
    "returned_unacknowledged": "returned, not acknowledged",
    "latched_unacknowledged": "latched, not acknowledged",
    "latched_acknowledged": "latched, acknowledged",
    "shelved": "shelved",
    "suppressed": "suppressed",
    "out_of_service": "out of service",
}
"""States of alarms (ISA-18.2) but normal."""


def standing(live: MachineLive) -> list[Document]:
    """The alarms that are not normal, the worst and newest first."""
    alarms = [one for one in [*live.alarms.values()] if one["state"] != "normal"]
    return sorted(alarms, key=lambda one: (-WORST.get(one["level"], 0), -one["monotonic_ns"]))


def level_of(standing_alarms: Iterable[Document]) -> str:
    """The worst level of alarms that no person and no sensor has covered."""
    levels = [one["level"] for one in standing_alarms if one["state"] not in COVERED]
    return max(levels, key=lambda level: WORST.get(level, 0), default="normal")


def tile(status: Document) -> Document:
    """A machine in short, by its `daqsvc.publish.service_status`."""
    alarms = status["alarms"]["standing"]
    entries = [
        {"alarm": one["alarm"], "first": one.get("first_out", False), "why": one["message"]} for one in alarms
    ]
    level, away = level_of(alarms), status.get("away", "")
    # What may have changed since reports stopped is not normal.
    level = "unknown" if away and level == "normal" else level
    name = str(status["machine"])
    title = name.rpartition(BETWEEN)[2] or status.get("place", "")
    place = status.get("place", "") if name else ""
    return {"name": name, "title": title, "place": place, "level": level, "alarms": entries, "away": away}


def head(live: MachineLive) -> str:
    """One line: the machine, its worst level, its speed."""
    level = level_of(standing(live))
    description = live.values["machine"].get("description", "")
    return (
        f'<span class="level {escape(level)}">{escape(level)}</span> '
        f"<span>{live.speed_in_words}</span> <span>{escape(description)}</span>"
        f"<span>{escape(live.note)}</span>"
    )


def alarm_rows(live: MachineLive) -> str:
    """The standing alarms as rows of a table."""
    rows = [
        row(
            level_mark(one["level"]),
            escape(one["alarm"]) + (' <span class="first">first</span>' if one["first_out"] else ""),
            escape(STATES.get(str(one["state"]), str(one["state"]))),
            time_mark(one["wall_ns"]),
            escape(live.message_of(one)),
        )
        for one in standing(live)
    ]
    return "".join(rows) or '<tr><td colspan="5">No alarm is active.</td></tr>'


def alarm_list(known: Mapping[str, Document | None], machine: str) -> str:
    """Alarms as rows of a table: those that want a person first, then by level.

    Args:
        known: by its name the last event of each; None if it never had one.
        machine: the machine's name in addresses.
    """
    there = f"/machines/{quote(machine, safe='')}/alarms?alarm="
    return "".join(
        row(
            level_mark("normal" if one is None else one["level"]),
            f'<a href="{there}{quote(name, safe="")}">{escape(name)}</a>' + _first(one),
            escape(_state(one)),
            "" if one is None else time_mark(one["wall_ns"]),
            "" if one is None else _stands(one),
        )
        for name, one in sorted(known.items(), key=lambda item: _urgency(item[1]))
    )


def _urgency(alarm: Document | None) -> tuple[int, int, int]:
    """The place of an alarm in the list: the smaller, the sooner."""
    if alarm is None:
        return 4, 0, 0
    state = str(alarm["state"])
    if state in COVERED:
        group = 2
    elif state == "normal":
        group = 3
    else:
        group = 0 if state.endswith("_unacknowledged") else 1
    return group, -WORST.get(alarm["level"], 0), -int(alarm["monotonic_ns"])


def _first(alarm: Document | None) -> str:
    return ' <span class="first">first</span>' if alarm is not None and alarm["first_out"] else ""


def _stands(latest: Document) -> str:
    """What was found last, and what was done about it since, by the last event of an alarm."""
    finding = str(latest.get("found_message", ""))
    return f"{escape(finding)}; {_what(latest)}" if finding else _what(latest)


def _what(event: Document) -> str:
    """What was found, or who did it and why; the message of most events states that already."""
    message = str(event["message"])
    others = (event["by"], event["reason"])
    return escape(": ".join([message, *(str(one) for one in others if one and str(one) not in message)]))


def _state(alarm: Document | None) -> str:
    """The state of an alarm, with what covers it."""
    if alarm is None or alarm["state"] == "normal":
        return "normal"
    words = [STATES.get(str(alarm["state"]), str(alarm["state"]))]
    if alarm.get("covered"):
        words.append(f"below: {STATES.get(str(alarm['covered']), str(alarm['covered']))}")
    if (until_ns := alarm.get("shelved_until_wall_ns")) is not None:
        words.append(f"until {iso_utc(until_ns // NS_PER_S * NS_PER_S)}")
    if alarm.get("chattering"):
        words.append("chatters")
    return "; ".join(words)


def level_mark(level: str) -> str:
    """A level with its colour."""
    return f'<span class="level {escape(level)}">{escape(level)}</span>'


def journal_rows(live: MachineLive) -> str:
    """What has happened to alarms since the page looks, and the last event of each before; newest first."""
    return event_rows([*live.journal][: -MOST_EVENTS - 1 : -1])


def event_rows(events: Iterable[Document]) -> str:
    """Alarm events as rows of a table."""
    rows = [
        row(
            time_mark(one["wall_ns"]),
            escape(one["alarm"]),
            escape(one["kind"]),
            level_mark(one["level"]),
            _what(one),
        )
        for one in events
    ]
    return "".join(rows) or '<tr><td colspan="5">Nothing has happened.</td></tr>'


def machine_rows(live: MachineLive) -> str:
    """What each detector reports, and what each channel measures."""
    rows = []
    for one in sorted([*live.latest.values()], key=lambda statement: str(statement["detector"])):
        figures = ", ".join(
            f"{name} {with_unit(value, one['units'].get(name, ''))}"
            for name, value in one["statistics"].items()
            if value is not None and "." not in name
        )
        likely = sorted(one["probabilities"].items(), key=lambda mode: -(mode[1] or 0.0))[:3]
        odds = ", ".join(f"p({mode}) {in_words(p)}" for mode, p in likely)
        decision = one["decision"] if not one["reason"] else f"{one['decision']}: {one['reason']}"
        rows.append(
            row(
                escape(str(one["detector"])),
                f'<span class="level {escape(one["severity"])}">{escape(decision)}</span>',
                escape("; ".join(filter(None, (odds, figures)))),
                time_mark(live.wall_ns_at_0 + int(one["monotonic_ns"])),
                escape(one["quality"]),
            )
        )
    return "".join(rows) or '<tr><td colspan="5">No detector has stated anything yet.</td></tr>'


def row(*cells: str) -> str:
    """Cells of HTML as a row of a table."""
    return f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"


def time_mark(wall_ns: int) -> str:
    """A time that the browser shows in its own zone; UTC is beside it."""
    utc = iso_utc(wall_ns // NS_PER_S * NS_PER_S)
    return f'<time datetime="{utc}" title="{utc}">{utc}</time>'
