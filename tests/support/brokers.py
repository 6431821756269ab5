"""Real brokers for tests, and a consumer that shares no code with the publisher."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import paho.mqtt.client as paho
import pytest
from paho.mqtt.enums import CallbackAPIVersion
from support.ports import LOOPBACK, free_port
from support.waiting import PATIENCE_S

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


def mosquitto_program(name: str = "mosquitto", package: str = "mosquitto") -> str:
    """A program of Mosquitto on this machine; skips the test if there is none, unless it is required."""
    program = shutil.which(name) or shutil.which(name, path="/usr/sbin:/usr/local/sbin")
    if program is None:
        reason = f"no {name} on this machine (apt-get install {package})"
        if os.environ.get("DAQSVC_REQUIRE_MOSQUITTO") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    return program


class Mosquitto:
    """A Mosquitto process on a loopback port, without persistence: a restart forgets everything."""

    def __init__(self, directory: Path, *, config: str = "", acl: str = "", anonymous: bool = True) -> None:
        self.port = free_port()
        self._program = mosquitto_program()
        self._process: subprocess.Popen[bytes] | None = None
        self._config = directory / "mosquitto.conf"
        lines = [
            f"listener {self.port} {LOOPBACK}",
            f"allow_anonymous {'true' if anonymous else 'false'}",
            "persistence false",
            config,
        ]
        if acl:
            (directory / "acl").write_text(acl)
            lines.append(f"acl_file {directory / 'acl'}")
        if os.geteuid() == 0:
            lines.append("user root")
        self._config.write_text("\n".join(lines) + "\n")
        self._log = directory / "mosquitto.log"

    def start(self) -> None:
        """Start and wait until it listens; blocks."""
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                [self._program, "-c", str(self._config), "-v"], stdout=log, stderr=subprocess.STDOUT
            )
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            if self._process.poll() is not None:
                break  # also if something else listens there
            with contextlib.suppress(OSError), socket.create_connection((LOOPBACK, self.port), 1.0):
                return
            time.sleep(0.02)
        pytest.fail(f"mosquitto did not start:\n{self._log.read_text()}")

    def stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def shut_down(self) -> None:
        """End it in order: it writes down what it keeps."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait(PATIENCE_S)

    def reload(self) -> None:
        """Have it read its certificates again, without ending a connection."""
        assert self._process is not None
        self._process.send_signal(signal.SIGHUP)

    @property
    def log_text(self) -> str:
        return self._log.read_text()


@contextlib.contextmanager
def running_mosquitto(directory: Path, **options: Any) -> Iterator[Mosquitto]:
    broker = Mosquitto(directory, **options)
    broker.start()
    try:
        yield broker
    finally:
        broker.stop()


@dataclass(frozen=True)
class Received:
    topic: str
    payload: dict[str, Any]
    retained: bool


class Consumer:
    """An independent subscriber: paho on its own thread, with MQTT 3.1.1, QoS 1."""

    def __init__(self, port: int, topic: str = "#") -> None:
        self.messages: list[Received] = []
        self._topic = topic
        self._subscribed = threading.Event()
        self._client = paho.Client(
            CallbackAPIVersion.VERSION2,
            client_id=f"consumer-{time.monotonic_ns()}",
            reconnect_on_failure=False,
        )
        self._client.on_connect = lambda client, *_: client.subscribe(self._topic, qos=1)
        self._client.on_subscribe = lambda *_: self._subscribed.set()
        self._client.on_message = self._take
        self._port = port

    def _take(self, _client: object, _userdata: object, message: paho.MQTTMessage) -> None:
        self.messages.append(
            Received(message.topic, json.loads(message.payload) if message.payload else {}, message.retain)
        )

    async def __aenter__(self) -> Self:
        await asyncio.to_thread(self._client.connect, LOOPBACK, self._port)
        self._client.loop_start()
        assert await asyncio.to_thread(self._subscribed.wait, PATIENCE_S), "the consumer could not subscribe"
        return self

    async def __aexit__(self, *_: object) -> None:
        self._client.disconnect()
        await asyncio.to_thread(self._client.loop_stop)

    def publish(self, topic: str, payload: str) -> None:
        """Say something, with QoS 1."""
        self._client.publish(topic, payload, qos=1)

    def on(self, part: str) -> list[Received]:
        return [message for message in self.messages if part in message.topic]


def listens(port: int) -> bool:
    """Whether somebody takes connections there."""
    try:
        socket.create_connection((LOOPBACK, port), 1.0).close()
    except OSError:
        return False
    return True


class TcpProxy:
    """Stands between a client and a broker.

    While it is ``blocked`` it ends every new connection; while it is ``deaf`` it swallows what the
    broker sends; `cut` ends the connections that there are.
    """

    def __init__(self, target_port: int) -> None:
        self._target_port = target_port
        self._server: Any = None
        self._writers: list[Any] = []
        self.blocked = False
        self.deaf = False

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._connected, LOOPBACK, 0)
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        self.cut()
        await self._server.wait_closed()

    @property
    def port(self) -> int:
        port: int = self._server.sockets[0].getsockname()[1]
        return port

    def cut(self) -> None:
        """End every connection without a word."""
        for writer in self._writers:
            writer.transport.abort()
        self._writers.clear()

    async def _connected(self, reader: Any, writer: Any) -> None:
        if self.blocked:
            writer.transport.abort()
            return
        try:
            target_reader, target_writer = await asyncio.open_connection(LOOPBACK, self._target_port)
        except OSError:
            writer.transport.abort()
            return
        self._writers += [writer, target_writer]

        async def pump(source: Any, sink: Any, *, back: bool) -> None:
            with contextlib.suppress(OSError):
                while data := await source.read(65536):
                    if back and self.deaf:
                        continue
                    sink.write(data)
                    await sink.drain()
            sink.close()

        await asyncio.gather(pump(reader, target_writer, back=False), pump(target_reader, writer, back=True))
