"""docs/comparison.md gives a source for what it states of others, and its example fits our messages."""

from __future__ import annotations

import json
import re
import tomllib

import pytest
from support.paths import ROOT

TELEGRAF = {
    "servers": list,
    "topics": list,
    "topic_tag": str,
    "qos": int,
    "connection_timeout": str,
    "max_undelivered_messages": int,
    "persistent_session": bool,
    "client_id": str,
    "username": str,
    "password": str,
    "tls_ca": str,
    "tls_cert": str,
    "tls_key": str,
    "insecure_skip_verify": bool,
    "data_format": str,
}
"""Keys of Telegraf's MQTT consumer and their types, by its README (source 17 of the page).

Debian has no Telegraf that could read the example."""
TELEGRAF_JSON = {
    "json_strict": bool,
    "json_query": str,
    "tag_keys": list,
    "json_string_fields": list,
    "json_name_key": str,
    "json_time_key": str,
    "json_time_format": str,
    "json_timezone": str,
}
"""The same of its JSON parser (source 18)."""
TEXT = (ROOT / "docs" / "comparison.md").read_text("utf-8")
BODY, SOURCES = TEXT.split("## Sources")


def test_every_source_is_cited_and_every_citation_has_a_source() -> None:
    cited = {int(number) for number in re.findall(r"\[(\d+)\](?!\()", BODY)}
    listed = {
        int(number): address
        for number, address in re.findall(r"(?m)^\| (\d+) \| .* \| <(https://\S+)> \|$", SOURCES)
    }
    assert cited == set(listed)
    assert len(listed) == len(set(listed.values())) >= 15


def test_the_day_of_looking_is_stated() -> None:
    assert re.search(r"come from the sources at the end, read on 20\d\d-\d\d-\d\d", BODY)


def test_each_system_has_both_sides_and_a_way_together() -> None:
    for system in ("System 1", "Telegraf", "openDAQ", "Home Assistant"):
        section = BODY.partition(f"\n## {system}\n")[2].partition("\n## ")[0]
        for part in ("**Better than daqsvc:**", "**daqsvc is better:**", "**Together:**"):
            assert part in section, (system, part)


def test_the_example_for_telegraf_names_topics_and_keys_that_there_are() -> None:
    example = tomllib.loads(re.findall(r"```toml\n(.*?)```", BODY, re.DOTALL)[0])
    [consumer] = example["inputs"]["mqtt_consumer"]
    schema = json.loads((ROOT / "docs" / "schemas" / "daqsvc.diagnosis-1.json").read_text("utf-8"))
    assert {*consumer["tag_keys"], consumer["json_time_key"]} <= set(schema["properties"])
    topics = (ROOT / "docs" / "mqtt.md").read_text("utf-8")
    assert "| `<machine>/diagnosis/<detector>` |" in topics
    assert consumer["topics"] == ["daqsvc/+/+/+/diagnosis/#"]  # root, site, box, machine


def telegraf_complaints(text: str) -> list[str]:
    """What Telegraf would not understand of an example, or would ignore."""
    inputs = tomllib.loads(text)["inputs"]
    if set(inputs) != {"mqtt_consumer"}:
        return [*inputs]
    [consumer] = inputs["mqtt_consumer"]
    known = TELEGRAF | TELEGRAF_JSON
    found = [key for key, value in consumer.items() if type(value) is not known.get(key)]
    if consumer.get("persistent_session") and not (
        consumer.get("client_id") and consumer.get("qos") in {1, 2}
    ):
        found.append("persistent_session")  # by source 17 it needs both
    if consumer.get("data_format") != "json":
        found.append("data_format")
    if consumer.get("json_time_format") != "2006-01-02T15:04:05Z07:00":
        found.append("json_time_format")  # of Go: the time of ISO 8601 with a zone
    return found + [
        one for one in consumer["servers"] if not re.fullmatch(r"(?:tcp|ssl|ws)://[^/]+:\d+", one)
    ]


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("persistent_session", "persistant_session"),
        ("mqtt_consumer", "mqtt_consume"),
        ("qos = 1", "qos = 0"),
        ("qos = 1", 'qos = "1"'),
        ('"json" ', '"jason" '),
        ("02T15:04:05Z07:00", "02 15:04"),
        ("tcp://127", "mqtts://127"),
        ("json_time_key", "time_key"),
    ],
)
def test_the_example_for_telegraf_is_of_its_keys(right: str, wrong: str) -> None:
    [example] = re.findall(r"```toml\n(.*?)```", BODY, re.DOTALL)
    assert telegraf_complaints(example) == []
    assert right in example
    assert telegraf_complaints(example.replace(right, wrong))
