"""What comes back on a Modbus line: any bytes are judged without an error, and only the reply is taken."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.examples import examples

from drivers.modbus.replies import (
    MAX_RTU_BYTES,
    MAX_TCP_BYTES,
    ExpectedReply,
    judge_rtu,
    judge_tcp,
    register_bytes,
)

pytestmark = pytest.mark.property


def crc_of(data):
    """CRC-16/MODBUS bit by bit, as its standard writes it down; low byte first on the line."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return (crc & 0xFF) << 8 | crc >> 8


def rtu(unit, pdu):
    body = bytes([unit]) + pdu
    return body + crc_of(body).to_bytes(2, "big")


def tcp(transaction, unit, pdu):
    return struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu


expected_replies = st.builds(
    ExpectedReply,
    st.integers(1, 247),
    st.sampled_from([3, 4]),
    st.integers(1, 125).map(lambda n: 2 * n),
    st.just(77),
) | st.builds(ExpectedReply, st.integers(1, 247), st.sampled_from([16, 24]), st.none(), st.just(77))
heads = st.sampled_from([b"", b"\0\x4d\0\0\0\x05\1\3", b"\1\3\4", b"\1\x18\0\x06\0\2", b"\1\x83\2"])


@settings(max_examples=examples(3000))
@given(st.builds(bytes.__add__, heads, st.binary(max_size=300)), expected_replies)
def test_any_bytes_are_judged(data, expected):
    for verdict in (judge_tcp(data, expected), judge_tcp(data, None), judge_rtu(data, expected, crc_of)):
        assert 0 <= verdict.used <= len(data)
        assert verdict.used or verdict.fault is None
        if verdict.pdu is not None:
            assert verdict.final
            assert verdict.fault is None
            assert verdict.pdu[0] & 0x7F == expected.function
            if verdict.pdu[0] in (3, 4):
                assert len(register_bytes(verdict.pdu)) == expected.data_bytes
    # What is not done with must stay below what a frame can hold, or a line could fill the memory.
    assert len(data) - judge_tcp(data, expected).used <= MAX_TCP_BYTES or judge_tcp(data, expected).used
    assert (
        len(data) - judge_rtu(data, expected, crc_of).used <= MAX_RTU_BYTES
        or judge_rtu(data, expected, crc_of).used
    )


def sound_pdu(expected, payload):
    if expected.function in (3, 4):
        data = (payload * 250)[: expected.data_bytes]
        return bytes([expected.function, expected.data_bytes]) + data, data
    if expected.function == 24:
        data = (payload * 31)[: 2 * (len(payload) % 32)]
        return struct.pack(">BHH", 24, 2 + len(data), len(data) // 2) + data, data
    return bytes([16]) + (payload * 4)[:4], b""


@settings(max_examples=examples(500))
@given(expected_replies, st.binary(min_size=1, max_size=40), st.integers(0, 300))
def test_a_reply_is_taken_once_it_is_whole_and_not_before(expected, payload, cut):
    pdu, data = sound_pdu(expected, payload)
    for frame, judge in (
        (tcp(77, expected.unit, pdu), judge_tcp),
        (rtu(expected.unit, pdu), lambda got, wanted: judge_rtu(got, wanted, crc_of)),
    ):
        part = frame[: min(cut, len(frame) - 1)]
        assert judge(part, expected).used == 0
        verdict = judge(frame + b"\0" * (cut % 3), expected)
        assert verdict.pdu == pdu
        assert verdict.used == len(frame)
        assert register_bytes(verdict.pdu) == data


@settings(max_examples=examples(500))
@given(expected_replies, st.binary(min_size=1, max_size=40), st.data())
def test_a_reply_that_is_not_the_one_is_told_by_kind(expected, payload, data):
    pdu, _ = sound_pdu(expected, payload)
    other = data.draw(st.integers(0, 255).filter(lambda unit: unit != expected.unit))
    assert judge_tcp(tcp(77, other, pdu), expected).fault == "wrong_unit"
    assert judge_rtu(rtu(other, pdu), expected, crc_of).fault == "wrong_unit"
    assert judge_tcp(tcp(78, expected.unit, pdu), expected).fault == "wrong_transaction"
    assert judge_tcp(tcp(77, expected.unit, pdu), None).fault == "wrong_transaction"
    spoilt = bytearray(rtu(expected.unit, pdu))
    spoilt[data.draw(st.integers(len(spoilt) - 2, len(spoilt) - 1))] ^= data.draw(st.integers(1, 255))
    assert judge_rtu(bytes(spoilt), expected, crc_of).fault == "corrupt"
    if expected.data_bytes is not None:
        for registers in {1, 60, 125} - {expected.data_bytes // 2}:
            wrong = bytes([expected.function, 2 * registers]) + b"\0" * (2 * registers)
            kind = "truncated" if 2 * registers < expected.data_bytes else "oversized"
            for verdict in (
                judge_tcp(tcp(77, expected.unit, wrong), expected),
                judge_rtu(rtu(expected.unit, wrong), expected, crc_of),
            ):
                assert (verdict.fault, verdict.pdu, verdict.final) == (kind, None, True)
