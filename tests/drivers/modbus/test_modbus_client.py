"""The Modbus client against a far end that a test plays byte by byte."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import select
import socket
import struct
from unittest import mock

import pytest
import serial
from pymodbus.framer import FramerRTU
from support.bus_tables import modbus_bus

from daqsvc.acquisition.clock import SystemClock
from drivers.modbus.client import ModbusClient, ModbusWire
from drivers.modbus.replies import LineLostError, ModbusCounters, NoReplyError
from sim_hw.nodes.serial_node import PseudoTerminal

pytestmark = pytest.mark.integration
TIMEOUT_NS = 50_000_000
PATIENT_S = 20.0


def reply(request: bytes, *words: int) -> bytes:
    """The frame that answers a request to read registers."""
    data = struct.pack(f">{len(words)}H", *words)
    return request[:4] + struct.pack(">HBBB", 3 + len(data), request[6], request[7], len(data)) + data


def rtu(body: bytes) -> bytes:
    """A frame on a serial line."""
    return body + FramerRTU.compute_CRC(body).to_bytes(2, "big")


@contextlib.asynccontextmanager
async def far_end(*answers):
    """A client and its counters; each of ``answers`` takes a request and writes what it likes."""

    async def talk(reader, writer):
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
            for answer in answers:
                answer(await reader.readexactly(12), writer)
            await reader.read()
        writer.close()

    server = await asyncio.start_server(talk, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    counters = ModbusCounters()
    options = modbus_bus(transport="tcp", host="127.0.0.1", tcp_port=port, timeout_ms=TIMEOUT_NS / 1e6)
    client = ModbusClient(options, SystemClock(), counters)
    await client.connect()
    try:
        yield client, counters
    finally:
        await client.close()
        server.close()


async def test_the_end_of_a_late_reply_is_not_taken_for_the_head_of_the_next():
    late = []

    def first_half_too_late(request, writer):
        frame = reply(request, 1, 2, 3)
        late.append(frame[6:])
        loop = asyncio.get_running_loop()
        loop.call_later(1.5 * TIMEOUT_NS / 1e9, writer.write, frame[:6])

    def second_half_and_the_answer(request, writer):
        writer.write(late.pop() + reply(request, 4, 5, 6))

    async with far_end(first_half_too_late, second_half_and_the_answer) as (client, counters):
        with pytest.raises(NoReplyError, match="has not answered within 50 ms"):
            await client.read(1, 3, 0, 3)
        before_ns = client.last_byte_ns
        async with asyncio.timeout(10):
            while client.last_byte_ns == before_ns:
                await asyncio.sleep(0.005)
        assert await client.read(1, 3, 0, 3) == struct.pack(">3H", 4, 5, 6)
    assert (counters.replies_wrong_transaction, counters.replies_wrong_protocol) == (1, 0)


async def test_a_flood_is_counted_and_ends_the_request():
    async with far_end(lambda _request, writer: writer.write(bytes(100_000))) as (client, counters):
        with pytest.raises((NoReplyError, LineLostError)):
            await client.read(1, 3, 0, 3)
    assert counters.replies_oversized + counters.replies_truncated >= 1
    assert counters.replies == 0


async def test_who_speaks_another_protocol_is_told_so():
    async with far_end(lambda _request, writer: writer.write(b"HTTP/1.1 400 Bad Request\r\n")) as (
        client,
        counters,
    ):
        with pytest.raises(LineLostError, match=r"127\.0\.0\.1:\d+ does not speak Modbus TCP; compare host"):
            await client.read(1, 3, 0, 3)
        assert not client.connected
    assert counters.replies_wrong_protocol == 1


async def test_a_connection_that_is_closed_ends_the_request_at_once():
    async with far_end(lambda _request, writer: writer.close()) as (client, counters):
        with pytest.raises(LineLostError, match="has closed the connection"):
            await client.read(1, 3, 0, 3)
    assert counters.timeouts == 0


async def test_a_connection_that_was_closed_while_nothing_was_asked_is_opened_again_if_somebody_is_there():
    def answer_and_close(request, writer):
        writer.write(reply(request, 7))
        writer.close()

    async def closed(client):
        async with asyncio.timeout(10):
            while client.connected:
                await asyncio.sleep(0.005)

    async with far_end(answer_and_close) as (client, counters):
        for _ in range(3):
            assert await client.read(1, 3, 0, 1) == b"\0\7"
            await closed(client)
        why = "has closed the connection; see whether the device has restarted"
        gone = mock.patch.object(ModbusWire, "open", side_effect=LineLostError("nobody listens there"))
        with gone, pytest.raises(LineLostError, match=why):
            await client.read(1, 3, 0, 1)
        await client.close()
        with pytest.raises(LineLostError, match=why):  # what its owner has closed stays so
            await client.read(1, 3, 0, 1)
    assert (counters.idle_closes, counters.requests) == (2, 3)


@contextlib.contextmanager
def nobody(tmp_path):
    """A TCP port that somebody has, and on which nobody listens."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        yield modbus_bus(transport="tcp", host="127.0.0.1", tcp_port=taken.getsockname()[1])


@contextlib.contextmanager
def unknown(tmp_path):
    nowhere = mock.Mock(side_effect=socket.gaierror(socket.EAI_NONAME, "Name or service not known"))
    with mock.patch.object(socket, "getaddrinfo", nowhere):
        yield modbus_bus(transport="tcp", host="no-such-host.invalid", tcp_port=502)


@contextlib.contextmanager
def cut_off(tmp_path):
    nowhere = mock.Mock(side_effect=OSError(errno.ENETUNREACH, "Network is unreachable"))
    with mock.patch.object(asyncio.BaseEventLoop, "create_connection", nowhere):
        yield modbus_bus(transport="tcp", host="192.0.2.20", tcp_port=502)


@contextlib.contextmanager
def unplugged(tmp_path):
    yield modbus_bus(transport="rtu", serial_port=str(tmp_path / "ttyUSB0"))


@contextlib.contextmanager
def in_use(tmp_path):
    with PseudoTerminal(tmp_path / "port"), serial.Serial(str(tmp_path / "port"), exclusive=True):
        yield modbus_bus(transport="rtu", serial_port=str(tmp_path / "port"), parity="none")


@pytest.mark.parametrize(
    ("line", "why"),
    [
        (
            nobody,
            r"it cannot be opened: nobody listens there; start the server, or correct host",
        ),
        (
            unknown,
            r"it cannot be opened: no address of 'no-such-host\.invalid' is known",
        ),
        (cut_off, r"it cannot be opened: no route leads there from this box; correct host"),
        (unplugged, r"cannot be opened: there is no .*ttyUSB0; plug the device in, or correct serial_port"),
        (in_use, r"cannot be opened: another program has it open; stop that program"),
    ],
)
async def test_why_a_line_cannot_be_opened_is_told_with_what_to_do(line, why, tmp_path):
    counters = ModbusCounters()
    with line(tmp_path) as options:
        client = ModbusClient(options, SystemClock(), counters)
        with pytest.raises(LineLostError, match=why):
            await client.connect()
        await client.close()
    assert counters.open_failures == 1


async def test_what_came_while_this_process_was_suspended_is_not_the_reply_to_the_next_request(tmp_path):
    """The quiet time has passed by the clock, but nobody has looked at what came in it."""
    counters = ModbusCounters()
    with PseudoTerminal(tmp_path / "port") as cable:
        options = modbus_bus(
            transport="rtu", serial_port=str(cable.path), parity="none", timeout_ms=1e3 * PATIENT_S
        )
        client = ModbusClient(options, SystemClock(), counters)
        await client.connect()
        fd = client._wire.transport.sync_serial.fileno()
        late, sound = rtu(b"\1\3\2\0\1"), rtu(b"\1\3\2\0\2")
        os.write(cable.fd, late)
        assert select.select([fd], [], [], PATIENT_S)[0], "it is in the port, and the event loop has not run"
        asking = asyncio.create_task(client.read(1, 3, 0, 1))
        while not counters.requests:
            await asyncio.sleep(0)
        await asyncio.sleep(0.05)
        os.write(cable.fd, sound)
        assert await asking == b"\0\2"
        await client.close()
    assert counters.replies_unasked == 1
