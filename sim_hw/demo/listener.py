"""A consumer of the service's messages, which knows nothing of the service but its broker."""

from __future__ import annotations

import asyncio
import json
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import aiomqtt

if TYPE_CHECKING:
    from collections.abc import Callable

CONNECT_S = 10.0
FAREWELL_S = 5.0
DEFAULT_PORT = 1883


@dataclass(frozen=True, slots=True)
class Received:
    """One message.

    Attributes:
        kind: ``"diagnosis"``, ``"alarm"``, ``"status"`` or ``"availability"``, from its schema.
        topic: where it came.
        payload: its JSON.
    """

    kind: str
    topic: str
    payload: dict[str, Any]


class Listener:
    """Subscribes to everything below a topic and hands messages on until the box goes offline.

    Args:
        url: the broker, ``mqtt://host:port``.
        base: topic of the box.
        hear: called with each message.
    """

    def __init__(self, url: str, base: str, hear: Callable[[Received], None]) -> None:
        parts = urlsplit(url)
        self._host, self._port = parts.hostname or "localhost", parts.port or DEFAULT_PORT
        self._base = base
        self._hear = hear
        self._subscribed = asyncio.Event()
        self._been_online = False
        self._offline = asyncio.Event()
        self.messages = 0

    async def run(self) -> None:
        """Listen until cancelled.

        Raises:
            aiomqtt.MqttError: the broker is not there.
        """
        quiet = logging.getLogger(f"{__name__}.aiomqtt")
        quiet.setLevel(logging.CRITICAL)
        client = aiomqtt.Client(self._host, self._port, timeout=CONNECT_S, logger=quiet)
        async with client:
            await client.subscribe(f"{self._base}/#", qos=1)
            self._subscribed.set()
            async for message in client.messages:
                self._take(str(message.topic), bytes(message.payload or b""), retained=bool(message.retain))

    def _take(self, topic: str, payload: bytes, *, retained: bool) -> None:
        if retained or not payload:
            return  # what an earlier run has left behind
        try:
            content = json.loads(payload)
        except (ValueError, RecursionError):
            return  # of somebody else, on a broker of the user's
        if not isinstance(content, dict):
            return
        kind = str(content.get("schema", "")).removeprefix("daqsvc.").split("/")[0]
        self.messages += 1
        if kind == "availability":
            online = content["state"] == "online"
            self._been_online |= online
            if self._been_online and not online:
                self._offline.set()
        self._hear(Received(kind, topic, content))

    async def subscribed(self) -> None:
        """Wait until nothing that is published from now on can be missed."""
        await self._subscribed.wait()

    async def farewell(self) -> bool:
        """Wait until the box has said that it goes; False if that takes too long."""
        try:
            await asyncio.wait_for(self._offline.wait(), FAREWELL_S)
        except TimeoutError:
            return False
        return True
