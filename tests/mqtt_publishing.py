"""A publisher under test, and messages for its outbox."""

from __future__ import annotations

import asyncio
import contextlib

from daqsvc.acquisition.clock import SystemClock
from daqsvc.publish.mqtt import MqttPublisher, MqttSettings

CLOCK = SystemClock()


@contextlib.asynccontextmanager
async def publishing(outbox, port, protocol="5", *, client_id="daqsvc-test", handler=None, **settings):
    """A running publisher of box ``edge-1`` at site ``lab``."""
    publisher = MqttPublisher(
        MqttSettings("127.0.0.1", port, client_id, protocol=protocol, **settings),
        "lab",
        "edge-1",
        outbox,
        CLOCK,
        commands=handler,
    )
    running = asyncio.create_task(publisher.run())
    try:
        yield publisher
    finally:
        await publisher.stop()
        await running
