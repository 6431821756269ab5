"""The Sparkplug payload: what is written is read again, here and elsewhere; nothing breaks reading."""

from __future__ import annotations

import contextlib
import math
import struct
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.paths import ROOT
from support.sparkplug_host import seen

from daqsvc.publish.sparkplug.codec import MOST_BYTES, DataType, Metric, Payload, PayloadError, decode, encode

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.property
SCHEMA = ROOT / "daqsvc/publish/sparkplug/sparkplug_b.proto"
U64 = 2**64 - 1
VALUES = {
    DataType.INT32: st.integers(-(2**31), 2**31 - 1),
    DataType.UINT32: st.integers(0, 2**32 - 1),
    DataType.INT64: st.integers(-(2**63), 2**63 - 1),
    DataType.UINT64: st.integers(0, U64),
    DataType.DATETIME: st.integers(0, U64),
    DataType.FLOAT: st.floats(width=32, allow_nan=False),
    DataType.DOUBLE: st.floats(allow_nan=False),
    DataType.BOOLEAN: st.booleans(),
    DataType.STRING: st.text(max_size=20),
}


@st.composite
def metrics(draw: st.DrawFn) -> Metric:
    datatype = draw(st.sampled_from(list(VALUES)))
    return Metric(
        name=draw(st.none() | st.text(max_size=10)),
        alias=draw(st.none() | st.integers(0, U64)),
        timestamp_ms=draw(st.none() | st.integers(0, U64)),
        datatype=datatype,
        value=draw(st.none() | VALUES[datatype]),
        historical=draw(st.booleans()),
        properties=draw(st.dictionaries(st.text(max_size=5), st.text(max_size=5), max_size=3)),
    )


PAYLOADS = st.builds(
    Payload,
    st.none() | st.integers(0, U64),
    st.none() | st.integers(0, 255),
    st.lists(metrics(), max_size=5).map(tuple),
)


@given(PAYLOADS)
def test_what_is_written_is_read_again(payload: Payload) -> None:
    assert decode(encode(payload)) == payload


@given(PAYLOADS)
def test_another_reader_reads_the_same(payload: Payload) -> None:
    told = seen("spBv1.0/g/NDATA/e", encode(payload), 0, retain=False)
    assert (told.timestamp, told.seq) == (payload.timestamp_ms, payload.seq)
    for ours, theirs in zip(payload.metrics, told.metrics, strict=True):
        assert (theirs.name, theirs.alias, theirs.timestamp) == (ours.name, ours.alias, ours.timestamp_ms)
        assert (theirs.datatype, theirs.historical) == (ours.datatype, ours.historical)
        assert theirs.null == (ours.value is None)
        assert theirs.properties == ours.properties
        value = ours.value
        if isinstance(value, int) and value < 0:
            value += 2**32 if ours.datatype is DataType.INT32 else 2**64
        assert theirs.value == value


@given(st.binary(max_size=60))
def test_any_bytes_are_read_or_refused(raw: bytes) -> None:
    with contextlib.suppress(PayloadError):
        decode(raw)


@given(PAYLOADS, st.data())
def test_a_payload_that_is_cut_or_damaged_is_read_or_refused(payload: Payload, data: st.DataObject) -> None:
    raw = bytearray(encode(payload))
    if raw:
        place = data.draw(st.integers(0, len(raw) - 1))
        raw[place] ^= data.draw(st.integers(0, 255))
        del raw[data.draw(st.integers(0, len(raw))) :]
    with contextlib.suppress(PayloadError):
        decode(bytes(raw))


def test_bytes_by_the_rules_of_the_encoding() -> None:
    """Field by field, written by hand: key = number * 8 + wire type, little-endian groups of seven bits."""
    payload = Payload(
        300,
        1,
        (Metric(name="x", alias=2, timestamp_ms=300, datatype=DataType.DOUBLE, value=0.5, historical=True),),
    )
    metric = b"\x0a\x01x" + b"\x10\x02" + b"\x18\xac\x02" + b"\x20\x0a" + b"\x28\x01" + b"\x69"
    metric += struct.pack("<d", 0.5)
    by_hand = b"\x08\xac\x02" + b"\x12" + bytes([len(metric)]) + metric + b"\x18\x01"
    assert encode(payload) == by_hand
    assert decode(by_hand) == payload


def test_what_is_not_known_is_skipped() -> None:
    """A uuid, a body, metadata: other senders may have them."""
    metric = b"\x0a\x01x" + b"\x42\x02\x08\x01" + b"\x20\x03" + b"\x50\x07"
    raw = b"\x22\x02id" + b"\x2a\x03abc" + b"\x12" + bytes([len(metric)]) + metric
    assert decode(raw).metrics == (Metric(name="x", datatype=DataType.INT32, value=7),)


@pytest.mark.parametrize(
    ("datatype", "value"),
    [
        (DataType.INT32, 2**31),
        (DataType.UINT32, -1),
        (DataType.INT64, 2**63),
        (DataType.INT32, 0.5),
        (DataType.INT32, True),
        (DataType.BOOLEAN, 1),
        (DataType.STRING, 1),
        (DataType.DOUBLE, "1"),
        (DataType.FLOAT, 1e300),
        (DataType.DOUBLE, 10**400),
        (DataType.DOUBLE, True),
        (None, 1),
    ],
)
def test_a_value_that_does_not_fit_its_datatype_is_refused(datatype, value) -> None:
    with pytest.raises(PayloadError, match="'speed'"):
        encode(Payload(0, 0, (Metric(name="speed", datatype=datatype, value=value),)))


@pytest.mark.parametrize(
    "payload",
    [
        Payload(-1, 0, ()),
        Payload(0, 2**64, ()),
        Payload(0, 0, (Metric(name="speed", alias=-1, datatype=DataType.INT32),)),
        Payload(0, 0, (Metric(name="\ud800", datatype=DataType.INT32),)),
    ],
)
def test_a_number_or_a_name_that_its_field_cannot_hold_is_refused(payload) -> None:
    with pytest.raises(PayloadError, match="cannot be written as a Sparkplug payload"):
        encode(payload)


def test_infinity_fits_both_kinds_of_floats() -> None:
    metrics = tuple(
        Metric(name="x", datatype=kind, value=-math.inf) for kind in (DataType.FLOAT, DataType.DOUBLE)
    )
    assert decode(encode(Payload(0, 0, metrics))).metrics == metrics


@pytest.mark.sources
def test_the_compiled_schema_is_that_of_the_proto_file(tmp_path: Path) -> None:
    compiled = sorted(SCHEMA.parent.glob("sparkplug_b_pb2.py*"))
    assert [file.suffix for file in compiled] == [".py", ".pyi"]
    name = SCHEMA.relative_to(ROOT)
    output = [f"--python_out={tmp_path}", f"--pyi_out={tmp_path}"]
    command = [sys.executable, "-m", "grpc_tools.protoc", "-I.", *output, name]
    subprocess.run(command, cwd=ROOT, check=True, timeout=60)
    for file in compiled:
        anew = tmp_path / file.relative_to(ROOT)
        assert file.read_text("utf-8") == anew.read_text("utf-8"), "run make proto"


def test_not_a_number_can_be_told() -> None:
    told = decode(encode(Payload(0, 0, (Metric(name="x", datatype=DataType.DOUBLE, value=math.nan),))))
    assert math.isnan(told.metrics[0].value)


@pytest.mark.parametrize(
    ("raw", "why"),
    [
        (b"\x00" * (MOST_BYTES + 1), "longest that is read"),
        (b"\x12\x05abc", "5 bytes that are no Sparkplug B payload"),
        (b"\x08", "no Sparkplug B payload"),
        (b"\x08" + b"\xff" * 11, "no Sparkplug B payload"),
        (b"\x0b", "no Sparkplug B payload"),
        (b"\x12\x02\x20\x63", "datatype 99 is not known"),
        (b"\x12\x04\x0a\x02\xff\xfe", "UTF-8"),
        (b"\x12\x05\x4a\x03\x0a\x01a", "1 keys for 0 values"),
    ],
)
def test_what_cannot_be_read_is_refused_in_words(raw: bytes, why: str) -> None:
    with pytest.raises(PayloadError, match=why):
        decode(raw)
