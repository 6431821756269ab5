"""Counts of devices that restart, or lie: what was found wrong once, in simulated time."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest
from support.clocks import LoopClock
from support.modbus_layouts import count_at, fifo_layout, in_sample, page_at, ring_layout, waveform_layout
from support.modbus_lines import Rig, options_of, ramp, responding, simulate

from drivers.modbus.registers import RegisterRecord, RegisterRun
from sim_hw.nodes.modbus_node import PlannedReply
from sim_hw.nodes.modbus_unit import FifoStore, ModbusUnit, store_for

pytestmark = pytest.mark.integration
SAMPLE = (in_sample("x", 0, "int16"), in_sample("y", 1, "int16"))
RECORD = RegisterRecord(SAMPLE, (RegisterRun(0, 2),))
RATE_HZ = 200.0
SOUND = lambda *_: PlannedReply()  # noqa: E731


async def sample(store, numbers, first):
    """Let a device take samples, one by one, by the clock; they are told apart by their numbers."""
    for k, number in enumerate(numbers):
        store.put(first + k, RECORD.encode(ramp(1, first=number)))
        await asyncio.sleep(1 / RATE_HZ)


def numbers_of(rig, stream="s"):
    samples = rig.samples(stream).astype(int)
    return samples[:, 0] + 30_000 * (samples[:, 1] - 100)


@pytest.mark.parametrize("depth", [64, 2048, 16_384])
@pytest.mark.parametrize("bits", [16, 32])
def test_a_ring_whose_counter_goes_back_by_less_than_its_depth_is_not_read_where_nothing_was_written(
    depth, bits
):
    layout = ring_layout(1, "holding", count_at(0, bits), 100, depth, SAMPLE, poll_ns=10_000_000)
    rig = Rig(options_of(serial=False, timeout_ms=100.0), {"s": (layout, RATE_HZ)}, clock=LoopClock())
    units = {1: ModbusUnit()}
    alive = [True]

    async def main():
        plan = lambda *_: PlannedReply("none" if alive[0] else "silent")  # noqa: E731
        async with responding(units, plan, serial=False), rig.running():
            await sample(store_for(units[1], layout), range(1, 901), 0)
            alive[0] = False
            await asyncio.sleep(2.0)
            units[1] = ModbusUnit()
            alive[0] = True
            await sample(store_for(units[1], layout), range(2001, 2801), 0)

    simulate(main)
    rig.check_books("s")
    numbers = numbers_of(rig)
    assert (np.diff(numbers) > 0).all()
    assert numbers[0] == 1
    assert set(numbers) <= {*range(1, 901), *range(2001, 2801)}
    assert rig.driver.streams["s"][1].restarts == 1
    assert len(numbers) > 900 + 800 - max(800 - depth, 0) - 20


def test_a_damaged_write_counter_is_not_believed():
    layout = ring_layout(1, "input", count_at(0, 32), 16, 1024, SAMPLE, poll_ns=20_000_000)
    rig = Rig(options_of(serial=False, timeout_ms=100.0), {"s": (layout, RATE_HZ)}, clock=LoopClock())
    looks = [0]

    class Unit(ModbusUnit):
        def answer(self, pdu):
            reply = super().answer(pdu)
            if pdu[1:] != b"\0\0\0\2":
                return reply
            looks[0] += 1
            if looks[0] % 7:
                return reply
            told = int.from_bytes(reply[2:], "big") ^ 1 << (looks[0] // 7) % 32
            return reply[:2] + told.to_bytes(4, "big")

    async def main():
        unit = Unit()
        async with responding({1: unit}, SOUND, serial=False), rig.running():
            await sample(store_for(unit, layout), range(1, 2001), 0)
            await asyncio.sleep(0.5)

    simulate(main)
    rig.check_books("s")
    np.testing.assert_array_equal(numbers_of(rig), np.arange(1, 2001))
    assert rig.counters("s").samples_lost == 0
    assert rig.driver.counters.counts_doubted > 10


def test_a_queue_that_overflows_while_acknowledgements_are_lost_gives_each_sample_once():
    layout = fifo_layout(1, 40, count_at(0, 16), SAMPLE, 50, poll_ns=10_000_000)
    options = options_of(serial=False, timeout_ms=150.0, demotion_s=0.5) | {
        "writes": [{"unit": 1, "address": 50}]
    }
    rig = Rig(options, {"s": (layout, RATE_HZ)}, clock=LoopClock())

    def plan(_unit, pdu):
        lost = pdu[0] == 16 and asyncio.get_running_loop().time() % 2.0 < 0.5
        return PlannedReply("silent" if lost else "none")

    async def main():
        unit = ModbusUnit()
        async with responding({1: unit}, plan, serial=False), rig.running():
            await sample(FifoStore(unit, layout, depth=28), range(1, 2401), 0)
            await asyncio.sleep(0.5)

    simulate(main)
    rig.check_books("s")
    numbers = numbers_of(rig)
    assert (np.diff(numbers) > 0).all()
    assert len(numbers) + rig.counters("s").samples_lost == numbers[-1] - numbers[0] + 1
    assert rig.counters("s").frames_duplicate > 0
    assert rig.driver.streams["s"][1].restarts == 0


def test_streams_that_share_a_page_register_get_their_own_pages():
    page = page_at(90, 150)
    layouts = {
        "x": waveform_layout(1, "holding", 0, 200, 600, SAMPLE, page, poll_ns=10_000_000),
        "y": waveform_layout(1, "holding", 0, 400, 230, SAMPLE, page_at(90, 40), poll_ns=10_000_000),
    }
    options = options_of(serial=False) | {"writes": [{"unit": 1, "address": 90}]}
    rig = Rig(options, {name: (layout, 1000.0) for name, layout in layouts.items()}, clock=LoopClock())
    blocks = {"x": RECORD.encode(ramp(600)).tobytes(), "y": RECORD.encode(ramp(230, first=5000)).tobytes()}
    unit = ModbusUnit()

    def show(number):
        for name, layout in layouts.items():
            size = 2 * layout.page.registers
            unit.put("holding", layout.address, blocks[name][number * size : (number + 1) * size])

    async def main():
        unit.watch(90, show)
        plan = lambda *_: PlannedReply(delay_ns=1_000_000)  # noqa: E731
        async with responding({1: unit}, plan, serial=False), rig.running():
            for block_id in range(1, 6):
                unit.put("holding", 0, block_id.to_bytes(2, "big"))
                await asyncio.sleep(1.0)

    simulate(main)
    for name, first in (("x", 0), ("y", 5000)):
        assert len(rig.blocks[name]) == 5
        for block in rig.blocks[name]:
            np.testing.assert_array_equal(block.samples, ramp(len(block.samples), first=first))


@pytest.mark.parametrize("shows_none", [True, False])
def test_a_waveform_device_that_restarts_has_not_lost_all_the_ids_between(shows_none):
    layout = waveform_layout(1, "holding", 0, 100, 500, SAMPLE, poll_ns=100_000_000)
    rig = Rig(options_of(serial=False), {"s": (layout, 1000.0)}, clock=LoopClock())

    async def main():
        unit = ModbusUnit()
        unit.map("holding", 0, 4000)
        ids = [40_000, 40_001, *([0, 0] if shows_none else []), 1, 2, 5, 6]
        async with responding({1: unit}, SOUND, serial=False), rig.running():
            for block_id in ids:
                unit.put("holding", 0, block_id.to_bytes(2, "big"))
                await asyncio.sleep(2.0)

    simulate(main)
    assert len(rig.blocks["s"]) == 6
    assert rig.driver.streams["s"][1].restarts == 1
    assert rig.driver.counters.blocks_missed == 2
    assert rig.counters("s").samples_lost == 2 * 500


def test_a_device_that_stands_still_begins_a_new_time_base_and_gives_nothing_twice():
    layout = ring_layout(1, "holding", count_at(0, 32), 100, 256, SAMPLE, poll_ns=10_000_000)
    rig = Rig(options_of(serial=False, timeout_ms=100.0), {"s": (layout, RATE_HZ)}, clock=LoopClock())
    silent = [False]

    async def main():
        unit = ModbusUnit()
        store = store_for(unit, layout)
        plan = lambda *_: PlannedReply("silent" if silent[0] else "none")  # noqa: E731
        async with responding({1: unit}, plan, serial=False), rig.running():
            await sample(store, range(1, 1001), 0)
            silent[0] = True
            await asyncio.sleep(14.0)  # it is not asked meanwhile, and does not sample
            silent[0] = False
            await sample(store, range(1001, 3001), 1000)

    simulate(main)
    rig.check_books("s")
    assert (np.diff(numbers_of(rig)) > 0).all()
    blocks = rig.blocks["s"]
    taken_s = [b.t_first_ns / 1e9 - 1000 - 14 * (n > 1000) for b in blocks for n in [int(b.samples[0, 0])]]
    off_s = np.array(taken_s) - np.array([(int(b.samples[0, 0]) - 1) / RATE_HZ for b in blocks])
    assert np.abs(off_s).max() < 0.05
