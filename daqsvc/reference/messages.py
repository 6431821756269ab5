"""Pages of what goes over the broker: topics, fields of payloads, Home Assistant, Sparkplug."""

from __future__ import annotations

import json
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from daqsvc.diagnosis.reading import Reading
from daqsvc.publish.home_assistant.discovery import Discovery
from daqsvc.publish.home_assistant.settings import HomeAssistant
from daqsvc.publish.mqtt.settings import MqttCommands
from daqsvc.publish.output import Watched
from daqsvc.publish.schemas import PAYLOADS, json_schemas
from daqsvc.publish.sparkplug.host import PrimaryHost
from daqsvc.publish.sparkplug.metrics import declared, node_properties, quiet_alarm
from daqsvc.publish.sparkplug.node import BDSEQ, REBIRTH, EdgeNode
from daqsvc.publish.topics import ANSWER, Topics
from daqsvc.reference import figures
from daqsvc.reference.markdown import anchored, code, page, table

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from daqsvc.publish.sparkplug.codec import Metric

_BOX = Topics("ROOT", "SITE", "BOX")
_STATE = Reading("DETECTOR", "statistics", "FIGURE", "um")
_MODE = Reading("DETECTOR", "probabilities", "MODE")


class Topic(NamedTuple):
    """A topic of the box.

    Attributes:
        topic: with words in capitals for names.
        schema: of what goes there; in words for what is no JSON object of daqsvc.
        qos: quality of service.
        retained: whether the broker keeps the latest.
        about: what goes there, and who sends it.
    """

    topic: str
    schema: str
    qos: int
    retained: str
    about: str


def topics() -> dict[str, Topic]:
    """Every topic, by the attribute of `Topics` that makes it."""
    command = _BOX.command("MACHINE", "VERB")
    return {
        "availability": Topic(
            _BOX.availability,
            "daqsvc.availability/1",
            1,
            "yes",
            "whether the box is online; also its last will",
        ),
        "status": Topic(_BOX.status, "daqsvc.status/1", 1, "no", "figures of the service, each second"),
        "alarm": Topic(
            _BOX.alarm("MACHINE", "ALARM"), "daqsvc.alarm/1", 1, "yes", "every event of one alarm, in order"
        ),
        "diagnosis": Topic(
            _BOX.diagnosis("MACHINE", "DETECTOR"),
            "daqsvc.diagnosis/1",
            1,
            "no",
            "every statement of one detector",
        ),
        "readings": Topic(
            _BOX.readings("MACHINE", "DETECTOR"),
            "daqsvc.readings/1",
            1,
            "no",
            "rounded figures of one detector, now and then; with `[mqtt.home_assistant]` only",
        ),
        "summary": Topic(
            _BOX.summary("MACHINE"),
            "daqsvc.summary/1",
            1,
            "yes",
            "the states of all alarms of a machine; with `[mqtt.home_assistant]` only",
        ),
        "command": Topic(
            command, "daqsvc.command/1", 1, "never", "to the box: a command to an alarm, named by `VERB`"
        ),
        "snapshot": Topic(
            _BOX.command("MACHINE", "snapshot"),
            "daqsvc.snapshot-command/1",
            1,
            "never",
            "to the box: make a snapshot now",
        ),
        "response": Topic(
            f"{command}/{ANSWER}", "daqsvc.response/1", 1, "no", "from the box: what came of a command"
        ),
        "live_request": Topic(
            _BOX.live_request("MACHINE", "VIEWER"),
            "daqsvc.live-request/1",
            1,
            "never",
            "to the box: a request for waveforms; with `[mqtt.live]` only",
        ),
        "live_feed": Topic(
            _BOX.live_feed("MACHINE", "VIEWER"),
            "pieces",
            1,
            "no",
            "from the box: waveforms, statements and alarms in pieces, while the lease lasts",
        ),
    }


def other_topics() -> dict[str, Topic]:
    """Topics of Home Assistant and of Sparkplug, by the name of what goes there."""
    discovery = Discovery(HomeAssistant(prefix="PREFIX"), MqttCommands(), Watched("MACHINE"), _BOX)
    # The id is made of ROOT, SITE, BOX and MACHINE.
    discovery_topic = f"{discovery.topic.rpartition('/device/')[0]}/device/ID/config"
    node, host = EdgeNode("GROUP", "NODE"), PrimaryHost("HOST")
    node_births = node.births(0, 0, (), {"DEVICE": ()})
    sent = [
        *node_births,
        node.data(None, 0, ()),
        node.data("DEVICE", 0, ()),
        node.device_death("DEVICE", 0),
        node.will(0, 0),
    ]
    by_kind = {one.topic.split("/")[2]: one for one in sent}
    entities, metrics = "[entities](home-assistant.md)", "[metrics](sparkplug.md)"
    rows = {
        "discovery": Topic(
            discovery_topic, entities, 1, "yes", "the machine as a device, with all its entities"
        ),
        "birth": Topic(
            discovery.birth_topic,
            "`online`",
            1,
            "as set there",
            "to the box: Home Assistant has started, so all is sent again",
        ),
    }
    rows |= {
        kind: Topic(one.topic, metrics, one.qos, "no", _SPARKPLUG_ABOUT[kind])
        for kind, one in by_kind.items()
    }
    for topic in (node.commands, node.command_topic("DEVICE")):
        kind = topic.split("/")[2]
        rows[kind] = Topic(topic, metrics, 1, "never", _SPARKPLUG_ABOUT[kind])
    for number, topic in enumerate(host.topics):
        version = "2.2" if number else "3.0"
        state = "`ONLINE` or `OFFLINE`" if number else "`online` and `timestamp`, as JSON"
        about = f"to the box: whether the `primary_host` is there, as of Sparkplug {version}"
        rows["STATE-2.2" if number else "STATE"] = Topic(topic, state, 1, "by the host", about)
    return rows


_SPARKPLUG_ABOUT = {
    "NBIRTH": "all metrics of the node: the box and its alarms, with names and values",
    "DBIRTH": "all metrics of a device: the machine, with names and values",
    "NDATA": "metrics of the node that have changed: every alarm event",
    "DDATA": "metrics of the device that have changed",
    "DDEATH": "the machine cannot be reached",
    "NDEATH": "the session of the node has ended; its last will",
    "NCMD": "to the box: a host writes metrics of the node",
    "DCMD": "to the box: a host writes metrics of the device",
}


_OVER_THE_SOCKET = "daqsvc.service-status/1"
"""Printed by ``daqsvc status --json``, and no message."""


class Field(NamedTuple):
    """A field of a payload.

    Attributes:
        path: its name, with those of what contains it.
        kind: its type in words.
        about: what it is.
    """

    path: str
    kind: str
    about: str


def fields(schema: Mapping[str, Any], short: Mapping[str, str] | None = None) -> Iterator[Field]:
    """Every field of a payload, from its JSON Schema.

    Args:
        schema: of the payload.
        short: by title, words for the type of objects whose fields are listed elsewhere.
    """
    definitions, short = schema.get("$defs", {}), short or {}

    def solved(one: Mapping[str, Any]) -> Mapping[str, Any]:
        return definitions[one["$ref"].rpartition("/")[2]] if "$ref" in one else one

    def walk(below: Mapping[str, Any], path: str, within: tuple[str, ...]) -> Iterator[Field]:
        for name, declared_at in below.get("properties", {}).items():
            one = solved(declared_at)
            about = declared_at.get("description") or ""
            yield Field(f"{path}{name}", _kind(declared_at, definitions, short=short), about)
            yield from deeper(one, f"{path}{name}", within)

    def deeper(one: Mapping[str, Any], path: str, within: tuple[str, ...]) -> Iterator[Field]:
        title = one.get("title", "")
        if title in within or title in short:
            return
        inside = (*within, title) if title else within
        if "properties" in one:
            yield from walk(one, f"{path}.", inside)
        if isinstance(items := one.get("items"), dict):
            yield from deeper(solved(items), f"{path}[]", inside)
        if isinstance(values := one.get("additionalProperties"), dict):
            yield from deeper(solved(values), f"{path}.NAME", inside)
        for arm in one.get("anyOf", ()):
            yield from deeper(solved(arm), path, inside)

    return walk(schema, "", ())


def _kind(
    one: Mapping[str, Any],
    definitions: Mapping[str, Any],
    within: tuple[str, ...] = (),
    short: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """The type of a field in words.

    Args:
        one: its schema.
        definitions: what a ``$ref`` leads to.
        within: those that lead here: what holds its own kind is a group of groups.
        short: words for objects, by title.
    """

    def of(other: Mapping[str, Any], *names: str) -> str:
        return _kind(other, definitions, (*within, *names), short)

    if "$ref" in one:
        name = one["$ref"].rpartition("/")[2]
        return "a group of these" if name in within else short.get(name) or of(definitions[name], name)
    if "const" in one:
        return code(json.dumps(one["const"]))
    if "enum" in one:
        return "one of " + ", ".join(code(f'"{value}"') for value in one["enum"])
    if "anyOf" in one:
        return " or ".join(dict.fromkeys(of(arm) for arm in one["anyOf"]))
    kind, values = one.get("type"), one.get("additionalProperties")
    words = _KINDS.get(f"{kind}", "any value")
    if kind == "array":
        each = one.get("prefixItems") or [one.get("items", {})]
        words = f"list, of each: {of(each[0])}"
    elif kind == "object" and isinstance(values, dict):
        words = f"by name, each: {of(values)}"
    return words


_KINDS = {
    "integer": "whole number",
    "number": "number",
    "string": "text",
    "boolean": "`true` or `false`",
    "object": "object",
    "null": "null",
}


def discovery() -> Mapping[str, Mapping[str, Any]]:
    """The entities of a machine in Home Assistant."""
    watched = Watched(
        "MACHINE", alarms=("ALARM",), services=("SERVICE",), readings=(_STATE, _MODE), findings=("DETECTOR",)
    )
    commands = MqttCommands(enabled=True, allow=("acknowledge", "reset"))
    components: Mapping[str, Mapping[str, Any]] = Discovery(
        HomeAssistant(), commands, watched, _BOX
    ).payload()["components"]
    return components


def sparkplug() -> list[tuple[str, Metric]]:
    """The metrics of the edge node and of its device, each with its owner."""
    node = [*node_properties("VERSION", "SITE", "BOX"), *quiet_alarm("MACHINE", "ALARM")]
    return [*(("node", one) for one in node), *(("device", one) for one in declared([_STATE, _MODE]))]


SPARKPLUG_WORDS: Mapping[str, str] = {
    "Properties/Software": "name and version of the program",
    "Properties/Site": "the site, as the machine file names it",
    "Properties/Box": "the box, as the machine file names it",
    "Alarms/MACHINE/ALARM/State": "state of the alarm, as `state` of `daqsvc.alarm/1`",
    "Alarms/MACHINE/ALARM/Level": "0 normal, 1 alert, 2 danger",
    "Alarms/MACHINE/ALARM/Active": "whether the condition is present, also below what covers the alarm",
    "Alarms/MACHINE/ALARM/Acknowledged": "whether somebody has seen it",
    "Alarms/MACHINE/ALARM/Message": "the latest event in a sentence",
    "Alarms/MACHINE/ALARM/Occurrence": "id of the activation",
    "Alarms/MACHINE/ALARM/Event": "id of the latest event: drop repeats by it",
    "DETECTOR/Decision": "what the detector has decided",
    "DETECTOR/Severity": "how bad that is",
    "DETECTOR/Quality": "whether samples and sensors are good",
    "DETECTOR/Group": "modes that the evidence cannot tell apart",
    "DETECTOR/FIGURE": "a figure of the detector; its unit is the property `engUnit`",
    "DETECTOR/Probability/MODE": "probability of a mode",
}
_WRITTEN: tuple[tuple[str, str, str, str], ...] = (
    (BDSEQ, "node", "INT64", "number of the session, as Sparkplug asks"),
    (REBIRTH, "node", "BOOLEAN", "write true for new births"),
    (
        "Alarms/MACHINE/ALARM/Acknowledge",
        "node",
        "BOOLEAN",
        "write true to acknowledge, where that is allowed",
    ),
    ("Alarms/MACHINE/ALARM/Reset", "node", "BOOLEAN", "write true to reset, where that is allowed"),
    ("Alarms/ALARM/Acknowledge", "device", "BOOLEAN", "the same, for hosts that write to devices"),
    ("Alarms/ALARM/Reset", "device", "BOOLEAN", "the same, for hosts that write to devices"),
)
"""What has no present value of its own, or can be written."""


def gaps() -> Iterator[str]:
    """Topics, fields and metrics that nothing describes."""
    known = topics()
    made = [name for name in dir(Topics) if not name.startswith("_") and name not in _NO_TOPICS]
    yield from (
        f"topic {name} of Topics is described nowhere: daqsvc.reference.messages"
        for name in made
        if name not in known
    )
    described = {one.schema for one in known.values()}
    yield from (
        f"{name} goes over no topic that is described"
        for name in {*PAYLOADS} - described - {_OVER_THE_SOCKET}
    )
    for name, schema in json_schemas().items():
        for one in fields(schema):
            if not one.about:
                yield f"field {one.path} of {name} has no description: {PAYLOADS[name].__module__}"
    for _, metric in sparkplug():
        if metric.name not in SPARKPLUG_WORDS:
            yield f"Sparkplug metric {metric.name} is described nowhere: daqsvc.reference.messages"
    yield from figures.gaps()


_NO_TOPICS = {
    *("root", "site", "box", "base", "alarm_prefix", "commands", "below_commands", "command_of"),
    *("live_requests", "live_request_of"),
}
"""Of `Topics`: parts, filters, and what takes topics apart."""


def pages() -> dict[str, str]:
    """Text of each page, by file name."""
    known = topics()
    rows = [
        (
            f'<a id="{name}"></a>{code(one.topic)}',
            f"[`{one.schema}`](payloads.md#{_anchor(one.schema)})" if one.schema in PAYLOADS else _PIECES,
            f"{one.qos}",
            one.retained,
            one.about,
        )
        for name, one in known.items()
    ]
    titles = ("topic", "payload", "QoS", "retained", "what")
    others = [
        (f'<a id="{name.lower()}"></a>{code(one.topic)}', one.schema, f"{one.qos}", one.retained, one.about)
        for name, one in other_topics().items()
    ]
    by_schema = {one.schema: one.topic for one in known.values()}
    parts = []
    for name, schema in json_schemas().items():
        where = (
            f"Topic {code(by_schema[name])}." if name in by_schema else "Printed by `daqsvc status --json`."
        )
        file = f"../schemas/{name.replace('/', '-')}.json"
        parts.append(anchored(f"## `{name}`", _anchor(name)))
        parts.append(f"{where} [JSON Schema]({file}). {_sentence(PAYLOADS[name].__doc__ or '')}")
        parts.append(
            table(
                ("field", "type", "what it is"),
                [(_marked(name, one.path), one.kind, one.about) for one in fields(schema)],
            )
        )
    entities = [
        (
            code(one["unique_id"].removeprefix(f"{_BOX.base}/MACHINE/")),
            one["platform"],
            one["name"],
            code(one.get("state_topic") or one["command_topic"]),
        )
        for one in discovery().values()
    ]
    sparkplug_metrics = [
        (m.name or "", owner, m.datatype.name if m.datatype else "") for owner, m in sparkplug()
    ]
    metrics = [
        *((code(name), owner, kind, SPARKPLUG_WORDS[name]) for name, owner, kind in sparkplug_metrics),
        *((code(name), owner, kind, about) for name, owner, kind, about in _WRITTEN),
    ]
    return {
        "topics.md": page(
            "MQTT topics",
            _TOPICS,
            table(titles, rows),
            "## Home Assistant and Sparkplug",
            _OTHERS,
            table(titles, others),
        ),
        "payloads.md": page("Payloads", _PAYLOADS, *parts, figures.section()),
        "home-assistant.md": page(
            "Entities in Home Assistant", _ENTITIES, table(("entity", "platform", "name", "topic"), entities)
        ),
        "sparkplug.md": page(
            "Sparkplug metrics", _METRICS, table(("metric", "of", "datatype", "what"), metrics)
        ),
    }


def _marked(schema: str, path: str) -> str:
    """The path of a field, which links find by the name of the payload and it."""
    return f'<a id="{_anchor(schema)}.{path.replace("[]", "")}"></a>{code(path)}'


def _anchor(schema: str) -> str:
    return schema.replace("/", "-")


def _sentence(text: str) -> str:
    return text.strip().partition("\n")[0]


_TOPICS = """Words in capitals are names: `ROOT` is `topic_root` of `[mqtt]` (`daqsvc` by default),
`SITE`, `BOX` and `MACHINE` are those of the machine file. A name of an alarm or a detector may hold a `/`.
What a consumer can rely on, and examples of payloads: [mqtt.md](../mqtt.md)."""
_PIECES = "[pieces of a compressed stream](../mqtt.md#live-view)"
_OTHERS = """With `[mqtt.home_assistant]` and `[mqtt.sparkplug]` only. `PREFIX` is `prefix` of
`[mqtt.home_assistant]` (`homeassistant` by default), and `ID` is made of `ROOT`, `SITE`, `BOX` and `MACHINE`.
`GROUP`, `NODE`, `DEVICE` and `HOST` are `group`, `edge_node`, `device` and `primary_host` of
`[mqtt.sparkplug]`. More: [mqtt.md](../mqtt.md#home-assistant), [sparkplug.md](../sparkplug.md)."""
_PAYLOADS = """Every field of every payload. A field is named by its path, with dots; `[]` means each
entry of a list, `NAME` for a name. Examples: [mqtt.md](../mqtt.md). Fields may be added within a version:
ignore what you do not know."""
_ENTITIES = """What a machine has in Home Assistant, where `[mqtt.home_assistant]` is in the machine file.
Words in capitals are names; the id of an entity begins with `ROOT/SITE/BOX/MACHINE/`. More:
[mqtt.md](../mqtt.md#home-assistant)."""
_METRICS = """What a Sparkplug host sees, where `[mqtt.sparkplug]` is in the machine file. Words in capitals
are names. More: [sparkplug.md](../sparkplug.md)."""
