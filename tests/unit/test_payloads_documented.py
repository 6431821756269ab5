"""The examples of docs/mqtt.md are payloads, key by key."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from daqsvc.alarms.events import EventKind
from daqsvc.alarms.states import AlarmState
from daqsvc.publish.payloads import (
    AlarmPayload,
    AvailabilityPayload,
    DiagnosisPayload,
    StatusPayload,
    json_schemas,
)

TEXT = (Path(__file__).parents[2] / "docs" / "mqtt.md").read_text(encoding="utf-8")
EXAMPLES = {
    example["schema"]: example
    for example in map(json.loads, re.findall(r"```json\n(.*?)```", TEXT, re.DOTALL))
}
MODELS = {
    "daqsvc.alarm/1": AlarmPayload,
    "daqsvc.diagnosis/1": DiagnosisPayload,
    "daqsvc.status/1": StatusPayload,
    "daqsvc.availability/1": AvailabilityPayload,
}


@pytest.mark.parametrize("schema", sorted(json_schemas()))
def test_every_payload_has_an_example_that_is_one(schema):
    payload = MODELS[schema].model_validate(EXAMPLES[schema])
    assert json.loads(payload.to_json()) == EXAMPLES[schema]


@pytest.mark.parametrize("word", [*AlarmState, *EventKind])
def test_every_state_and_kind_is_explained(word):
    assert f"`{word.value}`" in TEXT
