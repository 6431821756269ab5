"""Streams of one unit and one rate share requests where their registers lie together, and nothing else."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.clocks import LoopClock
from support.examples import examples
from support.modbus_layouts import register, registers_layout
from support.modbus_lines import Rig, options_of, responding, simulate

from daqsvc.notice import NOTICE
from drivers.modbus.registers import RegisterRecord, RegisterRun, shared_runs
from sim_hw.nodes.modbus_node import PlannedReply
from sim_hw.nodes.modbus_unit import ModbusUnit

pytestmark = pytest.mark.integration


def trend(addresses, unit=1, table="holding", max_gap=8, **limits):
    channels = [register(f"r{address}", address, "uint16") for address in addresses]
    return registers_layout(unit, table, channels, max_gap=max_gap, **limits)


def runs_of(layout):
    return RegisterRecord.of(layout).runs


def units():
    """Units 1 and 2, whose every register tells the unit and its own address."""
    made = {}
    for unit in (1, 2):
        made[unit] = ModbusUnit()
        for table in ("holding", "input"):
            words = 1000 * unit + np.arange(300)
            made[unit].put(table, 0, words.astype(">u2").tobytes())
    return made


def polled(streams, seconds, plan=lambda *_: PlannedReply()):
    """What the driver has read in simulated time, and the requests that it took: unit, function, run."""
    rig = Rig(options_of(serial=True, timeout_ms=50.0, demote_after=30), streams, clock=LoopClock())
    asked = []

    def noted(unit, pdu):
        asked.append(
            (unit, pdu[0], RegisterRun(int.from_bytes(pdu[1:3], "big"), int.from_bytes(pdu[3:5], "big")))
        )
        return plan(unit, pdu)

    async def main():
        async with responding(units(), noted, serial=True), rig.running():
            await asyncio.sleep(seconds)

    simulate(main)
    for name, (layout, _) in streams.items():
        rig.check_books(name)
        expected = [1000 * layout.unit + field.address for field in layout.channels]
        assert (rig.samples(name) == expected).all()
    return rig, asked


def watched(streams, unit_side, seconds):
    """The driver after some simulated time with such units; its books close."""
    rig = Rig(options_of(serial=True, timeout_ms=50.0), streams, clock=LoopClock())

    async def main():
        async with responding(unit_side, lambda *_: PlannedReply(), serial=True), rig.running():
            await asyncio.sleep(seconds)

    simulate(main)
    for name in streams:
        rig.check_books(name)
    return rig


def without_register(address):
    """Units, the first of which refuses whatever includes that register (illegal data address)."""
    unit_side = units()
    answer = unit_side[1].answer
    unit_side[1].answer = lambda pdu: b"\x83\2" if pdu[2] <= address < pdu[2] + pdu[4] else answer(pdu)
    return unit_side


def test_two_streams_of_one_gateway_are_read_in_one_request():
    streams = {"drive-end": (trend([16, 18, 20]), 10.0), "other-end": (trend([24, 26]), 10.0)}
    rig, asked = polled(streams, 3.0)
    assert set(asked) == {(1, 3, RegisterRun(16, 11))}
    for name in streams:
        assert rig.counters(name).samples_received == pytest.approx(30, abs=1)
        assert rig.counters(name).samples_lost == 0
    assert rig.driver.counters.requests == pytest.approx(30, abs=1)


@pytest.mark.parametrize(
    ("other", "rate_hz"),
    [
        (trend([24]), 5.0),  # another schedule
        (trend([24], table="input"), 10.0),
        (trend([24], unit=2), 10.0),
        (trend([40]), 10.0),  # too far away
        (trend([24], max_gap=2), 10.0),  # its own limit is narrower
        (trend([24], forbidden=[(22, 22)]), 10.0),
        (
            trend([24], forbidden=[(20, 20)]),
            10.0,
        ),  # what the first one reads
    ],
)
def test_what_does_not_belong_together_is_read_apart(other, rate_hz):
    streams = {"one": (trend([16, 20]), 10.0), "other": (other, rate_hz)}
    rig, asked = polled(streams, 2.0)
    assert {run for *_, run in asked} == {RegisterRun(16, 5), *runs_of(other)}
    assert rig.counters("one").samples_lost == rig.counters("other").samples_lost == 0


def test_a_request_that_fails_costs_a_sample_of_those_in_it_and_of_nobody_else():
    # One request for both ends, another for the gearbox; every third of the second kind is not answered.
    streams = {
        "drive-end": (trend([16]), 10.0),
        "gearbox": (trend([18, 90]), 10.0),
        "other-end": (trend([20]), 10.0),
    }
    count = [0]

    def plan(_unit, pdu):
        count[0] += pdu[2] == 90
        return PlannedReply("exception" if pdu[2] == 90 and count[0] % 3 == 0 else "none")

    rig, asked = polled(streams, 6.05, plan)
    assert {run for *_, run in asked} == {RegisterRun(16, 5), RegisterRun(90, 1)}
    refused = rig.driver.counters.exceptions["server device failure"]
    assert refused == pytest.approx(20, abs=1)
    for name in ("drive-end", "other-end"):
        assert rig.counters(name).samples_lost == 0
        assert rig.counters(name).samples_received == pytest.approx(60, abs=1)
    # The last one may have been refused: it is known as lost with the next.
    assert refused - 1 <= rig.counters("gearbox").samples_lost <= refused
    assert rig.counters("gearbox").samples_received == rig.counters("drive-end").samples_received - refused


def test_polls_that_take_longer_than_their_rate_allows_are_told_with_a_rate_that_can_be(caplog):
    slow = PlannedReply(delay_ns=290_000_000)
    rig = Rig(options_of(serial=False), {"device": (trend([16, 90]), 3.0)}, clock=LoopClock())

    async def main():
        async with responding(units(), lambda *_: slow, serial=False), rig.running():
            await asyncio.sleep(60.0)

    with caplog.at_level(NOTICE):
        simulate(main)
    assert rig.counters("device").samples_lost > 60
    (said,) = [record.message for record in caplog.records if "rate_hz" in record.message]
    assert said == (
        "stream 'device': a poll takes 580 ms, and at rate_hz = 3 there are 333 ms for it, so samples are "
        "lost. Write rate_hz = 1.6 or less, or have fewer requests on this line (max_gap, other streams)"
    )


def test_a_unit_that_has_not_what_lies_between_is_asked_by_stream(caplog):
    streams = {"one": (trend([16]), 10.0), "other": (trend([20]), 10.0)}
    with caplog.at_level(NOTICE):
        rig = watched(streams, without_register(18), 3.0)
    assert rig.driver.counters.exceptions == {"illegal data address": 1}
    for name, value in (("one", 1016), ("other", 1020)):
        assert (rig.samples(name) == value).all()
        assert rig.counters(name).samples_received == pytest.approx(30, abs=1)
        assert rig.counters(name).samples_lost == 0
    (said,) = [record.message for record in caplog.records if "polled by itself" in record.message]
    assert (
        "streams 'one' and 'other': unit 1 refuses function 3: illegal data address (registers 16 to 20)"
        in said
    )


def test_a_unit_that_has_not_what_lies_between_the_registers_of_one_stream_is_asked_for_less(caplog):
    streams = {"pump": (trend([16, 20, 22]), 10.0)}
    with caplog.at_level(NOTICE):
        rig = watched(streams, without_register(18), 3.0)
    assert rig.driver.counters.exceptions == {"illegal data address": 1}
    assert (rig.samples("pump") == [1016, 1020, 1022]).all()
    assert rig.counters("pump").samples_received == pytest.approx(30, abs=1)
    assert rig.counters("pump").samples_lost == 0
    (said,) = [record.message for record in caplog.records]
    assert said.startswith(
        "stream 'pump': unit 1 refuses function 3: illegal data address (registers 16 to 22)"
    )
    assert "the registers between those of the channels are left out" in said


def test_a_register_that_is_not_there_costs_its_own_channel_only(caplog):
    streams = {"pump": (trend([16, 17, 18, 30], max_gap=0), 1.0)}
    with caplog.at_level(NOTICE):
        rig = watched(streams, without_register(17), 30.0)
    samples = rig.samples("pump")
    assert (samples[:, [0, 2, 3]] == [1016, 1018, 1030]).all()
    assert np.isnan(samples[:, 1]).all()
    counters = rig.counters("pump")
    assert counters.samples_received == pytest.approx(30, abs=1)
    assert counters.samples_lost == 0
    assert counters.values_absent == counters.samples_received
    (said,) = [record.message for record in caplog.records]
    assert said.startswith(
        "stream 'pump': unit 1 refuses function 3: illegal data address (register 17): "
        "channel 'r17' has no value"
    )
    # The whole request, and this register by itself: once, and not with every sample.
    assert rig.driver.counters.exceptions["illegal data address"] == 2


def test_a_register_that_comes_back_is_read_again():
    streams = {"pump": (trend([16, 17], max_gap=0), 1.0)}
    unit_side = units()
    answer, asked = unit_side[1].answer, []

    def growing(pdu):
        asked.append(RegisterRun(pdu[2], pdu[4]))
        return b"\x83\2" if len(asked) < 60 and pdu[2] <= 17 < pdu[2] + pdu[4] else answer(pdu)

    unit_side[1].answer = growing
    rig = watched(streams, unit_side, 300.0)
    samples = rig.samples("pump")
    assert np.isnan(samples[0, 1])
    assert (samples[-100:] == [1016, 1017]).all()
    assert rig.counters("pump").samples_lost == 0


def test_a_unit_that_has_none_of_the_registers_gives_no_sample_and_is_named(caplog):
    streams = {"pump": (trend([16, 17], max_gap=0), 1.0)}
    unit_side = units()
    unit_side[1].answer = lambda _pdu: b"\x83\2"
    with caplog.at_level(NOTICE):
        rig = watched(streams, unit_side, 30.0)
    assert rig.counters("pump").samples_received == 0
    assert caplog.records[-1].message.startswith(
        "stream 'pump': unit 1 refuses function 3: illegal data address (registers 16 to 17)"
    )


def test_a_unit_that_falls_silent_while_its_registers_are_sought_loses_no_channel():
    streams = {"pump": (trend([16, 17], max_gap=0), 1.0)}
    unit_side = without_register(17)
    count = iter(range(1000))

    def silent(_unit, pdu):
        alone = pdu[4] == 1 and next(count) < 1
        return PlannedReply("silent" if alone else "none")

    rig = Rig(options_of(serial=True, timeout_ms=50.0), streams, clock=LoopClock())

    async def main():
        async with responding(unit_side, silent, serial=True), rig.running():
            await asyncio.sleep(20.0)

    simulate(main)
    rig.check_books("pump")
    assert (rig.samples("pump")[:, 0] == 1016).all()
    assert np.isnan(rig.samples("pump")[:, 1]).all()


def refusing(*addresses, code=2):
    """Units, the first of which refuses whatever includes one of these registers."""
    unit_side = units()
    answer, asked = unit_side[1].answer, []

    def refuse(pdu):
        asked.append(RegisterRun(pdu[2], pdu[4]))
        there = any(pdu[2] <= one < pdu[2] + pdu[4] for one in addresses)
        return bytes([0x83, code]) if there else answer(pdu)

    unit_side[1].answer = refuse
    return unit_side, asked


def test_what_is_refused_of_one_stream_does_not_hide_what_is_of_another(caplog):
    streams = {"one": (trend([16, 17]), 1.0), "other": (trend([20, 21]), 1.0)}
    with caplog.at_level(NOTICE):
        rig = watched(streams, refusing(17, 20, 21)[0], 30.0)
    assert (rig.samples("one")[:, 0] == 1016).all()
    assert rig.counters("one").samples_received == pytest.approx(30, abs=1)
    assert rig.counters("other").samples_received == 0
    assert [*rig.driver.link.faults] == ["other"]
    said = "\n".join(record.message for record in caplog.records)
    assert "channel 'r17' has no value" in said
    assert "stream 'other': unit 1 refuses function 3: illegal data address (registers 20 to 21)" in said


@pytest.mark.parametrize(
    ("unit_side", "channels", "requests"),
    [
        (refusing(*range(16, 32)), range(16, 32), 60 + 16),  # the whole map is elsewhere
        (refusing(*range(16, 32), code=3), range(16, 32), 60 + 16),
    ],
)
def test_channels_are_asked_for_one_by_one_once_and_not_with_every_sample(unit_side, channels, requests):
    sides, asked = unit_side
    watched({"pump": (trend([*channels], max_gap=0), 1.0)}, sides, 60.0)
    assert len(asked) == pytest.approx(requests, abs=3)


def answering(most, code=3):
    """Units, the first of which refuses what is longer than that."""
    unit_side = units()
    answer, asked = unit_side[1].answer, []

    def refuse(pdu):
        asked.append(RegisterRun(pdu[2], pdu[4]))
        return bytes([0x83, code]) if pdu[4] > most else answer(pdu)

    unit_side[1].answer = refuse
    return unit_side, asked


@pytest.mark.parametrize("code", [2, 3])
@pytest.mark.parametrize(("channels", "most"), [(range(100, 109), 8), ([*range(100, 107), 120], 4)])
def test_a_unit_that_answers_for_few_registers_at_once_is_asked_for_no_more(channels, most, code, caplog):
    sides, asked = answering(most, code)
    with caplog.at_level(NOTICE):
        rig = watched({"device": (trend([*channels]), 1.0)}, sides, 4000.0)
    assert (rig.samples("device") == [1000 + one for one in channels]).all()
    assert rig.counters("device").samples_lost == 0
    assert rig.counters("device").samples_received == pytest.approx(4000, abs=1)
    (said,) = [record.message for record in caplog.records if "max_count" in record.message]
    kind = {2: "address", 3: "value"}[code]
    last = max(one for one in channels if one < 110)
    assert said == (
        f"stream 'device': unit 1 refuses function 3: illegal data {kind} (registers 100 to {last}); it "
        f"answers for {most} at once, and is asked for no more by one request from now on. max_count = "
        f"{most} avoids the refusal"
    )
    # A few refusals while it was sought, and none later.
    assert sum(one.count > most for one in asked) <= 6
    assert all(one.count <= most for one in asked[40:])


def test_streams_that_share_requests_share_a_limit_of_their_length(caplog):
    streams = {"one": (trend([16, 17, 18]), 1.0), "other": (trend([20, 21], max_count=100), 1.0)}
    sides, asked = answering(3)
    with caplog.at_level(NOTICE):
        rig = watched(streams, sides, 200.0)
    for name in streams:
        assert rig.counters(name).samples_lost == 0
    assert set(asked[-100:]) == {RegisterRun(16, 3), RegisterRun(20, 2)}
    assert sum(one.count > 3 for one in asked) <= 4


def test_a_register_that_is_refused_as_if_it_were_too_long_costs_its_own_channel_only(caplog):
    with caplog.at_level(NOTICE):
        rig = watched({"pump": (trend([16, 17, 18, 19]), 1.0)}, refusing(18, code=3)[0], 30.0)
    samples = rig.samples("pump")
    assert (samples[:, [0, 1, 3]] == [1016, 1017, 1019]).all()
    assert np.isnan(samples[:, 2]).all()
    (said,) = [record.message for record in caplog.records]
    assert "channel 'r18' has no value" in said


def test_a_refusal_of_length_for_a_moment_limits_nothing():
    sides = units()
    answer, asked = sides[1].answer, []

    def starting(pdu):
        asked.append(RegisterRun(pdu[2], pdu[4]))
        return b"\x83\3" if len(asked) == 1 else answer(pdu)

    sides[1].answer = starting
    watched({"pump": (trend([16, 17, 18]), 1.0)}, sides, 30.0)
    assert set(asked[-20:]) == {RegisterRun(16, 3)}


def test_a_unit_that_dies_is_known_as_dead_though_its_channels_were_asked_for_one_by_one():
    sides, asked = refusing(17)
    rig = Rig(
        options_of(serial=True, timeout_ms=50.0),
        {"pump": (trend([16, 17, 18], max_gap=0), 1.0)},
        clock=LoopClock(),
    )

    async def main():
        async with (
            responding(sides, lambda *_: PlannedReply("silent" if len(asked) > 15 else "none"), serial=True),
            rig.running(),
        ):
            await asyncio.sleep(120.0)

    simulate(main)
    assert rig.driver.counters.units_demoted > 0
    assert rig.driver.link.losses > 0


def test_a_short_refusal_costs_a_channel_a_minute_however_long_another_is_away():
    sides, _ = refusing(17)
    refuse, begun = sides[1].answer, []

    def shortly(pdu):
        now_s = asyncio.get_running_loop().time()
        begun.append(now_s)
        short = 14_000 < now_s - begun[0] < 14_012 and pdu[2] <= 18 < pdu[2] + pdu[4]
        return b"\x83\2" if short else refuse(pdu)

    sides[1].answer = shortly
    rig = watched({"pump": (trend([16, 17, 18], max_gap=0), 0.1)}, sides, 16_000.0)
    samples = rig.samples("pump")
    assert np.isnan(samples[:, 1]).all()
    assert 1 <= np.isnan(samples[:, 2]).sum() <= 8


def test_each_channel_and_stream_without_its_register_is_named(caplog):
    parts = [register(name, 17, "uint16", bits=[at, 4]) for name, at in (("low", 0), ("high", 4))]
    layout = registers_layout(1, "holding", [register("r16", 16, "uint16"), *parts], max_gap=0)
    with caplog.at_level(NOTICE):
        watched({"bits": (layout, 1.0), "pump": (trend([17, 18]), 1.0)}, refusing(17)[0], 10.0)
    said = "\n".join(record.message for record in caplog.records)
    for stream, channel in (("bits", "low"), ("bits", "high"), ("pump", "r17")):
        refused = "unit 1 refuses function 3: illegal data address (register 17)"
        assert f"stream {stream!r}: {refused}: channel {channel!r}" in said


def test_streams_that_were_parted_are_tried_together_again():
    """A gateway that refused everything while it started is asked once for both, as before."""
    streams = {"one": (trend([16]), 1.0), "other": (trend([20]), 1.0)}
    unit_side = units()
    answer, asked = unit_side[1].answer, []

    def starting(pdu):
        asked.append(RegisterRun(pdu[2], pdu[4]))
        return b"\x83\2" if len(asked) <= 7 else answer(pdu)

    unit_side[1].answer = starting
    rig = watched(streams, unit_side, 300.0)
    assert asked[:9] == [RegisterRun(16, 5), *[RegisterRun(16, 1), RegisterRun(20, 1)] * 4]
    assert set(asked[-100:]) == {RegisterRun(16, 5)}
    for name in streams:
        assert rig.counters(name).samples_received == pytest.approx(297, abs=2)


def test_who_is_refused_for_good_is_named_alone_and_costs_the_others_nothing(caplog):
    streams = {name: (trend([at]), 1.0) for name, at in (("a", 16), ("b", 18), ("c", 20))}
    with caplog.at_level(NOTICE):
        rig = watched(streams, without_register(18), 1000.0)
    for name in ("a", "c"):
        assert rig.counters(name).samples_lost == 0
        assert rig.counters(name).samples_received == pytest.approx(1000, abs=1)
    assert rig.counters("b").samples_received == 0
    parted, refused = [record.message for record in caplog.records]
    assert parted.startswith("streams 'a', 'b' and 'c': unit 1 refuses function 3: illegal data address")
    assert refused.startswith("stream 'b': unit 1 refuses function 3: illegal data address (register 18)")


def test_a_refusal_that_says_nothing_of_the_registers_leaves_them_together():
    busy = iter([PlannedReply(), PlannedReply("exception")])
    streams = {"one": (trend([16]), 10.0), "other": (trend([20]), 10.0)}
    rig, asked = polled(streams, 2.0, lambda *_: next(busy, PlannedReply()))
    assert set(asked) == {(1, 3, RegisterRun(16, 5))}
    assert rig.counters("one").samples_lost == rig.counters("other").samples_lost == 1


banned = st.tuples(st.integers(0, 310), st.integers(0, 5)).map(lambda pair: (pair[0], sum(pair)))
limits = st.fixed_dictionaries(
    {
        "max_gap": st.integers(0, 20),
        "max_count": st.integers(60, 125),
        "forbidden": st.lists(banned, max_size=3),
    }
)


@settings(max_examples=examples(300))
@given(
    st.lists(st.tuples(st.sets(st.integers(0, 300), min_size=1, max_size=12), limits), min_size=1, max_size=5)
)
def test_shared_requests_are_fewer_and_read_for_each_stream_only_what_it_allows(wishes):
    layouts = []
    for addresses, allowed in wishes:
        taken = {a for first, last in allowed["forbidden"] for a in range(first, last + 1)}
        if addresses - taken:
            layouts.append(trend(sorted(addresses - taken), **allowed))
    runs = shared_runs(layouts)
    if runs is None:
        return
    assert len(runs) < sum(len(runs_of(layout)) for layout in layouts)
    read = [address for run in runs for address in range(run.address, run.end)]
    assert len(read) == len(set(read))
    for layout in layouts:
        assert {channel.address for channel in layout.channels} <= set(read)
        assert not set(read) & {a for first, last in layout.forbidden for a in range(first, last + 1)}
        assert all(run.count <= layout.max_count for run in runs)
