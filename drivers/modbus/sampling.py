"""Who reads what on a Modbus line."""

from __future__ import annotations

import asyncio
from collections import defaultdict
from typing import TYPE_CHECKING, Any

from drivers.modbus.fifo import FifoReader
from drivers.modbus.layouts import Fifo, Ring, TrendLayout, shared_runs
from drivers.modbus.ring import DeviceRingReader
from drivers.modbus.trend import TrendReader
from drivers.modbus.waveform import WaveformReader

if TYPE_CHECKING:
    from drivers.base import BusPort, StreamSpec
    from drivers.modbus.outcomes import ModbusCounters
    from drivers.modbus.reading import Reader


def readers_for(port: BusPort, counters: ModbusCounters) -> list[Reader]:
    """A reader for each stream, by the way its device hands out samples; one for all that share requests."""
    readers: list[Reader] = []
    polled: dict[tuple[int, str, float], list[StreamSpec[Any]]] = {}
    windows: dict[int, asyncio.Lock] = defaultdict(asyncio.Lock)
    checked = port.options.get("transport") == "rtu"  # each frame with its CRC
    for spec in port.streams:
        layout = spec.layout
        if isinstance(layout, TrendLayout):
            polled.setdefault((layout.unit, layout.table, spec.rate_hz), []).append(spec)
        elif isinstance(layout, Fifo):
            readers.append(FifoReader(spec, port, checked=checked))
        elif isinstance(layout, Ring):
            readers.append(DeviceRingReader(spec, port, counters, checked=checked))
        else:
            readers.append(WaveformReader(spec, port, counters, windows[layout.unit]))
    for specs in polled.values():
        if (runs := shared_runs([spec.layout for spec in specs])) is not None:
            readers.append(TrendReader(specs, port, runs))
        else:
            readers += [TrendReader([spec], port) for spec in specs]
    return readers
