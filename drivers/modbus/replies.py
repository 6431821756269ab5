"""What comes back on a Modbus line, byte by byte: which reply answers the request, and what the others are.

Pure functions over bytes, strict: a reply counts only if unit, transaction, function and length are those
that were asked for. Modbus Application Protocol 1.1b3; Modbus over serial line 1.02; TCP guide 1.0b.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

from drivers.base import BusCounters
from drivers.modbus.settings import FIFO_REGISTERS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from drivers.modbus.settings import Table


Fault: TypeAlias = Literal[
    "truncated", "oversized", "corrupt", "wrong_unit", "wrong_transaction", "wrong_function", "wrong_protocol"
]

READ_COILS, READ_DISCRETE, READ_HOLDING, READ_INPUT = 1, 2, 3, 4
WRITE_COIL, WRITE_REGISTER, WRITE_COILS, WRITE_REGISTERS = 5, 6, 15, 16
READ_FIFO = 24
FUNCTIONS: Mapping[Table, int] = {"holding": READ_HOLDING, "input": READ_INPUT}
"""Which function reads which table."""

EXCEPTIONS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "server device failure",
    5: "acknowledge",
    6: "server device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target device failed to respond",
}

REMEDIES = {
    1: "see whether the device has the other table: holding or input registers",
    2: "compare address and table with the register map of the device; what a map that begins at 1 calls "
    "101 is address 100 here; daqsvc sniff modbus shows which registers there are",
    3: "let a request read less (max_count), or compare the register map of the device with the layout",
    4: "check the device",
    5: "it takes longer than a reply may; lower the rate of what is read from it",
    6: "it is busy; lower the rate of what is read from it",
    8: "its memory fails; have it repaired",
    10: "compare unit with the routes of the gateway",
    11: "check the unit and its line behind the gateway, and compare unit with its address",
}
"""What to do about each of these."""

OTHER_REMEDY = "look the exception up in the manual of the device"

FAULTY: dict[Fault, str] = {
    "truncated": "a reply that is too short",
    "oversized": "a reply that is too long",
    "corrupt": "bytes that are no frame",
    "wrong_unit": "a reply in another unit's name",
    "wrong_transaction": "a reply to another request",
    "wrong_function": "a reply to another function",
    "wrong_protocol": "what is not Modbus",
}
"""What a unit answers with, in words."""

GATEWAY_CODES = frozenset({10, 11})
"""Exceptions by which a gateway states that the unit behind it is silent."""

_MBAP = struct.Struct(">HHHB")
MBAP_BYTES = _MBAP.size
MAX_TCP_BYTES = 260
MAX_RTU_BYTES = 256

_EXCEPTION_BIT = 0x80
_WRITES = (WRITE_COIL, WRITE_REGISTER, WRITE_COILS, WRITE_REGISTERS)
_READS = (READ_COILS, READ_DISCRETE, READ_HOLDING, READ_INPUT)


class ExpectedReply(NamedTuple):
    """The reply that is waited for.

    Attributes:
        unit: address of the unit that was asked.
        function: what it was asked to do.
        data_bytes: bytes of register data in the reply; None where the unit decides (FIFO) or there are none.
        transaction: id of the request; 0 on a serial line, which has none.
    """

    unit: int
    function: int
    data_bytes: int | None
    transaction: int = 0


class ReplyVerdict(NamedTuple):
    """What the bytes received so far are.

    Attributes:
        used: bytes that are done with; the rest may be the beginning of something.
        pdu: function and data of the reply that was waited for, a refusal of the unit included.
        fault: what is wrong with the bytes done with; None if there are none or they are the reply.
        final: whether the request can no more be answered, since this was its reply.
    """

    used: int = 0
    pdu: bytes | None = None
    fault: Fault | None = None
    final: bool = False


def pdu_bytes(start: bytes) -> int | None:
    """Length of a reply's PDU, from how it begins; None while that is too short to tell.

    Raises:
        ValueError: no reply that this service asks for begins like that.
    """
    if not start:
        return None
    function = start[0]
    if function & _EXCEPTION_BIT:
        return 2
    if function in _READS:
        return None if len(start) < 2 else 2 + start[1]
    if function in _WRITES:
        return 5
    if function == READ_FIFO:
        return None if len(start) < 3 else 3 + int.from_bytes(start[1:3], "big")
    raise ValueError(f"function {function} of a reply is not one that was ever asked for")


def judge_pdu(pdu: bytes, expected: ExpectedReply) -> Fault | None:  # noqa: PLR0911 - one for each fault
    """What is wrong with the PDU of the unit and transaction that were asked; None if nothing is."""
    if not pdu:
        return "truncated"
    if pdu[0] == expected.function | _EXCEPTION_BIT:
        return _length_fault(len(pdu), 2)
    if pdu[0] != expected.function:
        return "wrong_function"
    if pdu[0] in _WRITES:
        return _length_fault(len(pdu), 5)
    if pdu[0] == READ_FIFO:
        return _judge_fifo(pdu)
    assert expected.data_bytes is not None  # noqa: S101 - a read of registers knows how many
    if len(pdu) < 2:
        return "truncated"
    return _length_fault(pdu[1], expected.data_bytes) or _length_fault(len(pdu), 2 + expected.data_bytes)


def register_bytes(pdu: bytes) -> bytes:
    """The registers of a sound reply, high byte of each first; empty for a write."""
    if pdu[0] == READ_FIFO:
        return pdu[5:]
    return pdu[2:] if pdu[0] in _READS else b""


def judge_tcp(data: bytes, expected: ExpectedReply | None) -> ReplyVerdict:  # noqa: PLR0911 - one for each fault
    """What is at the head of the bytes received over TCP (MBAP frames)."""
    if len(data) < MBAP_BYTES:
        return ReplyVerdict()
    transaction, protocol, length, unit = _MBAP.unpack_from(data)
    if protocol != 0:
        # No length can be believed any more: nothing shows where the next frame begins.
        return ReplyVerdict(len(data), fault="wrong_protocol", final=True)
    if length < 2:
        return ReplyVerdict(len(data), fault="truncated", final=True)
    end = MBAP_BYTES - 1 + length
    if end > MAX_TCP_BYTES:
        return ReplyVerdict(len(data), fault="oversized", final=True)
    if len(data) < end:
        return ReplyVerdict()
    if expected is None or transaction != expected.transaction:
        return ReplyVerdict(end, fault="wrong_transaction")
    if unit != expected.unit:
        return ReplyVerdict(end, fault="wrong_unit")
    pdu = data[MBAP_BYTES:end]
    fault = judge_pdu(pdu, expected)
    return ReplyVerdict(end, None if fault else pdu, fault, final=True)


def judge_rtu(  # noqa: PLR0911 - one for each fault
    data: bytes, expected: ExpectedReply, crc_of: Callable[[bytes], int]
) -> ReplyVerdict:
    """What is at the head of the bytes received on a serial line.

    Args:
        data: all that was received since the request and is not done with.
        expected: the reply that is waited for.
        crc_of: CRC-16/MODBUS of some bytes, as an int of its two bytes in their order on the line.
    """
    if len(data) < 2:
        return ReplyVerdict()
    try:
        length = pdu_bytes(data[1:4])
    except ValueError:
        return ReplyVerdict(len(data), fault="corrupt")
    if length is None:
        return ReplyVerdict()
    end = 1 + length + 2
    if end > MAX_RTU_BYTES:
        return ReplyVerdict(len(data), fault="oversized")
    if len(data) < end:
        return ReplyVerdict()
    if crc_of(data[: end - 2]) != int.from_bytes(data[end - 2 : end], "big"):
        return ReplyVerdict(len(data), fault="corrupt")
    if data[0] != expected.unit:
        return ReplyVerdict(end, fault="wrong_unit")
    pdu = data[1 : end - 2]
    fault = judge_pdu(pdu, expected)
    return ReplyVerdict(end, None if fault else pdu, fault, final=True)


def _judge_fifo(pdu: bytes) -> Fault | None:
    if len(pdu) < 5:
        return "truncated"
    stated, registers = int.from_bytes(pdu[1:3], "big"), int.from_bytes(pdu[3:5], "big")
    if registers > FIFO_REGISTERS:
        return "oversized"
    return _length_fault(stated, 2 + 2 * registers) or _length_fault(len(pdu), 3 + stated)


def _length_fault(actual: int, wanted: int) -> Fault | None:
    if actual == wanted:
        return None
    return "truncated" if actual < wanted else "oversized"


class LineLostError(Exception):
    """The connection or the port is gone, or cannot be opened."""


class NoReplyError(Exception):
    """A unit has not answered in time, or what it answered was no reply to the request."""


class RequestRefusedError(Exception):
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
        idle_closes: connections that the device closed while nothing was asked, opened again for a request.
        units_demoted: how often a silent unit was set aside.
        units_back: how often one was found to be back.
        requests_demoted: how often requests of a unit that answers others were set aside.
        requests_back: how often such were answered again.
        probes: requests made to see whether what was set aside is answered again.
        blocks_torn: waveform blocks that the device replaced while they were read.
        blocks_missed: waveform blocks that were over before they could be read.
        ring_overruns: how often a ring was overwritten before it was read.
        counts_doubted: write counters and block ids that another reading did not confirm.
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
    idle_closes: int = 0
    units_demoted: int = 0
    units_back: int = 0
    requests_demoted: int = 0
    requests_back: int = 0
    probes: int = 0
    blocks_torn: int = 0
    blocks_missed: int = 0
    ring_overruns: int = 0
    counts_doubted: int = 0

    def note(self, fault: str) -> None:
        """Count a faulty reply."""
        name = f"replies_{fault}"
        setattr(self, name, getattr(self, name) + 1)

    def note_exception(self, code: int) -> str:
        """Count a refusal, and return what it is called."""
        kind = EXCEPTIONS.get(code, f"exception {code}")
        self.exceptions[kind] = self.exceptions.get(kind, 0) + 1
        return kind
