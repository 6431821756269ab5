"""The Modbus client: one request at a time, and its reply told from all else that comes.

Only this module imports pymodbus. Reconnecting, quiet times and retries are not its business: see
`drivers.modbus.line`.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import socket
import termios
from collections import deque
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU
from pymodbus.pdu.file_message import ReadFifoQueueRequest
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    WriteMultipleRegistersRequest,
)
from pymodbus.transport import CommParams, CommType, ModbusProtocol

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.notice import notice
from drivers.modbus.replies import (
    FAULTY,
    READ_HOLDING,
    READ_INPUT,
    ExpectedReply,
    LineLostError,
    ModbusCounters,
    NoReplyError,
    ReplyVerdict,
    RequestRefusedError,
    judge_rtu,
    judge_tcp,
    register_bytes,
)
from drivers.modbus.settings import ModbusRtuBus, ModbusTcpBus
from drivers.tty import why_not_open

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pymodbus.pdu import ModbusPDU

    from daqsvc.acquisition.clock import Clock
    from drivers.modbus.settings import ModbusBus


logger = logging.getLogger(__name__)

logging.getLogger("pymodbus.logging").setLevel(
    logging.CRITICAL
)  # every fault is counted, and reported once, here

LEAST_CONNECT_S = 1.0
MS_PER_S = 1000.0
_BUFFER_BYTES = 4096
_LAST_TRANSACTION = 0xFFFF
_SAME_IDLE, _IDLE_SPREAD = 3, 0.2
"""How often in a row a device closes the connection after about the same time until that is its limit, and
how far apart the times may be, as part of the longest."""


class ModbusRequest(NamedTuple):
    """A request as it is sent.

    Attributes:
        unit: address of the unit.
        pdu: function and data.
        data_bytes: bytes of register data in the reply, see `ExpectedReply`.
    """

    unit: int
    pdu: bytes
    data_bytes: int | None


class ModbusWire(ModbusProtocol):
    """pymodbus' transport: one request goes out, and of all bytes that come in only its reply is taken.

    pymodbus' own transactions sit between this and its client. They are left out: they skip faulty frames
    without counting them, and take a turn of the event loop more for each request.

    Args:
        bus: its table in the machine file.
        clock: stamps when bytes last arrived.
        counters: where faults are counted.

    Attributes:
        last_byte_ns: when bytes last arrived, monotonic; 0 if never.
        why_lost: why there is no connection, if there is none.
        idle_ns: how long nothing had come when the other end closed a connection that had worked, and over
            which nothing was asked; None if that is not how it ended.
    """

    def __init__(self, bus: ModbusBus, clock: Clock, counters: ModbusCounters) -> None:
        super().__init__(_transport_of(bus), is_server=False)
        self.last_byte_ns = 0
        self.why_lost = f"{bus.where} is closed"
        self.idle_ns: int | None = None
        self._bus = bus
        self._serial = isinstance(bus, ModbusRtuBus)
        self._timeout_s = bus.timeout_ms / MS_PER_S
        self._framer = (FramerRTU if self._serial else FramerSocket)(DecodePDU(False))
        self._clock = clock
        self._counters = counters
        self._transaction = 0
        self._deadline_s = 0.0
        self._alarm: asyncio.TimerHandle | None = None
        self._expected: ExpectedReply | None = None
        self._reply: asyncio.Future[bytes] = self.loop.create_future()

    async def open(self) -> None:
        """Open the connection or the port.

        Raises:
            LineLostError: it cannot be opened.
        """
        patience_s = max(self._timeout_s, LEAST_CONNECT_S)
        try:
            async with asyncio.timeout(patience_s):
                self.transport, _ = await self.call_create()
        except (OSError, ValueError, termios.error) as error:  # a time-out and pyserial's own are OSErrors
            self._counters.open_failures += 1
            why = self._why_not_open(error, patience_s)
            raise LineLostError(f"it cannot be opened: {why}") from error

    async def exchange(self, request: ModbusRequest) -> bytes:
        """Send a request and wait for its reply.

        Returns:
            PDU of the reply, or of the refusal.

        Raises:
            LineLostError: the connection is gone.
            NoReplyError: no sound reply came in time.
        """
        if self._waits:
            raise RuntimeError(f"{self._bus.where} is asked twice at once; wait for the first reply")
        if not self._serial:
            self._transaction = self._transaction % _LAST_TRANSACTION + 1
        unit, pdu, data_bytes = request
        self._expected = ExpectedReply(unit, pdu[0], data_bytes, self._transaction)
        self._reply = self.loop.create_future()
        self._deadline_s = self.loop.time() + self._timeout_s
        if self._alarm is None:
            self._alarm = self.loop.call_at(self._deadline_s, self._look_at_the_clock)
        self._begin_anew()
        self._throw_away()
        try:
            self.transport.write(self._framer.encode(pdu, unit, self._transaction))  # type: ignore[attr-defined]
            return await self._reply
        finally:
            if self._serial and self._expected is not None and self.recv_buffer:
                self._counters.note("truncated")  # this is all that came of the reply
            self._expected = None
            self._begin_anew()

    def data_received(self, data: bytes) -> None:
        """Take what answers the request, count all else; see `asyncio.Protocol`."""
        self.last_byte_ns = self._clock.monotonic_ns()
        data = self.recv_buffer + data
        while data:
            verdict = self._judge(data)
            if not verdict.used:
                break
            data = data[verdict.used :]
            if verdict.fault is not None:
                self._counters.note(verdict.fault)
            if verdict.final:
                self._settle(verdict)
        self.recv_buffer = data

    def callback_disconnected(self, exc: Exception | None) -> None:
        """End the wait for a reply that cannot come any more."""
        self.why_lost = (
            f"{self._bus.where} has closed the connection{f' ({exc})' if exc else ''}; see whether the "
            "device has restarted, or other clients take its connections"
        )
        if self.last_byte_ns and not self._serial and not self._waits:
            self.idle_ns = self._clock.monotonic_ns() - self.last_byte_ns
        self._fail(LineLostError(self.why_lost))

    def callback_connected(self) -> None:
        """Nothing to do: whoever opens the connection waits for it."""

    def callback_data(self, data: bytes, addr: tuple[object, ...] | None = None) -> int:
        """Never called: `data_received` takes all."""
        raise RuntimeError(f"{len(data)} bytes from {addr} have not come through data_received")

    def callback_new_connection(self) -> ModbusProtocol:
        """Never called: this end connects, and does not listen."""
        raise RuntimeError(f"{self._bus.where} is a client's end and accepts no connection")

    def _why_not_open(self, error: Exception, patience_s: float) -> str:
        if isinstance(self._bus, ModbusRtuBus):
            return why_not_open(error, self._bus.serial_port, "serial_port")
        if isinstance(error, socket.gaierror):
            return f"no address of {self._bus.host!r} is known ({error.strerror}); correct host"
        if isinstance(error, ConnectionRefusedError):
            return "nobody listens there; start the server, or correct host and tcp_port"
        if isinstance(error, TimeoutError):
            return f"nobody answers there within {patience_s:g} s; correct host, or check the network"
        if isinstance(error, OSError) and error.errno in {errno.ENETUNREACH, errno.EHOSTUNREACH}:
            return "no route leads there from this box; correct host, or check its network"
        return f"{error}" or type(error).__name__

    def _begin_anew(self) -> None:
        """On a serial line, what came before a request or is left of it belongs to no reply."""
        if self._serial:
            self.recv_buffer = b""

    def _throw_away(self) -> None:
        """Throw away what waits in a serial port: it came while this process was kept from looking at it."""
        port = getattr(self.transport, "sync_serial", None)
        if port is None:
            return
        with contextlib.suppress(OSError, termios.error):  # a port that is gone: sending states it
            if port.in_waiting:
                port.reset_input_buffer()
                self._counters.note("unasked")

    def _judge(self, data: bytes) -> ReplyVerdict:
        if len(data) > _BUFFER_BYTES:
            return ReplyVerdict(len(data), fault="oversized", final=True)
        if not self._serial:
            return judge_tcp(data, self._expected)
        if self._expected is None:
            self._counters.note("unasked")
            return ReplyVerdict(len(data))
        return judge_rtu(data, self._expected, FramerRTU.compute_CRC)

    def _settle(self, verdict: ReplyVerdict) -> None:
        """End the request: with its reply, or because this was its reply and it is faulty."""
        if verdict.pdu is not None:
            if self._waits:
                self._reply.set_result(verdict.pdu)
        elif verdict.fault == "wrong_protocol":
            # Where the next frame begins is not known any more.
            where = self._bus.where
            self._lose(f"{where} does not speak Modbus TCP; compare host and tcp_port with the device's")
        elif self._expected is not None and verdict.fault is not None:
            who = f"unit {self._expected.unit} at {self._bus.where}"
            self._fail(
                NoReplyError(
                    f"{who} answers with {FAULTY[verdict.fault]}; compare its register map with the layout"
                )
            )
        self._expected = None

    def close(self, reconnect: bool = False) -> None:  # noqa: FBT001, FBT002 - as pymodbus has it
        """See `ModbusProtocol.close`."""
        if self._alarm is not None:
            self._alarm.cancel()
            self._alarm = None
        super().close(reconnect)

    def _look_at_the_clock(self) -> None:
        """Give a request up whose time is over.

        One timer serves all requests: with one for each of thousands a second, most would be cancelled.
        """
        self._alarm = None
        if not self._waits:
            return
        if self.loop.time() < self._deadline_s:
            self._alarm = self.loop.call_at(self._deadline_s, self._look_at_the_clock)
        else:
            self._give_up()

    def _give_up(self) -> None:
        """End the request without a reply."""
        if self._expected is None:
            return
        self._counters.timeouts += 1
        unit, where = self._expected.unit, self._bus.where
        if self._serial or not self.recv_buffer:
            self._fail(
                NoReplyError(f"unit {unit} at {where} has not answered within {1e3 * self._timeout_s:g} ms")
            )
            return
        # Half a frame: its other half, if it comes, would be taken for the head of the next.
        self._counters.note("truncated")
        self._lose(f"unit {unit} at {where} has sent half a frame")

    def _lose(self, why: str) -> None:
        """Close the connection: what comes over it cannot be told apart any more."""
        self.why_lost = why
        self._fail(LineLostError(why))
        self.close()

    @property
    def _waits(self) -> bool:
        return self._expected is not None and not self._reply.done()

    def _fail(self, error: Exception) -> None:
        if self._waits:
            self._reply.set_exception(error)


def _transport_of(bus: ModbusBus) -> CommParams:
    """What pymodbus is to open; it neither tries again nor keeps time."""
    if isinstance(bus, ModbusTcpBus):
        return CommParams(bus.where, CommType.TCP, host=bus.host, port=bus.tcp_port)
    return CommParams(
        bus.where,
        CommType.SERIAL,
        host=bus.serial_port,
        baudrate=bus.baud,
        bytesize=8,
        parity=bus.parity[0].upper(),
        stopbits=bus.stop_bits,
    )


_READS = {READ_HOLDING: ReadHoldingRegistersRequest, READ_INPUT: ReadInputRegistersRequest}


def _encoded(request: ModbusPDU, data_bytes: int | None = None) -> ModbusRequest:
    return ModbusRequest(request.dev_id, bytes([request.function_code]) + request.encode(), data_bytes)


@lru_cache(maxsize=1024)
def _read_request(unit: int, function: int, address: int, count: int) -> ModbusRequest:
    """A read; what is polled is asked for in the same bytes every time."""
    return _encoded(_READS[function](address=address, count=count, dev_id=unit), 2 * count)


class ModbusClient:
    """One connection, one request at a time. Connect again with a new client.

    Only a connection that the device has closed while nothing was asked is opened again by this one: many
    devices close it after some seconds without a request.

    Args:
        bus: its table in the machine file.
        clock: stamps when bytes last arrived.
        counters: where faults are counted.
    """

    def __init__(self, bus: ModbusBus, clock: Clock, counters: ModbusCounters) -> None:
        self._bus = bus
        self._clock = clock
        self._counters = counters
        self._wire = ModbusWire(bus, clock, counters)
        self._idle_ns: deque[int] = deque(maxlen=_SAME_IDLE)
        """How long nothing had been asked when the device closed the connection, the last times."""
        self._idle_limit_logged = False
        """Whether it was stated that the device closes idle connections."""

    @property
    def last_byte_ns(self) -> int:
        """When bytes last arrived, monotonic; 0 if never."""
        return self._wire.last_byte_ns

    @property
    def connected(self) -> bool:
        """Whether the connection stands."""
        return self._wire.is_active()

    async def connect(self) -> None:
        """Open the connection.

        Raises:
            LineLostError: it cannot be opened.
        """
        await self._wire.open()

    async def close(self) -> None:
        """Close the connection; harmless if it is closed."""
        serial = getattr(self._wire.transport, "sync_serial", None)
        if serial is not None:
            # Closing a tty waits until everything is sent, which a dead adapter never does.
            with contextlib.suppress(OSError, ValueError):
                serial.reset_output_buffer()
        self._wire.idle_ns = None  # and it stays closed
        with contextlib.suppress(OSError):
            self._wire.close()
        await asyncio.sleep(0)  # a TCP transport closes its socket in the next turn

    async def read(self, unit: int, function: int, address: int, count: int) -> bytes:
        """Read registers.

        Args:
            unit: address of the unit.
            function: `READ_HOLDING` or `READ_INPUT`.
            address: first register, from 0.
            count: how many, 1 to 125.

        Returns:
            ``2 * count`` bytes, high byte of each register first.

        Raises:
            LineLostError: the connection is gone.
            NoReplyError: no sound reply came in time.
            RequestRefusedError: the unit answers with an exception.
        """
        return await self._ask(_read_request(unit, function, address, count))

    async def read_fifo(self, unit: int, address: int) -> bytes:
        """Read a FIFO queue (function 24); see `read` for what is returned and raised."""
        return await self._ask(_encoded(ReadFifoQueueRequest(address=address, dev_id=unit)))

    async def write(self, unit: int, address: int, values: Sequence[int]) -> None:
        """Write holding registers (function 16); see `read` for what is raised."""
        request = WriteMultipleRegistersRequest(address=address, registers=list(values), dev_id=unit)
        await self._ask(_encoded(request))

    async def _ask(self, request: ModbusRequest) -> bytes:
        if not self._wire.is_active():
            await self._open_again()
        self._counters.requests += 1
        pdu = await self._wire.exchange(request)
        self._counters.replies += 1
        if pdu[0] != request.pdu[0]:
            kind = self._counters.note_exception(pdu[1])
            raise RequestRefusedError(
                f"unit {request.unit} refuses function {request.pdu[0]}: {kind}", pdu[1]
            )
        return register_bytes(pdu)

    async def _open_again(self) -> None:
        closed = self._wire
        if closed.idle_ns is None:
            raise LineLostError(closed.why_lost)
        wire = ModbusWire(self._bus, self._clock, self._counters)
        try:
            await wire.open()
        except LineLostError as error:
            raise LineLostError(closed.why_lost) from error
        self._wire = wire
        self._counters.idle_closes += 1
        self._idle_ns.append(closed.idle_ns)
        if self._counters.idle_closes == 1:
            notice(
                logger,
                "%s closed the connection while nothing was asked (after %.3g s); it is opened again, and "
                "counted from now on",
                self._bus.where,
                closed.idle_ns / NS_PER_S,
            )
        # A device that restarts closes it, too, at any time: only about the same time again is a limit.
        if not self._idle_limit_logged and len(self._idle_ns) == _SAME_IDLE and _alike(self._idle_ns):
            self._idle_limit_logged = True
            notice(
                logger,
                "%s closes a connection over which nothing is asked (%d times after about %.3g s); it is "
                "opened again for each request. A rate_hz that asks more often keeps it open",
                self._bus.where,
                _SAME_IDLE,
                closed.idle_ns / NS_PER_S,
            )


def _alike(idle_ns: Sequence[int]) -> bool:
    """Whether some times may be one limit, at which a device looks now and then."""
    return max(idle_ns) - min(idle_ns) <= _IDLE_SPREAD * max(idle_ns)
