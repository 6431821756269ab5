"""Captured Modbus TCP: what real clients and servers sent, through the code that serves a live line."""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

import numpy as np
import pytest
from support.bus_tables import modbus_bus
from support.pcap import conversations

from daqsvc.acquisition.clock import SystemClock
from drivers.modbus.client import ModbusClient
from drivers.modbus.replies import (
    EXCEPTIONS,
    READ_INPUT,
    WRITE_REGISTERS,
    ExpectedReply,
    ModbusCounters,
    RequestRefusedError,
    judge_tcp,
    register_bytes,
)
from sim_hw.nodes.modbus_node import ModbusTcpServer, UnitConnection

if TYPE_CHECKING:
    from pathlib import Path

    from support.pcap import Conversation

    from drivers.modbus.replies import ReplyVerdict
    from sim_hw.nodes.modbus_unit import ModbusUnit

pytestmark = [pytest.mark.integration, pytest.mark.data]

PORT = 502
BITS, REGISTERS, WRITES, FIFO = (1, 2), (3, 4), (5, 6, 15, 16), 24
JUDGED = {*BITS, *REGISTERS, *WRITES, FIFO}
"""Functions whose replies are judged; the service asks for no others."""

FUNCTIONS = {
    "READ_COILS": 1,
    "READ_DISCRETE_INPUTS": 2,
    "READ_HOLDING_REGISTERS": 3,
    "READ_INPUT_REGISTERS": 4,
    "WRITE_SINGLE_COIL": 5,
    "WRITE_SINGLE_REGISTER": 6,
    "READ_EXCEPTION_STATUS": 7,
    "DIAGNOSTICS": 8,
    "WRITE_MULTIPLE_COILS": 15,
    "WRITE_MULTIPLE_REGISTERS": 16,
    "REPORT_SLAVE_ID": 17,
    "READ_FILE_RECORD": 20,
    "WRITE_FILE_RECORD": 21,
    "MASK_WRITE_REGISTER": 22,
    "READ_WRITE_MULTIPLE_REGISTERS": 23,
    "READ_FIFO_QUEUE": 24,
    "ENCAP_INTERFACE_TRANSPORT": 43,
}

# Counted with a cutter of frames that knows only lengths. Replies to no captured request (the capture began
# too late), or to functions that nobody here asks for, are those of a wrong transaction.
REPLIES = {
    "modbus_example.pcap": Counter(sound=13, refused=1, wrong_transaction=10),
    "modbus_test.pcap": Counter(sound=1115, wrong_transaction=1),
    "modbus_test_data_part1.pcap": Counter(sound=6, wrong_transaction=21, wrong_protocol=1),
    "modbus_test_data_part2.pcap": Counter(sound=5, refused=16, wrong_transaction=119),
    "modbusSmall.pcap": Counter(sound=16),
}


@dataclass(frozen=True, slots=True)
class Request:
    """What a client has asked."""

    transaction: int
    unit: int
    pdu: bytes

    @property
    def expected(self) -> ExpectedReply | None:
        """The reply that it waits for; None if nobody here would ask that."""
        function = self.pdu[0]
        if function not in JUDGED or len(self.pdu) < 3:
            return None
        data_bytes = None
        if function in BITS + REGISTERS:
            count = int.from_bytes(self.pdu[3:5], "big")
            data_bytes = -(-count // 8) if function in BITS else 2 * count
        return ExpectedReply(self.unit, function, data_bytes, self.transaction)


@dataclass(slots=True)
class Told:
    """A conversation as it was understood."""

    requests: list[Request] = field(default_factory=list)
    answered: list[tuple[Request, bytes]] = field(default_factory=list)
    verdicts: list[ReplyVerdict] = field(default_factory=list)
    left_over: int = 0


class Listener:
    """A unit that only listens to what it is asked."""

    def __init__(self, unit: int, heard: list[tuple[int, bytes]]) -> None:
        self._unit, self._heard = unit, heard

    def answer(self, pdu: bytes) -> bytes:
        self._heard.append((self._unit, pdu))
        return pdu


class Recorded:
    """Units that answer as they did when they were captured."""

    heard = reply = b""

    def answer(self, pdu: bytes) -> bytes:
        self.heard = pdu
        return self.reply


def understood(conversation: Conversation) -> Told:
    """Cut both sides into requests and replies, in the order of the capture."""
    told = Told()
    heard: list[tuple[int, bytes]] = []
    frames: list[bytes] = []
    units = {unit: cast("ModbusUnit", Listener(unit, heard)) for unit in range(256)}
    wire = UnitConnection(units, frames.append, serial=False)
    rest = b""
    for segment in conversation.segments:
        if not segment.from_server:
            wire.feed(segment.data)
            told.requests += [
                Request(int.from_bytes(frame[:2], "big"), unit, pdu)
                for frame, (unit, pdu) in zip(frames, heard, strict=True)
            ]
            frames.clear()
            heard.clear()
            continue
        rest += segment.data
        while rest:
            asked = next(
                (r for r in told.requests[::-1] if r.transaction == int.from_bytes(rest[:2], "big")), None
            )
            verdict = judge_tcp(rest, None if asked is None else asked.expected)
            if not verdict.used:
                break
            if verdict.pdu is not None and asked is not None:
                told.answered.append((asked, verdict.pdu))
            told.verdicts.append(verdict)
            rest = rest[verdict.used :]
    told.left_over = len(rest)
    return told


def captures(data: Path) -> dict[str, list[Told]]:
    """All conversations of all captures."""
    files = sorted((data / "modbus").rglob("*.pcap"))
    return {file.name: [understood(c) for c in conversations(file, PORT)] for file in files}


def test_every_reply_is_taken_or_counted_as_faulty(data: Path) -> None:
    found = captures(data)
    for name, told in found.items():
        kinds = Counter(
            str(verdict.fault) if verdict.pdu is None else "refused" if verdict.pdu[0] & 0x80 else "sound"
            for one in told
            for verdict in one.verdicts
        )
        assert kinds == REPLIES[name], name
        assert not any(one.left_over for one in told), name
    assert found.keys() == REPLIES.keys()


def values_of(names: dict[str, str], column: str) -> list[int]:
    """A column of numbers in a baseline log, empty if it has none."""
    return [] if names[column] in {"-", ""} else [int(value) for value in names[column].split(",")]


def test_requests_and_replies_say_what_the_analysers_own_log_says(data: Path) -> None:
    folder = data / "modbus" / "icsnpp" / "testing"
    (_, *lines) = (folder / "baseline" / "analyzer.basic" / "modbus_detailed.log").read_text().splitlines()
    names = next(line.split("\t")[1:] for line in lines if line.startswith("#fields"))
    rows = [dict(zip(names, line.split("\t"), strict=True)) for line in lines if line[0] != "#"]
    told = captures(data)["modbus_example.pcap"]
    heard = {(r.transaction, r.unit): r.pdu for one in told for r in one.requests}
    answers = {(r.transaction, r.unit): pdu for one in told for r, pdu in one.answered}
    logged = {(int(row["tid"]), int(row["unit"])): row for row in rows}
    assert heard.keys() == logged.keys()
    for key, row in logged.items():
        function, pdu = FUNCTIONS[row["func"]], heard[key]
        assert pdu[0] == function
        if function not in JUDGED:
            assert key not in answers
            continue
        reply = answers[key]
        assert int.from_bytes(pdu[1:3], "big") == int(row["address"])
        if row["exception_code"] != "-":
            assert reply == bytes([function | 0x80, 2])
            assert EXCEPTIONS[2].upper().replace(" ", "_") == row["exception_code"]
        elif function in REGISTERS:
            assert int.from_bytes(pdu[3:5], "big") == int(row["quantity"])
            assert np.frombuffer(register_bytes(reply), ">u2").tolist() == values_of(row, "response_values")
        elif function in BITS:
            bits = np.unpackbits(np.frombuffer(register_bytes(reply), np.uint8), bitorder="little")
            # The bits past those asked for are in a column of their own, if there are any.
            spare = values_of(row, "response_data")
            assert bits.tolist() == values_of(row, "response_values") + spare
        elif function == WRITE_REGISTERS:
            assert list(struct.unpack(f">{pdu[5] // 2}H", pdu[6:])) == values_of(row, "request_values")
        elif function == FIFO:
            assert register_bytes(reply) == b""


def may_be_asked(pdu: bytes) -> bool:
    """Whether the standard allows a request; one capture is of a client that tries anything."""
    if pdu[0] == FIFO:
        return len(pdu) == 3
    count = int.from_bytes(pdu[3:5], "big")
    return 1 <= count <= 125 and len(pdu) == (5 if pdu[0] in REGISTERS else 6 + 2 * count)


async def test_our_client_asks_in_the_same_bytes_and_reads_the_same_replies(data: Path) -> None:
    """Each captured exchange of a function that the service uses, held again with a server of its own."""
    exchanges = [
        (name, request, reply)
        for name, told in captures(data).items()
        for one in told
        for request, reply in one.answered
        if request.pdu[0] in {*REGISTERS, WRITE_REGISTERS, FIFO} and may_be_asked(request.pdu)
    ]
    assert Counter(request.pdu[0] for _, request, _ in exchanges)[READ_INPUT] > 1000
    recorded = Recorded()
    units = {unit: cast("ModbusUnit", recorded) for unit in range(256)}
    server = ModbusTcpServer(units)
    await server.start()
    counters = ModbusCounters()
    client = ModbusClient(
        modbus_bus(transport="tcp", host="127.0.0.1", tcp_port=server.port), SystemClock(), counters
    )
    await client.connect()
    try:
        for name, request, reply in exchanges:
            recorded.reply = reply
            unit, function, address = request.unit, request.pdu[0], int.from_bytes(request.pdu[1:3], "big")
            got, refusal = b"", None
            try:
                if function == WRITE_REGISTERS:
                    await client.write(
                        unit, address, struct.unpack(f">{request.pdu[5] // 2}H", request.pdu[6:])
                    )
                elif function == FIFO:
                    got = await client.read_fifo(unit, address)
                else:
                    got = await client.read(unit, function, address, int.from_bytes(request.pdu[3:5], "big"))
            except RequestRefusedError as error:
                refusal = bytes([function | 0x80, error.code])
            registers = {FIFO: reply[5:], WRITE_REGISTERS: b""}.get(function, reply[2:])
            assert (got, refusal) == ((b"", reply) if reply[0] & 0x80 else (registers, None)), name
            assert recorded.heard == request.pdu, name
    finally:
        await client.close()
        server.stop()
    assert counters.requests == counters.replies == len(exchanges)
