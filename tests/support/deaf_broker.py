"""A broker that takes connections and availability, and is deaf to everything else (MQTT 3.1.1)."""

from __future__ import annotations

import asyncio
import contextlib


class DeafBroker:
    """Speaks just enough MQTT to look healthy: CONNACK, PINGRESP, and PUBACK for availability only."""

    def __init__(self):
        self.connections = 0
        self._server = None

    async def __aenter__(self):
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        return self

    async def __aexit__(self, *_):
        self._server.close()

    @property
    def port(self):
        return self._server.sockets[0].getsockname()[1]

    async def _serve(self, reader, writer):
        with contextlib.suppress(asyncio.IncompleteReadError, OSError):
            while True:
                kind = (await reader.readexactly(1))[0]
                body = await reader.readexactly(await self._length(reader))
                if kind >> 4 == 1:
                    self.connections += 1
                    writer.write(b"\x20\x02\x00\x00")
                elif kind >> 4 == 3:
                    length = int.from_bytes(body[:2], "big")
                    if body[2 : 2 + length].endswith(b"/availability"):
                        writer.write(b"\x40\x02" + body[2 + length : 4 + length])
                elif kind >> 4 == 12:
                    writer.write(b"\xd0\x00")
        writer.close()

    @staticmethod
    async def _length(reader):
        value, shift = 0, 0
        while True:
            byte = (await reader.readexactly(1))[0]
            value |= (byte & 0x7F) << shift
            shift += 7
            if not byte & 0x80:
                return value
