"""Brokers as no plant should have.

One takes some messages and not others, in whatever way brokers do that (MQTT 5 and 3.1.1); one takes what the
box sends, and between that sends whatever a grammar of packets yields.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
from typing import TYPE_CHECKING, Any, Self

from support.mqtt_grammar import Grammar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable


Outcome = bool | None
"""True to acknowledge a message, False to end the connection, None to answer nothing."""


class PickyBroker:
    """Keeps what it takes.

    Args:
        takes: from topic and size of the payload what becomes of a message.
        refuse: topics that are refused with reason code 0x87 (MQTT 5).
        refuse_once: whether the first alarm is refused as beyond the quota, 0x97 (MQTT 5).
    """

    def __init__(
        self, takes: Callable[[str, int], Outcome], *, refuse: Iterable[str] = (), refuse_once: bool = False
    ) -> None:
        self.takes = takes
        self.refuse = set(refuse)
        self.connections = 0
        self.messages: list[tuple[str, dict[str, Any]]] = []
        self.retained: dict[str, dict[str, Any]] = {}
        self._refuse_once = refuse_once
        self._server: Any = None
        self._writers: set[asyncio.StreamWriter] = set()

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        for writer in self._writers:
            writer.transport.abort()

    @property
    def port(self) -> int:
        port: int = self._server.sockets[0].getsockname()[1]
        return port

    def sequences(self, topic: str) -> list[int]:
        return [told["sequence"] for of, told in self.messages if of == topic]

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        await self._rest(reader, writer)

    async def _rest(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, OSError):
            while await self._packet(reader, writer):
                pass
        self._writers.discard(writer)
        writer.close()

    async def _packet(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bool:
        first = (await reader.readexactly(1))[0]
        body = await reader.readexactly(await length_of(reader))
        kind = first >> 4
        if kind == 1:
            self.connections += 1
            self._mqtt5 = body[6] == 5
            writer.write(b"\x20\x03\x00\x00\x00" if self._mqtt5 else b"\x20\x02\x00\x00")
        elif kind == 3:
            return self._publish(writer, first, body)
        elif kind == 8:
            writer.write(
                b"\x90\x04" + body[:2] + b"\x00\x01" if self._mqtt5 else b"\x90\x03" + body[:2] + b"\x01"
            )
        elif kind == 12:
            writer.write(b"\xd0\x00")
        return kind != 14

    def _publish(self, writer: asyncio.StreamWriter, first: int, body: bytes) -> bool:
        end = 2 + int.from_bytes(body[:2], "big")
        topic, mid, rest = body[2:end].decode(), body[end : end + 2], body[end + 2 :]
        if self._mqtt5:
            rest = rest[1 + rest[0] :]
        taken = self.takes(topic, len(rest))
        if topic in self.refuse:
            writer.write(b"\x40\x03" + mid + b"\x87")
        elif self._refuse_once and "/alarms/" in topic:
            self._refuse_once = False
            writer.write(b"\x40\x03" + mid + b"\x97")
        elif taken:
            if "/alarms/" in topic:
                self.messages.append((topic, json.loads(rest)))
                if first & 1:
                    self.retained[topic] = json.loads(rest)
            writer.write(b"\x40\x02" + mid)
        return taken is not False


def only_availability(topic: str, _size: int) -> Outcome:
    """What a broker takes that looks healthy, and is deaf to everything else."""
    return True if topic.endswith("/availability") else None


async def length_of(reader: asyncio.StreamReader) -> int:
    """A remaining length (MQTT 5, section 1.5.5)."""
    value, shift = 0, 0
    while True:
        byte = (await reader.readexactly(1))[0]
        value |= (byte & 0x7F) << shift
        shift += 7
        if not byte & 0x80:
            return value


CONSENT = {True: b"\x20\x03\x00\x00\x00", False: b"\x20\x02\x00\x00"}


class RogueBroker:
    """Sends ``packets`` packets, however many connections that takes; from then on it is an honest one.

    Args:
        seed: what makes it send these.
        packets: how many it sends.
        at_most: packets over one connection.
    """

    def __init__(self, seed: int, packets: int, at_most: int = 100) -> None:
        self.left = packets
        self.connections = 0
        self.taken: list[str] = []
        self._at_most = at_most
        self._dice = random.Random(seed)
        self._server: asyncio.Server | None = None
        self._writers: set[asyncio.StreamWriter] = set()

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._server is not None
        self._server.close()
        for writer in self._writers:
            writer.transport.abort()

    @property
    def port(self) -> int:
        assert self._server is not None
        port: int = self._server.sockets[0].getsockname()[1]
        return port

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        self.connections += 1
        sending: asyncio.Task[None] | None = None
        with contextlib.suppress(asyncio.IncompleteReadError, OSError):
            await reader.readexactly(1)
            connect = await reader.readexactly(await length_of(reader))
            mqtt5 = connect[6] == 5
            dice = random.Random(self._dice.random())
            grammar = Grammar(dice, mqtt5, dice.choice((0.0, 0.0, 0.001, 0.01, 0.1)))
            if self.left and dice.random() < 0.1:
                self._say(writer, grammar, 1)  # before its consent
            writer.write(CONSENT[mqtt5])
            answering = self._answer(reader, writer, mqtt5=mqtt5)
            if self.left:
                sending = asyncio.create_task(self._send(writer, grammar))
            await answering
        if sending is not None:
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
        self._writers.discard(writer)
        writer.transport.abort()

    async def _send(self, writer: asyncio.StreamWriter, grammar: Grammar) -> None:
        dice = grammar.dice
        await asyncio.sleep(dice.choice((0, 0, 0.01, 0.03)))  # at once, or when the box listens
        with contextlib.suppress(OSError):
            for number in range(self._at_most):
                if not self.left or writer.is_closing():
                    break
                self._say(writer, grammar, 1 + number % 20)
                await writer.drain()
                await asyncio.sleep(dice.choice((0, 0, 0, 0.001)))
            await asyncio.sleep(0.01)
        writer.transport.abort()

    def _say(self, writer: asyncio.StreamWriter, grammar: Grammar, under_way: int) -> None:
        self.left -= 1
        writer.write(grammar.packet(under_way))

    async def _answer(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, mqtt5: bool
    ) -> None:
        while True:
            kind = (await reader.readexactly(1))[0] >> 4
            body = await reader.readexactly(await length_of(reader))
            if kind == 3:
                end = 2 + int.from_bytes(body[:2], "big")
                self.taken.append(body[2:end].decode())
                writer.write(b"\x40\x02" + body[end : end + 2])
            elif kind == 8:
                writer.write(
                    b"\x90\x04" + body[:2] + b"\x00\x01" if mqtt5 else b"\x90\x03" + body[:2] + b"\x01"
                )
            elif kind == 10:
                writer.write(b"\xb0\x04" + body[:2] + b"\x00\x00" if mqtt5 else b"\xb0\x02" + body[:2])
            elif kind == 12:
                writer.write(b"\xd0\x00")
