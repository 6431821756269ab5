"""A broker that takes what the box says, and between that sends whatever a grammar of packets yields."""

from __future__ import annotations

import asyncio
import contextlib
import random
from typing import Self

from support.mqtt_grammar import Grammar
from support.picky_broker import length_of

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
