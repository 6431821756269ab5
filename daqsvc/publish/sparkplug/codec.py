"""The Sparkplug B payload: values with datatypes, to bytes and back.

protobuf writes and reads the messages of ``sparkplug_b.proto``; what is added here is that a value fits its
datatype. Source: Sparkplug 3.0, section 6.4.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, TypeAlias

from google.protobuf.message import DecodeError

from daqsvc.publish.sparkplug import sparkplug_b_pb2 as messages

if TYPE_CHECKING:
    from collections.abc import Mapping

Value: TypeAlias = "bool | int | float | str | None"

MOST_BYTES = 1_000_000
"""No command is as long; a longer payload is not read."""

_U32, _U64 = 2**32 - 1, 2**64 - 1
_LARGEST_FLOAT = (2 - 2**-23) * 2.0**127


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
    DataType.INT32: "int_value",
    DataType.UINT32: "int_value",
    DataType.INT64: "long_value",
    DataType.UINT64: "long_value",
    DataType.DATETIME: "long_value",
    DataType.FLOAT: "float_value",
    DataType.DOUBLE: "double_value",
    DataType.BOOLEAN: "boolean_value",
    DataType.STRING: "string_value",
}
_LIMITS = {
    DataType.INT32: (-(2**31), 2**31 - 1),
    DataType.UINT32: (0, _U32),
    DataType.INT64: (-(2**63), 2**63 - 1),
    DataType.UINT64: (0, _U64),
    DataType.DATETIME: (0, _U64),
    DataType.FLOAT: (-_LARGEST_FLOAT, _LARGEST_FLOAT),
    DataType.DOUBLE: (-sys.float_info.max, sys.float_info.max),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Metric:
    """One value.

    Attributes:
        name: its name; None where the alias represents it.
        alias: number that represents the name after a birth; None for none.
        timestamp_ms: when the value was taken, UTC, ms since 1970.
        datatype: how the value is written; after reading, None where the sender left it out.
        value: None states that there is none now. Read without a datatype, an integer is unsigned.
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
        PayloadError: a value does not fit its datatype, or a number its field.
    """
    try:
        metrics = [_message(metric, datatypes=datatypes) for metric in payload.metrics]
        message = messages.Payload(timestamp=payload.timestamp_ms, metrics=metrics, seq=payload.seq)
    except PayloadError:
        raise
    except ValueError as error:
        raise PayloadError(f"this cannot be written as a Sparkplug payload: {error}") from error
    return message.SerializeToString()


def _message(metric: Metric, *, datatypes: bool) -> messages.Metric:
    datatype, value = metric.datatype, metric.value
    if datatype is None:
        raise PayloadError(f"metric {metric.name!r} has no datatype; state how its value is written")
    message = messages.Metric(
        name=metric.name,
        alias=metric.alias,
        timestamp=metric.timestamp_ms,
        datatype=datatype if datatypes else None,
        is_historical=metric.historical or None,
        is_null=value is None or None,
        properties=_property_set(metric.properties) if metric.properties else None,
    )
    if value is not None:
        if not _fits(datatype, value=value):
            raise PayloadError(
                f"{value!r} of metric {metric.name!r} is no {datatype.name}; correct the metric's datatype"
            )
        if isinstance(value, int) and value < 0 and datatype in {DataType.INT32, DataType.INT64}:
            # In two's complement, as the reference implementation sends them.
            value &= _U32 if datatype is DataType.INT32 else _U64
        setattr(message, _FIELD[datatype], value)
    return message


def _property_set(properties: Mapping[str, str]) -> messages.PropertySet:
    values = [messages.PropertyValue(type=DataType.STRING, string_value=text) for text in properties.values()]
    return messages.PropertySet(keys=properties, values=values)


def _fits(datatype: DataType, *, value: bool | float | str) -> bool:
    if isinstance(value, str) or datatype is DataType.STRING:
        return isinstance(value, str) and datatype is DataType.STRING
    if isinstance(value, bool) or datatype is DataType.BOOLEAN:
        return isinstance(value, bool) and datatype is DataType.BOOLEAN
    takes_floats = datatype in {DataType.FLOAT, DataType.DOUBLE}
    if isinstance(value, float) and not (takes_floats and math.isfinite(value)):
        return takes_floats
    low, high = _LIMITS[datatype]
    return low <= value <= high


def decode(raw: bytes) -> Payload:
    """Read a payload.

    Raises:
        PayloadError: the bytes are none, or too many.
    """
    if len(raw) > MOST_BYTES:
        raise PayloadError(f"payload of {len(raw)} bytes; the longest that is read has {MOST_BYTES}")
    try:
        message = messages.Payload.FromString(raw)
    except DecodeError as error:
        raise PayloadError(f"{len(raw)} bytes that are no Sparkplug B payload: {error}") from error
    return Payload(
        message.timestamp if message.HasField("timestamp") else None,
        message.seq if message.HasField("seq") else None,
        tuple(map(_metric, message.metrics)),
    )


def _metric(message: messages.Metric) -> Metric:
    datatype = _datatype(message.datatype) if message.HasField("datatype") else None
    return Metric(
        name=message.name if message.HasField("name") else None,
        alias=message.alias if message.HasField("alias") else None,
        timestamp_ms=message.timestamp if message.HasField("timestamp") else None,
        datatype=datatype,
        value=None if message.is_null else _signed(_value(message), datatype),
        historical=message.is_historical,
        properties=_properties(message.properties),
    )


def _datatype(number: int) -> DataType:
    try:
        return DataType(number)
    except ValueError:
        known = ", ".join(f"{one.value} ({one.name})" for one in DataType)
        raise PayloadError(f"datatype {number} is not known here; send one of {known}") from None


def _value(message: messages.Metric | messages.PropertyValue) -> Value:
    name = message.WhichOneof("value")
    value: Value = None if name is None else getattr(message, name)
    return value


def _signed(value: Value, datatype: DataType | None) -> Value:
    """An integer with its sign: the fields are unsigned, the datatype may state otherwise."""
    if datatype is DataType.INT32 and isinstance(value, int):
        value &= _U32
        return value - 2**32 if value >= 2**31 else value
    if datatype is DataType.INT64 and isinstance(value, int):
        return value - 2**64 if value >= 2**63 else value
    return value


def _properties(message: messages.PropertySet) -> dict[str, str]:
    if len(message.keys) != len(message.values):
        raise PayloadError(f"a property set has {len(message.keys)} keys for {len(message.values)} values")
    return {key: str(_value(value)) for key, value in zip(message.keys, message.values, strict=True)}
