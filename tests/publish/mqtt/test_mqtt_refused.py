"""What a broker will not take holds up nothing else, is kept on disk, and is tried again."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from functools import partial

import pytest
from support.alarm_desk import alarm_service
from support.brokers import Consumer, running_mosquitto
from support.mqtt_publishing import CLOCK, mqtt, outputs, publishing
from support.ports import free_port
from support.rogue_broker import PickyBroker
from support.waiting import eventually

from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.alarms.events import Identity
from daqsvc.alarms.manager import DiagnosisRule
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.outbox.store import Outbox
from daqsvc.publish.mqtt.connection import Connection
from daqsvc.publish.mqtt.errors import MqttError

pytestmark = pytest.mark.integration
BASE = "daqsvc/lab/edge-1"
GOOD, BAD = f"{BASE}/rig/alarms/rotor-fault", f"{BASE}/rig/alarms/sensor-ok/probe-x"
ACL = f"""
topic write {BASE}/availability
topic write {BASE}/status
topic write {GOOD}
topic read #
"""


async def append(outbox, topic, count=1, size=0):
    """Alarms on disk; their numbers."""
    return [
        await outbox.append(
            topic, lambda n: f'{{"sequence": {n}, "x": "{"x" * size}"}}'.encode(), retain=True
        )
        for _ in range(count)
    ]


def sequences(live, topic):
    return [message.payload["sequence"] for message in live.on(topic)]


@contextlib.asynccontextmanager
async def opened(path):
    outbox = Outbox(path, CLOCK)
    await outbox.open()
    try:
        yield outbox
    finally:
        await outbox.close()


@pytest.mark.gives("O12")
@pytest.mark.mosquitto
async def test_one_topic_that_the_broker_refuses_holds_up_no_other(tmp_path, caplog):
    """And once it is allowed, what was refused comes in its order, after a restart of both too."""
    caplog.set_level(logging.INFO)
    store = tmp_path / "outbox.sqlite"
    with running_mosquitto(tmp_path, acl=ACL) as strict:
        async with opened(store) as outbox, Consumer(strict.port, f"{BASE}/#") as live:
            refused = await append(outbox, BAD)
            async with publishing(outbox, strict.port) as publisher:
                await eventually(lambda: outbox.dead_letters.waiting == 1, "it is among the refused")
                good = await append(outbox, GOOD, 30)
                refused += await append(outbox, BAD, 30)
                good += await append(outbox, GOOD, 30)
                await eventually(lambda: outbox.dead_letters.waiting == 31, "its followers wait behind it")
                await eventually(lambda: outbox.counters.depth == 0, "the rest goes on")
                await eventually(lambda: sequences(live, GOOD) == good, "in its order")
                assert publisher.refused == {BAD: "the broker refuses messages: Not authorized"}
                assert publisher.counters.connections == 1
                assert publisher.figures()["dead_letters"] == 31
    said = [record.getMessage() for record in caplog.records if BAD in record.getMessage()]
    assert len(said) == 1
    assert "refuses an alarm message" in said[0]
    assert "away" not in caplog.text
    with running_mosquitto(tmp_path, acl=ACL + f"topic write {BAD}\n") as kinder:
        async with (
            opened(store) as outbox,
            Consumer(kinder.port, f"{BASE}/#") as live,
            publishing(outbox, kinder.port) as publisher,
        ):
            refused += await append(outbox, BAD, 5)
            await eventually(lambda: len(sequences(live, BAD)) >= 36, "all have arrived")
            assert list(dict.fromkeys(sequences(live, BAD))) == refused
            await eventually(lambda: publisher.refused == {}, "nothing is refused any more")
            assert outbox.dead_letters.waiting == 0


@pytest.mark.mosquitto
async def test_what_is_too_large_for_the_broker_holds_up_no_other(tmp_path, outbox, caplog):
    caplog.set_level(logging.INFO)
    with running_mosquitto(tmp_path, config="max_packet_size 1000") as mosquitto:
        async with Consumer(mosquitto.port) as live, publishing(outbox, mosquitto.port) as publisher:
            await append(outbox, GOOD, size=2000)
            others = await append(outbox, BAD, 3)
            await eventually(lambda: sequences(live, BAD) == others, "the smaller ones have passed")
            await eventually(lambda: GOOD in publisher.refused, "the large one is kept")
            assert "raise the largest packet there" in publisher.refused[GOOD]
            publisher.telemetry("status", b"x" * 1000)
            await eventually(lambda: publisher.counters.telemetry_refused == 1, "telemetry is dropped")
            assert publisher.counters.connections == 1
        assert "exceeds" not in mosquitto.log_text
    assert "away" not in caplog.text


@pytest.mark.mosquitto
async def test_a_box_whose_availability_is_refused_publishes_all_the_same(tmp_path, outbox, caplog):
    with running_mosquitto(tmp_path, acl=f"topic write {GOOD}\ntopic read #\n") as strict:
        async with Consumer(strict.port) as live, publishing(outbox, strict.port) as publisher:
            written = await append(outbox, GOOD)
            await eventually(lambda: sequences(live, GOOD) == written, "the alarm has arrived")
            assert publisher.refused == {
                f"{BASE}/availability": "the broker refuses messages: Not authorized"
            }
    assert "away" not in caplog.text


async def test_a_broker_that_ends_the_connection_for_one_topic_loses_nothing_else(
    outbox, caplog, monkeypatch
):
    """MQTT 3.1.1 has no other way to refuse: the culprit is found by sending one at a time."""
    monkeypatch.setattr("daqsvc.publish.mqtt.publisher.FIRST_RETRY_NS", 10_000_000)
    caplog.set_level(logging.INFO)
    async with PickyBroker(lambda topic, _size: topic != BAD) as broker:
        good = await append(outbox, GOOD, 5)
        bad = await append(outbox, BAD)
        good += await append(outbox, GOOD, 5)
        async with publishing(outbox, broker.port, "3.1.1") as publisher:
            await eventually(lambda: BAD in publisher.refused, "the culprit is found")
            await eventually(lambda: outbox.counters.depth == 0, "the rest goes on")
            bad += await append(outbox, BAD, 3)
            good += await append(outbox, GOOD, 3)
            await eventually(lambda: broker.sequences(GOOD)[-1] == good[-1], "and so it stays")
            await eventually(lambda: outbox.dead_letters.waiting == 4, "what is refused is kept")
            connections = broker.connections
            assert connections <= 6
            await asyncio.sleep(0.3)
            assert broker.connections == connections, "it is left alone for a while"
        assert list(dict.fromkeys(broker.sequences(GOOD))) == good
        assert "away" not in caplog.text
        assert f"ends the connection whenever a message on {BAD} is sent" in caplog.text
        assert "give each box its own" not in caplog.text
        broker.takes = lambda _topic, _size: True
        async with publishing(outbox, broker.port, "3.1.1"):
            await eventually(lambda: outbox.dead_letters.waiting == 0, "it is tried again at the next start")
        assert broker.sequences(BAD) == bad


async def test_a_broker_that_ends_the_connection_for_a_size_loses_nothing_else(outbox, caplog, monkeypatch):
    monkeypatch.setattr("daqsvc.publish.mqtt.publisher.FIRST_RETRY_NS", 10_000_000)
    async with PickyBroker(lambda _topic, size: size < 2000) as broker:
        large = await append(outbox, GOOD, size=3000)
        others = await append(outbox, BAD, 3)
        async with publishing(outbox, broker.port, "3.1.1") as publisher:
            await eventually(lambda: broker.sequences(BAD) == others, "the smaller ones have passed")
            for _ in range(3):
                publisher.telemetry("status", b"x" * 4000)  # of the lower class, but it ends connections too
            publisher.telemetry("rig/diagnosis/levels", b"{}")
            await eventually(lambda: publisher.counters.telemetry_refused == 3, "telemetry is dropped")
            await eventually(lambda: publisher.counters.telemetry_sent == 1, "other telemetry is not")
        assert outbox.dead_letters.waiting == len(large)
    assert "away" not in caplog.text


async def test_a_broker_that_says_nothing_about_one_topic_loses_nothing_else(outbox, caplog, monkeypatch):
    """No PUBACK for one, though later ones are acknowledged: a refusal without a word."""
    monkeypatch.setattr("daqsvc.publish.mqtt.connection.PUBACK_S", 0.3)
    async with PickyBroker(lambda topic, _size: None if topic == BAD else True) as broker:
        await append(outbox, BAD)
        good = await append(outbox, GOOD, 5)
        async with publishing(outbox, broker.port, "3.1.1") as publisher:
            await eventually(lambda: outbox.counters.depth == 0, "the rest goes on")
            assert broker.sequences(GOOD) == good
            assert "not acknowledged it within 0.3 s" in publisher.refused[BAD]
            assert broker.connections == 1


async def test_each_message_has_the_whole_time_for_its_own_acknowledgement(monkeypatch):
    monkeypatch.setattr("daqsvc.publish.mqtt.connection.PUBACK_S", 0.6)
    async with PickyBroker(lambda topic, _size: None if topic == BAD else True) as broker:
        connection = Connection("127.0.0.1", broker.port, in_flight=20, mqtt5=False, identifier="box")
        await connection.open()
        loop = asyncio.get_running_loop()

        async def waited_s() -> float:
            begun_s = loop.time()
            with pytest.raises(MqttError):
                await connection.deliver(BAD, b"{}", retain=False)
            return loop.time() - begun_s

        unheard = []
        for _ in range(3):
            unheard.append(asyncio.create_task(waited_s()))
            await asyncio.sleep(0.1)
            await connection.deliver(GOOD, b"{}", retain=False)
        async with asyncio.timeout(10):
            assert min(await asyncio.gather(*unheard)) > 0.55
        await connection.deliver(GOOD, b"{}", retain=False)
        await connection.close(1.0)


async def test_a_message_overtaken_while_it_was_refused_does_not_become_the_latest(outbox):
    """A quota that is exceeded for a moment: later ones were under way already, and were taken."""
    async with PickyBroker(lambda _topic, _size: True, refuse_once=True) as broker:
        first, *later = await append(outbox, GOOD, 3)
        async with publishing(outbox, broker.port):
            await eventually(lambda: outbox.counters.depth == 0, "all are dealt with")
            await eventually(lambda: outbox.dead_letters.waiting == 1, "the first was refused")
        assert broker.sequences(GOOD) == later
        async with publishing(outbox, broker.port):
            await eventually(lambda: outbox.dead_letters.waiting == 0, "it is tried again")
        assert broker.sequences(GOOD).count(first) == 1
        assert broker.retained[GOOD]["sequence"] == later[-1]


async def test_a_disk_that_takes_no_refused_messages_keeps_them_in_the_journal(
    tmp_path, outbox, caplog, monkeypatch
):
    monkeypatch.setattr("daqsvc.publish.mqtt.delivery.TRY_AGAIN_S", 0.05)
    path = tmp_path / "alarms-refused.sqlite"
    outbox.dead_letters._path = path
    path.mkdir()
    async with PickyBroker(lambda _topic, _size: True, refuse={BAD}) as broker:
        bad = await append(outbox, BAD, 2)
        good = await append(outbox, GOOD, 2)
        async with publishing(outbox, broker.port):
            await eventually(lambda: broker.sequences(GOOD) == good, "the rest goes on")
            await eventually(lambda: outbox.counters.depth == 2, "the journal knows")
            assert [message.sequence for message in await outbox.pending(0, 10)] == bad
            assert "waits in the journal" in caplog.text
            path.rmdir()
            await eventually(lambda: outbox.dead_letters.waiting == 2, "now it takes them")
            await eventually(lambda: outbox.counters.depth == 0, "and the journal is done with them")
            broker.refuse.clear()
            await eventually(lambda: broker.sequences(BAD) == bad, "tried again, they arrive in their order")


@pytest.mark.parametrize("there", [True, False], ids=["a broker", "no broker"])
async def test_a_store_that_cannot_be_read_makes_no_outage_of_the_broker(outbox, caplog, there):
    """What was never said to be away is not back, and not still away; the store's fault is said once."""
    caplog.set_level(logging.INFO, "daqsvc.publish")
    path = outbox.dead_letters._path
    path.mkdir()
    word = "connected to MQTT broker" if there else " is away: "
    async with (
        PickyBroker(lambda _topic, _size: True) as broker,
        publishing(outbox, broker.port if there else free_port()),
    ):
        await eventually(lambda: "MQTT broker" in caplog.text, "the first word of the broker")
    said = [record.getMessage() for record in caplog.records]
    (fault,) = [at for at, line in enumerate(said) if "what was refused before waits until it can" in line]
    first = next(at for at, line in enumerate(said) if "MQTT broker" in line)
    assert fault < first
    assert word in said[first]


@pytest.mark.mosquitto
async def test_an_alarm_names_what_is_refused_and_returns_when_it_is_taken(tmp_path, monkeypatch):
    """Also where its own topic is among the refused."""
    monkeypatch.setattr("daqsvc.publish.mqtt.delivery.TRY_AGAIN_S", 0.1)
    monkeypatch.setattr("daqsvc.publish.mqtt.publisher.STABLE_S", 0.3)
    store = tmp_path / "store"
    alarm = f"{BASE}/rig/alarms/broker/refused"
    rules = [DiagnosisRule(name, name) for name in ("rotor-fault", "sensor")]

    def said(detector):
        return Diagnosis("rig", detector, CLOCK.monotonic_ns(), "shaft", 0, 1, "bad", severity="alert")

    async def desk_at(port):
        desk = alarm_service(Identity("lab", "edge-1", "rig"), rules, store, CLOCK, outputs(mqtt(port, "c")))
        await desk.open()
        await desk.resume({})
        return desk, asyncio.create_task(desk.outputs["mqtt"].run())

    async def closed(desk, running):
        await desk.settle(2.0)
        await desk.stop(2.0)
        await running
        await desk.close(2.0)

    async def ticking(desk, condition, what):
        def ticks():
            desk.tick()
            return condition()

        await eventually(ticks, what)

    sensor = f"{BASE}/rig/alarms/sensor"
    with running_mosquitto(tmp_path, acl=f"{ACL}topic write {alarm}\n") as strict:
        async with Consumer(strict.port, alarm) as live:
            desk, running = await desk_at(strict.port)
            try:
                desk.take(said("sensor"))
                await ticking(desk, lambda: live.messages, "the alarm has arrived")
                told = live.messages[-1].payload
                assert (told["kind"], told["level"]) == ("raised", "alert")
                assert f"{sensor} (the broker refuses messages: Not authorized)" in told["message"]
                acknowledge = AlarmCommand(verb=Verb.ACKNOWLEDGE, alarm="broker/refused", by="Anna")
                assert (await desk.execute(acknowledge, "test")).accepted
            finally:
                await closed(desk, running)
            for port in (strict.port, free_port()):
                # A restart knows nothing at first, and without a broker for long: it says nothing new.
                desk, running = await desk_at(port)
                try:
                    letters, publisher = desk.outbox.dead_letters, desk.outputs["mqtt"]
                    await ticking(desk, partial(getattr, letters, "is_known"), "the file was read")
                    if port == strict.port:
                        await ticking(desk, partial(getattr, publisher, "is_refused_known"), "it was asked")
                    desk.tick()
                finally:
                    await closed(desk, running)
                status = desk.manager.alarms["broker/refused"]
                assert status.state.value == "active_acknowledged"
            # The acknowledgement was the last word; a new connection tells it once more.
            assert {one.payload["kind"] for one in live.messages} == {"raised", "acknowledged"}
    with running_mosquitto(tmp_path, acl=f"{ACL}topic write {BASE}/#\n") as kinder:
        async with Consumer(kinder.port, f"{BASE}/rig/alarms/#") as live:
            desk, running = await desk_at(kinder.port)
            try:
                await eventually(lambda: live.on(sensor), "what was refused has arrived")
                await ticking(desk, lambda: live.messages[-1].payload["kind"] == "returned", "it is over")
                assert live.messages[-1].topic == alarm
            finally:
                await closed(desk, running)
