"""Modbus units and requests that stay without reply, and lines that are opened again, in simulated time."""

from __future__ import annotations

import asyncio
import itertools
import random
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.clocks import LoopClock
from support.examples import examples, first_of
from support.modbus_layouts import count_at, fifo_layout, in_sample, register, registers_layout
from support.modbus_lines import Rig, options_of, responding, simulate

from daqsvc.acquisition import link as supervision
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.notice import NOTICE
from drivers.modbus.line import RequestKey, RetryPolicy, UnitHealth, UnitSetAsideError
from drivers.modbus.replies import READ_FIFO, REMEDIES, WRITE_REGISTERS, ModbusCounters
from sim_hw.nodes.modbus_node import PlannedReply
from sim_hw.nodes.modbus_unit import ModbusUnit

pytestmark = pytest.mark.property
TIMEOUT_MS = 100.0
FIFO = fifo_layout(1, 7, count_at(0, 16), (in_sample("n", 0, "uint16"),), poll_ns=10_000_000)


def trend_of(unit, address):
    return registers_layout(unit, "holding", [register("x", address, "uint16")])


def units(addresses=(1, 2, 3)):
    """Units whose every register tells the unit and its own address."""
    made = {unit: ModbusUnit() for unit in addresses}
    for unit, responder in made.items():
        responder.put("holding", 0, (unit << 10 | np.arange(64)).astype(">u2").tobytes())
    return made


def now_s():
    return LoopClock().monotonic_ns() / NS_PER_S - 1000


@pytest.mark.long
@settings(max_examples=examples(40))
@given(st.integers(0, 2**32), st.integers(1, 2))
def test_no_late_reply_becomes_the_value_of_another_stream_however_often_the_line_is_opened(
    seed, demote_after
):
    rng = random.Random(seed)
    streams = {"a": (trend_of(1, 3), 20.0), "b": (trend_of(1, 50), 20.0)}
    options = options_of(serial=True, timeout_ms=TIMEOUT_MS, demote_after=demote_after, demotion_s=1.0)
    rig = Rig(options, streams, clock=LoopClock())
    late_ns = 2 * round(TIMEOUT_MS * 1e6) - 5_000_000

    def plan(_unit, _pdu):
        return PlannedReply(delay_ns=rng.randrange(late_ns) if rng.random() < 0.3 else 0)

    async def main():
        async with responding(units(), plan, serial=True):
            for _ in range(8):  # the driver is stopped and run again at any moment
                async with rig.running():
                    await asyncio.sleep(rng.uniform(0.05, 4.0))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(supervision, "random", SimpleNamespace(Random=lambda: random.Random(seed)))
        simulate(main)
    for name, (layout, _) in streams.items():
        if rig.blocks[name]:
            assert (rig.samples(name) == (1 << 10 | layout.channels[0].address)).all()


def test_a_line_that_was_opened_is_quiet_as_if_somebody_had_just_asked():
    asked_s = []

    def plan(_unit, _pdu):
        asked_s.append(now_s())
        return PlannedReply()

    for serial, least_s in ((True, 2 * TIMEOUT_MS / 1e3), (False, 0.0)):
        asked_s.clear()
        streams = {"a": (trend_of(1, 3), 20.0)}
        rig = Rig(options_of(serial=serial, timeout_ms=TIMEOUT_MS), streams, clock=LoopClock())

        async def main(rig=rig, serial=serial):
            async with responding(units(), plan, serial=serial), rig.running():
                await asyncio.sleep(0.5)

        simulate(main)
        assert asked_s[0] == pytest.approx(least_s, abs=0.01)
        # It was only later: what was not asked for at first is not lost.
        assert rig.counters("a").samples_lost == 0


@pytest.mark.gives("B32")
@pytest.mark.parametrize("fault", ["silent", "wrong function", "gateway"])
@pytest.mark.parametrize("demote_after", first_of(3, 1))
def test_a_unit_lives_while_it_answers_anything(fault, demote_after, caplog):
    """A queue that the unit does not know costs its other stream nothing, and the link stays up."""
    unit_side = units()
    if fault == "gateway":
        answer = unit_side[1].answer
        unit_side[1].answer = lambda pdu: bytes([0x98, 11]) if pdu[0] == READ_FIFO else answer(pdu)

    def plan(_unit, pdu):
        return PlannedReply(
            fault if pdu[0] == READ_FIFO and fault != "gateway" else "none", delay_ns=1_000_000
        )

    streams = {"fifo": (FIFO, 100.0), "good": (trend_of(1, 7), 1.0)}
    options = options_of(serial=False, timeout_ms=TIMEOUT_MS, demote_after=demote_after)
    rig = Rig(options, streams, clock=LoopClock())

    async def main():
        async with responding(unit_side, plan, serial=False), rig.running():
            await asyncio.sleep(300.5)

    with caplog.at_level(NOTICE):
        simulate(main)
    counters = rig.driver.counters
    assert rig.counters("good").samples_lost == 0
    assert rig.counters("good").samples_received == 301
    assert (counters.units_demoted, counters.requests_demoted) == (0, 1)
    # After 10 s, 20 s more, 40 s, and then every 60 s.
    assert counters.probes == 3 + (300 - 70) // 60
    assert rig.driver.link.losses == 0
    (said,) = [record.message for record in caplog.records if "set aside" in record.message]
    when = "set aside, and asked again in 10 s, then after times that double up to 60 s"
    assert said.endswith(f"; function 24 for stream 'fifo' is {when}")


@pytest.mark.parametrize("order", [("dead", "one", "other"), ("one", "dead", "other")])
@pytest.mark.parametrize("dead_since_s", [0.0, 30.0])
def test_a_dead_unit_costs_those_that_are_polled_every_second_nothing(order, dead_since_s):
    """With the time-out of 0.5 s that a machine file has by default: the line is held for 1 s each time."""
    numbers = {"one": 1, "other": 2, "dead": 3}
    streams = {name: (trend_of(numbers[name], 5), 1.0) for name in order}
    rig = Rig(options_of(serial=True), streams, clock=LoopClock())

    async def main():
        def plan(unit, _pdu):
            return PlannedReply(
                "silent" if unit == 3 and now_s() > dead_since_s else "none", delay_ns=3_000_000
            )

        async with responding(units(), plan, serial=True), rig.running():
            await asyncio.sleep(300.8)

    simulate(main)
    # One if the dead unit, of which nobody knows yet, is first in line: then all others are a period late.
    lost = [rig.counters(name).samples_lost for name in ("one", "other")]
    assert sum(lost) <= (order[0] == "dead" and dead_since_s > 0)
    for name in ("one", "other"):
        assert rig.counters(name).samples_received >= 298
        assert (np.diff([block.t_first_ns for block in rig.blocks[name]]) > 0).all()
    assert rig.driver.counters.units_demoted == 1
    # Set aside after three, then asked ever more rarely.
    assert rig.driver.counters.timeouts <= 3 + 3 + 300 // 60


@pytest.mark.parametrize("serial", [True, False])
def test_a_unit_is_found_to_be_back_though_one_of_its_streams_never_is(serial):
    def plan(unit, pdu):
        silent = unit == 1 and (pdu[0] == READ_FIFO or 50 <= now_s() < 170)
        return PlannedReply("silent" if silent else "none")

    streams = {"fifo": (FIFO, 100.0), "good": (trend_of(1, 7), 1.0), "second": (trend_of(2, 7), 1.0)}
    rig = Rig(options_of(serial=serial, timeout_ms=TIMEOUT_MS), streams, clock=LoopClock())
    back_s = []

    async def main():
        async with responding(units(), plan, serial=serial), rig.running():
            while not back_s and now_s() < 300:
                await asyncio.sleep(1.0)
                if rig.driver.counters.units_back:
                    back_s.append(now_s())

    simulate(main)
    assert rig.driver.counters.units_demoted == 1
    # The longest that its absence, and a turn of the stream that is never there, can keep it waiting.
    assert back_s[0] <= 170 + 60 + 10 + 2
    assert rig.driver.link.losses == 0


def test_all_that_a_dead_unit_was_asked_shares_its_probes():
    patience = RetryPolicy(0, 0, demote_after=3)
    counters = ModbusCounters()
    unit = UnitHealth(9, patience, counters)
    requests = [unit.of(RequestKey(3, f"registers {k}")) for k in range(5)]
    asked = 0
    now_ns = 0
    for request in requests:
        unit.check(request, 0)
        unit.answered(request, 0)
    for now_s_ in range(1000):
        for request in requests:
            now_ns = now_s_ * NS_PER_S
            try:
                unit.check(request, now_ns)
            except UnitSetAsideError:
                continue
            asked += 1
            unit.missed(request, "unit 9 has not answered", now_ns)
    assert unit.dead
    # One each until it was dead, and then one for all of them, at most every 60 s but at first.
    assert asked <= 5 + 3 + 1000 // 60
    unit.answered(requests[0], now_ns)
    for request in requests:
        unit.check(request, now_ns)


@pytest.mark.gives("B33")
def test_each_refusal_is_told_once_with_what_to_do_about_it(caplog):
    unit_side = units()
    answer = unit_side[1].answer
    codes = itertools.cycle([6, 2, 77, None])

    def refusing(pdu):
        code = next(codes)
        return answer(pdu) if code is None else bytes([pdu[0] | 0x80, code])

    unit_side[1].answer = refusing
    rig = Rig(
        options_of(serial=False, timeout_ms=TIMEOUT_MS), {"a": (trend_of(1, 3), 20.0)}, clock=LoopClock()
    )

    async def main():
        async with responding(unit_side, lambda *_: PlannedReply(), serial=False), rig.running():
            await asyncio.sleep(10.0)

    with caplog.at_level(NOTICE):
        simulate(main)
    begin = "stream 'a': unit 1 refuses function 3: {} (register 3), which is counted from now on; {}"
    assert [record.message for record in caplog.records if "refuses" in record.message] == [
        begin.format(*told)
        for told in (
            ("server device busy", "it is busy; lower the rate of what is read from it"),
            ("illegal data address", REMEDIES[2]),
            ("exception 77", "look the exception up in the manual of the device"),
        )
    ]
    assert rig.driver.counters.exceptions["server device busy"] >= 49


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("wrong function", "answers with a reply to another function; compare"),
        ("truncated", "answers with a reply that is too short; compare"),
        ("oversized", "answers with a reply that is too long; compare"),
    ],
)
def test_what_is_wrong_with_a_reply_is_told_in_words(fault, words, caplog):
    rig = Rig(
        options_of(serial=False, timeout_ms=TIMEOUT_MS), {"a": (trend_of(1, 3), 20.0)}, clock=LoopClock()
    )

    async def main():
        async with responding(units(), lambda *_: PlannedReply(fault), serial=False), rig.running():
            await asyncio.sleep(1.0)

    with caplog.at_level(NOTICE):
        simulate(main)
    assert words in caplog.text


@pytest.mark.parametrize("values", [[], [70_000], [-1], [1.5], ["1"], [0] * 124])
def test_what_no_register_holds_is_not_sent(values):
    rig = Rig(
        options_of(serial=False, timeout_ms=TIMEOUT_MS, writes=[{"unit": 1, "address": 0, "count": 123}]),
        {"a": (trend_of(1, 3), 20.0)},
        clock=LoopClock(),
    )
    written = []

    def plan(_unit, pdu):
        written.append(pdu[0] == WRITE_REGISTERS)
        return PlannedReply()

    async def main():
        async with responding(units(), plan, serial=False), rig.running() as driver:
            await asyncio.sleep(0.5)
            with pytest.raises(ValueError, match=r"to be written; a re(gister|quest) "):
                await driver.write(1, 0, values)
            assert not any(written)
            await driver.write(1, 0, [np.int64(65_535)])
            assert any(written)

    simulate(main)


def apart(unit, *addresses):
    """A stream whose channels take a request each, as `daqsvc new` writes it."""
    channels = [register(f"r{address}", address, "uint16") for address in addresses]
    return registers_layout(unit, "holding", channels, max_gap=0)


class HungSession:
    """Units behind a connection that falls silent at ``at_s``, and answer over the next one at once.

    Args:
        at_s: when.
        spared: which requests are answered all the same, by unit and first register.
    """

    def __init__(self, at_s, spared=()):
        self._at_s = at_s
        self._spared = set(spared)
        self.lost_at_s = None
        self.driver = None

    def __call__(self, unit, pdu):
        address = int.from_bytes(pdu[1:3], "big")
        hangs = now_s() >= self._at_s and not self.driver.link.losses
        return PlannedReply("silent" if hangs and (unit, address) not in self._spared else "none")


def run_through(streams, plan, *, until_s, serial=False, **options):
    rig = Rig(options_of(serial=serial, timeout_ms=TIMEOUT_MS, **options), streams, clock=LoopClock())
    plan.driver = rig.driver

    async def main():
        async with responding(units(), plan, serial=serial), rig.running() as driver:
            while now_s() < until_s:
                await asyncio.sleep(0.1)
                if driver.link.losses and plan.lost_at_s is None:
                    plan.lost_at_s = now_s()

    simulate(main)
    return rig


@pytest.mark.parametrize("serial", [False, True])
@pytest.mark.parametrize("demote_after", first_of(3, 1))
def test_a_session_that_hangs_is_lost_also_if_a_poll_takes_several_requests(serial, demote_after, caplog):
    plan = HungSession(20.2)
    with caplog.at_level(NOTICE):
        rig = run_through(
            {"s": (apart(1, 1, 20, 40), 1.0)}, plan, until_s=60, serial=serial, demote_after=demote_after
        )
    # Three polls without a reply, and one request more that shows that the other registers are silent, too.
    assert plan.lost_at_s <= 20.2 + demote_after + 1
    assert rig.driver.link.losses == 1
    rig.check_books("s")
    assert 1 <= rig.counters("s").samples_lost <= demote_after + 3
    assert rig.counters("s").samples_received + rig.counters("s").samples_lost == pytest.approx(60, abs=2)
    assert rig.driver.counters.requests_demoted == 0
    assert "no unit answers" in caplog.text
    assert "is back" in caplog.text
    assert "function 3 for register" not in caplog.text


def test_a_session_that_hangs_is_lost_also_with_two_units_of_which_one_is_asked_rarely():
    streams = {
        "fast": (apart(1, 1, 20), 1.0),
        "second": (apart(1, 40, 50), 0.5),
        "other": (apart(2, 1, 20, 40), 1.0),
        "rare": (apart(3, 7, 30), 0.01),
    }
    plan = HungSession(130.2)
    rig = run_through(streams, plan, until_s=400)
    assert plan.lost_at_s <= 130.2 + 5
    assert rig.driver.link.losses == 1
    for name in streams:
        rig.check_books(name)
    assert 1 <= rig.counters("fast").samples_lost <= 6
    assert rig.counters("rare").samples_lost == 0


@pytest.mark.parametrize("polled", [(1, 20), (1,)])
def test_a_unit_of_which_one_request_alone_fails_is_not_taken_for_dead(polled, caplog):
    """The first request of a poll, or its only one: the rest is not asked any more, or rarely."""
    streams = {"first": (apart(1, *polled), 1.0), "rare": (apart(1, 50), 0.02)}
    plan = HungSession(60.2, spared=[(1, 20), (1, 50)])
    with caplog.at_level(NOTICE):
        rig = run_through(streams, plan, until_s=400)
    counters = rig.driver.counters
    assert rig.driver.link.losses == 0
    assert counters.units_demoted == 0
    assert counters.requests_demoted >= 1
    assert rig.counters("rare").samples_lost == 0
    assert "function 3 for register 1 is set aside" in caplog.text


def test_a_unit_that_is_asked_rarely_keeps_the_line_of_a_dead_one_up():
    """The dead unit is set aside; the other has not been asked since, and is asked before more is said."""
    streams = {"dead": (apart(1, 1, 20), 1.0), "rare": (apart(2, 7, 30), 0.01)}
    plan = HungSession(130.2, spared=[(2, 7), (2, 30)])
    rig = run_through(streams, plan, until_s=400)
    assert rig.driver.link.losses == 0
    assert rig.driver.counters.units_demoted == 1
    assert rig.counters("rare").samples_lost == 0
