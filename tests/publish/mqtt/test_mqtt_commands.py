"""Commands cross a real broker, and their answers come back: by MQTT 5 and 3.1.1."""

from __future__ import annotations

import asyncio
import json
import threading
from datetime import UTC, datetime

import paho.mqtt.client as paho
import pytest
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from support.brokers import Consumer, TcpProxy, running_mosquitto
from support.mqtt_publishing import Desk, commands, publishing, say
from support.waiting import PATIENCE_S, eventually

from daqsvc.alarms.commands import CommandOutcome, Verb
from daqsvc.publish.mqtt.commands import ResponsePayload

pytestmark = [pytest.mark.integration, pytest.mark.mosquitto]
ACKNOWLEDGE = "daqsvc/lab/edge-1/rig/commands/acknowledge"
SETTINGS = commands(Verb.ACKNOWLEDGE)


def command(identifier="c1", **changes):
    told = {"schema": "daqsvc.command/1", "id": identifier, "alarm": "rotor-fault", "by": "Ada"}
    return json.dumps(told | {"issued_at": datetime.now(UTC).isoformat()} | changes)


class Operator:
    """A person's client: MQTT 5, with a topic of its own for answers."""

    def __init__(self, port):
        self.answers = []
        self._client = paho.Client(paho.CallbackAPIVersion.VERSION2, "operator", protocol=paho.MQTTv5)
        self._ready = threading.Event()
        self._client.on_connect = lambda client, *_: client.subscribe("operator/answers", qos=1)
        self._client.on_subscribe = lambda *_: self._ready.set()
        self._client.on_message = lambda _c, _u, message: self.answers.append(message)
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()
        assert self._ready.wait(PATIENCE_S)

    def ask(self, topic, payload, correlation):
        properties = Properties(PacketTypes.PUBLISH)
        properties.ResponseTopic = "operator/answers"
        properties.CorrelationData = correlation
        self._client.publish(topic, payload, qos=1, properties=properties)

    def close(self):
        self._client.disconnect()
        self._client.loop_stop()


@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
async def test_a_command_is_carried_out_and_answered(tmp_path, outbox, protocol):
    desk = Desk()
    with running_mosquitto(tmp_path) as mosquitto:
        async with (
            Consumer(mosquitto.port) as live,
            publishing(outbox, mosquitto.port, protocol, handler=desk, commands=SETTINGS) as publisher,
        ):
            await eventually(lambda: "Sending SUBACK to daqsvc-test" in mosquitto.log_text, "the box listens")
            await asyncio.to_thread(say, mosquitto.port, ACKNOWLEDGE, command())
            await eventually(lambda: live.on("/response"), "it is answered")
            answer = live.on("/response")[0]
            assert answer.topic == f"{ACKNOWLEDGE}/response"
            assert not answer.retained
            told = ResponsePayload.model_validate(answer.payload)
            assert (told.accepted, told.id, told.events) == (True, "c1", ("edge-1-7",))
            assert publisher.figures()["commands"]["accepted"] == 1
    assert [(c.verb, c.alarm, c.by) for c in desk.asked] == [(Verb.ACKNOWLEDGE, "rotor-fault", "Ada")]


@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
async def test_a_command_on_a_topic_below_a_verb_is_answered_and_its_answer_is_not(
    tmp_path, outbox, protocol
):
    desk, deep = Desk(), f"{ACKNOWLEDGE}/rotor-fault"
    with running_mosquitto(tmp_path) as mosquitto:
        async with (
            Consumer(mosquitto.port) as live,
            publishing(outbox, mosquitto.port, protocol, handler=desk, commands=SETTINGS) as publisher,
        ):
            listens = "Sending SUBACK to daqsvc-test"
            await eventually(lambda: mosquitto.log_text.count(listens) == 2, "the box listens")
            await asyncio.to_thread(say, mosquitto.port, deep, command())
            await eventually(lambda: live.on(f"{deep}/response"), "it is answered")
            told = ResponsePayload.model_validate(live.on(f"{deep}/response")[0].payload)
            assert "no verb 'acknowledge/rotor-fault'" in told.reason
            await asyncio.to_thread(say, mosquitto.port, ACKNOWLEDGE, command("c2"))
            await eventually(
                lambda: publisher.figures()["commands"]["accepted"] == 1, "the next one is served"
            )
            assert publisher.figures()["commands"]["malformed"] == 1
            await eventually(lambda: len(live.on("/response")) == 2, "one answer each")
    assert [c.alarm for c in desk.asked] == ["rotor-fault"]


async def test_an_mqtt5_sender_is_answered_on_its_own_topic(tmp_path, outbox):
    with running_mosquitto(tmp_path) as mosquitto:
        async with publishing(outbox, mosquitto.port, handler=Desk(), commands=SETTINGS):
            await eventually(lambda: "Sending SUBACK to daqsvc-test" in mosquitto.log_text, "the box listens")
            operator = await asyncio.to_thread(Operator, mosquitto.port)
            operator.ask(ACKNOWLEDGE, command(), b"first")
            operator.ask(ACKNOWLEDGE, command("c2", schema="daqsvc.command/2"), b"second")
            await eventually(lambda: len(operator.answers) == 2, "both are answered")
            operator.close()
    told = {a.properties.CorrelationData: json.loads(a.payload) for a in operator.answers}
    assert told[b"first"]["accepted"]
    assert not told[b"second"]["accepted"]
    assert {a.properties.MessageExpiryInterval for a in operator.answers} <= {59, 60}


async def test_without_leave_in_the_machine_file_nobody_listens(tmp_path, outbox):
    desk = Desk()
    with running_mosquitto(tmp_path) as mosquitto:
        async with publishing(outbox, mosquitto.port, handler=desk) as publisher:
            await eventually(lambda: publisher.counters.connected, "connected")
            await asyncio.to_thread(say, mosquitto.port, ACKNOWLEDGE, command())
            await outbox.append("daqsvc/lab/edge-1/rig/alarms/a", lambda n: b"{}", retain=True)
            await eventually(lambda: outbox.counters.sent == 1, "the box is busy")
        assert "Received SUBSCRIBE" not in mosquitto.log_text
    assert desk.asked == []
    assert "commands" not in publisher.figures()


@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
async def test_a_retained_command_is_not_obeyed_at_every_reconnect(tmp_path, outbox, protocol):
    desk = Desk()
    with running_mosquitto(tmp_path) as mosquitto:
        await asyncio.to_thread(say, mosquitto.port, ACKNOWLEDGE, command("old"), retain=True)
        async with (
            Consumer(mosquitto.port) as live,
            TcpProxy(mosquitto.port) as wire,
            publishing(outbox, wire.port, protocol, handler=desk, commands=SETTINGS) as publisher,
        ):
            listens = "Sending SUBACK to daqsvc-test"
            await eventually(lambda: mosquitto.log_text.count(listens) == 2, "the box listens")
            wire.cut()
            await eventually(lambda: publisher.counters.connections == 2, "connected again")
            await eventually(lambda: mosquitto.log_text.count(listens) == 4, "listening again")
            await asyncio.to_thread(say, mosquitto.port, ACKNOWLEDGE, command("new", by="Bea"))
            await eventually(
                lambda: "new" in [m.payload["id"] for m in live.on("/response")], "the fresh one is answered"
            )
            refused = [m.payload for m in live.on("/response") if m.payload["id"] == "old"]
            assert all("retained" in answer["reason"] for answer in refused)
    assert [asked.by for asked in desk.asked] == ["Bea"]


async def test_an_answer_that_the_broker_refuses_costs_neither_connection_nor_alarms(
    tmp_path, outbox, caplog
):
    acl = "topic write daqsvc/lab/edge-1/+\ntopic write daqsvc/lab/edge-1/rig/alarms/#\ntopic read #\n"
    acl += "topic write daqsvc/lab/edge-1/rig/commands/acknowledge\n"
    desk = Desk()
    with running_mosquitto(tmp_path, acl=acl) as mosquitto:
        async with publishing(outbox, mosquitto.port, handler=desk, commands=SETTINGS) as publisher:
            await eventually(lambda: "Sending SUBACK to daqsvc-test" in mosquitto.log_text, "the box listens")
            await asyncio.to_thread(say, mosquitto.port, ACKNOWLEDGE, command())
            await eventually(lambda: publisher.figures()["commands"]["unanswered"] == 1, "it is refused")
            await outbox.append("daqsvc/lab/edge-1/rig/alarms/a", lambda n: b"{}", retain=True)
            await eventually(lambda: outbox.counters.sent == 1, "alarms pass")
            assert publisher.counters.connections == 1
    assert len(desk.asked) == 1
    assert "is not taken" in caplog.text


async def test_a_flood_of_commands_is_bounded_and_counted(tmp_path, outbox):
    """Whoever may write there may write a lot: what the box cannot look at is dropped, not hoarded."""
    gate = asyncio.Event()

    async def slow(_command, _source):
        await gate.wait()
        return CommandOutcome(accepted=True)

    def flood(port):
        client = paho.Client(paho.CallbackAPIVersion.VERSION2, "flood")
        client.connect("127.0.0.1", port)
        client.loop_start()
        for number in range(300):
            sent = client.publish(ACKNOWLEDGE, command(f"f{number}"), qos=1)
        sent.wait_for_publish(PATIENCE_S)
        client.disconnect()
        client.loop_stop()

    with running_mosquitto(tmp_path, config="max_inflight_messages 0\nmax_queued_messages 0") as mosquitto:
        async with publishing(outbox, mosquitto.port, handler=slow, commands=SETTINGS) as publisher:
            await eventually(lambda: "Sending SUBACK to daqsvc-test" in mosquitto.log_text, "the box listens")
            await asyncio.to_thread(flood, mosquitto.port)
            await eventually(lambda: publisher.figures()["overlooked"] >= 300 - 66, "the rest is dropped")
            gate.set()
            await eventually(lambda: publisher.figures()["commands"]["accepted"] >= 64, "these are obeyed")
