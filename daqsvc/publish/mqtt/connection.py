"""One connection to a broker: paho's protocol, asyncio's event loop, and a broker that is not trusted."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import threading
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.subscribeoptions import SubscribeOptions

from daqsvc.publish.mqtt.errors import (
    MqttCodeError,
    MqttError,
    NoConsentError,
    PublishRefusedError,
    SilentBrokerError,
    TakenOverError,
    in_words,
)
from daqsvc.publish.mqtt.wire import LARGEST_PACKET, Wire, WireContext

if TYPE_CHECKING:
    import ssl
    from collections.abc import AsyncIterator, Callable

    from paho.mqtt.client import MQTTMessage
    from paho.mqtt.reasoncodes import ReasonCode

# paho tells about every broken connection; the publisher states once, in its own words, what matters of it.
# Left without a log unless somebody has asked for it: paho calls it twice for each message.
_LIBRARY_LOG = logging.getLogger(f"{__name__}.library")
_LIBRARY_LOG.setLevel(logging.CRITICAL)

CONSENT_S = 5.0
"""How long the broker may take to accept or refuse a connection."""

PUBACK_S = 10.0
"""How long the broker may take to acknowledge a message, or a subscription."""

INCOMING: Final = 64
"""Messages from the broker that may wait to be examined; a flood of them is dropped and counted."""

FLOOD_PER_S: Final = 10_000
"""Packets a second that were not asked for; a broker that sends more waits in its socket, not in memory."""

OWED: Final = 1000
"""Acknowledgements that may wait to be sent before nothing more is read."""

RECEIVE_MAXIMUM: Final = 65_535
"""Messages that a broker takes at a time unless it states another number."""

UNANSWERED: Final = 100
"""Messages that a broker may leave without a PUBACK, though it answers others, before the connection is
given up."""

_AT_ONCE = 64
_FLUSH_S = 0.01
_MISC_S = 1.0
_HEAD_BYTES = 64
"""More than the rest of a PUBLISH packet needs: fixed header, packet id, properties that we set."""

_SESSION_TAKEN_OVER = 142
_FAILURE = 128


@dataclass(frozen=True, slots=True)
class Will:
    """What the broker publishes when the connection is lost.

    Attributes:
        topic: MQTT topic.
        payload: the bytes.
        qos: 0 or 1.
        retain: whether the broker keeps it as the latest of its topic.
    """

    topic: str
    payload: bytes
    qos: int = 1
    retain: bool = False


@dataclass(frozen=True, slots=True)
class Incoming:
    """A message from the broker.

    Attributes:
        topic: MQTT topic; any text, of up to 65,535 bytes.
        payload: the bytes.
        retain: whether it was kept at the broker.
        response_topic: where its sender wants an answer (MQTT 5).
        correlation: what its sender wants to see again in the answer (MQTT 5).
    """

    topic: str
    payload: bytes
    retain: bool = False
    response_topic: str | None = None
    correlation: bytes | None = None


class _Expected(NamedTuple):
    """A PUBACK that is expected: for which topic, by when (the loop's clock), and None if none came."""

    topic: str
    by_s: float
    answer: asyncio.Future[ReasonCode | None]


class Connection:
    """One connection to a broker, made once.

    - The blocking part of connecting (name lookup, TCP, TLS) runs on a separate daemon thread. A broker
      that does not answer delays neither the stop of the service nor the end of the process. All else,
      paho's callbacks too, happens on the event loop, so that no callback meets a socket that is closed
      already.
    - A connection that ends before the broker's consent is an error at once, not after a time limit.
    - `deliver` raises on a negative PUBACK and when the connection is lost. It keeps to the in-flight
    window of
      the broker, if that is the smaller one.
    - Whatever a broker sends ends the connection at worst; what waits of it is bounded.

    Args:
        hostname: of the broker.
        port: of the broker.
        in_flight: how many messages may wait for their PUBACK at a time.
        mqtt5: whether to speak MQTT 5, rather than 3.1.1.
        identifier: client id.
        username: None for an anonymous connection.
        password: None for none.
        tls_context: None for no TLS.
        keepalive: in s.
        will: None for none.
        reason_against: why nothing is to be sent on a topic; None if it may be.
        on_taken: called with the topic of each message for which a good PUBACK came.
        on_overlooked: called for each message from the broker that is dropped because too many wait.
        on_ignored: called for each message from the broker that came before its consent, or has no topic.
        most_waiting: messages from the broker that may wait to be examined.
    """

    def __init__(
        self,
        hostname: str,
        port: int,
        *,
        in_flight: int,
        mqtt5: bool,
        identifier: str,
        username: str | None = None,
        password: str | None = None,
        tls_context: ssl.SSLContext | None = None,
        keepalive: int = 60,
        will: Will | None = None,
        reason_against: Callable[[str], str | None] = lambda _topic: None,
        on_taken: Callable[[str], None] = lambda _topic: None,
        on_overlooked: Callable[[], None] = lambda: None,
        on_ignored: Callable[[], None] = lambda: None,
        most_waiting: int = INCOMING,
    ) -> None:
        self.is_mqtt5 = mqtt5
        self.unacknowledged: tuple[str, ...] = ()
        """Topics of what was under way when the connection was lost."""
        self._address = hostname, port, keepalive
        self._loop = asyncio.get_running_loop()
        self._in_flight = in_flight
        self._reason_against = reason_against
        self._on_taken = on_taken
        self._on_overlooked = on_overlooked
        self._on_ignored = on_ignored
        self._window = asyncio.Semaphore(in_flight)
        self._most_in_flight = RECEIVE_MAXIMUM
        self._handed_over = 0
        self._latest_answered = 0
        self._unanswered = 0
        self._largest_packet: int | None = None
        self._acknowledgements: dict[int, _Expected] = {}
        """By packet id, in the order in which they were handed over."""
        self._overdue: asyncio.TimerHandle | None = None
        self._grants: dict[int, asyncio.Future[list[ReasonCode]]] = {}
        self._queue: asyncio.Queue[Incoming] = asyncio.Queue(most_waiting)
        # Futures hold what went wrong as a result: asyncio must not complain about one that is not read.
        self._consent: asyncio.Future[Exception | None] = self._loop.create_future()
        self._ended: asyncio.Future[Exception | None] = self._loop.create_future()
        self._abandoned = False
        self._held: Wire | None = None
        self._fd: int | None = None
        self._reads = False
        self._writing: asyncio.Handle | None = None
        self._misc: asyncio.TimerHandle | None = None
        self._second_s = 0.0
        self._packets_before = 0
        self._asked_for = 0
        self._owed_before = 0
        protocol = MQTTProtocolVersion.MQTTv5 if mqtt5 else MQTTProtocolVersion.MQTTv311
        self._client = Client(
            CallbackAPIVersion.VERSION2, identifier, protocol=protocol, reconnect_on_failure=False
        )
        self._client.logger = _LIBRARY_LOG if _LIBRARY_LOG.isEnabledFor(logging.ERROR) else None
        self._client.max_inflight_messages = 0  # the window is kept here
        self._client.tls_set_context(cast("ssl.SSLContext", WireContext(tls_context, mqtt5=mqtt5)))
        if username is not None:
            self._client.username_pw_set(username, password)
        if will is not None:
            self._client.will_set(will.topic, will.payload, will.qos, will.retain)
        self._client.on_connect = lambda _client, _data, _flags, code, properties: self._answered(
            code, properties
        )
        self._client.on_disconnect = lambda _client, _data, _flags, code, _: self._disconnected(code)
        self._client.on_message = lambda _client, _data, message: self._arrived(message)
        self._client.on_publish = lambda _client, _data, mid, code, _: self._acknowledged(mid, code)
        self._client.on_subscribe = lambda _client, _data, mid, codes, _: self._granted(mid, codes)
        self._client.on_unsubscribe = lambda _client, _data, mid, codes, _: self._granted(mid, codes)
        self._client.on_socket_register_write = lambda *_: self._write_later()
        self._client.on_socket_close = lambda *_: self._detach()

    async def open(self, patience_s: Callable[[float], float] | None = None) -> None:
        """Connect and wait for the broker's consent.

        Args:
            patience_s: from how long it took to reach the broker, how long it may take for its consent, in s;
                None for `CONSENT_S`.

        Raises:
            NoConsentError: the broker did not answer.
            MqttError: it refused.
            OSError: it cannot be reached, or TLS failed.
        """
        since_s = self._loop.time()
        wait_s = CONSENT_S
        reached: asyncio.Future[Exception | None] = self._loop.create_future()
        threading.Thread(target=self._reach, args=(reached,), name="mqtt-connect", daemon=True).start()
        try:
            _raise(await reached)
            wait_s = CONSENT_S if patience_s is None else patience_s(self._loop.time() - since_s)
            async with asyncio.timeout(wait_s):
                _raise(await self._consent)
        except BaseException as error:
            self.abandon()
            if isinstance(error, TimeoutError) and reached.done() and reached.result() is None:
                raise NoConsentError(f"the broker did not answer within {wait_s:g} s") from error
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
            retain: whether the broker keeps it as the latest of its topic.
            expiry_s: when the broker drops it undelivered (MQTT 5 only); None for never.
            correlation: what the asker wants to see again in the answer (MQTT 5 only).

        Raises:
            PublishRefusedError: the broker will not take it, or it is too large, or no broker would take its
                topic; the connection stands.
            SilentBrokerError: no PUBACK came in time.
            MqttError: the connection is lost.
        """
        async with self._window:
            if self._ended.done():
                raise self._loss()
            self._check(topic, len(payload) + len(correlation or b""))
            try:
                info = self._client.publish(
                    topic, payload, 1, retain, self._properties_of(expiry_s, correlation)
                )
            except ValueError as error:
                raise PublishRefusedError(f"nothing can be sent on {topic[:200]!r}: {error}") from error
            if info.rc != 0:
                raise MqttCodeError(info.rc, "could not publish")
            self._handed_over += 1
            number = self._handed_over
            expected = _Expected(topic, self._loop.time() + PUBACK_S, self._loop.create_future())
            self._acknowledgements[info.mid] = expected
            if self._overdue is None:
                self._overdue = self._loop.call_at(expected.by_s, self._look_for_overdue)
            try:
                answer = await expected.answer
            finally:
                self._acknowledgements.pop(info.mid, None)
            if answer is None:
                raise self._silence(number)
            self._latest_answered = max(self._latest_answered, number)
        if answer.is_failure:
            raise PublishRefusedError(f"the broker refuses messages: {answer}")
        self._on_taken(topic)

    def _check(self, topic: str, length: int) -> None:
        reason = self._reason_against(topic)
        if reason is not None:
            raise PublishRefusedError(reason)
        size = len(topic.encode(errors="replace")) + length + _HEAD_BYTES
        if self._largest_packet is not None and size > self._largest_packet:
            # Sent all the same, it would only end the connection, again and again.
            raise PublishRefusedError(
                f"the message on {topic} needs {size} bytes and the broker takes {self._largest_packet}; "
                "raise the largest packet there (Mosquitto: max_packet_size)"
            )

    def _look_for_overdue(self) -> None:
        """Wait no longer for what should have been acknowledged by now; one timer for all under way."""
        self._overdue = None
        for expected in self._acknowledgements.values():
            if expected.answer.done():
                continue
            if expected.by_s > self._loop.time():
                self._overdue = self._loop.call_at(expected.by_s, self._look_for_overdue)
                return
            expected.answer.set_result(None)

    def _silence(self, number: int) -> MqttError:
        """No PUBACK came: for none, or for one only, which is a refusal without a word."""
        if number < self._latest_answered and self._unanswered < UNANSWERED:
            self._unanswered += 1
            return PublishRefusedError(
                f"the broker has not acknowledged it within {PUBACK_S:g} s, but later messages"
            )
        return SilentBrokerError(f"no PUBACK within {PUBACK_S:g} s")

    def widen(self, in_flight: int) -> None:
        """Let more messages wait for their PUBACK at a time, as far as the broker allows."""
        in_flight = min(in_flight, self._most_in_flight)
        for _ in range(in_flight - self._in_flight):
            self._window.release()
        self._in_flight = max(in_flight, self._in_flight)

    def tell(self, topic: str, payload: bytes) -> None:
        """Publish with QoS 0, not retained: whether it arrives is not reported.

        Raises:
            MqttError: the connection is lost.
        """
        if self._ended.done():
            raise self._loss()
        info = self._client.publish(topic, payload, 0)
        if info.rc != 0:
            raise MqttCodeError(info.rc, "could not publish")

    async def watch(self, *topics: str, fresh_only: bool = False) -> list[str]:
        """Subscribe with QoS 1.

        Args:
            topics: topic filters.
            fresh_only: leave out what is retained at the broker (MQTT 5 only).

        Returns:
            Those that the broker does not grant.

        Raises:
            MqttError: the connection is lost, or no SUBACK came in time.
        """
        refused = []
        for topic in topics:
            if self.is_mqtt5:
                never = SubscribeOptions.RETAIN_DO_NOT_SEND
                handling = never if fresh_only else SubscribeOptions.RETAIN_SEND_ON_SUBSCRIBE
                options = SubscribeOptions(1, noLocal=True, retainAsPublished=True, retainHandling=handling)
                granted = await self._ask(partial(self._client.subscribe, topic, options=options))
            else:
                granted = await self._ask(partial(self._client.subscribe, topic, qos=1))
            if any(_value(code) >= _FAILURE for code in granted):
                refused.append(topic)
        return refused

    async def unsubscribe(self, topic: str) -> None:
        """End a subscription.

        Raises:
            MqttError: the connection is lost, or no UNSUBACK came in time.
        """
        await self._ask(partial(self._client.unsubscribe, topic))

    async def incoming(self) -> AsyncIterator[Incoming]:
        """What the broker sends for the subscriptions, and whatever else it sends.

        Raises:
            MqttError: the connection is lost.
        """
        while True:
            arriving = asyncio.ensure_future(self._queue.get())
            try:
                ends: set[asyncio.Future[Any]] = {arriving, self._ended}
                await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
                if not arriving.done():
                    raise self._loss()
                message = arriving.result()
            finally:
                arriving.cancel()
            yield message

    @property
    def shown_certificate(self) -> bytes | None:
        """The broker's certificate, DER; None without TLS."""
        wire = self._wire
        return None if wire is None else wire.shown_certificate

    async def lost(self) -> None:
        """Wait until the connection is lost.

        Raises:
            MqttError: it is, however it ended.
        """
        await asyncio.wait({self._ended})
        raise self._loss()

    async def close(self, timeout_s: float) -> None:
        """Say goodbye to the broker, which drops the last will; let go after ``timeout_s`` at most."""
        if not self._ended.done():
            # The library closes the socket with its last word: nothing may wait to be sent before that.
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(timeout_s):
                    while (wire := self._wire) is not None and wire.unsent:  # noqa: ASYNC110  rare, and short
                        await asyncio.sleep(_FLUSH_S)
                    self._client.disconnect()
                    await asyncio.wait({self._ended})
        self.abandon()

    def abandon(self) -> None:
        """Drop the connection at once, without a word: the broker publishes the last will."""
        self._abandoned = True
        self._detach()
        self._finish(None)
        self._shut()

    # The library's side.

    @property
    def _wire(self) -> Wire | None:
        wire = self._client.socket()
        return wire if isinstance(wire, Wire) else None

    def _reach(self, reached: asyncio.Future[Exception | None]) -> None:
        """The blocking part, on a separate thread."""
        properties = (
            _properties(PacketTypes.CONNECT, MaximumPacketSize=LARGEST_PACKET) if self.is_mqtt5 else None
        )
        # Said unless something else is known: whatever ends the thread, no waiting is in vain.
        error: Exception | None = OSError("the thread that connects was lost")
        try:
            self._client.connect(*self._address, properties=properties)
            error = None
        except OSError as failure:  # before ValueError, which unverified certificates are, too
            error = failure
        except UnicodeError:
            # The library of names: an empty part, or one of more than 63 letters.
            error = OSError(f"{self._address[0]!r} cannot be the name of a host; correct mqtt.url")
        except ValueError as failure:
            error = OSError(f"the connection cannot be made: {failure}")
        except Exception as failure:  # noqa: BLE001  whatever it is, the caller shall see it
            error = failure
        finally:
            try:
                self._loop.call_soon_threadsafe(self._settle, reached, error)
            except RuntimeError:
                # A closed loop means that the process ends and the connection is not waited for any more.
                self._shut()

    def _settle(self, reached: asyncio.Future[Exception | None], error: Exception | None) -> None:
        wire = self._wire
        if self._abandoned or error is not None or wire is None:
            self._shut()
        else:
            self._attach(wire)
        if not reached.done():
            reached.set_result(error)

    def _attach(self, wire: Wire) -> None:
        """From here on the event loop has the socket, until `_detach`."""
        self._held = wire
        self._fd = wire.fileno()
        self._read_again()
        self._write_later()
        self._misc = self._loop.call_later(_MISC_S, self._look_after)

    def _detach(self) -> None:
        """Before the socket is closed, by whomever."""
        if self._misc is not None:
            self._misc.cancel()
        if self._fd is None:
            return
        self._loop.remove_reader(self._fd)
        self._loop.remove_writer(self._fd)
        if self._writing is not None:
            self._writing.cancel()
        self._fd, self._reads, self._writing = None, False, None

    def _shut(self) -> None:
        wire = self._client.socket()
        if wire is not None:
            wire.close()

    def _look_after(self) -> None:
        """Keep-alive."""
        self._misc = self._loop.call_later(_MISC_S, self._look_after)
        self._guarded(self._client.loop_misc)

    def _write_later(self) -> None:
        """Send once the event loop has done what it is at, so that packets go together."""
        if self._fd is not None and self._writing is None:
            self._writing = self._loop.call_soon(self._write)

    def _write(self) -> None:
        self._writing = None
        self._guarded(self._client.loop_write)
        wire = self._wire
        if self._fd is None or wire is None:
            return
        try:
            wire.flush()
        except OSError:
            while self._fd is not None:  # the library finds the connection broken, and states it in its way
                self._guarded(self._client.loop_read)
            return
        if wire.unsent:
            self._loop.add_writer(self._fd, self._write)
            return
        self._loop.remove_writer(self._fd)
        if self._client.want_write():
            self._write_later()
        else:
            self._read_again()

    def _read_again(self) -> None:
        wire = self._wire
        if self._fd is None or self._reads or wire is None:
            return
        self._owed_before = wire.packets
        self._reads = True
        self._loop.add_reader(self._fd, self._readable)
        if wire.pending():
            self._loop.call_soon(self._readable)

    def _read_no_more(self) -> None:
        if self._fd is not None:
            self._loop.remove_reader(self._fd)
            self._reads = False

    def _readable(self) -> None:
        for _ in range(_AT_ONCE):
            wire = self._wire
            if self._fd is None or not self._reads or wire is None:
                return
            self._guarded(self._client.loop_read)
            if self._fd is None:
                return
            self._hold_back(wire)
            if not wire.pending():
                return
        self._loop.call_soon(self._readable)

    def _hold_back(self, wire: Wire) -> None:
        """Read no more for now from a broker that floods the box, or takes nothing while it sends."""
        now_s = self._loop.time()
        if now_s - self._second_s >= 1.0:
            self._second_s, self._packets_before, self._asked_for = now_s, wire.packets, 0
        if not (self._client.want_write() or wire.unsent):
            self._owed_before = wire.packets
        if wire.packets - self._packets_before - self._asked_for > FLOOD_PER_S:
            self._read_no_more()
            self._loop.call_at(self._second_s + 1.0, self._read_again)
        elif wire.packets - self._owed_before > OWED:
            self._read_no_more()  # until all is written that waits

    def _guarded(self, work: Callable[[], object]) -> None:
        """Have the library do something; what it cannot make sense of ends the connection."""
        try:
            work()
        except Exception as error:  # noqa: BLE001  any, for what a broker sends decides which
            self._detach()
            self._finish(MqttError(f"what the broker sent makes no sense ({type(error).__name__}: {error})"))
            self._shut()

    def _answered(self, code: ReasonCode, properties: Properties | None) -> None:
        if self._consent.done():
            return
        # paho does not keep to the broker's limits, and the broker ends a connection that exceeds them.
        self._largest_packet = getattr(properties, "MaximumPacketSize", None)
        self._most_in_flight = max(getattr(properties, "ReceiveMaximum", RECEIVE_MAXIMUM), 1)
        if self._most_in_flight < self._in_flight:
            self._in_flight = self._most_in_flight
            self._window = asyncio.Semaphore(self._in_flight)
        self._consent.set_result(MqttCodeError(code) if code.is_failure else None)

    def _disconnected(self, code: ReasonCode) -> None:
        self._finish(MqttCodeError(code) if code.value else None)

    def _arrived(self, message: MQTTMessage) -> None:
        try:
            topic = message.topic
        except UnicodeDecodeError:
            topic = ""
        if not topic or not self._consent.done():
            self._on_ignored()
            return
        properties = message.properties
        answer = getattr(properties, "ResponseTopic", None)
        correlation = getattr(properties, "CorrelationData", None)
        try:
            self._queue.put_nowait(
                Incoming(
                    topic,
                    bytes(message.payload),
                    retain=bool(message.retain),
                    response_topic=answer if isinstance(answer, str) else None,
                    correlation=bytes(correlation) if isinstance(correlation, bytes | bytearray) else None,
                )
            )
        except asyncio.QueueFull:
            self._on_overlooked()

    def _acknowledged(self, mid: int, code: ReasonCode) -> None:
        expected = self._acknowledgements.get(mid)
        if expected is not None and not expected.answer.done():
            self._asked_for += 1
            expected.answer.set_result(code)

    def _granted(self, mid: int, codes: list[ReasonCode]) -> None:
        waiting = self._grants.get(mid)
        if waiting is not None and not waiting.done():
            waiting.set_result(codes)

    # This side.

    async def _ask(self, ask: Callable[[], tuple[int, int | None]]) -> list[ReasonCode]:
        """Have the broker answer to a subscription, or to the end of one."""
        if self._ended.done():
            raise self._loss()
        code, mid = ask()
        if code != 0 or mid is None:
            raise MqttCodeError(code, "could not subscribe")
        granted: asyncio.Future[list[ReasonCode]] = self._loop.create_future()
        self._grants[mid] = granted
        try:
            async with asyncio.timeout(PUBACK_S):
                ends: set[asyncio.Future[Any]] = {granted, self._ended}
                await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
        except TimeoutError:
            raise SilentBrokerError(f"no answer to a subscription within {PUBACK_S:g} s") from None
        finally:
            self._grants.pop(mid, None)
        if not granted.done():
            raise self._loss()
        return granted.result()

    def _properties_of(self, expiry_s: float | None, correlation: bytes | None) -> Properties | None:
        """The MQTT 5 properties of a message."""
        if not self.is_mqtt5 or (expiry_s is None and correlation is None):
            return None
        statements: dict[str, Any] = {}
        if expiry_s is not None:
            statements["MessageExpiryInterval"] = max(math.ceil(expiry_s), 1)
        if correlation is not None:
            statements["CorrelationData"] = correlation
        return _properties(PacketTypes.PUBLISH, **statements)

    def _finish(self, error: Exception | None) -> None:
        """The connection has ended: nothing that is under way will be acknowledged any more."""
        if self._ended.done():
            return
        violation = "" if self._held is None else self._held.violation
        if violation:
            error = MqttError(violation)
        self._ended.set_result(error)
        self.unacknowledged = tuple(
            expected.topic for expected in self._acknowledgements.values() if not expected.answer.done()
        )
        if not self._consent.done():
            closed = NoConsentError("the broker closed the connection at once")
            self._consent.set_result(error if violation else closed)
        for expected in self._acknowledgements.values():
            if not expected.answer.done():
                expected.answer.set_exception(self._loss())
        if self._overdue is not None:
            self._overdue.cancel()

    def _loss(self) -> MqttError:
        """Why the connection has ended."""
        error = self._ended.result() if self._ended.done() else None
        if _value(getattr(error, "rc", None)) == _SESSION_TAKEN_OVER:
            return TakenOverError("another client has connected with the same client_id")
        return MqttError(f"connection lost: {in_words(error)}")


def _raise(error: Exception | None) -> None:
    if error is not None:
        raise error


def _properties(packet: int, **values: Any) -> Properties:
    made = Properties(packet)  # type: ignore[no-untyped-call]
    for name, value in values.items():
        setattr(made, name, value)
    return made


def _value(code: object) -> int:
    """The number of a reason code, whatever dress paho gives it; 0 for none."""
    number = getattr(code, "value", code)
    return number if isinstance(number, int) else 0
