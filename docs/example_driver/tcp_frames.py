"""A driver for data loggers that send frames of one fixed length over TCP, back to back."""

import asyncio
import contextlib
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from daqsvc.api import Bus, BusPort, DriverPlugin, Finding, MachineFile, PackedLayout, StreamDriver, Text

CHUNK_BYTES = 65_536


class LoggerBus(Bus):
    """A data logger, which has one stream."""

    kind = "a data logger"

    driver: Annotated[Literal["tcp-frames"], Field(description="which driver", examples=["tcp-frames"])]
    host: Annotated[Text, Field(description="name or address of the logger", examples=["192.0.2.10"])]
    tcp_port: Annotated[int, Field(ge=1, le=65_535)] = Field(default=4001, description="its port")


class LoggerDriver(StreamDriver):
    """Reads one logger."""

    def __init__(self, bus: LoggerBus, port: BusPort) -> None:
        super().__init__(port, f"logger {port.name!r} ({bus.host}:{bus.tcp_port})")
        self._bus = bus

    async def read(self) -> str:
        """Read until the connection is lost; returns why."""
        reader, writer = await asyncio.open_connection(self._bus.host, self._bus.tcp_port)
        try:
            self.link.up()
            [stream] = self.port.streams
            length, rest = stream.layout.length, b""
            while chunk := await reader.read(CHUNK_BYTES):
                rest += chunk
                whole = len(rest) // length * length
                self.take(stream, np.frombuffer(rest[:whole], np.uint8).reshape(-1, length))
                rest = rest[whole:]
            return "the logger has closed the connection"
        finally:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()


class LoggerPlugin(DriverPlugin[LoggerBus]):
    """Loggers on TCP, with frames of any length."""

    buses = (LoggerBus,)
    layouts = (PackedLayout,)

    def checks(self, draft: MachineFile, facts: Mapping[str, Any]) -> Iterator[Iterator[Finding]]:
        """A logger has one stream."""
        del facts
        streams = [stream.bus for stream in draft.streams.values()]
        for name in (name for name, bus in draft.buses.items() if isinstance(bus, LoggerBus)):
            if streams.count(name) > 1:
                yield iter([Finding(("buses", name), "has several streams", "give it exactly one")])

    def build(self, bus: LoggerBus, port: BusPort) -> LoggerDriver:
        """The driver of one logger."""
        return LoggerDriver(bus, port)
