"""Home Assistant's rules for a device discovery message, as far as its documentation states them.

After https://www.home-assistant.io/integrations/mqtt/#device-discovery-payload and the pages of the
integrations ``binary_sensor.mqtt`` and ``sensor.mqtt``. There is no Home Assistant here: this is used
in place of its schema, and knows nothing of the code that it checks.
"""

from __future__ import annotations

import json
import re
from typing import Any

ROOT = {
    "device",
    "origin",
    "components",
    "availability",
    "availability_mode",
    "state_topic",
    "command_topic",
    "qos",
}
DEVICE = {
    "identifiers", "connections", "name", "manufacturer", "model", "model_id", "serial_number", "hw_version",
    "sw_version", "suggested_area", "configuration_url", "via_device",
}  # fmt: skip
ENTITY = {
    "platform", "name", "unique_id", "default_entity_id", "device_class", "state_topic", "value_template",
    "json_attributes_topic", "json_attributes_template", "expire_after", "force_update", "entity_category",
    "enabled_by_default", "icon", "qos",
}  # fmt: skip
PLATFORMS = {
    "binary_sensor": ENTITY | {"payload_on", "payload_off", "off_delay"},
    "sensor": ENTITY | {"unit_of_measurement", "state_class", "options", "suggested_display_precision"},
    "button": ENTITY - {"state_topic", "value_template", "expire_after", "force_update"}
    | {"command_topic", "command_template", "payload_press", "retain"},
}
UNITS_OF_CLASS = {
    "voltage": {"V", "mV", "µV", "kV", "MV"},
    "temperature": {"°C", "°F", "K"},
    "speed": {"mm/s", "m/s", "in/s", "ft/s", "km/h", "mm/d", "mm/h", "in/d", "in/h", "mph", "kn", "Beaufort"},
}
TEMPLATE = re.compile(
    r"\{\{ value_json(?P<path>(\.[a-z]\w*|\['[^'\\]+'\])*)"
    r"(\.get\('(?P<last>[^'\\]+)'\))?(?P<json> \| tojson)?"
    r"( if value_json(?P=path)\.get\('(?P<given>[^'\\]+)'\) else None)? \}\}"
)


def rendered(template: str, payload: dict[str, Any]) -> str:
    """The result of Jinja for the templates that are used; any other template fails."""
    match = TEMPLATE.fullmatch(template)
    assert match, f"a template beyond what these rules know: {template}"
    value: Any = payload
    for dotted, bracketed in re.findall(r"\.([a-z]\w*)|\['([^'\\]+)'\]", match["path"]):
        value = value[dotted or bracketed]
    if match["given"] and not value.get(match["given"]):
        return "None"
    if match["last"]:
        value = value.get(match["last"])
    return json.dumps(value) if match["json"] else str(value)


def check_discovery(topic: str, payload: dict[str, Any]) -> None:
    """Fail unless Home Assistant would take the message."""
    prefix, kind, object_id, last = topic.rsplit("/", 3)
    assert prefix
    assert (kind, last) == ("device", "config")
    assert re.fullmatch(r"[a-zA-Z0-9_-]+", object_id), object_id
    assert set(payload) <= ROOT
    assert payload["device"]["identifiers"]
    assert set(payload["device"]) <= DEVICE
    assert payload["origin"]["name"]
    assert set(payload["origin"]) <= {"name", "sw_version", "support_url"}
    for source in payload["availability"]:
        assert set(source) <= {"topic", "value_template", "payload_available", "payload_not_available"}
    ids = [entity["unique_id"] for entity in payload["components"].values()]
    assert len(set(ids)) == len(ids)
    for name, entity in payload["components"].items():
        assert re.fullmatch(r"[a-zA-Z0-9_-]+", name), name
        _check_entity(entity)


def _check_entity(entity: dict[str, Any]) -> None:
    assert set(entity) <= PLATFORMS[entity["platform"]], entity
    if entity["platform"] == "button":
        assert not set(entity["command_topic"]) & set("+#")
        return
    assert not set(entity["state_topic"]) & set("+#")
    assert TEMPLATE.fullmatch(entity["value_template"])
    if entity["platform"] == "binary_sensor":
        assert entity["device_class"] == "problem"
    elif entity.get("device_class") == "enum":
        assert entity["options"]
        assert not {"state_class", "unit_of_measurement"} & set(entity)
    elif "device_class" in entity:
        assert entity["unit_of_measurement"] in UNITS_OF_CLASS[entity["device_class"]]
