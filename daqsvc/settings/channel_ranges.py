"""What the channel of a sensor can carry, by the raw type, scale and offset of its layout."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from daqsvc.settings.buses import DbcLayout, PlainLayout
from daqsvc.settings.modbus import FifoLayout, RegistersLayout, RingLayout, WaveformLayout
from daqsvc.settings.serial import SerialLayout

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.settings.dbc import DbcMessage
    from daqsvc.settings.modbus import ModbusLayout
    from daqsvc.settings.models import MachineFile, Sensor


class WireRange(NamedTuple):
    """What a channel of whole numbers can carry, in volts or in the unit of its sensor.

    Attributes:
        low: least value.
        high: largest value.
        step: worth of one count; 0 if it is not known.
    """

    low: float
    high: float
    step: float


def wire_range(draft: MachineFile, sensor: Sensor, messages: Mapping[str, DbcMessage]) -> WireRange | None:
    """What the channel of a sensor can carry; None of a float or a text, and where it is not known.

    Args:
        draft: the machine file, or what is valid of it.
        sensor: one of its sensors.
        messages: by stream, the DBC messages that could be read.
    """
    stream = draft.streams.get(sensor.stream)
    layout = None if stream is None else stream.layout
    if isinstance(layout, DbcLayout):
        return _of_signals(layout, sensor.channel, messages.get(sensor.stream))
    if isinstance(layout, PlainLayout | SerialLayout):
        return _of_bytes(layout, sensor.channel)
    if isinstance(layout, RegistersLayout | FifoLayout | RingLayout | WaveformLayout):
        return _of_registers(layout, sensor.channel)
    return None


def _of_signals(layout: DbcLayout, channel: str, message: DbcMessage | None) -> WireRange | None:
    signals = next((item.signals for item in layout.channels if item.name == channel), ())
    known = [message.signal_ranges[s] for s in signals if message and s in message.signal_ranges]
    if not known or len(known) < len(signals):
        return None
    return WireRange(min(low for low, _ in known), max(high for _, high in known), 0.0)


def _of_bytes(layout: PlainLayout | SerialLayout, channel: str) -> WireRange | None:
    packed = next((item for item in layout.channels if item.name == channel), None)
    if packed is None or packed.type == "float32":
        return None
    return _scaled(packed.valid_raw or packed.raw_limits, packed.scale, packed.offset)


def _of_registers(layout: ModbusLayout, channel: str) -> WireRange | None:
    number = next((item for item in layout.channels if item.name == channel), None)
    if number is None or number.type.startswith("float"):
        return None
    bits = 16 * number.registers if number.bits is None else number.bits[1]
    half = 2.0 ** (bits - 1)
    raw = (0.0, 2 * half - 1) if number.type.startswith("u") else (-half, half - 1)
    return _scaled(raw, number.scale, number.offset)


def _scaled(raw: tuple[float, float], scale: float, offset: float) -> WireRange:
    ends = [end * scale + offset for end in raw]
    return WireRange(min(ends), max(ends), abs(scale))
