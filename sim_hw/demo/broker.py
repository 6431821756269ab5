"""An MQTT broker inside the process: for the demo, and for tests without Mosquitto."""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
from typing import TYPE_CHECKING, Self

from amqtt.broker import Broker
from amqtt.contexts import BrokerConfig, ListenerConfig
from amqtt.errors import BrokerError

if TYPE_CHECKING:
    from types import TracebackType

_LOOPBACK = "127.0.0.1"
_ATTEMPTS = 5

# These report every client that connects and leaves, at warning level and above.
_NOISY_LOGGERS = ("amqtt", "transitions")


class _TidyBroker(Broker):  # type: ignore[misc, unused-ignore]
    """A broker that knows its connections: amqtt forgets one whose closing is cancelled half-way."""

    def __init__(self, config: BrokerConfig) -> None:
        super().__init__(config)
        self.writers: set[asyncio.StreamWriter] = set()

    async def stream_connected(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, listener_name: str
    ) -> None:
        self.writers.add(writer)
        try:
            await super().stream_connected(reader, writer, listener_name)
        finally:
            self.writers.discard(writer)
            writer.close()

    async def shutdown(self) -> None:
        await super().shutdown()
        for writer in self.writers:
            writer.transport.abort()
        await asyncio.sleep(0)  # a transport closes its socket on the next turn of the loop


class EmbeddedBroker:
    """An anonymous amqtt broker (MQTT 3.1.1) on a loopback port; use it with ``async with``.

    Args:
        port: the port to listen on; 0 for a free one.
    """

    def __init__(self, port: int = 0) -> None:
        self._wanted_port = port
        self._port: int | None = None
        self._broker: _TidyBroker | None = None

    @property
    def port(self) -> int:
        """The port that it listens on.

        Raises:
            RuntimeError: the broker does not run.
        """
        if self._port is None:
            raise RuntimeError("the embedded broker does not run; enter it with 'async with'")
        return self._port

    @property
    def url(self) -> str:
        """Where to reach it, as a machine file states it."""
        return f"mqtt://{_LOOPBACK}:{self.port}"

    async def __aenter__(self) -> Self:
        for name in _NOISY_LOGGERS:
            logging.getLogger(name).setLevel(logging.CRITICAL)
        attempts_left = 1 if self._wanted_port else _ATTEMPTS
        while self._broker is None:
            attempts_left -= 1
            port = self._wanted_port or _free_port()
            try:
                self._broker = await self._started(port)
            except BrokerError as error:
                # Between finding a free port and listening on it, somebody else may take it.
                if not (attempts_left and _address_in_use(error)):
                    raise
            else:
                self._port = port
        return self

    @staticmethod
    async def _started(port: int) -> _TidyBroker:
        config = BrokerConfig(
            listeners={"default": ListenerConfig(bind=f"{_LOOPBACK}:{port}")},
            plugins={"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}},
        )
        broker = _TidyBroker(config)
        await broker.start()
        return broker

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._broker is not None:
            await self._broker.shutdown()
        self._broker = self._port = None


def _address_in_use(error: BaseException) -> bool:
    cause = error.__cause__
    return cause is not None and (
        (isinstance(cause, OSError) and cause.errno == errno.EADDRINUSE) or _address_in_use(cause)
    )


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((_LOOPBACK, 0))
        port: int = probe.getsockname()[1]
        return port
