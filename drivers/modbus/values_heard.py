"""What ``daqsvc new --listen`` read of the channels of a Modbus unit, so that a person can judge it."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

from drivers.questions import sensor_key

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from drivers.questions import Answers

SHOWN = 12
_CODES = {
    "uint16": ">H",
    "int16": ">h",
    "uint32": ">I",
    "int32": ">i",
    "float32": ">f",
    "uint64": ">Q",
    "int64": ">q",
    "float64": ">d",
}


def in_register(table: Mapping[str, Any], address: int, kind: str, order: str) -> str:
    """What was read at an address, and as what."""
    raw = _raw(table, address, kind, order)
    if not raw:
        return "was not read"
    return f"reads {raw[0]:.6g} as {kind}{f' {order}' if _wide(kind) else ''}"


def values_heard(table: Mapping[str, Any], answers: Answers) -> list[str]:
    """Sentences on what was read of the channels of the file, as it gives their values."""
    heard: list[str] = []
    silent: list[str] = []
    for channel in answers["channels"]:
        text = _heard(table, answers, channel)
        (heard if text else silent).append(text or channel)
    lines = [f"Heard: {'; '.join(_few(heard))}."] if heard else []
    return lines + ([f"No value was read of {', '.join(_few(silent))}."] if silent else [])


def _few(texts: Sequence[str]) -> list[str]:
    return [*texts[:SHOWN], *([f"and {len(texts) - SHOWN} more"] if len(texts) > SHOWN else [])]


def _heard(table: Mapping[str, Any], answers: Answers, channel: str) -> str:
    """What was read of a channel, in its unit; empty if nothing was."""
    address, kind, order, scale, bits, mark = (
        answers[sensor_key(channel, topic)]
        for topic in ("address", "register-type", "order", "scale", "bits", "no-value")
    )
    raw = _raw(table, address, kind, order)
    if not raw:
        return ""
    if bits is not None:
        raw = [int(value) >> bits[0] & (1 << bits[1]) - 1 for value in raw]
    unit = answers.get(sensor_key(channel, "unit"))
    behind = f" {unit}" if unit and unit != "1" else ""
    # The raw value that means none is compared as bits: of an int16, 0x8000 and -32768 are the same.
    width = bits[1] if bits is not None else int(kind[-2:])
    if mark is not None and not kind.startswith("float"):
        raw = [value for value in raw if (int(value) - mark) % 2**width]
    shown = "no value" if not raw else " to ".join(dict.fromkeys(f"{scale * one:.6g}" for one in sorted(raw)))
    return f"{channel} {shown}{behind if raw else ''} (register {address})"


def _wide(kind: str) -> bool:
    return not kind.endswith("16")


def _raw(table: Mapping[str, Any], address: int, kind: str, order: str) -> list[float]:
    """The number that registers hold, as it was read first and last; none if they were not read."""
    from drivers.modbus.readings import ORDERS, arranged  # noqa: PLC0415 - only for who listens

    by_address = {one["address"]: one for one in table["registers"]}
    places = range(address, address + int(kind[-2:]) // 16)
    if not all(place in by_address for place in places):
        return []
    known = next(one for one in ORDERS if one == order)
    rows = [[by_address[place][key] for place in places] for key in ("uint16", "later")]
    return [struct.unpack(_CODES[kind], arranged(row, known))[0] for row in rows if None not in row]
