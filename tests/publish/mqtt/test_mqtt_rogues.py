"""A rogue broker, and a rogue client of an honest one: nothing but counters may move."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import random
import socket
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import paho.mqtt.client as paho
import pytest
from support.brokers import Consumer
from support.examples import first_of
from support.live_service import play, running
from support.mqtt_grammar import COMMANDS, DISCOVERIES, TOPICS, payload
from support.mqtt_publishing import commands, publishing
from support.rogue_broker import CONSENT, RogueBroker
from support.sparkplug_edge import Machine, edge_node
from support.waiting import eventually
from test_mqtt_schemas import rig

from daqsvc.alarms.commands import CommandOutcome, Verb
from daqsvc.publish.home_assistant.settings import HomeAssistant
from daqsvc.publish.mqtt.connection import OWED, Connection
from daqsvc.publish.mqtt.wire import Wire
from daqsvc.publish.output import Watched

pytestmark = pytest.mark.integration
ALARM = "daqsvc/lab/edge-1/rig/alarms/rotor-fault"
QUIET = "daqsvc/lab/edge-1/rig/alarms/shaft-vibration-x"
MOST_GROWTH_MIB = 64


class Desk:
    def __init__(self):
        self.asked = []

    async def __call__(self, command, source):
        self.asked.append((command, source))
        return CommandOutcome(accepted=True)


def resident_mib():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


class Looking(logging.Handler):
    """Keeps what no record may be; all of them would take more memory than the box."""

    def __init__(self):
        super().__init__(logging.INFO)
        self.wrong = []

    def emit(self, record):
        said = record.getMessage()
        if record.exc_info or "Traceback" in said or len(said) > 2000 or not said.isprintable():
            self.wrong.append(said)


@contextlib.contextmanager
def nothing_but_counters_move(caplog, most_growth_mib=MOST_GROWTH_MIB):
    """No traceback, no complaint of the event loop, no memory that grows without end."""
    complaints = []
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(lambda _loop, context: complaints.append(context))
    looking, ours = Looking(), logging.getLogger("daqsvc")
    ours.addHandler(looking)
    ours.propagate = False
    ours.setLevel(logging.INFO)
    before_mib = resident_mib()
    try:
        yield
    finally:
        ours.removeHandler(looking)
        ours.propagate = True
        ours.setLevel(logging.NOTSET)
    assert complaints == []
    assert looking.wrong == []
    assert [r.getMessage() for r in caplog.records if r.exc_info] == []
    said = [r.getMessage() for r in caplog.records if r.name == "asyncio"]
    assert set(said) <= {"socket.send() raised exception."}, "which is the rogue's own"
    assert resident_mib() - before_mib < most_growth_mib


@contextlib.asynccontextmanager
async def listening(outbox, port, protocol, desk):
    """A publisher that takes commands and tells Home Assistant, and comes back at once after each loss."""
    rig = Watched("rig", alarms=("rotor-fault",))
    allowed = commands(*Verb)
    async with publishing(
        outbox, port, protocol, handler=desk, commands=allowed, home_assistant=HomeAssistant(), watched=rig
    ) as publisher:
        publisher._backoff.next_ns = lambda: 1_000_000
        yield publisher


async def rogue_broker(outbox, caplog, monkeypatch, protocol, packets):
    monkeypatch.setattr("daqsvc.publish.mqtt.publisher.TAKEN_OVER_S", 0.001)
    monkeypatch.setattr("daqsvc.publish.home_assistant.link.EARLIER_S", 0.01)
    monkeypatch.setattr("daqsvc.publish.mqtt.suspects.FIRST_BAR_S", 0.001)
    monkeypatch.setattr("daqsvc.publish.mqtt.suspects.LONGEST_BAR_S", 0.001)
    desk = Desk()
    with nothing_but_counters_move(caplog):
        async with (
            RogueBroker(packets, packets) as broker,
            listening(outbox, broker.port, protocol, desk) as box,
        ):
            while broker.left:
                await outbox.append(ALARM, lambda _: b"{}", retain=True)
                box.telemetry("status", b"{}")
                await asyncio.sleep(0.01)
            await eventually(lambda: box.counters.connected, "connected to what is an honest broker now")
            broker.taken.clear()
            written = outbox.counters.appended
            await outbox.append(ALARM, lambda _: b"{}", retain=True)
            box.telemetry("status", b"{}")
            await eventually(lambda: ALARM in broker.taken, "alarms pass")
            await eventually(lambda: "daqsvc/lab/edge-1/status" in broker.taken, "and so does telemetry")
            assert outbox.counters.appended == written + 1
            assert box.figures()["faults"] == 0
            figures = box.figures()
    assert desk.asked == [], "what it sends is far too old to be obeyed"
    assert broker.connections > packets / 200
    assert figures["ignored"] > 0
    assert figures["commands"]["malformed"] > 0


@pytest.mark.long
@pytest.mark.parametrize("protocol", first_of("5", "3.1.1"))
async def test_a_rogue_broker_costs_connections_and_nothing_else(outbox, caplog, monkeypatch, protocol):
    await rogue_broker(outbox, caplog, monkeypatch, protocol, 2000)


@pytest.mark.long
@pytest.mark.marathon
@pytest.mark.timeout(900)
@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
async def test_a_rogue_broker_with_a_lot_of_patience(outbox, caplog, monkeypatch, protocol):
    await rogue_broker(outbox, caplog, monkeypatch, protocol, 100_000)


def rogue_message(dice):
    """Topic, payload, QoS, retain and properties of a message that an honest broker passes on."""
    topics = (*TOPICS, f"{COMMANDS}/{'x' * 65_000}")
    topic = dice.choice(topics) if dice.random() < 0.5 else f"{COMMANDS}/acknowledge"
    told = paho.Properties(paho.PacketTypes.PUBLISH)
    if dice.random() < 0.3:
        told.ResponseTopic = dice.choice(("operators/ada", ALARM, "homeassistant/device/x/config", "x" * 300))
    if dice.random() < 0.3:
        told.CorrelationData = dice.randbytes(dice.choice((0, 8, 60_000)))
    return topic, payload(dice), dice.choice((0, 1)), dice.random() < 0.05, told


async def rogue_client(mosquitto, outbox, caplog, protocol, messages):
    desk = Desk()
    dice = random.Random(messages)
    sender = paho.Client(paho.CallbackAPIVersion.VERSION2, "rogue", protocol=paho.MQTTv5)
    with nothing_but_counters_move(caplog):
        async with (
            Consumer(mosquitto.port, QUIET) as live,
            listening(outbox, mosquitto.port, protocol, desk) as box,
        ):
            await eventually(lambda: box.counters.connected, "connected")
            await asyncio.to_thread(sender.connect, "127.0.0.1", mosquitto.port)
            sender.loop_start()
            for number in range(messages):
                sender.publish(*rogue_message(dice))
                if number % 50 == 0:
                    await asyncio.sleep(0.02)
                    await eventually(lambda: not sender.want_write(), "the broker takes what is sent")
            arrived = sender.publish(f"{COMMANDS}/acknowledge", b"the last", 1)
            await eventually(arrived.is_published, "the broker has it all")
            sender.disconnect()
            await asyncio.to_thread(sender.loop_stop)
            await outbox.append(QUIET, lambda _: b"{}", retain=True)
            await eventually(lambda: live.messages, "alarms pass")
            figures = box.figures()
    assert desk.asked == []
    assert figures["faults"] == 0
    assert figures["connections"] == 1
    assert figures["commands"]["malformed"] > 0
    assert figures["commands"]["stale"] > 0


@pytest.mark.long
@pytest.mark.mosquitto
@pytest.mark.parametrize("protocol", first_of("5", "3.1.1"))
async def test_a_rogue_client_moves_counters_and_nothing_else(mosquitto, outbox, caplog, protocol):
    await rogue_client(mosquitto, outbox, caplog, protocol, 2000)


@pytest.mark.long
@pytest.mark.marathon
@pytest.mark.mosquitto
@pytest.mark.timeout(900)
@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
async def test_a_rogue_client_with_a_lot_of_patience(mosquitto, outbox, caplog, protocol):
    await rogue_client(mosquitto, outbox, caplog, protocol, 100_000)


FOREIGN = ("notice", "company/notice", "company/site/notice", "daqsvc/lab/edge-2/rig/commands/acknowledge")


def message(topic, *, mqtt5, said=b"{}", flags=1):
    raw = topic.encode()
    body = len(raw).to_bytes(2, "big") + raw + (b"\x00" if mqtt5 else b"") + said
    return bytes([0x30 | flags, len(body)]) + body


@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
@pytest.mark.parametrize("when", ["before its consent", "with its consent", "afterwards"])
async def test_messages_that_nobody_subscribed_to_are_ignored_at_every_start(outbox, caplog, protocol, when):
    """Retained at the broker, or of a session of long ago; aedes and amqtt send them while the box
    connects."""
    mqtt5 = protocol == "5"
    strays = b"".join(message(topic, mqtt5=mqtt5) for topic in FOREIGN)

    class Hasty(RogueBroker):
        async def _serve(self, reader, writer):
            write = writer.write
            ways = {
                "before its consent": lambda data: write(strays + data),
                "with its consent": lambda data: write(data + strays),
                "afterwards": lambda data: (
                    write(data),
                    asyncio.get_running_loop().call_later(0.01, write, strays),
                ),
            }

            def written(data):
                (ways[when] if data == CONSENT[mqtt5] else write)(data)

            writer.write = written
            await super()._serve(reader, writer)

    desk = Desk()
    with nothing_but_counters_move(caplog):
        async with Hasty(1, 0) as broker:
            for start in range(1, 4):
                async with listening(outbox, broker.port, protocol, desk) as box:
                    await eventually(lambda b=box: b.counters.ignored == len(FOREIGN), "they are counted")
                    await outbox.append(ALARM, lambda _: b"{}", retain=True)
                    await eventually(lambda: outbox.counters.depth == 0, "alarms pass")
                    assert broker.connections == start
                    assert box.figures()["faults"] == 0
            assert not [topic for topic in broker.taken if "response" in topic], "nobody is answered there"
    assert desk.asked == []


@pytest.mark.mosquitto
@pytest.mark.parametrize("told", DISCOVERIES, ids=range(len(DISCOVERIES)))
async def test_a_retained_discovery_message_may_say_anything(mosquitto, outbox, caplog, told):
    topic = "homeassistant/device/daqsvc_2flab_2fedge-1_2frig/config"
    desk = Desk()
    sender = paho.Client(paho.CallbackAPIVersion.VERSION2, "rogue")
    await asyncio.to_thread(sender.connect, "127.0.0.1", mosquitto.port)
    sender.loop_start()
    left = sender.publish(topic, json.dumps(told), 1, retain=True)
    await eventually(left.is_published, "it is retained")
    sender.disconnect()
    await asyncio.to_thread(sender.loop_stop)
    with nothing_but_counters_move(caplog):
        async with (
            listening(outbox, mosquitto.port, "5", desk) as box,
            Consumer(mosquitto.port, topic) as live,
        ):
            await eventually(
                lambda: any("device" in m.payload for m in live.messages), "the box tells its own"
            )
            assert box.figures()["faults"] == 0
            assert box.counters.connections == 1


@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
async def test_a_rogue_broker_of_sparkplug_costs_connections_and_nothing_else(
    outbox, caplog, monkeypatch, tmp_path, protocol
):
    monkeypatch.setattr("daqsvc.publish.sparkplug.session.HOST_S", 0.05)
    with nothing_but_counters_move(caplog):
        async with (
            RogueBroker(7, 500) as broker,
            edge_node(outbox, tmp_path, broker.port, protocol=protocol) as edge,
        ):
            edge._backoff.next_ns = lambda: 1_000_000
            while broker.left:
                await Machine(outbox).flips(1)
                await asyncio.sleep(0.01)
            await eventually(lambda: edge.counters.connected, "connected to what is an honest broker now")
            births = edge.counters.births
            await eventually(lambda: edge.counters.births > births or edge.counters.alarms, "it tells")
            assert edge._faults.count == 0


@pytest.mark.mosquitto
async def test_with_mqtt_3_1_1_a_message_of_any_size_is_one_that_is_too_long(mosquitto, outbox, caplog):
    """No broker of 3.1.1 knows how much is too much: not even retained may it end every connection."""
    sender = paho.Client(paho.CallbackAPIVersion.VERSION2, "rogue")
    await asyncio.to_thread(sender.connect, "127.0.0.1", mosquitto.port)
    sender.loop_start()
    with nothing_but_counters_move(caplog):
        async with listening(outbox, mosquitto.port, "3.1.1", Desk()) as box:
            # Retained, so that it arrives also if the box subscribes only then.
            sender.publish(f"{COMMANDS}/acknowledge", b"{}", 1, retain=True)
            await eventually(lambda: box.figures()["commands"]["malformed"] == 1, "it listens to commands")
            for qos in (0, 1, 1):
                sender.publish(f"{COMMANDS}/acknowledge", b"x" * 3_000_000, qos)
            await eventually(lambda: box.figures()["commands"]["malformed"] == 4, "they are refused")
            sender.publish(f"{COMMANDS}/acknowledge", b"{}", 1)
            await eventually(lambda: box.figures()["commands"]["malformed"] == 5, "and the next one is read")
            assert box.counters.connections == 1
    sender.disconnect()
    await asyncio.to_thread(sender.loop_stop)


class Flooding(RogueBroker):
    """Sends messages as fast as they are taken."""

    async def _answer(self, reader, writer, *, mqtt5):
        # What waits between the two is what the box has to read before it hears of anything else.
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 16)
        answering = asyncio.create_task(super()._answer(reader, writer, mqtt5=mqtt5))
        flood = message("notice", mqtt5=True, said=b"x" * 100, flags=0) * 100
        with contextlib.suppress(OSError):
            while not answering.done():
                writer.write(flood)
                await writer.drain()
                await asyncio.sleep(0)
        answering.cancel()
        await asyncio.gather(answering, return_exceptions=True)


async def test_a_flood_of_messages_waits_in_the_brokers_socket(outbox, caplog, monkeypatch):
    monkeypatch.setattr("daqsvc.publish.mqtt.connection.FLOOD_PER_S", 2000)
    with nothing_but_counters_move(caplog):
        async with Flooding(1, 0) as broker, listening(outbox, broker.port, "5", Desk()) as box:
            await eventually(lambda: box.counters.ignored + box.counters.overlooked > 1000, "it floods")
            taken = box.counters.ignored + box.counters.overlooked
            await asyncio.sleep(1.0)
            assert box.counters.ignored + box.counters.overlooked - taken < 6000
            monkeypatch.undo()
            await outbox.append(ALARM, lambda _: b"{}", retain=True)
            await eventually(lambda: outbox.counters.depth == 0, "alarms pass all the same")
            assert box.counters.connections == 1


async def test_nothing_is_read_while_too_many_acknowledgements_wait():
    """A broker that sends messages of QoS 1, and takes nothing."""
    near, far = socket.socketpair()
    made = Connection("127.0.0.1", 1, in_flight=1, mqtt5=True, identifier="c")
    wire = Wire(near, mqtt5=True)
    near.setblocking(False)
    waits = True
    made._client = SimpleNamespace(want_write=lambda: waits, socket=lambda: wire, loop_write=lambda: None)
    made._attach(wire)
    try:
        wire.packets = OWED
        made._hold_back(wire)
        assert made._reads
        wire.packets += 1
        made._hold_back(wire)
        assert not made._reads
        made._write()
        assert not made._reads, "some are written, but not all"
        waits = False
        made._write()
        assert made._reads
        wire.packets += OWED
        made._hold_back(wire)
        assert made._reads, "a broker that takes what it is sent may send as much as it likes"
    finally:
        made.abandon()
        far.close()


async def test_a_rogue_broker_ends_no_acquisition(tmp_path, caplog, monkeypatch):
    monkeypatch.setattr("daqsvc.publish.mqtt.publisher.FIRST_RETRY_NS", 1_000_000)
    with nothing_but_counters_move(caplog, most_growth_mib=400):  # compiled kernels among them
        async with RogueBroker(11, 300) as broker, running(rig(broker.port), tmp_path / "store") as service:
            service.alarms.outputs["mqtt"]._backoff.next_ns = lambda: 1_000_000
            await play(service, np.zeros((1280, 3)), 640.0)
            await eventually(lambda: not broker.left, "it has sent what it wanted")
            streams = service.figures()["streams"]
            assert streams["shaft"]["samples_received"] > 1200
            assert streams["shaft"]["samples_lost"] == 0
            assert service.figures()["mqtt"]["faults"] == 0
            assert broker.connections > 1
