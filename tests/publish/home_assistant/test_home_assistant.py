"""A machine shows up in Home Assistant by itself: what is published, when, and what is taken away again."""

from __future__ import annotations

import asyncio
import errno
import json
from dataclasses import replace

import pytest
from support.brokers import Consumer, TcpProxy, running_mosquitto
from support.home_assistant_rules import check_discovery, rendered
from support.mqtt_publishing import commands, publishing, say
from support.waiting import eventually

from daqsvc.alarms.commands import Verb
from daqsvc.diagnosis.reading import Reading
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.outbox.files import replace_durably
from daqsvc.publish.home_assistant import left_over
from daqsvc.publish.home_assistant.settings import HomeAssistant
from daqsvc.publish.output import Watched

pytestmark = [pytest.mark.integration, pytest.mark.mosquitto]
WATCHED = Watched(
    "rig",
    alarms=("rotor-fault",),
    services=("sensor-ok/probe-x",),
    readings=(Reading("levels/probe-x", "statistics", "rms", "um"),),
    rests_on={"rotor-fault": ("sensor-ok/probe-x",)},
    findings=("rotor-bank",),
)
BUTTONS = commands(Verb.ACKNOWLEDGE, Verb.RESET)
RIG = {"home_assistant": HomeAssistant(), "watched": WATCHED, "commands": BUTTONS}
LEVEL = Diagnosis("rig", "levels/probe-x", 0, "shaft", 0, 320, "normal", statistics={"rms": 41.2487})
CONFIG = "homeassistant/device/daqsvc_2flab_2fedge-1_2frig/config"
SUMMARY = "daqsvc/lab/edge-1/rig/summary"


def alarm(state, level, occurrence="o-1", name="rotor-fault"):
    told = {
        "alarm": name,
        "state": state,
        "level": level,
        "occurrence": occurrence,
        "time": "2026-11-21T12:00:00.000000Z",
        "message": f"rotor-fault {level}",
    }
    return lambda sequence: json.dumps(told | {"id": f"edge-1-{sequence}"}).encode()


async def retained(port, topic):
    """What a client that comes now is told."""
    async with Consumer(port) as later:
        await eventually(lambda: later.on("/availability"), "the retained state arrives")
        await asyncio.sleep(0.3)  # in any order
        return [message.payload for message in later.messages if message.topic == topic]


def standing(live):
    """The alarm in the latest summary."""
    return live.on("/summary")[-1].payload["alarms"]["rotor-fault"]


def entity(live, name):
    """How Home Assistant would show one entity, after all that was published."""
    discovery = [m.payload for m in live.messages if m.topic == CONFIG][-1]
    (found,) = [e for e in discovery["components"].values() if e.get("unique_id", "").endswith(name)]
    states = [m.payload for m in live.messages if m.topic == found["state_topic"]]
    return rendered(found["value_template"], states[-1]) if states else None


@pytest.mark.parametrize("protocol", ["5", pytest.param("3.1.1", marks=pytest.mark.long)])
async def test_alarms_show_up_and_follow(mosquitto, outbox, protocol):
    async with (
        Consumer(mosquitto.port) as live,
        publishing(outbox, mosquitto.port, protocol, **RIG) as publisher,
    ):
        await eventually(lambda: live.on("/summary"), "the machine is told")
        (discovery,) = [m.payload for m in live.messages if m.topic == CONFIG]
        check_discovery(CONFIG, discovery)
        assert entity(live, "alarm/rotor-fault") == "OFF", "an alarm that was never raised is known as off"
        assert entity(live, "level/rotor-fault") == "normal"
        topic = publisher.topics.alarm("rig", "rotor-fault")
        for state, level, shown in [
            ("active_unacknowledged", "alert", "ON"),
            ("active_acknowledged", "danger", "ON"),
            ("suppressed", "danger", "None"),
            ("latched_acknowledged", "danger", "ON"),
            ("returned_unacknowledged", "alert", "OFF"),
            ("normal", "normal", "OFF"),
        ]:
            await outbox.append(topic, alarm(state, level), retain=True)
            await eventually(lambda: standing(live)["state"] == state, state)  # noqa: B023  awaited here
            assert entity(live, "alarm/rotor-fault") == shown
            assert entity(live, "level/rotor-fault") == ("None" if shown == "None" else level)
            assert entity(live, "state/rotor-fault") == state
        publisher.report(LEVEL)
        await eventually(lambda: live.on("/readings/"), "the level arrives")
        assert entity(live, "levels/probe-x/rms") == "41.2"
        assert len(await retained(mosquitto.port, SUMMARY)) == 1


async def test_without_good_data_no_alarm_is_said_to_be_off(mosquitto, outbox):
    async with (
        Consumer(mosquitto.port) as live,
        publishing(outbox, mosquitto.port, **RIG) as publisher,
    ):
        await eventually(lambda: live.on("/summary"), "the machine is told")
        sensor = publisher.topics.alarm("rig", "sensor-ok/probe-x")
        fault = publisher.topics.alarm("rig", "rotor-fault")

        async def shown(topic, told, expected):
            await outbox.append(topic, told, retain=True)
            await eventually(
                lambda: (entity(live, "alarm/rotor-fault"), entity(live, "level/rotor-fault")) == expected,
                f"{expected} is shown",
            )

        silent = alarm("active_unacknowledged", "alert", name="sensor-ok/probe-x")
        back = alarm("normal", "normal", name="sensor-ok/probe-x")
        await shown(sensor, silent, ("None", "None"))
        assert entity(live, "alarm/sensor-ok/probe-x") == "ON"
        await shown(sensor, back, ("OFF", "normal"))
        # What is raised stays raised: missing data clears nothing.
        await shown(fault, alarm("active_unacknowledged", "danger"), ("ON", "danger"))
        await outbox.append(sensor, silent, retain=True)
        await shown(fault, alarm("active_acknowledged", "danger"), ("ON", "danger"))
        await shown(fault, alarm("normal", "normal"), ("None", "None"))


async def test_a_restart_knows_how_the_alarms_stand_before_anything_happens(mosquitto, outbox):
    async with publishing(outbox, mosquitto.port, **RIG) as publisher:
        await eventually_told(mosquitto, "rotor-fault")
        topic = publisher.topics.alarm("rig", "rotor-fault")
        await outbox.append(topic, alarm("active_acknowledged", "danger"), retain=True)
        await eventually(lambda: outbox.counters.sent == 1, "the broker has it")
    for _ in range(5):
        async with Consumer(mosquitto.port) as live, publishing(outbox, mosquitto.port, **RIG):
            await eventually(lambda: any(not m.retained for m in live.on("/summary")), "the machine is told")
            fresh = [m.payload for m in live.on("/summary") if not m.retained]
        standings = [(p["alarms"]["rotor-fault"]["problem"]) for p in fresh]
        assert set(standings) == {"ON"}


async def test_discovery_is_told_again_at_reconnect_and_at_home_assistants_birth(
    mosquitto, outbox, monkeypatch
):
    monkeypatch.setattr("daqsvc.publish.home_assistant.link.BIRTH_DELAY_S", 0.05)

    async with (
        Consumer(mosquitto.port, CONFIG) as live,
        TcpProxy(mosquitto.port) as wire,
        publishing(outbox, wire.port, **RIG) as publisher,
    ):
        await eventually(lambda: len(live.messages) == 1, "the machine is told")
        await asyncio.to_thread(say, mosquitto.port, "homeassistant/status", "online")
        await eventually(lambda: len(live.messages) == 2, "it is told at the birth")
        await asyncio.to_thread(say, mosquitto.port, "homeassistant/status", "offline")
        wire.cut()
        await eventually(lambda: publisher.counters.connections == 2, "connected again")
        await eventually(lambda: len(live.messages) == 3, "it is told at the reconnect")


async def test_what_the_machine_file_no_longer_has_disappears(mosquitto, outbox):
    renamed = RIG | {"watched": replace(WATCHED, alarms=("rotor-rub",))}
    async with publishing(outbox, mosquitto.port, **RIG):
        await eventually_told(mosquitto, "rotor-fault")
    async with Consumer(mosquitto.port) as live, publishing(outbox, mosquitto.port, **renamed):
        await eventually(lambda: any(not m.retained for m in live.on("/summary")), "the machine is told")
        told = [m.payload["components"] for m in live.messages if m.topic == CONFIG and not m.retained]
    removal, last = told
    old = WATCHED.alarms[0]
    gone = {name for name, entity in removal.items() if set(entity) == {"platform"}}
    assert len(gone) == 5, "alarm, level, state and two buttons"
    assert all(old in name.replace("_2f", "/") for name in gone)
    assert gone.isdisjoint(last)
    assert set(removal) == gone | set(last)


async def eventually_told(mosquitto, alarm):
    async with Consumer(mosquitto.port, "homeassistant/#") as live:
        await eventually(lambda: live.messages and alarm in str(live.messages[-1].payload), "it is told")


async def test_switched_off_the_machine_is_taken_away(mosquitto, outbox):
    async with publishing(outbox, mosquitto.port, **RIG):
        await eventually_told(mosquitto, "rotor-fault")
    off = RIG | {"home_assistant": HomeAssistant(enabled=False)}
    async with publishing(outbox, mosquitto.port, **off) as publisher:
        async with Consumer(mosquitto.port) as live:
            await eventually(lambda: publisher.counters.connected, "connected")
            await outbox.append("daqsvc/lab/edge-1/rig/alarms/a", lambda n: b"{}", retain=True)
            await eventually(lambda: live.on("/alarms/"), "alarms pass")
        await eventually(lambda: mosquitto.log_text.count("Received PUBLISH") > 3, "it is taken away")
        assert await retained(mosquitto.port, CONFIG) == []
        assert await retained(mosquitto.port, SUMMARY) == []


async def test_without_its_section_the_machine_is_taken_away_too(mosquitto, outbox):
    async with publishing(outbox, mosquitto.port, **RIG):
        await eventually_told(mosquitto, "rotor-fault")
    async with publishing(outbox, mosquitto.port) as publisher:
        await eventually(lambda: publisher.counters.connected, "connected")
        await eventually(lambda: mosquitto.log_text.count(CONFIG) > 1, "it is taken away")
        await eventually(lambda: not publisher._links[0].left_over(), "that is remembered")
    assert await retained(mosquitto.port, CONFIG) == []
    assert await retained(mosquitto.port, SUMMARY) == []


@pytest.mark.long
async def test_under_another_prefix_the_old_one_is_taken_away(mosquitto, outbox):
    async with publishing(outbox, mosquitto.port, **RIG):
        await eventually_told(mosquitto, "rotor-fault")
    moved = RIG | {"home_assistant": HomeAssistant(prefix="ha2")}
    async with publishing(outbox, mosquitto.port, **moved) as publisher:
        await eventually(lambda: not publisher._links[0]._left_over.left_over(), "the old one is taken away")
        async with Consumer(mosquitto.port, "ha2/#") as live:
            await eventually(lambda: live.messages, "it is told under the new one")
    assert await retained(mosquitto.port, CONFIG) == []
    assert len(await retained(mosquitto.port, SUMMARY)) == 1


async def test_a_broker_that_forbids_discovery_still_gets_the_alarms(tmp_path, outbox, caplog):
    acl = "topic read #\ntopic write daqsvc/#\n"
    directory = tmp_path / "strict"
    directory.mkdir()
    with running_mosquitto(directory, acl=acl) as strict:
        async with publishing(outbox, strict.port, **RIG) as publisher:
            await eventually(lambda: "Home Assistant does not get rig" in caplog.text, "it is said")
            await outbox.append("daqsvc/lab/edge-1/rig/alarms/a", lambda n: b"{}", retain=True)
            await eventually(lambda: outbox.counters.sent == 1, "alarms pass")
            assert publisher.counters.connections == 1


@pytest.mark.gives("O16")
@pytest.mark.parametrize("told", [RIG, {}], ids=["told", "no longer told"])
async def test_what_a_full_disk_did_not_take_is_remembered_once_it_has_room(
    told, mosquitto, outbox, monkeypatch, caplog
):
    caplog.set_level("INFO")
    file = outbox.directory / left_over.FILE
    file.write_text('{"topics": ["homeassistant/device/earlier/config"]}')
    room = asyncio.Event()

    def write(path, data):
        if not room.is_set():
            raise OSError(errno.ENOSPC, "No space left on device")
        replace_durably(path, data)

    monkeypatch.setattr(left_over, "replace_durably", write)
    monkeypatch.setattr(left_over, "AGAIN_S", 0.02)
    async with publishing(outbox, mosquitto.port, **told):
        await eventually(lambda: "home-assistant.json cannot be written: " in caplog.text, "it is said")
        await asyncio.sleep(0.1)
        assert caplog.text.count("cannot be written") == 1
        assert "earlier" in file.read_text()
        room.set()
        await eventually(lambda: "home-assistant.json is written again" in caplog.text, "it is written")
    assert json.loads(file.read_text()) == {"topics": sorted([CONFIG, SUMMARY] if told else [])}
