"""When polled samples were taken: what a block says, against what the device knows, in simulated time."""

from __future__ import annotations

import asyncio
import itertools
import random

import numpy as np
import pytest
from support.clocks import LoopClock
from support.examples import first_of
from support.modbus_layouts import (
    count_at,
    fifo_layout,
    in_sample,
    register,
    registers_layout,
    ring_layout,
    waveform_layout,
)
from support.modbus_lines import Rig, options_of, ramp, responding, simulate

from daqsvc.acquisition.alignment import AlignedSource, Aligner
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.samples import Quality, SampleBlock
from drivers.modbus.registers import RegisterRecord, RegisterRun
from sim_hw.nodes.modbus_node import PlannedReply
from sim_hw.nodes.modbus_unit import ModbusUnit, store_for

pytestmark = pytest.mark.integration
SAMPLE = (in_sample("x", 0, "int16"), in_sample("y", 1, "int16"))
RECORD = RegisterRecord(SAMPLE, (RegisterRun(0, 2),))
LEAST_NS, MOST_NS = 1_000_000, 15_000_000
"""Between which a reply takes its time."""


def now_ns():
    return LoopClock().monotonic_ns()


def stated_ns(block):
    return block.t_first_ns + block.period_ns * np.arange(len(block.samples))


def told_truly(off_ns, told_ns):
    """How often what is told of an error is true."""
    return np.mean(np.abs(off_ns) <= told_ns)


def waveforms(poll_ns, most_late_ns, seed, every_s, samples=200, rate_hz=2000.0, seconds=40.0):
    """Blocks that a driver has fetched, and when the device had finished each, by number."""
    rng = random.Random(seed)
    layout = waveform_layout(1, "holding", 0, 100, samples, SAMPLE, poll_ns=poll_ns)
    rig = Rig(
        options_of(serial=False, timeout_ms=100.0, demote_after=30),
        {"s": (layout, rate_hz)},
        clock=LoopClock(),
    )
    ended_ns = []
    faults = ["none"] * 30 + ["silent", "exception"]

    async def main():
        units = {1: ModbusUnit()}
        store = store_for(units[1], layout)

        def plan(*_):
            return PlannedReply(
                rng.choice(faults) if most_late_ns else "none", rng.randrange(most_late_ns + 1)
            )

        async with responding(units, plan, serial=False), rig.running():
            while now_ns() < (1000 + seconds) * NS_PER_S:
                await asyncio.sleep(every_s(rng))
                number = len(ended_ns)
                store.put(number * samples, RECORD.encode(ramp(samples, first=number * samples)))
                ended_ns.append(now_ns())
            await asyncio.sleep(1.0)

    simulate(main)
    for before, block in itertools.pairwise(rig.blocks["s"]):
        assert block.first_index == before.end_index + block.gap
    numbers = [int(b.samples[0, 0] + 30_000 * (b.samples[0, 1] - 100)) // samples for b in rig.blocks["s"]]
    return rig, numbers, ended_ns


@pytest.mark.parametrize("seed", range(5))
def test_a_waveform_says_when_it_was_taken_and_how_sure_that_is(seed):
    poll_ns, most_late_ns = 50_000_000, 20_000_000
    rig, numbers, ended_ns = waveforms(poll_ns, most_late_ns, seed, lambda rng: rng.uniform(0.05, 1.5))
    blocks = rig.blocks["s"]
    assert len(blocks) > 20
    span_ns = 200 * NS_PER_S / 2000.0
    off_ns = np.array(
        [b.t_first_ns + span_ns - ended_ns[number] for b, number in zip(blocks, numbers, strict=True)]
    )
    told_ns = np.array([b.t_error_ns for b in blocks])
    assert (np.abs(off_ns) <= told_ns + 1).all()
    # Half the time from one look to the next, a request's there and back included: not said to be more.
    assert np.median(told_ns) <= (poll_ns + 2 * most_late_ns) / 2
    assert (np.isfinite(told_ns) == [not b.quality & Quality.TIME_UNSETTLED for b in blocks]).all()
    assert np.isfinite(told_ns).sum() >= len(blocks) - 1
    time_base = rig.driver.streams["s"][1]
    assert (time_base.settled, time_base.error_ns) == (True, told_ns[-1])


def test_of_a_block_that_was_there_before_anybody_looked_nothing_is_known():
    layout = waveform_layout(1, "holding", 0, 100, 200, SAMPLE, poll_ns=10_000_000)
    rig = Rig(options_of(serial=False), {"s": (layout, 2000.0)}, clock=LoopClock())

    async def main():
        units = {1: ModbusUnit()}
        store_for(units[1], layout).put(0, RECORD.encode(ramp(200)))
        async with responding(units, lambda *_: PlannedReply(), serial=False), rig.running():
            await asyncio.sleep(1.0)

    simulate(main)
    (block,) = rig.blocks["s"]
    assert block.t_error_ns == np.inf
    assert block.quality & Quality.TIME_UNSETTLED
    assert not rig.driver.streams["s"][1].settled


def test_waveforms_are_put_on_the_grid_of_another_bus():
    rate_hz = 1000.0
    rig, _, _ = waveforms(2_000_000, 0, 1, lambda _: 2.0, samples=1000, rate_hz=rate_hz)
    rows = []
    sources = [AlignedSource("probes", ("x",), rate_hz), AlignedSource("s", ("x", "y"), rate_hz)]
    aligner = Aligner("probes+s", sources, rows.append, max_error_ns=2_000_000)
    period_ns = round(NS_PER_S / rate_hz)
    still = np.zeros((100, 1), np.float32)
    probes = [
        SampleBlock(
            "probes", 100 * k, still, 1000 * NS_PER_S + 100 * k * period_ns, period_ns, t_error_ns=1e3
        )
        for k in range(400)
    ]
    blocks = sorted(
        [*probes, *rig.blocks["s"]], key=lambda block: block.t_first_ns + block.period_ns * len(block.samples)
    )
    for block in blocks:
        aligner.accept(block)
    there = np.concatenate([np.isfinite(row.samples).all(axis=1) for row in rows])
    # A block a second long every two seconds, less what the filter cannot reach at its ends.
    assert 0.4 < there.mean() < 0.5
    assert aligner.counters["s"].rows_withheld == 0
    assert max(row.error_ns[1] for row in rows[5:]) < 2.0 * 2_000_000


def trend_beside(rate_hz, neighbour_hz, neighbour_ns, *, serial, seconds=60.0):
    """A trend whose neighbour on the line takes so long to answer, and when each of its samples was taken."""
    rng = random.Random(4)
    layouts = {
        name: registers_layout(unit, "holding", [register("n", 0, "uint16")])
        for name, unit in (("trend", 1), ("neighbour", 2))
    }
    streams = {"trend": (layouts["trend"], rate_hz), "neighbour": (layouts["neighbour"], neighbour_hz)}
    rig = Rig(options_of(serial=serial, timeout_ms=500.0), streams, clock=LoopClock())
    units = {1: ModbusUnit(), 2: ModbusUnit()}
    taken_ns = []

    def plan(unit, _pdu):
        if unit == 2:
            return PlannedReply(delay_ns=rng.randrange(*neighbour_ns))
        units[1].put("holding", 0, len(taken_ns).to_bytes(2, "big"))
        taken_ns.append(now_ns())
        return PlannedReply(delay_ns=rng.randrange(LEAST_NS, MOST_NS))

    async def main():
        async with responding(units, plan, serial=serial), rig.running():
            await asyncio.sleep(seconds)

    simulate(main)
    rig.check_books("trend")
    return rig, np.array(taken_ns)


@pytest.mark.parametrize("serial", [True, False])
@pytest.mark.parametrize(
    ("rate_hz", "neighbour_hz", "neighbour_ns"),
    first_of(
        (20.0, 31.0, (LEAST_NS, MOST_NS)), (10.0, 1.0, (299_000_000, 301_000_000)), (400.0, 31.0, (1, 2))
    ),
)
def test_a_polled_sample_has_the_time_at_which_it_was_read(rate_hz, neighbour_hz, neighbour_ns, serial):
    rig, taken_ns = trend_beside(rate_hz, neighbour_hz, neighbour_ns, serial=serial)
    blocks = rig.blocks["trend"]
    numbers = np.concatenate([block.samples[:, 0] for block in blocks]).astype(int)
    stated = np.concatenate([stated_ns(block) for block in blocks])
    told_ns = np.concatenate([np.full(len(block.samples), block.t_error_ns) for block in blocks])
    assert (np.abs(stated - taken_ns[numbers]) <= told_ns + 1).all()
    # No more is said than half of what a request takes, unless several share a block.
    single = np.array([len(block.samples) == 1 for block in blocks for _ in block.samples])
    assert (told_ns[single] <= MOST_NS / 2 + 1).all()
    assert (np.diff(stated) > 0).all()
    assert not any(block.quality & Quality.TIME_UNSETTLED for block in blocks)
    counters, time_base = rig.driver.streams["trend"]
    assert (counters.frames_rejected, time_base.restarts) == (0, 0)
    assert time_base.error_ns == blocks[-1].t_error_ns
    # Every sample that was read is there: none is given up once it has a reply.
    assert counters.samples_received >= len(taken_ns) - 1


def test_a_poll_that_waits_for_the_line_is_the_sample_of_its_place_or_lost():
    # The line is held for almost half a period, at any time of it: nothing is lost by that.
    rig, taken_ns = trend_beside(1.0, 0.7, (440_000_000, 450_000_000), serial=True, seconds=90.0)
    assert rig.counters("trend").samples_lost == 0
    assert rig.counters("trend").samples_received >= len(taken_ns) - 1
    late_ns = stated_of(rig) - rig.blocks["trend"][0].t_first_ns - NS_PER_S * rig.indices("trend")
    assert late_ns.max() - late_ns.min() > 300_000_000
    # Held for longer than a period, it costs the samples that were due meanwhile, and these only.
    rig, taken_ns = trend_beside(10.0, 1.0, (299_000_000, 301_000_000), serial=True)
    lost = rig.counters("trend").samples_lost
    assert 60 <= lost <= 3 * 60
    assert rig.counters("trend").samples_received + lost == pytest.approx(590, abs=3)  # quiet at first


def stated_of(rig):
    return np.concatenate([stated_ns(block) for block in rig.blocks["trend"]])


@pytest.mark.parametrize(
    "layout",
    [
        fifo_layout(1, 33, count_at(0, 32), SAMPLE, poll_ns=20_000_000),
        ring_layout(1, "holding", count_at(0, 32), 100, 256, SAMPLE, poll_ns=20_000_000),
    ],
    ids=["fifo", "ring"],
)
def test_samples_that_the_device_counts_are_as_sure_as_is_told(layout):
    rng = random.Random(5)
    rate_hz = 200.0
    rig = Rig(options_of(serial=False, timeout_ms=100.0), {"s": (layout, rate_hz)}, clock=LoopClock())
    taken_ns = []

    async def main():
        units = {1: ModbusUnit()}
        store = store_for(units[1], layout)
        plan = lambda *_: PlannedReply(delay_ns=rng.randrange(LEAST_NS, MOST_NS))  # noqa: E731
        async with responding(units, plan, serial=False), rig.running():
            for k in itertools.count():
                await asyncio.sleep(
                    max(0.0, 1000 + k / rate_hz * (1 + 50e-6) - asyncio.get_running_loop().time())
                )
                taken_ns.append(now_ns())
                store.put(k, RECORD.encode(ramp(1, first=k)))
                if k >= 30 * rate_hz:
                    return

    simulate(main)
    assert rig.counters("s").samples_lost == 0
    blocks = [block for block in rig.blocks["s"] if np.isfinite(block.t_error_ns)]
    off_ns = np.array([b.t_first_ns - taken_ns[int(b.samples[0, 0])] for b in blocks])
    told_ns = np.array([block.t_error_ns for block in blocks])
    assert len(blocks) > 500
    # From a sample to its earliest arrival: the quickest reply, and at most a period until it is asked for.
    constant_ns = np.median(off_ns)
    assert LEAST_NS <= constant_ns <= LEAST_NS + NS_PER_S / rate_hz
    assert told_truly(off_ns - constant_ns, told_ns) >= 0.9
    assert told_ns[-1] < 3_000_000
