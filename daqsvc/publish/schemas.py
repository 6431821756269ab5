"""The JSON Schemas of all payloads and of the machine file, in ``docs/schemas`` for consumers and editors.

``python -m daqsvc.publish.schemas docs/schemas`` writes the files.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daqsvc.publish.home_assistant.readings import ReadingsPayload
from daqsvc.publish.home_assistant.summary import SummaryPayload
from daqsvc.publish.live.request import LiveRequestPayload
from daqsvc.publish.mqtt.commands import CommandPayload, ResponsePayload, SnapshotCommandPayload
from daqsvc.publish.payloads import AlarmPayload, AvailabilityPayload, DiagnosisPayload, StatusPayload
from daqsvc.publish.service_status import ServiceStatusPayload
from daqsvc.settings.json_schema import machine_schema_text

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pydantic import BaseModel

PAYLOADS: Mapping[str, type[BaseModel]] = {
    "daqsvc.alarm/1": AlarmPayload,
    "daqsvc.availability/1": AvailabilityPayload,
    "daqsvc.command/1": CommandPayload,
    "daqsvc.diagnosis/1": DiagnosisPayload,
    "daqsvc.live-request/1": LiveRequestPayload,
    "daqsvc.readings/1": ReadingsPayload,
    "daqsvc.response/1": ResponsePayload,
    "daqsvc.service-status/1": ServiceStatusPayload,
    "daqsvc.snapshot-command/1": SnapshotCommandPayload,
    "daqsvc.status/1": StatusPayload,
    "daqsvc.summary/1": SummaryPayload,
}
"""Every payload by the value of its ``schema`` key."""
MACHINE_FILE = "machine.schema.json"
"""The file with the schema of the machine file; `daqsvc check --schema` prints the same."""


def json_schemas() -> dict[str, dict[str, Any]]:
    """The JSON Schema (2020-12) of every payload, by the value of its ``schema`` key."""
    schemas = {}
    for name, model in PAYLOADS.items():
        # What is published has all its keys; what is taken in may leave out those with a default.
        taken_in = model in {CommandPayload, LiveRequestPayload, SnapshotCommandPayload}
        schema = model.model_json_schema(by_alias=True, mode="validation" if taken_in else "serialization")
        schemas[name] = {"$schema": "https://json-schema.org/draft/2020-12/schema", "$id": name, **schema}
    return schemas


def schema_files() -> dict[str, str]:
    """Name and text of each schema file of a payload."""
    return {
        f"{name.replace('/', '-')}.json": json.dumps(schema, indent=2) + "\n"
        for name, schema in json_schemas().items()
    }


def write(directory: Path) -> None:
    """Write the schema files into a directory, that of the machine file with them."""
    for name, text in {**schema_files(), MACHINE_FILE: machine_schema_text()}.items():
        (directory / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
