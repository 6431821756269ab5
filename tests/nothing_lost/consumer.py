"""Who the alarms are for: an independent MQTT 3.1.1 client with a persistent session."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from dataclasses import dataclass
from typing import Any, Self

import paho.mqtt.client as paho

LOOPBACK = "127.0.0.1"
PATIENCE_S = 60.0


@dataclass(frozen=True)
class Arrival:
    """An alarm message as it came: when (CLOCK_MONOTONIC), where, and the bytes."""

    t_ns: int
    topic: str
    payload: bytes

    @property
    def alarm(self) -> dict[str, Any]:
        """The payload."""
        told: dict[str, Any] = json.loads(self.payload)
        return told


class Consumer:
    """Receives every alarm message, over a connection that no fault touches, as long as the broker lives.

    A broker that has forgotten it is subscribed to anew; `subscribed` says when that is done.
    """

    def __init__(self, port: int, topic: str = "daqsvc/#") -> None:
        self.arrivals: list[Arrival] = []
        self.ids: set[str] = set()
        self.subscribed = threading.Event()
        self._port = port
        self._topic = topic

    async def __aenter__(self) -> Self:
        await self._join()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._leave()

    async def nap(self, duration_s: float) -> None:
        """Go away for a while; the broker keeps the session and what comes in the meantime."""
        await self._leave()
        await asyncio.sleep(duration_s)
        await self._join()

    async def is_listening(self) -> None:
        """Wait until the broker has it as a subscriber."""
        until = time.monotonic() + PATIENCE_S
        while not self.subscribed.is_set():
            if time.monotonic() > until:
                raise TimeoutError(f"the consumer could not subscribe within {PATIENCE_S:g} s")
            await asyncio.sleep(0.01)

    async def has(self, ids: set[str], timeout_s: float) -> bool:
        """Wait until it has received all of these, at most so long; whether it has."""
        until = time.monotonic() + timeout_s
        while not ids <= self.ids:
            if time.monotonic() > until:
                return False
            await asyncio.sleep(0.01)
        return True

    async def _join(self) -> None:
        # A client for each time: the loop of one may be stopped before it has seen the end, and then cannot
        # be started again without leaving sockets behind.
        self._client = client = paho.Client(
            paho.CallbackAPIVersion.VERSION2, client_id="consumer", clean_session=False
        )
        client.reconnect_delay_set(0.02, 0.1)  # type: ignore[arg-type]  # seconds; fractions work
        client.on_connect = self._connected
        client.on_disconnect = lambda *_: self.subscribed.clear()
        client.on_subscribe = lambda *_: self.subscribed.set()
        client.on_message = self._take
        client.connect_async(LOOPBACK, self._port)
        client.loop_start()
        await self.is_listening()

    async def _leave(self) -> None:
        self._client.disconnect()
        await asyncio.to_thread(self._client.loop_stop)
        self.subscribed.clear()

    def _connected(self, client: paho.Client, _userdata: object, flags: Any, *_: object) -> None:
        if flags.session_present:
            self.subscribed.set()
        else:
            client.subscribe(self._topic, qos=1)

    def _take(self, _client: object, _userdata: object, message: paho.MQTTMessage) -> None:
        if "/alarms/" in message.topic and message.payload:
            arrival = Arrival(time.monotonic_ns(), message.topic, message.payload)
            self.arrivals.append(arrival)
            self.ids.add(arrival.alarm["id"])
