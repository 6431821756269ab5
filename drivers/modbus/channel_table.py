"""What ``daqsvc check`` shows of the channels of a Modbus stream, to be compared with the device's manual."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drivers.modbus.settings import FifoLayout, RegisterChannel, RegistersLayout, RingLayout, WaveformLayout

if TYPE_CHECKING:
    from drivers.modbus.settings import SampleChannel

_COLUMNS = ("name", "unit", "table", "address", "manual", "place", "type", "order", "scale", "offset")
_MOST_OF_FIVE = 9_998
"""Address of the last register that a manual names with five digits."""


def channel_table(
    layout: RegistersLayout | FifoLayout | RingLayout | WaveformLayout,
) -> tuple[tuple[str, ...], ...]:
    """Rows on its channels, below one that names the columns; see `StreamWords.channels`."""
    table = "fifo" if isinstance(layout, FifoLayout) else layout.table
    channels = tuple(_row(layout.unit, table, one) for one in layout.channels)
    return ((*_COLUMNS, "bits", "no_value"), *channels)


def _row(unit: int, table: str, one: RegisterChannel | SampleChannel) -> tuple[str, ...]:
    is_register = isinstance(one, RegisterChannel)
    swapped = one.order in {"BADC", "DCBA"}
    return (
        one.name,
        f"{unit}",
        table,
        f"{one.first}" if is_register else "",
        manual_number(table, one.first) if is_register else "",
        "" if is_register else f"{one.first}",
        one.type,
        one.order if one.registers > 1 or swapped else "",
        f"{one.scale:g}",
        f"{one.offset:g}" if one.offset else "",
        _bits(one.bits),
        ", ".join(_mark(one, value) for value in one.no_value),
    )


def manual_number(table: str, address: int) -> str:
    """What most manuals call a register: 40001 is holding register 0, and of many they need six digits."""
    digit = 3 if table == "input" else 4
    return f"{digit}{address + 1:0{4 if address <= _MOST_OF_FIVE else 5}d}"


def _bits(bits: tuple[int, int] | None) -> str:
    if bits is None:
        return ""
    first, count = bits
    return f"{first}" if count == 1 else f"{first}-{first + count - 1}"


def _mark(one: RegisterChannel | SampleChannel, value: float) -> str:
    """A raw value as its bits, which manuals mostly show so."""
    if one.type.startswith("float"):
        return f"{value:g}"
    return f"0x{int(value) % 2**one.width:0{-(-one.width // 4)}X}"
