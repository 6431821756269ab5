"""Rings, queues and waveforms of devices that restart, on lines that lose, repeat and damage: exact books."""

from __future__ import annotations

import asyncio
import random
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.clocks import LoopClock
from support.examples import examples
from support.modbus_layouts import count_at, fifo_layout, in_sample, page_at, ring_layout, waveform_layout
from support.modbus_lines import Rig, options_of, responding, simulate

from daqsvc.acquisition import link as supervision
from drivers.modbus.registers import RegisterRecord, RegisterRun
from drivers.modbus.settings import FifoLayout, RingLayout, WaveformLayout
from sim_hw.nodes.modbus_node import PlannedReply
from sim_hw.nodes.modbus_unit import FifoStore, ModbusUnit, WaveformStore, store_for

pytestmark = pytest.mark.property
RATE_HZ = 500.0
WORD = 30_000
SAMPLE = (in_sample("low", 0, "int16"), in_sample("high", 1, "int16"))
RECORD = RegisterRecord(SAMPLE, (RegisterRun(0, 2),))
BLOCK = 60


def rows_of(first, n):
    """The registers of the samples with these numbers; no sample has the number 0."""
    numbers = np.arange(first, first + n)
    return RECORD.encode(np.stack([numbers % WORD, numbers // WORD], axis=1).astype(np.float32))


def numbers_of(samples):
    return samples[:, 0].astype(int) + WORD * samples[:, 1].astype(int)


class Device:
    """A unit that samples by the clock, and may be switched off and on.

    Args:
        layout: how it hands out samples.
        rng: draws what befalls the replies.
        count: where its count, or block id, begins.
        damaged: share of the counts that it tells of which one bit is wrong.
        stale: share of those that were told before.
        depth: of its queue.
    """

    def __init__(self, layout, rng, count, *, damaged=0.0, stale=0.0, depth=100):
        self.layout = layout
        self.made = 0
        self._rng = rng
        self._damaged, self._stale = damaged, stale
        self._depth = depth
        self._sound_until_s = asyncio.get_running_loop().time() + 0.5
        self._on(count)
        self.boots = [(self.made, self._since_s)]

    def _on(self, count):
        self._told = {}
        self._unit = ModbusUnit()
        if isinstance(self.layout, FifoLayout):
            self._store = FifoStore(self._unit, self.layout, self._depth)
        else:
            self._store = store_for(self._unit, self.layout)
        if isinstance(self._store, WaveformStore):
            self._store._id = count
        self._since_s = asyncio.get_running_loop().time()
        self._first = self._count = count
        self.on = True
        if isinstance(self.layout, RingLayout) and count:
            # It has run before, and the ring is full of what it has sampled.
            before = min(count, self.layout.depth)
            self._store.put(count - before, rows_of(1, before))
            self.made = before

    def taken_s(self, numbers):
        """When the samples with these numbers were taken."""
        firsts, since_s = (np.array(column) for column in zip(*self.boots, strict=True))
        boot = np.searchsorted(firsts[1:], np.asarray(numbers) - 1, side="right")
        return since_s[boot] + (numbers - firsts[boot]) / RATE_HZ

    def switch_off(self):
        self.sample()
        self.on = False

    def switch_on(self):
        self._on(0)
        self.boots.append((self.made, asyncio.get_running_loop().time()))

    def sample(self):
        """Take what is due by now."""
        if not self.on:
            return
        due = int((asyncio.get_running_loop().time() - self._since_s) * RATE_HZ) + self._first - self._count
        if due > 0:
            self._store.put(self._count, rows_of(self.made + 1, due))
            self.made += due
            self._count += due

    def answer(self, pdu):
        self.sample()
        reply = self._unit.answer(pdu)
        at = self._count_in(pdu)
        if at is None or len(reply) <= at:
            return reply
        before, self._told[pdu] = self._told.get(pdu, reply), reply
        if asyncio.get_running_loop().time() < self._sound_until_s:
            return reply  # the first count that is ever told has to be believed
        if self._rng.random() < self._stale:
            return before
        if self._rng.random() < self._damaged:
            told = int.from_bytes(reply[at : at + self._count_bytes], "big")
            # Of a queue, an error of less than a reply could be a repeat, or a loss: nobody can tell.
            lowest = 5 if isinstance(self.layout, FifoLayout) else 0
            told ^= 1 << self._rng.randrange(lowest, 8 * self._count_bytes)
            return reply[:at] + told.to_bytes(self._count_bytes, "big") + reply[at + self._count_bytes :]
        return reply

    @property
    def _count_bytes(self):
        return 2 if isinstance(self.layout, WaveformLayout) else self.layout.count.bits // 8

    def _count_in(self, pdu):
        """Where in the reply to a request a count is; None if there is none."""
        if isinstance(self.layout, FifoLayout):
            return 5 if pdu[0] == 24 else None
        return 2 if pdu[1:] == bytes([0, 0, 0, self._count_bytes // 2]) else None


def play(layout, seed, *, count, restarts, serial, damaged, stale, seconds=12.0, depth=100):
    """Let a driver read a device whose replies come late or never; returns what it made of it."""
    rng = random.Random(seed)
    options = options_of(serial=serial, timeout_ms=60.0, quiet_ms=60.0, demote_after=5, demotion_s=0.5)
    writes = [{"unit": 1, "address": 700, "count": 2}]
    rig = Rig(options | {"writes": writes}, {"s": (layout, RATE_HZ)}, clock=LoopClock())
    lost = ["silent", "exception", *([] if serial else ["wrong transaction"])]
    device = None
    quiet_until_s = 0.0

    def plan(_unit, pdu):
        now_s = asyncio.get_running_loop().time()
        if not device.on or now_s < quiet_until_s:
            return PlannedReply("silent")
        if rng.random() < 0.04:
            # What is wrong with a whole reply befalls it after the unit has done what it was asked to.
            return PlannedReply(rng.choice(lost))
        return PlannedReply(delay_ns=rng.randrange(3_000_000))

    async def main():
        nonlocal device, quiet_until_s
        device = Device(layout, rng, count, damaged=damaged, stale=stale, depth=depth)
        async with responding({1: device}, plan, serial=serial), rig.running():
            loop = asyncio.get_running_loop()
            outages = [(rng.uniform(1.0, seconds), k < restarts) for k in range(restarts + 2)]
            begun_s = loop.time()
            for at_s, restart in sorted(outages):
                await asyncio.sleep(max(begun_s + at_s - loop.time(), 0.0))
                if restart:
                    device.switch_off()
                    await asyncio.sleep(rng.uniform(0.2, 3.0))
                    device.switch_on()
                else:
                    quiet_until_s = loop.time() + rng.uniform(0.02, 1.5)
            await asyncio.sleep(max(begun_s + seconds + 3.0 - loop.time(), 3.0))
            device.sample()

    # The waits between attempts to open the line are drawn, too: the same ones in every run.
    with patch.object(supervision, "random", SimpleNamespace(Random=lambda: random.Random(seed))):
        simulate(main)
    return rig, device


def check_books(rig, device, *, within=0, unsure=0):
    """Nothing that was not sampled, nothing twice, and between restarts all is delivered or counted.

    Args:
        rig: with the driver.
        device: that it has read.
        within: by how much the place of some samples may be off: their count was damaged so little that the
            clock cannot tell, amid other losses.
        unsure: samples after a restart that may be placed before it has been found out.
    """
    rig.check_books("s")
    numbers = numbers_of(rig.samples("s"))
    assert numbers.min() >= 1, "a value was delivered that was never sampled"
    assert numbers.max() <= device.made
    assert (np.diff(numbers) > 0).all(), "a sample was delivered twice"
    indices = rig.indices("s")
    boot = np.searchsorted([first for first, _ in device.boots[1:]], numbers - 1, side="right")
    for k in range(len(device.boots)):
        off = (indices - numbers)[boot == k][unsure if k else 0 :]
        if not len(off):
            continue
        wrong = off != np.median(off)
        assert not wrong.any() or (np.abs(off - np.median(off)).max() <= within and wrong.mean() < 0.1), (
            f"what is missing after start {k} of the device is not what is counted"
        )
    return numbers, indices


SOUND = st.tuples(st.just(0.0), st.just(0.0))
DAMAGED = st.tuples(st.sampled_from([0.002, 0.01]), st.sampled_from([0.0, 0.005]))
BEGINNINGS = st.one_of(st.integers(0, 1500), st.integers(0, 2**16 - 1), st.integers(2**16 - 3000, 2**16 - 1))


@pytest.mark.long
@settings(max_examples=examples(15), deadline=None)
@given(
    st.integers(0, 2**32),
    BEGINNINGS,
    st.integers(0, 2),
    st.sampled_from([64, 256, 2048]),
    st.sampled_from([16, 32]),
    st.one_of(st.tuples(st.just(True), SOUND), st.tuples(st.just(False), SOUND | DAMAGED)),
)
def test_a_ring_is_read_once_and_its_books_are_exact(seed, count, restarts, depth, bits, link):
    serial, (damaged, stale) = link
    layout = ring_layout(1, "input", count_at(0, bits), 100, depth, SAMPLE, poll_ns=20_000_000)
    rig, device = play(
        layout, seed, count=count, restarts=restarts, serial=serial, damaged=damaged, stale=stale
    )
    numbers, indices = check_books(rig, device)
    assert len(numbers) > 0.3 * device.made - depth
    # Across a restart the index follows the clock; up to two seconds short a count is taken for slow.
    off_s = (indices - indices[0]) / RATE_HZ - (device.taken_s(numbers) - device.taken_s(numbers[0]))
    assert off_s.max() < 0.1
    assert off_s.min() > -0.1 - 2.2 * restarts
    assert rig.driver.streams["s"][1].restarts <= restarts


@pytest.mark.long
@settings(max_examples=examples(15), deadline=None)
@given(
    st.integers(0, 2**32),
    BEGINNINGS,
    st.integers(0, 2),
    st.sampled_from([20, 100, 400]),
    st.sampled_from([16, 32]),
    st.booleans(),
    st.one_of(st.tuples(st.just(True), SOUND), st.tuples(st.just(False), SOUND | DAMAGED)),
)
def test_a_queue_is_read_once_and_its_books_are_exact(seed, count, restarts, depth, bits, waits, link):
    serial, (damaged, stale) = link
    # A device that drops what it has handed out has nothing to hand out again.
    stale = stale if waits else 0.0
    layout = fifo_layout(1, 33, count_at(0, bits), SAMPLE, 700 if waits else None, poll_ns=10_000_000)
    rig, device = play(
        layout, seed, count=count, restarts=restarts, serial=serial, damaged=damaged, stale=stale, depth=depth
    )
    numbers, indices = check_books(rig, device, within=128 if damaged else 0, unsure=45)
    assert len(numbers) > 0.1 * device.made
    off_s = (indices - indices[0]) / RATE_HZ - (device.taken_s(numbers) - device.taken_s(numbers[0]))
    # What had been sampled before the first look after a restart is not known.
    assert np.abs(off_s).max() < 0.1 + 4.0 * restarts
    assert rig.driver.streams["s"][1].restarts <= restarts


@settings(max_examples=examples(12), deadline=None)
@given(
    st.integers(0, 2**32),
    st.one_of(st.just(0), st.integers(1, 65_535), st.integers(65_500, 65_535)),
    st.integers(0, 2),
    st.sampled_from([None, page_at(700, 50)]),
    st.one_of(st.tuples(st.just(True), SOUND), st.tuples(st.just(False), SOUND | DAMAGED)),
)
def test_waveforms_are_whole_and_each_is_there_once_or_counted(seed, count, restarts, page, link):
    # An old id right behind a page would hide that the block was replaced while that was read.
    serial, (damaged, _) = link
    layout = waveform_layout(1, "input", 0, 100, BLOCK, SAMPLE, page, poll_ns=10_000_000)
    rig, _ = play(layout, seed, count=count, restarts=restarts, serial=serial, damaged=damaged, stale=0.0)
    firsts = []
    for block in rig.blocks["s"]:
        numbers = numbers_of(block.samples)
        assert numbers[0] >= 1
        np.testing.assert_array_equal(numbers, np.arange(numbers[0], numbers[0] + BLOCK))
        firsts.append(numbers[0])
    assert (np.diff(firsts) >= BLOCK).all(), "a block was delivered twice"
    counters = rig.counters("s")
    if not restarts:
        taken = (firsts[-1] - firsts[0]) // BLOCK + 1
        lost_at_first = counters.samples_lost // BLOCK - (taken - len(firsts))
        assert 0 <= lost_at_first <= 30, "what is missing is not what is counted"
    else:
        assert counters.samples_lost < 15 * RATE_HZ
