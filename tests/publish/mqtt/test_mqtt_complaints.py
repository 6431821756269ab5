"""What users of other publishers complain about, one test each; the references are to their reports."""

from __future__ import annotations

import asyncio
import json
import logging
import threading
from collections import Counter

import paho.mqtt.client as paho
import pytest
from support.brokers import Consumer, TcpProxy, running_mosquitto
from support.mqtt_publishing import CLOCK, publishing
from support.rogue_broker import PickyBroker, only_availability
from support.waiting import PATIENCE_S, eventually

from daqsvc.errors.outputs import CLIENT_ID_TAKEN
from daqsvc.outbox.store import Outbox
from daqsvc.publish.mqtt import credentials
from daqsvc.publish.mqtt.delivery import IN_FLIGHT
from daqsvc.publish.mqtt.publisher import FIRST_RETRY_NS, SUSPICIOUS_LOSSES

pytestmark = pytest.mark.integration
ALARM = "daqsvc/lab/edge-1/rig/alarms/rotor-fault"


async def append(outbox, count, topic=ALARM):
    """Alarms on disk; their numbers."""
    payload = '{{"sequence": {0}}}'.format
    written = [outbox.submit(topic, lambda n: payload(n).encode(), retain=True) for _ in range(count)]
    return list(await asyncio.gather(*written))


def sequences(live):
    return [message.payload["sequence"] for message in live.on("/alarms/") if not message.retained]


@pytest.mark.mosquitto
async def test_in_flight_storm_after_a_reconnect(mosquitto, outbox):
    """paho.mqtt.python#400, #492, iotblackbelt#10: a backlog comes in several copies after a reconnect."""
    async with (
        Consumer(mosquitto.port) as live,
        TcpProxy(mosquitto.port) as wire,
        publishing(outbox, wire.port) as publisher,
    ):
        await eventually(lambda: publisher.counters.connected, "connected")
        wire.deaf = True
        written = await append(outbox, 300)
        await eventually(lambda: len(sequences(live)) == IN_FLIGHT, "the window is full")
        await asyncio.sleep(0.2)
        assert sequences(live) == written[:IN_FLIGHT], "nothing beyond the window is under way"
        wire.cut()
        wire.deaf = False
        await eventually(lambda: outbox.counters.depth == 0, "the broker has acknowledged all")
        await eventually(lambda: len(sequences(live)) == 300 + IN_FLIGHT, "all have arrived")
        copies = Counter(sequences(live))
        assert {n: c for n, c in copies.items() if c > 1} == dict.fromkeys(written[:IN_FLIGHT], 2)
        assert list(dict.fromkeys(sequences(live))) == written


@pytest.mark.mosquitto
async def test_a_full_queue_refuses_the_newest(mosquitto, outbox):
    """paho.mqtt.python#856, node-red#2864: after an outage the latest messages are those that are missing."""
    async with Consumer(mosquitto.port) as live, TcpProxy(mosquitto.port) as wire:
        wire.blocked = True
        async with publishing(outbox, wire.port):
            written = await append(outbox, 3000)
            wire.blocked = False
            await eventually(lambda: len(sequences(live)) == 3000, "all have arrived")
            assert sequences(live) == written


@pytest.mark.mosquitto
async def test_a_smaller_window_at_the_broker_ends_the_connection_again_and_again(
    tmp_path, outbox, monkeypatch
):
    """MQTT 5, 3.3.4: who sends more than the broker's Receive Maximum is disconnected; paho does not look."""
    # A broker that a busy computer keeps waiting is not silent.
    monkeypatch.setattr("daqsvc.publish.mqtt.connection.PUBACK_S", 10 * PATIENCE_S)
    with running_mosquitto(tmp_path, config="max_inflight_messages 3") as mosquitto:
        async with (
            Consumer(mosquitto.port) as live,
            TcpProxy(mosquitto.port) as wire,
            publishing(outbox, wire.port) as publisher,
        ):
            await append(outbox, 200)
            await eventually(lambda: outbox.counters.depth == 0, "all are acknowledged")
            assert publisher.counters.connections == 1
            wire.deaf = True
            await append(outbox, 20)
            await eventually(lambda: len(sequences(live)) == 203, "the broker's window is full")
            await asyncio.sleep(0.2)
            assert len(sequences(live)) == 203


@pytest.mark.mosquitto
async def test_a_message_too_large_for_the_broker_ends_the_connection_again_and_again(
    tmp_path, outbox, caplog
):
    """MQTT 5, 3.1.2.11.4: it is not sent, and what to do is said; smaller ones before it have passed."""
    with running_mosquitto(tmp_path, config="max_packet_size 1000") as mosquitto:
        async with publishing(outbox, mosquitto.port) as publisher:
            await append(outbox, 3)
            await outbox.append(ALARM, lambda n: b"x" * 1000, retain=True)
            await eventually(lambda: "raise the largest packet there" in caplog.text, "it is said")
            assert f"the message on {ALARM} needs" in caplog.text
            await eventually(lambda: publisher.counters.acknowledged == 3, "the smaller ones have passed")
            publisher.telemetry("status", b"x" * 1000)
            await eventually(lambda: publisher.counters.telemetry_refused == 1, "telemetry is dropped")
        assert "exceeds" not in mosquitto.log_text
    assert outbox.dead_letters.waiting == 1


@pytest.mark.mosquitto
async def test_one_log_line_per_message_above_ten_in_flight(mosquitto, outbox, caplog):
    """aiomqtt 2.5.1 warned over a thousand times in a run of 2000 messages."""
    caplog.set_level(logging.DEBUG)
    async with publishing(outbox, mosquitto.port):
        await append(outbox, 2000)
        await eventually(lambda: outbox.counters.depth == 0, "all are acknowledged")
    assert [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING] == []
    assert len([r for r in caplog.records if r.name.startswith(("daqsvc", "aiomqtt", "paho", "mqtt"))]) < 10


@pytest.mark.long
@pytest.mark.mosquitto
async def test_availability_flaps_when_two_boxes_share_a_client_id(tmp_path, mosquitto, outbox, caplog):
    """frigate#3280: each connection ends the other, and the availability goes on and off for ever."""
    other = Outbox(tmp_path / "other.sqlite", CLOCK)
    await other.open()
    async with publishing(outbox, mosquitto.port) as first, publishing(other, mosquitto.port) as second:
        await eventually(
            lambda: "because of another client with client_id" in caplog.text, "it is understood"
        )
        assert "'daqsvc-test'; give each box its own" in caplog.text
        # Whoever it was has come back ever later, and says no more about it.
        weary = max(first, second, key=lambda publisher: publisher._quick_losses)
        assert weary._backoff.ceiling_ns >= FIRST_RETRY_NS * 2**3
        weary._judge(11.0, OSError("lost"))
        assert weary._backoff.ceiling_ns >= FIRST_RETRY_NS * 2**3, "eleven seconds are no peace yet"
        weary._quick_losses = SUSPICIOUS_LOSSES
        weary._away(OSError("lost"))
        weary._judge(0.1, OSError("lost"))
        assert weary.reason.endswith("lost; perhaps another client has client_id 'daqsvc-test', too")
        assert weary.code is CLIENT_ID_TAKEN
    await other.close()


@pytest.mark.mosquitto
async def test_the_last_word_of_a_broker_that_flapped_is_that_it_is_back(
    mosquitto, outbox, caplog, monkeypatch
):
    """After the third quick loss a connection is not believed at once, but when it has lasted."""
    monkeypatch.setattr("daqsvc.publish.mqtt.publisher.STABLE_S", 0.5)
    monkeypatch.setattr("daqsvc.publish.mqtt.publisher.FIRST_RETRY_NS", 10_000_000)
    async with TcpProxy(mosquitto.port) as wire, publishing(outbox, wire.port) as publisher:
        for connections in range(1, SUSPICIOUS_LOSSES + 2):
            await eventually(lambda n=connections: publisher.counters.connections == n, "it is there")
            await eventually(lambda: publisher.counters.connected, "connected")
            if connections <= SUSPICIOUS_LOSSES:
                wire.cut()
        assert publisher._outage.is_reported
        assert "because of another client" in caplog.text
        await eventually(lambda: not publisher._outage.is_reported, "it has lasted")
        assert caplog.messages[-1] == f"MQTT broker 127.0.0.1:{wire.port} is back"
        caplog.clear()
        wire.cut()
        await eventually(lambda: publisher.counters.connections == connections + 1, "once more")
        away, *_, back = caplog.messages
        assert "is away" in away, "another outage, told anew"
        assert back.endswith("is back")


@pytest.mark.gives("O13")
@pytest.mark.mosquitto
async def test_a_broker_that_tells_of_a_rival_is_believed_at_once(mosquitto, outbox, caplog):
    """MQTT 5 has a reason code for it, 0x8E, session taken over."""
    async with TcpProxy(mosquitto.port) as wire, publishing(outbox, wire.port) as publisher:
        await eventually(lambda: publisher.counters.connected, "connected")
        wire._writers[0].write(b"\xe0\x02\x8e\x00")
        await eventually(lambda: "ended by another client with client_id" in caplog.text, "it is said")
        assert not publisher.counters.connected, "nor while it waits to come back"
        assert publisher.reason.startswith(f"127.0.0.1:{wire.port}: ")
        await asyncio.sleep(1.5)  # more than the first wait after any other loss
        assert publisher.counters.connections == 1


async def test_a_connected_broker_without_traffic_is_reconnected_to_in_a_storm(outbox, monkeypatch):
    """telegraf#16038: connected, nothing gets through, a new connection, and so on at the same pace."""
    monkeypatch.setattr("daqsvc.publish.mqtt.connection.PUBACK_S", 0.1)
    monkeypatch.setattr("daqsvc.publish.mqtt.publisher.PUBACK_S", 0.1)
    monkeypatch.setattr("daqsvc.publish.mqtt.publisher.STABLE_S", 0.05)
    monkeypatch.setattr("daqsvc.publish.mqtt.publisher.FIRST_RETRY_NS", 10_000_000)
    await append(outbox, 1)
    async with (
        PickyBroker(only_availability) as broker,
        publishing(outbox, broker.port, "3.1.1") as publisher,
    ):
        await eventually(lambda: broker.connections >= 5, "it keeps trying")
        await eventually(
            lambda: publisher._backoff.ceiling_ns >= 10_000_000 * 2**4, "each time after a longer wait"
        )
    assert outbox.counters.sent == 0


@pytest.mark.mosquitto
async def test_a_dead_connection_without_traffic_goes_unnoticed(mosquitto, outbox, caplog):
    """Connected but no traffic: the keep-alive notices, also when there is nothing to publish."""
    async with (
        TcpProxy(mosquitto.port) as wire,
        publishing(outbox, wire.port, keepalive_s=1) as publisher,
    ):
        await eventually(lambda: publisher.counters.connected, "connected")
        wire.deaf = True
        await eventually(lambda: "is away" in caplog.text, "the silence is noticed")
        wire.deaf = False
        await eventually(lambda: publisher.counters.connections == 2, "connected again")


@pytest.mark.mosquitto
async def test_all_boxes_come_back_at_the_same_instant(outbox, mosquitto):
    """Full jitter, also in the first wait after a loss: a broker that restarts is not run over."""
    waits = []
    for _ in range(40):
        async with publishing(outbox, mosquitto.port) as publisher:
            waits.append(publisher._backoff.next_ns() / 1e9)
    assert max(waits) < 0.8
    assert min(waits) < 0.4 < max(waits)
    assert len(set(waits)) == 40


class Subscriber5:
    """An MQTT 5 client with a session that the broker keeps while it is away."""

    def __init__(self, port):
        self.port = port
        self.messages = []

    def listen(self):
        """Connect, subscribe, and take what comes until `leave`; blocks until subscribed."""
        ready = threading.Event()
        self._client = paho.Client(paho.CallbackAPIVersion.VERSION2, "keeper", protocol=paho.MQTTv5)
        self._client.on_connect = lambda client, *_: client.subscribe("daqsvc/#", qos=1)
        self._client.on_subscribe = lambda *_: ready.set()
        self._client.on_message = lambda _c, _u, message: self.messages.append(message)
        kept = paho.Properties(paho.PacketTypes.CONNECT)
        kept.SessionExpiryInterval = 60
        self._client.connect("127.0.0.1", self.port, clean_start=False, properties=kept)
        self._client.loop_start()
        assert ready.wait(PATIENCE_S)

    def leave(self):
        self._client.disconnect()
        self._client.loop_stop()

    def on(self, part):
        return [message for message in self.messages if part in message.topic]


@pytest.mark.long
@pytest.mark.mosquitto
async def test_stale_telemetry_is_delivered_after_hours(mosquitto, outbox):
    """ism7mqtt#79, zigbee2mqtt#3740: what was measured before the outage comes as if it were new."""
    keeper = Subscriber5(mosquitto.port)
    await asyncio.to_thread(keeper.listen)
    async with publishing(outbox, mosquitto.port, telemetry_expiry_s=1.0) as publisher:
        publisher.telemetry("status", b"{}")
        await eventually(lambda: keeper.on("/status"), "it is delivered while it is fresh")
        assert keeper.on("/status")[0].properties.MessageExpiryInterval == 1
        await asyncio.to_thread(keeper.leave)
        publisher.telemetry("status", b"{}")
        await append(outbox, 1)
        await eventually(lambda: publisher.counters.telemetry_sent == 2, "the broker has it")
        await asyncio.sleep(2.5)  # the broker counts in whole seconds
        await asyncio.to_thread(keeper.listen)
        await eventually(lambda: keeper.on("/alarms/"), "the alarm is still delivered")
        assert len(keeper.on("/status")) == 1
        assert not hasattr(keeper.on("/alarms/")[0].properties, "MessageExpiryInterval")
    await asyncio.to_thread(keeper.leave)


@pytest.mark.mosquitto
async def test_telemetry_that_the_broker_refuses_holds_up_the_alarms(tmp_path, outbox, caplog):
    acl = "topic write daqsvc/lab/edge-1/availability\ntopic write daqsvc/lab/edge-1/rig/alarms/#\n"
    with running_mosquitto(tmp_path, acl=acl) as strict:
        async with publishing(outbox, strict.port) as publisher:
            for _ in range(5):
                publisher.telemetry("status", b"{}")
            await eventually(lambda: publisher.counters.telemetry_refused == 5, "it is refused")
            await append(outbox, 3)
            await eventually(lambda: outbox.counters.depth == 0, "the alarms pass")
            assert publisher.counters.connections == 1
    assert len([r for r in caplog.records if "is dropped and counted" in r.getMessage()]) == 1


@pytest.mark.long
@pytest.mark.mosquitto
async def test_alarms_wait_behind_a_backlog_of_telemetry(mosquitto, outbox):
    """One queue for everything: the alarm of today comes after the status of the whole night."""
    async with TcpProxy(mosquitto.port) as wire:
        wire.blocked = True
        async with publishing(outbox, wire.port) as publisher:
            for number in range(3000):
                publisher.telemetry("status", json.dumps({"number": number}).encode())
            await append(outbox, 20)
            wire.blocked = False
            await eventually(lambda: outbox.counters.depth == 0, "the alarms are acknowledged")
            assert publisher.counters.telemetry_sent < 500
            await eventually(lambda: publisher.counters.telemetry_sent == 3000, "the rest follows")


@pytest.mark.mosquitto
async def test_reading_certificates_blocks_the_event_loop(mosquitto, outbox, monkeypatch):
    """Loading the system's certificates takes tens of milliseconds."""
    threads = []
    read = credentials.read_credentials

    def remember(settings):
        threads.append(threading.current_thread())
        return read(settings)

    monkeypatch.setattr("daqsvc.publish.mqtt.publisher.read_credentials", remember)
    async with publishing(outbox, mosquitto.port) as publisher:
        await eventually(lambda: publisher.counters.connected, "connected")
    assert threads
    assert threading.main_thread() not in threads


@pytest.mark.mosquitto
async def test_threads_and_tasks_grow_with_every_reconnect(mosquitto, outbox):
    """plc4x#2229 and others: what a lost connection leaves behind adds up over months."""
    async with TcpProxy(mosquitto.port) as wire, publishing(outbox, wire.port) as publisher:
        publisher._backoff.next_ns = lambda: 1_000_000
        counts = []
        for number in range(2, 22):
            await eventually(lambda: publisher.counters.connected, "connected")
            await append(outbox, 1)
            await eventually(lambda: outbox.counters.depth == 0, "working")
            counts.append((threading.active_count(), len(asyncio.all_tasks())))
            wire.cut()
            await eventually(lambda n=number: publisher.counters.connections >= n, "connected again")
    early, late = counts[4], counts[-1]
    assert late[0] <= early[0] + 2
    assert late[1] <= early[1] + 2
