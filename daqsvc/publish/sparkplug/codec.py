"""The Sparkplug B payload on the wire: the part of its protocol-buffers schema that an edge node needs.

Written out rather than generated: five messages with plain fields. What is not known is skipped on reading,
as the encoding asks for. Source: Sparkplug 3.0, section 6.4.1; Protocol Buffers, "Encoding".
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

Value: TypeAlias = "bool | int | float | str | None"

MOST_BYTES = 1_000_000
"""No command is as long; a longer payload is not looked at."""

_VARINT, _FIXED64, _LENGTH, _FIXED32 = 0, 1, 2, 5
_U32, _U64 = 2**32 - 1, 2**64 - 1


class PayloadError(ValueError):
    """Bytes that are no Sparkplug B payload, or a value that its datatype cannot hold."""


class DataType(IntEnum):
    """Datatypes of metrics and properties that are used here, by their number in the schema."""

    INT32 = 3
    INT64 = 4
    UINT32 = 7
    UINT64 = 8
    FLOAT = 9
    DOUBLE = 10
    BOOLEAN = 11
    STRING = 12
    DATETIME = 13


_FIELD = {
    # The fields of the value in a metric; a property has them seven lower.
    DataType.INT32: 10,
    DataType.UINT32: 10,
    DataType.INT64: 11,
    DataType.UINT64: 11,
    DataType.DATETIME: 11,
    DataType.FLOAT: 12,
    DataType.DOUBLE: 13,
    DataType.BOOLEAN: 14,
    DataType.STRING: 15,
}
_PROPERTY_SHIFT = 7
_LIMITS = {
    DataType.INT32: (-(2**31), 2**31 - 1),
    DataType.UINT32: (0, _U32),
    DataType.INT64: (-(2**63), 2**63 - 1),
    DataType.UINT64: (0, _U64),
    DataType.DATETIME: (0, _U64),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Metric:
    """One value.

    Attributes:
        name: its name; None where the alias stands for it.
        alias: number that stands for the name after a birth; None for none.
        timestamp_ms: when the value was taken, UTC, ms since 1970.
        datatype: how the value is written; after reading, None where the sender left it out.
        value: None says that there is none now. Read without a datatype, an integer is unsigned.
        historical: whether the value is of the past and leaves the present one alone.
        properties: what belongs to the value, e.g. its unit, as text.
    """

    name: str | None = None
    alias: int | None = None
    timestamp_ms: int | None = None
    datatype: DataType | None = None
    value: Value = None
    historical: bool = False
    properties: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Payload:
    """What one message carries.

    Attributes:
        timestamp_ms: when it was sent, UTC, ms since 1970; None for none.
        seq: sequence number, 0 to 255; None for none.
        metrics: the values.
    """

    timestamp_ms: int | None
    seq: int | None
    metrics: tuple[Metric, ...]


def encode(payload: Payload, *, datatypes: bool = True) -> bytes:
    """The payload's bytes.

    Args:
        payload: to be sent; every metric with its datatype.
        datatypes: whether the datatypes are written: births need them, data messages do without.

    Raises:
        PayloadError: a value does not fit its datatype.
    """
    parts = []
    if payload.timestamp_ms is not None:
        parts.append(_number(1, payload.timestamp_ms))
    parts += [_bytes(2, _metric(metric, datatypes=datatypes)) for metric in payload.metrics]
    if payload.seq is not None:
        parts.append(_number(3, payload.seq))
    return b"".join(parts)


def _metric(metric: Metric, *, datatypes: bool) -> bytes:
    if metric.datatype is None:
        raise PayloadError(f"metric {metric.name!r} has no datatype; say how its value is written")
    parts = []
    if metric.name is not None:
        parts.append(_text(1, metric.name))
    if metric.alias is not None:
        parts.append(_number(2, metric.alias))
    if metric.timestamp_ms is not None:
        parts.append(_number(3, metric.timestamp_ms))
    if datatypes:
        parts.append(_number(4, metric.datatype))
    if metric.historical:
        parts.append(_number(5, 1))
    if metric.value is None:
        parts.append(_number(7, 1))
    if metric.properties:
        parts.append(_bytes(9, _properties(metric.properties)))
    if metric.value is not None:
        parts.append(_value(_FIELD[metric.datatype], metric.datatype, metric.value, metric.name))
    return b"".join(parts)


def _properties(properties: Mapping[str, str]) -> bytes:
    keys = [_text(1, key) for key in properties]
    shape = _FIELD[DataType.STRING] - _PROPERTY_SHIFT
    values = [_bytes(2, _number(1, DataType.STRING) + _text(shape, value)) for value in properties.values()]
    return b"".join([*keys, *values])


def _value(at: int, datatype: DataType, value: Value, name: str | None) -> bytes:
    wrong = PayloadError(f"{value!r} of metric {name!r} is no {datatype.name}; correct the metric's datatype")
    if datatype is DataType.STRING:
        if not isinstance(value, str):
            raise wrong
        return _text(at, value)
    if value is None or isinstance(value, str) or isinstance(value, bool) != (datatype is DataType.BOOLEAN):
        raise wrong
    if datatype is DataType.BOOLEAN:
        return _number(at, int(value))
    if datatype in {DataType.FLOAT, DataType.DOUBLE}:
        wide = datatype is DataType.DOUBLE
        try:
            packed = struct.pack("<d" if wide else "<f", value)
        except OverflowError:
            raise wrong from None
        return _key(at, _FIXED64 if wide else _FIXED32) + packed
    low, high = _LIMITS[datatype]
    if not isinstance(value, int) or not low <= value <= high:
        raise wrong
    # Negative numbers go in two's complement of 32 or 64 bits, as the reference implementation sends them.
    return _number(at, value & (_U32 if datatype in {DataType.INT32, DataType.UINT32} else _U64))


def _varint(number: int) -> bytes:
    written = bytearray()
    while number > 0x7F:
        written.append(number & 0x7F | 0x80)
        number >>= 7
    written.append(number)
    return bytes(written)


def _key(at: int, kind: int) -> bytes:
    return _varint(at << 3 | kind)


def _number(at: int, number: int) -> bytes:
    if not 0 <= number <= _U64:
        raise PayloadError(f"{number} cannot stand in a payload; it takes 0 to {_U64}")
    return _key(at, _VARINT) + _varint(number)


def _bytes(at: int, content: bytes) -> bytes:
    return _key(at, _LENGTH) + _varint(len(content)) + content


def _text(at: int, text: str) -> bytes:
    return _bytes(at, text.encode())


class _Field(NamedTuple):
    """A field as read: its number and wire type, and what stands in it."""

    at: int
    kind: int
    number: int
    content: bytes


def decode(raw: bytes) -> Payload:
    """Read a payload.

    Raises:
        PayloadError: the bytes are none, or too many.
    """
    if len(raw) > MOST_BYTES:
        raise PayloadError(f"payload of {len(raw)} bytes; the longest that is read has {MOST_BYTES}")
    timestamp_ms = seq = None
    metrics = []
    for found in _fields(raw):
        match found.at, found.kind:
            case 1, 0:
                timestamp_ms = found.number
            case 2, 2:
                metrics.append(_read_metric(found.content))
            case 3, 0:
                seq = found.number
    return Payload(timestamp_ms, seq, tuple(metrics))


def _read_metric(raw: bytes) -> Metric:
    fields = {found.at: found for found in _fields(raw)}
    datatype = _datatype(fields.get(4))
    properties = fields.get(9)
    return Metric(
        name=_read_text(fields.get(1)),
        alias=_read_number(fields.get(2)),
        timestamp_ms=_read_number(fields.get(3)),
        datatype=datatype,
        value=None if _read_number(fields.get(7)) else _read_value(fields.values(), datatype),
        historical=bool(_read_number(fields.get(5))),
        properties={} if properties is None else _read_properties(properties.content),
    )


def _datatype(found: _Field | None) -> DataType | None:
    number = _read_number(found)
    if number is None:
        return None
    try:
        return DataType(number)
    except ValueError:
        raise PayloadError(f"datatype {number} is not known here; send one of {_names()}") from None


def _names() -> str:
    return ", ".join(f"{one.value} ({one.name})" for one in DataType)


def _read_value(fields: Iterable[_Field], datatype: DataType | None, shift: int = 0) -> Value:
    """The value in the fields of a metric or, seven lower, of a property."""
    for found in fields:
        match found.at + shift, found.kind:
            case 10 | 11, 0:
                return _signed(found.number, datatype)
            case 12, 5:
                return float(struct.unpack("<f", found.content)[0])
            case 13, 1:
                return float(struct.unpack("<d", found.content)[0])
            case 14, 0:
                return found.number != 0
            case 15, 2:
                return _utf8(found.content)
    return None


def _signed(number: int, datatype: DataType | None) -> int:
    if datatype is DataType.INT32:
        number &= _U32
        return number - 2**32 if number >= 2**31 else number
    if datatype is DataType.INT64:
        return number - 2**64 if number >= 2**63 else number
    return number


def _read_properties(raw: bytes) -> dict[str, str]:
    keys, values = [], []
    for found in _fields(raw):
        if found.at == 1 and found.kind == _LENGTH:
            keys.append(_utf8(found.content))
        elif found.at == 2 and found.kind == _LENGTH:
            values.append(_read_value(_fields(found.content), None, _PROPERTY_SHIFT))
    if len(keys) != len(values):
        raise PayloadError(f"a property set has {len(keys)} keys for {len(values)} values")
    return {key: str(value) for key, value in zip(keys, values, strict=True)}


def _read_number(found: _Field | None) -> int | None:
    return found.number if found is not None and found.kind == _VARINT else None


def _read_text(found: _Field | None) -> str | None:
    return _utf8(found.content) if found is not None and found.kind == _LENGTH else None


def _utf8(content: bytes) -> str:
    try:
        return content.decode()
    except UnicodeDecodeError:
        raise PayloadError(f"text in a payload is not UTF-8: {content[:20]!r}") from None


def _fields(raw: bytes) -> Iterator[_Field]:
    at = 0
    while at < len(raw):
        key, at = _read_varint(raw, at)
        number, content = 0, b""
        kind = key & 7
        if kind == _VARINT:
            number, at = _read_varint(raw, at)
        elif kind in {_FIXED64, _FIXED32, _LENGTH}:
            length, at = _read_varint(raw, at) if kind == _LENGTH else (8 if kind == _FIXED64 else 4, at)
            content = raw[at : at + length]
            if len(content) < length:
                raise PayloadError(f"a field of {length} bytes ends after {len(content)}: the payload is cut")
            at += length
        else:
            raise PayloadError(f"byte {at}: {kind} is no wire type that is read here")
        yield _Field(key >> 3, kind, number, content)


def _read_varint(raw: bytes, at: int) -> tuple[int, int]:
    number = shift = 0
    while at < len(raw):
        byte = raw[at]
        number |= (byte & 0x7F) << shift
        at += 1
        if byte < 0x80:
            return number & _U64, at
        shift += 7
        if shift >= 70:
            raise PayloadError(f"byte {at}: a number of more than 64 bits")
    raise PayloadError("a number is cut: the payload ends in the middle of it")
