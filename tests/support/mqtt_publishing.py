"""A publisher under test, who carries out its commands, and a client that sends one message."""

from __future__ import annotations

import asyncio
import contextlib
import time

import paho.mqtt.client as paho
from support.brokers import PATIENCE_S

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.commands import CommandOutcome
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


class Desk:
    """Accepts every command and keeps it."""

    def __init__(self):
        self.asked = []

    async def __call__(self, command, source):
        self.asked.append(command)
        return CommandOutcome(accepted=True, events=("edge-1-7",))


def say(port, topic, payload, *, retain=False):
    """Publish once, from a client that goes away again."""
    client = paho.Client(paho.CallbackAPIVersion.VERSION2, f"sayer-{time.monotonic_ns()}")
    client.connect("127.0.0.1", port)
    client.loop_start()
    client.publish(topic, payload, qos=1, retain=retain).wait_for_publish(PATIENCE_S)
    client.disconnect()
    client.loop_stop()
