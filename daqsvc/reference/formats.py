"""The page of all JSON beside messages: files, the control socket, and what verbs print.

``python -m daqsvc.reference.formats docs/schemas`` writes the JSON Schemas of it. What a program writes is of
the types that are named here, so that neither can have a field that the other has not.
"""

from __future__ import annotations

import json
import pkgutil
import re
import sys
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import daqsvc
from daqsvc.publish.schemas import PAYLOADS
from daqsvc.reference.markdown import anchored, code, page, table
from daqsvc.reference.messages import fields
from daqsvc.reference.typed import about, lacking, schema_of

if TYPE_CHECKING:
    from collections.abc import Iterator


class Format(NamedTuple):
    """JSON that is written or read.

    Attributes:
        kinds: its types, ``module:class``, if there are several any of them; with ``+`` between them one that
            has the keys of both.
        where: where it is.
        taken_in: whether the program reads it, and does with what has a default left out.
    """

    kinds: tuple[str, ...]
    where: str
    taken_in: bool = False


FORMATS: dict[str, Format] = {
    "daqsvc.control/1": Format(
        (
            "daqsvc.control:ControlRequest",
            "daqsvc.control:LiveRequest",
            "daqsvc.control:Question",
        ),
        "One line to the [control socket](../commands.md#programs) `control.sock` in the store.",
        taken_in=True,
    ),
    "daqsvc.control-answer/1": Format(
        (
            "daqsvc.control:ControlAnswer",
            "daqsvc.control:ReloadAnswer",
            "daqsvc.control:SnapshotAnswer",
            "daqsvc.control:WhichMachineAnswer",
        ),
        "One line, the answer of the control socket. The answer to `status` is "
        "[`daqsvc.service-status/1`](payloads.md#daqsvc.service-status-1), that to `live` is "
        "[`daqsvc.live/1`](formats.md#daqsvc.live-1).",
    ),
    "daqsvc.live/1": Format(
        ("daqsvc.live_feed:LiveBegin", "daqsvc.live_feed:LiveLine"),
        "Lines of the control socket after `live`, and in pieces over [MQTT](../mqtt.md#live-view).",
    ),
    "daqsvc.audit/1": Format(
        ("daqsvc.audit:AuditLine",), "Lines of the [audit log](../commands.md#the-audit-log) `audit.jsonl`."
    ),
    "daqsvc.snapshot/1": Format(
        (
            "daqsvc.recorder:SnapshotAbout",
            "daqsvc.recorder:SnapshotCause",
            "daqsvc.recorder:SnapshotWindow",
            "daqsvc.recorder:SnapshotStanding",
            "daqsvc.recorder:SnapshotState",
        ),
        "Messages in a [snapshot](../recorder.md). Those of `/alarms` are as "
        "[`daqsvc.alarm/1`](payloads.md#daqsvc.alarm-1), those of `/diagnoses` as "
        "[`daqsvc.diagnosis/1`](payloads.md#daqsvc.diagnosis-1) without the time by the wall clock; both "
        "have `at_ns`, too.",
    ),
    "daqsvc.wav/1": Format(
        ("daqsvc.recording.writers.wav:WavComment",),
        "The comment (`ICMT`) in the WAV files of [`daqsvc export`](../export.md).",
    ),
    "daqsvc.export/1": Format(("daqsvc.commands.export:Export",), ""),
    "daqsvc.trend/1": Format(("daqsvc.commands.trend:TrendLine",), ""),
    "daqsvc reload": Format(("daqsvc.commands.reload:Reloaded",), ""),
    "daqsvc snapshot": Format(("daqsvc.commands.snapshot:SnapshotTaken",), ""),
    "daqsvc ack": Format(("daqsvc.commands.alarms:AlarmVerbAnswer",), ""),
    "daqsvc replay": Format(("daqsvc.commands.replay:ReplayReport",), ""),
    "daqsvc record": Format(
        ("daqsvc.commands.record:RecordSummary+drivers.can.errors:CanCounters",),
        "Printed by `daqsvc record`.",
    ),
    "daqsvc analyze": Format(
        (
            "daqsvc.detectors.shaft.verdict:RotorVerdictJson+daqsvc.offline.other_parts:OtherParts",
            "daqsvc.offline.orders:OrderVerdictJson+daqsvc.offline.other_parts:OtherParts",
            "daqsvc.detectors.bearing.verdict:BearingVerdictJson+daqsvc.offline.other_parts:OtherParts",
            "daqsvc.fleet.campaign:CampaignJson+daqsvc.commands.analyze_fleet:WhereResults",
        ),
        "Printed by `daqsvc analyze --json`: the first of these that the machine file has a detector for, or "
        "the last one with `--cluster`.",
    ),
    "daqsvc calibrate": Format(
        (
            "daqsvc.commands.calibrate_report:RotorCalibrationJson",
            "daqsvc.commands.calibrate_report:BearingsCalibrationJson",
            "daqsvc.commands.calibrate_report:Refused",
        ),
        "",
    ),
    "daqsvc detectability": Format(
        (
            "daqsvc.detectors.rotor_bank.detectability:BankDetectabilityJson",
            "daqsvc.detectors.rotor_synchronous.detectability:VectorDetectabilityJson",
        ),
        "",
    ),
    "daqsvc fleet": Format(("daqsvc.fleet.report:FleetReportJson",), ""),
    "daqsvc demo": Format(
        (
            "sim_hw.demo.session:DemoPage",
            "sim_hw.demo.session:DemoMessage",
            "sim_hw.demo.session:DemoSummary",
        ),
        "",
    ),
    "daqsvc sim": Format(
        (
            "sim_hw.sim_command:SimSummary",
            "sim_hw.bus_socket:BusAddress+sim_hw.bus_socket_hub:HubCounters",
        ),
        "Printed by `daqsvc sim` at the end.",
    ),
    "daqsvc reproduce": Format(("sim_hw.reproduce.results:ResultRow",), ""),
    "daqsvc sniff can": Format(("drivers.can.sniff_json:CanFigures+daqsvc.commands.sniff:SniffEnd",), ""),
    "daqsvc sniff serial": Format(
        ("drivers.serial.sniff_json:SerialFigures+daqsvc.commands.sniff:SniffEnd",), ""
    ),
    "daqsvc sniff modbus": Format(
        ("drivers.modbus.scan_json:ModbusFigures+daqsvc.commands.sniff:SniffEnd",), ""
    ),
}
"""By the value of ``schema``, or by the verb that prints it."""
PRINTED: dict[str, tuple[str, ...]] = {
    "daqsvc alarms": ("daqsvc.alarm/1",),
    "daqsvc trend": ("daqsvc.trend/1",),
    "daqsvc trend --events": ("daqsvc.alarm/1",),
    "daqsvc status": ("daqsvc.service-status/1",),
    "daqsvc export": ("daqsvc.export/1",),
    **dict.fromkeys(
        ("daqsvc reset", "daqsvc shelve", "daqsvc unshelve", "daqsvc bypass", "daqsvc unbypass"),
        ("daqsvc ack",),
    ),
}
"""By verb the formats of ``--json``, where they are not called by the verb; and of other options."""
_NAMED = re.compile(r"daqsvc\.[a-z-]+/[0-9]+")


def printed(verb: str, option: str = "--json") -> tuple[str, ...]:
    """The formats that a verb prints with an option; none if it is not known."""
    if option != "--json":
        return PRINTED.get(f"{verb} {option}", ())
    return PRINTED.get(verb, (verb,) if verb in FORMATS else ())


def slug(name: str) -> str:
    """The name of a format as it is in addresses and names of files."""
    return re.sub(r"[/ ]", "-", name)


def link(name: str) -> str:
    """A link to a format, from a page of the reference."""
    where = "payloads.md" if name in PAYLOADS else "formats.md"
    return f"[`{name}`]({where}#{slug(name)})"


@cache
def types(name: str) -> tuple[tuple[type[Any], ...], ...]:
    """The types of a format, each with others whose keys it has, too."""
    return tuple(
        tuple(pkgutil.resolve_name(kind) for kind in joined.split("+")) for joined in FORMATS[name].kinds
    )


@cache
def schemas() -> dict[str, dict[str, Any]]:
    """The JSON Schema (2020-12) of every format."""
    return {name: schema_of(name, types(name), taken_in=one.taken_in) for name, one in FORMATS.items()}


def schema_files() -> dict[str, str]:
    """Name and text of each schema file."""
    return {f"{slug(name)}.json": json.dumps(schema, indent=2) + "\n" for name, schema in schemas().items()}


def named_in_code() -> set[str]:
    """Every value of a ``schema`` key that is in the code."""
    package = Path(f"{daqsvc.__file__}").parent
    texts = (file.read_text(encoding="utf-8") for file in package.rglob("*.py"))
    return {name for text in texts for name in _NAMED.findall(text)}


def gaps() -> Iterator[str]:
    """Formats and fields that nothing describes."""
    for name in sorted(named_in_code() - {*FORMATS, *PAYLOADS}):
        yield f"format {name} is described nowhere: daqsvc.reference.formats"
    for name, schema in schemas().items():
        for field in lacking(schema):
            yield f"field {field} of {name} has no description: {', '.join(FORMATS[name].kinds)}"


def pages() -> dict[str, str]:
    """Text of each page, by file name."""
    parts = []
    for name, one in FORMATS.items():
        schema = schemas()[name]
        verbs = [verb for verb in [*PRINTED, name] if name in printed(verb)]
        where = one.where or f"Printed by {_listed([f'{verb} --json' for verb in sorted(verbs)])}."
        parts.append(anchored(f"## `{name}`", slug(name)))
        parts.append(f"{where} [JSON Schema](../schemas/{slug(name)}.json).")
        for kind, *_ in types(name):
            held = schema["$defs"][kind.__name__] if "anyOf" in schema else schema
            anchor = f"{slug(name)}.{kind.__name__}" if "anyOf" in schema else slug(name)
            parts.append(about(kind))
            rows = [
                (f'<a id="{anchor}.{path.replace("[]", "")}"></a>{code(path)}', what, words)
                for path, what, words in fields({**held, "$defs": schema.get("$defs", {})}, short=SHORT)
            ]
            parts.append(table(("field", "type", "what it is"), rows))
    return {"formats.md": page("JSON in files, on the control socket and of --json", _ABOUT, *parts)}


def _listed(verbs: list[str]) -> str:
    *others, last = map(code, verbs)
    return f"{', '.join(others)} and {last}" if others else last


SHORT = {
    "BearingVerdictJson": "object as the verdict about the bearings below",
    "AlarmPayload": "object as [`daqsvc.alarm/1`](payloads.md#daqsvc.alarm-1)",
    "Statement": "object as [`daqsvc.diagnosis/1`](payloads.md#daqsvc.diagnosis-1), without `schema`, "
    "`site`, `box`, `time` and `wall_ns`",
}
"""What is not listed again, by title."""

_ABOUT = """Every field of the JSON that daqsvc writes or reads beside MQTT messages, which are in
[payloads.md](payloads.md). A field is named by its path, with dots; `[]` means each entry of a list, `NAME`
for a name. Where a format has a `schema` with its name and version, fields may be added within a version:
ignore what you do not know. What has no `schema` is named by the verb that prints it. What the page sends
to its own scripts in a browser is no interface, and not listed."""


def main(arguments: list[str]) -> int:
    """Write the schemas into the directory that is named."""
    for name, text in schema_files().items():
        (Path(arguments[0]) / name).write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
