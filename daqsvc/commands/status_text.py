"""The answer of ``daqsvc status`` as a person reads it, in a terminal of 80 columns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.commands.tables import ago, aligned, harmless, local_time, wrapped
from daqsvc.rounding import counted, readable, with_unit

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    Document = Mapping[str, Any]

LEAST_PROBABILITY = 0.005
STATES = {"ok": "ok", "not_ok": "NOT OK", "missing": "missing", "unknown": "-"}


def status_text(status: Document, width: int = 80, *, alarms_first: bool = False) -> str:
    """The state of everything, from a `ServiceStatusPayload` by its keys in JSON.

    Args:
        status: what the service has answered.
        width: columns of the terminal.
        alarms_first: whether alarms, outbox and broker are above the rest, which a screen may not hold;
            else below, where the eye is after a command.
    """
    head = _filled(
        f"{status['machine']} ({status['site']}/{status['box']}), daqsvc {status['version']}, "
        f"running for {_age(status['uptime_s'])}",
        width,
    )
    tables, alarms = [*_tables(status, width)], [*_alarms_and_outputs(status, width)]
    return "\n\n".join([head, *alarms, *tables] if alarms_first else [head, *tables, *alarms])


def _tables(status: Document, width: int) -> Iterator[str]:
    buses = [[name, bus["driver"], bus["state"], _why(bus)] for name, bus in status["buses"].items()]
    yield aligned(["BUS", "DRIVER", "STATE", "WHY"], buses, width)
    streams = [
        [name, one["bus"], _rate(one), _age(one["age_s"]), _lost(one)]
        for name, one in status["streams"].items()
    ]
    yield aligned(["STREAM", "BUS", "RATE (Hz)", "AGE", "LOST"], streams, width)
    alone = _by_sensor(status["statements"])
    channels = [_channel(one, alone) for one in status["channels"]]
    yield aligned(["CHANNEL", "STATE", "NEWEST", "AGE", "MEASURES"], channels, width)
    others = [one for one in status["statements"] if len(one["sensors"]) != 1]
    if others:
        rows = [[one["detector"], _quality(one), _age(one["age_s"]), _finding(one)] for one in others]
        yield aligned(["DETECTOR", "QUALITY", "AGE", "FINDING"], rows, width)
    if faults := list(_faults(status["faults"])):
        yield aligned(["LOST OR FAULTY", "SINCE THE START, BY CAUSE"], faults, width)
    if others := [[name, ids] for name, ids in _other_frames(status["figures"]["buses"])]:
        yield aligned(["BUS", "FRAMES THAT NO STREAM HAS, BY ID"], others, width)
    if failures := status["figures"]["failures"]:
        yield aligned(["PART", "FAILURES"], [[name, f"{count}"] for name, count in failures.items()], width)


def _why(thing: Document) -> str:
    """Why a bus or an output is away, with the code of the reason; services of earlier versions give none."""
    reason, code = thing.get("reason", ""), thing.get("code")
    return f"{reason} [{code}]" if reason and code else f"{reason}"


def _alarms_and_outputs(status: Document, width: int) -> Iterator[str]:
    yield "\n".join(_filled(line, width) for line in (_alarms(status), _outbox(status), *_outputs(status)))
    if standing := status["alarms"]["standing"]:
        yield _standing(standing, width)


def _standing(alarms: Sequence[Document], width: int) -> str:
    """A line for each alarm, and what it reports below."""
    rows = [[one["level"], _alarm_state(one), one["alarm"], _ago(one["age_s"])] for one in alarms]
    title, *lines = aligned(["LEVEL", "STATE", "ALARM", "CHANGED"], rows).splitlines()
    shown = [title]
    for line, one in zip(lines, alarms, strict=True):
        message = one["message"].removeprefix(f"{one['alarm']} {one['level']}: ")
        shown += [line, *(f"    {part}" for part in wrapped(harmless(message), width - 4))]
    return "\n".join(shown)


def _alarm_state(alarm: Document) -> str:
    words = str(alarm["state"]).replace("_", " ")
    # Services of earlier versions do not report it.
    until_ns = alarm.get("shelved_until_wall_ns")
    return f"{words} until {local_time(until_ns)}" if until_ns and alarm["state"] == "shelved" else words


def _by_sensor(statements: Iterable[Document]) -> dict[str, list[Document]]:
    """By sensor, the statements on it alone."""
    alone: dict[str, list[Document]] = {}
    for one in statements:
        if len(one["sensors"]) == 1:
            alone.setdefault(one["sensors"][0], []).append(one)
    return alone


def _channel(channel: Document, alone: Mapping[str, Sequence[Document]]) -> list[str]:
    statements = alone.get(channel["sensor"] or "", ())
    words = [_measures(one) for one in statements if one["measures"]]
    words += [f"[{channel['reason']}]"] if channel["reason"] else []
    state = STATES[channel["state"]]
    severities = [one["severity"] for one in statements if one["severity"] != "normal"]
    return [
        channel["sensor"] or f"{channel['stream']}.{channel['channel']}",
        f"{state}, {'danger' if 'danger' in severities else 'alert'}" if severities else state,
        _figure(channel["value"], channel["unit"]) + _named(channel),
        _age(channel["age_s"]),
        " ".join(words),
    ]


def _named(channel: Document) -> str:
    """What the value of a state means; services of earlier versions do not state it."""
    return f" ({harmless(name)})" if (name := channel.get("value_name")) else ""


def _finding(statement: Document) -> str:
    likely = {name: p for name, p in statement["probabilities"].items() if p and p >= LEAST_PROBABILITY}
    parts = [f"{statement['where']}: " * bool(statement["where"]) + statement["decision"]]
    parts[0] += f" ({statement['severity']})" * (statement["severity"] != "normal")
    parts += [f"p({name}) {p:.3f}" for name, p in sorted(likely.items(), key=lambda one: -one[1])]
    parts += [_measures(statement)] if statement["measures"] else []
    parts += [f"[{statement['reason']}]"] if statement["reason"] else []
    return "; ".join(parts)


def _measures(statement: Document) -> str:
    figures = ", ".join(
        f"{name} {_figure(one['value'], one['unit'])}" for name, one in statement["measures"].items()
    )
    # Where nothing can be measured, what was measured last is shown with its own age.
    held = statement["measures_age_s"] > statement["age_s"] or statement["quality"] != "good"
    return f"{figures} ({_age(statement['measures_age_s'])} ago)" if held else figures


def _quality(statement: Document) -> str:
    return str(statement["quality"]).replace("not_ok", "NOT OK")


def _faults(faults: Document) -> Iterator[list[str]]:
    for kind, things in faults.items():
        for name, causes in things.items():
            what = name if name == kind else f"{_ONE[kind]} {name}"
            counted = [f"{cause} {count:,}" for cause, count in causes.items() if cause != "frames_unknown"]
            if counted:
                yield [what, ", ".join(counted)]


def _other_frames(buses: Document) -> Iterator[tuple[str, str]]:
    """Frames that are no faults, though they help to find one: those that no stream of the file has."""
    for name, figures in buses.items():
        ids = figures.get("unknown_ids") or {}
        if count := figures.get("frames_unknown"):
            yield name, ", ".join(f"{one} {n:,}" for one, n in ids.items()) or f"{count:,}"


_ONE = {"streams": "stream", "buses": "bus", "detectors": "detector"}


def _alarms(status: Document) -> str:
    counted = {state: count for state, count in status["alarms"]["by_state"].items() if count}
    return "alarms: " + (
        ", ".join(f"{n} {state.replace('_', ' ')}" for state, n in counted.items()) or "none"
    )


def _outbox(status: Document) -> str:
    outbox = status["outbox"]
    events = outbox["depth"] + outbox["waiting"]
    waits = "waits" if events == 1 else "wait"
    # Without a broker they wait for one that a later machine file may have.
    what = f"{waits} for the broker" if "mqtt" in status["outputs"] else "kept for a broker"
    text = "outbox: " + (f"{counted(events, 'alarm event')} {what}" if events else "nothing waits")
    if outbox["oldest_age_s"] is not None:
        text += f", the oldest for {_age(outbox['oldest_age_s'])}"
    if outbox["waiting"]:
        text += f"; {outbox['waiting']:,} of them only in memory"
    return text if outbox["journal"] == "written" else f"{text}; the journal is {outbox['journal']}"


def _outputs(status: Document) -> Iterator[str]:
    if not status["outputs"]:
        yield "broker: none is configured"
    for path, output in status["outputs"].items():
        name = "broker" if path == "mqtt" else path
        # Services of earlier versions give no reason, and no duration.
        reason, away_s = _why(output), output.get("away_s")
        lasting = "" if away_s is None else f" for {_age(away_s)}"
        if output["connected"]:
            yield f"{name}: connected"
        elif output["connected"] is not None:
            yield f"{name}: NOT CONNECTED{lasting}{f' ({reason})' * bool(reason)}"
        elif reason:
            yield f"{name}: {reason}{f' ({lasting.strip()})' * bool(lasting)}"


def _rate(stream: Document) -> str:
    return f"{_figure(stream['rate_hz'], '', 7)} of {stream['configured_rate_hz']:g}"


def _lost(stream: Document) -> str:
    lost, received = stream["samples_lost"], stream["samples_received"]
    if not lost + received:
        return "no samples yet" + (f" [{stream['doubt']}]" if stream["doubt"] else "")
    share = [f"{readable(100 * lost / (lost + received), 2)} %"] * bool(lost)
    # A service of before has no such key.
    share += ["estimated"] * (stream.get("losses") == "estimated")
    behind = f" ({', '.join(share)})" if share else ""
    doubt = f" [{stream['doubt']}]" if stream["doubt"] else ""
    return f"{lost:,} of {lost + received:,} samples{behind}{doubt}"


def _figure(value: float | None, unit: str, digits: int = 4) -> str:
    return "-" if value is None else with_unit(value, unit, digits)


def _age(age_s: float | None) -> str:
    if age_s is None:
        return "-"
    return f"{age_s:.1f} s" if age_s < 10 else ago(round(age_s * NS_PER_S))


def _ago(age_s: float | None) -> str:
    return "-" if age_s is None else f"{_age(age_s)} ago"


def _filled(text: str, width: int) -> str:
    return "\n".join(wrapped(harmless(text), width))
