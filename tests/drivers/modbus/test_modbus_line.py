"""A Modbus line in simulated time: late replies, silent units, rings that overrun, devices that restart."""

from __future__ import annotations

import asyncio
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.bus_tables import modbus_bus
from support.clocks import LoopClock
from support.examples import examples
from support.modbus_layouts import count_at, in_sample, register, registers_layout, ring_layout
from support.modbus_lines import Rig, options_of, ramp, responding, simulate

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.notice import NOTICE
from drivers.modbus.client import ModbusClient
from drivers.modbus.line import ModbusLine, RetryPolicy, UnitSetAsideError
from drivers.modbus.registers import RegisterRun
from drivers.modbus.replies import ModbusCounters, NoReplyError, RequestRefusedError
from sim_hw.nodes.modbus_node import PlannedReply
from sim_hw.nodes.modbus_unit import ModbusUnit, encode, store_for

pytestmark = pytest.mark.property
TIMEOUT_NS = 100_000_000
SAMPLE = (in_sample("x", 0, "int16"), in_sample("y", 1, "int16"))


def marked_units(units):
    """Units whose every register tells the unit and its own address."""
    made = {}
    for unit in units:
        made[unit] = ModbusUnit()
        for table, mark in (("holding", 0), ("input", 0x4000)):
            words = [mark | unit << 10 | address for address in range(64)]
            made[unit].put(table, 0, np.array(words, ">u2").tobytes())
    return made


def register_of(unit, function, address):
    return (0x4000 if function == 4 else 0) | unit << 10 | address


@settings(max_examples=examples(40))
@given(
    st.integers(0, 2**32),
    st.lists(
        st.tuples(st.integers(1, 4), st.sampled_from([3, 4]), st.integers(0, 50), st.integers(1, 3)),
        min_size=10,
        max_size=60,
    ),
)
def test_no_late_reply_ever_becomes_the_value_of_another_register(seed, requests):
    rng = random.Random(seed)

    # Replies come up to twice the time-out late: some in time, some in the quiet time after it.
    def plan(_unit, _pdu):
        return PlannedReply(
            rng.choice(["none", "none", "none", "silent"]), rng.randrange(0, 2 * TIMEOUT_NS - 5_000_000)
        )

    counters = ModbusCounters()
    answered = []

    async def main():
        options = modbus_bus(**options_of(serial=True), timeout_ms=TIMEOUT_NS / 1e6)
        client = ModbusClient(options, LoopClock(), counters)
        async with responding(marked_units(range(1, 5)), plan, serial=True):
            await client.connect()
            patience = RetryPolicy(TIMEOUT_NS, RetryPolicy.of(options).gap_ns, demote_after=10_000)
            line = ModbusLine(client, LoopClock(), counters, patience, units=[1, 2, 3, 4])

            async def ask(unit, function, address, count):
                try:
                    raw = await line.read(unit, function, RegisterRun(address, count))
                except NoReplyError:
                    return
                answered.append(((unit, function, address, count), np.frombuffer(raw, ">u2").tolist()))

            # Several readers at once, as the streams of a bus.
            await asyncio.gather(*(ask(*request) for request in requests))
            await client.close()

    simulate(main)
    for (unit, function, address, count), words in answered:
        assert words == [register_of(unit, function, address + k) for k in range(count)]
    assert len(answered) + counters.timeouts == len(requests)
    assert counters.replies == len(answered)


def test_late_replies_happen_and_are_counted():
    counters = ModbusCounters()

    async def main():
        options = modbus_bus(**options_of(serial=True), timeout_ms=TIMEOUT_NS / 1e6)
        client = ModbusClient(options, LoopClock(), counters)
        late = iter([PlannedReply(delay_ns=150_000_000)])
        async with responding(marked_units([1, 2]), lambda *_: next(late, PlannedReply()), serial=True):
            await client.connect()
            line = ModbusLine(
                client,
                LoopClock(),
                counters,
                RetryPolicy(TIMEOUT_NS, RetryPolicy.of(options).gap_ns),
                units=[1, 2],
            )
            with pytest.raises(NoReplyError, match=r"unit 1 at .* has not answered within 100 ms"):
                await line.read(1, 3, RegisterRun(5, 1))
            asked_ns = LoopClock().monotonic_ns()
            # The same function and length: without the quiet time the late reply would pass for this one.
            assert await line.read(1, 3, RegisterRun(6, 1)) == register_of(1, 3, 6).to_bytes(2, "big")
            assert LoopClock().monotonic_ns() - asked_ns >= TIMEOUT_NS
            await client.close()

    simulate(main)
    assert counters.replies_unasked == 1
    assert (counters.timeouts, counters.replies) == (1, 1)


def test_every_request_has_its_whole_time_out_whenever_it_is_made():
    # One alarm watches over all requests: what the one before left it at must not cut this one short.
    delays_ns = iter([0, 95_000_000, 0, 101_000_000, 99_000_000])
    counters = ModbusCounters()

    async def main():
        options = modbus_bus(**options_of(serial=False), timeout_ms=TIMEOUT_NS / 1e6)
        client = ModbusClient(options, LoopClock(), counters)
        async with responding(
            marked_units([1]), lambda *_: PlannedReply(delay_ns=next(delays_ns)), serial=False
        ):
            await client.connect()
            for late in (False, False, False, True, False):
                begun_ns = LoopClock().monotonic_ns()
                if late:
                    with pytest.raises(NoReplyError):
                        await client.read(1, 3, 5, 1)
                    assert LoopClock().monotonic_ns() - begun_ns == pytest.approx(TIMEOUT_NS, abs=1000)
                else:
                    assert await client.read(1, 3, 5, 1) == register_of(1, 3, 5).to_bytes(2, "big")
                await asyncio.sleep(0.07)
            await client.close()

    simulate(main)
    assert (counters.timeouts, counters.replies) == (1, 4)


FAULTS = {
    "silent": ("timeouts", "timeouts"),
    "wrong unit": ("replies_wrong_unit", "replies_wrong_unit"),
    "wrong transaction": (None, "replies_wrong_transaction"),
    "wrong function": ("replies_wrong_function", "replies_wrong_function"),
    "truncated": ("replies_truncated", "replies_truncated"),
    "cut off": ("replies_truncated", None),
    "oversized": ("replies_oversized", "replies_oversized"),
    "corrupt": ("replies_corrupt", None),
    "garbage": ("replies_corrupt", None),
}
CASES = [
    (fault, serial, names[not serial])
    for fault, names in FAULTS.items()
    for serial in (True, False)
    if names[not serial] is not None
]


@pytest.mark.parametrize(("fault", "serial", "counted"), CASES)
def test_what_is_no_reply_is_counted_by_kind_and_the_next_request_is_answered(fault, serial, counted):
    counters = ModbusCounters()

    async def main():
        where = options_of(serial=serial)
        options = modbus_bus(**where, timeout_ms=TIMEOUT_NS / 1e6)
        client = ModbusClient(options, LoopClock(), counters)
        plan = iter([PlannedReply(fault)])
        async with responding(marked_units([1]), lambda *_: next(plan, PlannedReply()), serial=serial):
            await client.connect()
            quiet_ns = TIMEOUT_NS if serial else 0
            line = ModbusLine(
                client,
                LoopClock(),
                counters,
                RetryPolicy(quiet_ns, RetryPolicy.of(options).gap_ns),
                units=[1],
            )
            with pytest.raises(NoReplyError):
                await line.read(1, 3, RegisterRun(5, 4))
            words = [register_of(1, 3, 5 + k) for k in range(4)]
            assert await line.read(1, 3, RegisterRun(5, 4)) == np.array(words, ">u2").tobytes()
            await client.close()

    simulate(main)
    assert getattr(counters, counted) == 1
    assert counters.replies == 1


@pytest.mark.parametrize("fault", ["wrong protocol", "cut off"])
def test_a_tcp_stream_that_lost_its_frames_is_opened_again(fault):
    layout = registers_layout(1, "holding", [register("x", 5, "uint16")])
    plan = iter([PlannedReply(), PlannedReply(fault)])
    rig = Rig(options_of(serial=False, timeout_ms=100.0), {"s": (layout, 10.0)}, clock=LoopClock())

    async def main():
        async with (
            responding(marked_units([1]), lambda *_: next(plan, PlannedReply()), serial=False),
            rig.running() as driver,
        ):
            await asyncio.sleep(60)
            assert driver.link.state == "up"
            assert driver.link.losses == 1

    simulate(main)
    rig.check_books("s")
    assert (rig.samples("s") == register_of(1, 3, 5)).all()


SLOW = registers_layout(1, "holding", [register("x", 5, "uint16")])


def test_a_device_that_closes_idle_connections_is_connected_for_each_request(caplog):
    rig = Rig(options_of(serial=False), {"s": (SLOW, 0.04)}, clock=LoopClock())

    async def main():
        async with (
            responding(marked_units([1]), lambda *_: PlannedReply(), serial=False) as units,
            rig.running() as driver,
        ):
            await asyncio.sleep(20)
            for _ in range(5):  # each time before the next request is due
                for connection in list(units.active_connections.values()):
                    connection.close()
                await asyncio.sleep(25)
            assert driver.link.state == "up"

    with caplog.at_level(NOTICE):
        simulate(main)
    assert rig.indices("s").tolist() == [0, 1, 2, 3, 4, 5]
    assert (rig.driver.link.losses, rig.driver.counters.idle_closes) == (0, 5)
    once, limit = [
        one.getMessage()
        for one in caplog.records
        if "nothing is asked" in one.getMessage() or "nothing was asked" in one.getMessage()
    ]
    assert "closed the connection while nothing was asked (after 20 s); it is opened again" in once
    assert "closes a connection over which nothing is asked (3 times after about 20 s); it is opened" in limit


def test_a_device_that_restarts_now_and_then_is_not_said_to_close_idle_connections(caplog):
    rig = Rig(options_of(serial=False), {"s": (SLOW, 0.04)}, clock=LoopClock())

    async def main():
        async with (
            responding(marked_units([1]), lambda *_: PlannedReply(), serial=False) as units,
            rig.running() as driver,
        ):
            for wait_s in (5, 40, 17, 33, 25):  # until then nothing was asked for 5, 20, 12, 20 and 20 s
                await asyncio.sleep(wait_s)
                for connection in list(units.active_connections.values()):
                    connection.close()
            await asyncio.sleep(4)
            assert driver.link.state == "up"

    with caplog.at_level(NOTICE):
        simulate(main)
    said = " ".join(one.getMessage() for one in caplog.records)
    assert rig.driver.counters.idle_closes == 4
    assert said.count("closed the connection while nothing was asked (after 5 s); it is opened again") == 1
    assert "rate_hz" not in said


def test_a_poll_that_was_due_when_the_line_was_lost_is_made_over_the_next_line():
    plan = iter([PlannedReply(), PlannedReply("wrong protocol"), PlannedReply(), PlannedReply("cut off")])
    rig = Rig(options_of(serial=False, timeout_ms=100.0), {"s": (SLOW, 0.04)}, clock=LoopClock())

    async def main():
        async with (
            responding(marked_units([1]), lambda *_: next(plan, PlannedReply()), serial=False),
            rig.running() as driver,
        ):
            await asyncio.sleep(110)
            assert driver.link.losses == 2

    simulate(main)
    rig.check_books("s")
    assert rig.indices("s").tolist() == [0, 1, 2, 3, 4]
    assert rig.counters("s").samples_lost == 0


@pytest.mark.parametrize("serial", [True, False])
def test_a_refusal_is_told_from_silence(serial):
    counters = ModbusCounters()

    async def main():
        options = modbus_bus(**options_of(serial=serial), timeout_ms=TIMEOUT_NS / 1e6)
        client = ModbusClient(options, LoopClock(), counters)
        async with responding(marked_units([1]), lambda *_: PlannedReply(), serial=serial):
            await client.connect()
            line = ModbusLine(client, LoopClock(), counters, RetryPolicy(TIMEOUT_NS, 0), units=[1])
            with pytest.raises(RequestRefusedError, match="unit 1 refuses function 24: illegal data address"):
                await line.read_fifo(1, 7)
            with pytest.raises(RequestRefusedError, match="illegal data address"):
                await line.read(1, 3, RegisterRun(65_530, 10))
            await client.close()

    simulate(main)
    assert counters.exceptions == {"illegal data address": 2}
    assert counters.timeouts == 0


def trend_of(unit):
    return registers_layout(unit, "holding", [register("x", unit, "uint16")])


@pytest.mark.parametrize("serial", [True, False])
def test_a_dead_unit_is_set_aside_and_does_not_slow_its_neighbours(serial):
    # Unit 2 is silent from 60 s to 180 s.
    def plan(unit, _pdu):
        dead = unit == 2 and 1060 <= LoopClock().monotonic_ns() / NS_PER_S < 1180
        return PlannedReply("silent" if dead else "none")

    streams = {f"unit-{unit}": (trend_of(unit), 5.0) for unit in (1, 2, 3)}
    options = options_of(serial=serial, timeout_ms=100.0, demote_after=3, demotion_s=10.0)
    rig = Rig(options, streams, clock=LoopClock())
    lost_while_dead = {}

    async def main():
        async with responding(marked_units([1, 2, 3]), plan, serial=serial), rig.running():
            await asyncio.sleep(59)
            before = {name: rig.counters(name).samples_received for name in streams}
            await asyncio.sleep(121)
            for name in streams:
                received = rig.counters(name).samples_received - before[name]
                lost_while_dead[name] = 121 * 5 - received
            await asyncio.sleep(60)

    simulate(main)
    counters = rig.driver.counters
    assert counters.units_demoted == 1
    assert counters.units_back == 1
    # Three failures and eleven probes, each a time-out and, on a serial line, as long a silence. A neighbour
    # polled every 200 ms misses at most two of its polls by that; without setting aside it would lose half.
    assert counters.timeouts <= 3 + 12
    for neighbour in ("unit-1", "unit-3"):
        assert lost_while_dead[neighbour] <= 2 * counters.timeouts
        assert lost_while_dead[neighbour] <= 0.05 * 605
    assert lost_while_dead["unit-2"] >= 0.9 * 600
    for name in streams:
        rig.check_books(name)
        assert (rig.samples(name) == register_of(int(name[-1]), 3, int(name[-1]))).all()
    assert rig.driver.link.losses == 0


def test_a_unit_set_aside_is_not_asked_until_its_time_has_come():
    counters = ModbusCounters()

    async def main():
        options = modbus_bus(**options_of(serial=True), timeout_ms=TIMEOUT_NS / 1e6)
        client = ModbusClient(options, LoopClock(), counters)
        patience = RetryPolicy(
            TIMEOUT_NS, RetryPolicy.of(options).gap_ns, demote_after=2, demotion_ns=NS_PER_S
        )
        async with responding(marked_units([1]), lambda *_: PlannedReply(), serial=True):
            await client.connect()
            line = ModbusLine(client, LoopClock(), counters, patience, units=[1, 9])
            for _ in range(2):
                with pytest.raises(NoReplyError, match="unit 9"):
                    await line.read(9, 3, RegisterRun(0, 1))
            for _ in range(5):
                with pytest.raises(UnitSetAsideError, match=r"unit 9 is set aside: .* has not answered"):
                    await line.read(9, 3, RegisterRun(0, 1))
            assert counters.requests == 2
            await asyncio.sleep(1)
            with pytest.raises(NoReplyError):
                await line.read(9, 3, RegisterRun(0, 1))
            assert (counters.requests, counters.probes) == (3, 1)
            assert not line.lost.done(), "unit 1 has not been asked yet"
            await client.close()

    simulate(main)


def test_a_line_on_which_nobody_answers_is_lost_and_opened_again():
    silent_until_s = 1100
    rig = Rig(options_of(serial=False, timeout_ms=100.0), {"s": (trend_of(1), 5.0)}, clock=LoopClock())

    def plan(_unit, _pdu):
        now_s = LoopClock().monotonic_ns() / NS_PER_S
        return PlannedReply("silent" if 1020 <= now_s < silent_until_s else "none")

    async def main():
        async with responding(marked_units([1]), plan, serial=False), rig.running() as driver:
            await asyncio.sleep(60)
            assert driver.link.state == "down"
            assert "no unit answers; the last one asked: unit " in driver.link.reason
            await asyncio.sleep(90)
            assert driver.link.state == "up"
            assert driver.link.losses == 1

    simulate(main)
    rig.check_books("s")
    assert rig.counters("s").samples_lost >= 79 * 5


@settings(max_examples=examples(40))
@given(
    st.integers(0, 2**32),
    st.sampled_from([16, 32]),
    st.sampled_from([64, 128, 256]),
    st.booleans(),
)
def test_a_ring_gives_every_sample_once_or_counts_it_lost(seed, bits, depth, serial):
    rng = random.Random(seed)
    rate_hz = 200.0
    layout = ring_layout(1, "holding", count_at(0, bits), 100, depth, SAMPLE, poll_ns=5_000_000)
    faults = ["none"] * 60 + ["silent", "exception", "truncated", "oversized", "wrong unit"]

    def plan(_unit, _pdu):
        return PlannedReply(rng.choice(faults), rng.randrange(30_000_000))

    options = options_of(serial=serial, timeout_ms=40.0, quiet_ms=40.0, demote_after=30)
    rig = Rig(options, {"s": (layout, rate_hz)}, clock=LoopClock())
    first = rng.randrange(2**16)

    async def main():
        units = marked_units([1])
        store = store_for(units[1], layout)
        store.put(first, encode(layout, ramp(1, first=first)))
        async with responding(units, plan, serial=serial), rig.running():
            sent = first + 1
            for _ in range(250):
                n = rng.randrange(1, 4)
                await asyncio.sleep(n / rate_hz)
                store.put(sent, encode(layout, ramp(n, first=sent)))
                sent += n

    simulate(main)
    rig.check_books("s")
    got = rig.samples("s")
    fresh = int(np.argmax((got == ramp(1, first=first)[0]).all(axis=1)))
    numbers = got[fresh:, 0].astype(int) + 30_000 * (got[fresh:, 1].astype(int) - 100)
    indices = rig.indices("s")[fresh:]
    # Every sample lies where the device's counter puts it: what is missing is exactly what is counted.
    np.testing.assert_array_equal(numbers - numbers[0], indices - indices[0])
    assert len(numbers) > 20


def test_a_ring_that_overruns_loses_exactly_what_the_counter_says():
    layout = ring_layout(1, "holding", count_at(0, 32), 100, 64, SAMPLE, poll_ns=10_000_000)
    silent = [False]
    options = options_of(serial=False, timeout_ms=100.0, demote_after=30)
    rig = Rig(options, {"s": (layout, 100.0)}, clock=LoopClock())

    async def main():
        units = {1: ModbusUnit()}
        store = store_for(units[1], layout)
        plan = lambda *_: PlannedReply("silent" if silent[0] else "none")  # noqa: E731
        async with responding(units, plan, serial=False), rig.running():
            for k in range(600):
                silent[0] = 200 <= k < 380
                store.put(k, encode(layout, ramp(1, first=k)))
                await asyncio.sleep(0.01)

    simulate(main)
    rig.check_books("s")
    counters = rig.counters("s")
    # Of 180 samples in silence, and one or two until the next look, the ring still has 63.
    assert 180 - 63 - 2 <= counters.samples_lost <= 180 - 63 + 12
    assert rig.driver.counters.ring_overruns == 1
    indices = rig.indices("s")
    np.testing.assert_array_equal(rig.samples("s"), ramp(600)[indices])


def test_a_ring_that_begins_again_is_followed_without_what_is_left_from_before():
    layout = ring_layout(1, "holding", count_at(0, 32), 100, 64, SAMPLE, poll_ns=10_000_000)
    rig = Rig(options_of(serial=False), {"s": (layout, 100.0)}, clock=LoopClock())

    async def main():
        units = {1: ModbusUnit()}
        store = store_for(units[1], layout)
        async with responding(units, lambda *_: PlannedReply(), serial=False), rig.running():
            for k in [*range(5000, 5400), *range(400)]:
                store.put(k, encode(layout, ramp(1, first=k)))
                await asyncio.sleep(0.01)

    simulate(main)
    rig.check_books("s")
    assert rig.driver.streams["s"][1].restarts == 1
    values = rig.samples("s")[:, 0].astype(int)
    restart = int(np.argmax(np.diff(values) < 0)) + 1
    np.testing.assert_array_equal(np.diff(values[restart:]), 1)
    assert values[restart] <= 1, "the first samples after the restart are lost"
    assert values[-1] >= 397


def test_a_schedule_finer_than_the_event_loop_sleeps_is_kept_without_loss():
    rig = Rig(options_of(serial=False), {"s": (trend_of(1), 1500.0)}, clock=LoopClock(late_ns=1_100_000))

    async def main():
        async with responding(marked_units([1]), lambda *_: PlannedReply(), serial=False), rig.running():
            await asyncio.sleep(2)

    simulate(main)
    rig.check_books("s")
    assert rig.counters("s").samples_lost == 0
    assert rig.counters("s").samples_received == pytest.approx(3000, abs=10)
