"""Hosts acknowledge and reset alarms: by a real broker, through the alarm service, into the audit log."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from typing import TYPE_CHECKING, Any

import pytest
from support.alarm_desk import alarm_service
from support.mqtt_publishing import commands, mqtt, outputs
from support.sparkplug_edge import BOOLEAN, CLOCK, NODE, born, rebirth, said
from support.sparkplug_host import Host
from support.waiting import eventually

from daqsvc.alarms.commands import Verb
from daqsvc.alarms.events import Identity
from daqsvc.alarms.rules import DiagnosisRule
from daqsvc.alarms.states import AlarmState
from daqsvc.publish.mqtt.settings import MqttCommands
from daqsvc.publish.output import Watched
from daqsvc.publish.sparkplug.codec import DataType, Metric, Payload, encode
from daqsvc.publish.sparkplug.settings import Sparkplug

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from daqsvc.alarm_service import AlarmService

pytestmark = [pytest.mark.integration, pytest.mark.mosquitto]

NODE_ACK = "Alarms/rig/rotor-fault/Acknowledge"
DEVICE_ACK = "Alarms/rotor-fault/Acknowledge"
BOTH = frozenset({Verb.ACKNOWLEDGE, Verb.RESET})
NCMD, DCMD = NODE.format("NCMD"), f"{NODE.format('DCMD')}/rig"


@contextlib.asynccontextmanager
async def box(tmp_path: Path, port: int, allow: frozenset[Verb] | None = BOTH) -> AsyncIterator[AlarmService]:
    """A desk whose alarm latches, at a broker, as an edge node."""
    watched = Watched("rig", alarms=("rotor-fault",))
    allowed = MqttCommands() if allow is None else commands(*allow)
    desk = alarm_service(
        Identity("lab", "edge-1", "rig"),
        [DiagnosisRule("rotor-fault", "bank", latching=True)],
        tmp_path / "store",
        CLOCK,
        outputs(mqtt(port, "edge-1", commands=allowed), watched, sparkplug=Sparkplug()),
    )
    await desk.open()
    await desk.resume({"rig": {"bank": ("x",)}})
    running = [asyncio.create_task(teller.run()) for teller in desk.outputs.values()]
    try:
        yield desk
    finally:
        await desk.settle(2.0)
        await desk.stop(2.0)
        await asyncio.gather(*running)
        await desk.close(2.0)


def written(*metrics: Metric, sent_ms: int | None = None) -> bytes:
    return encode(Payload(time.time_ns() // 1_000_000 if sent_ms is None else sent_ms, None, metrics))


def true(name: str) -> Metric:
    return Metric(name=name, datatype=DataType.BOOLEAN, value=True)


def audited(tmp_path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (tmp_path / "store" / "audit.jsonl").read_text().splitlines()]


def state(desk: AlarmService) -> AlarmState:
    return desk.manager.alarms["rotor-fault"].state


@pytest.mark.parametrize(("topic", "name"), [(DCMD, DEVICE_ACK), (NCMD, NODE_ACK)])
async def test_a_host_acknowledges_and_resets_what_it_has_seen_in_a_birth(
    mosquitto, tmp_path, topic, name
) -> None:
    async with Host(mosquitto.port) as host, box(tmp_path, mosquitto.port) as desk:
        await born(host)
        birth = host.of("DBIRTH" if topic == DCMD else "NBIRTH")[-1].metric(name)
        assert (birth.datatype, birth.value, birth.null) == (BOOLEAN, False, False)
        desk.take(said("F1", "danger"))
        await eventually(lambda: "active_unacknowledged" in told(host, "State"), "the host sees the alarm")
        host.ask(topic, written(true(name)))
        await eventually(lambda: told(host, "Acknowledged") == [False, True], "the host sees what came of it")
        assert state(desk) is AlarmState.ACTIVE_ACKNOWLEDGED
        host.ask(topic, written(true(name.replace("Acknowledge", "Reset"))))
        await eventually(
            lambda: desk.outputs["mqtt.sparkplug"].counters.commands_refused == 1,
            "the condition is still present",
        )
        desk.take(said("N", "normal"))
        alias = Metric(
            alias=next(
                a for a, known in host.names().items() if known == name.replace("Acknowledge", "Reset")
            ),
            datatype=DataType.BOOLEAN,
            value=True,
        )
        await asyncio.sleep(0.002)
        host.ask(topic, written(alias))
        await eventually(lambda: state(desk) is AlarmState.NORMAL, "it is reset")
        await eventually(lambda: told(host, "State")[-1] == "normal", "the host sees it")
        await eventually(lambda: desk.outputs["mqtt.sparkplug"].counters.commands == 2, "both are counted")
    log = [(line["verb"], line["outcome"]) for line in audited(tmp_path)]
    assert log == [
        ("acknowledge", "asked"),
        ("acknowledge", "accepted"),
        ("reset", "asked"),
        ("reset", "refused"),
        ("reset", "asked"),
        ("reset", "accepted"),
    ]
    assert {(line["source"], line["by"]) for line in audited(tmp_path)} == {
        (f"sparkplug {topic}", "Sparkplug host")
    }


def told(host: Host, part: str) -> list[Any]:
    return host.told(f"Alarms/rig/rotor-fault/{part}", historical=False)


async def test_what_is_not_allowed_too_old_or_nothing_is_refused(mosquitto, tmp_path) -> None:
    now_ms = time.time_ns() // 1_000_000
    only = frozenset({Verb.ACKNOWLEDGE})
    async with Host(mosquitto.port) as host, box(tmp_path, mosquitto.port, only) as desk:
        await born(host)
        assert not [m for b in host.of("NBIRTH", "DBIRTH") for m in b.metrics if m.name.endswith("/Reset")]
        desk.take(said("F1", "danger"))
        refused = [
            (DCMD, written(true("Alarms/rotor-fault/Reset"))),
            (DCMD, written(true(NODE_ACK))),
            (NCMD, written(true(DEVICE_ACK))),
            (DCMD, written(Metric(name=DEVICE_ACK, datatype=DataType.BOOLEAN, value=False))),
            (DCMD, written(Metric(name=DEVICE_ACK, datatype=DataType.STRING, value="true"))),
            (DCMD, written(true(DEVICE_ACK), sent_ms=now_ms - 3_600_000)),
            (DCMD, written(true(DEVICE_ACK), sent_ms=2**64 - 1)),
            (DCMD, written(true("Alarms/" + "a" * 300 + "/Acknowledge"))),
            (DCMD, written(true("Alarms//Acknowledge"))),
            (DCMD, written(Metric(alias=999, datatype=DataType.BOOLEAN, value=True))),
            (DCMD, written(*[true(DEVICE_ACK)] * 65)),
            (DCMD, written()),
            (DCMD, b"\xff\xff"),
            (f"{NODE.format('DCMD')}/other", written(true(DEVICE_ACK))),
        ]
        for topic, payload in refused:
            host.ask(topic, payload)
        counters = desk.outputs["mqtt.sparkplug"].counters
        await eventually(lambda: counters.commands_refused == len(refused), "each is counted")
        assert state(desk) is AlarmState.ACTIVE_UNACKNOWLEDGED
        assert counters.commands == 0
        host.ask(NCMD, rebirth())
        await born(host, 2)
        twice = written(true(DEVICE_ACK))
        host.ask(DCMD, twice)
        host.ask(DCMD, twice)
        await eventually(lambda: counters.commands_refused == len(refused) + 1, "the same wish twice is one")
        assert counters.commands == 1
        assert state(desk) is AlarmState.ACTIVE_ACKNOWLEDGED


async def test_nothing_can_be_written_without_leave_of_the_machine_file(mosquitto, tmp_path) -> None:
    async with Host(mosquitto.port) as host, box(tmp_path, mosquitto.port, None) as desk:
        await born(host)
        names = {metric.name for birth in host.of("NBIRTH", "DBIRTH") for metric in birth.metrics}
        assert not [name for name in names if name.endswith(("/Acknowledge", "/Reset"))]
        desk.take(said("F1", "danger"))
        host.ask(DCMD, written(true(DEVICE_ACK)))
        host.ask(NCMD, written(true(NODE_ACK)))
        await eventually(
            lambda: desk.outputs["mqtt.sparkplug"].counters.commands_refused == 2, "both are refused"
        )
        assert state(desk) is AlarmState.ACTIVE_UNACKNOWLEDGED
    assert not (tmp_path / "store" / "audit.jsonl").exists()
