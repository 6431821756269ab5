"""An aiomqtt client that cannot hold up the service, and that hears the broker say no."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import ssl
import threading
from typing import TYPE_CHECKING, Any

import aiomqtt

if TYPE_CHECKING:
    from pathlib import Path

    from paho.mqtt.client import Client, DisconnectFlags
    from paho.mqtt.properties import Properties
    from paho.mqtt.reasoncodes import ReasonCode

# paho and aiomqtt tell about every broken connection; the publisher does that once, in its own words.
_LIBRARY_LOG = logging.getLogger(f"{__name__}.library")
_LIBRARY_LOG.setLevel(logging.CRITICAL)

CONSENT_S = 5.0
"""How long the broker may take to accept or refuse a connection."""


class NoConsentError(aiomqtt.MqttError):
    """The broker was reached, but did not say whether it accepts the connection."""


class PublishRefusedError(aiomqtt.MqttError):
    """The broker has answered a publication with a reason why it will not take it (MQTT 5 only)."""


def tls_context(ca_file: Path | None) -> ssl.SSLContext:
    """A context that verifies the broker's certificate and host name; reads files.

    Args:
        ca_file: certificate authorities in PEM; None for those of the system.

    Raises:
        OSError: the file cannot be read, or holds no certificate.
    """
    context = ssl.create_default_context(cafile=ca_file)
    context.sslsocket_class = _TidySocket
    return context


class _TidySocket(ssl.SSLSocket):
    """Closes itself when the handshake fails; paho would leave it to the garbage collector."""

    def do_handshake(self, block: bool = False) -> None:  # noqa: FBT001, FBT002  as in the base class
        try:
            super().do_handshake(block)
        except BaseException:
            self.close()
            raise


class Connection(aiomqtt.Client):
    """One connection to a broker, made once.

    It differs from its base class in what a service that must not stop needs:

    - The blocking part of connecting (name lookup, TCP, TLS) runs on a daemon thread instead of the
      event loop's executor: a broker that does not answer delays neither the stop of the service nor
      the end of the process.
    - A connection that ends before the broker's consent is an error at once, not after a time limit.
    - `deliver` raises on a negative PUBACK, which the base class takes for a good one, and when the
      connection is lost.
    - `abandon` lets go of a connection that cannot be closed politely.

    Args:
        hostname: of the broker.
        port: of the broker.
        in_flight: how many messages may wait for their PUBACK at a time.
        options: further arguments of `aiomqtt.Client`.
    """

    def __init__(self, hostname: str, port: int, *, in_flight: int, **options: Any) -> None:
        super().__init__(hostname, port, logger=_LIBRARY_LOG, max_inflight_messages=in_flight, **options)
        self.pending_calls_threshold = in_flight
        self._refused: asyncio.Future[ReasonCode] = self._loop.create_future()
        self._abandoned = False

    async def open(self) -> None:
        """Connect and wait for the broker's consent.

        Raises:
            NoConsentError: the broker did not answer.
            aiomqtt.MqttError: it refused.
            OSError: it cannot be reached, or TLS failed.
        """
        reached: asyncio.Future[None] = self._loop.create_future()
        threading.Thread(target=self._reach, args=(reached,), name="mqtt-connect", daemon=True).start()
        try:
            await reached
            await self._first_of(self._connected, CONSENT_S)
        except BaseException:
            self.abandon()
            raise

    async def deliver(self, topic: str, payload: bytes, *, retain: bool) -> None:
        """Publish with QoS 1 and wait for the PUBACK.

        Raises:
            PublishRefusedError: the broker will not take it.
            aiomqtt.MqttError: the connection is lost, or no PUBACK came in time.
        """
        publication = asyncio.ensure_future(self.publish(topic, payload, qos=1, retain=retain))
        try:
            await self._first_of(publication, None)
        finally:
            publication.cancel()

    async def lost(self) -> None:
        """Wait until the connection is lost, however it ends."""
        await asyncio.wait({self._disconnected})

    async def close(self, timeout_s: float) -> None:
        """Say goodbye to the broker, which drops the last will; let go after ``timeout_s`` at most."""
        if not self._disconnected.done():
            self._client.disconnect()
            await asyncio.wait({self._disconnected}, timeout=timeout_s)
        self.abandon()

    def abandon(self) -> None:
        """Drop the connection at once, without a word: the broker publishes the last will."""
        self._abandoned = True
        self._client._sock_close()  # noqa: SLF001  paho offers no other way to drop a connection
        for future in (self._connected, self._disconnected):
            if future.done() and not future.cancelled():
                future.exception()  # looked at, so that asyncio does not report it as never retrieved

    async def _first_of(self, wanted: asyncio.Future[None], timeout_s: float | None) -> None:
        """Wait for ``wanted`` unless the connection ends, the broker refuses, or time runs out."""
        ends: set[asyncio.Future[Any]] = {wanted, self._refused, self._disconnected}
        await asyncio.wait(ends, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
        if wanted.done():
            wanted.result()
        elif self._refused.done():
            raise PublishRefusedError(f"the broker refuses messages: {self._refused.result()}")
        elif self._disconnected.done():
            raise aiomqtt.MqttError(f"connection lost: {self._disconnected.exception() or 'closed'}")
        else:
            raise NoConsentError(f"the broker did not answer within {timeout_s:g} s")

    def _reach(self, reached: asyncio.Future[None]) -> None:
        """The blocking part, on a thread of its own."""
        error: Exception | None = None
        try:
            self._client_connect()
        except Exception as failure:  # noqa: BLE001  whatever it is, the caller shall see it
            error = failure
        # A closed loop means that the process ends and nobody waits for the connection any more.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._settle, reached, error)

    def _settle(self, reached: asyncio.Future[None], error: Exception | None) -> None:
        if self._abandoned:
            self.abandon()
        elif error is not None:
            reached.set_exception(error)
        else:
            reached.set_result(None)

    def _on_publish(
        self, client: Client, userdata: Any, mid: int, reason_code: ReasonCode, properties: Properties
    ) -> None:
        if not reason_code.is_failure:
            super()._on_publish(client, userdata, mid, reason_code, properties)
        elif not self._refused.done():
            self._refused.set_result(reason_code)

    def _on_disconnect(
        self,
        client: Client,
        userdata: Any,
        flags: DisconnectFlags,
        reason_code: ReasonCode,
        properties: Properties | None = None,
    ) -> None:
        if not self._connected.done():
            self._connected.set_exception(NoConsentError("the broker closed the connection at once"))
            return
        super()._on_disconnect(client, userdata, flags, reason_code, properties)
