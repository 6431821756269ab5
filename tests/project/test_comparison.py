"""docs/comparison.md gives a source for what it states of others, and its example fits our messages."""

from __future__ import annotations

import json
import re
import tomllib

from support.paths import ROOT

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
