"""What a running service says and hears is what the schemas in docs/schemas promise, key by key."""

from __future__ import annotations

import asyncio
import functools
import json
from datetime import UTC, datetime

import numpy as np
import pytest
from support.brokers import Consumer, running_mosquitto
from support.live_service import play, running
from support.machine_files import MACHINES
from support.mqtt_publishing import say
from support.paths import ROOT
from support.waiting import eventually

from daqsvc.publish.schemas import MACHINE_FILE, PAYLOADS, schema_files
from daqsvc.reference import formats
from daqsvc.settings import parse_machine_file

pytestmark = pytest.mark.integration
DOCS = ROOT / "docs" / "schemas"


@functools.cache
def validator(name):
    """Of a published schema. Importing jsonschema takes 1.5 s: whoever only collects does without."""
    from jsonschema import Draft202012Validator

    return Draft202012Validator(json.loads((DOCS / f"{name.replace('/', '-')}.json").read_text()))


@pytest.mark.parametrize("name", sorted([*PAYLOADS, *map(formats.slug, formats.FORMATS)]))
def test_every_published_schema_is_one_itself(name):
    validator(name).check_schema(validator(name).schema)


@pytest.mark.parametrize("name", sorted({**schema_files(), **formats.schema_files()}))
def test_the_published_schema_is_the_one_of_the_code(name):
    of_code = {**schema_files(), **formats.schema_files()}
    assert (DOCS / name).read_text(encoding="utf-8") == of_code[name], "run make reference"


def test_every_published_schema_is_one_of_the_code():
    assert {path.name for path in DOCS.iterdir()} == {*schema_files(), *formats.schema_files(), MACHINE_FILE}


def acknowledge(identifier, **changes):
    told = {"schema": "daqsvc.command/1", "id": identifier, "alarm": "shaft-vibration-x", "by": "Ada"}
    return told | {"issued_at": datetime.now(UTC).isoformat()} | changes


def rig(port):
    text = (MACHINES / "laval-rig.toml").read_text(encoding="utf-8").replace('"socketcan"', '"virtual"')
    broker = f'[mqtt]\nurl = "mqtt://127.0.0.1:{port}"\ninsecure = true\n'
    return parse_machine_file(
        f"{text[: text.index('[mqtt]')]}{broker}[mqtt.commands]\nenabled = true\n[mqtt.home_assistant]\n",
        MACHINES / "laval-rig.toml",
    )


@pytest.mark.long
@pytest.mark.mosquitto
async def test_all_that_a_service_says_and_hears_is_as_the_schemas_promise(tmp_path):
    t_s = np.arange(3 * 640) / 640.0
    motion = 70.0 * np.exp(2j * np.pi * 10.0 * t_s)
    # An orbit far over the danger setpoint, and a pulse each revolution.
    samples = np.column_stack((motion.real, motion.imag, np.where((10.0 * t_s) % 1.0 < 0.1, -2.0, -10.0)))
    topic = "daqsvc/lab/edge-1/laval-rig/commands/acknowledge"
    good, bad = acknowledge("good", reason="on my way"), acknowledge("bad", schema="daqsvc.command/2")
    with running_mosquitto(tmp_path) as mosquitto:
        async with Consumer(mosquitto.port, "daqsvc/#") as live:
            async with running(rig(mosquitto.port), tmp_path / "store") as service:
                await play(service, samples, 640.0)
                await eventually(lambda: live.on("/alarms/shaft-vibration-x"), "the alarm arrives")
                for asked in (good, bad):
                    await asyncio.to_thread(say, mosquitto.port, topic, json.dumps(asked))
                await eventually(lambda: len(live.on("/response")) == 2, "both are answered")
                await eventually(
                    lambda: live.on("/status") and live.on("/diagnosis/"), "the telemetry arrives"
                )
            await eventually(
                lambda: live.on("/availability")[-1].payload["state"] == "offline", "the goodbye"
            )
    answers = {m.payload["id"]: m.payload for m in live.on("/response")}
    assert answers["good"]["accepted"]
    (told,) = [m.payload for m in live.on("/alarms/shaft-vibration-x") if m.payload["kind"] == "acknowledged"]
    assert answers["good"]["events"] == [told["id"]]
    assert told["by"] == "Ada"
    assert not answers["bad"]["accepted"]
    said = [m.payload for m in live.messages if not m.topic.endswith("/commands/acknowledge")]
    # What goes to the box, and what it says over its control socket.
    asked = {"daqsvc.command/1", "daqsvc.live-request/1", "daqsvc.snapshot-command/1"}
    others = asked | {"daqsvc.service-status/1"}
    assert {payload["schema"] for payload in said} == set(PAYLOADS) - others
    for payload in [*said, good]:
        validator(payload["schema"]).validate(payload)
    assert not validator("daqsvc.command/1").is_valid(bad)


@pytest.mark.parametrize(
    ("name", "payload"),
    [
        ("daqsvc.command/1", {}),
        ("daqsvc.command/1", acknowledge("c") | {"force": True}),
        ("daqsvc.command/1", acknowledge("a b")),
        ("daqsvc.command/1", acknowledge("c", duration_s=0)),
        ("daqsvc.live-request/1", {"schema": "daqsvc.live-request/1", "feed": -1, "lease_s": 1.0}),
        ("daqsvc.live-request/1", {"schema": "daqsvc.live-request/1", "feed": 1, "lease_s": 1e6}),
        ("daqsvc.availability/1", {"schema": "daqsvc.availability/1", "state": "gone"}),
    ],
)
def test_the_schemas_refuse_what_is_no_payload(name, payload):
    assert not validator(name).is_valid(payload)
