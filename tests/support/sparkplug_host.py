"""A Sparkplug host application for tests: sees every message as it is, and reads payloads by itself.

It shares no code with the edge node: payloads are read by the rules of the protocol-buffers encoding and
the field numbers of the Sparkplug specification.
"""

from __future__ import annotations

import asyncio
import json
import struct
import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.properties import Properties
from paho.mqtt.subscribeoptions import SubscribeOptions
from support.ports import LOOPBACK
from support.waiting import PATIENCE_S

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


def fields_of(raw: bytes) -> Iterator[tuple[int, Any]]:
    """Field numbers and what they contain: an int, or bytes."""
    at = 0

    def varint() -> int:
        nonlocal at
        number = shift = 0
        while True:
            number |= (raw[at] & 127) << shift
            shift += 7
            at += 1
            if raw[at - 1] < 128:
                return number

    while at < len(raw):
        number, wire = divmod(varint(), 8)
        if wire == 0:
            yield number, varint()
            continue
        size = {1: 8, 5: 4}.get(wire) or varint()
        yield number, raw[at : at + size]
        at += size


@dataclass(frozen=True)
class SeenMetric:
    name: str | None
    alias: int | None
    timestamp: int | None
    datatype: int | None
    historical: bool
    null: bool
    value: Any
    properties: dict[str, str]


@dataclass(frozen=True)
class Seen:
    """One message: kind is e.g. ``"NBIRTH"``; seq and timestamp are None where the payload has none."""

    topic: str
    qos: int
    retain: bool
    raw: bytes
    kind: str
    device: str | None
    seq: int | None
    timestamp: int | None
    metrics: list[SeenMetric] = field(default_factory=list)

    def metric(self, name: str) -> SeenMetric:
        metrics = [metric for metric in self.metrics if metric.name == name]
        assert len(metrics) == 1, f"{self.kind} has {len(metrics)} metrics {name!r}"
        return metrics[0]

    def value(self, name: str) -> Any:
        return self.metric(name).value


def metric_of(raw: bytes) -> SeenMetric:
    fields = dict(fields_of(raw))
    readers: dict[int, Callable[[Any], Any]] = {
        10: lambda number: number,
        11: lambda number: number,
        12: lambda four: struct.unpack("<f", four)[0],
        13: lambda eight: struct.unpack("<d", eight)[0],
        14: bool,
        15: lambda text: text.decode(),
    }
    values = [readers[number](content) for number, content in fields.items() if number in readers]
    assert len(values) <= 1, "a metric has one value at most"
    properties: dict[str, str] = {}
    if 9 in fields:
        pairs = list(fields_of(fields[9]))
        keys = [content.decode() for number, content in pairs if number == 1]
        texts = [dict(fields_of(content)) for number, content in pairs if number == 2]
        assert len(keys) == len(texts)
        assert all(text[1] == 12 for text in texts), "every property has the type of a string"
        properties = {key: text[8].decode() for key, text in zip(keys, texts, strict=True)}
    name = fields.get(1)
    return SeenMetric(
        name=None if name is None else name.decode(),
        alias=fields.get(2),
        timestamp=fields.get(3),
        datatype=fields.get(4),
        historical=bool(fields.get(5, 0)),
        null=bool(fields.get(7, 0)),
        value=values[0] if values else None,
        properties=properties,
    )


def seen(topic: str, raw: bytes, qos: int, *, retain: bool) -> Seen:
    parts = topic.split("/")
    fields = list(fields_of(raw))
    assert {number for number, _ in fields} <= {1, 2, 3}
    single = dict(fields)
    return Seen(
        topic=topic,
        qos=qos,
        retain=retain,
        raw=raw,
        kind=parts[2],
        device=parts[4] if len(parts) > 4 else None,
        seq=single.get(3),
        timestamp=single.get(1),
        metrics=[metric_of(content) for number, content in fields if number == 2],
    )


class Host:
    """Subscribes to everything of Sparkplug, in the order in which the broker passes it on."""

    def __init__(self, port: int, host_id: str = "scada") -> None:
        self.messages: list[Seen] = []
        self._host_id = host_id
        self._port = port
        self._subscribed = threading.Event()
        self._client = paho.Client(
            CallbackAPIVersion.VERSION2,
            client_id=f"host-{time.monotonic_ns()}",
            protocol=paho.MQTTv5,
            reconnect_on_failure=False,
        )
        # Quality of service and the retain flag as the publisher chose them.
        options = SubscribeOptions(2, noLocal=True, retainAsPublished=True)
        self._client.on_connect = lambda client, *_: client.subscribe("spBv1.0/#", options=options)
        self._client.on_subscribe = lambda *_: self._subscribed.set()
        self._client.on_message = self._take

    def _take(self, _client: object, _userdata: object, message: paho.MQTTMessage) -> None:
        if "/STATE/" not in message.topic:
            self.messages.append(
                seen(message.topic, bytes(message.payload), message.qos, retain=message.retain)
            )

    async def __aenter__(self) -> Self:
        await asyncio.to_thread(self._client.connect, LOOPBACK, self._port)
        self._client.loop_start()
        assert await asyncio.to_thread(self._subscribed.wait, PATIENCE_S), "the host could not subscribe"
        return self

    async def __aexit__(self, *_: object) -> None:
        self._client.disconnect()
        await asyncio.to_thread(self._client.loop_stop)

    def of(self, *kinds: str) -> list[Seen]:
        return [message for message in self.messages if message.kind in kinds]

    def names(self) -> dict[int, str]:
        """Names by alias, from all births so far."""
        births = [metric for message in self.of("NBIRTH", "DBIRTH") for metric in message.metrics]
        return {metric.alias: str(metric.name) for metric in births if metric.alias is not None}

    def told(self, name: str, *, historical: bool) -> list[Any]:
        """Values of a metric in data messages, in order."""
        alias = {known: number for number, known in self.names().items()}.get(name)
        return [
            metric.value
            for message in self.of("NDATA", "DDATA")
            for metric in message.metrics
            if metric.alias == alias and metric.historical is historical
        ]

    def say_state(self, *, online: bool, timestamp: int) -> None:
        state = json.dumps({"online": online, "timestamp": timestamp})
        self._client.publish(f"spBv1.0/STATE/{self._host_id}", state, 1, retain=True).wait_for_publish(5.0)

    def say_word(self, word: str) -> None:
        """Its state as of Sparkplug 2.2."""
        self._client.publish(f"STATE/{self._host_id}", word, 1, retain=True).wait_for_publish(5.0)

    def ask(self, topic: str, payload: bytes) -> None:
        plain = Properties(3)  # type: ignore[no-untyped-call]
        self._client.publish(topic, payload, 0, properties=plain).wait_for_publish(PATIENCE_S)
