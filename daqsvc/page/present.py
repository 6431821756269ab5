"""The present values of a machine: what each sensor measures, its limits, and whether it is OK."""

from __future__ import annotations

from bisect import bisect_right
from html import escape
from typing import TYPE_CHECKING, Any

from daqsvc.dsp.phase import deviation_deg
from daqsvc.page.text import level_mark, row, time_mark
from daqsvc.rounding import counted_are, readable, with_unit

if TYPE_CHECKING:
    from daqsvc.page.machine_live import MachineLive

    Document = dict[str, Any]

MOST_ROWS = 500
LIMITS = ("alert", "danger")
ZONES = ("zone_b", "zone_c", "zone_d")
"""Thresholds at which the zones of a standard begin."""
OK = {"good": "OK", "not_ok": "not OK", "missing": "missing"}
"""By the quality of a statement, what a person reads of the sensors behind it."""
WORST_FIRST = ("not_ok", "missing", "good")


def value_rows(live: MachineLive) -> str:
    """What each sensor measures, with its limits and its OK state, as rows of a table."""
    statements: dict[str, list[Document]] = {name: [] for name in live.sensors}
    for one in [*live.latest.values()]:
        for name in one["sensors"]:
            statements.setdefault(name, []).append(one)
    rows = [_row_of(live, name, about) for name, about in [*statements.items()][:MOST_ROWS]]
    if (more := len(statements) - MOST_ROWS) > 0:
        rows.append(f'<tr><td colspan="5">{counted_are(more, "more sensor")} not listed.</td></tr>')
    return "".join(rows) or '<tr><td colspan="5">No sensor has reported yet.</td></tr>'


def _row_of(live: MachineLive, sensor: str, statements: list[Document]) -> str:
    if not statements:
        return row(escape(sensor), "no detector measures it", "", "unknown", "")
    own = [one for one in statements if len(one["sensors"]) == 1]
    values = "<br>".join(escape(value) for one in own for value in _values(one))
    levels = [str(one["severity"]) for one in own]
    level = next((one for one in ("danger", "alert") if one in levels), "normal")
    # Where nothing can be measured, nothing is within its limits; what was worse before is held.
    is_judged = bool(values) or level != "normal" or any(one["quality"] == "good" for one in own)
    worst = min(statements, key=lambda one: WORST_FIRST.index(one["quality"]))
    state = OK[worst["quality"]] + (f": {worst['reason']}" if worst["reason"] else "")
    newest_ns = max(int(one["monotonic_ns"]) for one in statements)
    return row(
        escape(sensor),
        values or ("no value" if own else "see the detectors below"),
        level_mark(level) if own and is_judged else "",
        escape(state),
        time_mark(live.wall_ns_at_0 + newest_ns),
    )


def _values(statement: Document) -> list[str]:
    """Each figure of a statement with its unit and its limits."""
    texts = []
    for name, value in statement["statistics"].items():
        if value is None or "." in name:
            continue
        unit = statement["units"].get(name, "")
        thresholds = statement["thresholds"]
        limits = {which: thresholds.get(f"{name}.{which}") for which in LIMITS}
        known = [f"{which} {readable(limit)}" for which, limit in limits.items() if limit is not None]
        if (reference := thresholds.get(f"{name}.reference")) is not None:
            known.insert(0, f"{readable(deviation_deg(value, reference))} {unit} from {readable(reference)}")
        begins = [at for which in ZONES if (at := thresholds.get(f"{name}.{which}")) is not None]
        if len(begins) == len(ZONES):
            known.insert(0, f"zone {'ABCD'[bisect_right(begins, value)]} of ISO 20816-3")
        texts.append(f"{name} {with_unit(value, unit)}" + (f" ({', '.join(known)})" if known else ""))
    return texts
