"""Tables of buses and layouts as machine files have them, in few words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from drivers.can.settings import CanBus
from drivers.modbus.settings import ModbusRtuBus, ModbusTcpBus
from drivers.replay.settings import ReplayBus, TableLayout
from drivers.serial.settings import FRAMINGS, LineLayout, SerialBus

if TYPE_CHECKING:
    from collections.abc import Sequence


def can_bus(**options: Any) -> CanBus:
    """A CAN bus."""
    return CanBus.model_validate({"driver": "can", **options})


def modbus_bus(**options: Any) -> ModbusTcpBus | ModbusRtuBus:
    """A Modbus line; its host or port may be one that no machine file could name, such as a null modem."""
    if options["transport"] == "tcp":
        own = {key: value for key, value in options.items() if key != "quiet_ms"}  # of serial lines only
        tcp = ModbusTcpBus.model_validate({"driver": "modbus", **own, "host": "192.0.2.10"})
        return tcp.model_copy(update={"host": options["host"]})
    table = {"driver": "modbus", "baud": 19_200, **options, "serial_port": "/dev/ttyS0"}
    return ModbusRtuBus.model_validate(table).model_copy(update={"serial_port": options["serial_port"]})


def replay_bus(**options: Any) -> ReplayBus:
    """A replayed bus."""
    return ReplayBus.model_validate({"driver": "replay", **options})


def serial_bus(**options: Any) -> SerialBus:
    """A serial port."""
    return FRAMINGS[options["framing"]].model_validate({"driver": "serial", "baud": 115_200, **options})


def line_layout(
    columns: Sequence[str],
    channels: Sequence[str | dict[str, Any]],
    *,
    counter: str | None = None,
    bits: int = 32,
    time: str | None = None,
    unit: str = "ms",
    **more: Any,
) -> LineLayout:
    """A line of text; each channel is a column."""
    given: dict[str, Any] = {"line": columns, **more}
    given["channels"] = [{"name": item} if isinstance(item, str) else item for item in channels]
    if counter is not None:
        given["counter"] = {"column": counter, "bits": bits}
    if time is not None:
        given["time"] = {"column": time, "unit": unit}
    return LineLayout.model_validate(given)


def table_layout(*columns: tuple[str, str, float, float]) -> TableLayout:
    """Columns of a table: name of the channel, name of the column, scale and offset."""
    keys = ("name", "column", "scale", "offset")
    return TableLayout.model_validate(
        {"columns": [dict(zip(keys, column, strict=True)) for column in columns]}
    )
