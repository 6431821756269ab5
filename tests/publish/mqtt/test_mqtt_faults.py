"""Mistakes of this program cost a connection at most; the version that a broker speaks is found once."""

from __future__ import annotations

import asyncio
import json

import pytest
from support.mqtt_publishing import publishing
from support.rogue_broker import PickyBroker, length_of
from support.waiting import PATIENCE_S, eventually

from daqsvc.publish.mqtt import session
from daqsvc.publish.mqtt.publisher import MqttPublisher

pytestmark = pytest.mark.integration
ALARM = "daqsvc/lab/edge-1/rig/alarms/rotor-fault"


@pytest.mark.gives("O17")
@pytest.mark.parametrize(
    "error", [KeyError("x"), RecursionError(), ValueError("\ud800"), RuntimeError("a\nb")]
)
@pytest.mark.parametrize("where", ["_connect", "_serve"])
async def test_whatever_goes_wrong_in_the_publisher_is_said_once_and_tried_again(
    outbox, caplog, monkeypatch, error, where
):
    work = getattr(MqttPublisher, where)
    left = 3

    async def fails(self, *arguments):
        nonlocal left
        if left:
            left -= 1
            raise error
        return await work(self, *arguments)

    monkeypatch.setattr(MqttPublisher, where, fails)
    monkeypatch.setattr("daqsvc.publish.mqtt.publisher.FIRST_RETRY_NS", 1_000_000)
    async with (
        PickyBroker(lambda _topic, _size: True) as broker,
        publishing(outbox, broker.port) as publisher,
    ):
        await outbox.append(ALARM, lambda n: json.dumps({"sequence": n}).encode(), retain=True)
        await eventually(lambda: outbox.counters.depth == 0, "it publishes in the end")
        assert publisher.figures()["faults"] == 3
    said = [r for r in caplog.records if "publishing was interrupted" in r.getMessage()]
    assert len(said) == 1
    assert type(error).__name__ in said[0].getMessage()
    assert "\n" not in said[0].getMessage()


@pytest.mark.parametrize("part", ["_look_after_credentials", "_listen"])
async def test_a_part_of_the_session_that_fails_takes_nothing_else_with_it(outbox, monkeypatch, part):
    work, left = getattr(session.Session, part), 2

    async def fails(self):
        nonlocal left
        if left:
            left -= 1
            raise LookupError
        await work(self)

    monkeypatch.setattr(session.Session, part, fails)
    monkeypatch.setattr("daqsvc.publish.mqtt.publisher.FIRST_RETRY_NS", 1_000_000)
    async with (
        PickyBroker(lambda _topic, _size: True) as broker,
        publishing(outbox, broker.port) as publisher,
    ):
        await eventually(lambda: publisher.figures()["faults"] == 2, "it is counted")
        await outbox.append(ALARM, lambda n: json.dumps({"sequence": n}).encode(), retain=True)
        await eventually(lambda: outbox.counters.depth == 0, "it publishes in the end")


class OldBroker(PickyBroker):
    """Waits for the rest of an MQTT 5 CONNECT as if it were a broken packet, like amqtt."""

    def __init__(self):
        super().__init__(lambda _topic, _size: True)
        self.asked = []

    async def _serve(self, reader, writer):
        self._writers.add(writer)
        await reader.readexactly(1)
        body = await reader.readexactly(await length_of(reader))
        self.asked.append(body[6])
        if body[6] == 5:
            await reader.read()
            writer.close()
            return
        self._mqtt5 = False
        writer.write(b"\x20\x02\x00\x00")
        await self._rest(reader, writer)


async def test_a_broker_that_knows_no_mqtt_5_is_found_out_once(outbox, monkeypatch):
    """And asked for it again when it may be another one."""
    monkeypatch.setattr("daqsvc.publish.mqtt.publisher.FIRST_RETRY_NS", 1_000_000)
    monkeypatch.setattr("daqsvc.publish.mqtt.spoken.HASTE_S", 0.05)
    monkeypatch.setattr("daqsvc.publish.mqtt.connection.CONSENT_S", PATIENCE_S)
    async with OldBroker() as broker:
        for _ in range(3):
            async with publishing(outbox, broker.port, "auto") as publisher:
                await eventually(lambda p=publisher: p.counters.connected, "connected")
        assert broker.asked == [5, 4, 4, 4]
        monkeypatch.setattr("daqsvc.publish.mqtt.spoken.REMEMBERED_NS", 0)
        async with publishing(outbox, broker.port, "auto") as publisher:
            await eventually(lambda: publisher.counters.connected, "connected")
        assert broker.asked == [5, 4, 4, 4, 5, 4]


async def test_a_broker_of_mqtt_5_that_takes_its_time_gets_it(outbox, monkeypatch):
    """It is asked in 3.1.1, does not answer to that either, and then is waited for."""
    monkeypatch.setattr("daqsvc.publish.mqtt.publisher.FIRST_RETRY_NS", 1_000_000)
    monkeypatch.setattr("daqsvc.publish.mqtt.spoken.HASTE_S", 0.05)
    monkeypatch.setattr("daqsvc.publish.mqtt.spoken.CONSENT_S", 1.0)

    class Slow(PickyBroker):
        async def _serve(self, reader, writer):
            if len(self._writers) < 2:
                self._writers.add(writer)
                await reader.read()  # deaf to the first two
                writer.close()
                return
            await asyncio.sleep(0.3)
            await super()._serve(reader, writer)

    async with (
        Slow(lambda _topic, _size: True) as broker,
        publishing(outbox, broker.port, "auto") as publisher,
    ):
        await eventually(lambda: publisher.counters.connected, "connected")
        assert broker._mqtt5
    assert not (outbox.directory / "mqtt-version.json").exists()


@pytest.mark.parametrize("left", [b"", b"[", b"\xff", b"[1]", b'{"broker": 1}', b"[" * 100_000])
async def test_what_an_earlier_run_left_may_be_anything(outbox, left):
    (outbox.directory / "mqtt-version.json").write_bytes(left)
    async with (
        PickyBroker(lambda _t, _s: True) as broker,
        publishing(outbox, broker.port, "auto") as publisher,
    ):
        await eventually(lambda: publisher.counters.connected, "connected")
        assert publisher.figures()["faults"] == 0
