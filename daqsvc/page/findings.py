"""What is wrong with a machine, how sure that is, since when, and what to do: in sentences.

The next steps are those of trade practice (ISO 13373-3:2015, guidelines for vibration diagnosis). They state
what to look at, and never that it is safe to go on: that decides a person who knows the machine.
"""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any, NamedTuple

from daqsvc.dsp.phase import deviation_deg
from daqsvc.page.text import level_mark, row, time_mark
from daqsvc.page.views.modes import in_words
from daqsvc.rounding import with_unit

if TYPE_CHECKING:
    from daqsvc.page.machine_live import MachineLive

    Document = dict[str, Any]


class Fault(NamedTuple):
    """A fault in the trade's words.

    Attributes:
        name: the same.
        next_step: what to look at; ``{views}`` is replaced by what the page can show of its sensors.
    """

    name: str
    next_step: str


FAULTS = {
    "unbalance": Fault(
        "unbalance",
        "Compare 1X with the last balancing report; look for deposits, a lost part or a bent shaft, and "
        "balance at the next stop.",
    ),
    "static_load": Fault(
        "a static load",
        "Look at the alignment, the process load and the temperatures of the bearings: something pushes the "
        "shaft to one side.",
    ),
    "damping_loss": Fault(
        "loss of damping",
        "Look at oil pressure, temperature and viscosity, and at the bearing clearance; keep away from the "
        "critical speed.",
    ),
    "stiffness_loss": Fault(
        "loss of stiffness",
        "Look at foundation bolts, pedestals and bearing supports; at the next stop look for a cracked "
        "shaft.",
    ),
    "rub": Fault(
        "rub",
        "Look at the orbit for a flattened side and at harmonics; reduce speed or load if the process "
        "allows, and look at seals, clearances and alignment.",
    ),
    "inner": Fault(
        "damage of the inner race", "Look at the envelope spectrum at BPFI; plan to replace the bearing."
    ),
    "outer": Fault(
        "damage of the outer race",
        "Look at the envelope spectrum at BPFO and at the lubrication; plan to replace the bearing.",
    ),
    "ball": Fault("damage of a ball", "Look at the envelope spectrum at 2 BSF; plan to replace the bearing."),
    "inner_or_outer": Fault(
        "damage of a race", "Look at the envelope spectrum at BPFI and BPFO; plan to replace the bearing."
    ),
    "unmodelled": Fault(
        "a change that no fault of the model explains",
        "Look at {views}, and at what was changed on the machine recently.",
    ),
    "changed": Fault(
        "a change that names no part", "Look at the spectra beside those of the healthy machine."
    ),
    "small_change": Fault("a small change", "Nothing yet: look whether it grows."),
    "alert": Fault("a value beyond its alert limit", "Look at {views} for what it is."),
    "danger": Fault(
        "a value beyond its danger limit",
        "Decide now whether the machine may go on; look at {views} for what it is.",
    ),
}
"""By what detectors state, in their words."""
MOST_NAMED = 5
"""Sensors that a sentence names at most."""
SOUND = {"normal", "undetermined"}


def finding_rows(live: MachineLive) -> str:
    """What each detector finds that is not as it should be, as rows of a table; the worst first."""
    findings = [one for one in [*live.latest.values()] if _is_finding(live, one)]
    worst = {"danger": 0, "alert": 1}
    findings.sort(key=lambda one: (worst.get(one["severity"], 2), str(one["detector"])))
    rows = [_row_of(live, one) for one in findings]
    if rows:
        return "".join(rows)
    heard = len(live.latest)
    sentence = "No detector finds a fault." if heard else "No detector has stated anything yet."
    return f'<tr><td colspan="4">{escape(sentence + _unjudged(live))}</td></tr>'


def _unjudged(live: MachineLive) -> str:
    """What to know besides: that sensors are not OK, by which nothing is found."""
    bad = {sensor for one in [*live.latest.values()] if one["quality"] != "good" for sensor in one["sensors"]}
    if not bad:
        return ""
    names = sorted(bad)
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    verb = "is" if len(names) == 1 else "are"
    return f" But {', '.join(names[:MOST_NAMED])}{more} {verb} not OK or missing: nothing is found by that."


def sentence(live: MachineLive, statement: Document) -> str:
    """What a detector finds, in a sentence: the fault, what it is not told apart from, how sure, by what."""
    detector, decision = str(statement["detector"]), str(statement["decision"])
    name = _named(live, detector, decision)
    where = f" at {statement['where']}" if statement.get("where") else ""
    text = f"{detector} finds {name}{where}"
    others = [_named(live, detector, one) for one in statement.get("group", ()) if one != decision]
    others = [one for one in dict.fromkeys(others) if one != name]
    if others:
        text += f", not told apart from {' and '.join(others)}"
    group = {decision, *statement.get("group", ())}
    probabilities = {mode: p for mode, p in statement["probabilities"].items() if p is not None}
    if decision in probabilities:
        text += f", p {in_words(probabilities[decision])}"
        if others:
            text += f" (all of these {in_words(sum(probabilities.get(one, 0.0) for one in group))})"
    if evidence := _evidence(statement, group):
        text += f"; {evidence}"
    if statement["quality"] != "good":
        text += f". That is held from before: {statement['reason'] or statement['quality']}"
    return f"{text}."


def _evidence(statement: Document, group: set[str]) -> str:
    """The evidence for it: the least lead over what is excluded, or the value that is beyond its limit."""
    leads = {
        name.removeprefix("lead."): nats
        for name, nats in statement.get("evidence", {}).items()
        if name.startswith("lead.") and nats is not None
    }
    excluded = {name: nats for name, nats in leads.items() if name not in group}
    if excluded:
        nearest = min(excluded, key=lambda name: excluded[name])
        return f"evidence {excluded[nearest]:.1f} nats over the next, {nearest}"
    beyond = []
    for name, limit in statement.get("thresholds", {}).items():
        measure, _, which = name.rpartition(".")
        value = statement["statistics"].get(measure)
        reference = statement["thresholds"].get(f"{measure}.reference")
        if value is not None and reference is not None:
            value = deviation_deg(value, reference)
        if which == statement["severity"] and value is not None and limit is not None and value >= limit:
            unit = statement["units"].get(measure, "")
            off = "" if reference is None else " off its reference"
            beyond.append(
                f"{measure} is {with_unit(value, unit)}{off}, {which} limit {with_unit(limit, unit)}"
            )
    return ", ".join(beyond)


def _is_finding(live: MachineLive, statement: Document) -> bool:
    fault = live.fault_of(str(statement["detector"]), str(statement["decision"]))
    return bool(statement["severity"] != "normal") or (fault not in SOUND and fault in FAULTS)


def _named(live: MachineLive, detector: str, decision: str) -> str:
    fault = live.fault_of(detector, decision)
    known = FAULTS.get(fault)
    if known is None:
        return "the healthy machine" if fault == "normal" else decision
    return known.name if fault == decision else f"{known.name} ({decision})"


def _next_step(live: MachineLive, statement: Document) -> str:
    """What to look at, of what there is: a value that a device has measured itself has no spectrum."""
    known = FAULTS.get(live.fault_of(str(statement["detector"]), str(statement["decision"])))
    if known is None:
        return "Look at its figures below."
    about = {*statement.get("sensors", ())} or {*live.vibration_sensors()}
    views = ["its trend"]
    if about & {*live.waveform_sensors()}:
        views.append("its spectrum")
    if any(about & {*pair} for pair in live.probes()):
        views.append("the orbit")
    *others, last = views
    return known.next_step.format(views=f"{', '.join(others)} and {last}" if others else last)


def _row_of(live: MachineLive, statement: Document) -> str:
    detector = str(statement["detector"])
    decided = live.decided[detector]
    since = time_mark(live.wall_ns_at_0 + decided.since_ns)
    return row(
        escape(sentence(live, statement)),
        level_mark(str(statement["severity"])),
        since if decided.is_seen else f"before {since}",
        escape(_next_step(live, statement)),
    )
