"""Registers whose float is no number: such values are missing, whichever way they are read."""

from __future__ import annotations

import asyncio
import itertools
import math
import struct

import numpy as np
import pytest
from support.clocks import LoopClock
from support.modbus_layouts import (
    count_at,
    fifo_layout,
    in_sample,
    register,
    registers_layout,
    ring_layout,
    waveform_layout,
)
from support.modbus_lines import Rig, options_of, responding, simulate

from daqsvc.notice import NOTICE
from sim_hw.nodes.modbus_node import PlannedReply
from sim_hw.nodes.modbus_unit import ModbusUnit, store_for

pytestmark = pytest.mark.integration
FIELDS = (register("x", 0, "float32"), register("y", 2, "float64"))
SAMPLE = (in_sample("x", 0, "float32"), in_sample("y", 2, "float64"))
SENT = [(1.5, -2.0), (math.inf, 1.0), (2.5, -math.inf), (math.nan, 3.0), (3.4e38, 1e39), (-1.5, 0.25)]
ABSENT = 4  # 1e39 is more than any float32
LAYOUTS = {
    "registers": registers_layout(1, "holding", FIELDS),
    "fifo": fifo_layout(1, 33, count_at(0, 32), SAMPLE, poll_ns=20_000_000),
    "ring": ring_layout(1, "holding", count_at(0, 32), 100, 64, SAMPLE, poll_ns=20_000_000),
    "waveform": waveform_layout(1, "holding", 0, 100, len(SENT), SAMPLE, poll_ns=20_000_000),
}


def test_a_mark_for_no_value_is_missing_and_counted(caplog):
    layout = registers_layout(1, "holding", (register("x", 0, "int16", scale=0.1, no_value=0x7FFF),))
    rig = Rig(options_of(serial=False), {"s": (layout, 10.0)}, clock=LoopClock())

    async def main():
        unit = ModbusUnit()
        unit.put("holding", 0, struct.pack(">H", 250))
        async with responding({1: unit}, lambda *_: PlannedReply(), serial=False), rig.running():
            await asyncio.sleep(1.0)
            unit.put("holding", 0, struct.pack(">H", 0x7FFF))
            await asyncio.sleep(1.0)

    with caplog.at_level(NOTICE):
        simulate(main)
    samples = rig.samples("s")[:, 0]
    absent = int(np.isnan(samples).sum())
    assert 5 <= absent < len(samples)
    assert np.unique(samples[~np.isnan(samples)]).tolist() == [25.0]
    assert rig.counters("s").values_absent == absent
    assert sum("are missing" in record.message for record in caplog.records) == 1


@pytest.mark.gives("B36")
@pytest.mark.parametrize("way", LAYOUTS)
def test_what_is_no_number_is_missing_and_counted(way, caplog):
    layout = LAYOUTS[way]
    rig = Rig(options_of(serial=False), {"s": (layout, 10.0)}, clock=LoopClock())
    rows = np.frombuffer(b"".join(struct.pack(">fd", *row) for row in SENT), np.uint8).reshape(len(SENT), 12)

    async def main():
        unit = ModbusUnit()
        store = store_for(unit, layout)
        if way == "registers":
            store.put(0, rows[:1])
        async with responding({1: unit}, lambda *_: PlannedReply(), serial=False), rig.running():
            if way == "waveform":
                await asyncio.sleep(0.1)
                store.put(0, rows)
            else:
                for k in range(len(SENT)):
                    store.put(k, rows[k : k + 1])
                    await asyncio.sleep(0.1)
            await asyncio.sleep(3.0)

    with caplog.at_level(NOTICE):
        simulate(main)
    with np.errstate(over="ignore"):
        told = np.array(SENT).astype(np.float32)
    told[~np.isfinite(told)] = np.nan
    samples = rig.samples("s")
    # What registers show is read again until it changes, and a ring begins with what has been in it before.
    changes = [row for row, _ in itertools.groupby(map(repr, samples.tolist()))]
    assert changes[-len(told) :] == list(map(repr, told.tolist()))
    assert rig.counters("s").values_absent == ABSENT
    assert rig.counters("s").samples_lost == 0
    (said,) = [record.message for record in caplog.records if "are missing" in record.message]
    assert said.startswith(
        "stream 's': no measurement in 1 of its values" if way != "waveform" else "stream 's'"
    )
