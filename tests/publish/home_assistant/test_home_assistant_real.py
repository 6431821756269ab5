"""A machine in a real Home Assistant: what a person sees there, and what the buttons do."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import numpy as np
import pytest
from support.home_assistant_server import running_home_assistant
from support.mqtt_publishing import Desk, mqtt, output_port, publisher_of, publishing
from test_home_assistant import LEVEL, RIG, WATCHED, alarm

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.commands import Verb
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.outbox.store import Outbox

pytestmark = [
    pytest.mark.integration,
    pytest.mark.mosquitto,
    pytest.mark.long,
    pytest.mark.marathon,
    pytest.mark.timeout(1800),
]

DEVICE = "rig (lab/edge-1)"
BANK = Diagnosis("rig", "rotor-bank", 0, "shaft", 0, 320, "U2", group=("U2", "D1"), severity="alert")


@pytest.fixture
def home_assistant(tmp_path, mosquitto):
    with running_home_assistant(tmp_path / "hass", mosquitto.port) as server:
        yield server


class Seen:
    """What a person sees of one device."""

    def __init__(self, server, device=DEVICE):
        self._server, self._device = server, device
        self.entities = {}

    async def look(self):
        found = await asyncio.to_thread(self._server.entities)
        self.entities = {
            name.removeprefix(f"{self._device} "): entity
            for name, entity in found.items()
            if name.startswith(self._device)
        }
        return {name: entity["state"] for name, entity in self.entities.items()}

    async def until(self, **expected):
        """Wait until entities show this; names with "_" for " "."""
        wanted = {name.replace("__", "-").replace("_", " "): state for name, state in expected.items()}
        for _ in range(240):
            shown = await self.look()
            if {name: shown.get(name) for name in wanted} == wanted:
                return shown
            await asyncio.sleep(0.25)
        pytest.fail(f"expected {wanted}, Home Assistant shows {shown}")


async def test_a_person_sees_how_things_stand_and_can_act(home_assistant, mosquitto, outbox, tmp_path):
    seen, desk = Seen(home_assistant), Desk()
    async with publishing(outbox, mosquitto.port, **RIG, handler=desk) as publisher:
        fault, sensor = (publisher.topics.alarm("rig", name) for name in ("rotor-fault", "sensor-ok/probe-x"))
        publisher.report(LEVEL)
        publisher.report(BANK)
        shown = await seen.until(
            rotor__fault="off",
            rotor__fault_level="normal",
            rotor__fault_alarm_state="normal",
            probe__x_sensor_fault="off",
            rotor__bank_finding="U2 or D1",
        )
        assert shown["levels/probe-x rms"] == "41.2"

        await outbox.append(fault, alarm("active_unacknowledged", "danger"), retain=True)
        await seen.until(
            rotor__fault="on", rotor__fault_level="danger", rotor__fault_alarm_state="active_unacknowledged"
        )
        assert seen.entities["rotor-fault"]["attributes"]["level"] == "danger"

        await asyncio.to_thread(home_assistant.press, seen.entities["acknowledge rotor-fault"]["entity_id"])
        await asyncio.to_thread(home_assistant.press, seen.entities["reset rotor-fault"]["entity_id"])
        for _ in range(100):
            if len(desk.asked) == 2:
                break
            await asyncio.sleep(0.1)
        assert [(c.verb, c.alarm, c.by) for c in desk.asked] == [
            (verb, "rotor-fault", "Home Assistant") for verb in (Verb.ACKNOWLEDGE, Verb.RESET)
        ]

        # Each of these was one and the same "on", or looked healthy.
        for state in ("active_acknowledged", "latched_acknowledged"):
            await outbox.append(fault, alarm(state, "danger"), retain=True)
            await seen.until(rotor__fault="on", rotor__fault_alarm_state=state)
        for state in ("suppressed", "shelved", "out_of_service"):
            await outbox.append(fault, alarm(state, "danger"), retain=True)
            await seen.until(
                rotor__fault="unknown", rotor__fault_level="unknown", rotor__fault_alarm_state=state
            )
        await outbox.append(fault, alarm("normal", "normal"), retain=True)
        await seen.until(rotor__fault="off", rotor__fault_level="normal")
        silent = alarm("active_unacknowledged", "alert", name="sensor-ok/probe-x")
        await outbox.append(sensor, silent, retain=True)
        publisher.report(replace(LEVEL, quality="missing", statistics={}))
        shown = await seen.until(
            rotor__fault="unknown", rotor__fault_level="unknown", probe__x_sensor_fault="on"
        )

        # The second box has a machine of the same name.
        await _two_boxes_stay_apart(home_assistant, mosquitto, tmp_path / "second")
    # Without its section nothing is left that looks healthy.
    async with publishing(outbox, mosquitto.port):
        for _ in range(120):
            if not await seen.look():
                break
            await asyncio.sleep(0.25)
        assert await seen.look() == {}


async def _two_boxes_stay_apart(server, mosquitto, store):
    outbox = Outbox(store, SystemClock())
    await outbox.open()
    settings = mqtt(mosquitto.port, "second", commands=RIG["commands"])
    publisher = publisher_of(settings, output_port(outbox, WATCHED, box="edge-2"), RIG["home_assistant"])
    running = asyncio.create_task(publisher.run())
    try:
        other = Seen(server, "rig (lab/edge-2)")
        await other.until(rotor__fault="off")
        first = Seen(server)
        await first.look()
        ids = [entity["entity_id"] for seen in (first, other) for entity in seen.entities.values()]
        assert len(set(ids)) == len(ids)
        assert not [name for name in ids if name.endswith("_2")]
    finally:
        await publisher.stop()
        await running
        await outbox.close()


async def test_a_healthy_machine_hardly_fills_the_database(home_assistant, mosquitto, outbox):
    seen, rng = Seen(home_assistant), np.random.default_rng(1)
    async with publishing(outbox, mosquitto.port, **RIG) as publisher:
        publisher.report(LEVEL)
        await seen.until(rotor__fault="off")
        entity = seen.entities["levels/probe-x rms"]["entity_id"]
        for _ in range(25 * 10):
            publisher.report(replace(LEVEL, statistics={"rms": 41.2 * (1 + 0.02 * rng.standard_normal())}))
            await asyncio.sleep(0.1)
        rows = await asyncio.to_thread(home_assistant.rows, entity)
        # Ten statements a second were a row each.
        assert 1 <= len([row for row in rows if row not in {"unknown", "unavailable"}]) <= 3
        publisher.report(replace(LEVEL, statistics={"rms": 80.0}))
        for _ in range(60):
            if "80.0" in await asyncio.to_thread(home_assistant.rows, entity):
                return
            await asyncio.sleep(0.5)
        pytest.fail("a level that has doubled is not in the database")
