"""The Modbus client: pymodbus carries bytes and PDUs, and what it is given to decode has been judged here.

This is the only module that imports pymodbus. Reconnecting, quiet times and retries are not its business:
pymodbus' own are switched off, see `drivers.modbus_line`.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import termios
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, NoReturn

from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerRTU
from pymodbus.pdu import ModbusPDU
from pymodbus.pdu.file_message import ReadFifoQueueRequest
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    WriteMultipleRegistersRequest,
)
from pymodbus.transaction import TransactionManager

from daqsvc.acquisition.clock import NS_PER_S
from drivers.base import BusCounters
from drivers.modbus_replies import (
    EXCEPTIONS,
    READ_FIFO,
    READ_HOLDING,
    READ_INPUT,
    WRITE_REGISTERS,
    Expected,
    Verdict,
    judge_rtu,
    judge_tcp,
    register_bytes,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daqsvc.acquisition.clock import Clock

logging.getLogger("pymodbus.logging").setLevel(
    logging.CRITICAL
)  # every fault is counted, and told once, here

BITS_PER_CHARACTER = 11
"""Start, eight data, parity and stop bits, or a second stop bit without parity."""

LEAST_CONNECT_S = 1.0
_BUFFER_BYTES = 4096
_NEVER = 2**31


class LineLostError(Exception):
    """The connection or the port is gone, or cannot be opened."""


class NoReplyError(Exception):
    """A unit has not answered in time, or what it answered was no reply to the request."""


class RefusedError(Exception):
    """A unit has answered with a Modbus exception.

    Attributes:
        code: the exception code.
    """

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


@dataclass(slots=True)
class ModbusCounters(BusCounters):
    """What happened on a Modbus line; every figure only grows.

    Attributes:
        requests: requests sent.
        replies: sound replies, refusals included.
        timeouts: requests without a sound reply in time.
        exceptions: refusals by kind, e.g. ``"illegal data address"``.
        replies_truncated: replies shorter than what was asked for, or cut off.
        replies_oversized: replies longer than what was asked for, or than any reply may be.
        replies_corrupt: RTU frames whose CRC does not match, and bytes that are no frame.
        replies_wrong_unit: frames of another unit than was asked.
        replies_wrong_transaction: TCP frames that answer no request under way.
        replies_wrong_function: frames that answer another function.
        replies_wrong_protocol: TCP frames that are not Modbus.
        replies_unasked: bunches of bytes on a serial line while no reply was waited for: late replies.
        units_demoted: how often a silent unit was set aside.
        probes: requests to a unit set aside, to see if it is back.
        units_back: how often one was.
        blocks_torn: waveform blocks that the device replaced while they were read.
        blocks_missed: waveform blocks that were over before they could be read.
        ring_overruns: how often a ring was overwritten before it was read.
    """

    requests: int = 0
    replies: int = 0
    timeouts: int = 0
    exceptions: dict[str, int] = field(default_factory=dict)
    replies_truncated: int = 0
    replies_oversized: int = 0
    replies_corrupt: int = 0
    replies_wrong_unit: int = 0
    replies_wrong_transaction: int = 0
    replies_wrong_function: int = 0
    replies_wrong_protocol: int = 0
    replies_unasked: int = 0
    units_demoted: int = 0
    probes: int = 0
    units_back: int = 0
    blocks_torn: int = 0
    blocks_missed: int = 0
    ring_overruns: int = 0

    def note(self, fault: str) -> None:
        """Count a faulty reply."""
        name = f"replies_{fault}"
        setattr(self, name, getattr(self, name) + 1)

    def note_exception(self, code: int) -> str:
        """Count a refusal, and return what it is called."""
        kind = EXCEPTIONS.get(code, f"exception {code}")
        self.exceptions[kind] = self.exceptions.get(kind, 0) + 1
        return kind


@dataclass(frozen=True, slots=True)
class LineOptions:
    """How to open a line, and how long to wait on it.

    Attributes:
        transport: Modbus TCP, or RTU on a serial port.
        host: of a TCP server.
        tcp_port: of a TCP server.
        serial_port: device file of a serial port.
        baud: bit/s of a serial port.
        parity: of a serial port.
        stop_bits: of a serial port.
        timeout_ns: how long a unit may take to answer.
    """

    transport: Literal["tcp", "rtu"]
    host: str = ""
    tcp_port: int = 502
    serial_port: str = ""
    baud: int = 19_200
    parity: Literal["none", "even", "odd"] = "even"
    stop_bits: Literal[1, 2] = 1
    timeout_ns: int = NS_PER_S // 2

    @property
    def where(self) -> str:
        """What a person calls the other end."""
        return f"{self.host}:{self.tcp_port}" if self.transport == "tcp" else self.serial_port

    @property
    def gap_ns(self) -> int:
        """Silence between serial frames: t3.5, at least 1.75 ms (Modbus over serial line 1.02, 2.5.1.1)."""
        if self.transport == "tcp":
            return 0
        return max(round(3.5 * BITS_PER_CHARACTER * NS_PER_S / self.baud), 1_750_000)


class ModbusClient:
    """One connection, one request at a time. Connect again with a new client.

    Args:
        options: what to open.
        clock: stamps when bytes last arrived.
        counters: where faults are counted.
    """

    def __init__(self, options: LineOptions, clock: Clock, counters: ModbusCounters) -> None:
        timeout_s = options.timeout_ns / NS_PER_S
        made: AsyncModbusTcpClient | AsyncModbusSerialClient
        common: dict[str, Any] = {
            "timeout": max(timeout_s, LEAST_CONNECT_S),
            "retries": 0,
            "reconnect_delay": 0,
            "name": options.where,
        }
        if options.transport == "tcp":
            made = AsyncModbusTcpClient(options.host, port=options.tcp_port, **common)
        else:
            made = AsyncModbusSerialClient(
                options.serial_port,
                baudrate=options.baud,
                parity=options.parity[0].upper(),
                stopbits=options.stop_bits,
                **common,
            )
        self._transactions = _Transactions(made.ctx, options, clock, counters)
        made.ctx = self._transactions
        made.set_max_no_responses(_NEVER)
        self._client = made
        self._options = options
        self._counters = counters

    @property
    def last_byte_ns(self) -> int:
        """When bytes last arrived, monotonic; 0 if never."""
        return self._transactions.last_byte_ns

    @property
    def connected(self) -> bool:
        """Whether the connection stands."""
        return self._client.connected

    async def connect(self) -> None:
        """Open the connection.

        Raises:
            LineLostError: it cannot be opened.
        """
        why = "nobody answers there"
        try:
            opened = await self._client.connect()
        except (ModbusException, OSError, ValueError, termios.error) as error:
            opened, why = False, f"{error}"
        _heed_cancellation()
        if not opened:
            self._counters.open_failures += 1
            raise LineLostError(f"{self._options.where} cannot be opened: {why}")
        self._transactions.comm_params.timeout_connect = self._options.timeout_ns / NS_PER_S

    async def close(self) -> None:
        """Close the connection; harmless if it is closed."""
        serial = getattr(self._transactions.transport, "sync_serial", None)
        if serial is not None:
            # Closing a tty waits until everything is sent, which a dead adapter never does.
            with contextlib.suppress(OSError, ValueError):
                serial.reset_output_buffer()
        with contextlib.suppress(OSError):
            self._client.close()
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
            RefusedError: the unit answers with an exception.
        """
        kind = {READ_HOLDING: ReadHoldingRegistersRequest, READ_INPUT: ReadInputRegistersRequest}[function]
        request = kind(address=address, count=count, dev_id=unit)
        return await self._ask(request, Expected(unit, function, 2 * count))

    async def read_fifo(self, unit: int, address: int) -> bytes:
        """Read a FIFO queue (function 24); see `read` for what is returned and raised."""
        request = ReadFifoQueueRequest(address=address, dev_id=unit)
        return await self._ask(request, Expected(unit, READ_FIFO, None))

    async def write(self, unit: int, address: int, values: Sequence[int]) -> None:
        """Write holding registers (function 16); see `read` for what is raised."""
        request = WriteMultipleRegistersRequest(address=address, registers=list(values), dev_id=unit)
        await self._ask(request, Expected(unit, WRITE_REGISTERS, None))

    async def _ask(self, request: ModbusPDU, expected: Expected) -> bytes:
        if not self._client.connected:
            raise LineLostError(self._transactions.why_lost)
        self._counters.requests += 1
        transactions = self._transactions
        transactions.expect(expected)
        try:
            await transactions.execute(False, request)
        except ModbusException as error:
            _heed_cancellation()
            self._explain(expected, error)
        finally:
            transactions.expect(None)
        _heed_cancellation()
        pdu = transactions.accepted
        self._counters.replies += 1
        if pdu[0] != expected.function:
            kind = self._counters.note_exception(pdu[1])
            raise RefusedError(f"unit {expected.unit} refuses function {expected.function}: {kind}", pdu[1])
        return register_bytes(pdu)

    def _explain(self, expected: Expected, error: ModbusException) -> NoReturn:
        """Raise what pymodbus' error means."""
        if not self._client.connected:
            raise LineLostError(self._transactions.why_lost) from error
        unit, options = expected.unit, self._options
        if self._transactions.refused:
            raise NoReplyError(
                f"unit {unit} at {options.where} answers with a {self._transactions.refused} reply; "
                "compare its register map with the layout"
            ) from error
        self._counters.timeouts += 1
        if options.transport == "tcp" and self._transactions.recv_buffer:
            # Half a frame: its other half, if it comes, would be taken for the head of the next.
            self._counters.note("truncated")
            self._client.close()
            raise LineLostError(f"unit {unit} at {options.where} has sent half a frame") from error
        raise NoReplyError(
            f"unit {unit} at {options.where} has not answered within {options.timeout_ns / 1e6:g} ms"
        ) from error


class _Transactions(TransactionManager):
    """pymodbus' transactions, given only those bytes that are the reply to the request under way."""

    def __init__(
        self, made: TransactionManager, options: LineOptions, clock: Clock, counters: ModbusCounters
    ) -> None:
        super().__init__(
            made.comm_params,
            made.framer,
            0,
            is_server=False,
            trace_packet=None,
            trace_pdu=None,
            trace_connect=None,
        )
        self.max_buffer_size = _BUFFER_BYTES  # a flood is judged and counted like anything else
        self.last_byte_ns = 0
        self.accepted = b""
        self.refused = ""
        self.why_lost = f"{options.where} is closed"
        self._where = options.where
        self._serial = options.transport == "rtu"
        self._clock = clock
        self._counters = counters
        self._expected: Expected | None = None

    def expect(self, expected: Expected | None) -> None:
        """Say which reply is waited for from now on; None for none."""
        if expected is None and self._expected is not None and self._serial and self.recv_buffer:
            self._counters.note("truncated")  # the request is over, and this is all that came of its reply
        if expected is not None:
            self.refused = ""
        self.recv_buffer = b""
        self._expected = expected

    def callback_data(self, data: bytes, addr: tuple[Any, ...] | None = None) -> int:
        """Take what answers the request, count all else; see `ModbusProtocol.callback_data`."""
        del addr
        self.last_byte_ns = self._clock.monotonic_ns()
        used = 0
        while used < len(data):
            verdict = self._judge(data[used:])
            if not verdict.used:
                break
            used += verdict.used
            if verdict.fault is not None:
                self._counters.note(verdict.fault)
            if verdict.final:
                self._settle(verdict)
        return used

    def callback_disconnected(self, exc: Exception | None) -> None:
        """Let nobody wait for a reply that cannot come any more."""
        self.why_lost = f"{self._where} has closed the connection" + (f" ({exc})" if exc else "")
        self._fail(self.why_lost)

    def _judge(self, data: bytes) -> Verdict:
        # The transaction id is pymodbus' to choose, when it sends.
        expected = self._expected
        if not self._serial:
            if expected is not None:
                expected = Expected(
                    expected.unit, expected.function, expected.data_bytes, self.request_transaction_id
                )
            return judge_tcp(data, expected)
        if expected is None:
            self._counters.note("unasked")
            return Verdict(len(data))
        return judge_rtu(data, expected, FramerRTU.compute_CRC)

    def _settle(self, verdict: Verdict) -> None:
        """End the request: with its reply, or because this was its reply and it is faulty."""
        if verdict.pdu is None:
            self.refused = str(verdict.fault)
            self._fail(f"the reply is {verdict.fault}")
            if verdict.fault == "wrong_protocol" and self.transport is not None:
                self.transport.close()  # where the next frame begins is not known any more
        elif self._waits:
            # The registers are decoded in bulk later; pymodbus only needs to see that this is its reply.
            self.accepted = verdict.pdu
            self.response_future.set_result(
                ModbusPDU(dev_id=self.request_dev_id, transaction_id=self.request_transaction_id)
            )
        self._expected = None

    @property
    def _waits(self) -> bool:
        return self._expected is not None and not self.response_future.done()

    def _fail(self, why: str) -> None:
        if self._waits:
            self.response_future.set_exception(ModbusException(why))


def _heed_cancellation() -> None:
    """Raise the cancellation that `asyncio.wait_for` has swallowed, as it does when a result comes with it.

    Python 3.12 does not any more.
    """
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError
