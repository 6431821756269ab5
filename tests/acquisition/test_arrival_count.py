"""Streams whose frames carry no counter: placed, and their loss told, by the times of arrival."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.machine_files import MACHINES, only_problem, parsed

from daqsvc.acquisition.arrival_count import ArrivalCount
from daqsvc.acquisition.assembler import StreamAssembler
from daqsvc.acquisition.samples import Quality, SampleBlock
from daqsvc.settings import describe, load_machine_file
from drivers.can.dbc import layout_from_dbc
from drivers.can.plugin import frame_layout

pytestmark = pytest.mark.property
PERIOD_NS = 10_000_000
SENSOR = MACHINES / "j1939-pgn61485.toml"
TRIAXIAL = MACHINES / "dbc-triaxial.toml"


@given(
    drift=st.floats(-5e-3, 5e-3),
    gaps=st.lists(st.tuples(st.integers(1, 60), st.integers(1, 20)), max_size=30),
    seed=st.integers(0, 2**32 - 1),
    batch=st.integers(1, 40),
)
def test_loss_is_exact_while_no_frame_is_later_than_half_a_period(drift, gaps, seed, batch) -> None:
    rng = np.random.default_rng(seed)
    lost = np.concatenate([[0] * 40, *([0] * whole + [missing] for whole, missing in gaps), [0] * 5])
    sent = np.cumsum(lost + 1) - 1
    late_ns = rng.uniform(0, 0.5 * PERIOD_NS, len(sent))
    arrival_ns = (sent * PERIOD_NS * (1 + drift) + late_ns).astype(np.int64)
    counter = ArrivalCount(PERIOD_NS)
    counts = np.concatenate(
        [counter.count(part) for part in np.split(arrival_ns, range(batch, len(sent), batch))]
    )
    assert (counts - counts[0]).tolist() == (sent - sent[0]).tolist()


def test_a_device_that_is_a_little_slow_loses_nothing_over_the_hours() -> None:
    arrival_ns = (np.arange(300_000) * PERIOD_NS * 1.004).astype(np.int64)
    assert ArrivalCount(PERIOD_NS).count(arrival_ns)[-1] == 299_999


def test_frames_that_come_all_at_once_are_a_frame_each() -> None:
    arrival_ns = np.array([0, 1, 1, 1, 1]) * PERIOD_NS
    assert (np.diff(ArrivalCount(PERIOD_NS).count(arrival_ns)) >= 1).all()


def test_a_frame_that_comes_before_its_time_is_delivered_all_the_same() -> None:
    """A message of one a second that is also sent when something happens."""
    blocks: list[SampleBlock] = []
    stream = StreamAssembler(
        "s", 1.0, counter_bits=None, samples_per_frame=1, counts_per_frame=1, deliver=blocks.append
    )
    arrival_ns = np.sort(np.concatenate([np.arange(60), [7.23, 7.9, 31.5]]) * 1e9).astype(np.int64)
    for t_ns in arrival_ns:
        stream.accept(np.zeros(1, np.int64), np.zeros((1, 1, 1), np.float32), np.ones(1, bool), t_ns[None])
    stream.flush()
    assert stream.counters.samples_received == len(arrival_ns)
    assert stream.counters.frames_rejected == 0
    assert stream.time_base.restarts == 0
    index = np.concatenate([np.arange(block.first_index, block.end_index) for block in blocks])
    assert len(index) == len(arrival_ns)
    assert (np.diff(index) > 0).all()


def test_what_the_assembler_makes_of_them_is_whole_and_says_that_loss_is_estimated() -> None:
    blocks: list[SampleBlock] = []
    stream = StreamAssembler(
        "foot", 100.0, counter_bits=None, samples_per_frame=1, counts_per_frame=1, deliver=blocks.append
    )
    sent = np.delete(np.arange(1000), [*range(400, 407), 700])
    samples = sent.astype(np.float32)[:, None, None]
    for part in np.array_split(np.arange(len(sent)), 60):
        intact = np.isin(sent[part], [800], invert=True)
        stream.accept(np.zeros(len(part), np.int64), samples[part], intact, sent[part] * PERIOD_NS + 10**9)
        stream.tick(int(sent[part[-1]]) * PERIOD_NS + 10**9)
    stream.flush()
    counters = stream.counters
    assert (counters.samples_received, counters.samples_lost) == (991, 9)
    assert (counters.frames_corrupt, counters.frames_duplicate, counters.gaps) == (1, 0, 3)
    first = blocks[0].first_index
    for block in blocks:
        assert block.samples[:, 0].tolist() == list(range(block.first_index - first, block.end_index - first))
        assert bool(block.quality & Quality.LOSS_ESTIMATED) == bool(block.lost_before)
    last = blocks[-1]
    assert last.t_first_ns == pytest.approx(10**9 + (last.first_index - first) * PERIOD_NS, abs=1000)


@pytest.mark.parametrize("missing", [1, 50, 51])
def test_a_gap_too_long_to_be_told_by_the_clock_to_the_frame_is_a_break(missing: int) -> None:
    blocks: list[SampleBlock] = []
    stream = StreamAssembler(
        "s", 100.0, counter_bits=None, samples_per_frame=1, counts_per_frame=1, deliver=blocks.append
    )
    sent = np.concatenate([np.arange(60), np.arange(60) + 60 + missing])
    for t_ns in sent * PERIOD_NS:
        stream.accept(
            np.zeros(1, np.int64), np.zeros((1, 1, 1), np.float32), np.ones(1, bool), np.array([t_ns])
        )
    stream.flush()
    (after,) = [block for block in blocks if block.lost_before]
    assert after.lost_before == missing
    assert bool(after.quality & Quality.PLACE_ESTIMATED) == (missing > 50)


def test_the_standard_acceleration_message_of_j1939_is_read_without_a_counter() -> None:
    machine = load_machine_file(SENSOR)
    layout = frame_layout(machine, "foot")
    assert (layout.counter, layout.counter_bits, layout.counts_per_frame) == (None, None, 1)
    payload = np.array([[0x00, 0x7D, 0x01, 0x7D, 0xFF, 0xFF, 0xFF, 0xFF]], np.uint8)
    lateral, longitudinal, vertical = layout.decode(payload).samples[0, 0].tolist()
    assert (lateral, longitudinal) == (
        0.0,
        pytest.approx(0.01, abs=1e-6),
    )  # 0x7d00 is 320 m/s2 above the offset
    assert np.isnan(vertical)
    sent = layout.encode(np.array([5]), np.array([[[0.0, 0.01, np.nan]]]))
    assert sent[0, :6].tobytes() == payload[0, :6].tobytes()
    assert "none: by time" in describe(machine)


def test_a_message_of_a_data_base_may_have_no_counter_either() -> None:
    machine = parsed(TRIAXIAL, ("counter = {", "no_counter = true # {"))
    (stream,) = machine.streams
    assert frame_layout(machine, stream).counter is None
    given = machine.streams[stream].layout
    channels = {channel.name: channel.signals for channel in given.channels}
    read = layout_from_dbc(
        machine.resolve(given.dbc), given.message, counter=None, counts="frames", channels=channels
    )
    assert read.counter_bits is None


def test_whoever_goes_without_a_counter_says_so() -> None:
    problem, _ = only_problem(SENSOR, ("no_counter = true\n", ""))
    assert problem.key == "streams.foot.layout.counter"
    assert "no_counter = true" in problem.remedy
    both = 'no_counter = true\ncounter = { byte = 7, bits = 8, counts = "frames" }'
    problem, _ = only_problem(SENSOR, ("no_counter = true", both))
    assert problem.key == "streams.foot.layout.no_counter"


@given(
    bursts=st.lists(st.tuples(st.integers(8, 40), st.integers(2, 4)), min_size=1, max_size=8),
    missing=st.integers(0, 5),
    batch=st.integers(1, 12),
    seed=st.integers(0, 2**32 - 1),
)
def test_frames_that_were_held_up_and_then_come_at_once_are_no_loss(bursts, missing, batch, seed) -> None:
    """What a busy gateway has held up catches up; what is missing besides is counted as ever."""
    rng = np.random.default_rng(seed)
    whole = 30 + sum(calm + held for calm, held in bursts)
    sent = np.concatenate([np.arange(whole), whole + missing + np.arange(20)])
    arrival_ns = sent * PERIOD_NS + rng.uniform(0, 0.3 * PERIOD_NS, len(sent))
    at = 30
    for calm, held in bursts:
        arrival_ns[at : at + held] = (at + held) * PERIOD_NS
        at += held + calm
    arrival_ns = np.maximum.accumulate(arrival_ns).astype(np.int64)
    blocks: list[SampleBlock] = []
    stream = StreamAssembler(
        "s", 100.0, counter_bits=None, samples_per_frame=1, counts_per_frame=1, deliver=blocks.append
    )
    for part in np.split(np.arange(len(sent)), range(batch, len(sent), batch)):
        samples = sent[part].astype(np.float32)[:, None, None]
        stream.accept(np.zeros(len(part), np.int64), samples, np.ones(len(part), np.bool_), arrival_ns[part])
        stream.tick(int(arrival_ns[part[-1]]))
    stream.flush()
    assert stream.counters.samples_lost == missing
    first = blocks[0].first_index
    for block in blocks:
        assert block.samples[:, 0].tolist() == list(range(block.first_index - first, block.end_index - first))


def test_a_late_frame_waits_for_those_after_it_no_longer_than_said() -> None:
    blocks: list[SampleBlock] = []
    stream = StreamAssembler(
        "s", 100.0, counter_bits=None, samples_per_frame=1, counts_per_frame=1, deliver=blocks.append
    )
    for k in [*range(50), 55]:
        t_ns = k * PERIOD_NS
        frame = np.full((1, 1, 1), k, np.float32)
        stream.accept(np.zeros(1, np.int64), frame, np.ones(1, np.bool_), np.array([t_ns]))
    assert blocks[-1].end_index == 50
    stream.tick(55 * PERIOD_NS + 20 * PERIOD_NS)
    stream.tick(55 * PERIOD_NS + 40 * PERIOD_NS)
    assert blocks[-1].end_index == 56
    assert blocks[-1].lost_before == 5
