"""Modbus units that answer over TCP or a pseudo-terminal, with the faults that replies can have."""

from __future__ import annotations

import asyncio
import contextlib
import os
import tty
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

from pymodbus.framer import FramerRTU

from daqsvc.acquisition.clock import NS_PER_S, SystemClock
from drivers.modbus.settings import RegistersLayout
from sim_hw.nodes.modbus_unit import encode, store_for

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from daqsvc.acquisition.clock import Clock
    from drivers.modbus.settings import ModbusLayout
    from sim_hw.nodes.modbus_unit import ModbusUnit
    from sim_hw.nodes.pacing import Pacer

ReplyFault: TypeAlias = Literal[
    "none",
    "silent",
    "exception",
    "wrong unit",
    "wrong transaction",
    "wrong function",
    "wrong protocol",
    "truncated",
    "cut off",
    "oversized",
    "corrupt",
    "garbage",
]

DEVICE_FAILURE = 4
_EXCEPTION_BIT = 0x80
_MBAP = 7
_REQUEST_BYTES = {3: 5, 4: 5, 6: 5, 24: 3}
"""Lengths of the PDUs of requests, by function; that of function 16 is in the PDU."""


@dataclass(frozen=True, slots=True)
class PlannedReply:
    """What becomes of one reply.

    Attributes:
        fault: what is wrong with it.
        delay_ns: how late it is.
    """

    fault: ReplyFault = "none"
    delay_ns: int = 0


FaultPlan: TypeAlias = "Callable[[int, bytes], PlannedReply]"
"""States what becomes of the reply, from the unit and the PDU of the request."""


def _sound(unit: int, pdu: bytes) -> PlannedReply:
    del unit, pdu
    return PlannedReply()


class UnitConnection:
    """One connection seen from the units: bytes of requests in, bytes of replies out.

    Args:
        units: the units, by address. Others stay silent on a serial line, as no unit has them.
        send: puts bytes on the wire.
        serial: RTU frames rather than those of TCP.
        plan: what becomes of each reply.
        clock: for late replies.
    """

    def __init__(
        self,
        units: Mapping[int, ModbusUnit],
        send: Callable[[bytes], None],
        *,
        serial: bool,
        plan: FaultPlan = _sound,
        clock: Clock | None = None,
    ) -> None:
        self._units = units
        self._send = send
        self._serial = serial
        self._plan = plan
        self._clock: Clock = SystemClock() if clock is None else clock
        self._buffer = b""
        self._late: set[asyncio.Task[None]] = set()

    def feed(self, data: bytes) -> None:
        """Take bytes from the client, and answer every request that is complete."""
        self._buffer += data
        while True:
            parsed = _rtu_request(self._buffer) if self._serial else _tcp_request(self._buffer)
            if parsed is None:
                return
            used, head, unit, pdu = parsed
            self._buffer = self._buffer[used:]
            if unit in self._units and pdu:
                self._answer(head, unit, pdu)

    def close(self) -> None:
        """Send nothing more."""
        for task in self._late:
            task.cancel()

    def _answer(self, head: bytes, unit: int, pdu: bytes) -> None:
        answer = self._plan(unit, pdu)
        if answer.fault == "silent":
            return
        refused = bytes([pdu[0] | _EXCEPTION_BIT, DEVICE_FAILURE])
        reply = refused if answer.fault == "exception" else self._units[unit].answer(pdu)
        frame = _faulty(answer.fault, head, unit, reply, serial=self._serial)
        if not answer.delay_ns:
            self._send(frame)
            return
        task = asyncio.create_task(self._send_late(frame, answer.delay_ns), name="modbus-late-reply")
        self._late.add(task)
        task.add_done_callback(self._late.discard)

    async def _send_late(self, frame: bytes, delay_ns: int) -> None:
        await self._clock.sleep_ns(delay_ns)
        self._send(frame)


class ModbusTcpServer:
    """Units behind a TCP port of this machine.

    Args:
        units: by address.
        plan: what becomes of each reply.
        port: where to listen; a free one if 0.
    """

    def __init__(self, units: Mapping[int, ModbusUnit], plan: FaultPlan = _sound, port: int = 0) -> None:
        self.port = port
        self._units = units
        self._plan = plan
        self._server: asyncio.Server | None = None
        self._connections: set[_TcpConnection] = set()
        self._starting: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Listen on 127.0.0.1; again on the same port after `stop`."""
        self._server = await asyncio.get_running_loop().create_server(
            lambda: _TcpConnection(self._units, self._plan, self._connections), "127.0.0.1", self.port
        )
        self.port = self._server.sockets[0].getsockname()[1]

    def start_at_once(self) -> None:
        """As `start`, for callers that cannot wait; it does not answer until the next turn or two."""
        self._starting = asyncio.get_running_loop().create_task(self.start(), name="modbus-server-start")

    def stop(self) -> None:
        """Listen no more, and reset every connection."""
        if self._starting is not None:
            self._starting.cancel()
        if self._server is not None:
            self._server.close()
            self._server = None
        for connection in list(self._connections):
            connection.abort()


class _TcpConnection(asyncio.Protocol):
    def __init__(
        self, units: Mapping[int, ModbusUnit], plan: FaultPlan, connections: set[_TcpConnection]
    ) -> None:
        self._units, self._plan, self._connections = units, plan, connections

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)  # noqa: S101 - TCP streams are
        self._transport = transport
        self._wire = UnitConnection(self._units, self._reply, serial=False, plan=self._plan)
        self._connections.add(self)

    def data_received(self, data: bytes) -> None:
        self._wire.feed(data)

    def connection_lost(self, exc: Exception | None) -> None:
        del exc
        self._connections.discard(self)
        self._wire.close()

    def abort(self) -> None:
        self._connections.discard(self)
        self._wire.close()
        self._transport.abort()

    def _reply(self, frame: bytes) -> None:
        if not self._transport.is_closing():
            self._transport.write(frame)


class ModbusRtuServer:
    """Units on a pseudo-terminal, reached by a link to its device file.

    Args:
        units: by address.
        link: path of the link; it comes with `start` and goes with `stop`, like a USB adapter.
        plan: what becomes of each reply.
        clock: for late replies.
    """

    def __init__(
        self,
        units: Mapping[int, ModbusUnit],
        link: Path,
        plan: FaultPlan = _sound,
        clock: Clock | None = None,
    ) -> None:
        self._units = units
        self._link = link
        self._plan = plan
        self._clock = clock
        self._fds: tuple[int, int] | None = None
        self._wire: UnitConnection | None = None

    def start(self) -> None:
        """Plug in."""
        # The device's end of the terminal stays open, or the line would hang up with every client.
        line, device = os.openpty()
        tty.setraw(device)
        os.set_blocking(line, False)
        self._fds = line, device
        self._link.unlink(missing_ok=True)
        self._link.symlink_to(os.ttyname(device))
        self._wire = UnitConnection(self._units, self._send, serial=True, plan=self._plan, clock=self._clock)
        asyncio.get_running_loop().add_reader(line, self._receive)

    def stop(self) -> None:
        """Unplug."""
        if self._fds is None or self._wire is None:
            return
        self._wire.close()
        self._link.unlink(missing_ok=True)
        asyncio.get_running_loop().remove_reader(self._fds[0])
        for fd in self._fds:
            os.close(fd)
        self._fds = None

    def _receive(self) -> None:
        if self._fds is not None and self._wire is not None:
            with contextlib.suppress(BlockingIOError):
                self._wire.feed(os.read(self._fds[0], 4096))

    def _send(self, frame: bytes) -> None:
        if self._fds is not None:
            with contextlib.suppress(BlockingIOError):  # no reader: a wire does not wait
                os.write(self._fds[0], frame)


class ModbusNode:
    """Plays samples into a unit, each at the time at which it is taken.

    Args:
        unit: where they are kept until they are read.
        layout: how.
        samples: ``[n, channels]`` in the layout's physical units, in the order of its channels.
        rate_hz: samples per second.
        first_index: the device's count of ``samples[0]``.
    """

    def __init__(
        self,
        unit: ModbusUnit,
        layout: ModbusLayout,
        samples: NDArray[np.float64] | NDArray[np.float32],
        rate_hz: float,
        *,
        first_index: int = 0,
    ) -> None:
        self._rows = encode(layout, samples)
        self._store = store_for(unit, layout)
        if isinstance(layout, RegistersLayout):
            # A device has measured before it is asked for the first time.
            self._store.put(first_index, self._rows[:1])
        self._period_ns = NS_PER_S / rate_hz
        self._first_index = first_index
        self.samples_sent = 0

    async def play(self, pacer: Pacer) -> None:
        """Take all samples, as the pacer lets time pass."""
        for k in range(len(self._rows)):
            await pacer.wait_until(round(k * self._period_ns))
            self._store.put(self._first_index + k, self._rows[k : k + 1])
            self.samples_sent = k + 1


def _tcp_request(buffer: bytes) -> tuple[int, bytes, int, bytes] | None:
    """Bytes used, transaction, unit and PDU of the request at the head; None until it is whole."""
    if len(buffer) < _MBAP:
        return None
    end = 6 + int.from_bytes(buffer[4:6], "big")
    if len(buffer) < end:
        return None
    return end, buffer[:2], buffer[6], buffer[_MBAP:end]


def _rtu_request(buffer: bytes) -> tuple[int, bytes, int, bytes] | None:
    if len(buffer) < 2:
        return None
    function = buffer[1]
    if function == 16:
        if len(buffer) < 7:
            return None
        length = 6 + buffer[6]
    elif function in _REQUEST_BYTES:
        length = _REQUEST_BYTES[function]
    else:
        return len(buffer), b"", 0, b""  # no request: wait for silence
    end = 1 + length + 2
    if len(buffer) < end:
        return None
    if not FramerRTU.check_CRC(buffer[: end - 2], int.from_bytes(buffer[end - 2 : end], "big")):
        return len(buffer), b"", 0, b""
    return end, b"", buffer[0], buffer[1 : end - 2]


def _faulty(fault: ReplyFault, head: bytes, unit: int, pdu: bytes, *, serial: bool) -> bytes:
    """The frame of a reply, with its fault."""
    if fault == "wrong function":
        pdu = bytes([pdu[0] ^ 7]) + pdu[1:]
    elif fault == "truncated":  # a whole frame, with two registers fewer than it was asked for
        pdu = bytes([pdu[0], max(pdu[1] - 4, 0)]) + pdu[2 : 2 + max(pdu[1] - 4, 0)]
    elif fault == "oversized":
        pdu = bytes([pdu[0], pdu[1] + 4]) + pdu[2:] + b"\0\0\0\0"
    elif fault == "wrong unit":
        unit = unit % 247 + 1
    if serial:
        body = bytes([unit]) + pdu
        frame = body + FramerRTU.compute_CRC(body).to_bytes(2, "big")
    else:
        transaction = head if fault != "wrong transaction" else bytes([head[0] ^ 0x55, head[1]])
        protocol = b"\0\0" if fault != "wrong protocol" else b"HT"
        frame = transaction + protocol + (1 + len(pdu)).to_bytes(2, "big") + bytes([unit]) + pdu
    if fault == "corrupt":
        frame = frame[:-1] + bytes([frame[-1] ^ 0xFF])
    elif fault == "cut off":
        frame = frame[: max(len(frame) // 2, 3)]
    elif fault == "garbage":
        frame = bytes((0xA5 ^ byte) | 0x40 for byte in frame)
    return frame
