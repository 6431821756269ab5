"""An aiomqtt client that cannot hold up the service, and that hears the broker say no."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import ssl
import threading
from typing import TYPE_CHECKING, Any

import aiomqtt
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.subscribeoptions import SubscribeOptions

from daqsvc.publish.outage import in_words

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from paho.mqtt.client import Client, ConnectFlags, DisconnectFlags, MQTTMessage
    from paho.mqtt.reasoncodes import ReasonCode

# paho and aiomqtt tell about every broken connection, and about every message above ten under way; the
# publisher says once, in its own words, what matters of it.
_LIBRARY_LOG = logging.getLogger(f"{__name__}.library")
_LIBRARY_LOG.setLevel(logging.CRITICAL)

CONSENT_S = 5.0
"""How long the broker may take to accept or refuse a connection."""

PUBACK_S = 10.0
"""How long the broker may take to acknowledge a message."""

INCOMING = 64
"""Messages from the broker that may wait to be looked at; a flood of them is dropped and counted."""

LARGEST_PACKET = 1 << 20
"""Bytes of the largest packet that an MQTT 5 broker may send to the box."""

_HEAD_BYTES = 64
"""More than the rest of a PUBLISH packet needs: fixed header, packet id, properties that we set."""

_SESSION_TAKEN_OVER = 142
_FAILURE = 128


class NoConsentError(aiomqtt.MqttError):
    """The broker was reached, but did not say whether it accepts the connection."""


class PublishRefusedError(aiomqtt.MqttError):
    """The broker has answered a publication with a reason why it will not take it (MQTT 5 only)."""


class SilentBrokerError(aiomqtt.MqttError):
    """The connection stands, but no acknowledgement came over it in time."""


class TakenOverError(aiomqtt.MqttError):
    """Another client has connected with the same client id."""


class Connection(aiomqtt.Client):
    """One connection to a broker, made once.

    It differs from its base class in what a service that must not stop needs:

    - The blocking part of connecting (name lookup, TCP, TLS) runs on a daemon thread instead of the
      event loop's executor: a broker that does not answer delays neither the stop of the service nor
      the end of the process.
    - A connection that ends before the broker's consent is an error at once, not after a time limit.
    - `deliver` raises on a negative PUBACK, which the base class takes for a good one, and when the
      connection is lost. It keeps to the in-flight window of the broker, if that is the smaller one.
    - `abandon` lets go of a connection that cannot be closed politely.

    Args:
        hostname: of the broker.
        port: of the broker.
        in_flight: how many messages may wait for their PUBACK at a time.
        protocol: MQTT version.
        on_overlooked: called for each message from the broker that is dropped because too many wait.
        options: further arguments of `aiomqtt.Client`.
    """

    def __init__(
        self,
        hostname: str,
        port: int,
        *,
        in_flight: int,
        protocol: aiomqtt.ProtocolVersion,
        on_overlooked: Callable[[], None] = lambda: None,
        **options: Any,
    ) -> None:
        self.is_mqtt5 = protocol is aiomqtt.ProtocolVersion.V5
        if self.is_mqtt5:
            options["properties"] = _properties(PacketTypes.CONNECT, MaximumPacketSize=LARGEST_PACKET)
        super().__init__(
            hostname,
            port,
            logger=_LIBRARY_LOG,
            protocol=protocol,
            max_inflight_messages=in_flight,
            max_queued_incoming_messages=INCOMING,
            **options,
        )
        self._on_overlooked = on_overlooked
        self._in_flight = in_flight
        self._window = asyncio.Semaphore(in_flight)
        self._largest_packet: int | None = None
        self._acknowledgements: dict[int, asyncio.Future[ReasonCode]] = {}
        self._disconnected.add_done_callback(self._give_up)
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
            async with asyncio.timeout(CONSENT_S):
                await self._connected
        except BaseException as error:
            self.abandon()
            if isinstance(error, TimeoutError):
                raise NoConsentError(f"the broker did not answer within {CONSENT_S:g} s") from error
            raise

    async def deliver(
        self,
        topic: str,
        payload: bytes,
        *,
        retain: bool,
        expiry_s: float | None = None,
        correlation: bytes | None = None,
    ) -> None:
        """Publish with QoS 1 and wait for the PUBACK.

        Args:
            topic: MQTT topic.
            payload: the bytes.
            retain: whether the broker shall keep it as the latest of its topic.
            expiry_s: when the broker shall drop it undelivered (MQTT 5 only); None for never.
            correlation: what the asker wants to see again in the answer (MQTT 5 only).

        Raises:
            PublishRefusedError: the broker will not take it, or it is too large; the connection stands.
            SilentBrokerError: no PUBACK came in time.
            aiomqtt.MqttError: the connection is lost.
        """
        async with self._window:
            if self._disconnected.done():
                raise self._loss()
            size = len(topic.encode()) + len(payload) + _HEAD_BYTES
            if self._largest_packet is not None and size > self._largest_packet:
                # Sent all the same, it would only end the connection, again and again.
                raise PublishRefusedError(
                    f"the message on {topic} needs {size} bytes and the broker takes {self._largest_packet}; "
                    "raise the largest packet there (Mosquitto: max_packet_size)"
                )
            info = self._client.publish(topic, payload, 1, retain, self._told(expiry_s, correlation))
            if info.rc != 0:
                raise aiomqtt.MqttCodeError(info.rc, "could not publish")
            acknowledged = self._loop.create_future()
            self._acknowledgements[info.mid] = acknowledged
            try:
                async with asyncio.timeout(PUBACK_S):
                    answer: ReasonCode = await acknowledged
            except TimeoutError:
                raise SilentBrokerError(f"no PUBACK within {PUBACK_S:g} s") from None
            finally:
                self._acknowledgements.pop(info.mid, None)
        if answer.is_failure:
            raise PublishRefusedError(f"the broker refuses messages: {answer}")

    def tell(self, topic: str, payload: bytes) -> None:
        """Publish with QoS 0, not retained: nobody says whether it arrives.

        Raises:
            aiomqtt.MqttError: the connection is lost.
        """
        if self._disconnected.done():
            raise self._loss()
        info = self._client.publish(topic, payload, 0)
        if info.rc != 0:
            raise aiomqtt.MqttCodeError(info.rc, "could not publish")

    async def watch(self, *topics: str, fresh_only: bool = False) -> list[str]:
        """Subscribe with QoS 1.

        Args:
            topics: topic filters.
            fresh_only: leave out what is retained at the broker (MQTT 5 only).

        Returns:
            Those that the broker does not grant.

        Raises:
            aiomqtt.MqttError: the connection is lost, or no SUBACK came in time.
        """
        refused = []
        for topic in topics:
            if self.is_mqtt5:
                never = SubscribeOptions.RETAIN_DO_NOT_SEND
                handling = never if fresh_only else SubscribeOptions.RETAIN_SEND_ON_SUBSCRIBE
                options = SubscribeOptions(1, noLocal=True, retainAsPublished=True, retainHandling=handling)
                granted = await self.subscribe(topic, options=options)
            else:
                granted = await self.subscribe(topic, qos=1)
            if any(_value(code) >= _FAILURE for code in granted):
                refused.append(topic)
        return refused

    async def incoming(self) -> AsyncIterator[aiomqtt.Message]:
        """What the broker sends for the subscriptions.

        Raises:
            aiomqtt.MqttError: the connection is lost.
        """
        try:
            async for message in self.messages:
                yield message
        except aiomqtt.MqttError:
            raise self._loss() from None

    @property
    def shown_certificate(self) -> bytes | None:
        """The broker's certificate, DER; None without TLS."""
        wire = self._client.socket()
        return wire.getpeercert(binary_form=True) if isinstance(wire, ssl.SSLSocket) else None

    async def lost(self) -> None:
        """Wait until the connection is lost.

        Raises:
            aiomqtt.MqttError: it is, however it ended.
        """
        await asyncio.wait({self._disconnected})
        raise self._loss()

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

    def _told(self, expiry_s: float | None, correlation: bytes | None) -> Properties | None:
        """What MQTT 5 can say about a message."""
        if not self.is_mqtt5 or (expiry_s is None and correlation is None):
            return None
        told: dict[str, Any] = {}
        if expiry_s is not None:
            told["MessageExpiryInterval"] = max(math.ceil(expiry_s), 1)
        if correlation is not None:
            told["CorrelationData"] = correlation
        return _properties(PacketTypes.PUBLISH, **told)

    def _loss(self) -> aiomqtt.MqttError:
        """Why the connection has ended."""
        error = self._disconnected.exception() if self._disconnected.done() else None
        if _value(getattr(error, "rc", None)) == _SESSION_TAKEN_OVER:
            return TakenOverError("another client has connected with the same client_id")
        return aiomqtt.MqttError(
            f"connection lost: {in_words(error if isinstance(error, Exception) else None)}"
        )

    def _give_up(self, _disconnected: object) -> None:
        """Nothing that is under way will be acknowledged any more."""
        for waiting in self._acknowledgements.values():
            if not waiting.done():
                waiting.set_exception(self._loss())

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

    def _on_connect(
        self,
        client: Client,
        userdata: Any,
        flags: ConnectFlags,
        reason_code: ReasonCode,
        properties: Properties | None = None,
    ) -> None:
        # paho does not keep to the broker's limits, and the broker ends a connection that exceeds them.
        self._largest_packet = getattr(properties, "MaximumPacketSize", None)
        least = min(getattr(properties, "ReceiveMaximum", self._in_flight), self._in_flight)
        if not self._connected.done() and least < self._in_flight:
            self._window = asyncio.Semaphore(least)
        super()._on_connect(client, userdata, flags, reason_code, properties)

    def _on_message(self, client: Client, userdata: Any, message: MQTTMessage) -> None:
        if self._queue.full():
            self._on_overlooked()
        else:
            super()._on_message(client, userdata, message)

    def _on_publish(
        self,
        client: Client,  # noqa: ARG002
        userdata: Any,  # noqa: ARG002
        mid: int,
        reason_code: ReasonCode,
        properties: Properties,  # noqa: ARG002
    ) -> None:
        waiting = self._acknowledgements.get(mid)
        if waiting is not None and not waiting.done():
            waiting.set_result(reason_code)

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


def _properties(packet: int, **values: Any) -> Properties:
    made = Properties(packet)  # type: ignore[no-untyped-call]
    for name, value in values.items():
        setattr(made, name, value)
    return made


def _value(code: object) -> int:
    """The number of a reason code, whatever dress paho gives it; 0 for none."""
    number = getattr(code, "value", code)
    return number if isinstance(number, int) else 0
