"""Alarms really cross a broker: order, retained state, last will, outages; seen by an independent client."""

from __future__ import annotations

import asyncio
import itertools
import json
import logging

import pytest
from support.brokers import Consumer, TcpProxy, running_mosquitto
from support.mqtt_publishing import publishing
from support.ports import free_port
from support.waiting import PATIENCE_S, eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.events import Identity
from daqsvc.alarms.manager import AlarmManager, DiagnosisRule
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.notice import NOTICE
from daqsvc.outbox.store import Outbox
from daqsvc.publish.mqtt.connection import Connection
from daqsvc.publish.payloads import AlarmPayload, AvailabilityPayload, alarm_payload, status_payload
from daqsvc.publish.topics import Topics
from sim_hw.demo.broker import EmbeddedBroker

pytestmark = pytest.mark.integration
RIG = Identity("lab", "edge-1", "rig")
TOPICS = Topics("daqsvc", "lab", "edge-1")
CLOCK = SystemClock()
MODES = [("F1", "alert"), ("F1L2", "alert"), ("F1L3", "danger"), ("N", "normal")]


@pytest.fixture(
    params=[
        pytest.param("mosquitto-5", marks=pytest.mark.mosquitto),
        pytest.param("mosquitto-3.1.1", marks=pytest.mark.mosquitto),
        "amqtt-3.1.1",
    ]
)
async def broker(request, tmp_path):
    """A broker's port and the protocol to speak with it."""
    name, protocol = request.param.split("-")
    if name == "amqtt":
        async with EmbeddedBroker() as embedded:
            yield embedded.port, protocol
    else:
        with running_mosquitto(tmp_path) as mosquitto:
            yield mosquitto.port, protocol


class Service:
    """What the service does with a diagnosis: manager, payload, outbox."""

    def __init__(self, outbox, alarm="rotor-fault"):
        self._manager = AlarmManager(RIG, [DiagnosisRule(alarm, "rotor-bank")], CLOCK)
        self._outbox = outbox
        self.ids = []

    async def take(self, decision, severity):
        diagnosis = Diagnosis(
            "rig", "rotor-bank", CLOCK.monotonic_ns(), "shaft", 0, 64, decision, severity=severity
        )
        for event in self._manager.take(diagnosis):
            sequence = await self._outbox.append(
                TOPICS.alarm("rig", event.alarm),
                lambda number, event=event: alarm_payload(event, number, "series").to_json(),
                retain=True,
            )
            self.ids.append(f"series-{sequence}")

    async def cycle(self, times=1):
        for _ in range(times):
            for mode in MODES:
                await self.take(*mode)


def ids(received):
    return [message.payload["id"] for message in received]


def without_repeats(values):
    return list(dict.fromkeys(values))


async def test_alarms_arrive_in_order_valid_and_retained(broker, outbox):
    port, protocol = broker
    async with Consumer(port) as live, publishing(outbox, port, protocol) as publisher:
        service = Service(outbox)
        await service.cycle(times=25)
        await eventually(lambda: len(live.on("/alarms/")) >= 100, "all alarms have arrived")
        received = live.on("/alarms/")
        assert ids(received) == service.ids
        assert {message.topic for message in received} == {"daqsvc/lab/edge-1/rig/alarms/rotor-fault"}
        payloads = [AlarmPayload.model_validate(message.payload) for message in received]
        assert [p.kind for p in payloads[:4]] == ["raised", "changed", "escalated", "returned"]
        assert [p.cause.decision for p in payloads[:4]] == ["F1", "F1L2", "F1L3", "N"]
        for before, after in itertools.pairwise(payloads):
            assert (after.previous.state, after.previous.level) == (before.state, before.level)
        await eventually(lambda: outbox.counters.depth == 0, "the broker has acknowledged all")
        assert publisher.counters.acknowledged == publisher.counters.published == 100
        async with Consumer(port) as later:
            await eventually(lambda: later.on("/alarms/"), "the retained state arrives")
            states = later.on("/alarms/")  # amqtt gives a new client each retained message twice
            assert all(state.retained for state in states)
            assert without_repeats(ids(states)) == service.ids[-1:]


async def test_availability_from_birth_to_a_clean_stop(broker, outbox):
    port, protocol = broker
    async with Consumer(port) as live:
        async with publishing(outbox, port, protocol):
            await eventually(lambda: live.on("/availability"), "the box is online")
            async with Consumer(port) as later:
                await eventually(lambda: later.on("/availability"), "the retained state arrives")
                assert later.on("/availability")[0].retained
        await eventually(lambda: len(live.on("/availability")) == 2, "the box is offline")
        states = [AvailabilityPayload.model_validate(m.payload) for m in live.on("/availability")]
        assert [(s.state, s.reason) for s in states] == [("online", "connected"), ("offline", "stopped")]
        async with Consumer(port) as later:
            await eventually(lambda: later.on("/availability"), "the retained state arrives")
            assert later.on("/availability")[0].payload["state"] == "offline"


async def test_telemetry_arrives_and_is_not_retained(broker, outbox):
    port, protocol = broker
    async with Consumer(port) as live, publishing(outbox, port, protocol) as publisher:
        await eventually(lambda: publisher.counters.connected, "connected")
        for depth in range(5):
            payload = status_payload("lab", "edge-1", {"outbox": {"depth": depth}}, CLOCK)
            publisher.telemetry("status", payload.to_json())
        await eventually(lambda: len(live.on("/status")) == 5, "the figures arrive")
        figures = [message.payload["figures"]["outbox"]["depth"] for message in live.on("/status")]
        assert figures == [0, 1, 2, 3, 4]
        async with Consumer(port) as later:
            await eventually(lambda: later.on("/availability"), "the retained state arrives")
            assert later.on("/status") == []


async def test_a_publisher_that_stops_hands_over_the_telemetry_that_waits(broker, outbox, monkeypatch):
    port, protocol = broker
    deliver = Connection.deliver

    async def at_leisure(self, topic, *arguments, **options):
        if "status" in topic:
            await asyncio.sleep(0.01)
        await deliver(self, topic, *arguments, **options)

    monkeypatch.setattr(Connection, "deliver", at_leisure)
    async with Consumer(port) as live:
        async with publishing(outbox, port, protocol) as publisher:
            await eventually(lambda: publisher.counters.connected, "connected")
            for number in range(20):
                publisher.telemetry("status", json.dumps({"number": number}).encode())
        assert publisher.counters.telemetry_sent == 20
        await eventually(lambda: len(live.on("/status")) == 20, "all of it arrives")
        await eventually(lambda: live.on("/availability")[-1].payload["state"] == "offline", "the goodbye")


@pytest.mark.mosquitto
async def test_telemetry_that_found_no_broker_waits_for_the_next_start(tmp_path):
    outbox = Outbox(tmp_path / "outbox.sqlite", CLOCK)
    await outbox.open()
    async with publishing(outbox, free_port()) as publisher:
        for number in range(3):
            publisher.telemetry("status", json.dumps({"number": number}).encode())
    assert publisher.counters.telemetry_sent == 0
    await outbox.close()
    outbox = Outbox(tmp_path / "outbox.sqlite", CLOCK)
    await outbox.open()
    with running_mosquitto(tmp_path) as mosquitto:
        async with Consumer(mosquitto.port) as live, publishing(outbox, mosquitto.port):
            await eventually(lambda: len(live.on("/status")) == 3, "it arrives")
    assert [message.payload["number"] for message in live.on("/status")] == [0, 1, 2]
    await outbox.close()


async def test_the_last_will_speaks_for_a_cut_connection(broker, outbox):
    port, protocol = broker
    async with (
        Consumer(port) as live,
        TcpProxy(port) as wire,
        publishing(outbox, wire.port, protocol) as publisher,
    ):
        await eventually(lambda: live.on("/availability"), "the box is online")
        wire.cut()
        await eventually(lambda: len(live.on("/availability")) >= 3, "it was offline and is back")
        states = [(m.payload["state"], m.payload["reason"]) for m in live.on("/availability")]
        assert states[:3] == [
            ("online", "connected"),
            ("offline", "connection lost"),
            ("online", "connected"),
        ]
        # The consumer may hear of the new connection before the publisher has its PUBACK.
        await eventually(lambda: publisher.counters.connections == 2, "the publisher is back too")


@pytest.mark.mosquitto
async def test_a_broker_that_forgets_everything_costs_nothing(tmp_path, outbox, caplog):
    caplog.set_level(logging.INFO, "daqsvc.publish")
    service, quiet = Service(outbox), Service(outbox, "quiet-alarm")
    with running_mosquitto(tmp_path) as mosquitto:
        async with TcpProxy(mosquitto.port) as wire, publishing(outbox, wire.port):
            async with Consumer(mosquitto.port) as before:
                await quiet.take("F1", "alert")
                await service.cycle(times=5)
                await eventually(lambda: outbox.counters.depth == 0, "all is acknowledged")
            wire.blocked = True
            mosquitto.stop()
            wire.cut()
            await service.cycle(times=5)
            assert outbox.counters.depth == 20
            mosquitto.start()
            async with Consumer(mosquitto.port) as after:
                wire.blocked = False
                await eventually(lambda: outbox.counters.depth == 0, "the rest is acknowledged")
                await eventually(
                    lambda: ids(after.on("rotor-fault"))[-1:] == service.ids[-1:], "it has arrived"
                )
                seen = without_repeats(ids(before.on("rotor-fault")) + ids(after.on("rotor-fault")))
                assert seen == service.ids
                assert ids(after.on("quiet-alarm")) == quiet.ids
            async with Consumer(mosquitto.port) as later:
                await eventually(lambda: len(later.on("/alarms/")) == 2, "both retained states are back")
                assert sorted(ids(later.on("/alarms/"))) == sorted([quiet.ids[-1], service.ids[-1]])
    lost, *still, back = (r.getMessage() for r in caplog.records if r.levelno >= NOTICE)
    assert "is away" in lost
    assert all("is still away" in reason for reason in still)
    assert len({lost, *still}) == 1 + len(still), "each reason once"
    assert "is back" in back


@pytest.mark.mosquitto
async def test_lost_acknowledgements_only_repeat_ids(tmp_path, outbox):
    with running_mosquitto(tmp_path) as mosquitto:
        async with (
            Consumer(mosquitto.port) as live,
            TcpProxy(mosquitto.port) as wire,
            publishing(outbox, wire.port) as publisher,
        ):
            await eventually(lambda: publisher.counters.connected, "connected")
            service = Service(outbox)
            wire.deaf = True
            await service.cycle(times=2)
            await eventually(lambda: len(live.on("/alarms/")) == 8, "the broker has got them")
            assert outbox.counters.depth == 8
            wire.cut()
            wire.deaf = False
            await eventually(lambda: outbox.counters.depth == 0, "they are acknowledged at last")
            await eventually(lambda: len(live.on("/alarms/")) == 16, "they came twice")
            received = live.on("/alarms/")
            assert ids(received) == service.ids * 2
            assert [m.payload for m in received[:8]] == [m.payload for m in received[8:]]


@pytest.mark.mosquitto
async def test_restart_of_the_service_sends_what_was_left(tmp_path):
    with running_mosquitto(tmp_path) as mosquitto:
        outbox = Outbox(tmp_path / "outbox.sqlite", CLOCK)
        await outbox.open()
        service = Service(outbox)
        await service.cycle()
        await outbox.close()
        outbox = Outbox(tmp_path / "outbox.sqlite", CLOCK)
        await outbox.open()
        async with Consumer(mosquitto.port) as live, publishing(outbox, mosquitto.port):
            await eventually(lambda: len(live.on("/alarms/")) == 4, "they arrive")
            assert ids(live.on("/alarms/")) == service.ids
        await outbox.close()


@pytest.mark.mosquitto
async def test_stopping_hands_over_what_is_left(tmp_path, outbox):
    with running_mosquitto(tmp_path) as mosquitto:
        async with Consumer(mosquitto.port) as live:
            async with publishing(outbox, mosquitto.port) as publisher:
                await eventually(lambda: publisher.counters.connected, "connected")
                service = Service(outbox)
                await service.cycle(times=50)
            await eventually(lambda: len(live.on("/availability")) == 2, "the box is offline")
            assert ids(live.on("/alarms/")) == service.ids
    assert await outbox.pending(0, 10) == []


async def silent_server():
    """Accepts connections and never says anything."""

    async def listen(reader, writer):
        await reader.read()
        writer.close()

    return await asyncio.start_server(listen, "127.0.0.1", 0)


async def test_without_a_broker_it_stops_at_once_and_keeps_everything(outbox, caplog):
    service = Service(outbox)
    async with publishing(outbox, free_port()) as publisher:
        await service.cycle()
        await eventually(lambda: "is away" in caplog.text, "it has noticed")
        async with asyncio.timeout(PATIENCE_S):
            await publisher.stop()
    assert [m.sequence for m in await outbox.pending(0, 10)] == [
        int(one.removeprefix("series-")) for one in service.ids
    ]
    assert len(caplog.records) == 1


async def test_a_silent_broker_does_not_hold_up_the_stop(outbox, monkeypatch):
    # Whoever waited for it would do so for longer than anybody waits here, however slow the machine is.
    monkeypatch.setattr("daqsvc.publish.mqtt.connection.CONSENT_S", 10 * PATIENCE_S)
    monkeypatch.setattr("daqsvc.publish.mqtt.spoken.CONSENT_S", 10 * PATIENCE_S)
    server = await silent_server()
    async with server, publishing(outbox, server.sockets[0].getsockname()[1]) as publisher:
        await asyncio.sleep(0.1)
        async with asyncio.timeout(PATIENCE_S):
            await publisher.stop()


@pytest.mark.mosquitto
async def test_a_half_open_connection_does_not_hold_up_the_stop(tmp_path, outbox, monkeypatch):
    monkeypatch.setattr("daqsvc.publish.mqtt.connection.PUBACK_S", 10 * PATIENCE_S)
    with running_mosquitto(tmp_path) as mosquitto:
        async with TcpProxy(mosquitto.port) as wire, publishing(outbox, wire.port) as publisher:
            await eventually(lambda: publisher.counters.connected, "connected")
            wire.deaf = True
            await Service(outbox).cycle()
            async with asyncio.timeout(PATIENCE_S):
                await publisher.stop(deadline_s=0.5)
    assert len(await outbox.pending(0, 10)) == 4


@pytest.mark.mosquitto
async def test_a_refused_alarm_stays_on_disk(tmp_path, outbox, caplog):
    acl = "topic write daqsvc/lab/edge-1/availability\n"
    with running_mosquitto(tmp_path, acl=acl) as mosquitto:
        async with publishing(outbox, mosquitto.port) as publisher:
            await eventually(lambda: publisher.counters.connected, "connected")
            await Service(outbox).cycle()
            await eventually(lambda: "refuses messages: Not authorized" in caplog.text, "it is refused")
    assert outbox.dead_letters.waiting == 4
    assert await outbox.pending(0, 10) == []


async def test_an_old_broker_is_met_with_the_old_protocol(outbox, monkeypatch):
    monkeypatch.setattr("daqsvc.publish.mqtt.connection.CONSENT_S", 0.3)
    async with EmbeddedBroker() as embedded, publishing(outbox, embedded.port, "auto") as publisher:
        await eventually(lambda: publisher.counters.connected, "connected by MQTT 3.1.1")
