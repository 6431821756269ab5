"""The four ways to get samples out of a device on a polled bus, over TCP."""

from __future__ import annotations

import asyncio
import contextlib
import re

import numpy as np
import pytest
from support.clocks import LoopClock
from support.modbus_layouts import (
    count_at,
    fifo_layout,
    in_sample,
    page_at,
    register,
    registers_layout,
    ring_layout,
    trigger_at,
    waveform_layout,
)
from support.modbus_lines import Rig, options_of, ramp, responding, simulate, until

from daqsvc.acquisition.samples import Quality
from daqsvc.notice import NOTICE
from drivers.modbus.registers import RegisterRecord, RegisterRun
from sim_hw.nodes.modbus_node import ModbusTcpServer, PlannedReply
from sim_hw.nodes.modbus_unit import ModbusUnit, encode, store_for

pytestmark = pytest.mark.integration
SAMPLE = (in_sample("x", 0, "int16"), in_sample("y", 1, "int16"))
RECORD = RegisterRecord(SAMPLE, (RegisterRun(0, 2),))


COUNT_REGISTERS = b"\0\2"


class Faults:
    """A plan of faults that a test fills; the next replies get them, the later ones none."""

    def __init__(self):
        self.coming = []
        self.asked = []
        self.meanwhile = None
        self.refuse = lambda _pdu: False

    def __call__(self, unit, pdu):
        self.asked.append((unit, pdu))
        if self.meanwhile is not None and self.meanwhile(pdu) is None:
            self.meanwhile = None
        if self.refuse(pdu):
            return PlannedReply("exception")
        return self.coming.pop(0) if self.coming else PlannedReply()


@contextlib.asynccontextmanager
async def serving(layout, rate_hz, **options):
    unit, faults = ModbusUnit(), Faults()
    server = ModbusTcpServer({1: unit}, faults)
    await server.start()
    given = {"transport": "tcp", "host": "127.0.0.1", "tcp_port": server.port, "timeout_ms": 200.0}
    rig = Rig(given | options, {"s": (layout, rate_hz)})
    store = store_for(unit, layout)
    try:
        yield rig, faults, lambda first, n: store.put(first, encode(layout, ramp(n, first=first)))
    finally:
        server.stop()


async def test_a_trend_is_polled_on_schedule_and_a_failed_poll_is_a_lost_sample():
    channels = [register("x", 10, "int16"), register("y", 40, "int16")]
    async with serving(registers_layout(1, "input", channels), 50.0) as (rig, faults, put):
        put(7, 1)
        async with rig.running():
            await until(lambda: rig.counters("s").samples_received >= 5)
            faults.coming = [PlannedReply(), PlannedReply("exception")]
            await until(lambda: not faults.coming)
            seen = rig.counters("s").samples_received
            await until(lambda: rig.counters("s").samples_received >= seen + 5)
    rig.check_books("s")
    assert rig.counters("s").samples_lost >= 1
    assert rig.driver.counters.exceptions == {"server device failure": 1}
    assert (rig.samples("s") == ramp(1, first=7)).all()
    assert {pdu for _, pdu in faults.asked} == {b"\x04\x00\x0a\x00\x01", b"\x04\x00\x28\x00\x01"}


@pytest.mark.parametrize("bits", [16, 32])
@pytest.mark.parametrize("acknowledge", [None, 700])
async def test_a_fifo_is_emptied_without_loss_or_repeat(bits, acknowledge):
    layout = fifo_layout(
        1, 33, count_at(0, bits, low_word_first=True), SAMPLE, acknowledge, poll_ns=1_000_000
    )
    writes = [] if acknowledge is None else [{"unit": 1, "address": 700, "count": 2}]
    first = 65_500  # the count of 16 bits wraps on the way
    async with serving(layout, 1000.0, writes=writes) as (rig, _faults, put), rig.running():
        for k in range(0, 100, 10):
            put(first + k, 10)
            await until(lambda k=k: rig.counters("s").samples_received >= k + 10 - 1)
            await asyncio.sleep(0.01)
    rig.check_books("s")
    assert rig.counters("s").samples_lost == 0
    np.testing.assert_array_equal(rig.samples("s"), ramp(100, first=first))


async def test_a_lost_fifo_reply_costs_what_was_in_it_unless_the_device_waits_to_be_told():
    lost = {}
    for acknowledge in (None, 700):
        layout = fifo_layout(1, 33, count_at(0, 32), SAMPLE, acknowledge, poll_ns=1_000_000)
        writes = [{"unit": 1, "address": 700, "count": 2}]
        async with serving(layout, 1000.0, writes=writes) as (rig, faults, put), rig.running():
            put(0, 10)
            await until(lambda: rig.counters("s").samples_received == 10)
            faults.coming = [PlannedReply("wrong transaction")]
            put(10, 10)
            await until(lambda: not faults.coming)
            await until(lambda: rig.driver.counters.timeouts == 1)
            read = rig.counters("s").frames_received
            put(20, 10)
            await until(lambda read=read: rig.counters("s").frames_received >= read + 10)
            put(30, 10)  # what follows a gap is believed when more goes on from it
            await until(lambda: rig.counters("s").samples_received + rig.counters("s").samples_lost == 40)
        rig.check_books("s")
        lost[acknowledge] = rig.counters("s").samples_lost
    # The reply may have been one of an empty queue: then nothing was lost with it.
    assert lost[700] == 0
    assert lost[None] in (0, 10)


async def test_samples_whose_acknowledgement_failed_are_not_delivered_twice():
    layout = fifo_layout(1, 33, count_at(0, 32), SAMPLE, 700, poll_ns=1_000_000)
    writes = [{"unit": 1, "address": 700, "count": 2}]
    async with serving(layout, 1000.0, writes=writes) as (rig, faults, put), rig.running():
        await until(lambda: rig.driver.link.state == "up")
        failing = [True]
        # The write itself gets lost: the device is told nothing, and hands the samples out again.
        faults.refuse = lambda pdu: pdu[0] == 16 and bool(failing) and failing.pop()
        put(0, 10)
        await until(lambda: not failing)
        put(10, 3)
        await until(lambda: rig.counters("s").samples_received == 13)
    rig.check_books("s")
    np.testing.assert_array_equal(rig.samples("s"), ramp(13))
    assert rig.counters("s").frames_duplicate == 10
    assert rig.counters("s").samples_lost == 0


async def test_a_fifo_reply_that_ends_within_a_sample_is_counted_and_left_out():
    layout = fifo_layout(1, 33, count_at(0, 16), SAMPLE, poll_ns=1_000_000)
    unit = ModbusUnit()
    replies = [b"\0\5" + b"\0\1\0\2\0\3"]
    unit.add_queue(33, lambda: replies.pop() if replies else b"")
    server = ModbusTcpServer({1: unit})
    await server.start()
    rig = Rig({"transport": "tcp", "host": "127.0.0.1", "tcp_port": server.port}, {"s": (layout, 1000.0)})
    async with rig.running():
        await until(lambda: rig.counters("s").frames_wrong_length == 1)
    server.stop()
    assert rig.counters("s").samples_received == 0


@pytest.mark.parametrize("table", ["holding", "input"])
async def test_a_ring_is_followed_without_loss_or_repeat_through_failed_requests(table):
    layout = ring_layout(1, table, count_at(0, 16), 100, 512, SAMPLE, poll_ns=1_000_000)
    rng = np.random.default_rng(3)
    first = 65_000
    async with serving(layout, 2000.0, timeout_ms=50.0) as (rig, faults, put), rig.running():
        sent = first
        put(sent, 1)
        await until(lambda: rig.counters("s").frames_received)
        base = rig.counters("s").frames_received
        for _ in range(30):
            n = int(rng.integers(1, 200))
            faults.coming = [PlannedReply("exception")] * int(rng.integers(0, 3))
            put(sent + 1, n)
            sent += n
            await until(lambda sent=sent, base=base: rig.counters("s").frames_received - base == sent - first)
    rig.check_books("s")
    assert rig.counters("s").samples_lost == 0
    assert rig.driver.counters.ring_overruns == 0
    # What was in the ring before the driver came is zeros but for the first sample put.
    np.testing.assert_array_equal(rig.samples("s")[-(sent - first) :], ramp(sent - first, first=first + 1))


async def test_what_is_overwritten_while_it_is_read_is_lost_and_not_mixed_up():
    layout = ring_layout(1, "holding", count_at(0, 32), 100, 64, SAMPLE, poll_ns=1_000_000)
    async with serving(layout, 10_000.0) as (rig, faults, put), rig.running():
        put(0, 10)
        await until(lambda: rig.counters("s").samples_received == 10)
        # 40 samples are there; while they are read, the device writes 50 more, over some of them.
        faults.meanwhile = lambda pdu: pdu[3:5] != COUNT_REGISTERS and put(50, 50)
        put(10, 40)
        await until(lambda: rig.counters("s").samples_received + rig.counters("s").samples_lost >= 100)
    rig.check_books("s")
    assert rig.driver.counters.ring_overruns >= 1
    indices = rig.indices("s")
    np.testing.assert_array_equal(rig.samples("s"), ramp(100)[indices - indices[0]])


@pytest.mark.parametrize("page", [None, page_at(90, 200)])
async def test_waveform_blocks_are_read_whole_and_missed_ones_are_counted(page):
    layout = waveform_layout(1, "holding", 0, 100, 600, SAMPLE, page, poll_ns=1_000_000)
    writes = [] if page is None else [{"unit": 1, "address": 90}]
    async with serving(layout, 20_000.0, writes=writes) as (rig, _faults, put), rig.running():
        put(0, 600)
        await until(lambda: rig.counters("s").samples_received == 600)
        put(600, 1800)  # three blocks at once: only the last can still be read
        await until(lambda: rig.counters("s").samples_received == 1200)
    first, second = rig.blocks["s"]
    np.testing.assert_array_equal(first.samples, ramp(600))
    np.testing.assert_array_equal(second.samples, ramp(600, first=1800))
    assert rig.counters("s").samples_lost == 1200
    assert rig.driver.counters.blocks_missed == 2
    assert second.first_index == first.end_index + second.gap
    assert (first.pause_before, second.lost_before) == (0, 1200)
    assert second.quality & Quality.LOSS_ESTIMATED


async def test_a_block_that_is_replaced_while_it_is_read_is_dropped_and_counted():
    layout = waveform_layout(1, "holding", 0, 100, 600, SAMPLE, poll_ns=1_000_000)
    async with serving(layout, 20_000.0) as (rig, faults, put), rig.running():
        await until(lambda: rig.driver.link.state == "up")
        faults.meanwhile = lambda pdu: pdu[1:3] == b"\0\0" or put(600, 600)  # at the first page
        put(0, 600)
        await until(lambda: rig.counters("s").samples_received == 600)
    (block,) = rig.blocks["s"]
    np.testing.assert_array_equal(block.samples, ramp(600, first=600))
    assert rig.driver.counters.blocks_torn == 1
    assert rig.counters("s").samples_lost == 600


@pytest.mark.parametrize("unheard", [False, True], ids=["sound", "replies get lost"])
def test_a_block_is_triggered_as_often_as_is_asked_for_and_no_more(unheard):
    every_s, taking_s = 10.0, 0.3
    layout = waveform_layout(1, "holding", 0, 100, 300, SAMPLE, None, trigger_at(95, 1, every_s))
    rig = Rig(
        options_of(serial=False, writes=[{"unit": 1, "address": 95}]),
        {"s": (layout, 1000.0)},
        clock=LoopClock(),
    )
    written_s, units = [], {1: ModbusUnit()}
    store = store_for(units[1], layout)

    def plan(_unit, pdu):
        if pdu[0] != 16:
            return PlannedReply()
        written_s.append(asyncio.get_running_loop().time())
        # A reply that is cut off: the device has heard the request.
        return PlannedReply("truncated" if unheard and len(written_s) % 3 == 2 else "none")

    async def main():
        async with responding(units, plan, serial=False), rig.running():
            taken = 0
            for _ in range(1000):  # 100 s
                await asyncio.sleep(0.1)
                if len(written_s) > taken and asyncio.get_running_loop().time() - written_s[-1] >= taking_s:
                    store.put(300 * taken, RECORD.encode(ramp(300, first=300 * taken)))
                    taken += 1

    simulate(main)
    assert 8 <= len(written_s) <= 11
    assert np.diff(written_s).min() >= every_s - 1e-6
    blocks = rig.blocks["s"]
    assert len(blocks) >= 8
    np.testing.assert_array_equal(rig.samples("s"), ramp(300 * len(blocks)))
    assert rig.counters("s").samples_lost == 0
    rig.check_books("s")
    # Between them nothing is missing: each is a snapshot, as far from the one before as the clock says.
    assert all(not block.quality & Quality.AFTER_LOSS and block.lost_before == 0 for block in blocks)
    apart_s = np.array([block.pause_before for block in blocks[1:]]) / 1000.0
    assert apart_s == pytest.approx(every_s - taking_s, abs=0.3)


@pytest.mark.gives("B47")
def test_a_waveform_that_is_never_read_whole_is_stated_once_with_what_to_do(caplog):
    """Blocks of 4 s on a unit that takes 120 ms to answer: 33 requests each. Later it is faster."""
    x = (in_sample("x", 0, "int16"),)
    layout = waveform_layout(1, "holding", 0, 100, 4096, x)
    trend = registers_layout(1, "holding", [register("v", 20, "int16")])
    rig = Rig(
        options_of(serial=False, timeout_ms=500.0),
        {"wave": (layout, 4096.0), "v": (trend, 1.0)},
        clock=LoopClock(),
    )
    units, slow, fault = {1: ModbusUnit()}, [True], {}
    store = store_for(units[1], layout)
    units[1].put("holding", 20, b"\0\1")

    async def main():
        plan = lambda *_: PlannedReply(delay_ns=120_000_000 if slow[0] else 1_000_000)  # noqa: E731
        async with responding(units, plan, serial=False), rig.running() as driver:
            for k in range(60):
                store.put(4096 * k, encode(layout, ramp(4096, channels=1, first=4096 * k)))
                await asyncio.sleep(4.0)
                slow[0] = k < 40
                if k == 10:
                    assert not rig.blocks["wave"]
                fault[k] = driver.link.why_silent("wave")

    with caplog.at_level(NOTICE):
        simulate(main)
    said = [record.getMessage() for record in caplog.records if "read whole" in record.getMessage()]
    stated, again = said
    assert stated.startswith("stream 'wave': no block is read whole: reading one takes ")
    took_s, stands_s = (float(one) for one in re.findall(r"([\d.]+) s", stated)[:2])
    assert took_s == pytest.approx(34 * 0.12, abs=1.0)
    assert stands_s == pytest.approx(4.0, abs=0.6)
    assert "; have the device take blocks less often, or have fewer samples in a block" in stated
    assert again == "stream 'wave': a block was read whole again"
    assert fault[20].startswith("no block is read whole: ")
    assert fault[59] == ""
    assert len(rig.blocks["wave"]) > 10
    assert rig.counters("v").samples_lost == 0
    rig.check_books("wave")
