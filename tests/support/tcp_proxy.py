"""A TCP proxy that does to a connection what networks do, and counts what MQTT messages pass.

It sits between the service and its broker. Because it sees every PUBLISH go up and every PUBACK come
down, it is the witness of what the broker has taken over, without a word from the service.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import socket
import struct
from dataclasses import dataclass, field
from typing import Self

LOOPBACK = "127.0.0.1"
PUBLISH, PUBACK = 3, 4
_ID = re.compile(rb'"id":\s*"([^"]+)"')
_RESET = struct.pack("ii", 1, 0)


@dataclass
class Tap:
    """What went over all connections.

    Attributes:
        acknowledged: alarm payloads that the broker has acknowledged to the service, by their ids.
    """

    acknowledged: dict[str, bytes] = field(default_factory=dict)


class _Packets:
    """Cuts a byte stream into MQTT control packets: type with flags, and body."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        self._buffer += data
        packets = []
        while (packet := self._next()) is not None:
            packets.append(packet)
        return packets

    def _next(self) -> tuple[int, bytes] | None:
        length = shift = 0
        for at in range(1, min(5, len(self._buffer))):
            byte = self._buffer[at]
            length |= (byte & 0x7F) << shift
            shift += 7
            if not byte & 0x80:
                end = at + 1 + length
                if len(self._buffer) < end:
                    return None
                first, body = self._buffer[0], bytes(self._buffer[at + 1 : end])
                del self._buffer[:end]
                return first, body
        return None


class _Link:
    """One connection of the service and its continuation to the broker."""

    def __init__(self, tap: Tap, near: asyncio.StreamWriter, far: asyncio.StreamWriter) -> None:
        self.near, self.far = near, far
        self.silent = False
        self._tap = tap
        self._up, self._down = _Packets(), _Packets()
        self._in_flight: dict[int, tuple[str, bytes]] = {}

    def watch(self, data: bytes, *, up: bool) -> None:
        """Note what has been forwarded."""
        for first, body in (self._up if up else self._down).feed(data):
            if up and first >> 4 == PUBLISH and first & 0x06:
                topic_end = 2 + int.from_bytes(body[:2], "big")
                match = _ID.search(body)
                if match:
                    number = int.from_bytes(body[topic_end : topic_end + 2], "big")
                    self._in_flight[number] = (match[1].decode(), body[body.index(b'{"', topic_end) :])
            elif not up and first >> 4 == PUBACK:
                name, payload = self._in_flight.pop(int.from_bytes(body[:2], "big"), ("", b""))
                refused = len(body) > 2 and body[2] >= 0x80
                if name and not refused:
                    self._tap.acknowledged[name] = payload

    def reset(self) -> None:
        """End it with RST on both sides."""
        for writer in (self.near, self.far):
            sock = writer.get_extra_info("socket")
            with contextlib.suppress(OSError):
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
            writer.transport.abort()


class FaultyProxy:
    """Forwards connections to a port, as well as it is configured to.

    Attributes:
        tap: what has passed.
        blocked: new connections are reset at once.
        latency_s: how long every piece waits before it is forwarded.
        slice_bytes: largest piece that is forwarded at a time; 0 for no limit.

    Args:
        target_port: the broker's port on loopback.
    """

    def __init__(self, target_port: int) -> None:
        self.tap = Tap()
        self.blocked = False
        self.latency_s = 0.0
        self.slice_bytes = 0
        self._target_port = target_port
        self._server: asyncio.Server | None = None
        self._links: set[_Link] = set()
        self._handlers: set[asyncio.Task[None]] = set()
        self._bytes_to_live: int | None = None

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._connected, LOOPBACK, 0)
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._server is not None
        self._server.close()
        self.blocked = True
        while self._handlers:
            self.reset()
            await asyncio.wait(self._handlers, timeout=0.05)
        await self._server.wait_closed()
        await asyncio.sleep(0)  # a transport closes its socket on the next turn of the loop

    @property
    def port(self) -> int:
        """Where the service connects to."""
        assert self._server is not None
        port: int = self._server.sockets[0].getsockname()[1]
        return port

    def reset(self) -> None:
        """Reset every connection."""
        for link in self._links:
            link.reset()

    def reset_after(self, count: int) -> None:
        """Reset the connections once ``count`` more bytes have gone to the broker, wherever that falls."""
        self._bytes_to_live = count

    def silence(self) -> None:
        """From now on the connections that there are carry nothing, without a notice (half-open)."""
        for link in self._links:
            link.silent = True

    def heal(self) -> None:
        """Forward everything again, at full speed; a silent connection stays silent."""
        self.blocked = False
        self.latency_s = 0.0
        self.slice_bytes = 0
        self._bytes_to_live = None

    def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        handler = asyncio.create_task(self._handle(reader, writer))
        self._handlers.add(handler)
        handler.add_done_callback(self._handlers.discard)

    async def _handle(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            if self.blocked:
                raise ConnectionRefusedError
            far_reader, far_writer = await asyncio.open_connection(LOOPBACK, self._target_port)
        except OSError:
            writer.transport.abort()
            return
        link = _Link(self.tap, writer, far_writer)
        self._links.add(link)
        for each in (writer, far_writer):
            each.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            await asyncio.gather(
                self._pump(link, reader, far_writer, up=True), self._pump(link, far_reader, writer, up=False)
            )
        finally:
            self._links.discard(link)
            link.reset()

    async def _pump(
        self, link: _Link, source: asyncio.StreamReader, sink: asyncio.StreamWriter, *, up: bool
    ) -> None:
        with contextlib.suppress(OSError):
            while data := await source.read(65536):
                if self.latency_s:
                    await asyncio.sleep(self.latency_s)
                await self._forward(link, data, sink, up=up)
        if not link.silent:
            sink.close()
            return
        # Silence hides the end of one side from the other; that one ends when somebody loses patience.
        if up:
            link.reset()

    async def _forward(self, link: _Link, data: bytes, sink: asyncio.StreamWriter, *, up: bool) -> None:
        at = 0
        while at < len(data):
            if link.silent:
                return
            piece = data[at : at + (self.slice_bytes or len(data))]
            if up and self._bytes_to_live is not None:
                piece = piece[: self._bytes_to_live]
                self._bytes_to_live -= len(piece)
            sink.write(piece)
            await sink.drain()
            link.watch(piece, up=up)
            at += len(piece)
            if up and self._bytes_to_live == 0:
                self._bytes_to_live = None
                link.reset()
                return
            if self.slice_bytes:
                await asyncio.sleep(0)
